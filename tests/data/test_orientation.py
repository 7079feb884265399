"""Orientation of depth beside its picture: symmetries, and their scores on real captures and the built-in room."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data import orientation
from dhtorch.synthetic import SyntheticRoom

ROOT = os.environ.get("DHTORCH_DATA")
#: Capture → least number of its six frames in which the stored orientation wins alone.
CAPTURES = {
    "holo_a": 5,
    "holo_stream": 4,
    "7s_redkitchen_000": 6,
    "7s_redkitchen_200": 6,
    "7s_redkitchen_400": 6,
    "7s_redkitchen_600": 6,
    "tum_fr1_desk9": 6,
    "tum_fr1_rpy_a": 6,
    "r3d_door": 6,
    "slambook_rgbd": 5,
}


def some(recording: data.Recording, n: int = 6) -> list[tuple[Tensor, Tensor]]:
    places = np.unique(np.linspace(0, len(recording) - 1, n).round().astype(int)).tolist()
    return [(recording[i].image[0], recording[i].depth[0]) for i in places]


@pytest.mark.data
@pytest.mark.skipif(ROOT is None, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize("capture", CAPTURES)
def test_the_stored_orientation_of_sound_captures_wins(capture: str) -> None:
    frames = some(data.open(Path(str(ROOT)) / capture))
    scores = torch.stack([orientation.orientation_scores(image, depth) for image, depth in frames])
    assert int((scores.argmax(1) == 0).sum()) >= CAPTURES[capture]
    assert int(scores.mean(0).argmax()) == 0
    assert orientation.select_symmetry(frames)[0] in (0, None)


@pytest.mark.parametrize("k", range(8))
def test_the_symmetry_that_undoes_a_planted_one_is_selected(k: int) -> None:
    room = SyntheticRoom(n_frames=3, hw=(240, 320))
    planted = [(room[i].image[0], orientation.apply_symmetry(room[i].depth[0], k)) for i in range(3)]
    inverse = k if k >= 4 else -k % 4
    selected, scores = orientation.select_symmetry(planted)
    assert selected == inverse
    assert scores.shape == (8,)
    assert float(scores.abs().max()) <= 1


def test_symmetries_are_the_eight_of_a_rectangle() -> None:
    x = torch.arange(6.0).reshape(2, 3)
    images = {tuple(orientation.apply_symmetry(x, k).flatten().tolist()) for k in range(8)}
    assert len(images) == 8
    assert torch.equal(orientation.apply_symmetry(x, 6), x.flip(-2))
    assert torch.equal(orientation.apply_symmetry(x, 1)[0], torch.tensor([3.0, 0.0]))  # clockwise: left column on top


def test_a_map_without_edges_decides_nothing() -> None:
    image = torch.rand(1, 60, 80, generator=torch.Generator().manual_seed(0))
    selected, scores = orientation.select_symmetry([(image, torch.ones(60, 80)), (image, torch.zeros(60, 80))])
    assert selected is None
    assert torch.equal(scores, torch.zeros(8, dtype=torch.float64))
