"""Starts the command in a process of its own, and sends it a signal at a chosen moment."""

import os
import signal
import subprocess
import sys
import time


def start(folder, *args):
    """Starts ``dhtorch`` with these arguments in its own process group, as a shell does, with output to files."""
    with (folder / "out").open("w") as out, (folder / "err").open("w") as err:
        command = [sys.executable, "-m", "dhtorch", *args]
        return subprocess.Popen(command, cwd=folder, stdout=out, stderr=err, start_new_session=True)


def stop(process, finished, n, how):
    """Sends a signal to the whole group as soon as ``n`` files are ``finished()``; returns the exit code."""
    try:
        end = time.monotonic() + 150  # on a busy machine a start alone takes long
        while len(finished()) < n and process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)
        os.killpg(process.pid, how)
        return process.wait(60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
