"""Write ``conf/method/*.yaml`` from the methods' records, so that every option stands once: in its function.

    python docs/settings.py            write them (``make conf``)
    python docs/settings.py --check    say which differ, and change nothing

What Hydra composes is then complete: every stage's function with every option and its value, so that any of them can be
changed from the command line, and a misspelt one is refused by the settings alone. Comments are the first words that a
function's docstring has for the option.
"""

import argparse
import inspect
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dhtorch.experiments.baselines import opencv, xfeat
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import METHODS, PAPER_DIRECT
from dhtorch.pipeline.spec import MethodSpec

FOLDER = Path(__file__).resolve().parent.parent / "conf" / "method"

#: Given by the caller at run time, never by settings.
AT_RUN_TIME = {"hint", "device", "dtype", "seed", "fit", "linear"}

#: File name → method, and what its file says first.
WRITTEN: dict[str, Method] = {
    **METHODS,
    "paper_direct": PAPER_DIRECT,
    "opencv": opencv.OPENCV,
    "xfeat": xfeat.XFEAT,
}

WIDTH = 120


def document(name: str, method: Method) -> str:
    """The file of a method."""
    lines = [f"# {line}" for line in _source_comment(name)]
    lines += ["# Written from its record by `make conf`.", "_target_: dhtorch.pipeline.method.Method"]
    comments = _comments(MethodSpec)
    for field in fields(method):
        lines += _option(field.name, getattr(method, field.name), comments.get(field.name), 0)
    return "\n".join(lines) + "\n"


def _option(name: str, value: Any, comment: str | None, depth: int) -> Iterator[str]:
    """The lines of one option; of a function with all its options below."""
    pad = "  " * depth
    if is_dataclass(value):  # a record of options
        yield f"{pad}{name}:"
        yield f"{pad}  _target_: {type(value).__module__}.{type(value).__qualname__}"
        for field in fields(value):
            yield from _option(field.name, getattr(value, field.name), None, depth + 1)
        return
    function = value.func if isinstance(value, partial) else value
    if not callable(function):
        line = f"{pad}{name}: {_scalar(value)}"
        yield line if comment is None or len(line) + len(comment) + 4 > WIDTH else f"{line}  # {comment}"
        return
    bound: Mapping[str, Any] = value.keywords if isinstance(value, partial) else {}
    yield f"{pad}{name}:"
    yield f"{pad}  _target_: {function.__module__}.{function.__qualname__}"
    yield f"{pad}  _partial_: true"
    comments = _comments(function)
    for key, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY and key not in AT_RUN_TIME:
            yield from _option(key, bound.get(key, parameter.default), comments.get(key), depth + 1)


def _scalar(value: Any) -> str:
    """A value as YAML writes it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        text = repr(value)
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_scalar, value)) + "]"
    if isinstance(value, torch.Tensor | torch.nn.Module):
        raise TypeError(f"settings hold numbers and names, found {type(value).__name__}")
    return str(value)


def _source_comment(name: str) -> list[str]:
    """The comment above a method's name in its module."""
    for module in (sys.modules["dhtorch.pipeline.presets"], opencv, xfeat):
        source = inspect.getsource(module)
        if match := re.search(rf"((?:^#: .*\n)+)^{name.upper()} = ", source, re.M):
            return [line.removeprefix("#: ").replace("``", "`") for line in match[1].splitlines()]
    raise ValueError(f"{name}: found no comment above {name.upper()}")


def _comments(function: Any) -> dict[str, str]:
    """Option → the first words about it: of a docstring's Args, or of the comment beside a record's field."""
    if inspect.isclass(function):
        pairs = re.findall(r"^    (\w+): .* = .*?  # (.*)$", inspect.getsource(function), re.M)
        return dict(pairs)
    text = inspect.getdoc(function) or ""
    args = re.search(r"^Args:\n((?: .*\n|\n)+)", text, re.M)
    if args is None:
        return {}
    entries = re.findall(r"^    ([\w, ]+): ((?:.*\n?)(?:      .*\n?)*)", args[1], re.M)
    summaries = {}
    for names, words in entries:
        first = re.split(r"(?<=\w)[.;] |:\s|\.$", " ".join(words.split()))[0]
        if "," not in names:
            summaries[names] = first.replace("``", "`")
    return summaries


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing, fail where a file differs")
    check = parser.parse_args(argv).check
    stale = []
    for name, method in WRITTEN.items():
        path, text = FOLDER / f"{name}.yaml", document(name, method)
        if path.is_file() and path.read_text() == text:
            continue
        stale.append(path.name)
        if not check:
            path.write_text(text)
    if stale:
        print(f"{'differ from their records' if check else 'wrote'}: {', '.join(stale)}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    raise SystemExit(main())
