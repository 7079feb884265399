"""Codec of TFRecord files and their ``tf.train.Example`` messages, without TensorFlow.

A file is a sequence of records: length (8 bytes, little-endian), its checksum, the data, its checksum. Checksums are
CRC-32C (Castagnoli), *masked*: rotated right by 15 bits, plus a constant. A message is a protocol buffer:
``Example{1: Features{1: map<text, Feature>}}``, a feature being a list of bytes (1), floats (2) or integers (3).

Alphabet: a span is (offset, length) of bytes in the file.
"""

import os
import struct
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular, unreadable_error

_MAX_RECORDS = 10_000_000
_MAX_FIELDS = 2_000_000  # of one record: names, images, runs of numbers

_HEADER_BYTES = 12  # before a record's data: length and its checksum
_FOOTER_BYTES = 4  # after a record's data: its checksum
_CRC_POLYNOMIAL = 0x82F63B78  # bits reflected
_CRC_MASK = 0xA282EAD8
_CRC_BLOCK_BYTES = 512  # block whose checksum is computed in parallel with those of the other blocks
_CRC_BATCH_BYTES = 4 << 20  # bytes split into blocks at a time
_FEATURE_KINDS = {1: "bytes", 2: "float", 3: "int64"}


class ByteSpan(NamedTuple):
    """A span of bytes in a file."""

    offset: int
    length: int


class ExampleFeature(NamedTuple):
    """One feature of a record, undecoded: its type and spans of bytes."""

    kind: str  # "bytes", "float" or "int64"
    spans: tuple[ByteSpan, ...]  # bytes: one per value; numbers: one per packed run


def index_records(file: Path) -> list[ByteSpan]:
    """Spans of the records of a file; reads only their lengths and verifies the lengths' checksums.

    Raises:
        FormatError: unreadable, a wrong checksum, a file that ends inside a record, or no record.
    """
    spans: list[ByteSpan] = []
    try:
        with open_regular(file) as stream:
            total, at = os.fstat(stream.fileno()).st_size, 0
            while at < total:
                head = os.pread(stream.fileno(), _HEADER_BYTES, at)
                if len(head) < _HEADER_BYTES:
                    raise FormatError(file, f"record at byte {at}", f"{len(head)} bytes", "a TFRecord header of 12")
                length, stored = struct.unpack("<QI", head)
                if mask_crc(crc32c(head[:8])) != stored:
                    raise FormatError(file, f"record at byte {at}", "a wrong checksum of its length", "a TFRecord")
                if at + _HEADER_BYTES + length + _FOOTER_BYTES > total:
                    raise FormatError(file, f"record {len(spans)}", f"{total - at} bytes", f"{length} and 16 more")
                spans.append(ByteSpan(at + _HEADER_BYTES, length))
                at += _HEADER_BYTES + length + _FOOTER_BYTES
                if len(spans) > _MAX_RECORDS:
                    raise FormatError(file, "records", "more", f"at most {_MAX_RECORDS}")
    except OSError as error:
        raise unreadable_error(file, error) from None
    if not spans:
        raise FormatError(file, "records", "none", "at least one")
    return spans


def read_record(file: Path, span: ByteSpan) -> bytes:
    """The data of a record, whose checksum must match.

    Raises:
        FormatError: unreadable, too long, cut off, or a wrong checksum.
    """
    data = read_span(file, ByteSpan(span.offset, span.length + _FOOTER_BYTES))
    body, stored = data[: span.length], int.from_bytes(data[span.length :], "little")
    if mask_crc(crc32c(body)) != stored:
        actual = f"checksum {mask_crc(crc32c(body)):08x}"
        raise FormatError(file, f"record at byte {span.offset}", actual, f"{stored:08x}")
    return body


def read_span(file: Path, span: ByteSpan) -> bytes:
    """The bytes of one span of a file.

    Raises:
        FormatError: unreadable, too long, or cut off.
    """
    return read_spans(file, [span])[0]


def read_spans(file: Path, spans: Sequence[ByteSpan]) -> list[bytes]:
    """The bytes of several spans of a file, which is opened once.

    Raises:
        FormatError: as :func:`read_span`.
    """
    contents = []
    try:
        with open_regular(file) as stream:
            for offset, length in spans:
                if length > MAX_FILE_BYTES:
                    raise FormatError(file, f"record at byte {offset}", f"{length} bytes", f"at most {MAX_FILE_BYTES}")
                data = os.pread(stream.fileno(), length, offset)
                if len(data) != length:
                    raise FormatError(file, f"record at byte {offset}", f"{len(data)} bytes", f"{length} bytes")
                contents.append(data)
    except OSError as error:
        raise unreadable_error(file, error) from None
    return contents


def parse_example(body: bytes, file: Path, start: int) -> dict[str, ExampleFeature]:
    """Bytes of an ``Example`` → name → feature; spans are offsets in the file, where the message begins at ``start``.

    Raises:
        FormatError: not such a message.
    """
    return _Message(body, file, start).features()


def read_feature_numbers(file: Path, name: str, feature: ExampleFeature, most: int) -> np.ndarray:
    """The numbers of a feature: floats as float64, integers as int64.

    Raises:
        FormatError: a feature of bytes, or more than ``most`` numbers.
    """
    if feature.kind == "bytes":
        raise FormatError(file, name, "bytes", "numbers")
    size = sum(span.length for span in feature.spans)
    min_bytes = 4 if feature.kind == "float" else 1
    if size > min_bytes * most * (1 if min_bytes == 4 else 10):
        raise FormatError(file, name, f"{size} bytes of numbers", f"at most {most} numbers")
    if not feature.spans:
        return np.zeros(0)
    first, last = feature.spans[0].offset, feature.spans[-1].offset + feature.spans[-1].length
    data = read_span(file, ByteSpan(first, last - first))
    runs = [data[at - first : at - first + length] for at, length in feature.spans]
    if feature.kind == "float":
        data = b"".join(runs)
        if len(data) % 4:
            raise FormatError(file, name, f"{len(data)} bytes", "floats of 4 bytes")
        return np.frombuffer(data, "<f4").astype(np.float64)
    return np.concatenate([np.zeros(0, np.int64), *(_decode_varints(run, file, name) for run in runs)])


def mask_crc(crc: int) -> int:
    """The masked checksum, as stored in a file."""
    return (((crc >> 15) | (crc << 17)) + _CRC_MASK) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """CRC-32C of ``data``: checksums of many blocks in parallel, then combined, since the CRC is linear in its bits."""
    state = 0xFFFFFFFF
    table, (a, b, c, d) = _crc_tables()
    head = len(data) % _CRC_BLOCK_BYTES
    for byte in data[:head]:
        state = int(table[(state ^ byte) & 0xFF]) ^ (state >> 8)
    for at in range(head, len(data), _CRC_BATCH_BYTES // _CRC_BLOCK_BYTES * _CRC_BLOCK_BYTES):
        batch = np.frombuffer(
            data, np.uint8, min(_CRC_BATCH_BYTES // _CRC_BLOCK_BYTES * _CRC_BLOCK_BYTES, len(data) - at), at
        )
        columns = np.ascontiguousarray(batch.reshape(-1, _CRC_BLOCK_BYTES).T)
        sums = np.zeros(columns.shape[1], np.uint32)
        for column in columns:
            sums = table[(sums ^ column) & 0xFF] ^ (sums >> 8)
        for block in sums.tolist():
            state = a[state & 0xFF] ^ b[(state >> 8) & 0xFF] ^ c[(state >> 16) & 0xFF] ^ d[state >> 24] ^ block
    return state ^ 0xFFFFFFFF


@cache
def _crc_tables() -> tuple[np.ndarray, list[list[int]]]:
    """(256,) change of the state by one byte, and (4, 256) by a block of zeros for each byte of the state."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_CRC_POLYNOMIAL), table >> 1)
    shifts = (np.arange(256, dtype=np.uint32)[None] << (8 * np.arange(4, dtype=np.uint32))[:, None]).astype(np.uint32)
    for _ in range(_CRC_BLOCK_BYTES):
        shifts = table[shifts & 0xFF] ^ (shifts >> 8)
    return table, shifts.tolist()


class _Message:
    """Parser of a protocol buffer; at most ``_MAX_FIELDS`` fields, since one costs more memory than its bytes."""

    def __init__(self, body: bytes, file: Path, start: int) -> None:
        self.body, self.file, self.start = body, file, start
        self.left = _MAX_FIELDS

    def features(self) -> dict[str, ExampleFeature]:
        """Name → feature; of several with one name the last."""
        result: dict[str, ExampleFeature] = {}
        for _, features in self._inner((0, len(self.body)), 1):
            for _, entry in self._inner(features, 1):
                name, feature = "", None
                for number, span in self._inner(entry, 1, 2):
                    if number == 1:
                        try:
                            name = self.body[span[0] : sum(span)].decode()
                        except UnicodeDecodeError as error:
                            raise FormatError(self.file, "name of a feature", error.reason, "UTF-8") from None
                        continue
                    kind, inner = next(self._inner(span, *_FEATURE_KINDS), (0, span))
                    spans = (ByteSpan(self.start + at, size) for n, _, (at, size) in self._fields(inner) if n == 1)
                    feature = ExampleFeature(_FEATURE_KINDS[kind], tuple(spans)) if kind else None
                if feature is not None:
                    result[name] = feature
        return result

    def _inner(self, within: tuple[int, int], *numbers: int) -> Iterator[tuple[int, tuple[int, int]]]:
        """Length-delimited fields (bytes, strings, messages) with one of ``numbers``: (field number, span)."""
        return ((n, span) for n, wire, span in self._fields(within) if wire == 2 and n in numbers)

    def _fields(self, within: tuple[int, int]) -> Iterator[tuple[int, int, tuple[int, int]]]:
        """(field number, wire type, span) of each field of a message."""
        at, end = within[0], within[0] + within[1]
        while at < end:
            self.left -= 1
            if self.left < 0:
                raise FormatError(self.file, "message", "more fields", f"at most {_MAX_FIELDS} in a record")
            tag, at = self._varint(at, end)
            wire, size = tag & 7, 0
            if wire == 2:
                size, at = self._varint(at, end)
            elif wire == 0:
                size = self._varint(at, end)[1] - at
            elif wire in (1, 5):
                size = 8 if wire == 1 else 4
            else:
                raise FormatError(self.file, "message", f"wire type {wire}", "a tf.train.Example")
            if at + size > end:
                raise FormatError(self.file, "message", f"a field of {size} bytes in {end - at}", "a tf.train.Example")
            yield tag >> 3, wire, (at, size)
            at += size

    def _varint(self, at: int, end: int) -> tuple[int, int]:
        value = 0
        for shift in range(0, 70, 7):
            if at >= end:
                break
            byte, at = self.body[at], at + 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value, at
        raise FormatError(self.file, "message", f"an unterminated number at byte {at}", "a tf.train.Example")


def _decode_varints(run: bytes, file: Path, name: str) -> np.ndarray:
    """Packed 64-bit varints, two's complement → int64 array."""
    raw = np.frombuffer(run, np.uint8)
    ends = np.flatnonzero(raw < 0x80)
    if len(raw) and (not len(ends) or ends[-1] != len(raw) - 1):
        raise FormatError(file, name, "an unterminated integer", "packed integers")
    starts = np.concatenate([[0], ends[:-1] + 1]).astype(np.int64) if len(ends) else np.zeros(0, np.int64)
    if len(ends) and int((ends - starts).max()) >= 10:
        raise FormatError(file, name, "an integer of more than 10 bytes", "packed integers")
    place = (np.arange(len(raw)) - np.repeat(starts, np.diff(np.append(starts, len(raw))))).astype(np.uint64)
    parts = (raw & 0x7F).astype(np.uint64) << (np.uint64(7) * place)
    summed = np.bitwise_or.reduceat(parts, starts) if len(starts) else np.zeros(0, np.uint64)
    return summed.view(np.int64)
