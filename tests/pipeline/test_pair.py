"""The whole method: exact scenes, company of other pairs, gradients; its parts alone: test_merge.py."""

import os
from functools import partial
from pathlib import Path

import pytest
import torch
from support import box_scene as box
from support import textured_box as walls

from dhtorch import data, extend, pytree
from dhtorch.experiments.baselines import opencv
from dhtorch.experiments.baselines.device_pose import device_pose_fit, known_pose_fit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.presets import METHODS
from dhtorch.stages import triangulate

ROOT = os.environ.get("DHTORCH_DATA")
real = [pytest.mark.data, pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")]
OPENCV = partial(
    extend,
    track=opencv.opencv_lucas_kanade,
    pose=opencv.opencv_pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.opencv_triangulate),
)


HW = (144, 192)
CAMERA = cam.resize(walls.CAMERA, walls.HW, HW)
GAP = 4


@pytest.fixture(scope="module")
def views():
    """Three pairs of an exact room, near returns only, and the same with all of them."""
    full = [[walls.view(walls.at(k), HW, CAMERA) for k in (i, i + GAP)] for i in range(3)]
    return [tuple(map(walls.near, pair)) for pair in full], full


def together(pairs):
    return pytree.collate([p[0] for p in pairs]), pytree.collate([p[1] for p in pairs])


def truth_of(frame, uv):
    """Exact depth (1, N) of the points that an exact frame shows at pixels."""
    _, depth = box.hit(frame.camera, frame.T_world_from_cam, frame.hw)
    v, u = (uv[0] + 0.5).floor().long().flip(-1).unbind(-1)
    return depth[v, u][None]


def test_exact_scene_gives_pose_and_far_depth(views):
    pairs, full = views
    for (frame_0, frame_1), whole in zip(pairs, full, strict=True):
        trace = {}
        estimate = extend(frame_0, frame_1, n=512, trace=trace)
        far = estimate.keep & (trace["samples"].depth == 0)
        error = ((estimate.depth - truth_of(whole[0], estimate.uv)) / truth_of(whole[0], estimate.uv)).abs()[far]
        T = se3.relative(*(f.T_world_from_cam for f in whole))
        off = se3.compose(trace["fit"].T_1_from_0, se3.invert(T).to(torch.float32))
        found = int(far.sum()), float(error.median()), float(se3.rotation_angle(off.R)), float(off.t.norm())
        assert found[0] > 300 and found[1] < 0.03 and (error > 0.1).float().mean() < 0.04, found
        assert found[2] < 6e-3 and found[3] < 2e-2, found


# ---------------------------------------------------------------------------------------------------- company


def test_an_answer_does_not_depend_on_its_company(views):
    torch.set_num_threads(1)
    pairs = views[0]
    eight = [pairs[k] for k in (0, 1, 2, 1, 0, 2, 2, 1)]
    batch = extend(*together(eight), n=512)
    alone = [extend(*p, n=512) for p in pairs]
    for b, k in enumerate((0, 1, 2, 1, 0, 2, 2, 1)):
        for name in ("depth", "sigma", "score", "gate", "parallax_deg", "residual_px"):
            x, y = getattr(batch[b : b + 1], name), getattr(alone[k], name)
            assert torch.equal(x.nan_to_num(-1), y.nan_to_num(-1)), (b, k, name)


def test_every_pair_may_have_its_own_seed(views):
    pairs = views[0][:2]
    seeds = torch.tensor([5, 9])
    batch = extend(*together(pairs), n=256, seed=seeds)
    for b, (p, s) in enumerate(zip(pairs, (5, 9), strict=True)):
        assert torch.equal(batch[b : b + 1].depth.nan_to_num(), extend(*p, n=256, seed=s).depth.nan_to_num())
    with pytest.raises(ValueError, match="seed has shape"):
        extend(*together(pairs), n=16, seed=torch.tensor([1, 2, 3]))


# ---------------------------------------------------------------------------------------------------- hopeless input


def test_a_pure_rotation_is_not_answered():
    T = walls.at(0)
    turned = se3.Pose(T.R @ se3.exp(torch.tensor([[0.01, -0.04, 0.02, 0, 0, 0]]).double()).R, T.t)
    frame_0, frame_1 = (walls.near(walls.view(pose, HW, CAMERA)) for pose in (T, turned))
    for name in ("paper", "map"):
        assert not METHODS[name](frame_0, frame_1, n=256).keep.any(), name


# ---------------------------------------------------------------------------------------------------- pose, cameras


def test_a_given_pose_replaces_stage_five(views):
    (frame_0, frame_1), *_ = views[0]
    n = 512
    fit = device_pose_fit(frame_0, frame_1, n)
    estimate = extend(frame_0.replace(depth=0 * frame_0.depth), frame_1, n=n, fit=fit)
    z = truth_of(frame_0, estimate.uv)
    error = ((estimate.depth - z).abs() / z)[estimate.keep]
    assert estimate.keep.sum() > 450 and error.median() < 0.025
    with pytest.raises(ValueError, match="T_world_from_cam"):
        device_pose_fit(frame_0.replace(T_world_from_cam=None), frame_1, n)
    lost = known_pose_fit(fit.T_1_from_0.map(lambda x: x * torch.nan), n)
    assert not lost.ok.any() and not extend(frame_0, frame_1, n=n, fit=lost).keep.any()


# ---------------------------------------------------------------------------------------------------- gradients


def gradients_are_finite(frame_0, frame_1, near, n):
    image_0 = (frame_0.image.float() / 255).requires_grad_()
    image_1 = (frame_1.image.float() / 255).requires_grad_()
    depth = walls.near(frame_0, near).depth.clone().requires_grad_()
    f, c = frame_0.camera.f.clone().requires_grad_(), frame_1.camera.c.clone().requires_grad_()
    a = frame_0.replace(image=image_0, depth=depth, camera=frame_0.camera.replace(f=f))
    b = frame_1.replace(image=image_1, camera=frame_1.camera.replace(c=c))
    estimate = extend(a, b, n=n)
    assert estimate.keep.sum() >= 20
    estimate.depth[estimate.keep].log().mean().backward()
    for name, x in {"image_0": image_0, "image_1": image_1, "depth": depth, "f": f, "c": c}.items():
        assert x.grad is not None and x.grad.isfinite().all(), name
        assert x.grad.abs().max() > 0, name


def test_gradients_reach_images_near_depth_and_intrinsics(views):
    gradients_are_finite(*views[1][0], walls.NEAR, 256)


@pytest.mark.parametrize(
    "name", [pytest.param("holo_a", marks=real), pytest.param("middlebury_motorcycle", marks=real)]
)
def test_gradients_on_a_real_pair(name):
    recording = data.open(Path(ROOT) / name)
    near, gap = {"holo_a": (2.5, 3), "middlebury_motorcycle": (2.8, 1)}[name]
    i = 2 if name == "holo_a" else 0
    gradients_are_finite(recording[i], recording[i + gap], near, 512)


def test_scaling_the_near_depth_scales_the_answer(views):
    """Metric by construction: near returns 10 % longer make every recovered depth 10 % longer."""
    (frame_0, frame_1), *_ = views[0]
    once = extend(frame_0, frame_1, n=512)
    longer = extend(frame_0.replace(depth=1.1 * frame_0.depth), frame_1, n=512)
    both = once.keep & longer.keep
    ratio = (longer.depth / once.depth)[both]
    assert both.sum() > 450 and torch.allclose(ratio, torch.full_like(ratio, 1.1), rtol=1e-5)


def test_opencv_fills_the_same_stages(views):
    (frame_0, frame_1), *_ = views[0]
    ours, theirs = extend(frame_0, frame_1, n=1024), OPENCV(frame_0, frame_1, n=1024)
    both = ours.keep & theirs.keep
    assert both.sum() > 0.98 * max(ours.keep.sum(), theirs.keep.sum())
    assert ((ours.depth / theirs.depth)[both] - 1).abs().median() < 1e-3


def test_threads_change_rounding_at_most(views):
    pairs = together(views[0])
    torch.set_num_threads(2)
    two = extend(*pairs, n=200)
    torch.set_num_threads(1)
    one = extend(*pairs, n=200)
    both = one.keep & two.keep
    assert ((one.depth - two.depth).abs()[both] <= 1e-3 * one.sigma[both]).all()
    differ = one.gate != two.gate
    near_threshold = ((one.parallax_deg - 0.3).abs() < 3e-5) | ((one.residual_px - 3).abs() < 3e-4)
    assert not (differ & ~near_threshold).any()
