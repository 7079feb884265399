"""Finding, checking and loading the compiled kernels of ``csrc``: optional, as every operator has a torch reference.

    pip install dhtorch             a wheel for this platform holds them, and they are in use
    python -m dhtorch.ops           compile them into the user's cache, with the system's C++ compiler
    DHTORCH_OPS=0 python …          use torch alone; DHTORCH_OPS=1: an error where they cannot be loaded

Which functions have a kernel, and for which tensors it runs: :mod:`dhtorch.ops.dispatch`. Agreement with the torch
reference, which the tests check (``tests/ops/test_compiled.py``):

- bit for bit: pixels of samples, flags and classes of holes, depth in metres, tokens, the sensor's map, census costs,
  their best surface;
- up to one rounding of a value: pyramids, sigma, statistics of windows around samples, where textures carry the
  rounding of their sums;
- up to the rounding of sums over a window, of the search for points and the registration of windows: half of the
  positions are equal or within 1e-4 px, 99 of 100 within a tenth of their sigma, at most one validity in 200 differs;
- poses: 99 of 100 within a hundredth of their sigma; fitted surfaces and filled planes: 99 of 100 depths within a tenth
  of their sigma, at most one gate in 200 differs.

A library is one file of one vector level (:data:`LEVELS`), chosen by the level that torch itself uses, and works with
any torch that has the stable ABI. Its name has a hash of its sources and its manifest (``.json``) the file's checksum:
a file of other sources, a changed one, or one that other users may write is not loaded; torch computes instead, and
one warning says why.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import stat
import sys
import time
import warnings
from pathlib import Path

import torch

from dhtorch import codes
from dhtorch.ops import constants

#: The command that compiles the library.
COMMAND = "python -m dhtorch.ops"

#: Lowest and highest time of torch as a multiple of that of the compiled operators, one thread. Source: a pair of
#: ``paper`` and ``map`` and a reference view of ``auto`` in benchmarks/results/pair.json and pair_avx2.json (``python
#: benchmarks/pair.py``), 2.9 to 7.8; a map of every pixel in dense_speed.json and dense_speed_avx2.json (``python
#: benchmarks/dense.py``), 5.5 to 8.9.
TIMES_SLOWER = (3, 9)

#: What follows the word torch where no library is there.
_ADVICE = (
    f"{TIMES_SLOWER[0]} to {TIMES_SLOWER[1]} times slower on the CPU than compiled ones; "
    f"to compile them: {COMMAND} (needs a C++ compiler)"
)

#: Environment variable: 0 leaves the library unused, 1 makes it an error if it cannot be loaded.
SWITCH = "DHTORCH_OPS"

#: Lowest torch version whose stable ABI has what the sources use.
MIN_TORCH_VERSION = (2, 10)

#: Folder of the C++ sources.
FOLDER = Path(__file__).with_name("csrc")

#: Folder of the libraries that a wheel brings.
INSTALLED = Path(__file__).with_name("lib")

#: C++ sources of the library.
SOURCES = tuple(
    FOLDER / f"{part}.cpp"
    for part in (
        *("sweep", "search", "affine", "pyramid", "fit", "windows"),
        *("tokens", "pose", "tracks", "lens", "linear", "parallax", "filters", "planes"),
    )
)

#: Header that all sources include.
HEADER = FOLDER / "vectors.h"

#: Code tables whose values are in the generated header, as ``<table>_<name>``.
_CODE_TABLES = (codes.Flag, codes.Gate, codes.Hole, codes.Source, codes.PoseCode)

#: No FMA contraction: torch rounds the product and the sum. ``-fno-math-errno -fno-trapping-math`` let square roots and
#: selections be vectorised; results are unchanged.
FLAGS = ("-O3", "-std=c++20", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")

#: Vector level of x86-64 that torch reports (``torch.backends.cpu.get_cpu_capability``) → compiler's name of the level;
#: SSE4.2 for the processors below AVX2.
LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3", "DEFAULT": "x86-64-v2"}

#: Time in which a build replaces a library and its manifest, s. Source: derived, two renames take below 1 ms; longer
#: where the machine is busy.
_REPLACEMENT_S = 0.2

_X86_64 = ("x86_64", "amd64")

_loaded: list[Path] = []
_tried: list[bool] = []


def cache() -> Path:
    """Folder of compiled libraries: DHTORCH_CACHE, else ``dhtorch`` in the user's cache folder."""
    folder = os.environ.get("DHTORCH_CACHE")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dhtorch"


def levels() -> tuple[str, ...]:
    """Vector levels for which a library can be compiled on this machine; one, without a flag, other than on x86-64."""
    return tuple(LEVELS.values()) if platform.machine().lower() in _X86_64 else (platform.machine().lower(),)


def level() -> str:
    """The vector level that torch uses in this process, which ATEN_CPU_CAPABILITY may restrict."""
    if platform.machine().lower() not in _X86_64:
        return levels()[0]
    return LEVELS.get(torch.backends.cpu.get_cpu_capability(), LEVELS["DEFAULT"])


def file_name(for_level: str) -> str:
    """Name of the library of a level: with a hash of all that decides its content, but the compiler."""
    sources = (source.read_text(encoding="utf-8") for source in (HEADER, *SOURCES))
    key = "\n".join((*sources, constants_header(), sys.platform, platform.machine(), *FLAGS))
    return f"dhtorch-{hashlib.sha256(key.encode()).hexdigest()[:16]}-{for_level}.so"


def library() -> Path:
    """Path in the cache of the library for these sources and this processor, whether or not it exists."""
    return cache() / file_name(level())


def constants_header() -> str:
    """C++ header with the values of the code tables and of :mod:`dhtorch.ops.constants`."""
    lines = ["// Generated from dhtorch/codes.py and dhtorch/ops/constants.py.", "#pragma once", "#include <cstdint>"]
    lines.append("namespace {")
    for table in _CODE_TABLES:
        values = ((f"{table.__name__.upper()}_{name}", code) for code, name in codes.names(table).items())
        lines += [f"[[maybe_unused]] constexpr int32_t {name} = {code};" for name, code in values]
    for name, value in vars(constants).items():
        if name.isupper() and isinstance(value, int):
            lines.append(f"[[maybe_unused]] constexpr int64_t {name} = {value};")
        elif name.isupper():
            numbers = ", ".join(map(str, value))
            lines.append(f"[[maybe_unused]] constexpr int32_t {name}[] = {{{numbers}}};")
    return "\n".join((*lines, "}  // namespace", ""))


def manifest(path: Path) -> Path:
    """The file beside a library that holds its checksum."""
    return path.with_name(f"{path.name}.json")


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def problem(path: Path) -> str | None:
    """Why an existing library must not be loaded; None = it may be.

    Checked are the checksum in its manifest, and that no other user may write the file or its folder; a library of the
    cache must also belong to this user or to the administrator.
    """
    for each in (path, path.parent):
        status = each.stat()
        if status.st_mode & stat.S_IWOTH:
            return f"{each} may be written by other users"
        if path.parent != INSTALLED and status.st_uid not in (0, _user(status.st_uid)):
            return f"{each} belongs to another user"
    try:
        expected = json.loads(manifest(path).read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return f"{manifest(path)} does not hold its checksum"
    return None if checksum(path) == expected else f"{path} differs from its checksum"


def _problem_after_replacement(path: Path) -> str | None:
    """As :func:`problem`, asked again after a moment where a build may be replacing the file and its manifest."""
    reason = problem(path)
    if reason is None:
        return None
    time.sleep(_REPLACEMENT_S)
    return problem(path)


def _user(otherwise: int) -> int:
    """This process's user; ``otherwise`` on systems without user numbers."""
    return int(getattr(os, "getuid", lambda: otherwise)())


def load() -> None:
    """Load the compiled library, which operators of this process then use.

    Raises:
        FileNotFoundError: no library for these sources and this processor is installed or in the cache.
        OSError: torch older than :data:`MIN_TORCH_VERSION`; a library that must not or cannot be loaded.
    """
    if _loaded:
        return
    check_torch_version()
    name, reasons = file_name(level()), []
    for path in (INSTALLED / name, cache() / name):
        if not path.is_file():
            continue
        reason = _problem_after_replacement(path)
        if reason is None:
            try:
                torch.ops.load_library(str(path.resolve()))
            except OSError as error:  # of another machine, or without libraries that it needs
                reason = f"{path}: {str(error).splitlines()[0]}"
        if reason is None:
            _loaded.append(path)
            return
        reasons.append(reason)
    if reasons:
        raise OSError(f"compiled operators: {'; '.join(reasons)}; compile them again with {COMMAND}")
    others = sorted(each.name for each in INSTALLED.glob("dhtorch-*.so"))
    stale = f"; {INSTALLED} holds {others[0]}, of other sources or another processor" if others else ""
    raise FileNotFoundError(
        f"{cache() / name}: no library for these sources and this processor{stale}; compile it with {COMMAND}"
    )


def load_if_present() -> bool:
    """Load the library at the first call if there is one, as DHTORCH_OPS says -> whether it is loaded.

    A library that is there and must not be loaded is left with one warning. Where there is none, the warning is an
    ImportWarning: Python ignores these, so that only the commands, which enable them, print it.

    Raises:
        OSError: as :func:`load`, with DHTORCH_OPS=1.
    """
    switch = os.environ.get(SWITCH, "")
    if switch == "0" or (not switch and _tried):
        return False
    try:
        load()
    except FileNotFoundError as error:
        if switch:
            raise
        if "other sources" in str(error):
            warnings.warn(f"{error} (torch is used)", stacklevel=2)
        else:
            warnings.warn(f"operators: torch, {_ADVICE}", ImportWarning, stacklevel=2)
    except OSError as error:
        if switch:
            raise
        if _is_recent():
            warnings.warn(f"{error} (torch is used)", stacklevel=2)
    _tried.append(True)
    return is_loaded()


def is_loaded() -> bool:
    """Whether the library is loaded in this process."""
    return bool(_loaded)


def describe_operators(*, advice: bool = False) -> str:
    """What computes the operators of this process: ``compiled x86-64-v4``, or ``torch``.

    ``advice`` adds to ``torch`` that DHTORCH_OPS=0 chose it, else how much slower it is and how to compile the library.
    """
    if _loaded or load_if_present():
        return f"compiled {level()}"
    reason = f" ({SWITCH}=0)" if os.environ.get(SWITCH) == "0" else f", {_ADVICE}"
    return f"torch{reason}" if advice else "torch"


def check_torch_version() -> None:
    """Raise an OSError for a torch without the stable ABI."""
    if not _is_recent():
        expected = ".".join(map(str, MIN_TORCH_VERSION))
        raise OSError(f"compiled operators: found torch {torch.__version__}, expected at least {expected}")


def _is_recent() -> bool:
    return tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2]) >= MIN_TORCH_VERSION
