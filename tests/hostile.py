"""Hostile input: damage a written capture in every way we can think of and read it in a child that may die.

``attack(write, read, tmp_path)`` lets ``write`` make one intact sample, then makes seeded mutants of it. Each one is
read in a forked child of this (warmed-up) process, under a limit of time and of memory, with no right to write. The
outcome of a mutant is ``"frames"`` (it read as valid data), ``"FormatError"`` (one line that names file and field) or a
failure: another exception, a crash, a hang, too much memory, a file touched outside the capture, code executed.

A sample is held as ``{relative path: bytes}``; a mutation is a function from one such capture to another, so a mutant is
known by its seed alone: ``attack(..., only=17)`` repeats mutant 17.
"""

from __future__ import annotations

import faulthandler
import io
import json
import os
import pickle
import random
import resource
import select
import shutil
import signal
import struct
import sys
import tarfile
import time
import traceback
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

from dhtorch import data
from dhtorch.data import FormatError, files

SECONDS = 2.0  # wall clock for one mutant
BYTES = 512 << 20  # resident, above the level before the call
FINE = ("frames", "FormatError")
_EXECUTED = 86  # exit code of a child that ran code out of a file

Capture = dict[str, bytes | None]  # None = a folder stands where the file was


class Outcome(NamedTuple):
    """What became of one mutant."""

    kind: str  # "frames", "FormatError", or the kind of failure
    detail: str
    seconds: float
    bytes: int  # peak resident memory above the level before the call


def read_frames(path: Path) -> None:
    """Open everything at ``path``, decode every frame and every truth, hold them against what they promise."""
    for recording in data.open_all(path):
        truth = getattr(recording, "truth", None)
        for i, frame in enumerate(recording):
            check_frame(frame)
            if truth is not None:
                depth = truth(i)["depth"]
                assert depth.shape[1:] == frame.hw
                assert bool(torch.isfinite(depth).all()) and bool((depth >= 0).all())


def check_frame(frame: Any) -> None:
    """Depth finite and not negative, cameras and pose usable, confidence 0, 1 or 2."""
    assert frame.image.ndim == 4 and frame.image.shape[1] in (1, 3) and frame.image.numel() > 0
    assert frame.image.dtype == torch.uint8 or bool(torch.isfinite(frame.image).all())
    assert bool(torch.isfinite(frame.depth).all()) and bool((frame.depth >= 0).all())
    for camera in (frame.camera, frame.depth_camera or frame.camera):
        assert bool((camera.f > 0).all()) and bool(torch.isfinite(torch.cat((camera.f, camera.c))).all())
        assert camera.distortion is None or bool(torch.isfinite(camera.distortion).all())
    if frame.conf is not None:
        assert frame.conf.dtype == torch.uint8 and int(frame.conf.max()) <= 2
    if frame.time is not None:
        assert bool(torch.isfinite(frame.time).all())
    if (T := frame.T_world_from_cam) is not None:
        assert bool(torch.isfinite(T.t).all())
        assert float((T.R @ T.R.mT - torch.eye(3).to(T.R)).abs().max()) < 1e-6 and bool(
            (torch.linalg.det(T.R) > 0).all()
        )


def attack(
    write: Callable[[Path], Path | None],
    read: Callable[[Path], Any],
    tmp_path: Path,
    *,
    mutants: int = 100,
    seed: int = 0,
    only: int | None = None,
) -> Counter[str]:
    """Mutants of one sample by outcome; fails the test unless each is ``"frames"`` or ``"FormatError"``.

    Args:
        write: makes a tiny sample below the folder it is given; returns what is to be opened (None = that folder).
        read: opens a capture and reads all of it; raises FormatError or returns. ``read_frames`` does for recordings.
        tmp_path: an empty folder. The capture is ``capture/`` in it; an intact copy, ``intact/``, is the bait of paths
            that lead out of the capture.
        mutants: how many.
        seed: of all choices.
        only: the one mutant to repeat.
    """
    counts, failures = Counter[str](), []
    with sample(write, read, tmp_path) as (good, outcome_of):
        for number in range(mutants) if only is None else (only,):
            what, want = mutate(good, random.Random(f"{seed}/{number}"))
            outcome = outcome_of(want)
            counts[outcome.kind] += 1
            if outcome.kind not in FINE:
                figures = f"after {outcome.seconds:.2f} s, {outcome.bytes / 2**20:.0f} MiB"
                failures.append(f"mutant {number} ({what}): {outcome.kind} {figures}: {outcome.detail}")
    assert not failures, f"{dict(counts)}\n" + "\n".join(failures[:5])
    return counts


@contextmanager
def sample(
    write: Callable[[Path], Path | None], read: Callable[[Path], Any], tmp_path: Path
) -> Iterator[tuple[Capture, Callable[[Capture], Outcome]]]:
    """Write an intact sample; gives it with a function that lays another capture in its place and reads that.

    Arguments as of :func:`attack`; for tests that draw their mutants otherwise, such as Hypothesis.
    """
    root = tmp_path / "capture"
    root.mkdir()
    path = write(root) or root
    shutil.copytree(root, tmp_path / "intact")
    good: Capture = {str(f.relative_to(root)): f.read_bytes() for f in sorted(root.rglob("*")) if f.is_file()}
    have = good

    def outcome_of(want: Capture) -> Outcome:
        nonlocal have
        _lay(root, have, want)
        have = want
        return run(read, path, tmp_path)

    files.set_opencv_threads(1)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a thread pool does not survive a fork
    try:
        read(path)  # warm up: what is imported late is not charged to a mutant; the intact sample must read
        yield good, outcome_of
    finally:
        torch.set_num_threads(threads)
        _lay(root, have, good)


# ------------------------------------------------------------------------------------------------- one mutant, one child


def run(read: Callable[[Path], Any], path: Path, tmp_path: Path) -> Outcome:
    """Read ``path`` in a forked child. A child that got no processor on a busy machine has a second try."""
    outcome, cpu = _run(read, path, tmp_path)
    return _run(read, path, tmp_path)[0] if outcome.kind == "hang" and cpu < SECONDS / 2 else outcome


def _run(read: Callable[[Path], Any], path: Path, tmp_path: Path) -> tuple[Outcome, float]:
    end, child_end = os.pipe()
    start = time.perf_counter()
    pid = os.fork()
    if pid == 0:
        os.close(end)
        _child(read, path, tmp_path, child_end)
    os.close(child_end)
    said, level, killed = b"", 0, ""
    while True:
        ready = select.select([end], [], [], 0.01)[0]
        if ready:
            chunk = os.read(end, 65536)
            if not chunk:
                break
            said += chunk
            level = level or int(said.split(b"\n")[0] if b"\n" in said else 0)
        if not killed and time.perf_counter() - start > SECONDS:
            killed = "hang"
            os.kill(pid, signal.SIGKILL)
        elif not killed and level and _resident(pid) - level > BYTES:
            killed = "memory"
            os.kill(pid, signal.SIGKILL)
    os.close(end)
    _, status, used = os.wait4(pid, 0)
    seconds = time.perf_counter() - start
    peak = max(used.ru_maxrss * 1024 - level, 0) if level else 0
    code = os.waitstatus_to_exitcode(status)
    _, _, rest = said.partition(b"\n")
    kind, _, detail = rest.decode(errors="replace").partition("\n")
    if killed or peak > BYTES:
        kind, detail = killed or "memory", ""
    elif code != 0:
        kind, detail = ("code executed" if code == _EXECUTED else "crash"), f"exit code {code} {kind} {detail[-2000:]}"
    return Outcome(kind, detail, seconds, peak), used.ru_utime + used.ru_stime


def _child(read: Callable[[Path], Any], path: Path, tmp_path: Path, report: int) -> None:
    """Never returns: writes the level of memory, the outcome and its detail, and exits."""
    kind, detail = "crash", ""
    try:
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115  (pytest's own would write to a file)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python turns it into an error that a reader might swallow
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(
            resource.RLIMIT_AS, (_virtual() + 8 * BYTES, -1)
        )  # the machine survives what the watch misses
        touched = _guard(tmp_path.resolve(), path)
        os.write(report, f"{_resident(os.getpid())}\n".encode())
        faulthandler.enable(report, all_threads=False)  # the last words of a crash
        try:
            read(path)
            kind = "frames"
        except FormatError as error:
            kind, detail = "FormatError", str(error)
            if "\n" in detail or len(error.args) != 4 or not error.args[1] or str(tmp_path) not in detail:
                kind = "a FormatError that does not name file and field"
        if touched:
            kind, detail = "escape", "; ".join(touched[:3])
    except BaseException as error:
        kind, detail = type(error).__name__, "".join(traceback.format_exception(error)[-5:])
    os.write(report, f"{kind}\n{detail}"[:4000].encode())
    os._exit(0)


def _guard(tmp_path: Path, path: Path) -> list[str]:
    """Note every file written, every file opened beside the capture, and every program started."""
    touched: list[str] = []
    inside = str(tmp_path / "capture")
    starts = ("os.system", "os.exec", "os.fork", "os.posix_spawn", "subprocess.Popen", "socket.connect", "os.kill")
    changes = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.chmod", "os.truncate")

    def hook(event: str, args: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(args[0], (str, bytes)):
            name = os.path.realpath(os.fsdecode(args[0]))
            writing = bool(args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) and name != os.devnull
            if writing or (name.startswith(str(tmp_path)) and not name.startswith(inside)):
                touched.append(f"{'wrote' if writing else 'opened'} {name}")
        elif event in starts or event in changes:
            touched.append(f"{event} {args[:1]}")

    sys.addaudithook(hook)
    return touched


def _resident(pid: int) -> int:
    """Bytes; 0 when the process is gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    except (OSError, IndexError):
        return 0


def _virtual() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _lay(root: Path, have: Capture, want: Capture) -> None:
    """Turn the files of one capture into those of another."""
    changed = [name for name in have.keys() | want.keys() if have.get(name, 0) is not want.get(name, 0)]
    for name in changed:
        file = root / name
        if file.is_dir():
            file.rmdir()
        else:
            file.unlink(missing_ok=True)
    for name in changed:
        file, content = root / name, want.get(name, b"")
        if name in want:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.mkdir() if content is None else file.write_bytes(content)


# ---------------------------------------------------------------------------------------------------------- mutations


def mutate(good: Capture, draw: random.Random) -> tuple[str, Capture]:
    """(what was done, the damaged capture): one file changed, now and then two, or files moved about."""
    want = dict(good)
    told = []
    for _ in range(1 if draw.random() < 0.85 else 2):
        if not any(content is not None for content in want.values()):
            break  # nothing left to damage
        if draw.random() < 0.12:
            told.append(_move(want, draw))
            continue
        name = _victim(want, draw)
        told.append(f"{name}: {_damage(want, name, draw)}")
    return "; ".join(told), want


def _victim(capture: Capture, draw: random.Random) -> str:
    """Kinds of file are equally likely, so that one table among a hundred pictures gets its share."""
    kinds: dict[str, list[str]] = {}
    for name, content in sorted(capture.items()):
        if content is not None:
            kinds.setdefault("".join(c for c in name if not c.isdigit()), []).append(name)
    return draw.choice(kinds[draw.choice(sorted(kinds))])


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
    special: list[Callable[[bytes, str, random.Random], bytes]] = []
    if content[:4] == b"\x89PNG":
        special = [_png]
    elif content[:2] == b"PK":
        special = [_zip]
    elif content[257:262] == b"ustar":
        special = [_tar]
    elif name.endswith((".json", ".pincam", ".txt", ".csv", ".traj", ".jsonl")) or _is_text(content):
        special = [_json, _json, _word] if content.lstrip()[:1] in (b"{", b"[") else [_word, _lines]
    way = draw.choice(special if special and draw.random() < 0.75 else _BYTES)
    capture[name] = way(content, name, draw)
    return way.__name__.strip("_")


def _is_text(content: bytes) -> bool:
    return all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in content[:256])


# bytes ------------------------------------------------------------------------------------------------------------


def _at(content: bytes, draw: random.Random) -> int:
    """Headers are hit as often as all the rest."""
    return draw.randrange(min(128, len(content)) if draw.random() < 0.5 else len(content))


def _flip(content: bytes, name: str, draw: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8, 64))):
        out[_at(content, draw)] ^= 1 << draw.randrange(8)
    return bytes(out)


def _truncate(content: bytes, name: str, draw: random.Random) -> bytes:
    return content[: _at(content, draw)]


def _insert(content: bytes, name: str, draw: random.Random) -> bytes:
    at = _at(content, draw)
    return content[:at] + draw.randbytes(draw.choice((1, 2, 4, 100))) + content[at:]


def _delete(content: bytes, name: str, draw: random.Random) -> bytes:
    at = _at(content, draw)
    return content[:at] + content[at + draw.choice((1, 2, 4, 100)) :]


def _duplicate(content: bytes, name: str, draw: random.Random) -> bytes:
    at, to = sorted((_at(content, draw), _at(content, draw)))
    return content[:to] + content[at:]


def _zero(content: bytes, name: str, draw: random.Random) -> bytes:
    at, size = _at(content, draw), draw.choice((1, 4, 64, 4096))
    return content[:at] + bytes([draw.choice((0, 0, 255))]) * len(content[at : at + size]) + content[at + size :]


def _integer(content: bytes, name: str, draw: random.Random) -> bytes:
    """An absurd number over an aligned field, in either byte order."""
    size = draw.choice((1, 2, 4, 8))
    at = _at(content, draw) // size * size
    value = draw.choice((0, 1, 2, 1 << (8 * size - 1), (1 << 8 * size) - 1, (1 << (8 * size - 1)) - 1, 1 << (4 * size)))
    return content[:at] + value.to_bytes(size, draw.choice(("little", "big"))) + content[at + size :]


def _pickled(content: bytes, name: str, draw: random.Random) -> bytes:
    """A pickle that ends the process when it is loaded, plain or as a numpy array of objects."""
    payload = pickle.dumps(_Bomb(), protocol=2)
    if draw.random() < 0.5:
        return payload
    head = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head) + 1) + head + b"\n" + payload


class _Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (_EXECUTED,)


_BYTES = (_flip, _flip, _truncate, _insert, _delete, _duplicate, _zero, _integer, _integer, _pickled)


# text -------------------------------------------------------------------------------------------------------------

_WORDS = [
    *("nan", "inf", "-inf", "-1", "0", "-0.0", "1e999", "1e300", "-1e300", "1e-300", "1e18", "-1e18", "1.5.2", "1,5"),
    *("9223372036854775808", "4294967296", "65536", "2147483647", "0x10", "true", "null", "None", "x", "é", "\x00"),
    *("../../../../etc/hostname", "/etc/hostname", ".", "..", "file:///etc/hostname"),
    *("", "9" * 400, "a" * 10_000, "\n", ";", ",", '"', "[", "}", "\\", f"__import__('os')._exit({_EXECUTED})"),
]


def _spans(text: str, draw: random.Random) -> tuple[int, int]:
    """A word: what stands between separators."""
    at = draw.randrange(len(text)) if text else 0
    low, high = at, at
    while low > 0 and text[low - 1] not in " \t\r\n,;=[]{}()\"'":
        low -= 1
    while high < len(text) and text[high] not in " \t\r\n,;=[]{}()\"'":
        high += 1
    return low, high


def _word(content: bytes, name: str, draw: random.Random) -> bytes:
    """A word replaced by something hostile; a file's name now and then by the way to the intact copy beside."""
    text = content.decode(errors="replace")
    low, high = _spans(text, draw)
    word = text[low:high]
    new = f"../intact/{word}" if "." in word and "/" in word and draw.random() < 0.5 else draw.choice(_WORDS)
    return (text[:low] + new + text[high:]).encode()


def _lines(content: bytes, name: str, draw: random.Random) -> bytes:
    """A line gone, twice, at another place, or cut: missing frames and time stamps out of order."""
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
    f"__import__('os')._exit({_EXECUTED})",
)


def _json(content: bytes, name: str, draw: random.Random) -> bytes:
    """A value of a JSON document (or of one line of it) replaced, removed, repeated, nested or renamed."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):
        lines = content.split(b"\n")
        i = draw.randrange(len(lines))
        try:
            json.loads(lines[i])
        except (ValueError, RecursionError):
            return _word(content, name, draw)
        lines[i] = _json(lines[i], name, draw)
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


def _png(content: bytes, name: str, draw: random.Random) -> bytes:
    """A chunk damaged and its check sum made good again, so that the decoder gets to see it."""
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
        body = draw.choice((_flip, _integer, _truncate, _duplicate))(body, name, draw)
    else:
        chunks.insert(
            draw.randrange(len(chunks)), (draw.choice((b"PLTE", b"tRNS", b"zTXt", b"IDAT", b"iCCP")), b"\xff" * 7)
        )
    chunks[i if chunks[i][0] == kind else i + 1] = (kind, body)
    framed = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return content[:8] + b"".join(framed)


def _zip(content: bytes, name: str, draw: random.Random) -> bytes:
    """A member damaged inside a sound archive, gone, twice, named out of the archive, or a bomb."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members: Capture = {info.filename: archive.read(info) for info in archive.infolist() if not info.is_dir()}
            method = archive.infolist()[0].compress_type if archive.infolist() else zipfile.ZIP_STORED
    except (zipfile.BadZipFile, ValueError, RuntimeError, zlib.error, OSError):
        return _flip(content, name, draw)
    if not members:
        return _flip(content, name, draw)
    bomb = _member(members, draw)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for member, body in members.items():
            archive.writestr(member, body or b"")
    return _with_bomb(out.getvalue(), bomb) if bomb else out.getvalue()


def _tar(content: bytes, name: str, draw: random.Random) -> bytes:
    """The same for a tar; also members that are links and devices."""
    try:
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            members: Capture = {m.name: archive.extractfile(m).read() for m in archive.getmembers() if m.isfile()}  # type: ignore[union-attr]
    except (tarfile.TarError, ValueError, EOFError, OSError):
        return _flip(content, name, draw)
    if not members:
        return _flip(content, name, draw)
    _member(members, draw)
    odd = draw.choice(sorted(members)) if members and draw.random() < 0.2 else None
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for member, given in members.items():
            info, body = tarfile.TarInfo(member), given or b""
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
    """Damage the members in place; the name of one to be blown up, if any."""
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


def _with_bomb(content: bytes, name: str) -> str | bytes:
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
