"""Files and messages of the command after signals, kills, races and a full disk."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from support.small_result import KEY, result

from dhtorch.cli import run, signals
from dhtorch.runtime import console, file_lock, storage
from dhtorch.runtime import results as result_files

EVIL = "a\x1b[31mred\x07\x9b2J\u202ereversed\r"


def test_nothing_a_terminal_obeys_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with console.escape_output(), console.escape_output():
        print(EVIL)
        print(EVIL, file=sys.stderr)
        sys.stdout.writelines(["1\t2\n"])
        assert sys.stdout.encoding and sys.stdout.fileno is not None
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == err.strip() == r"a\x1b[31mred\x07\x9b2J\u202ereversed\x0d"
    assert out.endswith("1\t2\n") and console.escape_control("naïve ✓ 深度") == "naïve ✓ 深度"


def test_a_hostile_name_is_spelt_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / EVIL.replace("\r", "")
    folder.mkdir()
    for words in (["inspect", str(folder)], ["report", str(folder)], [f"data.x={EVIL}"]):
        assert run.main(words) == 2
        out, err = capsys.readouterr()
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err), words


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)])
def test_a_signal_ends_a_call_in_order(
    number: int, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tidied = []

    def told(_argv: list[str]) -> int:
        try:
            signal.raise_signal(number)
        finally:
            tidied.append(True)
        return 0

    inherited = signal.getsignal(number)
    before = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    signal.signal(number, before)  # whatever the shell has ignored, as nohup does SIGHUP
    monkeypatch.setattr(run, "_dispatch", told)
    try:
        assert run.main([]) == code and tidied
        assert "dhtorch: interrupted" in capsys.readouterr().err
        assert signal.getsignal(number) is before
    finally:
        signal.signal(number, inherited)


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.catch_termination() as told:
            signal.raise_signal(signal.SIGHUP)
        assert told.code(7) == 7
    finally:
        signal.signal(signal.SIGHUP, before)


_PARENT = """
import multiprocessing, sys, time
from dhtorch.runtime.parent_watch import exit_with_parent
def work():
    exit_with_parent()
    exit_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(60)
if __name__ == "__main__":
    process = multiprocessing.get_context("spawn" if len(sys.argv) > 1 else "fork").Process(target=work)
    process.start()
    process.join()
"""


def test_a_worker_ends_with_a_killed_parent(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(_PARENT)
    parent = subprocess.Popen([sys.executable, "parent.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent.stdout:
        worker = int(parent.stdout.readline())
        parent.kill()
        parent.wait()
        end = time.monotonic() + 5
        while Path(f"/proc/{worker}").exists() and time.monotonic() < end:
            time.sleep(0.05)
        assert not Path(f"/proc/{worker}").exists()


def _hold(file: Path, ready: Any) -> None:
    with file_lock.acquire_file_lock(file, "out: x"):
        ready.set()
        time.sleep(60)


def test_one_writer_at_a_time_and_dead_ones_block_nobody(tmp_path: Path) -> None:
    file = tmp_path / "deep" / ".lock"
    with (
        file_lock.acquire_file_lock(file, "out: x"),
        pytest.raises(BlockingIOError, match="this process"),
        file_lock.acquire_file_lock(file, "out: x"),
    ):
        pass
    assert not file.exists()
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    other = context.Process(target=_hold, args=(file, ready))
    other.start()
    try:
        assert ready.wait(30)
        match = rf"out: x: found another dhtorch process \({other.pid} on .*, for \d+ s\) writing there, expected one writer"
        with pytest.raises(BlockingIOError, match=match), file_lock.acquire_file_lock(file, "out: x"):
            pass
    finally:
        other.kill()
        other.join()
    assert file.exists()
    with file_lock.acquire_file_lock(file, "out: x"):
        assert json.loads(file.read_text())["process"] == os.getpid()
    assert not file.exists()


def test_a_second_sweep_in_a_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with file_lock.acquire_file_lock(tmp_path / "out" / ".dhtorch" / "lock", "x"):
        assert run.main([f"output={tmp_path}/out"]) == 2
    assert "expected one writer" in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("*.json"))


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*x\.json'"):
        storage.write_json(tmp_path / "x.json", {})
    assert not list(tmp_path.iterdir())


def test_a_limit_of_size_names_the_file(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match=r"File too large: '.*x\.json'"):
            storage.write_json(tmp_path / "x.json", list(range(1000)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert not list(tmp_path.iterdir())


def test_a_result_changed_by_hand_is_not_finished(tmp_path: Path) -> None:
    path = result_files.write_result(tmp_path / "result.json", result())
    assert result_files.is_finished(path, KEY)
    found = json.loads(path.read_text())
    path.write_text(json.dumps(found, indent=4))
    assert result_files.is_finished(path, KEY), "laid out otherwise, the same"
    found["rows"][0]["scene"] = "another"
    path.write_text(json.dumps(found))
    assert result_files.read_result(path)["rows"][0]["scene"] == "another" and not result_files.is_finished(path, KEY)
    result_files.write_result(path, found)
    assert result_files.is_finished(path, KEY)


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a":' * 900 + "1" + "}" * 900, "[" * 100 + "]" * 100])
def test_values_nested_too_deep_are_no_result(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "result.json"
    path.write_text(text)
    assert not result_files.is_finished(path, KEY)
    with pytest.raises(ValueError, match=r"result.json: found no strict JSON"):
        result_files.read_result(path)
    assert run.main(["report", str(tmp_path)]) in (1, 2) or "result.json" in capsys.readouterr().err
