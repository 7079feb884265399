"""Hostile files of every format and of every other input (depth maps, results, models, settings …), each read by a
child under the law of docs/data.md: time, memory, writes, code.

    make fuzz                                            # some thousand seeded cases, within ten minutes
    python benchmarks/fuzz.py --full --json benchmarks/results/fuzz.json   # more than 20,000
    python benchmarks/fuzz.py --only lerobot_v2 --case 17                  # one case again

Half of the cases are bytes damaged (``tests/support/byte_damage.py``), half are files taken apart and put together
again with one thing changed (``tests/support/format_damage.py``). A case is known by its format, seed and number.
Before them, a pipe, a socket, a device, a folder and a file of 3 GiB stand in the place of each kind of file. Exit code
1 where one is neither valid data nor a FormatError in one line.
"""

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from support import byte_damage, damage_harness, format_damage  # noqa: E402
from support.captures_by_format import SAMPLES as CAPTURES  # noqa: E402
from support.other_inputs import OTHER_INPUTS  # noqa: E402

from dhtorch.runtime import storage  # noqa: E402
from dhtorch.runtime.safe_open import MAX_MEMORY_BYTES  # noqa: E402

SAMPLES = CAPTURES | OTHER_INPUTS
SOME, MANY = 150, 350  # cases of every format or other input
SECONDS = 20  # of a processor
#: Memory in bytes of an input that is no capture: its arrays may have any size that its files have.
OTHER_BYTES = 2 << 30
MINUTES = 9  # after which the seeded part stops, wherever it is


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases, print a line for every format; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help=f"{MANY} cases of every format instead of {SOME}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one format")
    parser.add_argument("--case", type=int, help="one case of it")
    parser.add_argument("--json", type=Path, help="write a summary")
    options = parser.parse_args(argv)
    damage_harness.SECONDS = SECONDS
    names = [options.only] if options.only else list(SAMPLES)
    numbers = [options.case] if options.case is not None else range(MANY if options.full else SOME)
    end = time.monotonic() + (MINUTES * 60 if not options.full else float("inf"))
    outcomes = {}
    for k, name in enumerate(names):  # each its share of what is left, so that a slow one starves no other
        now = time.monotonic()
        outcomes[name] = attack(name, numbers, options.seed, now + (end - now) / (len(names) - k))
    failures = [failure for each in outcomes.values() for failure in each["failures"]]
    total = sum(each["cases"] for each in outcomes.values())
    print(f"{total} cases, {len(failures)} failures")
    if options.json:
        law = {"name": "all", "cases": total, "failures": len(failures), "cpu_s": SECONDS, "bytes": MAX_MEMORY_BYTES}
        law["bytes_of_other_inputs"] = OTHER_BYTES
        storage.write_json(
            options.json, [law | {"seed": options.seed}, *({"name": k} | v for k, v in outcomes.items())]
        )
    return int(bool(failures))


def attack(name: str, numbers: Sequence[int], seed: int, stop: float) -> dict[str, Any]:
    """Cases of one format by outcome, the worst of them, and what failed."""
    counts, failures = Counter[str](), list[str]()
    damage_harness.BYTES = MAX_MEMORY_BYTES if name in CAPTURES else OTHER_BYTES
    slowest = largest = 0.0
    with (
        tempfile.TemporaryDirectory(prefix="dhtorch-fuzz-") as folder,
        damage_harness.sample(*SAMPLES[name], Path(folder)) as (good, outcome_of),
    ):
        for number, what, want in _iter_cases(name, good, numbers, seed):
            if time.monotonic() > stop:
                break
            outcome = outcome_of(want)
            counts[outcome.kind] += 1
            slowest, largest = max(slowest, outcome.seconds), max(largest, outcome.bytes / 2**20)
            if outcome.kind not in damage_harness.FINE:
                failures.append(f"{name} case {number} ({what}): {outcome.kind}: {outcome.detail[-500:]}")
                print(failures[-1], flush=True)
    print(f"{name:20} {counts.total():5} cases, {dict(counts)}, at most {slowest:.1f} s, {largest:.0f} MiB", flush=True)
    worst = {"slowest_s": round(slowest, 2), "largest_mib": round(largest)}
    return {"cases": counts.total(), "outcomes": dict(counts), **worst, "failures": failures}


def _iter_cases(
    name: str, good: byte_damage.Capture, numbers: Sequence[int], seed: int
) -> Iterator[tuple[int, str, byte_damage.Capture]]:
    """Number, description and files of each case; numbers below 0 are those of what is no file."""
    if len(numbers) > 1 and name != "settings":  # these are the user's own
        yield from ((~k, *case) for k, case in enumerate(byte_damage.iter_strange(good)))
    for number in numbers:
        draw = random.Random(f"{name}/{seed}/{number}")
        yield number, *(byte_damage.mutate if number % 2 else format_damage.recode)(good, draw)


if __name__ == "__main__":
    raise SystemExit(main())
