"""Poses from elsewhere on real captures: true ones are used, wrong ones refuted and called by their name."""

import os
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dhtorch import data
from dhtorch.codes import PoseCode
from dhtorch.geometry import se3
from dhtorch.geometry.pose_conventions import CONVENTIONS
from dhtorch.pipeline.presets import MAP
from dhtorch.pytree import collate
from dhtorch.records import Frame, Pose
from dhtorch.stages import pose_prior

ROOT = Path(os.environ.get("DHTORCH_DATA", "/nowhere"))
GL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))

#: Set → frames between two views, cutoff in m, reference views, frames by which a trajectory is late.
SETS = {"holo_a": (3, 2.5, (0, 12), 3), "tum_fr1_desk9": (4, 1.0, (0, 2), -2), "r3d_door": (10, 9.0, (5, 10), 10)}


def views(name: str) -> tuple[Frame, Frame, Frame, Frame, float]:
    """Reference views and others with returns up to the cutoff, the frames whose poses a late trajectory has, reference views whole."""
    gap, near, at, late = SETS[name]
    recording = data.open(ROOT / name)
    whole = collate(recording[i] for i in at)
    others, later = (collate(recording[i + gap + d] for i in at) for d in (0, late))
    cut = [f.replace(depth=torch.where(f.depth <= near, f.depth, 0.0)) for f in (whole, others)]
    return cut[0], cut[1], later, whole, near


def world(frame: Frame) -> Tensor:
    assert frame.T_world_from_cam is not None
    return se3.to_matrix(frame.T_world_from_cam).double()


def asked(reference: Frame, others: Frame, poses: tuple[Tensor, Tensor], **options):
    """Estimate and fit under poses that a data set would state so."""
    motion = pose_prior.relative_prior(*(Pose(M[:, :3, :3], M[:, :3, 3]) for M in poses), **options).to(torch.float32)
    trace: dict = {}
    return MAP.replace(n=1000)(reference, others, fit=motion, trace=trace), trace["fit"]


def error(estimate, whole: Frame, near: float) -> float:
    """Median relative error of answers whose return was held back."""
    uv = estimate.uv.round().long()
    true = torch.stack([z[p[:, 1], p[:, 0]] for z, p in zip(whole.depth, uv, strict=True)])
    far = estimate.keep & (true > near)
    assert far.sum() >= 10
    return float(((estimate.depth - true).abs() / true)[far].median())


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", ["holo_a", *(pytest.param(s, marks=pytest.mark.slow) for s in SETS if s != "holo_a")])
def test_true_poses_are_used_and_wrong_ones_named(name: str) -> None:
    if not (ROOT / name).is_dir():
        pytest.skip(f"DHTORCH_DATA has no {name}")
    reference, others, later, whole, near = views(name)
    T_0, T_1 = world(reference), world(others)
    estimate, fit = asked(reference, others, (T_0, T_1))
    assert fit.ok.any() and (fit.code != PoseCode.REFUTED).all(), "true"
    if name == "holo_a":
        assert error(estimate, whole, near) < 0.1
    thousand = torch.tensor([1.0, 1.0, 1.0, 1000.0], dtype=torch.float64)
    wrong = {
        "OpenGL axes (x right, y up, z backward)": (T_0 @ GL, T_1 @ GL),
        "the inverse": (torch.linalg.inv(T_0), torch.linalg.inv(T_1)),
        "millimetres": (T_0 * thousand, T_1 * thousand),
        "": (T_0, world(later)),  # late: no convention
    }
    for said, poses in wrong.items():
        estimate, fit = asked(reference, others, poses)
        assert (fit.code == PoseCode.REFUTED).all() and not estimate.keep.any(), said or "late"
        looks = [CONVENTIONS[i] for i in fit.matched_convention.tolist()]
        assert said in looks if said else set(looks) == {""}, looks
