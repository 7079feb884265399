"""Damages a written capture in many ways and reads every mutant in a child process, with limits and without writing.

``attack(write, read, tmp_path)`` lets ``write`` make one intact sample, then makes seeded mutants of it. Each one is
read in a forked child of this (warmed-up) process, under a limit of time and of memory, with no right to write. The
outcome of a mutant is ``"frames"`` (it read as valid data), ``"FormatError"`` (one line that names file and field) or a
failure: another exception, a crash, a hang, too much work or memory, too many bytes read, a file touched outside the
capture, code executed.

The damage is that of ``byte_damage``; the number of a mutant determines it: ``attack(..., only=17)`` repeats mutant 17.
"""

import contextlib
import faulthandler
import io
import os
import random
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch

from dhtorch import data
from dhtorch.cli import run as commands
from dhtorch.data import FormatError
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks
from support.byte_damage import EXECUTED, Capture, mutate

SECONDS = 2  # of a processor for one mutant, whatever else the machine does
PATIENCE = 60.0  # wall clock after which it hangs
BYTES = 512 << 20  # resident, above the level before the call
READ_BYTES = 64 << 20  # read from files, many times the size of a sample
FINE = ("frames", "FormatError")


class Outcome(NamedTuple):
    """The outcome of reading one mutant."""

    kind: str  # "frames", "FormatError", or the kind of failure
    detail: str
    seconds: float
    bytes: int  # peak resident memory above the level before the call


def read_all(path: Path) -> None:
    """Opens everything at ``path``, decodes every frame, truth and stack, and checks them."""
    for recording in _opened(path):
        truth = getattr(recording, "truth", None)
        for i, each in enumerate(recording):
            if isinstance(each, FocalStack):
                check_stack(each)
                continue
            check_frame(each)
            if truth is not None:
                depth = truth(i)["depth"]
                assert depth.shape[1:] == each.hw
                assert bool(torch.isfinite(depth).all()) and bool((depth >= 0).all())


def _opened(path: Path) -> Sequence[Recording] | list[FocalStacks]:
    try:
        data.recognise(path)
    except FormatError:
        return [formats.open_stacks(path)]
    return data.open_all(path)


def check_stack(stack: FocalStack) -> None:
    """Pictures in range, depth finite and not negative."""
    assert stack.images.ndim == 5 and stack.images.shape[2] in (1, 3)
    assert stack.images.dtype == torch.uint8 or 0 <= float(stack.images.min()) <= float(stack.images.max()) <= 1
    if stack.depth is not None:
        assert stack.depth.shape[1:] == stack.hw
        assert bool(torch.isfinite(stack.depth).all()) and bool((stack.depth >= 0).all())


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
        read: opens a capture and reads all of it; raises FormatError or returns. ``read_all`` does for recordings.
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
    """Writes an intact sample; yields it and a function that replaces it by another capture and reads that.

    Arguments as of :func:`attack`; for those that draw their mutants otherwise.
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


def run_command(words: Sequence[str], path: Path, tmp_path: Path) -> Outcome:
    """Run ``dhtorch`` in a forked child, which may write; FormatError where it ends with one sentence and exit code 2."""

    def read(path: Path) -> None:
        with contextlib.redirect_stderr(io.StringIO()) as stream:
            code = commands.main([*words])
        lines = [line for line in stream.getvalue().splitlines() if line.startswith("dhtorch: ") or code not in (0, 2)]
        if code == 2 and len(lines) == 1:
            raise FormatError(path, "command", lines[0], "another path")
        assert code == 0, f"exit code {code}: {lines}"

    return run(read, path, tmp_path, may_write=True)


def run(read: Callable[[Path], Any], path: Path, tmp_path: Path, *, may_write: bool = False) -> Outcome:
    """Read ``path`` in a forked child, which may use a processor for ``SECONDS``."""
    end, child_end = os.pipe()
    start = time.perf_counter()
    pid = os.fork()
    if pid == 0:
        os.close(end)
        _child(read, path, tmp_path, child_end, may_write)
    os.close(child_end)
    output, level, killed = b"", 0, ""
    while True:
        ready = select.select([end], [], [], 0.01)[0]
        if ready:
            chunk = os.read(end, 65536)
            if not chunk:
                break
            output += chunk
            level = level or int(output.split(b"\n")[0] if b"\n" in output else 0)
        if not killed and time.perf_counter() - start > PATIENCE:
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
    _, _, rest = output.partition(b"\n")
    kind, _, detail = rest.decode(errors="replace").partition("\n")
    if killed or peak > BYTES:
        kind, detail = killed or "memory", ""
    elif code == -signal.SIGXCPU:
        kind, detail = "busy", detail[-2000:]
    elif code != 0:
        kind, detail = ("code executed" if code == EXECUTED else "crash"), f"exit code {code} {kind} {detail[-2000:]}"
    return Outcome(kind, detail, seconds, peak)


def _child(read: Callable[[Path], Any], path: Path, tmp_path: Path, report: int, may_write: bool) -> None:
    """Never returns: writes the level of memory, the outcome and its detail, and exits."""
    kind, detail = "crash", ""
    try:
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115  (pytest's own would write to a file)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python turns it into an error that a reader might swallow
        if not may_write:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))
        resource.setrlimit(
            resource.RLIMIT_AS, (_virtual() + 8 * BYTES, -1)
        )  # the machine survives what the watch misses
        touched, start = [] if may_write else _guard(tmp_path.resolve(), path), bytes_read()
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
        elif (size := bytes_read() - start) > READ_BYTES:
            kind, detail = "flood", f"{size} bytes read: {detail}"
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


def bytes_read() -> int:
    """Bytes that this process has read so far."""
    return int(Path("/proc/self/io").read_text().split()[1])


def _virtual() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _lay(root: Path, have: Capture, want: Capture) -> None:
    """Turn the files of one capture into those of another."""
    changed = [name for name in have.keys() | want.keys() if have.get(name, 0) is not want.get(name, 0)]
    for name in changed:
        file = root / name
        if file.is_dir() and not file.is_symlink():
            file.rmdir()
        else:
            file.unlink(missing_ok=True)
    for name in changed:
        file, content = root / name, want.get(name, b"")
        if name in want:
            file.parent.mkdir(parents=True, exist_ok=True)
            make = Path.mkdir if content is None else content
            make(file) if callable(make) else file.write_bytes(make)
