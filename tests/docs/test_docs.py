"""The documentation: it builds without a warning, no link leads nowhere, and what it says comes from the code."""

import html
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from dhtorch import data
from dhtorch.experiments.report import layouts

REPO = Path(__file__).resolve().parents[2]
DOCS = REPO / "docs"
WITHOUT = [name for name in ("mkdocs", "material", "mkdocstrings") if importlib.util.find_spec(name) is None]


def script(name):
    """A script of the documentation as a module."""
    sys.path.insert(0, str(DOCS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(DOCS))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site: page → text."""
    if WITHOUT:
        pytest.skip(f"needs pip install dhtorch[docs]: {', '.join(WITHOUT)} not found")
    folder = tmp_path_factory.mktemp("site")
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "OMP_NUM_THREADS": "1"}  # an advertisement, not a warning of ours
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=REPO, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr, done.stderr[-3000:]
    return folder, {p.relative_to(folder).as_posix(): p.read_text(encoding="utf-8") for p in folder.rglob("*.html")}


@pytest.mark.slow
def test_there_is_a_page_for_every_promise(site):
    _, pages = site
    assert {p.relative_to(DOCS).with_suffix(".html").as_posix() for p in DOCS.rglob("*.md")} <= set(pages)
    for module in ("pipeline", "stages", "geometry", "transforms", "data", "experiments", "synthetic"):
        assert f"api/{module}.html" in pages


@pytest.mark.slow
def test_no_internal_link_leads_nowhere(site):
    """Pages, reference views, pictures, scripts and styles; other people's sites are not asked."""
    folder, pages = site
    targets = {name: set(re.findall(r'\bid="([^"]+)"', text)) for name, text in pages.items()}
    found = 0
    for name, text in pages.items():
        if name == "404.html":  # its links start from the root of a server
            continue
        for link in re.findall(r'\b(?:href|src)="([^"]*)"', text):
            parts = urlsplit(html.unescape(link))
            if parts.scheme or parts.netloc:
                continue
            path = ((folder / name).parent / unquote(parts.path)).resolve() if parts.path else folder / name
            assert path.exists(), f"{name}: {link}"
            path = path / "index.html" if path.is_dir() else path
            if parts.fragment and path.suffix == ".html":
                page = path.relative_to(folder.resolve() if parts.path else folder).as_posix()
                assert unquote(parts.fragment) in targets[page] | {"__skip"}, f"{name}: {link}"
            found += 1
    assert found > 1000


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere(site):
    """No font, script or style of another host: the site works offline."""
    _, pages = site
    for name, text in pages.items():
        loaded = re.findall(
            r'<(?:script|img|iframe)[^>]+src="([^"]+)"|<link[^>]+rel="stylesheet"[^>]+href="([^"]+)"', text
        )
        assert not [link for pair in loaded for link in pair if link.startswith(("http", "//"))], name


def test_the_pages_are_whole_without_the_site():
    """What is read in the repository holds no mark that is filled elsewhere."""
    for page in DOCS.rglob("*.md"):
        for mark, body in re.findall(r"^<!-- (?!end)(.*?) -->\n(.*?)^<!-- end -->$", page.read_text(), re.M | re.S):
            assert body.strip(), (page.name, mark)


def test_a_mark_that_nobody_makes_is_an_error():
    with pytest.raises(ValueError, match="'wishes', expected one of"):
        script("hooks").generate("wishes")


#: A Python example of a page, and what the page shows as its output.
EXAMPLE = re.compile(r"^```python\n(.*?)^```\n(?:\nIt prints\n\n```text\n(.*?)^```\n)?", re.M | re.S)

#: Numbers of an output may differ by this fraction on another processor or version of torch.
MAX_RELATIVE_CHANGE = 0.15


def assert_prints(shown, printed):
    """The output that a page shows is the real one: the same words, and numbers that differ by rounding at most."""
    number = re.compile(r"\d+(?:\.\d+)?")
    assert number.sub("#", printed) == number.sub("#", shown), (
        f"the page shows\n{shown}and the example prints\n{printed}"
    )
    for now, then in zip(number.findall(printed), number.findall(shown), strict=True):
        assert abs(float(now) - float(then)) <= MAX_RELATIVE_CHANGE * float(then) + 0.02, (now, then, printed)


@pytest.mark.parametrize("page", ["methods", "pipelines", "extend", "learning", "upstream"])
def test_the_examples_run(page, capsys, monkeypatch):
    examples = EXAMPLE.findall((DOCS / f"{page}.md").read_text(encoding="utf-8"))
    names: dict = {}
    monkeypatch.setattr(data, "FORMATS", dict(data.FORMATS))  # to which an example adds
    monkeypatch.setattr(layouts, "EXPERIMENT_LAYOUTS", dict(layouts.EXPERIMENT_LAYOUTS))
    out = ""
    for code, shown in examples:
        exec(compile(code, f"{page}.md", "exec"), names)
        printed = capsys.readouterr().out
        out += printed
        if page in ("pipelines", "extend"):
            assert_prints(shown, printed)
    if page == "methods":
        score = names["estimate"].score
        assert ((score > 0) == names["estimate"].keep).all() and (score > 0).any()
    elif page == "upstream":
        assert names["solution"].valid.all() and (names["points"][..., 2] > 0).all()
        assert names["tracks"].points.shape == (2, 5, 2)
    elif page == "learning":
        gradient, keep = names["predicted"].grad, names["labels"].keep
        assert gradient.isfinite().all() and gradient[keep].ne(0).all() and 50 < int(keep.sum()) < keep.numel()
    elif page == "extend":
        assert names["outcome"].verdict in ("supported", "refuted") and names["mine"].track is names["half_size"]
        kept = names["estimate"].keep
        assert ((names["estimate"].score > 0) == kept).all() and int(kept.sum()) > 50
        tracked = names["mine"](names["room"][0], names["room"][6])
        both = tracked.keep & kept
        assert float((tracked.depth / names["estimate"].depth - 1).abs()[both].median()) < 0.1, "the half-size tracker"
    else:
        assert "of 256 samples have a depth beyond the sensor" in out and "pick up the cup" in out
        assert len(names["far"]) > 30 and float(names["far"].max()) > 4, "recovered depth, and beyond the sensor"


def test_what_paper_is_has_the_values_of_its_settings():
    """Each option in the table on the method ``paper`` has the value of ``conf/method/paper.yaml``."""
    text = (DOCS / "methods.md").read_text(encoding="utf-8")
    part = text[text.index("### What `paper` is") : text.index("### A learned tracker")]
    rows = re.findall(r"^\| `([\w.]+)` \| .*? \| `([^`]+)` \| .+ \|$", part, re.M)
    settings = yaml.safe_load((REPO / "conf/method/paper.yaml").read_text(encoding="utf-8"))
    for name, told in rows:
        value = settings
        for key in name.split("."):
            value = value[key]
        value = value["_target_"].rpartition(".")[2] if isinstance(value, dict) else value
        assert value == yaml.safe_load(told), name
    assert len(rows) == len(re.findall(r"^\| `", part, re.M)) > 20
    assert {"n", "hypotheses", "track.track.window", "track.track.levels", "score"} <= {name for name, _ in rows}


def test_options_that_the_pages_name_exist():
    """Choices of groups in the examples are files of conf/."""
    for page in DOCS.rglob("*.md"):
        for group, name in re.findall(
            r"\b(data|method|experiment|launch|pairs)=([a-z]\w*)\b", page.read_text(encoding="utf-8")
        ):
            if name not in ("mine",):
                assert (REPO / "conf" / group / f"{name}.yaml").is_file(), (page.name, f"{group}={name}")


def test_direct_dependencies_have_licences_that_fit():
    licences = script("licences")
    for package, groups in licences.requirements().items():
        found = licences.licence(package)
        assert found, f"{package}: no licence known"
        if package in licences.TOOLS:
            assert (found, groups) == (licences.TOOLS[package], ["dev"]), package
            used = [
                p
                for p in (REPO / "dhtorch").rglob("*.py")
                if re.search(rf"\bimport {package}|from {package}", p.read_text(encoding="utf-8"))
            ]
            assert not used, used
        else:
            assert licences.compatible(found), f"{package}: {found}"
        assert f"| {package} |" in licences.table()


def test_an_expression_fits_where_one_of_its_choices_does():
    fits = script("licences").compatible
    assert fits("MIT") and fits("MIT OR GPL-3.0-only") and fits("Apache-2.0 AND (BSD-3-Clause)")
    assert not fits("GPL-3.0-only") and not fits("MIT AND GPL-3.0-only") and not fits("proprietary")


@pytest.mark.parametrize("some", [slice(0, None, 5), pytest.param(slice(0, None), marks=pytest.mark.slow)])
def test_every_part_of_the_package_has_a_page_of_the_api(some):
    hooks = script("hooks")
    for part in list(hooks.parts())[some]:
        assert hooks.api_page(part).startswith(f"# {part}\n"), part
