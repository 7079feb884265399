"""Memory that a process keeps: asked for again, it does not come from the system page by page."""

import ctypes
import os
import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest

from dhtorch.cli import run
from dhtorch.runtime import allocator

glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has no such setting")

ASKED = """
import resource, sys, torch
from dhtorch.runtime.allocator import disable_malloc_trim
from dhtorch.transforms import one_thread

def faults(mebibytes):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.ones(mebibytes << 18) for _ in range(3)]
    del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

asked = {"nothing": lambda: None, "keep": disable_malloc_trim, "worker": one_thread}[sys.argv[1]]()
for size in (1, 8, 64):
    faults(size)
print(asked, *(faults(size) for size in (1, 8, 64)))
"""


def said(how):
    env = {k: v for k, v in os.environ.items() if k not in allocator._MALLOC_VARIABLES}
    done = subprocess.run([sys.executable, "-c", ASKED, how], env=env, capture_output=True, text=True, check=True)
    asked, *counts = done.stdout.split()
    return asked, [int(n) for n in counts]


@pytest.mark.slow
@glibc
def test_what_is_freed_is_not_asked_for_again():
    _, given_back = said("nothing")
    asked, kept = said("keep")
    assert given_back[2] > 5000, "else this test would tell nothing"
    assert asked == "True" and max(kept) < given_back[2] / 5  # blocks may come to lie elsewhere than before
    assert max(said("worker")[1]) < given_back[2] / 5


@pytest.mark.parametrize("variable", [None, *allocator._MALLOC_VARIABLES])
def test_both_thresholds_are_set_and_none_where_the_environment_sets_one(monkeypatch, variable):
    for name in allocator._MALLOC_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    if variable is not None:
        monkeypatch.setenv(variable, "131072")
    calls, refused = [], []
    library = SimpleNamespace(mallopt=lambda *call: calls.append(call) or int(call[0] not in refused))
    monkeypatch.setattr(ctypes, "CDLL", lambda _: library)
    assert allocator.disable_malloc_trim() is (variable is None)
    expected = [(-3, 2**30), (-1, 2**30)] if variable is None else []
    assert calls == expected, "M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h, bytes"
    for option in (-1, -3):
        refused[:] = [option]
        assert allocator.disable_malloc_trim() is False
    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    assert allocator.disable_malloc_trim() is False, "another allocator is left alone"


@pytest.mark.slow
@pytest.mark.parametrize("words", [["stream", "max_frames=2"], ["pairs=gap", "pairs.gap=1", "figures=false"]])
def test_commands_that_work_on_frames_keep_what_they_free(words, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(run, "disable_malloc_trim", lambda: asked.append(1))
    small = ["data=synthetic", "data.n_frames=3", "method=paper", "method.n=64"]
    assert run.main(["stream", "--help"]) == 0 and run.main(["stream", "moost=2"]) == run.EXIT_FAILED and not asked
    assert run.main([*words, *small, f"output={tmp_path / 'out'}"]) == 0 and asked == [1]
