"""Our functions beside kornia's: time, difference, and whether kornia's keeps what an answer here must keep.

Both sides are asked the same question in turn, one thread, float32. Beside the time stand the largest and the median
relative difference, the latter in float64 as well; whether either side answers a batch as it answers each element
alone, and a point among others as among fewer, bit for bit; whether ``torch.compile`` captures it as one graph; whether
its gradient is finite, also where a formula divides by zero. A function that now calls kornia is compared as it was
before, see :mod:`before_kornia`.

``--before FOLDER`` asks both methods of real pairs (``DHTORCH_DATA``), here and in an earlier checkout; without it the
file's answers stay.

This file is not called ``kornia.py``, because every script beside it would then import it instead of the library.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import harness
import torch
from kornia_peers import PEERS, Peer
from torch import Tensor
from torch.utils import _pytree as pytree

HERE = Path(__file__).resolve().parent

#: Sizes of the checks that compare bits: where there are points enough of them that a vector loop has a tail, else as
#: many elements; pictures are few.
B, MANY, N, FEW = 3, 67, 501, 37


def run(repeats: int, only: str = "", clock: str = "wall") -> list[dict[str, Any]]:
    """A row for every pair of functions."""
    return [compare(peer, repeats, clock) for peer in PEERS if only in f"{peer.ours} {peer.kornia}"]


def compare(peer: Peer, repeats: int, clock: str) -> dict[str, Any]:
    """Time both sides and say how they differ."""
    args = peer.make(torch.float32, *peer.size)
    calls = (lambda: peer.mine(*args), lambda: peer.theirs(*args))
    with torch.no_grad():
        ours, theirs = harness.in_turn(calls, repeats=repeats, least_ms=20, clock=clock)
        largest, typical = difference(*(call() for call in calls))
        exact = peer.make(torch.float64, *peer.size)
        _, typical_64 = difference(peer.mine(*exact), peer.theirs(*exact))
    more: dict[str, Any] = {"kornia": peer.kornia, "used": peer.used, "why": peer.why, "note": peer.note}
    more |= {"largest": largest, "median_rel": typical, "median_rel_float64": typical_64}
    for side, fn in (("ours", peer.mine), ("kornia", peer.theirs)):
        arrays = peer.arrays and side == "ours"
        more[f"{side}_steady"] = steady(peer, fn)
        more[f"{side}_captures"] = None if arrays else captures(peer, fn)
        more[f"{side}_gradient"] = None if arrays else gradient(fn, peer.make(torch.float32, B, FEW))
        more[f"{side}_hard"] = None if peer.hard is None else gradient(fn, peer.hard())
    versions = {name: version(name) for name in ("torch", "kornia")}
    size = {"n": peer.size[1], "batch": peer.size[0], "clock": clock}
    return harness.row(peer.ours, ours, "kornia", theirs, **size, **more, versions=versions)


def difference(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Largest absolute and median relative difference of what is finite on both sides."""
    a, b = a.double().flatten(), b.double().flatten()
    both = a.isfinite() & b.isfinite()
    a, b = a[both], b[both]
    scale = a.abs().clamp_min(1e-6 * float(a.abs().max()) + 1e-300)
    return float((a - b).abs().max()), float(((a - b).abs() / scale).median())


def steady(peer: Peer, fn: Callable[..., Any]) -> bool:
    """Whether each element alone, and a few points alone, get the bits that they get in company."""
    many = MANY if not peer.points and peer.size[0] > B else B
    args = peer.make(torch.float32, many, N)
    whole = fn(*args)
    if len(whole) != many:
        return True
    alone = torch.cat([fn(*(x[k : k + 1] for x in args)) for k in range(many)])
    same = torch.equal(alone.nan_to_num(), whole.nan_to_num())
    if peer.points:
        few = fn(*(x[:, :FEW] if k in peer.points else x for k, x in enumerate(args)))
        same = same and torch.equal(few.nan_to_num(), whole[:, :FEW].nan_to_num())
    return same


def captures(peer: Peer, fn: Callable[..., Any]) -> bool:
    """Whether it compiles as one graph."""
    torch._dynamo.reset()
    with contextlib.suppress(Exception):
        torch.compile(fn, backend="eager", fullgraph=True)(*peer.make(torch.float32, B, FEW))
        return True
    return False


def gradient(fn: Callable[..., Any], args: tuple[Any, ...]) -> bool:
    """Whether there is a gradient, and all of it finite."""
    args = pytree.tree_map(lambda x: x.clone().requires_grad_(), args)
    with contextlib.suppress(Exception):
        result = fn(*args)
        torch.where(result.isfinite(), result, 0.0).sum().backward()
        grads = [x.grad for x in _tensors(args) if x.grad is not None]
        return bool(grads) and all(bool(g.isfinite().all()) for g in grads)
    return False


def _tensors(args: Any) -> Iterator[Tensor]:
    yield from (x for x in pytree.tree_leaves(args) if isinstance(x, Tensor) and x.is_floating_point())


def answers(before: Path) -> list[dict[str, Any]]:
    """What the methods say of real pairs, here and in the checkout ``before``: a row for each scene and method."""
    with tempfile.TemporaryDirectory() as folder:
        dumps = []
        for side, root in (("before", before), ("now", HERE.parent)):
            path = Path(folder) / f"{side}.pt"
            environment = {**os.environ, "PYTHONPATH": str(root)}
            subprocess.run(
                [sys.executable, str(HERE / "answers.py"), str(path)], env=environment, cwd=folder, check=True
            )
            dumps.append(torch.load(path))
    commit = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=before, text=True).strip()
    rows = []
    for key in dict.fromkeys((scene, method) for scene, method, _ in dumps[0]):
        pairs = [k for k in dumps[0] if k[:2] == key]
        a, b = ({name: torch.cat([side[k][name] for k in pairs]) for name in ("depth", "gate")} for side in dumps)
        both = (a["gate"] == 0) & (b["gate"] == 0)
        moved = ((a["depth"] - b["depth"]).abs() / a["depth"])[both]
        numbers = {"answered": int((a["gate"] == 0).sum()), "flipped": float((a["gate"] != b["gate"]).double().mean())}
        numbers |= {"median_rel": float(moved.median()), "largest_rel": float(moved.max())}
        rows.append({"name": "answers", "scene": key[0], "method": key[1], "pairs": len(pairs), **numbers})
        rows[-1]["before"] = commit
    return rows


def main() -> None:
    """Print the rows, and write them with ``--json``."""
    parser = harness.arguments(__doc__ or "")
    parser.add_argument("--only", default="", help="rows whose names hold this")
    parser.add_argument("--before", type=Path, help="an earlier checkout, whose answers to real pairs are compared")
    options = parser.parse_args()
    harness.set_threads(1)
    rows = run(options.repeats, options.only, options.clock)
    for r in rows:
        counts = " ".join(f"{k}={r[k]}" for k in r if k.endswith(("steady", "captures", "gradient", "hard")))
        print(f"{r['name']:46} {r['kornia']:52} {r['ratio']:7.3f} {r['largest']:9.2e} {r['median_rel']:9.2e} {counts}")
    if options.before is not None:
        rows += answers(options.before)
        print(*rows[len(rows) - 8 :], sep="\n")
    elif options.json is not None and options.json.is_file():  # answers are not asked again for the sake of times
        rows += [r for r in json.loads(options.json.read_text()) if r["name"] == "answers"]
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
