"""Parser of Thrift's compact protocol, as far as Parquet uses it: structures → dicts field number → value."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

#: Limit of the nesting of structures and lists; a Parquet footer has nine levels.
_MAX_NESTING = 12


def parse_struct(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """(structure at ``at`` as dict field number → value, position of its end).

    Raises:
        ValueError, IndexError: damaged data.
    """
    fields: dict[int, Any] = {}
    number = 0
    while True:
        number, kind, at = _parse_field_header(data, at, number)
        if kind == 0:
            return fields, at
        fields[number], at = _parse_value(data, at, kind, depth)


def iter_list_structs(data: bytes, at: int, wanted: int) -> Iterator[dict[int, Any]]:
    """The structures in the list that is field ``wanted`` of the structure at ``at``, one by one.

    Raises:
        ValueError, IndexError: damaged data, or no such list.
    """
    number = 0
    while True:
        number, kind, at = _parse_field_header(data, at, number)
        if number == wanted and kind == 9:
            count, kind, at = _parse_list_header(data, at)
            if kind != 12:
                raise ValueError(f"a list of type {kind}")
            for _ in range(count):
                item, at = parse_struct(data, at, 1)
                yield item
            return
        if kind == 0:
            raise ValueError(f"no list in field {wanted}")
        _, at = _parse_value(data, at, kind, 0)


def _parse_field_header(data: bytes, at: int, number: int) -> tuple[int, int, int]:
    """(number, type, position of the value) of the next field; type 0 = end of the structure."""
    head = data[at]
    kind, step = head & 15, head >> 4
    if head == 0:
        return number, 0, at + 1
    if step:
        return number + step, kind, at + 1
    number, at = _parse_zigzag(data, at + 1)
    return number, kind, at


def _parse_value(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if depth > _MAX_NESTING:
        raise ValueError("structures nested too deep")
    if kind in (1, 2):  # true and false are encoded in the type
        return kind == 1, at
    if kind in (4, 5, 6):
        return _parse_zigzag(data, at)
    if kind in (3, 7):  # a byte, or a double, which is not needed
        return (data[at], at + 1) if kind == 3 else (None, at + 8)
    if kind == 8:
        length, at = _parse_varint(data, at)
        if length > len(data) - at:
            raise ValueError("a string beyond the end")
        return data[at : at + length], at + length
    if kind in (9, 10):
        return _parse_list(data, at, depth + 1)
    if kind == 12:
        return parse_struct(data, at, depth + 1)
    raise ValueError(f"a field of type {kind}")


def _parse_list(data: bytes, at: int, depth: int) -> tuple[list[Any], int]:
    count, kind, at = _parse_list_header(data, at)
    values = []
    for _ in range(count):
        if kind in (1, 2):  # in a list a boolean takes a byte
            item, at = data[at] == 1, at + 1
        else:
            item, at = _parse_value(data, at, kind, depth)
        values.append(item)
    return values, at


def _parse_list_header(data: bytes, at: int) -> tuple[int, int, int]:
    """(length, type, position of the first value) of a list."""
    count, kind = data[at] >> 4, data[at] & 15
    at += 1
    if count == 15:
        count, at = _parse_varint(data, at)
    if count > len(data) - at:  # every value takes at least a byte
        raise ValueError(f"a list of {count} values in {len(data) - at} bytes")
    return count, kind, at


def _parse_varint(data: bytes, at: int) -> tuple[int, int]:
    """(unsigned varint, position of its end)."""
    number = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
    raise ValueError("an unterminated number")


def _parse_zigzag(data: bytes, at: int) -> tuple[int, int]:
    """(signed zigzag varint, position of its end)."""
    number, at = _parse_varint(data, at)
    return (number >> 1) ^ -(number & 1), at
