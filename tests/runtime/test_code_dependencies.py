"""Which code a job can reach: editing that makes its result another one, editing anything else does not."""

import ast
import contextlib
import copy
import shutil
import sys
from functools import cache
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

import dhtorch
from dhtorch.cli.run import config_dir, job_name
from dhtorch.runtime import code_dependencies
from dhtorch.runtime import results as result_files

ROOT = Path(dhtorch.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))


@cache
def settings(*overrides):
    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        return OmegaConf.to_container(hydra.compose("run", list(overrides)), resolve=True)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A copy of the package that may be edited."""
    folder = tmp_path_factory.mktemp("copy") / "dhtorch"
    return Path(shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns("__pycache__")))


@contextlib.contextmanager
def edited(path):
    """A file with a comment at its end, for as long as it is looked at."""
    before = path.read_bytes()
    path.write_bytes(before + b"\n# edited\n")
    yield
    path.write_bytes(before)


MAIN = ("data=synthetic",)


@pytest.mark.parametrize(
    ("overrides", "path", "counts"),
    [
        (MAIN, "stages/track.py", True),
        (MAIN, "stages/fuse.py", True),
        (MAIN, "geometry/se3.py", True),
        (MAIN, "pipeline/pair.py", True),  # imported when a method is called
        (MAIN, "synthetic/room.py", True),
        (MAIN, "experiments/protocol.py", True),
        (MAIN, "metrics/risk.py", True),
        (MAIN, "viz/viewer/exhibit.py", False),
        (MAIN, "viz/viewer/html.py", False),
        (MAIN, "experiments/negative/icp.py", False),
        (MAIN, "experiments/negative/icp.py", False),
        (MAIN, "extract/dataset.py", False),
        (MAIN, "experiments/report/page.py", False),
        (MAIN, "cli/run.py", False),
        (MAIN, "metrics/calibration/map.json", False),
        ((*MAIN, "experiment=icp"), "experiments/negative/icp.py", True),
        ((*MAIN, "experiment=icp"), "experiments/negative/icp.py", True),
        ((*MAIN, "experiment=icp"), "experiments/paper/heldout.py", False),
        ((*MAIN, "method=opencv"), "experiments/baselines/opencv.py", True),
        (MAIN, "experiments/baselines/opencv.py", False),
    ],
)
def test_a_result_is_another_one_when_what_it_reaches_is_edited(package, overrides, path, counts):
    config = settings(*overrides)
    before = result_files.compute_result_key(config, "d", code_dir=package)
    with edited(package / path):
        assert (result_files.compute_result_key(config, "d", code_dir=package) != before) == counts
    assert result_files.compute_result_key(config, "d", code_dir=package) == before


def test_tables_that_travel_with_a_module_count_with_it(package):
    config = copy.deepcopy(settings(*MAIN))
    node = {"_target_": "dhtorch.metrics.calibration.load_probability", "name": "map"}
    config["method"]["score"]["recalibration"] = node
    before = result_files.compute_result_key(config, "d", code_dir=package)
    with edited(package / "metrics" / "calibration" / "map.json"):
        assert result_files.compute_result_key(config, "d", code_dir=package) != before
    assert not any(
        name.endswith((".pyc", ".css"))
        for name in code_dependencies.find_reachable_modules(code_dependencies.iter_targets(config), package)
    )


def test_a_comment_or_docstring_is_no_other_code(package):
    path = package / "metrics" / "risk.py"
    before = code_dependencies.digest_source(path)
    source = path.read_text()
    path.write_text(source.replace('"""', '"""Edited. ', 1) + "\n# edited\n")
    assert code_dependencies.digest_source(path) == before
    path.write_text(source + "\nEDITED = 1\n")
    assert code_dependencies.digest_source(path) != before
    path.write_text(source)


def test_further_roots_count(package):
    config = {"method": {"_target_": "dhtorch.pipeline.method.Method"}}
    roots = {"roots": ["dhtorch.extract.dataset"], "code_dir": package}
    before = result_files.compute_result_key(config, "d", **roots)
    assert before != result_files.compute_result_key(config, "d", code_dir=package)
    with edited(package / "extract" / "dataset.py"):
        assert before != result_files.compute_result_key(config, "d", **roots)


def test_names_are_those_of_modules_functions_and_packages():
    reach = lambda *names: set(code_dependencies.find_reachable_modules(names))  # noqa: E731
    assert reach("dhtorch.codes.Gate") == reach("dhtorch.codes") == {"__init__.py", "codes.py"}
    assert {"geometry/__init__.py", "geometry/se3.py", "pytree.py"} <= reach("dhtorch.geometry.se3.exp")
    assert reach("dhtorch.nothing", "dhtorch.nowhere.at.all") == {"__init__.py"} and reach("nobody.knows") == set()
    assert reach() == set() and list(code_dependencies.find_reachable_modules(["dhtorch.records"])) == sorted(
        code_dependencies.find_reachable_modules(["dhtorch.records"])
    )


def test_somebody_elses_function_counts_and_what_it_takes_from_here(tmp_path, monkeypatch):
    (tmp_path / "their_tracker.py").write_text("from dhtorch.stages import track\n\ndef follow(): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    found = code_dependencies.find_reachable_modules(["their_tracker.follow"])
    assert found["elsewhere:their_tracker"] == tmp_path / "their_tracker.py"
    assert {"stages/track.py", "geometry/lucas_kanade.py"} <= set(found) and "pipeline/multiview.py" not in found
    config = {"track": {"_target_": "their_tracker.follow"}}
    before = result_files.compute_result_key(config, "d")
    with edited(tmp_path / "their_tracker.py"):
        assert result_files.compute_result_key(config, "d") != before
    sys.modules.pop("their_tracker", None)


def written(path):
    """Names that a file imports of the package, read with the grammar."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "dhtorch")
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "dhtorch":
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_import_of_the_package_is_missed():
    for path in FILES:
        found, expected = set(code_dependencies.iter_imports(path.read_text(encoding="utf-8"))), set(written(path))
        assert expected <= found, path
        assert not found - expected or '"""' in path.read_text(encoding="utf-8"), "an example in a docstring"
    told = "from dhtorch.a import (\n    b,  # a note\n    c as d,\n)\n\ndef f():\n    import dhtorch.e\n    from dhtorch import g\n"
    assert list(code_dependencies.iter_imports(told)) == [
        "dhtorch.a",
        "dhtorch.a.b",
        "dhtorch.a.c",
        "dhtorch.e",
        "dhtorch",
        "dhtorch.g",
    ]


def test_nothing_is_imported_by_a_name_that_is_made_at_run_time():
    """Such an import would be out of reach: but of the package's own doors, and of modules that settings name."""
    allowed = {"__init__.py", "viz/viewer/again.py", "data/io/decode.py", "cli/run.py", "cli/option_checks.py"}
    users = {p.relative_to(ROOT).as_posix() for p in FILES if "import_module(" in p.read_text(encoding="utf-8")}
    assert users <= allowed
