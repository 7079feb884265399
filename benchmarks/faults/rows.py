"""One planted change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One change that makes the code wrong."""

    module: str  # dotted, below dhtorch; the end of it is enough where that is unique
    function: str  # function, Class.method, or a name that the module assigns
    old: str  # text inside it, there once
    new: str
    equivalent: str = ""  # why it changes no answer, if it changes none


def faults(table: Mapping[str, Sequence[tuple[str, ...]]]) -> Iterator[Fault]:
    """Rows by module → faults."""
    for module, rows in table.items():
        yield from (Fault(module, *row) for row in rows)
