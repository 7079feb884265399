"""Dispatch to kernels, and the library of kernels: built, checked, loaded, or left where it is not sound."""

import json
import platform
import re
import shutil
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import pytest
import torch
from support.tiny_runs import ROOM
from torch.autograd import forward_ad

from dhtorch import codes
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry import (
    plane_sweep,
    pyramid,
)
from dhtorch.ops import builder, constants, dispatch, loader


def test_the_generated_header_holds_the_codes_and_the_shared_constants():
    header = loader.constants_header()
    for table in (codes.Flag, codes.Hole, codes.Source):
        for code, name in codes.names(table).items():
            assert f" {table.__name__.upper()}_{name} = {code};" in header
    assert "UNUSABLE" not in header
    assert "LUMA_THOUSANDTHS[] = {299, 587, 114};" in header and sum(constants.LUMA_THOUSANDTHS) == 1000
    for name in ("FIT_RADIUS_PX", "MAX_KERNEL_WINDOW_PX", "MAX_MAP_RADIUS_PX"):
        assert f" {name} = {getattr(constants, name)};" in header


@pytest.mark.parametrize(
    ("owner", "name", "value", "differs"),
    [
        (constants, "FIT_RADIUS_PX", 5, True),
        (platform, "machine", lambda: "other", True),
        (platform, "machine", lambda: "arm64", True),
        (sys, "platform", "other", True),
        (loader, "FLAGS", ["-O0"], True),
        (torch, "__version__", "2.11.1", False),
    ],
)
def test_another_constant_machine_or_command_has_a_file_of_its_own(monkeypatch, owner, name, value, differs):
    before = loader.library()
    monkeypatch.setattr(owner, name, value)
    assert (loader.library() != before) == differs
    if name == "machine":
        assert loader.levels() == (value(),) and value() in loader.library().name


def test_arguments_that_no_kernel_reads_are_left_to_torch(loaded, monkeypatch):
    seen = []
    kinds = {"x": torch.float32, "code": (torch.uint8, torch.int32), "any_strides": torch.float32}

    @dispatch.operator(kernel=lambda *_, **__: seen.append("kernel"), dtypes=kinds, any_layout=("any_strides",))
    def both(x, code=None, any_strides=None, *, option=0):
        """The reference."""
        seen.append("torch")

    def which(*args, **kwargs):
        both(*args, **kwargs)
        return seen.pop()

    x = torch.zeros(2, 3, 4, 5)
    assert both.__name__ == "both" and both.__doc__ == "The reference."
    assert which(x, x.to(torch.uint8)) == which(x, x.int(), x.mT) == which(x) == which(any_strides=x, x=x) == "kernel"
    for one in (x.double(), x.half(), x.mT, x.to("meta"), torch.nn.Parameter(x), torch._neg_view(x)):
        assert which(one) == "torch"
    assert which(x, x) == which(x, x.long()) == which(code=x.long(), x=x) == which(x, None, x.double()) == "torch"
    with torch.no_grad():
        assert which(torch.nn.Parameter(x)) == "torch", "no plain tensor"
        assert which(x.clone().requires_grad_()) == "kernel"
    torch.vmap(lambda y: (both(y), y)[1])(x)
    assert seen.pop() == "torch"
    with forward_ad.dual_level():
        assert which(x) == "torch"
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert which(x) == "torch"


def test_an_operator_runs_its_kernel_where_its_condition_holds(monkeypatch):
    monkeypatch.setattr(loader, "_loaded", [None])

    @dispatch.operator(
        kernel=lambda *tensors, radius: "kernel",
        dtypes={"x": torch.float32, "y": torch.float32},
        when=lambda *tensors, radius: radius == 4,
    )
    def both(*tensors, radius):
        """The reference."""
        return "torch"

    x = torch.zeros(3)
    assert both(x, x, radius=4) == both(x, None, radius=4) == "kernel"
    assert both(x, x, radius=2) == both(x, x.double(), radius=4) == "torch"
    for wrong in ({"y": torch.float32}, {"x": torch.float32, "z": torch.float32}):
        with pytest.raises(TypeError, match=r"double: found dtypes of .*, expected x"):

            @dispatch.operator(kernel=both, dtypes=wrong)
            def double(x):
                """The reference."""


def test_tangents_are_carried_where_kernels_are_loaded(loaded):
    image, tangent = torch.rand(2, 1, 3, 48, 64)
    with forward_ad.dual_level():
        top = pyramid.build_pyramid(forward_ad.make_dual(image, tangent), 2, 11).levels[1]
        found = forward_ad.unpack_dual(top).tangent
    expected = pyramid.build_pyramid(tangent, 2, 11).levels[1]  # linear in the image
    assert found is not None and torch.allclose(found, expected, atol=1e-6)
    assert dispatch.is_in_use()


def test_a_library_is_in_use_where_there_is_one_unless_it_is_turned_off(cache, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    assert not dispatch.is_in_use() and loader.describe_operators() == "torch" and not loader._loaded
    monkeypatch.delenv("DHTORCH_OPS")
    assert dispatch.is_in_use() and loader._loaded == [loader.library()]
    assert loader.describe_operators() == f"compiled {loader.level()}"
    assert {*cache.iterdir()} == {loader.library(), loader.manifest(loader.library())}, "nothing unfinished stays"


def test_without_a_library_torch_computes_and_nothing_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(ImportWarning, match=f"operators: torch, .* slower .*: {loader.COMMAND}") as heard:
        assert not dispatch.is_in_use() and loader.describe_operators() == "torch"
    assert len(heard) == 1, "a category that Python ignores: the library prints nothing"
    monkeypatch.setenv("DHTORCH_OPS", "1")
    with pytest.raises(FileNotFoundError, match=f"no library for .*; compile it with {loader.COMMAND}"):
        plane_sweep.aggregate_best_plane(torch.zeros(1, 2, 2, 3, dtype=torch.uint8), torch.tensor(1))
    assert not (tmp_path / "none").exists()


#: Torch computes for the library, for a quiet command, for two commands, and for one that leaves compiled code unused.
FIRST_USE = """
import os, sys
from dhtorch.cli import run
from dhtorch.ops import dispatch, loader
loader.INSTALLED = loader.cache()
words = sys.argv[1:]
print(dispatch.is_in_use(), file=sys.stderr)
for flags, switch, is_first in ((["-q"], "", True), ([], "", True), ([], "", False), ([], "0", True)):
    os.environ["DHTORCH_OPS"] = switch
    loader._tried[:] = loader._tried[: not is_first]
    print(run.main([*flags, *words]), file=sys.stderr)
"""


def test_a_command_prints_once_that_operators_are_not_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.setenv("DHTORCH_OPS", "")
    words = ["stream", *ROOM[:4], "data=synthetic", "method=map", "method.n=64", "max_frames=2", "output=out"]
    command = [sys.executable, "-c", FIRST_USE, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    line = f"dhtorch: warning: operators: torch, {loader._ADVICE}"
    assert done.stderr.splitlines() == ["False", "0", line, "0", "0", "0"]
    assert loader.COMMAND in line and "3 to 9 times slower" in line and "C++ compiler" in line


def copy_of(cache, folder):
    """The compiled library and its manifest, copied to another cache -> its path."""
    shutil.copytree(cache, folder)
    return folder / loader.library().name


def make_foreign(path):
    """A file with a right checksum that no processor can load."""
    path.write_bytes(b"\x7fELF" + bytes(200))
    loader.manifest(path).write_text(json.dumps({"sha256": loader.checksum(path)}))


#: Name -> what is done to the library, and what the warning says.
SPOILED = {
    "changed": (lambda path: path.write_bytes(path.read_bytes()[:-1] + b"x"), "differs from its checksum"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:1000]), "differs from its checksum"),
    "empty": (lambda path: path.write_bytes(b""), "differs from its checksum"),
    "foreign": (make_foreign, "Could not load|file"),
    "no manifest": (lambda path: loader.manifest(path).unlink(), "does not hold its checksum"),
    "bad manifest": (lambda path: loader.manifest(path).write_text('{"sha256": null'), "does not hold its checksum"),
    "open": (lambda path: path.chmod(0o777), "may be written by other users"),
    "open folder": (lambda path: path.parent.chmod(0o777), "may be written by other users"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_library_is_left_with_one_warning_and_built_again(cache, tmp_path, monkeypatch, name):
    path, (spoil, message) = copy_of(cache, tmp_path / "copy"), SPOILED[name]
    spoil(path)
    monkeypatch.setenv("DHTORCH_CACHE", str(path.parent))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(UserWarning, match=message) as heard:
        assert not dispatch.is_in_use() and not dispatch.is_in_use()
    assert len(heard) == 1 and "torch is used" in str(heard[0].message) and loader.COMMAND in str(heard[0].message)
    monkeypatch.setenv("DHTORCH_OPS", "1")
    with pytest.raises(OSError, match=message):
        loader.load()
    if name not in ("foreign", "open folder"):
        monkeypatch.setattr(builder, "_compile", lambda compiler, work, level: write(work / "made.so", b"new"))
        assert builder.build() == path and path.read_bytes() == b"new" and loader.problem(path) is None


def write(path, data):
    path.write_bytes(data)
    return path


def test_a_library_of_other_sources_is_left(cache, tmp_path, monkeypatch):
    name = copy_of(cache, tmp_path / "installed").name
    for file in (tmp_path / "installed").iterdir():
        file.rename(file.with_name(file.name.replace(name[8:24], "0123456789abcdef")))
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(UserWarning, match="of other sources or another processor"):
        assert not dispatch.is_in_use()


def test_the_library_of_a_wheel_is_used_before_the_cache(cache, tmp_path, monkeypatch):
    path, opened = copy_of(cache, tmp_path / "installed"), []
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    monkeypatch.delenv("DHTORCH_OPS")
    monkeypatch.setattr(torch.ops, "load_library", opened.append)  # a process registers the operators once
    assert dispatch.is_in_use() and loader._loaded == [path] and opened == [str(path.resolve())]


def test_two_processes_may_build_at_once(tmp_path, monkeypatch):
    """Each writes files of its own; the names are those of whole files at any time."""
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "cache"))
    made = []

    def compile_while_another_does(compiler, work, level):
        if not made:
            made.append(work)
            builder.build()  # the other process, from beginning to end
        return write(work / "made.so", b"whole")

    monkeypatch.setattr(builder, "_compile", compile_while_another_does)
    path = builder.build()
    assert loader.problem(path) is None and path.read_bytes() == b"whole"
    assert {*path.parent.iterdir()} == {path, loader.manifest(path)}


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "cache"))

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(builder.tempfile, "TemporaryDirectory", refuse)
    with pytest.raises(OSError, match=r"cache: no permission to write .*; set DHTORCH_CACHE"):
        builder.build()


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="levels are those of x86-64")
def test_a_torch_held_to_narrower_vectors_has_a_file_of_its_own(monkeypatch):
    files = set()
    for capability, level in loader.LEVELS.items():
        monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda word=capability: word)
        assert loader.level() == level and level in loader.library().name
        files.add(loader.library())
    assert len(files) == len(loader.levels()) == 3
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "another")
    assert loader.level() == "x86-64-v2"


def test_a_torch_that_is_too_old_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    for old in ("2.5.1+cpu", "2.9.0a0+git1"):
        monkeypatch.setattr(torch, "__version__", old)
        for call in (builder.build, loader.load):
            with pytest.raises(OSError, match=rf"found torch {re.escape(old)}, expected at least 2\.10"):
                call()
        monkeypatch.delenv("DHTORCH_OPS", raising=False)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not dispatch.is_in_use(), "the reference computes, without a warning"
    assert not list(tmp_path.iterdir())


def test_the_command_says_what_it_does_and_takes_no_options():
    for option, code in (("--help", 0), ("--fast", 2)):
        asked = [sys.executable, "-m", "dhtorch.ops", option]
        said = subprocess.run(asked, capture_output=True, text=True, check=False)
        assert said.returncode == code and loader.COMMAND in said.stdout


def test_a_compiler_that_is_missing_or_fails_is_reported(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    monkeypatch.setenv("CXX", "no-such-compiler-7")
    asked = [sys.executable, "-m", "dhtorch.ops"]
    said = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert said.returncode == 2 and "no-such-compiler-7: no such C++ compiler" in said.stderr
    if shutil.which("false"):
        monkeypatch.setenv("CXX", "false --kind")
        with pytest.raises(OSError, match=r"false --kind .*exit code 1"):
            builder.build()
        assert not list(tmp_path.iterdir())


def test_a_map_fits_into_the_kernel_and_a_level_is_padded_by_more_than_it_reads():
    assert max(*lk.TOP_RADII, *lk.MIDDLE_RADII, *lk.FINEST_RADII) <= constants.MAX_MAP_RADIUS_PX
    reach = pyramid.OUTSIDE_MARGIN_PX + constants.MAX_MAP_RADIUS_PX + 2
    assert reach <= pyramid.SEARCH_PADDING_PX, "the largest radius, and a row"


def run_workers(count, folders, monkeypatch):
    """{name of a folder: [operators, warnings, whether the answers are torch's] of each worker}, in a new process."""
    monkeypatch.delenv("DHTORCH_OPS", raising=False)
    program = Path(__file__).parents[1] / "support" / "library_workers.py"
    command = [sys.executable, str(program), str(count), *map(str, folders.values())]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    return dict(zip(folders, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked")
def test_every_worker_of_a_loader_takes_a_sound_library_and_leaves_another(cache, tmp_path, monkeypatch):
    names = ("sound", "changed", "cut", "foreign", "no manifest")
    folders = {name: copy_of(cache, tmp_path / name).parent for name in names} | {"none": tmp_path / "none"}
    folders["none"].mkdir()
    for name in names[1:]:
        SPOILED[name][0](folders[name] / loader.library().name)
    found = run_workers(3, folders, monkeypatch)
    compiled = f"compiled {loader.level()}"
    assert found["sound"] == [[compiled, [], True]] * 3 and found["none"] == [["torch", [], True]] * 3
    for name in names[1:]:
        for operators, heard, same in found[name]:
            assert operators == "torch" and same and len(heard) == 1, name
            assert "(torch is used)" in heard[0] and loader.COMMAND in heard[0], name


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked")
def test_workers_that_start_while_the_library_is_replaced_have_a_whole_one(cache, tmp_path, monkeypatch):
    """A build renames the manifest and then the library, again and again, here with a file of other bytes."""
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    path = copy_of(cache, tmp_path / "copy")
    variants = [path.read_bytes(), path.read_bytes() + bytes(8)]
    stop, replaced = threading.Event(), []

    def replace():
        while not stop.is_set():
            new = write(path.with_name("new.so"), variants[len(replaced) % 2])
            note = path.with_name("new.json")
            note.write_text(json.dumps({"sha256": loader.checksum(new)}))
            note.replace(loader.manifest(path))
            time.sleep(0.01)
            new.replace(path)
            replaced.append(time.monotonic())
            time.sleep(0.6)

    thread = threading.Thread(target=replace)
    thread.start()
    try:
        found = run_workers(4, {str(k): path.parent for k in range(6)}, monkeypatch)
    finally:
        stop.set()
        thread.join()
    assert len(replaced) >= 3
    assert [row for rows in found.values() for row in rows] == [[f"compiled {loader.level()}", [], True]] * 24


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the compiler of this test is a shell script")
def test_builds_of_several_processes_at_once_leave_one_whole_library(cache, tmp_path, monkeypatch):
    """Beside them workers start; the compiler here copies a library, slowly."""
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    sound = loader.library()
    script = tmp_path / "c++"
    script.write_text(
        f"""#!/bin/sh
sleep 0.1
link=no
while [ $# -gt 0 ]; do
  case "$1" in -shared) link=yes;; -o) out="$2";; esac
  shift
done
if [ $link = yes ]; then dd if={sound} of="$out" bs=65536 2>/dev/null; else : > "$out"; fi
"""
    )
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    folder = tmp_path / "cache"
    copy_of(cache, folder)
    SPOILED["changed"][0](folder / sound.name)  # so that each process compiles again
    monkeypatch.setenv("DHTORCH_CACHE", str(folder))
    builds = [
        subprocess.Popen([sys.executable, "-m", "dhtorch.ops"], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    heard = [build.communicate(timeout=300)[0] for build in builds]
    assert [build.returncode for build in builds] == [0, 0, 0] and all(sound.name in text for text in heard)
    path = folder / sound.name
    assert loader.problem(path) is None and path.read_bytes() == sound.read_bytes()
    assert {*folder.iterdir()} == {path, loader.manifest(path)}, "nothing unfinished stays"
    assert run_workers(2, {"built": folder}, monkeypatch) == {"built": [[f"compiled {loader.level()}", [], True]] * 2}
