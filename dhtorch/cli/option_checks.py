"""Validation of command-line arguments before a run: arguments, option names, values; one-line errors with suggestions.

Values of a function's options are compared with its annotations, options of no function against
:data:`_OPTION_RULES`, and lower limits of numbers follow from their names. A new stage or reader needs no entry here.
"""

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

#: Options whose value is a path: never split at commas.
_PATH_OPTIONS = ("output", "out", "depth", "html", "save", "result", "root", "data.root", "path")

#: Options whose value is a list: outside a sweep the brackets may be omitted.
_LIST_OPTIONS = ("data.K", "data.K_depth", "data.intrinsics", "data.camera", "data.episode", "data.distortion")

#: Arguments common in other commands → the equivalent here.
_COMMON_ALIASES = {"version": "--version", "-h": "--help", "-V": "--version", "show": "view"}

#: A test of a value, and the text after "expected" in the error.
_OptionRule = tuple[Callable[[Any], bool], str]


def _whole_number(low: int) -> _OptionRule:
    """Rule: a whole number of at least ``low``."""
    return (lambda v: _is_whole(v) and v >= low), f"a whole number of at least {low}"


def _one_of(*known: Any) -> _OptionRule:
    """Rule: one of ``known``; True is not equal to 1."""
    names = [str(k).lower() if isinstance(k, bool) or k is None else str(k) for k in known]
    return (lambda v: any(v is k or (v == k and type(v) is type(k)) for k in known)), " or ".join(names)


def _or_null(rule: _OptionRule) -> _OptionRule:
    """Rule: ``rule`` or None."""
    return (lambda v: v is None or rule[0](v)), f"{rule[1]}, or null"


_TRUE_OR_FALSE = _one_of(True, False)
_ABOVE_ZERO: _OptionRule = (lambda v: _is_number(v) and v > 0), "a positive number"  # infinity included

#: Option of the command itself → its rule.
_OPTION_RULES: dict[str, _OptionRule] = {
    "seed": _whole_number(0),
    "threads": _or_null(_whole_number(1)),
    "batch": _whole_number(1),
    "workers": _whole_number(0),
    "between": _or_null(_whole_number(0)),
    "dtype": _one_of("float32", "float64"),
    "device": ((lambda v: isinstance(v, str)), "a device that torch can use on this machine, e.g. cpu or cuda"),
    **dict.fromkeys(("figures", "points"), _one_of(True, False, "all")),
    **dict.fromkeys(
        ("resume", "traceback", "arrays", "budget", "past", "browser", "markdown", "yes", "data.follow_links"),
        _TRUE_OR_FALSE,
    ),
    "cutoff": _or_null(_ABOVE_ZERO),
    "holdout.cutoff": _or_null(_ABOVE_ZERO),
    "holdout.truth": _one_of("raw", "5x5", "full"),
    "poses": _one_of("auto", "device", "anchored"),
    "voxel": _or_null(_ABOVE_ZERO),
    "truncation": _or_null(_ABOVE_ZERO),
    **dict.fromkeys(
        ("sensor_sigma_m", "sensor_sigma_rel", "min_weight"),
        ((lambda v: _is_number(v) and v >= 0), "a number of at least 0"),
    ),
    "min_conf": _whole_number(0),
    "min_maps": _whole_number(1),
    "weight": _one_of("variance", "confidence"),
    "mesh": _or_null(_TRUE_OR_FALSE),
    "dense": (
        (lambda v: v is None or isinstance(v, bool | Mapping)),
        "true, false or options, e.g. {size: 320}",
    ),
    "max_frames": _or_null(_whole_number(1)),
    "every": _whole_number(1),
    "source_views": _whole_number(1),
    "planes": _whole_number(2),
    "size": _whole_number(8),
    "refinements": _whole_number(0),
    "min_correlation": ((lambda v: _is_number(v) and -1 <= v <= 1), "a number from -1 to 1"),
    "max_sigma_rel": _ABOVE_ZERO,
    "unit": _or_null(_ABOVE_ZERO),
    "minutes": _or_null(_ABOVE_ZERO),
    "recordings": _or_null(_whole_number(1)),
    "ref_frames": _or_null(_whole_number(1)),
    **dict.fromkeys(("window", "pictures"), _whole_number(0)),
    "shard_rows": _whole_number(1),
    **dict.fromkeys(("causal", "report", "cameras"), _TRUE_OR_FALSE),
    "gap": ((lambda v: v == "auto" or (_is_whole(v) and v >= 0)), "a whole number of at least 0"),
    "step": ((lambda v: _is_number(v) and 0 <= v <= 1), "a number from 0 to 1"),
    "fps": ((lambda v: v is None or (_is_number(v) and 1e-4 <= v <= 1e4)), "a number from 0.0001 to 10000"),
}

#: Numeric parameters of functions by name: counts (at least 1), and those that must not be negative.
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
    *("steps", "hw", "depth_hw", "tokens_hw", "tokens", "shard_rows", "long", "stack"),
)
_NONNEGATIVE_NAMES = re.compile(
    r".*_(px|m|rel|hz)|(min|max|sigma)_.*|metres|seconds|tolerance|foveation|near|range_limit|window"
)
#: Parameters that may be negative: below zero they disable a test, or they have a direction.
_SIGNED_NAMES = ("max_rise", "min_score", "min_correlation")
#: Options with the name of a count that may be 0; their function checks them.
_ZERO_OPTIONS = ("extract.gap",)

#: Origins of annotations that accept a list.
_LIST_TYPES = (list, tuple, collections.abc.Sequence, collections.abc.Iterable)


def validate_words(argv: Sequence[str], known: Sequence[str]) -> None:
    """Reject arguments that are neither an option nor a flag.

    Raises:
        ValueError: such an argument, with the nearest of the ``known`` commands.
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
            near = f" (for a capture write data=auto data.root={word})"
        expected = f"one of {', '.join(known)}, or option=value" if k == 0 and not near else "option=value"
        raise ValueError(f"{word}: found an unknown argument{near}, expected {expected}; see dhtorch --help")


def quote_words(argv: Sequence[str], sweep: bool = False) -> list[str]:
    """The arguments in Hydra's grammar: values that it cannot parse, and paths, are quoted."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    parser, quoted = OverridesParser.create(), []
    for word in argv:
        key, sign, value = word.partition("=")
        if sign and value and not word.startswith("-"):
            listed = "," in value and not value.startswith(("'", '"', "["))
            if key in _PATH_OPTIONS and listed and (not sweep or key == "output" or Path(value).exists()):
                quoted.append(f"{key}={quote_value(value)}")
                continue
            if key.lstrip("+") in _LIST_OPTIONS and listed and not sweep and not value.startswith("{"):
                quoted.append(f"{key}=[{value}]")
                continue
            try:
                parser.parse_override(word)
            except HydraException:
                quoted.append(f"{key}={quote_value(value)}")
                continue
        quoted.append(word)
    return quoted


def quote_value(text: str) -> str:
    """A value quoted for Hydra's grammar where necessary."""
    return text if re.fullmatch(r"[\w./-]+", text) else "'" + text.replace("'", r"\'") + "'"


def list_choices(argv: Sequence[str], folder: Path) -> dict[str, list[str]]:
    """Settings group → the chosen names, of a sweep all of them: ``a,b``, ``choice(a,b)`` and ``glob(a*)``.

    Raises:
        ValueError: a name that the group does not have, with the nearest and all valid ones; a pattern without a match.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.core.override_parser.types import ChoiceSweep, Glob  # noqa: PLC0415

    parser, chosen = OverridesParser.create(), {}
    for word in argv:
        key, sign, text = word.lstrip("+").partition("=")
        if not sign or "/" in key or not key or not (folder / key).is_dir():
            continue
        names = sorted(p.stem for p in (folder / key).glob("*.yaml"))
        value = parser.parse_override(word).value()
        if isinstance(value, Glob):
            value = value.filter(names) or [text]
        value = value.list if isinstance(value, ChoiceSweep) else value if isinstance(value, list) else [value]
        chosen[key] = [str(getattr(each, "text", each)) for each in value]
        for name in chosen[key]:
            if name not in names:
                from dhtorch.pipeline.presets import GONE_METHODS, gone_method  # noqa: PLC0415

                if key == "method" and name in GONE_METHODS:
                    raise ValueError(gone_method(name))
                actual = f"{key}: found {name!r}{console.suggest_name(name, names)}"
                raise ValueError(f"{actual}, expected one of {', '.join(names)}")
    return chosen


def validate_option_names(
    argv: Sequence[str],
    settings: Mapping[str, Any],
    groups: Iterable[str],
    more: Iterable[str],
    elsewhere: Iterable[str] = (),
) -> None:
    """Reject option names that are not in the settings; with ``+`` also those that their function does not accept.

    Args:
        argv: the arguments.
        settings: composed from the arguments that choose a group.
        groups: names of groups.
        more: further valid names.
        elsewhere: names valid with another choice of a group: suggested, but not accepted.

    Raises:
        ValueError: names the nearest option.
    """
    known = {*iter_option_names(settings), *groups, *more}
    for word in argv:
        key = word.partition("=")[0].partition("@")[0]
        plain = key.lstrip("+~")
        if "=" not in word and not key.startswith("~"):
            continue
        if plain in known or plain.startswith(("hydra.", "hydra/")) or (key != plain and _is_accepted(plain, settings)):
            continue
        typed = [name.removeprefix("data.") for name in known]  # options of readers are typed without it
        near = console.suggest_name(plain, [*elsewhere, *known, *typed])
        raise ValueError(f"{plain}: found an unknown option{near}, expected one listed by --help")


def add_reader_options(argv: Sequence[str], settings: Mapping[str, Any], readers: Iterable[str]) -> list[str]:
    """The arguments, with ``++`` before reader options that are missing because the format is unknown.

    Args:
        argv: the arguments.
        settings: composed from the arguments that choose a group.
        readers: option names of all readers; :func:`dhtorch.data.open_all` rejects those of another reader.
    """
    mine = list_reader_options(settings, readers)
    return [f"++{word}" if word.partition("=")[0] in mine else word for word in argv]


def list_reader_options(settings: Mapping[str, Any], readers: Iterable[str]) -> set[str]:
    """Dotted names of reader options accepted although the settings do not list them."""
    data = settings.get("data")
    if not isinstance(data, Mapping):
        return set()
    is_open = data.get("format") == "auto" if "_target_" in data else True  # without a _target_: options of a reader
    return {f"data.{name}" for name in readers if name not in data} if is_open else set()


def iter_option_names(settings: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Dotted names of all options and of the nodes that hold options."""
    for key, value in settings.items():
        if not str(key).startswith("_"):
            yield f"{above}{key}"
            if isinstance(value, Mapping):
                yield from iter_option_names(value, f"{above}{key}.")


def validate_values(settings: Mapping[str, Any], like: Mapping[str, Any] | None = None, above: str = "") -> None:
    """Reject invalid option values.

    Args:
        settings: all settings.
        like: the same settings with default values; their types are used where a function has no annotation.
        above: dotted name of the node with these settings, with a trailing dot.

    Raises:
        ValueError: names the option, the value found and what was expected.
    """
    target = settings.get("_target_")
    hints = _load_hints(str(target)) if target else {}
    for key, value in settings.items():
        name = f"{above}{key}"
        if str(key).startswith("_") or key == "choices":
            continue
        default = (like or {}).get(key)
        if target:
            _check_value(name, value, hints.get(str(key), _hint_from_default(default)))
        elif name in _OPTION_RULES and not _OPTION_RULES[name][0](value):
            raise ValueError(f"{name}: found {_format_value(value)}, expected {_OPTION_RULES[name][1]}")
        if isinstance(value, float) and math.isnan(value):
            raise ValueError(f"{name}: found nan, expected a number")
        if isinstance(value, Mapping):
            validate_values(value, default if isinstance(default, Mapping) else None, f"{name}.")


def validate_choices(settings: Mapping[str, Any], choices_of: Mapping[str, Iterable[Any]]) -> None:
    """Reject values of options, by name, that are none of their choices.

    Raises:
        ValueError: names the option, the value found and the choices.
    """
    for name, choices in choices_of.items():
        if settings[name] not in choices:
            raise ValueError(f"{name}: found {settings[name]!r}, expected one of {', '.join(map(str, choices))}")


def _check_value(name: str, value: Any, hint: Any) -> None:
    """Check one value against its annotation and the lower limit of its name."""
    key = name.rpartition(".")[2]
    if not _matches_hint(value, hint):
        raise ValueError(f"{name}: found {_format_value(value)}, expected {_describe_hint(hint)}")
    low = 1 if key in _COUNT_NAMES else 0 if _NONNEGATIVE_NAMES.fullmatch(key) and key not in _SIGNED_NAMES else None
    low = None if name in _ZERO_OPTIONS else low
    for each in value if isinstance(value, list) else [value]:
        if low is not None and _is_number(each) and each < low:
            kind = "a whole number of at least 1" if low else "a number of at least 0"
            raise ValueError(f"{name}: found {_format_value(value)}, expected {kind}")


def _hint_from_default(default: Any) -> Any:
    """Annotation of an option from its default value; Any for a default of None."""
    if isinstance(default, list):
        return list[_hint_from_default(default[0])] | None if default else list | None  # type: ignore[misc]
    kind = next((k for k in (bool, int, float, str) if isinstance(default, k)), None)
    return Any if kind is None else kind | None


def _matches_hint(value: Any, hint: Any) -> bool:
    """Whether a plain value fits an annotation; annotations that cannot be checked fit."""
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
    """Whether the items of a list fit its annotation."""
    if origin is tuple and args and args[-1] is not Ellipsis:
        return len(values) == len(args) and all(map(_matches_hint, values, args))
    return all(_matches_hint(v, args[0]) for v in values) if args else True


def _describe_hint(hint: Any) -> str:
    """Text of an annotation, for an error message."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_describe_hint(each) for each in args))
    if origin is typing.Literal:
        return " or ".join(map(str, args))
    names = {type(None): "null", bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    if hint in names:
        return names[hint]
    if origin in _LIST_TYPES:
        items = [_describe_hint(a) for a in args if a is not Ellipsis]
        return f"a list of {' and '.join(items) or 'values'}"
    return "the settings of a function" if origin is collections.abc.Callable else "another value"


def _is_accepted(key: str, settings: Mapping[str, Any]) -> bool:
    """Whether the function of the node above an option has such a parameter."""
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
    """Annotations of a target's parameters; empty where they cannot be resolved."""
    try:
        function = _load_function(target)
        return typing.get_type_hints(function.__init__ if inspect.isclass(function) else function)
    except (ImportError, AttributeError, NameError, TypeError):
        return {}


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _format_value(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
