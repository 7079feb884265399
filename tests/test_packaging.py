"""What is handed out: the wheel and the source archive are whole, and the wheel works where no checkout is."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import dhtorch

REPO = Path(__file__).resolve().parents[1]
PACKAGE = REPO / "dhtorch"
TINY = ["data.hw=[60,80]", "data.n_frames=3", "data.supersample=1", "data.lidar=exact", "pairs.gap=2", "method.n=256"]

#: A ridge probe on a synthetic robot set, which the package writes itself.
PROBE = ["experiment=rh20t_probe", "data=rh20t_synthetic", "data.tasks=3", "data.scenes=1", "data.hw=[36,64]"]
PROBE += ["experiment.dinov2=null", "experiment.n_folds=3", "method.n=256"]

#: Files beside the modules that the package reads when it runs.
ASSETS = {p.relative_to(REPO).as_posix() for p in PACKAGE.rglob("*") if p.suffix in (".css", ".js", ".html", ".json")}


def build(source, what, target):
    """``wheel`` or ``sdist`` of a source tree, by the build backend alone: nothing is fetched."""
    code = f"import hatchling.build as b, sys; print(b.build_{what}(sys.argv[1]))"
    run = [sys.executable, "-c", code, str(target)]
    done = subprocess.run(run, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DHTORCH_OPS", "0")  # without compiled operators, which `pip install` adds
        return build(REPO, "wheel", tmp_path_factory.mktemp("wheel"))


def members(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def tracked(*folders):
    """Files of the repository below some folders; git's list, so that caches do not count."""
    run = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *folders]
    done = subprocess.run(run, cwd=REPO, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    return {name for name in done.stdout.split("\n") if name and (REPO / name).is_file()}


def test_the_wheel_holds_the_package_its_settings_and_assets_and_no_more(wheel):
    inside = {name for name in members(wheel) if not name.split("/")[0].endswith(".dist-info")}
    assert ASSETS and inside >= ASSETS
    assert "dhtorch/py.typed" in inside
    assert inside == tracked("dhtorch") | {f"dhtorch/{name}" for name in tracked("conf")}


def test_the_wheel_says_what_it_is(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (facts,) = (archive.read(n).decode() for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        (entry,) = (archive.read(n).decode() for n in archive.namelist() if n.endswith("entry_points.txt"))
        assert any(n.endswith("licenses/LICENSE") for n in archive.namelist())
    project = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "License-Expression: Apache-2.0" in facts and "# dhtorch" in facts
    assert set(re.findall(r"^Provides-Extra: (.*)$", facts, re.M)) == set(project["optional-dependencies"])
    assert "dhtorch = dhtorch.cli.run:main" in entry


def test_urls_and_links_are_those_of_the_repository_that_builds(tmp_path, monkeypatch):
    """Without GitHub's variables there are no URLs, and README keeps its links."""
    monkeypatch.delenv("GITHUB_REPOSITORY", raising=False)
    monkeypatch.setenv("DHTORCH_OPS", "0")  # metadata alone: no compiler
    with zipfile.ZipFile(build(REPO, "wheel", tmp_path)) as archive:
        (plain,) = (archive.read(n).decode() for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
    assert "Project-URL" not in plain and "](docs/assets/triptych.jpg)" in plain
    monkeypatch.setenv("GITHUB_REPOSITORY", "owner/dhtorch")
    with zipfile.ZipFile(build(REPO, "wheel", tmp_path)) as archive:
        (facts,) = (archive.read(n).decode() for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
    named = dict(line.split(", ") for line in re.findall(r"^Project-URL: (.*)$", facts, re.M))
    assert set(named) == {"Homepage", "Documentation", "Changelog", "Issues"}
    assert named["Homepage"] == "https://github.com/owner/dhtorch"
    assert "](https://github.com/owner/dhtorch/raw/main/docs/assets/triptych.jpg)" in facts
    assert not re.findall(r"\]\((?!https?:|#)", facts)


def test_the_version_stands_in_one_place():
    """Citation and changes, below those that are not released, name the version of the package."""
    (citation,) = re.findall(r"^version: (.*)$", (REPO / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    headings = re.findall(r"^## (.*)$", (REPO / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert citation == next(h for h in headings if h != "Unreleased") == dhtorch.__version__


@pytest.mark.slow
@pytest.mark.timeout(900)  # a minute of work, but a busy machine stretches it
def test_the_wheel_works_where_no_checkout_is(wheel, tmp_path):
    """In an environment of its own beside the present libraries: a job, an experiment and every word."""
    environment, empty = tmp_path / "env", tmp_path / "empty"
    venv.create(environment, with_pip=False, symlinks=os.name != "nt")
    (here,) = {p.resolve() for p in environment.rglob("site-packages")}
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([*pip, "--disable-pip-version-check"], check=True, capture_output=True)
    libraries = next(p for p in sys.path if p.endswith("site-packages"))
    (here / "libraries.pth").write_text(libraries + "\n", encoding="utf-8")
    empty.mkdir()
    calls = [
        [*TINY, "figures=false", "output=job"],
        [*TINY, "figures=false", "output=census", "experiment=hole_census"],
        ["demo", "out=demo"],
        [*PROBE, "figures=false", "output=probe"],
        ["report", "job", "--html", "page.html"],
        ["view", "job", "html=view.html"],
        ["inspect", "job", "--out", "sheets", "--format", "nothing"],
    ]
    code = (
        "import json, sys, dhtorch; from dhtorch.cli.run import config_dir, main;"
        "print('\\x00' + json.dumps([[main(a) for a in json.loads(sys.argv[1])], dhtorch.__file__, str(config_dir())]))"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "DHTORCH_DATA")}
    run = [python, "-P", "-c", code, json.dumps(calls)]
    done = subprocess.run(run, cwd=empty, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    codes, module, settings = json.loads(done.stdout.partition("\x00")[2])
    assert codes == [0, 0, 0, 0, 0, 0, 2], done.stderr  # no format is called "nothing"
    assert Path(module) == here / "dhtorch" / "__init__.py" and Path(settings) == here / "dhtorch" / "conf"
    assert {"page.html", "view.html"} <= {p.name for p in empty.iterdir()} and "<style" in (
        empty / "page.html"
    ).read_text(encoding="utf-8")
    version = subprocess.run(
        [scripts / "dhtorch", "--version"], cwd=empty, env=env, capture_output=True, text=True, check=True
    )
    assert version.stdout.startswith("dhtorch ")


@pytest.mark.slow
def test_the_source_archive_makes_the_same_wheel(wheel, tmp_path):
    archive = build(REPO, "sdist", tmp_path)
    with tarfile.open(archive) as tar:
        tar.extractall(tmp_path, filter="data")
    (source,) = (p for p in tmp_path.iterdir() if p.is_dir())
    for name in ("tests", "benchmarks", "notebooks", "docs", "conf"):
        assert (source / name).is_dir(), name
    for name in (
        "README.md",
        "LICENSE",
        "CITATION.cff",
        "Makefile",
        "constraints.txt",
        "mkdocs.yml",
        "pyproject.toml",
        "hatch_build.py",
    ):
        assert (source / name).is_file(), name
    again = build(source, "wheel", tmp_path)
    assert again.name == wheel.name and members(again) == members(wheel)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "extra",
    ["all", "live", "learned", "view", "matchers", "scale", "ray-launcher", "peers", "docs", "dev"],
)
def test_extras_can_be_resolved(wheel, extra):
    """Dry run against the index, with the pinned torch."""
    ask = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--retries", "0", "--timeout", "10"]
    reachable = subprocess.run([*ask, "index", "versions", "rich"], capture_output=True, text=True, check=False)
    if reachable.returncode:
        pytest.skip("no package index can be reached")
    wanted = [f"dhtorch[{extra}] @ {wheel.as_uri()}", "-c", str(REPO / "constraints.txt")]
    force = ["--ignore-installed"] if extra == "ray-launcher" else []  # an environment of its own
    done = subprocess.run([*ask, "install", "--dry-run", *force, *wanted], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Would install" in done.stdout


def test_every_extra_is_tested():
    project = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (mark,) = [m for m in test_extras_can_be_resolved.pytestmark if m.name == "parametrize"]
    assert set(mark.args[1]) == set(project["optional-dependencies"])
