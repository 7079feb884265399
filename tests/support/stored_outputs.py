"""What a command prints and writes, against what is stored of it: texts to the letter, numbers to a tenth.

``DHTORCH_STORE=1 pytest PATH`` stores anew what the commands of PATH print and write, after a change that is meant.
"""

import json
import re
from pathlib import Path

from support.digests import alike
from support.stored_values import stored_values

FOLDER = Path(__file__).parents[1] / "cli" / "stored_outputs"

#: Difference of two numbers that counts as none: single precision and the processor's vectors move a command's figures.
ABSOLUTE, RELATIVE = 0.06, 0.1

#: What differs from run to run: times, dates, keys, versions, and what a machine is.
CHANGING = re.compile(
    r"^git$|meta$|seal|elapsed|seconds|(^|_)date|time_|_time$|key|digest|version|commit|threads|operators|created|peak"
)


def lines_of(value, path=""):
    """A line for every leaf of a JSON value, without those that change."""
    if isinstance(value, dict):
        return [line for k, v in value.items() if not CHANGING.search(k) for line in lines_of(v, f"{path}.{k}")]
    if isinstance(value, list) and len(value) <= 12:
        return [line for k, v in enumerate(value) for line in lines_of(v, f"{path}.{k}")]
    return [f"{path}: {len(value)} items" if isinstance(value, list) else f"{path}: {value}"]


def page_lines(text):
    """The words of a page, its pictures and drawings left out."""
    text = re.sub(r"<(script|style|svg)\b.*?</\1>", "", text, flags=re.DOTALL)
    return [line for tag in re.split(r"<[^>]*>", text) if (line := " ".join(tag.split()))]


def collected(printed, folder, root):
    """Lines of what was printed, and of the JSON files and pages of a folder."""
    found = {"printed": printed.splitlines()}
    for file in sorted(folder.rglob("*")) if folder is not None else ():
        name = str(file.relative_to(folder))
        if file.suffix == ".json":
            found[name] = lines_of(json.loads(file.read_text(encoding="utf-8")))
        elif file.suffix in (".html", ".md"):
            found[name] = page_lines(file.read_text(encoding="utf-8"))
    return {name: [_plain(line.replace(str(root), "ROOT")) for line in lines] for name, lines in found.items()}


def _plain(line):
    """A line without durations and sizes, and with numbers that are not grouped."""
    line = re.sub(r"\d+(\.\d+)?( s\b| ms\b| MiB\b)", "#", line)
    return re.sub(r"(?<=\d),(?=\d{3}\b)", "", line)


def check(name, root, *, printed="", folder=None):
    """Assert that a command printed and wrote what is stored under a name; paths below ``root`` are left out."""
    found, file = collected(printed, folder, root), FOLDER / f"{name}.json"
    stored = stored_values(file, found, found)
    assert found.keys() == stored.keys()
    wrong = [
        f"{key}: {len(found[key])} lines, stored are {len(lines)}"
        for key, lines in stored.items()
        if len(found[key]) != len(lines)
    ]
    for key, lines in stored.items():
        pairs = zip(found[key], lines, strict=False)
        wrong += [f"{key}\n- {b}\n+ {a}" for a, b in pairs if not alike(a, b, ABSOLUTE, RELATIVE)]
    assert not wrong, "\n".join(wrong)
