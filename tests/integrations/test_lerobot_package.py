"""integrations/lerobot without LeRobot: its name, its window of frames, and what the client suite ran."""

import ast
import importlib.util
import json
import tomllib
from pathlib import Path

import pytest
import torch

from dhtorch import ExtendDepth

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "integrations" / "lerobot"
NAME = "lerobot_camera_dhtorch"


@pytest.fixture(scope="module")
def window():
    """The module of the window, which imports no LeRobot."""
    spec = importlib.util.spec_from_file_location("window", PACKAGE / NAME / "window.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_lerobot_finds_the_distribution_by_its_name_and_imports_it():
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())
    assert project["project"]["name"] == NAME and project["tool"]["setuptools"]["packages"] == [NAME]
    assert (PACKAGE / NAME / "__init__.py").is_file()
    files = {file.stem for file in (PACKAGE / NAME).glob("*.py")}
    used = {
        node.module.removeprefix(f"{NAME}.")
        for file in (PACKAGE / NAME).glob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(NAME)
    }
    assert used <= files


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_windows_of_a_running_episode_are_those_of_a_loader(window, gap):
    frames = torch.arange(12.0).reshape(6, 2)
    stream = window.FrameWindow(gap)
    for start, stop in ((0, 4), (4, 6)):
        for i in range(start, stop):
            images, depths, is_pad = stream.push(frames[i], 10 * frames[i])
            earlier = max(i - gap, start)  # LeRobot's: held at the first frame of the episode, and marked
            assert torch.equal(images, frames[[earlier, i]]) and torch.equal(depths, 10 * images)
            assert is_pad.tolist() == [i - gap < start, False]
        stream.reset()


def test_state_is_the_past_and_a_buffer_that_is_filled_anew_does_not_change_it(window):
    first, buffer = window.FrameWindow(2), torch.zeros(3)
    assert first.state_dict() == {}
    for value in (1.0, 2.0, 3.0):
        first.push(buffer.fill_(value), buffer)
    second = window.FrameWindow(2)
    second.load_state_dict(first.state_dict())
    images, _, is_pad = second.push(buffer.fill_(4.0), buffer)
    assert images[:, 0].tolist() == [2.0, 4.0] and not is_pad.any()
    second.load_state_dict({})
    assert second.push(buffer, buffer)[2].tolist() == [True, False]
    with pytest.raises(ValueError, match="at least 1"):
        window.FrameWindow(0)


def test_blank_columns_have_the_shapes_of_a_sample():
    transform = ExtendDepth(depth_unit="m", n=32, dense={"size": 40}, batched=False)
    K = torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]])
    sample = {"image": torch.rand(3, 60, 80), "depth": torch.ones(30, 40), "intrinsics": K}
    blank = transform.blank_columns((60, 80))
    out = transform(sample)
    assert {f"dhtorch.{key}": x.shape[1:] for key, x in blank.items()} == {
        key: x.shape for key, x in out.items() if key not in sample
    }


def test_every_test_of_the_package_has_a_row_and_none_failed():
    rows = json.loads((ROOT / "benchmarks" / "results" / "lerobot_plugin.json").read_text())
    functions = {
        f"{file.stem}.{node.name}"
        for file in (PACKAGE / "tests").glob("test_*.py")
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }
    for version in {row["lerobot"] for row in rows}:
        ran = {row["test"].partition("[")[0]: row["passed"] for row in rows if row["lerobot"] == version}
        assert set(ran) in (functions, {"all"}) and False not in ran.values()
