"""Committed results: each has its command, the command's settings are the file's, and what is told names it whole."""

import json
import re
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from dhtorch.runtime import results as result_files

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import cells
import readme
import reproduce
import speed_tables

REPO = Path(__file__).resolve().parents[1]
FILES = {path.stem for path in (REPO / "benchmarks/results").glob("*.json")}
PAGES = ("README.md", "benchmarks/README.md", *sorted(str(p.relative_to(REPO)) for p in REPO.glob("docs/**/*.md")))


def test_every_result_has_a_command_and_every_command_its_result():
    parts = {name for file in cells.COLLECTIONS for name in cells.load(cells.RESULTS / f"{file}.json")}
    assert {*reproduce.EXPERIMENTS, *reproduce.SCRIPTS} == FILES - set(cells.COLLECTIONS) | parts
    assert parts == {name for names in cells.COLLECTIONS.values() for name in names} and not parts & FILES


def test_what_a_script_makes_again_becomes_a_part_of_its_collection(tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "RESULTS", tmp_path)
    cells.write_collection(tmp_path / "speeds.json", {"lk": [{"a": "é"}], "pnp": []})
    (tmp_path / "lk.json").write_text('[{"a": 1}, {"a": null}]')
    monkeypatch.setattr(reproduce.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    monkeypatch.setattr(reproduce, "note", lambda name: None)
    assert reproduce.run("lk") and not (tmp_path / "lk.json").exists()
    assert json.loads((tmp_path / "speeds.json").read_text()) == {"lk": [{"a": 1}, {"a": None}], "pnp": []}


def test_a_result_is_committed_without_what_no_page_reads():
    names = {"scene": "a", "method": "map", "truth": "full"}
    curves = {"risk_coverage": {"coverage": [1], "risk": [2], "oracle": [3]}, "distance": {}}
    scene = {**names, "pair": None, "coverage": 0.5, "overlay": 1, "curves": curves, "ms": {}}
    pair = {**names, "pair": [0, 1], "coverage": 0.5, "named_kind": "unit"}
    summary = {"map.coverage": 1, "map.ms.track": 2, "map.apart.glass.coverage": 3}
    whole = {"experiment": "heldout", "rows": [scene, pair], "summary": summary}
    kept = {k: v for k, v in scene.items() if k not in ("overlay", "curves", "ms")}
    assert reproduce.without_detail(whole) == {**whole, "rows": [kept], "summary": {"map.coverage": 1}}
    compared = reproduce.without_detail({**whole, "experiment": "method_comparison"})["rows"]
    assert compared == [{**kept, "ms": {}, "curves": curves}]
    validated = reproduce.without_detail({**whole, "experiment": "validate_study"})["rows"]
    assert validated == [kept, {k: v for k, v in pair.items() if k != "coverage"}]


@pytest.mark.parametrize(("part", "names"), [("kornia twin", {"kornia_twin"}), ("pin", set())])
def test_a_table_from_a_file_with_earlier_settings_has_a_note_that_names_it(part, names):
    assert {name for name in names if not reproduce.other_settings(name)} == set()
    blocks = [
        m for page in PAGES for m in re.findall(rf"<!-- {part} -->(.*?)<!-- end -->", (REPO / page).read_text(), re.S)
    ]
    assert blocks, "no page has this part"
    for block in blocks:
        notes = re.findall(r"\*Made with the settings of an earlier release, .*?`python \S+ (.*?)`\.\*", block)
        assert {name for note in notes for name in note.split()} == names


def test_a_column_of_the_first_release_is_labelled():
    assert readme.heading("map", "untouched") == readme.heading("map", "method_comparison") == "`map` of release 1"
    assert readme.heading("map", "track_chain") == "`map`" and readme.heading("paper", "untouched") == "`paper`"


def test_no_result_has_a_sigma_of_a_method_that_states_none():
    result = result_files.read_result(REPO / "benchmarks/results/method_comparison.json")
    blank = ("within_sigma", "within_2sigma", "ece", "ece_equal_mass")
    rows = [row for row in result["rows"] if row["pair"] is None]
    for method, states in (("paper", False), ("opencv", False), ("map", True), ("auto", True)):
        numbers = [row.get(key) for row in rows if row["method"] == method for key in blank]
        assert any(value is not None for value in numbers) == states, method
        assert (result["summary"][f"{method}.within_sigma"]["value"] is not None) == states, method


def test_other_settings_code_or_content_of_a_result_are_named(tmp_path, monkeypatch):
    """What ``--check`` prints, for a result that is made, edited, and whose code changes."""
    result = result_files.read_result(REPO / "benchmarks/results/global_map.json")
    monkeypatch.setattr(reproduce, "RESULTS", tmp_path)
    monkeypatch.setattr(reproduce, "PROVENANCE", tmp_path / "provenance.json")
    path = result_files.write_result(tmp_path / "global_map.json", result)
    assert "neither its commit nor its code is recorded" in reproduce.check("global_map")
    reproduce.note("global_map")
    assert reproduce.check("global_map") == "" and reproduce.provenance()["global_map"]["commit"]
    monkeypatch.setattr(reproduce, "reachable", lambda name: {"a.py": path})
    assert "other code" in reproduce.check("global_map")
    path.write_text(path.read_text() + " ")
    assert "neither its commit" in reproduce.check("global_map")
    assert "no icp.json" in reproduce.check("icp")
    other = {"experiment": {"n": 1}, "root": "elsewhere"}
    assert reproduce.differences(other, {"experiment": {"n": 1024}}) == ["experiment.n: found 1, expected 1024"]


@pytest.mark.parametrize("name", ["heldout", "sweep"])
def test_a_result_depends_on_the_stages_and_the_kernels(name):
    assert {"geometry/lucas_kanade.py", "ops/csrc/search.cpp"} <= {*reproduce.reachable(name)}


@pytest.mark.parametrize("page", PAGES)
def test_commands_on_the_pages_are_those_that_made_the_results(page):
    """Whatever a page tells to type for an experiment on named data makes one of the files."""
    known = [set(shlex.split(words)) for words in reproduce.EXPERIMENTS.values()]
    text = (REPO / page).read_text().replace("\n", " ")
    told = re.findall(r"`dhtorch ((?:[\w.]+=[\w.,\[\]]+ ?)+)`", text)
    for words in told:
        asked = set(words.split())
        if {"experiment", "data"} <= {w.partition("=")[0] for w in asked}:
            assert any(asked == command for command in known), words


def test_a_speed_is_told_with_its_processor():
    for name in (*speed_tables.SCRIPTS, "scaling"):
        rows = cells.read(name)
        named = {row.get("processor") for row in rows}
        assert len(named) == 1 and None not in named, name
        assert named.pop() in speed_tables.on(name, "")
    meta = result_files.read_result(REPO / "benchmarks/results/latency.json")["meta"]
    assert meta["processor"]


def test_a_processor_is_named_by_maker_model_and_vectors(tmp_path, monkeypatch):
    monkeypatch.delenv("ATEN_CPU_CAPABILITY", raising=False)
    told = "processor : 0\nmodel name\t: A. Maker 9000 @ 2 GHz\ncpu family\t: 6\nmodel\t\t: 85\nflags\t: fpu avx2{}\n\nmodel : 2"
    info = tmp_path / "cpuinfo"
    for more, vectors in (("", "AVX2"), (" avx512f", "AVX-512"), (" avx512f amx_tile", "AVX-512 and AMX")):
        info.write_text(told.format(more))
        assert result_files.describe_processor(info) == f"A. Maker 9000 @ 2 GHz, family 6 model 85, {vectors}"
    assert result_files.describe_processor(tmp_path / "none")
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "avx2")
    assert result_files.describe_processor(info).endswith("AVX-512 and AMX held to AVX2")
    info.write_text(told.format(""))
    assert result_files.describe_processor(info).endswith("model 85, AVX2")
