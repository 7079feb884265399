"""Scripts of this folder one after the other in one process, which imports a loader once: a request a line, an answer.

A request is ``["torch_loader.py", "DST"]``, an answer ``[what it said in its last line or null, why not]``.
"""

import io
import json
import runpy
import sys
import traceback
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


def answer(script: str, *words: str) -> tuple[Any, str]:
    """What a script said, and what it ended with."""
    sys.argv = [script, *words]
    stdout = io.StringIO()
    try:
        with redirect_stdout(stdout):
            runpy.run_path(str(HERE / script), run_name="__main__")
    except SystemExit as stop:
        return None, str(stop)
    except Exception as error:  # whatever a loader of others raises is what the table is to say
        return None, " ".join("".join(traceback.format_exception_only(error)).split())
    last = stdout.getvalue().strip().splitlines()[-1:]
    return (json.loads(last[0]), "") if last else ({}, "")


def main() -> None:
    """Until there is no request."""
    out, sys.stdout = sys.stdout, sys.stderr  # what libraries print is no answer
    for line in sys.stdin:
        print(json.dumps(answer(*json.loads(line))), file=out, flush=True)


if __name__ == "__main__":
    main()
