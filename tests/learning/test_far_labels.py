"""Far labels for a network, with short settings: what is hidden, what is held out, what each variant learns from."""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from dhtorch import MAP
from dhtorch.pytree import collate
from dhtorch.synthetic import open_room

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "learning"))

import far_labels

VARIANTS = far_labels.VARIANTS


@pytest.fixture(scope="module")
def study():
    room = open_room(seed=0, n_frames=8, hw=(96, 128), supersample=1, step_m=0.06, gap=2)
    return far_labels.Study([room], MAP, block=2)


@pytest.fixture(scope="module")
def labelled(study):
    return far_labels.label_scene(study, study.scenes[0], n=256)


def made_up_frames(n=6):
    """Pictures whose left half is dark and 1 m away, with returns, and whose right half is bright, 3 m away, answered."""
    g = torch.Generator().manual_seed(0)
    bright = (torch.arange(32) >= 16).float().expand(1, 3, 24, 32)
    frames = []
    for _ in range(n):
        xy = torch.rand(1, 200, 2, generator=g) * 1.8 - 0.9
        far = xy[..., 0] > 0
        depth = torch.where(far, 3.0, 1.0)
        image = 0.6 * bright + 0.2 + 0.05 * torch.rand(1, 3, 24, 32, generator=g)
        frames.append(far_labels.Labels(image, xy, depth, 0.02 * depth, far, depth, far))
    return frames


def test_held_out_frames_are_neither_labelled_nor_source_views(study):
    training, held_out = far_labels.split_frames(8, study.block)
    assert sorted(training + held_out) == list(range(8)) and held_out == [4, 5]
    for method in (study.method, far_labels.AUTO):
        for i in training:
            views = far_labels.source_views(study.scenes[0], method, i, training)
            assert views and set(views) <= set(training) - {i}


def test_every_variant_has_its_own_labels(labelled):
    labels = collate(labelled[0])
    depth, sigma = {}, {}
    for variant in VARIANTS:
        depth[variant], sigma[variant] = far_labels.targets(labels, variant)
    assert (depth["near"][labels.recovered] == 0).all()
    assert (depth["near"][~labels.recovered] == labels.depth[~labels.recovered]).all()
    assert (depth["far"] == labels.depth).all() and (depth["unweighted"] == labels.depth).all()
    assert (depth["truth"][labels.far] == labels.truth[labels.far]).all()
    used = labels.depth > 0
    assert (sigma["far"][used] > sigma["unweighted"][used]).all()
    relative = sigma["unweighted"][used] / labels.depth[used]
    torch.testing.assert_close(relative, torch.full_like(relative, far_labels.NETWORK_ERROR))


def test_far_labels_teach_what_near_ones_do_not():
    frames = made_up_frames()
    errors = {}
    for variant in ("near", "far"):
        network = far_labels.train(frames, variant, 0, steps=40)
        errors[variant] = torch.tensor(far_labels.frame_errors(network, frames)).mean(0)
    assert errors["far"][0] < 0.15 < 0.3 < errors["near"][0]
    assert errors["near"][1] < 0.15 and errors["far"][1] < 0.15


def test_the_far_labels_script(monkeypatch, tmp_path, study, labelled, capsys):
    monkeypatch.setattr(far_labels, "open_study", lambda _name: study)
    monkeypatch.setattr(far_labels, "label_scene", lambda *_: labelled)
    monkeypatch.setattr(far_labels, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    monkeypatch.setattr(sys, "argv", ["far_labels.py", "--steps", "2", "--json", str(tmp_path / "result.json")])
    far_labels.main()
    (row,) = json.loads((tmp_path / "result.json").read_text())
    assert row["held_out_frames"] == 2 and row["training_frames"] == 6
    assert row["near.far_ratio"]["value"] == 1 and row["constant.far_error"]["value"] > 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*VARIANTS, "constant"))
