"""Finding, checking and loading the compiled kernels of ``csrc``; ``python -m dhtorch.ops --help`` describes them."""

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

from dhtorch.ops.constants import constants_header

COMMAND = "python -m dhtorch.ops"  # compiles the library
#: Lowest and highest time of torch as a multiple of that of the compiled operators, one thread. Source: whole calls in
#: benchmarks/results, pair.json and pair_avx2.json 2.9 to 7.8, dense_speed.json and dense_speed_avx2.json 5.5 to 8.9.
TIMES_SLOWER = (3, 9)
_SLOWER = f"{TIMES_SLOWER[0]} to {TIMES_SLOWER[1]} times slower on the CPU than compiled ones"
_ADVICE = f"{_SLOWER}; to compile them: {COMMAND} (needs a C++ compiler)"
SWITCH = "DHTORCH_OPS"  # variable: 0 leaves the library unused, 1 makes it an error if it cannot be loaded
MIN_TORCH_VERSION = (2, 10)  # whose stable ABI has what the sources use
INSTALLED = Path(__file__).with_name("lib")  # libraries that a wheel brings
_FOLDER = Path(__file__).with_name("csrc")
_PARTS = "sweep search affine pyramid fit windows tokens pose tracks lens linear parallax filters planes"
SOURCES = tuple(_FOLDER / f"{part}.cpp" for part in _PARTS.split())
#: No FMA contraction: torch rounds the product and the sum. The last two let square roots and selections be vectorised.
FLAGS = ("-O3", "-std=c++20", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
#: Vector level of x86-64 that torch reports → compiler's name of it; SSE4.2 for the processors below AVX2.
LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3", "DEFAULT": "x86-64-v2"}
_loaded: list[Path] = []
_tried: list[bool] = []


def cache() -> Path:
    """Folder of compiled libraries: DHTORCH_CACHE, else ``dhtorch`` in the user's cache folder."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("DHTORCH_CACHE") or caches / "dhtorch")


def levels() -> tuple[str, ...]:
    """Vector levels for which a library can be compiled on this machine; one, without a flag, other than on x86-64."""
    machine = platform.machine().lower()
    return tuple(LEVELS.values()) if machine in ("x86_64", "amd64") else (machine,)


def level() -> str:
    """The vector level that torch uses in this process, which ATEN_CPU_CAPABILITY may restrict."""
    chosen = LEVELS.get(torch.backends.cpu.get_cpu_capability(), LEVELS["DEFAULT"])
    return chosen if len(levels()) > 1 else levels()[0]


def file_name(for_level: str) -> str:
    """Name of the library of a level: with a hash of all that decides its content, but the compiler."""
    sources = (source.read_text(encoding="utf-8") for source in (_FOLDER / "vectors.h", *SOURCES))
    key = "\n".join((*sources, constants_header(), sys.platform, platform.machine(), *FLAGS))
    return f"dhtorch-{hashlib.sha256(key.encode()).hexdigest()[:16]}-{for_level}.so"


def library() -> Path:
    """Path in the cache of the library for these sources and this processor, whether or not it exists."""
    return cache() / file_name(level())


def manifest(path: Path) -> Path:
    """The file beside a library that holds its checksum."""
    return path.with_name(f"{path.name}.json")


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def problem(path: Path) -> str | None:
    """Why an existing library must not be loaded: another checksum than its manifest's, or other users; else None."""
    for each in (path, path.parent):
        status = each.stat()
        if status.st_mode & stat.S_IWOTH:
            return f"{each} may be written by other users"
        if path.parent != INSTALLED and hasattr(os, "getuid") and status.st_uid not in (0, os.getuid()):
            return f"{each} belongs to another user"
    try:
        expected = json.loads(manifest(path).read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return f"{manifest(path)} does not hold its checksum"
    return None if checksum(path) == expected else f"{path} differs from its checksum"


def load() -> None:
    """Load the library, which operators of this process then use; OSError where it is missing or must not be loaded."""
    if _loaded:
        return
    check_torch_version()
    name, reasons = file_name(level()), []
    for path in (each for each in (INSTALLED / name, cache() / name) if each.is_file()):
        if problem(path):  # a build may be replacing the file and its manifest, by two renames in below 1 ms
            time.sleep(0.2)
        reason = problem(path)
        try:
            if reason is None:
                torch.ops.load_library(str(path.resolve()))
                _loaded.append(path)
                return
        except OSError as error:  # of another machine, or without libraries that it needs
            reason = f"{path}: {str(error).splitlines()[0]}"
        reasons.append(reason)
    if reasons:
        raise OSError(f"compiled operators: {'; '.join(reasons)}; compile them again with {COMMAND}")
    others = sorted(each.name for each in INSTALLED.glob("dhtorch-*.so"))
    stale = f"; {INSTALLED} holds {others[0]}, of other sources or another processor" if others else ""
    missing = f"{cache() / name}: no library for these sources and this processor{stale}"
    raise FileNotFoundError(f"{missing}; compile it with {COMMAND}")


def load_if_present() -> bool:
    """Load the library at the first call, as DHTORCH_OPS says -> whether it is loaded; one warning says why not."""
    if _loaded:
        return True
    switch = os.environ.get(SWITCH, "")
    if switch == "0" or (not switch and _tried):
        return False
    try:
        load()
    except OSError as error:
        if switch:
            raise
        if isinstance(error, FileNotFoundError) and "other sources" not in str(error):
            warnings.warn(f"operators: torch, {_ADVICE}", ImportWarning, stacklevel=2)  # Python ignores these
        elif "found torch" not in str(error):  # an older torch needs no word
            warnings.warn(f"{error} (torch is used)", stacklevel=2)
    _tried.append(True)
    return bool(_loaded)


def describe_operators(*, advice: bool = False) -> str:
    """What computes the operators of this process: ``compiled x86-64-v4``, or ``torch``; ``advice`` adds why."""
    if load_if_present():
        return f"compiled {level()}"
    reason = f" ({SWITCH}=0)" if os.environ.get(SWITCH) == "0" else f", {_ADVICE}"
    return f"torch{reason}" if advice else "torch"


def check_torch_version() -> None:
    """Raise an OSError for a torch without the stable ABI."""
    if tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2]) < MIN_TORCH_VERSION:
        expected = f"at least {MIN_TORCH_VERSION[0]}.{MIN_TORCH_VERSION[1]}"
        raise OSError(f"compiled operators: found torch {torch.__version__}, expected {expected}")
