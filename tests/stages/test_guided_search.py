"""Search where the pose says: places of samples under a known pose, against exact scenes and repeated texture."""

import math
from functools import cache

import pytest
import torch
from support.rooms import room

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.metrics import holdout
from dhtorch.pipeline.presets import MAP
from dhtorch.pytree import collate, stack
from dhtorch.records import Camera, Pose, Samples
from dhtorch.stages.guided_search import guided_search

HW = (120, 160)


@cache
def orbit(degrees, pivot_m=2.2):
    """Pose T_1_from_0 of a camera turned about a point in front of it, and the room seen from both."""
    first = room(n_frames=2, hw=HW, lidar="exact").true_poses.map(lambda x: x[:1])
    R = se3.exp(torch.tensor([[0, math.radians(degrees), 0, 0, 0, 0]], dtype=torch.float64)).R
    pivot = torch.tensor([[0, 0, pivot_m]], dtype=torch.float64)
    T_0_from_1 = Pose(R, pivot - (R @ pivot[..., None])[..., 0])
    second = se3.compose(first, T_0_from_1)
    world = Pose(torch.cat((first.R, second.R)), torch.cat((first.t, second.t)))
    return se3.invert(T_0_from_1).to(torch.float32), room(n_frames=2, hw=HW, lidar="exact", true_poses=world)


def true_places(frame, samples, camera, T):
    """Pixels (B, N, 2) in view 1 of the samples' true depth, and whether that depth is reliable."""
    truth = holdout.select_candidates(samples, holdout.sample_truth(frame, samples.uv), 1.8)
    uv = samples.uv.expand(len(samples.xyz), -1, 2)
    return cam.project(camera, se3.apply(T, cam.unproject(frame.camera, uv, truth.depth))), truth.ok


def orbit_case(degrees):
    """Samples with returns up to 1.8 m, both frames, the pose, and true places."""
    T, pair = orbit(degrees)
    whole, other = collate([pair[0]]), collate([pair[1]])
    samples = MAP.replace(n=512).sample_depth(holdout.range_split(whole, 1.8))
    return samples, whole, other, T, *true_places(whole, samples, other.camera, T)


def search(samples, whole, other, T, **options):
    """Matches in one view or, with V × B frames, in several."""
    others, T = (other, T) if other.image.dim() == 5 else (other.map(lambda x: x[None]), T.map(lambda x: x[None]))
    return guided_search(samples, whole.image, others.image, whole.camera, others.camera, T, **options)


@pytest.mark.parametrize("degrees", [15, 25])
def test_unique_matches_lie_at_the_true_places_under_a_large_turn(degrees):
    samples, whole, other, T, place, ok = orbit_case(degrees)
    found = search(samples, whole, other, T)
    off = (found.uv_1[0] - place).norm(dim=-1)[ok & found.unique]
    assert len(off) > 0.3 * ok.sum()
    assert off.median() < 0.5
    assert (off < 3).float().mean() > 0.8


def test_returns_are_predicted_by_the_pose_alone():
    samples, whole, other, T, _, _ = orbit_case(15)
    found = search(samples, whole, other, T)
    near = samples.usable
    expected = cam.project(other.camera, se3.apply(T, torch.where(near[..., None], samples.xyz, 1.0)))
    torch.testing.assert_close(found.uv_1[0][near], expected[near])
    assert not found.unique[near].any()


def test_only_wanted_samples_are_searched_and_their_matches_are_those_of_all():
    samples, whole, other, T, _, _ = orbit_case(15)
    wanted = torch.arange(512)[None] % 3 == 0
    everything, some = search(samples, whole, other, T), search(samples, whole, other, T, wanted=wanted)
    far = ~samples.usable
    assert torch.equal(some.unique, everything.unique & wanted)
    torch.testing.assert_close(some.uv_1[0][far & wanted], everything.uv_1[0][far & wanted], equal_nan=True)
    assert not some.uv_1[0][far & ~wanted].isfinite().any()


def test_a_view_that_shows_another_scene_does_not_spoil_the_match():
    samples, whole, other, T, place, ok = orbit_case(15)
    noise = other.replace(image=torch.rand(other.image.shape, generator=torch.Generator().manual_seed(0)))
    others, poses = stack([other, other, noise]), stack([T, T, T])
    found = search(samples, whole, others, poses)
    off = (found.uv_1[0] - place).norm(dim=-1)[ok & found.unique]
    assert len(off) > 0.3 * ok.sum()
    assert off.median() < 0.5
    assert found.ncc[2][found.unique].median() < 0.5 < found.ncc[0][found.unique].median()


def flat_scene(texture):
    """Samples without a return on a wall at 3 m, seen from two places 0.3 m apart, and the true shift, px."""
    f, depth, baseline = 150.0, 3.0, 0.3
    camera = Camera(f=torch.full((1, 2), f), c=torch.tensor([[79.5, 59.5]]))
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    shift = f * baseline / depth
    images = [texture(u + s, v)[None, None] for s in (0.0, shift)]
    uv = torch.stack(torch.meshgrid(torch.arange(60.0, 140, 8), torch.arange(30.0, 90, 8), indexing="ij"), -1)
    uv = torch.cat((uv.reshape(1, -1, 2), torch.tensor([[[80.0, 60.0]]])), 1)
    N = uv.shape[1]
    zero, code = torch.zeros(1, N), torch.zeros(1, N, dtype=torch.int32)
    depth_m = zero.clone()
    depth_m[:, -1] = 0.8  # one return, which ends the segments
    xyz = torch.where(depth_m[..., None] > 0, cam.unproject(camera, uv, depth_m), torch.nan)
    samples = Samples(uv, depth_m, 0.01 * depth_m, xyz, (depth_m > 0).float(), code, zero + 1, code)
    T = Pose(torch.eye(3)[None, None], torch.tensor([[[-baseline, 0.0, 0.0]]]))
    cameras = camera.map(lambda x: x[None])
    return guided_search(samples, images[0], images[1][None], camera, cameras, T), uv, shift


def stripes(u, v):
    return 0.5 + 0.3 * (2 * math.pi * u / 8).sin() + 0.1 * (2 * math.pi * v / 17).sin()


def paint(u, v):
    waves = torch.rand(12, 3, generator=torch.Generator().manual_seed(3))
    return 0.5 + sum(0.04 * (0.6 * (a - 0.3) * u + 0.6 * (b - 0.5) * v + 6 * c).sin() for a, b, c in waves)


def test_repeated_texture_along_the_segment_is_not_unique_and_other_texture_is():
    repeated, _, _ = flat_scene(stripes)
    assert not repeated.unique.any()
    found, uv, shift = flat_scene(paint)
    assert found.unique[:, :-1].float().mean() > 0.7
    place = uv - torch.tensor([shift, 0.0])
    off = (found.uv_1[0] - place).norm(dim=-1)[found.unique]
    assert off.median() < 0.2
