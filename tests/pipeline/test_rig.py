"""Several cameras at one instant: rigs as recordings, their pairs, one pose for all instants."""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from support.box_scene import CAMERA, HW, pose, render
from support.writers import write_lerobot
from torch import Tensor

from dhtorch import data
from dhtorch.codes import PoseCode
from dhtorch.data.io.decode import FormatError
from dhtorch.data.pairs import by_cameras, spaced_frames
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.rig import Rig, join_cameras, open_rig
from dhtorch.geometry import covariance, se3
from dhtorch.geometry.pose_averaging import average_poses
from dhtorch.pipeline.presets import MAP, PAPER
from dhtorch.pipeline.rig import ConstantPose, estimate_rig_pose
from dhtorch.pytree import collate
from dhtorch.records import Frame, Pose
from dhtorch.synthetic import two_cameras
from dhtorch.transforms import ExtendDepth

TRUE = se3.invert(two_cameras._two_camera_pose(0.15, 3.0))


@cache
def robot() -> Rig:
    (scene,) = two_cameras.open_two_cameras(n_frames=6, hw=(144, 192), depth_hw=(72, 96), supersample=1)
    assert isinstance(scene.recording, Rig) and scene.near == 2.0
    return scene.recording


def cameras(which: int) -> Frame:
    return collate(robot()[i] for i in range(which, len(robot()), 2))


def one(name: str, stamps: list[float] | None, places: list[int], value: int = 0) -> Recording:
    frame = Frame(torch.full((1, 1, 4, 4), value, dtype=torch.uint8), torch.zeros(1, 4, 4), CAMERA)
    times = None if stamps is None else torch.tensor(stamps, dtype=torch.float64)
    return Recording(name=name, format="x", load=lambda i: frame, number=torch.tensor(places), times=times)


# ---------------------------------------------------------------------------------------------------- one recording


def test_frames_of_one_instant_stand_together() -> None:
    a, b = one("car/a", [0.0, 0.1, 0.2, 0.3], [0, 1, 2, 3], 1), one("car/b", [0.11, 0.19, 0.4], [5, 6, 9], 2)
    rig = join_cameras([a, b])
    assert rig.name == "car" and rig.cameras == ("a", "b") and len(rig) == 4
    assert rig.times is not None and rig.times.tolist() == [0.1, 0.11, 0.2, 0.19]
    assert rig.camera.tolist() == [0, 1, 0, 1] and rig.instant.tolist() == [0, 0, 1, 1]
    assert [int(frame.image[0, 0, 0, 0]) for frame in rig] == [1, 2, 1, 2]
    assert [float(frame.time[0]) for frame in rig] == [0.1, 0.11, 0.2, 0.19]
    assert any("car/a: 2 frames without a common instant" in line for line in rig.report)
    assert len(join_cameras([a, b], tolerance=0.02)) == 4 and not isinstance(rig, TruthRecording)
    with pytest.raises(FormatError, match="no instant common to all cameras"):
        join_cameras([a, b], tolerance=0.001)
    by_number = join_cameras([one("car/a", None, [1, 2, 4]), one("car/b", [0.0, 1.0, 2.0], [2, 3, 4])])
    assert by_number.times is None and by_number.number.tolist() == [4, 5, 8, 9]
    for wrong in ([a], [a, a], []):
        with pytest.raises(FormatError, match="two or more cameras of different names"):
            join_cameras(wrong)
    folder = Path("a folder")
    for recording, where in ((a, "car/a"), (dataclasses.replace(a, root=folder), "a folder")):
        with pytest.raises(FormatError, match=f"^{where}: cameras: found a, expected"):
            join_cameras([recording])


def test_a_frame_belongs_to_one_instant() -> None:
    slow, fast = one("car/a", [0.0, 1.0], [0, 1]), one("car/b", [k / 10 for k in range(11)], list(range(11)))
    assert join_cameras([slow, fast]).times.tolist() == [0, 0, 1, 1]  # type: ignore[union-attr]
    assert join_cameras([fast, slow], tolerance=0.3).times.tolist() == [0, 0, 1, 1]  # type: ignore[union-attr]


def test_cameras_of_a_data_set(tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    shots = [[render(CAMERA, pose(i), HW, i / 30) for i in range(3)]]
    write_lerobot(tmp_path, shots, image="image", depth="png")
    with pytest.raises(FormatError, match="expected two or more cameras of one scene"):
        open_rig(tmp_path)
    assert data.open(tmp_path).name.endswith("/front")


def test_the_truth_of_a_rig_is_that_of_its_cameras() -> None:
    rig = robot()
    assert isinstance(rig, TruthRecording) and rig.poses is not None
    T = se3.relative(rig.poses[2:3], rig.poses[3:4])
    torch.testing.assert_close(T.t, TRUE.t, atol=1e-12, rtol=0)
    assert not torch.equal(rig[2].camera.f, rig[3].camera.f)
    assert not torch.equal(rig.truth(2)["depth"], rig.truth(3)["depth"])


# ---------------------------------------------------------------------------------------------------- pairs


def test_pairs_in_space_and_in_time() -> None:
    rig = robot()
    assert [tuple(p) for p in by_cameras(rig)][:3] == [(0, 1), (1, 0), (2, 3)]
    assert [tuple(p) for p in by_cameras(rig, reference="left")] == [(2 * k, 2 * k + 1) for k in range(6)]
    mixed = by_cameras(rig, instants=[0, 1], reference="right", stride=2)
    assert [tuple(p) for p in mixed] == [(1, (0, 2, 3)), (5, (2, 3, 4, 6, 7)), (9, (6, 7, 8, 10, 11))]
    past = by_cameras(rig, instants=[0, 2], reference="left", past=True)
    assert tuple(past[0]) == (0, 1) and tuple(past[3]) == (6, (2, 3, 7))
    assert spaced_frames(1, 0, 1) == [0]
    for options, said in (
        ({"reference": "head"}, "expected one of left, right"),
        ({"instants": []}, "pairs.instants"),
        ({"instants": [-1]}, "pairs.instants"),
        ({"stride": 0}, "pairs.stride"),
        ({"instants": [9]}, "expected at least one pair"),
    ):
        with pytest.raises(ValueError, match=said):
            by_cameras(rig, **options)
    with pytest.raises(ValueError, match="is one camera"):
        by_cameras(one("car/a", None, [0, 1]))


# ---------------------------------------------------------------------------------------------------- one pose


def measured(B: int, V: int, sigma: Tensor, seed: int = 0) -> tuple[Pose, Pose, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    T = se3.exp(torch.randn(B, 6, generator=draw, dtype=torch.float64))
    noise = torch.randn(B * V, 6, generator=draw, dtype=torch.float64) * sigma
    each = se3.compose(se3.exp(noise), T.map(lambda x: x.repeat_interleave(V, 0)))
    cov = torch.diag(sigma**2).expand(B, V, 6, 6)
    return T, each.map(lambda x: x.unflatten(0, (B, V))), cov


SIGMA = torch.tensor([0.002] * 3 + [0.005] * 3, dtype=torch.float64)


def test_the_mean_is_as_good_as_its_covariance_says() -> None:
    T, each, cov = measured(200, 12, SIGMA)
    found = average_poses(each, cov, torch.ones(200, 12, dtype=torch.bool))
    assert found.ok.all() and found.agree.float().mean() > 0.99
    xi = se3.log(se3.compose(found.T, se3.invert(T)))
    z = xi / found.cov.diagonal(dim1=1, dim2=2).sqrt()
    assert 0.62 < (z.abs() < 1).float().mean() < 0.80 and (z.abs() < 4).all()
    bold = average_poses(each, cov / 25, torch.ones(200, 12, dtype=torch.bool))
    torch.testing.assert_close(bold.scale.mean(), torch.tensor(5.0, dtype=torch.float64), atol=0.5, rtol=0)


def test_wrong_measurements_do_not_count() -> None:
    _, each, cov = measured(20, 12, SIGMA)
    valid = torch.ones(20, 12, dtype=torch.bool)
    valid[:, 11] = False
    t = each.t.clone()
    t[:, :3] += torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.3
    t[:, 11] = torch.nan
    found = average_poses(Pose(each.R, t), cov, valid)
    assert found.ok.all() and not found.agree[:, :3].any() and not found.agree[:, 11].any()
    clean = average_poses(each, cov, valid & (torch.arange(12) > 2))
    torch.testing.assert_close(found.T.t, clean.T.t, atol=1e-3, rtol=0)


def test_a_rig_that_is_not_rigid_has_no_pose() -> None:
    _, each, cov = measured(5, 10, SIGMA)
    t = each.t.clone()
    t[:, 5:] += 0.2
    valid = torch.ones(5, 10, dtype=torch.bool)
    found = average_poses(Pose(each.R, t), cov, valid)
    assert not found.ok.any() and found.T.t.isnan().all() and found.cov.isnan().all()
    _, wild, cov = measured(5, 10, 60 * SIGMA, seed=3)
    assert not average_poses(wild, cov / 3600, valid).ok.any(), "what scatters sixtyfold is no one motion"
    assert not average_poses(each, cov, valid & (torch.arange(10) < 1)).ok.any()
    assert not average_poses(each, cov, torch.zeros_like(valid)).ok.any()
    with pytest.raises(ValueError, match="no measurement"):
        average_poses(each[:, :0], cov[:, :0], valid[:, :0])


@pytest.mark.slow
def test_a_robots_cameras_are_measured_once() -> None:
    left, right = cameras(0), cameras(1)
    found = estimate_rig_pose(left, right, method=MAP.replace(n=400))
    xi = se3.log(se3.compose(found.T.to(torch.float64), se3.invert(TRUE)))[0]
    assert found.ok.all() and found.agree.float().mean() > 0.6
    assert xi[:3].norm() < 0.003 and xi[3:].norm() < 0.006, "0.15 m apart"
    off = covariance.mahalanobis(xi[None], found.cov.to(torch.float64))
    assert off < 4.74, "one rig in a thousand"
    surer = estimate_rig_pose(left, right, method=MAP.replace(n=400), places=3)
    share = found.agree.sum() / (found.agree.sum() / 3).clamp_min(1)
    torch.testing.assert_close(found.cov / share, surer.cov, rtol=1e-4, atol=0)
    with pytest.raises(ValueError, match="places is 0"):
        estimate_rig_pose(left, right, places=0)
    trace: dict[str, Any] = {}
    given = PAPER.replace(n=300, pose_prior=ConstantPose(found.T, found.cov))
    estimate = given(left, right, trace=trace)
    assert (trace["fit"].code == PoseCode.OK).all() and estimate.keep.float().mean() > 0.5
    assert torch.equal(trace["fit"].T_1_from_0.t, found.T.t.expand(6, 3))
    given(right, left, trace=trace)
    assert (trace["fit"].code == PoseCode.REFUTED).all()


def test_a_sample_of_two_cameras_under_a_calibration() -> None:
    left, right = robot()[0], robot()[1]
    sample = {
        "left": left.image[0],
        "right": right.image[0],
        "depth": left.depth[0],
        "K_left": torch.cat((left.camera.f, left.camera.c), 1)[0],
        "K_right": torch.cat((right.camera.f, right.camera.c), 1)[0],
    }
    keys: dict[str, Any] = {"image": "left", "other_image": "right", "intrinsics": "K_left"}
    keys |= {"other_intrinsics": "K_right", "depth_unit": "m", "n": 300}
    matrix = se3.to_matrix(TRUE)[0].tolist()
    fixed = ExtendDepth(**keys, pose=matrix, pose_kind="1_from_0", pose_cov=(0.001, 0.002))(sample)
    assert fixed is not None and fixed["dhtorch.pose_ok"]
    torch.testing.assert_close(fixed["dhtorch.T_1_from_0"], se3.to_matrix(TRUE)[0].float(), atol=1e-6, rtol=0)
    free = ExtendDepth(**keys)(sample)
    assert free is not None and free["dhtorch.pose_ok"] and "dhtorch.pose_convention" not in free
    for wrong in ({"pose": matrix}, {"pose": [[1.0]], "pose_kind": "1_from_0"}, {"pose": 3, "pose_kind": "1_from_0"}):
        with pytest.raises(ValueError, match="pose: found"):
            ExtendDepth(**keys, **{"other_pose": "x"} | wrong)
