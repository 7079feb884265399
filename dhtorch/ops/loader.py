"""Inner loops of the sweep and its fits, of pyramids, of what a loader does beside the stages, of what is read around
samples, of the search for points, of the registration of their windows and of poses as compiled code, for those who ask
for it; nothing needs it.

    python -m dhtorch.ops.loader            compile ``native*.cpp``, with the system's C++ compiler, into the user's
    cache DHTORCH_OPS=1 python …           use it, in loader workers as well; or dhtorch.ops.loader.load() in a
    program

``dhtorch.pipeline.surface`` and ``pair``, ``dhtorch.stages.backproject``, ``holes`` and ``pose``,
``dhtorch.geometry.plane_sweep``, ``pyramid``, ``lookup``, ``neighbours``, ``lucas_kanade``, ``affine`` and
``near_far``, ``dhtorch.transforms.tokens``, ``views`` and ``alone`` ask here whether tensors may be handed over; where
not (nothing was loaded, another device or type, under vmap, a compiler or a graph) they do the same in torch, which is
the reference. Tokens, depths in metres, the sensor's own map and the sweep are alike bit for bit, the fits of the sweep
up to rounding: no more than one gate in 200 differs, and 99 of 100 depths by less than a tenth of their sigma. A
pyramid, what is read around samples and what is said of them do up to one rounding of a number, textures up to the
rounding of their sums. The search and the
registration do up to the rounding of sums over a window: half of the places that were searched for are equal and half
of those that were registered lie within 1e-4 px, 99 of 100 lie within a tenth of their sigma, and no more than one
verdict in 200 changes. Of poses, whose costs and equations it sums, 99 of 100 lie within a hundredth of their sigma.
Nothing is ever compiled or downloaded without the command above. The file in the cache is named after its sources,
torch's version and the processor, whose widest vectors it uses.
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
from torch import Tensor
from torch.autograd import forward_ad

from dhtorch.runtime.results import describe_processor

FOLDER = Path(__file__).with_name("csrc")

SOURCES = tuple(
    FOLDER / f"{part}.cpp"
    for part in ("sweep", "search", "affine", "pyramid", "fit", "windows", "tokens", "pose", "tracks")
)

#: What the sources share.
HEADER = FOLDER / "vectors.h"

#: A product that is fused with a sum would round once where torch rounds twice. Nobody asks whether an operation was
#: invalid, so that roots and choices between numbers may be made in vectors; they stay what they are.
FLAGS = ("-O3", "-std=c++20", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")

#: What ATEN_CPU_CAPABILITY may hold torch to → the level of x86-64 that has no wider vectors.
_LEVELS = {"avx2": "x86-64-v3", "default": "x86-64-v2"}

#: Types of numbers that the compiled code reads.
_TOLD = frozenset((torch.float32, torch.uint8, torch.bool, torch.int16, torch.int32, torch.int64))

#: The command that makes the file, as errors tell it.
COMMAND = "python -m dhtorch.ops.loader"

_loaded: list[Path] = []


def cache() -> Path:
    """The folder of compiled files: DHTORCH_CACHE, else ``dhtorch`` in the user's cache."""
    own = os.environ.get("DHTORCH_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dhtorch"


def library() -> Path:
    """Where the compiled file of this source, torch and processor is or would be."""
    flags = (*FLAGS, *_vectors())
    sources = (source.read_text(encoding="utf-8") for source in (HEADER, *SOURCES))
    key = "\n".join((*sources, torch.__version__, describe_processor(), platform.machine(), *flags))
    return cache() / f"dhtorch-{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"


def build() -> Path:
    """Compile the source, unless that was done; returns the file.

    Raises:
        OSError: no compiler (CXX, else c++, g++ or clang++), one that fails (its words are in the message), or no
            right to write.
    """
    path = library()
    if path.is_file():
        return path
    compiler = _compiler()
    home = Path(torch.__file__).parent
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        unfinished = Path(folder) / path.name
        words = [*compiler, *FLAGS, *_vectors(), f"-I{home / 'include'}", *map(str, SOURCES), "-o", str(unfinished)]
        words += ["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else [f"-L{home / 'lib'}", "-ltorch_cpu"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{shlex.join(words)}: exit code {done.returncode}\n{done.stderr.strip()}")
        unfinished.replace(path)
    return path


def load() -> None:
    """Use the compiled file from now on, in this process.

    Raises:
        FileNotFoundError: there is none for this source, torch and processor.
    """
    if _loaded:
        return
    path = library()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: not compiled for this torch and processor; {COMMAND} does it")
    torch.ops.load_library(str(path))
    _loaded.append(path)


def serves(*tensors: Tensor) -> bool:
    """Whether tensors may be handed to the compiled code: it is loaded, or DHTORCH_OPS=1 asks for that, and they are
    contiguous ones of the CPU, in whole numbers or single precision, and nobody transforms or differentiates them
    (backward, or forward: ``torch.autograd.forward_ad`` hides its tangents within plain tensors).

    Raises:
        FileNotFoundError: DHTORCH_OPS=1 asks for what was not compiled.
    """
    if torch.compiler.is_compiling() or forward_ad._current_level >= 0:
        return False
    if not _loaded:
        if os.environ.get("DHTORCH_OPS", "") in ("", "0"):
            return False
        load()
    graph = torch.is_grad_enabled()
    for x in tensors:  # in as few steps as there are: some stages ask a dozen times
        if type(x) is not Tensor or x.dtype not in _TOLD or not x.is_cpu or not x.is_contiguous():
            return False
        if (graph and x.requires_grad) or x.is_neg() or torch._C._functorch.is_functorch_wrapped_tensor(x):
            return False
    return True


def _vectors() -> tuple[str, ...]:
    """What tells the compiler to use all that this processor has, or what torch is held to; nothing on other makes."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return ()
    held = os.environ.get("ATEN_CPU_CAPABILITY", "").lower()
    return (f"-march={_LEVELS.get(held, 'native')}",)


def _compiler() -> list[str]:
    own = shlex.split(os.environ.get("CXX", ""))
    found = own or [name for name in ("c++", "g++", "clang++") if shutil.which(name)][:1]
    if not found or shutil.which(found[0]) is None:
        raise OSError(f"{' '.join(own) or 'c++, g++, clang++'}: no such C++ compiler; CXX names another")
    return found


def main() -> int:
    """Compile, and say where the file is; exit code 2 where that cannot be done."""
    if sys.argv[1:]:
        print(
            __doc__ if {"-h", "--help"} & set(sys.argv[1:]) else f"found {sys.argv[1]!r}, expected nothing: {COMMAND}"
        )
        return 0 if {"-h", "--help"} & set(sys.argv[1:]) else 2
    try:
        print(build())
    except OSError as error:
        print(f"dhtorch.ops.loader: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
