"""What is typed, looked over before anything runs: words, names of options, values. Whatever is refused is said in one
line that begins with the option, and names what stands nearest to it.

Values of options that a function takes are held against its annotations; those that belong to no function against
:data:`_OPTION_RULES`, and how small a number may be against its name. So a new stage or reader needs nothing here.
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
_PATH_OPTIONS = ("output", "out", "depth", "html", "save", "result", "root", "data.root", "path")

#: Options whose value is a list: outside a sweep it needs no brackets.
_LIST_OPTIONS = ("data.K", "data.K_depth", "data.intrinsics", "data.camera", "data.episode", "data.distortion")

#: Words that others' commands have → ours.
_COMMON_ALIASES = {"help": "--help", "version": "--version", "-h": "--help", "-V": "--version", "show": "view"}

#: A test of a value and what is expected, in words.
_OptionRule = tuple[Callable[[Any], bool], str]


def _whole_number(low: int) -> _OptionRule:
    """A whole number of at least ``low``."""
    return (lambda v: _is_whole(v) and v >= low), f"a whole number of at least {low}"


def _above_zero() -> _OptionRule:
    """A positive number, infinity included."""
    return (lambda v: _is_number(v) and v > 0), "a positive number"


def _at_least_zero() -> _OptionRule:
    """A number that is not negative."""
    return (lambda v: _is_number(v) and v >= 0), "a number of at least 0"


def _one_of(*known: Any) -> _OptionRule:
    """One of some values; True is not 1."""
    said = [str(k).lower() if isinstance(k, bool) or k is None else str(k) for k in known]
    return (lambda v: any(v is k or (v == k and type(v) is type(k)) for k in known)), " or ".join(said)


def _or_null(rule: _OptionRule) -> _OptionRule:
    """Nothing, too."""
    return (lambda v: v is None or rule[0](v)), f"{rule[1]}, or null"


_TRUE_OR_FALSE = _one_of(True, False)
_DENSE_OPTIONS: _OptionRule = (
    (lambda v: v is None or isinstance(v, bool | Mapping)),
    "true, false or options as {size: 320}",
)

#: Options of the command's own → what they may be.
_OPTION_RULES: dict[str, _OptionRule] = {
    "seed": _whole_number(0),
    "threads": _or_null(_whole_number(1)),
    "batch": _whole_number(1),
    "workers": _whole_number(0),
    "dtype": _one_of("float32", "float64"),
    "device": ((lambda v: isinstance(v, str)), "one that torch can use here, as cpu or cuda"),
    "figures": _one_of(True, False, "all"),
    **dict.fromkeys(("resume", "traceback", "arrays", "points", "past"), _TRUE_OR_FALSE),
    "cutoff": _or_null(_above_zero()),
    "holdout.cutoff": _or_null(_above_zero()),
    "holdout.truth": _one_of("raw", "5x5", "full"),
    "poses": _one_of("device", "anchored"),
    "voxel": _or_null(_above_zero()),
    "truncation": _or_null(_above_zero()),
    **dict.fromkeys(("sensor_sigma_m", "sensor_sigma_rel", "min_weight"), _at_least_zero()),
    "min_conf": _whole_number(0),
    "min_maps": _whole_number(1),
    "mesh": _or_null(_TRUE_OR_FALSE),
    "dense": _DENSE_OPTIONS,
    "most": _or_null(_whole_number(1)),
    "every": _whole_number(1),
    "source_views": _whole_number(1),
    "planes": _whole_number(2),
    "size": _whole_number(8),
    "refinements": _whole_number(0),
    "min_correlation": ((lambda v: _is_number(v) and -1 <= v <= 1), "a number from -1 to 1"),
    "max_sigma_rel": _above_zero(),
    "unit": _or_null(_above_zero()),
    "minutes": _or_null(_above_zero()),
    "recordings": _or_null(_whole_number(1)),
}

#: Names, and ends of names, of numbers that functions take → least value.
_COUNT_NAMES: tuple[str, ...]
_COUNT_NAMES = (
    "n",
    "hypotheses",
    "views",
    "levels",
    "gap",
    "stride",
    "n_frames",
    "supersample",
    "window",
    "block",
    "patch",
)
_COUNT_NAMES += ("steps", "hw", "depth_hw", "tokens_hw", "tokens", "shard_rows", "long", "stack")
_NONNEGATIVE_NAMES = re.compile(
    r".*_(px|m|rel|hz)|(min|max|sigma)_.*|metres|seconds|tolerance|foveation|near|range_limit|window"
)
#: Numbers below zero that switch a test off, or point somewhere.
_SIGNED_NAMES = ("max_rise", "min_score", "min_correlation")

#: Annotations of lists.
_LIST_TYPES = (list, tuple, collections.abc.Sequence, collections.abc.Iterable)


def validate_words(argv: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what is neither an option nor a flag.

    Raises:
        ValueError: such a word, with the nearest of the ``known`` ones.
    """
    for k, word in enumerate(argv):
        if "=" in word or word.startswith(("-", "~")):
            continue
        near = (
            f" (did you mean {_COMMON_ALIASES[word]}?)"
            if word in _COMMON_ALIASES
            else console.suggest_name(word, known if k == 0 else ())
        )
        if not near and Path(word).exists():
            near = f" (a capture is named as data=auto data.root={word})"
        expected = f"one of {', '.join(known)}, or option=value" if k == 0 and not near else "option=value"
        raise ValueError(f"{word}: found a word that says nothing here{near}, expected {expected}; see dhtorch --help")


def quote_words(argv: Sequence[str], sweep: bool = False) -> list[str]:
    """The words as Hydra's grammar takes them: a value that it cannot read, or that names a place, is one text."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    parser, found = OverridesParser.create(), []
    for word in argv:
        key, sign, value = word.partition("=")
        if sign and value and not word.startswith("-"):
            listed = "," in value and not value.startswith(("'", '"'))
            if key in _PATH_OPTIONS and listed and (not sweep or key == "output" or Path(value).exists()):
                found.append(f"{key}={quote_value(value)}")
                continue
            if key.lstrip("+") in _LIST_OPTIONS and listed and not sweep and not value.startswith(("[", "{")):
                found.append(f"{key}=[{value}]")
                continue
            try:
                parser.parse_override(word)
            except HydraException:
                found.append(f"{key}={quote_value(value)}")
                continue
        found.append(word)
    return found


def quote_value(text: str) -> str:
    """A value as Hydra's grammar takes it."""
    return text if re.fullmatch(r"[\w./-]+", text) else "'" + text.replace("'", r"\'") + "'"


def validate_choices(argv: Sequence[str], folder: Path) -> None:
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
                found = f"{key}: found {choice!r}{console.suggest_name(choice, known)}"
                raise ValueError(f"{found}, expected one of {', '.join(known)}")


def validate_option_names(
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
    known = {*iter_option_names(settings), *groups, *more}
    for word in argv:
        key = word.partition("=")[0].partition("@")[0]
        plain = key.lstrip("+~")
        if "=" not in word and not key.startswith("~"):
            continue
        if plain in known or plain.startswith(("hydra.", "hydra/")) or (key != plain and _is_accepted(plain, settings)):
            continue
        near = console.suggest_name(plain, [*elsewhere, *known])
        raise ValueError(f"{plain}: found no such option{near}, expected one that --help lists")


def add_reader_options(argv: Sequence[str], settings: Mapping[str, Any], readers: Iterable[str]) -> list[str]:
    """The words with those of a reader's options added that the settings do not list, as it is yet to be recognised.

    Args:
        argv: the words.
        settings: as composed from the words that choose a group.
        readers: names of all options that any reader has; :func:`dhtorch.data.open_all` refuses those of another.
    """
    mine = list_reader_options(settings, readers)
    return [f"++{word}" if word.partition("=")[0] in mine else word for word in argv]


def list_reader_options(settings: Mapping[str, Any], readers: Iterable[str]) -> set[str]:
    """Dotted names of the readers' options that may be said although the settings do not list them."""
    data = settings.get("data")
    if not isinstance(data, Mapping):
        return set()
    recognised = data.get("format") == "auto" if "_target_" in data else True  # without: options of a reader alone
    return {f"data.{name}" for name in readers if name not in data} if recognised else set()


def iter_option_names(settings: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Dotted names of all options, and of what holds some."""
    for key, value in settings.items():
        if not str(key).startswith("_"):
            yield f"{above}{key}"
            if isinstance(value, Mapping):
                yield from iter_option_names(value, f"{above}{key}.")


def validate_values(settings: Mapping[str, Any], like: Mapping[str, Any] | None = None, above: str = "") -> None:
    """Refuse what an option cannot be, before any work.

    Args:
        settings: all of them.
        like: the same with their defaults; holds where a function says nothing of an option that it hands on.
        above: name of what holds these settings, with a dot.

    Raises:
        ValueError: naming the option, what was found and what was expected.
    """
    target = settings.get("_target_")
    hints = _load_hints(str(target)) if target else {}
    for key, value in settings.items():
        name = f"{above}{key}"
        if str(key).startswith("_") or key == "choices":
            continue
        usual = (like or {}).get(key)
        if target:
            _check_value(name, value, hints.get(str(key), _hint_from_default(usual)))
        elif name in _OPTION_RULES and not _OPTION_RULES[name][0](value):
            raise ValueError(f"{name}: found {_format_value(value)}, expected {_OPTION_RULES[name][1]}")
        if isinstance(value, float) and math.isnan(value):
            raise ValueError(f"{name}: found nan, expected a number")
        if isinstance(value, Mapping):
            validate_values(value, usual if isinstance(usual, Mapping) else None, f"{name}.")


def _check_value(name: str, value: Any, hint: Any) -> None:
    """One value against the annotation and its name."""
    key = name.rpartition(".")[2]
    if not _matches_hint(value, hint):
        raise ValueError(f"{name}: found {_format_value(value)}, expected {_describe_hint(hint)}")
    low = 1 if key in _COUNT_NAMES else 0 if _NONNEGATIVE_NAMES.fullmatch(key) and key not in _SIGNED_NAMES else None
    for each in value if isinstance(value, list) else [value]:
        if low is not None and _is_number(each) and each < low:
            kind = "a whole number of at least 1" if low else "a number of at least 0"
            raise ValueError(f"{name}: found {_format_value(value)}, expected {kind}")


def _hint_from_default(usual: Any) -> Any:
    """What an option is by its default; one that may be nothing may be anything."""
    if isinstance(usual, list):
        return list[_hint_from_default(usual[0])] | None if usual else list | None  # type: ignore[misc]
    kind = next((k for k in (bool, int, float, str) if isinstance(usual, k)), None)
    return Any if kind is None else kind | None


def _matches_hint(value: Any, hint: Any) -> bool:
    """Whether a plain value is what an annotation says; what cannot be told fits, as what a function will make."""
    if isinstance(value, Mapping) and "_target_" in value:
        return True
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_matches_hint(value, each) for each in args)
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
    if origin in _LIST_TYPES:
        return isinstance(value, list | tuple) and _items_match_hint(value, origin, args)
    return origin is not collections.abc.Callable or isinstance(value, Mapping)


def _items_match_hint(values: Sequence[Any], origin: Any, args: Sequence[Any]) -> bool:
    """Whether the items of a list are what its annotation says."""
    if origin is tuple and args and args[-1] is not Ellipsis:
        return len(values) == len(args) and all(map(_matches_hint, values, args))
    return all(_matches_hint(v, args[0]) for v in values) if args else True


def _describe_hint(hint: Any) -> str:
    """An annotation in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_describe_hint(each) for each in args))
    if origin is typing.Literal:
        return " or ".join(map(str, args))
    plain = {type(None): "null", bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    if hint in plain:
        return plain[hint]
    if origin in _LIST_TYPES:
        inner = [_describe_hint(a) for a in args if a is not Ellipsis]
        return f"a list of {' and '.join(inner) or 'values'}"
    return "the settings of a function" if origin is collections.abc.Callable else "another value"


def _is_accepted(key: str, settings: Mapping[str, Any]) -> bool:
    """Whether the function that stands above an option takes it."""
    *above, last = key.split(".")
    node: Any = settings
    for name in above:
        node = node.get(name) if isinstance(node, Mapping) else None
    if not above or not isinstance(node, Mapping):
        return False
    if "_target_" not in node:
        return "launcher" in above
    parameters = inspect.signature(_load_function(str(node["_target_"]))).parameters
    return last in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def _load_function(target: str) -> Any:
    module, _, name = target.rpartition(".")
    return getattr(importlib.import_module(module), name)


def _load_hints(target: str) -> dict[str, Any]:
    """Annotations of what a target takes; none where they cannot be read."""
    try:
        found = _load_function(target)
        return typing.get_type_hints(found.__init__ if inspect.isclass(found) else found)
    except (ImportError, AttributeError, NameError, TypeError):
        return {}


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _format_value(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
