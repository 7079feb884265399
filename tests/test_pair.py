"""The whole method: exact scenes, hopeless input, company of other pairs, gradients, undistortion."""

import os
from functools import partial
from pathlib import Path

import pytest
import torch

from dhtorch import data, pair, tree
from dhtorch.baselines import opencv
from dhtorch.baselines.device_pose import device_pose, given_pose
from dhtorch.codes import Flag, Gate, PoseCode, Source
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.evaluate import errors, holdout
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pair import extend, merge
from dhtorch.stages import triangulate

ROOT = os.environ.get("DHTORCH_DATA")
real = [pytest.mark.data, pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")]
OPENCV = partial(
    extend,
    track=opencv.lucas_kanade,
    pose=opencv.pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.triangulate),
)


def cut(frame, near):
    return frame.replace(depth=torch.where(frame.depth <= near, frame.depth, torch.zeros_like(frame.depth)))


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(hw=(240, 320), n_frames=9, lidar="exact", image_noise=0.0)


@pytest.fixture(scope="module")
def views(room):
    """Three pairs of the exact room, near returns only, and the exact depth of the anchors."""
    gap = room.gap
    pairs = [(cut(room[i], 2.0), cut(room[i + gap], 2.0)) for i in range(3)]
    return pairs, [room[i] for i in range(3)]


def together(pairs):
    return tree.collate([p[0] for p in pairs]), tree.collate([p[1] for p in pairs])


def test_exact_scene_gives_pose_and_far_depth(views, room):
    pairs, full = views
    for k, ((frame_0, frame_1), whole) in enumerate(zip(pairs, full, strict=True)):
        trace = {}
        estimate = extend(frame_0, frame_1, n=1024, trace=trace)
        exact, surface = room.truth(k)["depth"], room.truth(k)["surface"]
        truth = holdout.truth_at(whole.replace(depth=exact, depth_camera=None), estimate.uv)
        odd = surface[0][tuple((estimate.uv[0] + 0.5).floor().long().flip(-1).unbind(-1))][None] != 0
        points = errors.select(estimate, holdout.candidates(trace["samples"], truth, 2.0, excluded=odd))
        found = errors.measure(points)
        assert found["n_kept"] > 100 and found["median_rel"] < 0.03 and found["wrong_share"] < 0.03, found
        T = se3.relative(whole.T_world_from_cam, room[k + room.gap].T_world_from_cam)
        off = se3.compose(trace["fit"].T_1_from_0, se3.invert(T).to(torch.float32))
        assert se3.rotation_angle(off.R) < 3e-3 and off.t.norm() < 6e-3


def test_map_takes_the_sensor_first(views):
    (frame_0, frame_1), *_ = views[0]
    trace = {}
    estimate = extend(frame_0, frame_1, n=512, trace=trace)
    samples = trace["samples"]
    merged = merge(samples, estimate)
    sensed = samples.xyz.isfinite().all(-1)
    assert torch.equal(merged.source == Source.SENSOR, sensed)
    assert torch.equal(merged.source == Source.RECOVERED, estimate.keep & ~sensed)
    assert torch.equal(merged.depth[sensed], samples.depth[sensed])
    assert (merged.depth[merged.source == Source.NONE] == 0).all() and merged.depth.isfinite().all()
    assert set(trace["ms"]) == {"sample", "backproject", "classify", "track", "pose", "triangulate", "score"}


# ---------------------------------------------------------------------------------------------------- company


def codes_equal(a, b):
    return torch.equal(a.gate, b.gate) and torch.equal(a.n_views, b.n_views)


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


def test_threads_change_rounding_at_most(views):
    pairs = together(views[0])
    torch.set_num_threads(2)
    two = extend(*pairs, n=512)
    torch.set_num_threads(1)
    one = extend(*pairs, n=512)
    both = one.keep & two.keep
    assert ((one.depth - two.depth).abs()[both] <= 1e-3 * one.sigma[both]).all()
    differ = one.gate != two.gate
    near_threshold = ((one.parallax_deg - 0.3).abs() < 3e-5) | ((one.residual_px - 3).abs() < 3e-4)
    assert not (differ & ~near_threshold).any()


def test_every_pair_may_have_its_own_seed(views):
    pairs = views[0][:2]
    seeds = torch.tensor([5, 9])
    batch = extend(*together(pairs), n=256, seed=seeds)
    for b, (p, s) in enumerate(zip(pairs, (5, 9), strict=True)):
        assert torch.equal(batch[b : b + 1].depth.nan_to_num(), extend(*p, n=256, seed=s).depth.nan_to_num())
    with pytest.raises(ValueError, match="seed has shape"):
        extend(*together(pairs), n=16, seed=torch.tensor([1, 2, 3]))


# ---------------------------------------------------------------------------------------------------- hopeless input


def promised_numbers_are_finite(estimate, samples):
    for name in ("score", "parallax_deg", "residual_px"):
        assert getattr(estimate, name).isfinite().all(), name
    assert estimate.depth[estimate.keep].isfinite().all() and estimate.sigma[estimate.keep].isfinite().all()
    assert samples.depth.isfinite().all() and samples.confidence.isfinite().all()


@pytest.mark.parametrize(
    "what", ["no depth", "nan depth", "black", "white", "one point", "identical", "unrelated", "swapped"]
)
def test_hopeless_input_is_silent_with_a_reason(views, what):
    (frame_0, frame_1), (other, _), _ = views[0]
    if what == "no depth":
        frame_0 = frame_0.replace(depth=0 * frame_0.depth)
    if what == "nan depth":
        frame_0 = frame_0.replace(depth=torch.nan * frame_0.depth)
    if what == "one point":
        depth = torch.zeros_like(frame_0.depth)
        depth[0, 120, 160] = 1.5
        frame_0 = frame_0.replace(depth=depth)
    if what in ("black", "white"):
        frame_0 = frame_0.replace(image=torch.full_like(frame_0.image, 0 if what == "black" else 255))
    if what == "identical":
        frame_1 = frame_0
    if what == "unrelated":
        frame_1 = frame_1.replace(image=torch.randint_like(frame_1.image, 0, 256))
    if what == "swapped":
        frame_0, frame_1 = frame_1, other
    trace = {}
    estimate = extend(frame_0, frame_1, n=256, trace=trace)
    promised_numbers_are_finite(estimate, trace["samples"])
    if what in ("no depth", "nan depth", "one point"):
        assert (trace["fit"].code == PoseCode.TOO_FEW).all() and not estimate.keep.any()
        assert trace["fit"].T_1_from_0.t.isnan().all()
        assert (
            (estimate.gate == Gate.NO_POSE) | (estimate.gate == Gate.NO_TRACK) | (estimate.gate == Gate.NO_TEXTURE)
        ).all()
    if what in ("black", "white"):
        bit = Flag.UNDEREXPOSED if what == "black" else Flag.SATURATED
        assert ((trace["samples"].flag & bit) != 0).all() and not estimate.keep.any()
    if what == "identical":
        assert not estimate.keep.any(), "no baseline, no answer"


def test_pure_rotation_is_answered_only_by_noise_and_counted():
    """The paper's gate trusts parallax from a noisy pose; what it still answers is reported, here only bounded."""
    room = SyntheticRoom(hw=(240, 320), n_frames=4, path="rotation", lidar="exact", image_noise=0.0)
    estimate = extend(cut(room[0], 2.0), cut(room[2], 2.0), n=512)
    assert estimate.depth[estimate.keep].isfinite().all()
    assert estimate.keep.float().mean() < 0.5


def test_wrong_shapes_raise(views):
    (frame_0, frame_1), *_ = views[0]
    with pytest.raises(ValueError, match="expected"):
        extend(frame_0, tree.collate([frame_1, frame_1]))
    with pytest.raises(ValueError, match="expected"):
        extend(frame_0.replace(depth=frame_0.depth[0]), frame_1)


# ---------------------------------------------------------------------------------------------------- pose, cameras


def test_a_given_pose_replaces_seat_five(views, room):
    (frame_0, frame_1), *_ = views[0]
    n = 512
    fit = device_pose(frame_0, frame_1, n)
    estimate = extend(frame_0.replace(depth=0 * frame_0.depth), frame_1, n=n, fit=fit)
    z = room.truth(0)["depth"][0][tuple((estimate.uv[0] + 0.5).floor().long().flip(-1).unbind(-1))]
    error = ((estimate.depth[0] - z).abs() / z)[estimate.keep[0]]
    assert estimate.keep.sum() > 100 and error.median() < 0.01
    with pytest.raises(ValueError, match="T_world_from_cam"):
        device_pose(frame_0.replace(T_world_from_cam=None), frame_1, n)
    lost = given_pose(fit.T_1_from_0.map(lambda x: x * torch.nan), n)
    assert not lost.ok.any() and not extend(frame_0, frame_1, n=n, fit=lost).keep.any()


def test_undistorted_tracks_are_ideal_pixels_with_covariance():
    camera = cam.Camera(
        torch.tensor([[517.3, 516.5]], dtype=torch.float64),
        torch.tensor([[318.6, 255.3]], dtype=torch.float64),
        torch.tensor([[0.262383, -0.953104, -0.005358, 0.002628, 1.163314]], dtype=torch.float64),
    )
    uv = torch.rand(1, 50, 2, dtype=torch.float64) * torch.tensor([639.0, 479.0])
    zero = torch.zeros(1, 50, dtype=torch.float64)
    cov = torch.eye(2, dtype=torch.float64).expand(1, 50, 2, 2)
    tracks = pair.Tracks(uv, uv, zero, zero, cov, zero == 0)
    ideal = pair.undistort_tracks(tracks, camera, camera)
    assert torch.allclose(cam.distort(camera, ideal.uv_1), uv, atol=1e-6) and ideal.valid.all()
    step = torch.tensor([1e-4, 0.0], dtype=torch.float64)
    moved = (cam.undistort(camera, uv + step) - cam.undistort(camera, uv - step)) / 2e-4
    J = cam.undistort_jacobian(camera, ideal.uv_1)
    assert torch.allclose(J[..., 0], moved, atol=1e-5)
    assert torch.allclose(ideal.cov, J @ J.mT)
    assert pair.undistort_tracks(tracks, cam.ideal(camera), cam.ideal(camera)) is tracks


# ---------------------------------------------------------------------------------------------------- gradients


def gradients_are_finite(frame_0, frame_1, near, n):
    image_0 = (frame_0.image.float() / 255).requires_grad_()
    image_1 = (frame_1.image.float() / 255).requires_grad_()
    depth = cut(frame_0, near).depth.clone().requires_grad_()
    f, c = frame_0.camera.f.clone().requires_grad_(), frame_1.camera.c.clone().requires_grad_()
    a = frame_0.replace(image=image_0, depth=depth, camera=frame_0.camera.replace(f=f))
    b = frame_1.replace(image=image_1, camera=frame_1.camera.replace(c=c))
    estimate = extend(a, b, n=n)
    assert estimate.keep.sum() >= 20
    estimate.depth[estimate.keep].log().mean().backward()
    for name, x in {"image_0": image_0, "image_1": image_1, "depth": depth, "f": f, "c": c}.items():
        assert x.grad is not None and x.grad.isfinite().all(), name
        assert x.grad.abs().max() > 0, name


def test_gradients_reach_images_near_depth_and_intrinsics(views, room):
    gradients_are_finite(room[0], room[room.gap], 2.0, 256)


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
    assert both.sum() > 50 and torch.allclose(ratio, torch.full_like(ratio, 1.1), rtol=1e-2)


def test_opencv_fills_the_same_seats(views, room):
    (frame_0, frame_1), *_ = views[0]
    ours, theirs = extend(frame_0, frame_1, n=1024), OPENCV(frame_0, frame_1, n=1024)
    both = ours.keep & theirs.keep
    assert both.sum() > 0.8 * max(ours.keep.sum(), theirs.keep.sum())
    assert ((ours.depth / theirs.depth)[both] - 1).abs().median() < 0.02
