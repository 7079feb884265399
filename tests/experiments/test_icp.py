"""ICP with known motion: dense clouds against a brute-force search, sparse sets, and sets that cannot be registered."""

import math

import pytest
import torch
from support.paper_protocol_runs import configured_method, small_room
from support.rooms import Changed

from dhtorch.experiments.negative import icp as experiment
from dhtorch.experiments.negative.icp import estimate_normals, register_icp
from dhtorch.experiments.protocol import Settings
from dhtorch.geometry import se3
from dhtorch.records import Pose

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def surface(n, seed=0, noise=0.0):
    """Points (1, n, 3) of a bumpy surface in front of a camera, drawn at random."""
    generator = torch.Generator().manual_seed(seed)
    xy = 2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1
    x, y = xy.unbind(-1)
    z = 2.5 + 0.3 * (2.1 * x).sin() * (1.7 * y + 0.4).cos() + 0.25 * (3.1 * y + x).sin() + 0.15 * x
    noise = noise * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return torch.stack((x, y, z), -1)[None] + noise


def off(found, true):
    """Angle (degrees) and distance (m) between two motions."""
    return math.degrees(float(se3.rotation_angle(found.R @ true.R.mT)[0])), float((found.t - true.t).norm())


def oracle(x, q, T, iterations, reach):
    """The textbook: nearest by brute force, closed-form alignment by SVD of what lies within reach."""
    for _ in range(iterations):
        Y = x @ T.R[0].T + T.t[0]
        distance, index = (Y[:, None] - q[None]).norm(dim=-1).min(-1)
        a, b = x[distance < reach], q[index[distance < reach]]
        U, _, Vt = torch.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        D = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(Vt.T @ U.T))]).double())
        R = Vt.T @ D @ U.T
        T = Pose(R[None], (b.mean(0) - R @ a.mean(0))[None])
    return T


TRUE = se3.exp(torch.tensor([[0.03, -0.05, 0.02, 0.06, -0.04, 0.05]]).double())
START = se3.identity(1, torch.zeros(1).double())


def test_the_same_points_are_brought_back_exactly():
    q = surface(900)
    x = se3.apply(se3.invert(TRUE), q)
    for planes in (None, estimate_normals(q)):
        found = register_icp(x, q, START, normals_1=planes)
        angle, distance = off(found.T_1_from_0, TRUE)
        assert angle < 1e-3 and distance < 1e-5 and bool(found.ok) and float(found.inlier_share) == 1
        assert float(found.rms_m) < 1e-5 and 0 < float(found.condition) <= 1


def test_points_agree_with_the_textbook_on_dense_clouds():
    q, x = surface(1200, 1), se3.apply(se3.invert(TRUE), surface(600, 2))
    found = register_icp(x, q, START, reach_m=0.2, least_reach_m=0.2, keep=1.0, iterations=40)
    expected = oracle(x[0], q[0], START, 40, 0.2)
    angle, distance = off(found.T_1_from_0, expected)
    assert angle < 0.01 and distance < 2e-4, "the same fixed point"
    angle, distance = off(found.T_1_from_0, TRUE)
    assert angle < 1 and distance < 0.02


def test_planes_forgive_other_samples_of_the_same_surface():
    q, x = surface(1200, 1, 0.002), se3.apply(se3.invert(TRUE), surface(700, 2, 0.002))
    point, plane = (register_icp(x, q, START, normals_1=m) for m in (None, estimate_normals(q)))
    worse, better = off(point.T_1_from_0, TRUE), off(plane.T_1_from_0, TRUE)
    assert better[1] < 0.004 and better[0] < 0.2
    assert worse[1] > 2 * better[1] and float(point.rms_m) > 2 * float(plane.rms_m), "nearest is not the same point"


def test_masked_points_and_batch_mates_change_nothing():
    q, x = surface(400, 1).float(), surface(300, 2).float()
    hole = torch.full((1, 60, 3), torch.nan)
    alone = register_icp(x, q, START.to(torch.float32))
    padded = register_icp(torch.cat((x, hole), 1), torch.cat((hole, q), 1), START.to(torch.float32))
    for field in ("rms_m", "inlier_share", "condition"):
        torch.testing.assert_close(getattr(alone, field), getattr(padded, field))
    torch.testing.assert_close(alone.T_1_from_0.t, padded.T_1_from_0.t)
    assert not bool(padded.matched[:, 300:].any()) and torch.equal(padded.matched[:, :300], alone.matched)


def test_trimming_survives_what_the_other_view_does_not_show():
    q = surface(900)
    x = se3.apply(se3.invert(TRUE), q)
    x[:, :150, 2] += 0.15  # something stands in front
    kept, all_of_them = (register_icp(x, q, START, keep=k, least_reach_m=0.25) for k in (0.8, 1.0))
    assert off(kept.T_1_from_0, TRUE)[1] < 0.005 < off(all_of_them.T_1_from_0, TRUE)[1]


def test_normals_of_a_known_plane_face_the_camera():
    true = torch.tensor([0.3, -0.2, -1.0]).double()
    true = true / true.norm()
    q = surface(500)
    q[..., 2] = 2.5 - (true[0] * q[..., 0] + true[1] * q[..., 1]) / true[2]
    q[:, 7] = torch.nan
    found = estimate_normals(q)
    assert bool(found[:, 7].isnan().all()) and bool((found[:, 8:] @ true > 0.99999).all())
    cloud = torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0)) + 1
    assert float(estimate_normals(cloud).isnan().any(-1).float().mean()) > 0.5, "no plane in a fog"


def test_what_cannot_be_registered_is_flagged():
    q = surface(50)
    nothing = torch.full((1, 40, 3), torch.nan).double()
    start = se3.exp(torch.tensor([[0.1, 0, 0, 0.2, 0, 0]]).double())
    for x, y, T in ((nothing, q, start), (q, nothing, start), (q, q + 10, start), (q[:, :4], q, START)):
        found = register_icp(x, y, T)
        assert not bool(found.ok) and torch.equal(found.T_1_from_0.t, T.t)
        assert bool(found.inlier_share.isfinite()) and bool(found.condition.isfinite())
    flat = surface(600)
    flat[..., 2] = 2.0
    wall, bumpy = (register_icp(x, x, START, normals_1=estimate_normals(x)) for x in (flat, surface(600)))
    assert not bool(wall.ok) and float(wall.condition) < 1e-9, "a wall leaves three directions open"
    assert float(bumpy.condition) > 1e-4
    lost = Pose(START.R * torch.nan, START.t)
    assert not bool(register_icp(q, q, lost).ok)


def asked(*recordings, **options):
    return experiment.run(
        list(recordings), {"paper": configured_method()}, None, Settings(), **{"n": 300, "links": 3, **options}
    )


def test_the_exact_pose_cannot_be_improved_and_no_pose_can():
    outcome = asked(small_room(lidar="exact", path="lateral", step_m=0.04), poor_deg=4.0, n=500, min_inlier_share=0.2)
    found = {v: outcome.scenes(v, "trajectory")["synthetic_room"] for v in experiment.VARIANTS}
    assert found["good"]["drift_rel"] < 1e-9 and found["good"]["right_share"] == 1
    assert found["good + icp points"]["drift_rel"] > 0.001 and found["good + icp points"]["right_share"] < 1
    assert found["poor"]["rotation_deg"] == pytest.approx(4.0, abs=1e-6)
    assert found["poor + icp points"]["rotation_deg"] < 2.5
    assert found["none + icp points"]["drift_rel"] < found["none"]["drift_rel"]
    assert all(found[v]["n_voxels"] == found[v]["n_voxels_all"] for v in experiment.ICP_POSE_SOURCES)
    assert len([r for r in outcome.rows if r["pair"] is not None]) == 9 * 2


def test_links_without_confidence_leave_the_map_and_keep_the_pose():
    recording = small_room(lidar="exact")
    outcome = asked(recording, min_inlier_share=1.01)
    found = {v: outcome.scenes(v, "trajectory")["synthetic_room"] for v in experiment.VARIANTS}
    alone, refined = found["good"], found["good + icp points"]
    assert refined["confident_share"] == 0 and refined["drift_rel"] < 1e-9
    assert refined["n_voxels"] < alone["n_voxels"] == refined["n_voxels_all"]
    assert refined["voxels_vs_pose"] == refined["n_voxels"] / alone["n_voxels"] and alone["voxels_vs_pose"] == 1
    assert outcome.verdict == "refuted", "without confidence nothing is gained where there is no pose"


def test_a_scene_without_trajectory_or_depth_has_no_answer():
    blind, empty = Changed(small_room(), poses=None), small_room(lidar=None)
    assert experiment.verdict(asked(blind))[0] is None
    silent = asked(empty)
    assert silent.verdict == "undecided" and silent.rows[0]["note"] == "nothing to estimate" and len(silent.rows) == 9
