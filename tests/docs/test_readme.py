"""README and the pages say what the result files say, and README's examples print what stands under them."""

import re
import sys
import tomllib
import types
from pathlib import Path

import pytest
import torch
from torch.utils.data import Dataset

from dhtorch.runtime import results as result_files
from dhtorch.transforms import TOKEN_CHANNELS

REPO = Path(__file__).resolve().parents[2]
sys.path.append(str(REPO / "benchmarks"))

import readme  # noqa: E402
import sweep  # noqa: E402

README = (REPO / "README.md").read_text()


def test_tables_are_those_of_the_result_files(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["readme.py", "--check"])
    assert readme.main() == 0, "run: python benchmarks/readme.py"


@pytest.mark.parametrize("name", readme.reproduce.EXPERIMENTS)
def test_committed_results_are_valid(name):
    result_files.read_result(REPO / f"benchmarks/results/{name}.json")


class Shifted(Dataset):
    """Items as LeRobot hands them out: noise that moves, and a wall 2 m away."""

    def __init__(self, name):
        wide = torch.nn.functional.avg_pool2d(torch.rand(1, 3, 480, 720, generator=torch.manual_seed(0)), 5, 1, 2)[0]
        self.name, self.wide = name, wide
        depth = {"dtype": "image", "info": {"is_depth_map": True, "depth_unit": "m"}}
        self.meta = types.SimpleNamespace(features={"observation.images.front_depth": depth})

    def __len__(self):
        return 8

    def __getitem__(self, i):
        return {
            "observation.images.front": self.wide[:, :, 3 * i : 3 * i + 640],
            "observation.images.front_depth": torch.full((1, 480, 640), 2.0),
            "action": torch.zeros(7),
            "episode_index": torch.tensor(0),
        }


def examples():
    """(code, what it prints) of README, in its order."""
    found = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README, re.DOTALL)
    assert len(found) == len(re.findall("```python", README)) == 2
    return found


def test_the_twelve_lines_run(capsys):
    code, said = examples()[0]
    assert len(code.strip().splitlines()) <= 12
    assert "SyntheticRoom()" in code
    smaller = code.replace("SyntheticRoom()", "SyntheticRoom(hw=(120, 160), supersample=1)")  # seconds, not a minute
    exec(compile(smaller, "README.md", "exec"), {})
    words = re.sub(r"[\d.]+", "N", capsys.readouterr().out)
    assert words == re.sub(r"[\d.]+", "N", said)


@pytest.mark.slow
def test_the_twelve_lines_say_what_stands_under_them(capsys):
    code, said = examples()[0]
    exec(compile(code, "README.md", "exec"), {})
    found, told = ([float(x) for x in re.findall(r"[\d.]*\d", text)] for text in (capsys.readouterr().out, said))
    assert found == pytest.approx(told, rel=0.03)


def test_the_loader_s_example_prints_what_stands_under_it(capsys, monkeypatch):
    code, said = examples()[1]
    name = re.search(r"^from (lerobot\S*) import LeRobotDataset$", code, re.M)[1]
    pieces = name.split(".")
    for k in range(1, len(pieces) + 1):
        monkeypatch.setitem(sys.modules, ".".join(pieces[:k]), types.ModuleType(".".join(pieces[:k])))
    sys.modules[name].LeRobotDataset = Shifted
    smaller = code.replace("num_workers=2, worker_init_fn=one_thread", "num_workers=0")
    assert smaller != code
    exec(compile(smaller, "README.md", "exec"), {})
    assert capsys.readouterr().out == said
    assert (
        len(TOKEN_CHANNELS) == 10 and all(f"`{name}`" in README for name in TOKEN_CHANNELS) and "ten channels" in README
    )


def test_the_sweep_that_is_shown_is_the_one_that_was_run():
    assert f"`{sweep.COMMAND}`" in (REPO / "docs" / "pipelines.md").read_text()


def test_commands_are_those_of_the_program():
    """Choices of groups are files of conf/, extras are those of the package."""
    for group, name in re.findall(r"\b(data|method|experiment|launch)=([a-z]\w*)\b", README):
        assert (REPO / "conf" / group / f"{name}.yaml").is_file(), f"{group}={name}"
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = re.findall(r"pip install (?:-e )?'\.\[([\w,]+)\]'", README)
    assert all(extra in project for extras in asked for extra in extras.split(","))


def test_every_table_stands_on_a_page():
    shown = {name for page in readme.pages() for name in readme.MARKER.findall(page.read_text())}
    assert set(readme.TABLES) <= shown
    with pytest.raises(ValueError, match="wishes"):
        readme.maker("wishes")


def test_links_and_names_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (REPO / target).exists(), target
    for name in re.findall(r"`(stages\.[\w.]+)`", README):
        module, _, function = f"dhtorch.{name}".rpartition(".")
        assert hasattr(__import__(module, fromlist=["x"]), function), name
    for file in re.findall(r"`((?:conf|dhtorch|notebooks|benchmarks)/[\w/.]+)`", README):
        assert (REPO / file).exists(), file
