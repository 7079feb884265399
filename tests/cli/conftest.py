"""The ``dhtorch`` command as a function, for the tests of the command line."""

import pytest

from dhtorch.cli.run import main
from dhtorch.runtime import console


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Function that runs the ``dhtorch`` command in this process, in an empty folder: arguments -> (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    monkeypatch.delenv(console._VERBOSITY_VARIABLE, raising=False)

    def call(*args):
        try:
            code = main(list(args))
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code or 0, out, err

    return call
