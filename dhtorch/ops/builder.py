"""Compilation of ``csrc``: sources -> one library a vector level, with its manifest.

``python -m dhtorch.ops`` compiles this processor's level into the user's cache; the build of a wheel
(``hatch_build.py``) all levels of its platform. Nothing else compiles, and nothing is downloaded.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from dhtorch.ops import loader

#: Name of the generated header, as in the sources' ``#include``.
_CONSTANTS_HEADER = "constants.h"


def build(folder: Path | None = None, level: str | None = None) -> Path:
    """Compile the library unless it exists and may be loaded -> its path.

    Two processes may build at once: each writes files of its own and replaces the result as a whole.

    Args:
        folder: where the library is written; None = :func:`loader.cache`.
        level: one of :func:`loader.levels`; None = that of this processor.

    Raises:
        OSError: torch older than :data:`loader.MIN_TORCH_VERSION`; no compiler (CXX, else c++, g++ or clang++);
            compilation failed, with the compiler's message; no permission to write.
    """
    loader.check_torch_version()
    folder, level = folder or loader.cache(), level or loader.level()
    path = folder / loader.file_name(level)
    if path.is_file() and loader.problem(path) is None:
        return path
    compiler = find_compiler()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as work:
            compiled_file = _compile(compiler, Path(work), level)
            compiled_file.chmod(0o755)
            note = Path(work) / "manifest.json"
            note.write_text(
                json.dumps({"sha256": loader.checksum(compiled_file), "compiler": compiler}), encoding="utf-8"
            )
            note.replace(loader.manifest(path))
            compiled_file.replace(path)
    except PermissionError as error:
        raise OSError(
            f"{folder}: no permission to write compiled operators; set DHTORCH_CACHE to another folder"
        ) from error
    return path


def find_compiler() -> list[str]:
    """Command of the C++ compiler: CXX, else the first of c++, g++, clang++.

    Raises:
        OSError: there is none.
    """
    requested = shlex.split(os.environ.get("CXX", ""))
    command = requested or [name for name in ("c++", "g++", "clang++") if shutil.which(name)][:1]
    if not command or shutil.which(command[0]) is None:
        raise OSError(f"{' '.join(requested) or 'c++, g++, clang++'}: no such C++ compiler; set CXX to another")
    return command


def _compile(compiler: Sequence[str], work: Path, level: str) -> Path:
    """Compile the sources, as many at a time as there are cores, and link them -> the library, in ``work``."""
    torch_folder = Path(torch.__file__).parent
    (work / _CONSTANTS_HEADER).write_text(loader.constants_header(), encoding="utf-8")
    major, minor = loader.MIN_TORCH_VERSION
    flags = [*loader.FLAGS, f"-DTORCH_TARGET_VERSION=0x{major:02x}{minor:02x}000000000000"]
    if len(loader.levels()) > 1:
        flags.append(f"-march={level}")
    flags += [f"-I{work}", f"-I{torch_folder / 'include'}"]
    objects = [work / f"{source.stem}.o" for source in loader.SOURCES]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        compiled = [
            pool.submit(_run, [*compiler, *flags, "-c", str(source), "-o", str(each)])
            for source, each in zip(loader.SOURCES, objects, strict=True)
        ]
        for each in compiled:
            each.result()
    compiled_file = work / "library.so"
    link = (
        ["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else [f"-L{torch_folder / 'lib'}", "-ltorch_cpu"]
    )
    _run([*compiler, "-shared", *map(str, objects), *link, "-o", str(compiled_file)])
    return compiled_file


def _run(command: Sequence[str]) -> None:
    """Run the compiler.

    Raises:
        OSError: it failed; the message holds the command and what it printed.
    """
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode:
        raise OSError(f"{shlex.join(command)}: exit code {process.returncode}\n{process.stderr.strip()}")


def wheel_tag() -> str:
    """Tag of a wheel that holds the libraries of this platform; they use no ABI of Python's, so its stable one fits."""
    return f"cp311-abi3-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"


def build_for_wheel(folder: Path) -> list[Path]:
    """Compile all levels of this platform -> the libraries and their manifests, in ``folder``."""
    libraries = [build(folder, level) for level in loader.levels()]
    return [file for path in libraries for file in (path, loader.manifest(path))]
