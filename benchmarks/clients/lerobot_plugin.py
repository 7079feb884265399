"""The LeRobot package (``integrations/lerobot``) in LeRobot: its wheel, found by LeRobot, and its tests.

python benchmarks/clients/lerobot_plugin.py --lerobot PYTHON --lerobot PYTHON --json FILE

The wheel and pytest are installed into a temporary folder on the path of each interpreter, whose own packages stay as
they are; this interpreter needs pip and setuptools. For each of :data:`VERSIONS` that no interpreter has, the rows that
FILE holds are kept; where there are none, they say ``not run``.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from all import QUICK, REPO, call, environment, short, versions
from lerobot_train import VERSIONS
from written import CAMERAS, write_robot

PACKAGE = REPO / "integrations" / "lerobot"

#: Pytest and what it needs, all of them pure Python.
TOOLS = ("pytest", "pluggy", "iniconfig", "packaging", "pygments")

#: Room of the set: a camera that moves far enough between two frames for depth where the sensor has none.
ROOM = {"hw": (192, 256), "depth_hw": (96, 128), "supersample": 2, "step_m": 0.03, "range_limit": 2.5}


def install(work: Path) -> Path:
    """Folder with the package's wheel and pytest installed."""
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    copy = shutil.copytree(PACKAGE, work / "package")  # a build leaves folders in it
    build = ["wheel", "--no-deps", "--no-build-isolation", "-w", str(work), str(copy)]
    subprocess.run([*pip, *build], check=True)
    (wheel,) = work.glob("lerobot_camera_dhtorch-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(work / "site"), *TOOLS, str(wheel)], check=True)
    return work / "site"


def enriched_robot(work: Path) -> Path:
    """A LeRobot set with an action, a state and a sensor's depth, and what ``dhtorch enrich`` adds."""
    write_robot(work / "source", CAMERAS[:1], 10, **ROOM)
    words = ("-m", "dhtorch", "enrich", str(work / "source"), str(work / "set"), "format=lerobot", "data=lerobot")
    result, why = call(sys.executable, *words, *QUICK, "dense={size: 80}")
    if result is None:
        sys.exit(f"enrich: {why}")
    return work / "set"


def run_tests(python: str, site: Path, data: Path) -> list[dict[str, Any]]:
    """Row of each test in one interpreter."""
    env = environment() | {"DHTORCH_LEROBOT_SET": str(data), "HF_HOME": str(data.parent / "hf")}
    env |= {"PYTHONPATH": os.pathsep.join(map(str, (site, REPO))), "PYTHONDONTWRITEBYTECODE": "1"}
    report = data.parent / "report.xml"
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", ".", f"--junitxml={report}"]
    done = subprocess.run([python, *words, "tests"], env=env, cwd=PACKAGE, capture_output=True, text=True, check=False)
    if not report.is_file():
        return [{"test": "all", "passed": False, "why": short((done.stderr or done.stdout).strip().splitlines()[-1])}]
    rows = []
    for case in ElementTree.parse(report).iter("testcase"):
        wrong = next((each for each in case if each.tag in ("failure", "error", "skipped")), None)
        passed = None if wrong is not None and wrong.tag == "skipped" else wrong is None
        why = "" if wrong is None else short(wrong.get("message", ""))
        rows.append(
            {"test": f"{case.get('classname', '').split('.')[-1]}.{case.get('name')}", "passed": passed, "why": why}
        )
    report.unlink()
    return rows


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--json", type=Path, help="rows of versions that are not run now stay as they are in it")
    args = parser.parse_args()
    known = {has.get("lerobot"): (python, has) for python in args.lerobot for has in [versions(python)]}
    before = json.loads(args.json.read_text()) if args.json and args.json.is_file() else []
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        site, data = (install(Path(folder)), enriched_robot(Path(folder))) if known else (None, None)
        for version in dict.fromkeys((*VERSIONS, *known)):
            kept = [row for row in before if row["lerobot"] == version]
            none = [{"lerobot": version, "torch": None, "test": "all", "passed": None, "why": "not run"}]
            if version in known and site and data:
                python, has = known[version]
                kept = [{"lerobot": version, "torch": has["torch"], **row} for row in run_tests(python, site, data)]
                print(*map(json.dumps, kept), sep="\n", flush=True)
            rows += kept or none
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if all(row["passed"] is not False for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
