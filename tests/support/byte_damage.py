"""Random damage of captures: changed bytes, text, archive members and files, as from a bad disk, download or attacker.

A capture is ``{relative path: bytes}``. Every choice is drawn from the given generator: a seed repeats a mutant.
"""

import io
import json
import os
import pickle
import random
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

EXECUTED = 86  # exit code of a process that ran code out of a file

#: Content of a file by name; None = a folder stands where the file was, a function makes what does.
Capture = dict[str, bytes | Callable[[Path], None] | None]


def _sparse(path: Path) -> None:
    """A file of 3 GiB that takes no place on the disk."""
    path.touch()
    os.truncate(path, 3 << 30)


#: What is no file of a capture, by name → a function that makes it.
STRANGE_FILES: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "socket": lambda path: os.mknod(path, stat.S_IFSOCK | 0o600),
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "3 GiB": _sparse,
}


def iter_strange(good: Capture) -> Iterator[tuple[str, Capture]]:
    """(description, capture) with each of ``STRANGE_FILES`` in the place of one file of each kind."""
    for name in {_kind(name): name for name in sorted(good)}.values():
        yield from ((f"{name}: {what}", good | {name: make}) for what, make in STRANGE_FILES.items())


def overwrite(file: Path, content: bytes) -> None:
    """Other content for a file whose inode and time of modification stay."""
    before = file.stat()
    for _ in range(100_000):  # until the file system's clock, which moves in steps, has another time of the change
        with file.open("r+b") as stream:
            stream.write(content)
            stream.truncate()
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
        if file.stat().st_ctime_ns != before.st_ctime_ns:
            return
    raise AssertionError(f"{file}: the time of the change stands still")


def change_middle(file: Path) -> None:
    """Change the byte in the middle of a file whose size, inode and time of modification stay."""
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    overwrite(file, bytes(content))


def mutate(good: Capture, draw: random.Random) -> tuple[str, Capture]:
    """(description, damaged capture): mostly one file changed, sometimes two, or files removed or exchanged."""
    want = dict(good)
    changes = []
    for _ in range(1 if draw.random() < 0.85 else 2):
        if not any(content is not None for content in want.values()):
            break  # nothing left to damage
        if draw.random() < 0.12:
            changes.append(_move(want, draw))
            continue
        name = _victim(want, draw)
        changes.append(f"{name}: {_damage(want, name, draw)}")
    return "; ".join(changes), want


def _victim(capture: Capture, draw: random.Random) -> str:
    """Name of a random file; kinds of file are equally likely, however many files of each there are."""
    kinds: dict[str, list[str]] = {}
    for name, content in sorted(capture.items()):
        if content is not None:
            kinds.setdefault(_kind(name), []).append(name)
    return draw.choice(kinds[draw.choice(sorted(kinds))])


def _kind(name: str) -> str:
    return "".join(c for c in name if not c.isdigit())


def _move(capture: Capture, draw: random.Random) -> str:
    """A file missing, empty, a folder, or in the place of another one."""
    name = _victim(capture, draw)
    way = draw.choice(("missing", "empty", "folder", "swapped", "replaced"))
    other = _victim(capture, draw)
    if way == "missing":
        del capture[name]
    elif way == "swapped":
        capture[name], capture[other] = capture[other], capture[name]
    else:
        capture[name] = {"empty": b"", "folder": None, "replaced": capture[other]}[way]
    return f"{name}: {way}" + (f" with {other}" if way in ("swapped", "replaced") else "")


def _damage(capture: Capture, name: str, draw: random.Random) -> str:
    content = capture[name]
    assert content is not None
    if not content:
        return "empty already"
    special: list[Callable[[bytes, random.Random], bytes]] = []
    if content[:4] == b"\x89PNG":
        special = [_png]
    elif content[:2] == b"PK":
        special = [_zip]
    elif content[257:262] == b"ustar":
        special = [_tar]
    elif name.endswith((".json", ".pincam", ".txt", ".csv", ".traj", ".jsonl")) or _is_text(content):
        special = [_json, _json, _word] if content.lstrip()[:1] in (b"{", b"[") else [_word, _lines]
    way = draw.choice(special if special and draw.random() < 0.75 else _BYTES)
    capture[name] = way(content, draw)
    return way.__name__.strip("_")


def _is_text(content: bytes) -> bool:
    return all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in content[:256])


# bytes ------------------------------------------------------------------------------------------------------------


def _at(content: bytes, draw: random.Random) -> int:
    """A random position; the first 128 bytes are as likely as all others together."""
    return draw.randrange(min(128, len(content)) if draw.random() < 0.5 else len(content))


def _flip(content: bytes, draw: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8, 64))):
        out[_at(content, draw)] ^= 1 << draw.randrange(8)
    return bytes(out)


def _truncate(content: bytes, draw: random.Random) -> bytes:
    return content[: _at(content, draw)]


def _insert(content: bytes, draw: random.Random) -> bytes:
    at = _at(content, draw)
    return content[:at] + draw.randbytes(draw.choice((1, 2, 4, 100))) + content[at:]


def _delete(content: bytes, draw: random.Random) -> bytes:
    at = _at(content, draw)
    return content[:at] + content[at + draw.choice((1, 2, 4, 100)) :]


def _duplicate(content: bytes, draw: random.Random) -> bytes:
    at, to = sorted((_at(content, draw), _at(content, draw)))
    return content[:to] + content[at:]


def _zero(content: bytes, draw: random.Random) -> bytes:
    at, size = _at(content, draw), draw.choice((1, 4, 64, 4096))
    return content[:at] + bytes([draw.choice((0, 0, 255))]) * len(content[at : at + size]) + content[at + size :]


def _integer(content: bytes, draw: random.Random) -> bytes:
    """An absurd number over an aligned field, in either byte order."""
    size = draw.choice((1, 2, 4, 8))
    at = _at(content, draw) // size * size
    value = draw.choice((0, 1, 2, 1 << (8 * size - 1), (1 << 8 * size) - 1, (1 << (8 * size - 1)) - 1, 1 << (4 * size)))
    return content[:at] + value.to_bytes(size, draw.choice(("little", "big"))) + content[at + size :]


def _pickled(content: bytes, draw: random.Random) -> bytes:
    """A pickle that ends the process when it is loaded, plain or as a numpy array of objects."""
    payload = pickle.dumps(_Bomb(), protocol=2)
    if draw.random() < 0.5:
        return payload
    head = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head) + 1) + head + b"\n" + payload


class _Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (EXECUTED,)


_BYTES = (_flip, _flip, _truncate, _insert, _delete, _duplicate, _zero, _integer, _integer, _pickled)


# text -------------------------------------------------------------------------------------------------------------

_WORDS = [
    *("nan", "inf", "-inf", "-1", "0", "-0.0", "1e999", "1e300", "-1e300", "1e-300", "1e18", "-1e18", "1.5.2", "1,5"),
    *("9223372036854775808", "4294967296", "65536", "2147483647", "0x10", "true", "null", "None", "x", "é", "\x00"),
    *("../../../../etc/hostname", "/etc/hostname", ".", "..", "file:///etc/hostname"),
    *("", "9" * 400, "a" * 10_000, "\n", ";", ",", '"', "[", "}", "\\", f"__import__('os')._exit({EXECUTED})"),
]


def _word(content: bytes, draw: random.Random) -> bytes:
    """A word replaced by a hostile one; a file name sometimes by the path of the intact copy."""
    text = content.decode(errors="replace")
    at = draw.randrange(len(text)) if text else 0
    separators = [k for k, letter in enumerate(text) if letter in " \t\r\n,;=[]{}()\"'"]
    low = max((k + 1 for k in separators if k < at), default=0)
    high = min((k for k in separators if k >= at), default=len(text))
    word = text[low:high]
    new = f"../intact/{word}" if "." in word and "/" in word and draw.random() < 0.5 else draw.choice(_WORDS)
    return (text[:low] + new + text[high:]).encode()


def _lines(content: bytes, draw: random.Random) -> bytes:
    """A line removed, repeated, moved or cut: missing frames and time stamps out of order."""
    lines = content.split(b"\n")
    i, j = draw.randrange(len(lines)), draw.randrange(len(lines))
    way = draw.randrange(5)
    if way == 0:
        del lines[i]
    elif way == 1:
        lines.insert(j, lines[i])
    elif way == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif way == 3:
        lines[i] = lines[i][: draw.randrange(len(lines[i]) + 1)]
    else:
        lines = lines[:i]
    return b"\n".join(lines)


_VALUES: tuple[Any, ...] = (
    *(None, True, "", "x", [], {}, 0, -1, 1, 2.5, 1e300, -1e300, 1e-300, float("nan"), float("inf"), -float("inf")),
    *(2**31, 2**63, 2**64, 10**400, "nan", "1e999", "../../../../etc/hostname", "/etc/hostname", "\x00", "a" * 10_000),
    *([[[[]]]], [0] * 3, [0.0] * 9, [0.0] * 16, [float("nan")] * 9, [1] * 10_000, {"a": 1}, [None], ["x"]),
    f"__import__('os')._exit({EXECUTED})",
)


def _json(content: bytes, draw: random.Random) -> bytes:
    """A value of a JSON document (or of one line of it) replaced, removed, repeated, nested or renamed."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):
        lines = content.split(b"\n")
        i = draw.randrange(len(lines))
        try:
            json.loads(lines[i])
        except (ValueError, RecursionError):
            return _word(content, draw)
        lines[i] = _json(lines[i], draw)
        return b"\n".join(lines)
    holder: Any = {"": value}
    where: Any = ""
    while isinstance(holder[where], (dict, list)) and holder[where] and (where == "" or draw.random() < 0.8):
        holder = holder[where]
        where = draw.choice(sorted(holder)) if isinstance(holder, dict) else draw.randrange(len(holder))
    way = draw.random()
    old = holder[where]
    if way < 0.6:
        holder[where] = draw.choice(_VALUES)
        if isinstance(old, str) and "." in old and draw.random() < 0.5:
            holder[where] = f"../intact/{old}"
    elif way < 0.75:
        del holder[where]
    elif way < 0.85 and isinstance(holder, list):
        holder.insert(draw.randrange(len(holder) + 1), old)
    elif way < 0.95:
        holder[where] = draw.choice(([old], {"x": old}, str(old), [old, old]))
    else:
        return b"[" * 100_000 + content
    return json.dumps(value).encode()


# containers -------------------------------------------------------------------------------------------------------


def _png(content: bytes, draw: random.Random) -> bytes:
    """A chunk damaged and its check sum corrected, so that the decoder reads it."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    i = draw.randrange(len(chunks))
    kind, body = chunks[i]
    way = draw.randrange(4)
    if kind == b"IDAT" and way == 0:
        body = zlib.compress(draw.choice((b"", b"\x09" * 100, bytes(1_000_000))))
    elif body and way < 3:
        body = draw.choice((_flip, _integer, _truncate, _duplicate))(body, draw)
    else:
        chunks.insert(
            draw.randrange(len(chunks)), (draw.choice((b"PLTE", b"tRNS", b"zTXt", b"IDAT", b"iCCP")), b"\xff" * 7)
        )
    chunks[i if chunks[i][0] == kind else i + 1] = (kind, body)
    framed = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return content[:8] + b"".join(framed)


def _zip(content: bytes, draw: random.Random) -> bytes:
    """A member of a valid archive damaged, removed, repeated, named outside the archive, or a decompression bomb."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members: Capture = {info.filename: archive.read(info) for info in archive.infolist() if not info.is_dir()}
            method = archive.infolist()[0].compress_type if archive.infolist() else zipfile.ZIP_STORED
    except (zipfile.BadZipFile, ValueError, RuntimeError, zlib.error, OSError):
        return _flip(content, draw)
    if not members:
        return _flip(content, draw)
    bomb = _member(members, draw)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for member, body in members.items():
            archive.writestr(member, body or b"")
    return with_bomb(out.getvalue(), bomb) if bomb else out.getvalue()


def _tar(content: bytes, draw: random.Random) -> bytes:
    """The same damage in a tar archive; also members that are links and devices."""
    try:
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            members: Capture = {m.name: archive.extractfile(m).read() for m in archive.getmembers() if m.isfile()}  # type: ignore[union-attr]
    except (tarfile.TarError, ValueError, EOFError, OSError):
        return _flip(content, draw)
    if not members:
        return _flip(content, draw)
    _member(members, draw)
    odd = draw.choice(sorted(members)) if members and draw.random() < 0.2 else None
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for member, content in members.items():
            info, body = tarfile.TarInfo(member), content or b""
            info.size = len(body)
            if member == odd:
                info.type, info.size = (
                    draw.choice((tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE)),
                    0,
                )
                info.linkname = "../../intact"
            archive.addfile(info, io.BytesIO(body if info.size else b""))
    return out.getvalue()


def _member(members: Capture, draw: random.Random) -> str | None:
    """Damages the members in place; returns the name of one to become a bomb, or None."""
    name = _victim(members, draw)
    way = draw.random()
    if way < 0.75:
        _damage(members, name, draw)
    elif way < 0.85:
        _move(members, draw)
    elif way < 0.92:
        members[f"../../{name}"] = members.pop(name)
    else:
        return name
    return None


def with_bomb(content: bytes, name: str) -> str | bytes:
    """The archive with member ``name`` replaced by a gigabyte of zeros, deflated."""
    packed, crc, size = _bomb()
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for info in old.infolist():
            archive.writestr(info.filename, packed if info.filename == name else old.read(info))
    raw = bytearray(out.getvalue())
    with zipfile.ZipFile(io.BytesIO(bytes(raw))) as archive:
        info, directory = archive.getinfo(name), archive.start_dir
    entry = raw.index(b"PK\x01\x02", directory)
    while raw[entry + 46 : entry + 46 + len(name.encode())] != name.encode():
        entry = raw.index(b"PK\x01\x02", entry + 4)
    for at in (info.header_offset + 8, entry + 10):  # method, time, date, crc, packed size, size
        raw[at : at + 2] = struct.pack("<H", zipfile.ZIP_DEFLATED)
        raw[at + 6 : at + 10] = struct.pack("<I", crc)
        raw[at + 14 : at + 18] = struct.pack("<I", size)
    return bytes(raw)


@cache
def _bomb() -> tuple[bytes, int, int]:
    """(deflated bytes, crc, size) of a gigabyte of zeros."""
    block, blocks = bytes(1 << 24), 64
    squeeze = zlib.compressobj(1, zlib.DEFLATED, -15)
    one = squeeze.compress(block) + squeeze.flush(zlib.Z_FULL_FLUSH)
    crc = 0
    for _ in range(blocks):
        crc = zlib.crc32(block, crc)
    return one * blocks + zlib.compressobj(1, zlib.DEFLATED, -15).flush(), crc, len(block) * blocks
