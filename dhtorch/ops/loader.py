"""Compilation and loading of the C++ kernels of ``csrc``, which are optional: every operator has a torch reference.

    python -m dhtorch.ops          compile them into the user's cache, with the system's C++ compiler
    DHTORCH_OPS=1 python …         use them, in loader workers as well; or dhtorch.ops.loader.load() in a program

Which functions have a kernel, and for which tensors it runs: :mod:`dhtorch.ops.dispatch`. Agreement with the torch
reference, which the tests check (``tests/ops/test_compiled.py``):

- bit for bit: pixels of samples, flags and classes of holes, depth in metres, tokens, the sensor's map, census costs,
  their best surface;
- up to one rounding of a value: pyramids, sigma, statistics of windows around samples, where textures carry the
  rounding of their sums;
- up to the rounding of sums over a window, of the search for points and the registration of windows: half of the
  positions are equal or within 1e-4 px, 99 of 100 within a tenth of their sigma, at most one validity in 200 differs;
- poses: 99 of 100 within a hundredth of their sigma; fitted surfaces: 99 of 100 depths within a tenth of their sigma,
  at most one gate in 200 differs.

Nothing is compiled or downloaded without the command above. The library's name is a hash of its sources, torch's
version, the compiler flags and the processor, the widest vector instructions of which it uses.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from dhtorch import codes
from dhtorch.ops import constants
from dhtorch.runtime.results import describe_processor

#: The command that compiles the library.
COMMAND = "python -m dhtorch.ops"

#: Environment variable: 1 loads the library on first use.
SWITCH = "DHTORCH_OPS"

#: Lowest torch version whose headers have the stable ABI with ``TORCH_BOX``, which the sources use.
MIN_TORCH_VERSION = (2, 10)

#: Folder of the C++ sources.
FOLDER = Path(__file__).with_name("csrc")

#: C++ sources of the library.
SOURCES = tuple(
    FOLDER / f"{part}.cpp"
    for part in ("sweep", "search", "affine", "pyramid", "fit", "windows", "tokens", "pose", "tracks")
)

#: Header that all sources include.
HEADER = FOLDER / "vectors.h"

#: Name of the generated header, as in the sources' ``#include``.
CONSTANTS_HEADER = "constants.h"

#: Code tables whose values are in the generated header, as ``<table>_<name>``.
_CODE_TABLES = (codes.Flag, codes.Hole, codes.Source)

#: No FMA contraction: torch rounds the product and the sum. ``-fno-math-errno -fno-trapping-math`` let square roots and
#: selections be vectorised; results are unchanged.
FLAGS = ("-O3", "-std=c++20", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")

#: Value of ATEN_CPU_CAPABILITY, which restricts torch's vector instructions -> the x86-64 level without wider ones.
_LEVELS = {"avx2": "x86-64-v3", "default": "x86-64-v2"}

_loaded: list[Path] = []


def cache() -> Path:
    """Folder of compiled libraries: DHTORCH_CACHE, else ``dhtorch`` in the user's cache folder."""
    folder = os.environ.get("DHTORCH_CACHE")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dhtorch"


def library() -> Path:
    """Path of the library for these sources, this torch version and this processor, whether or not it exists."""
    flags = (*FLAGS, *_vector_flags())
    sources = (source.read_text(encoding="utf-8") for source in (HEADER, *SOURCES))
    key = "\n".join((*sources, constants_header(), torch.__version__, describe_processor(), platform.machine(), *flags))
    return cache() / f"dhtorch-{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"


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


def build() -> Path:
    """Compile the library unless it exists -> its path.

    Raises:
        OSError: torch older than :data:`MIN_TORCH_VERSION`; no compiler (CXX, else c++, g++ or clang++);
            compilation failed, with the compiler's message; no permission to write.
    """
    _check_torch_version()
    path = library()
    if path.is_file():
        return path
    compiler = _compiler_command()
    torch_folder = Path(torch.__file__).parent
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        temporary = Path(folder) / path.name
        (Path(folder) / CONSTANTS_HEADER).write_text(constants_header(), encoding="utf-8")
        command = [*compiler, *FLAGS, *_vector_flags(), f"-I{folder}", f"-I{torch_folder / 'include'}"]
        command += [*map(str, SOURCES), "-o", str(temporary)]
        command += (
            ["-undefined", "dynamic_lookup"]
            if sys.platform == "darwin"
            else [f"-L{torch_folder / 'lib'}", "-ltorch_cpu"]
        )
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        if process.returncode:
            raise OSError(f"{shlex.join(command)}: exit code {process.returncode}\n{process.stderr.strip()}")
        temporary.replace(path)
    return path


def load() -> None:
    """Load the compiled library, which operators of this process then use.

    Raises:
        FileNotFoundError: no library was compiled for these sources, this torch and this processor.
        OSError: torch older than :data:`MIN_TORCH_VERSION`.
    """
    if _loaded:
        return
    _check_torch_version()
    path = library()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no library for this torch and processor; compile it with {COMMAND}")
    torch.ops.load_library(str(path))
    _loaded.append(path)


def is_loaded() -> bool:
    """Whether the library is loaded in this process."""
    return bool(_loaded)


def _check_torch_version() -> None:
    version = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if version < MIN_TORCH_VERSION:
        expected = ".".join(map(str, MIN_TORCH_VERSION))
        raise OSError(f"compiled operators: found torch {torch.__version__}, expected at least {expected}")


def _vector_flags() -> tuple[str, ...]:
    """Compiler flag of the vector instructions of this processor, or of those torch is restricted to; x86-64 only."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return ()
    capability = os.environ.get("ATEN_CPU_CAPABILITY", "").lower()
    return (f"-march={_LEVELS.get(capability, 'native')}",)


def _compiler_command() -> list[str]:
    requested = shlex.split(os.environ.get("CXX", ""))
    command = requested or [name for name in ("c++", "g++", "clang++") if shutil.which(name)][:1]
    if not command or shutil.which(command[0]) is None:
        raise OSError(f"{' '.join(requested) or 'c++, g++, clang++'}: no such C++ compiler; set CXX to another")
    return command
