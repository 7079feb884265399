"""Table of readme.py: clients by version and command, from the result files of ``clients/``, with what helps."""

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

from cells import read, table

#: Reason of a failure (pattern) → what it is, and what helps.
FIXES: dict[str, tuple[str, str]] = {
    r"BackwardCompatibilityError": ("supports only v3.0", "`enrich format=lerobot`"),
    r"OfflineModeIsEnabled": ("supports only v2.1, and then queries the hub", "`enrich format=v2.1`"),
    r"found no picture in the tables": ("images are stored as video, which it does not decode", "LeRobot's own loader"),
    r"found no poses": ("a source without poses", "a source with poses, or a LeRobot format"),
    r"knows no depth": ("no depth support", "LeRobot 0.6 or later"),
    r"lerobot-rollout is in": ("has no `lerobot-rollout`", "LeRobot 0.6 or later"),
    r"\Anot installed\Z|\Anot run\Z": ("not run", "an environment with it, see the command below"),
}

#: Client in a result file → its name in the table.
NAMES = {"torch": "PyTorch", "openpi_client": "openpi-client", "datasets": "Hugging Face datasets"}
NAMES |= {"lerobot": "LeRobot", "webdataset": "WebDataset", "modality.json by its fields": "GR00T's `modality.json`"}

#: Target in a result file → the command that writes it, or what is read.
WRITERS = {
    "lerobot v3.0": "`enrich format=lerobot`",
    "lerobot v2.1": "`enrich format=v2.1`",
    "nerfstudio": "`enrich format=nerfstudio`",
    "as it is": "an RLDS set as it is",
    "read by dhtorch": "depth that LeRobot wrote",
}


class Outcome(NamedTuple):
    """What one client made of one set."""

    client: str
    version: str
    command: str
    passed: bool | None  # None = not run
    why: str = ""
    off: float | None = None  # m, largest difference of depth from the stored values; None = not compared


def clients() -> str:
    """Client × version × command: sets on which it passed, and for the others the reason and the fix."""
    groups: dict[tuple[str, str, str], list[Outcome]] = {}
    for outcome in list_outcomes():
        groups.setdefault(outcome[:3], []).append(outcome)
    head = ["client", "version", "command, or what it reads", "passed", "largest depth difference, mm", "reason", "fix"]
    lines = []
    for (client, version, command), outcomes in groups.items():
        run = [outcome for outcome in outcomes if outcome.passed is not None]
        result = f"{sum(bool(outcome.passed) for outcome in run)} of {len(run)}" if run else "not run"
        causes = [explain(outcome.why) for outcome in outcomes if not outcome.passed]
        texts = ["; ".join(dict.fromkeys(cause[k] for cause in causes if cause[k])) for k in range(2)]
        off = max((outcome.off for outcome in outcomes if outcome.off is not None), default=None)
        lines.append([client, version or "–", command, result, "–" if off is None else f"{1e3 * off:.1g}", *texts])
    return table(head, lines, n_label=len(head))


def explain(why: str) -> tuple[str, str]:
    """Reason of a failure → what it is in words, and what helps; a reason that no pattern knows stands as it is."""
    known = next((texts for pattern, texts in FIXES.items() if re.search(pattern, why)), None)
    return known or (why.replace("|", "/"), "")


def list_outcomes() -> Iterator[Outcome]:
    """Rows of the results; of ``clients`` a row without a loader is a format that ``enrich`` refuses for its source."""
    for row in read("clients"):
        loader, target = str(row["loader"]), str(row["target"])
        if loader == "–":
            yield Outcome("dhtorch", "", WRITERS[target], False, row["why"])
            continue
        name, _, version = (loader, "", "") if loader in NAMES else loader.partition(" ")
        if not re.match(r"\d", version):  # words, not a version
            name, version = loader, ""
        version, _, rest = version.partition(", ")
        passed = None if row["why"] == "not installed" else bool(row["opened"]) and not row["why"]
        name = f"{name}'s parser" if rest else NAMES.get(name, name)
        more = next((word for word in row["options"] if word.startswith("columns=")), "")
        command = f"{WRITERS[target][:-1]} {more}`" if more else WRITERS[target]
        off = (row["compared"] or {}).get("largest_difference", {}).get("depth")
        yield Outcome(name, version, command, passed, row["why"], off)
    for row in read("lerobot_train"):
        command = str(row["command"])
        shown = f"`lerobot-train --policy.type={command}`" if command in ("act", "diffusion") else command
        shown = "README's example of a loader" if row["set"] == "README" else shown
        yield Outcome("LeRobot", row["lerobot"], shown, row["passed"], row["why"])
    for row in read("lerobot_plugin"):  # one for each test of the package
        yield Outcome("LeRobot", row["lerobot"], "tests of `integrations/lerobot`", row["passed"], row["why"])
    for row in read("readers_3d"):
        writer = "`dhtorch PATH`" if row["written_by"] == "recover" else f"`dhtorch {row['written_by']}`"
        passed = None if row["state"] == "not run" else row["state"] == "passed"
        yield Outcome(row["reader"], row["version"] or "", writer, passed, row["why"])


TABLES: dict[str, Callable[[], str]] = {"clients": clients}
