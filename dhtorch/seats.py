"""A method is a function with functions in its seats: how to change what sits there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from dhtorch.records import Estimate

Method = partial[Estimate]  # of dhtorch.pair.extend (or extend_window), with its seats and options

#: Search radius in a sparse depth map, px: the truth test reads sparse returns in 7×7 windows, so do the samples.
SPARSE_SEARCH_PX = 3


def refill(method: Method, func: Callable[..., Estimate] | None = None, **seats: Any) -> Method:
    """The method with some seats or options replaced; ``{seat: {option: value}}`` changes options of a seat.

    ``func`` replaces what joins the seats (``extend``).
    Nested partials are joined into one, so that ``.keywords`` always shows every seat.
    """
    merged = dict(method.keywords)
    for name, value in seats.items():
        merged[name] = refill(merged[name], **value) if isinstance(value, Mapping) else value
    return partial(func or method.func, *method.args, **merged)


def adapt(method: Method, recording: Any) -> Method:
    """The method with what this scene's data asks for: pyramid levels, a search in sparse depth."""
    seats: dict[str, Any] = {}
    if recording.levels is not None and "track" in method.keywords:
        seats["track"] = {"levels": recording.levels}
    if recording.sparse and "backproject" in method.keywords:
        seats["backproject"] = {"search_px": SPARSE_SEARCH_PX}
    return refill(method, **seats)


def n_views(method: Method) -> int:
    """How many further views a method looks at: 1, or its option ``views``."""
    return int(method.keywords.get("views", 1))
