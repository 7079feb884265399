"""Memory of a call: its learned weights, and the peak of a process that runs nothing else."""

import contextlib
import ctypes
import gc
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from dhtorch.data.io.decode import set_opencv_threads
from dhtorch.pipeline.spec import iter_networks
from dhtorch.pytree import Record

_MIB = 2**20


def count_weights(*parts: Any) -> dict[str, int]:
    """``parameters`` and ``weight_bytes`` of all networks among ``parts`` and in the options of partials."""
    tensors = {id(p): p for network in iter_networks(*parts) for p in network.parameters()}.values()
    return {
        "parameters": sum(p.numel() for p in tensors),
        "weight_bytes": sum(p.numel() * p.element_size() for p in tensors),
    }


def peak_mib(call: Callable[[], Any], before: Callable[[], Any] | None = None) -> float | None:
    """Highest resident memory (MiB) while ``call`` runs once, above that of the process before it.

    Measured in a fresh process that has imported dhtorch and holds the inputs.

    Args:
        call: a picklable partial; its arguments are inputs and are copied before the measurement.
        before: called first and not counted, for what is loaded at first use.

    Returns:
        MiB; None where the system does not report it.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        return process.submit(_child_peak, call, before, torch.get_num_threads()).result()


def _child_peak(call: Callable[[], Any], before: Callable[[], Any] | None, threads: int) -> float | None:
    """Peak memory (MiB) of ``call``, measured in the child process."""
    torch.set_num_threads(threads)
    set_opencv_threads(threads)
    if before is not None:
        before()
    call = _call_on_copies(call)
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # free memory that the process reuses is not counted
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):  # the high-water mark becomes the resident bytes, where the kernel allows it
        Path("/proc/self/clear_refs").write_text("5")
    start = _read_proc_status("VmRSS") or _rusage()
    with torch.no_grad():
        call()
    # the kernel's high-water mark of this address space first: ru_maxrss of a new process starts at its parent's size
    highest = _read_proc_status("VmHWM") or _rusage()
    return None if start is None or highest is None else max(highest - start, 0) / _MIB


def _call_on_copies(call: Any) -> Any:
    """Call on private copies of its inputs: shared memory would count on first access."""
    if isinstance(call, partial):
        copies = [a.map(torch.clone) if isinstance(a, Record) else _call_on_copies(a) for a in call.args]
        return partial(call.func, *copies, **call.keywords)
    return call.clone() if isinstance(call, torch.Tensor) else call


def _read_proc_status(name: str) -> int | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    sizes = [int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")]
    return sizes[0] if sizes else None


def _rusage() -> int | None:
    try:
        import resource  # noqa: PLC0415  (not on Windows)
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
