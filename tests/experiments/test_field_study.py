"""The study of captures of other tools: an output is right if all checks of one accepted form hold."""

import pytest

from dhtorch.experiments.compare import field_study
from dhtorch.experiments.compare.field_study import holds

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default

OUTPUT = "50 %: 1.862 m, poses 5; Warning: the poses look like OpenGL axes; 12,345 pixels"


@pytest.mark.parametrize(
    ("check", "right"),
    [
        ({"see": "opengl"}, True),
        ({"see": "poses +5"}, True),
        ({"see": "wxyz"}, False),
        ({"unseen": "wxyz"}, True),
        ({"unseen": "warning"}, False),
        ({"exit": 0}, True),
        ({"exit": 2}, False),
        ({"number": "50 %: ([0-9.]+)", "within": [1.842, 1.88]}, True),
        ({"number": "50 %: ([0-9.]+)", "within": [1.862, 1.862]}, True),
        ({"number": "50 %: ([0-9.]+)", "within": [1.87, 1.88]}, False),
        ({"number": "50 %: ([0-9.]+)", "within": [1.0, 1.8]}, False),
        ({"number": "90 %: ([0-9.]+)", "within": [0, 9]}, False),
        ({"number": "([0-9,]+) pixels", "within": [12345, 12345]}, True),
        ({"exit": 0, "see": "OpenGL", "unseen": "OpenGL"}, False),
        ({}, True),
    ],
)
def test_checks_of_an_output(check, right, tmp_path):
    assert holds(check, OUTPUT, 0, tmp_path) == right


def test_checks_of_a_file(tmp_path):
    (tmp_path / "page.html").write_text("Depth unit\n   assumed: 1/1000 m")
    for check in ({"see": "unit assumed"}, {"number": r"1/(\d+)", "within": [1000, 1000]}):
        assert holds({**check, "file": "page.html"}, "", 0, tmp_path)
        assert not holds(check, "", 0, tmp_path), "the file is examined, not the output"
        assert not holds({**check, "file": "none.html"}, "unit assumed 1/1000", 0, tmp_path)
    assert not holds({"file": "none.html", "unseen": "x"}, "", 0, tmp_path), "a missing file fails"


@pytest.fixture
def cases(tmp_path):
    """Three cases with scripts for commands: right, right in its second form, and one of two commands wrong."""
    scripts = {
        "a": 'import sys; print("value:  2.5\\n m"); sys.exit(3)',
        "b": 'import sys, pathlib; pathlib.Path(sys.argv[1], "x.txt").write_text("found"); print("warn", file=sys.stderr)',
        "c": "print('silent')",
    }
    for name, script in scripts.items():
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "run.py").write_text(script)
    first = {"run": "python run.py", "accept": [[{"exit": 3}, {"number": "value: ([0-9.]+) m", "within": [2, 3]}]]}
    second = {
        "run": "python run.py {out}",
        "accept": [[{"see": "other"}], [{"see": "warn"}, {"see": "found", "file": "x.txt"}, {"exit": 0}]],
    }
    sound, wrong = ({"run": "python run.py", "accept": [[{word: "silent"}]]} for word in ("see", "unseen"))
    return {"a": [first], "b": [second], "c": [sound, wrong]}


def test_rows_and_summary(cases, tmp_path):
    outcome = field_study.run((), {}, None, {}, cases=cases, root=str(tmp_path), folder="cases")
    commands = [row for row in outcome.rows if row["pair"] is not None]
    by_case = {row["scene"]: row["right"] for row in outcome.rows if row["pair"] is None}
    assert by_case == {"a": True, "b": True, "c": False}
    assert [row["right"] for row in commands] == [True, True, True, False]
    assert [row["exit"] for row in commands] == [3, 0, 0, 0] and commands[0]["output"].strip() == "value: 2.5 m"
    assert outcome.summary["field.cases_right"]["value"] == pytest.approx(2 / 3)
    assert outcome.summary["field.commands_right"]["value"] == pytest.approx(3 / 4)
    assert "2 of 3 cases; not: c" in str(vars(outcome))


def test_all_right_is_what_is_expected(cases, tmp_path):
    del cases["c"]
    outcome = field_study.run((), {}, None, {}, cases=cases, root=str(tmp_path), folder="cases")
    assert "2 of 2 cases" in str(vars(outcome)) and "not:" not in str(vars(outcome))


def test_a_command_without_end_is_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr(field_study, "_MAX_SECONDS", 1)
    (tmp_path / "run.py").write_text("import time; time.sleep(60)")
    text, code = field_study.run_command(tmp_path, "python run.py", tmp_path / "out")
    assert (text, code) == ("no end after 1 s", -1)


def test_other_commands_are_those_of_dhtorch(tmp_path):
    text, code = field_study.run_command(tmp_path, "inspect nothing-there", tmp_path / "out")
    assert code == 2 and "nothing-there" in text
