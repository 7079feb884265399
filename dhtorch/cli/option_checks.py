"""What is typed, looked over before anything runs: words, names of options, values. Whatever is refused is said in one
line that begins with the option, and names what stands nearest to it.

Values of options that a function takes are held against its annotations; those that belong to no function against
:data:`RULES`, and how small a number may be against its name. So a new stage or reader needs nothing here.
"""

from __future__ import annotations

import collections.abc
import importlib
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dhtorch.runtime import console

#: Options whose value is a place: whatever stands in it, it is one text.
PLACES = ("output", "out", "depth", "html", "save", "result", "root", "data.root", "path")

#: Options whose value is a list: outside a sweep it needs no brackets.
LISTS_OF = ("data.K", "data.K_depth", "data.intrinsics", "data.camera", "data.episode", "data.distortion")

#: Words that others' commands have → ours.
USUAL = {"help": "--help", "version": "--version", "-h": "--help", "-V": "--version", "show": "view"}

#: A test of a value and what is expected, in words.
Rule = tuple[Callable[[Any], bool], str]


def whole(low: int) -> Rule:
    """A whole number of at least ``low``."""
    return (lambda v: _is_whole(v) and v >= low), f"a whole number of at least {low}"


def above_zero() -> Rule:
    """A positive number, infinity included."""
    return (lambda v: _is_number(v) and v > 0), "a positive number"


def at_least_zero() -> Rule:
    """A number that is not negative."""
    return (lambda v: _is_number(v) and v >= 0), "a number of at least 0"


def one_of(*known: Any) -> Rule:
    """One of some values; True is not 1."""
    said = [str(k).lower() if isinstance(k, bool) or k is None else str(k) for k in known]
    return (lambda v: any(v is k or (v == k and type(v) is type(k)) for k in known)), " or ".join(said)


def or_null(rule: Rule) -> Rule:
    """Nothing, too."""
    return (lambda v: v is None or rule[0](v)), f"{rule[1]}, or null"


FLAG = one_of(True, False)
SWEEP: Rule = ((lambda v: v is None or isinstance(v, bool | Mapping)), "true, false or options as {size: 320}")

#: Options of the command's own → what they may be.
RULES: dict[str, Rule] = {
    "seed": whole(0),
    "threads": or_null(whole(1)),
    "batch": whole(1),
    "workers": whole(0),
    "dtype": one_of("float32", "float64"),
    "device": ((lambda v: isinstance(v, str)), "one that torch can use here, as cpu or cuda"),
    "figures": one_of(True, False, "all"),
    **dict.fromkeys(("resume", "traceback", "arrays", "points", "past"), FLAG),
    "cutoff": or_null(above_zero()),
    "holdout.cutoff": or_null(above_zero()),
    "holdout.truth": one_of("raw", "5x5", "full"),
    "poses": one_of("device", "anchored"),
    "voxel": or_null(above_zero()),
    "truncation": or_null(above_zero()),
    **dict.fromkeys(("sensor_sigma_m", "sensor_sigma_rel", "min_weight"), at_least_zero()),
    "min_conf": whole(0),
    "min_maps": whole(1),
    "mesh": or_null(FLAG),
    "dense": SWEEP,
    "most": or_null(whole(1)),
    "every": whole(1),
    "partners": whole(1),
    "planes": whole(2),
    "size": whole(8),
    "refinements": whole(0),
    "min_correlation": ((lambda v: _is_number(v) and -1 <= v <= 1), "a number from -1 to 1"),
    "max_sigma_rel": above_zero(),
    "unit": or_null(above_zero()),
    "minutes": or_null(above_zero()),
    "recordings": or_null(whole(1)),
}

#: Names, and ends of names, of numbers that functions take → least value.
COUNTS: tuple[str, ...]
COUNTS = ("n", "hypotheses", "views", "levels", "gap", "stride", "n_frames", "supersample", "window", "block", "patch")
COUNTS += ("steps", "hw", "depth_hw", "tokens_hw", "tokens", "shard_rows", "long", "stack")
MEASURES = re.compile(r".*_(px|m|rel|hz)|(min|max|sigma)_.*|metres|seconds|tolerance|foveation|near|range_limit|window")
#: Numbers below zero that switch a test off, or point somewhere.
SIGNED = ("max_rise", "min_score", "min_correlation")

#: Annotations of lists.
LISTS = (list, tuple, collections.abc.Sequence, collections.abc.Iterable)


def refuse_words(argv: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what is neither an option nor a flag.

    Raises:
        ValueError: such a word, with the nearest of the ``known`` ones.
    """
    for k, word in enumerate(argv):
        if "=" in word or word.startswith(("-", "~")):
            continue
        near = f" (did you mean {USUAL[word]}?)" if word in USUAL else console.suggestion(word, known if k == 0 else ())
        if not near and Path(word).exists():
            near = f" (a capture is named as data=auto data.root={word})"
        expected = f"one of {', '.join(known)}, or option=value" if k == 0 and not near else "option=value"
        raise ValueError(f"{word}: found a word that says nothing here{near}, expected {expected}; see dhtorch --help")


def quoted(argv: Sequence[str], sweep: bool = False) -> list[str]:
    """The words as Hydra's grammar takes them: a value that it cannot read, or that names a place, is one text."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    parser, found = OverridesParser.create(), []
    for word in argv:
        key, sign, value = word.partition("=")
        if sign and value and not word.startswith("-"):
            listed = "," in value and not value.startswith(("'", '"'))
            if key in PLACES and listed and (not sweep or key == "output" or Path(value).exists()):
                found.append(f"{key}={quote(value)}")
                continue
            if key.lstrip("+") in LISTS_OF and listed and not sweep and not value.startswith(("[", "{")):
                found.append(f"{key}=[{value}]")
                continue
            try:
                parser.parse_override(word)
            except HydraException:
                found.append(f"{key}={quote(value)}")
                continue
        found.append(word)
    return found


def quote(text: str) -> str:
    """A value as Hydra's grammar takes it."""
    return text if re.fullmatch(r"[\w./-]+", text) else "'" + text.replace("'", r"\'") + "'"


def refuse_choices(argv: Sequence[str], folder: Path) -> None:
    """Refuse a choice of a group that it does not have.

    Raises:
        ValueError: with the nearest of the group's choices and all of them.
    """
    for word in argv:
        key, sign, value = word.lstrip("+").partition("=")
        if not sign or not (folder / key).is_dir() or "/" in key:
            continue
        known = sorted(p.stem for p in (folder / key).glob("*.yaml"))
        for choice in value.strip("'\"").split(","):
            if choice.strip() not in known and not choice.strip().startswith(("[", "{", "choice(", "glob(")):
                found = f"{key}: found {choice!r}{console.suggestion(choice, known)}"
                raise ValueError(f"{found}, expected one of {', '.join(known)}")


def refuse_keys(
    argv: Sequence[str],
    settings: Mapping[str, Any],
    groups: Iterable[str],
    more: Iterable[str],
    elsewhere: Iterable[str] = (),
) -> None:
    """Refuse names of options that are not among the settings; with ``+`` those that their function does not take.

    Args:
        argv: the words.
        settings: as composed from the words that choose a group.
        groups: names of groups.
        more: further names that are known.
        elsewhere: names that another choice of a group has: suggested, but not taken.

    Raises:
        ValueError: with the nearest name.
    """
    known = {*names(settings), *groups, *more}
    for word in argv:
        key = word.partition("=")[0].partition("@")[0]
        plain = key.lstrip("+~")
        if "=" not in word and not key.startswith("~"):
            continue
        if plain in known or plain.startswith(("hydra.", "hydra/")) or (key != plain and _taken(plain, settings)):
            continue
        near = console.suggestion(plain, [*elsewhere, *known])
        raise ValueError(f"{plain}: found no such option{near}, expected one that --help lists")


def for_reader(argv: Sequence[str], settings: Mapping[str, Any], readers: Iterable[str]) -> list[str]:
    """The words with those of a reader's options added that the settings do not list, as it is yet to be recognised.

    Args:
        argv: the words.
        settings: as composed from the words that choose a group.
        readers: names of all options that any reader has; :func:`dhtorch.data.open_all` refuses those of another.
    """
    mine = reader_names(settings, readers)
    return [f"++{word}" if word.partition("=")[0] in mine else word for word in argv]


def reader_names(settings: Mapping[str, Any], readers: Iterable[str]) -> set[str]:
    """Dotted names of the readers' options that may be said although the settings do not list them."""
    data = settings.get("data")
    if not isinstance(data, Mapping):
        return set()
    recognised = data.get("format") == "auto" if "_target_" in data else True  # without: options of a reader alone
    return {f"data.{name}" for name in readers if name not in data} if recognised else set()


def names(settings: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Dotted names of all options, and of what holds some."""
    for key, value in settings.items():
        if not str(key).startswith("_"):
            yield f"{above}{key}"
            if isinstance(value, Mapping):
                yield from names(value, f"{above}{key}.")


def refuse_values(settings: Mapping[str, Any], like: Mapping[str, Any] | None = None, above: str = "") -> None:
    """Refuse what an option cannot be, before any work.

    Args:
        settings: all of them.
        like: the same with their defaults; holds where a function says nothing of an option that it hands on.
        above: name of what holds these settings, with a dot.

    Raises:
        ValueError: naming the option, what was found and what was expected.
    """
    target = settings.get("_target_")
    hints = _hints(str(target)) if target else {}
    for key, value in settings.items():
        name = f"{above}{key}"
        if str(key).startswith("_") or key == "choices":
            continue
        usual = (like or {}).get(key)
        if target:
            _held(name, value, hints.get(str(key), _kind(usual)))
        elif name in RULES and not RULES[name][0](value):
            raise ValueError(f"{name}: found {_said(value)}, expected {RULES[name][1]}")
        if isinstance(value, float) and math.isnan(value):
            raise ValueError(f"{name}: found nan, expected a number")
        if isinstance(value, Mapping):
            refuse_values(value, usual if isinstance(usual, Mapping) else None, f"{name}.")


def _held(name: str, value: Any, hint: Any) -> None:
    """One value against the annotation and its name."""
    key = name.rpartition(".")[2]
    if not _fits(value, hint):
        raise ValueError(f"{name}: found {_said(value)}, expected {_wanted(hint)}")
    low = 1 if key in COUNTS else 0 if MEASURES.fullmatch(key) and key not in SIGNED else None
    for each in value if isinstance(value, list) else [value]:
        if low is not None and _is_number(each) and each < low:
            kind = "a whole number of at least 1" if low else "a number of at least 0"
            raise ValueError(f"{name}: found {_said(value)}, expected {kind}")


def _kind(usual: Any) -> Any:
    """What an option is by its default; one that may be nothing may be anything."""
    if isinstance(usual, list):
        return list[_kind(usual[0])] | None if usual else list | None  # type: ignore[misc]
    kind = next((k for k in (bool, int, float, str) if isinstance(usual, k)), None)
    return Any if kind is None else kind | None


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is what an annotation says; what cannot be told fits, as what a function will make."""
    if isinstance(value, Mapping) and "_target_" in value:
        return True
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, each) for each in args)
    if origin is typing.Literal:
        return value in args
    simple: dict[Any, Callable[[Any], bool]] = {
        type(None): lambda v: v is None,
        bool: lambda v: isinstance(v, bool),
        int: _is_whole,
        float: _is_number,
        str: lambda v: isinstance(v, str),
    }
    if hint in simple:
        return simple[hint](value)
    if origin in LISTS:
        return isinstance(value, list | tuple) and _fit_each(value, origin, args)
    return origin is not collections.abc.Callable or isinstance(value, Mapping)


def _fit_each(values: Sequence[Any], origin: Any, args: Sequence[Any]) -> bool:
    """Whether the items of a list are what its annotation says."""
    if origin is tuple and args and args[-1] is not Ellipsis:
        return len(values) == len(args) and all(map(_fits, values, args))
    return all(_fits(v, args[0]) for v in values) if args else True


def _wanted(hint: Any) -> str:
    """An annotation in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_wanted(each) for each in args))
    if origin is typing.Literal:
        return " or ".join(map(str, args))
    plain = {type(None): "null", bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    if hint in plain:
        return plain[hint]
    if origin in LISTS:
        inner = [_wanted(a) for a in args if a is not Ellipsis]
        return f"a list of {' and '.join(inner) or 'values'}"
    return "the settings of a function" if origin is collections.abc.Callable else "another value"


def _taken(key: str, settings: Mapping[str, Any]) -> bool:
    """Whether the function that stands above an option takes it."""
    *above, last = key.split(".")
    node: Any = settings
    for name in above:
        node = node.get(name) if isinstance(node, Mapping) else None
    if not above or not isinstance(node, Mapping):
        return False
    if "_target_" not in node:
        return "launcher" in above
    parameters = inspect.signature(_function(str(node["_target_"]))).parameters
    return last in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def _function(target: str) -> Any:
    module, _, name = target.rpartition(".")
    return getattr(importlib.import_module(module), name)


def _hints(target: str) -> dict[str, Any]:
    """Annotations of what a target takes; none where they cannot be read."""
    try:
        found = _function(target)
        return typing.get_type_hints(found.__init__ if inspect.isclass(found) else found)
    except (ImportError, AttributeError, NameError, TypeError):
        return {}


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _said(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
