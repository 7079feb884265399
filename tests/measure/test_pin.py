"""A reference view against pictures: offsets that are known exactly, verdicts, sigma, and the words for a mount."""

import math
import random
from functools import cache

import pytest
import torch

from dhtorch.cli.pin import describe_pin, guide_pin
from dhtorch.codes import PinReason, PinVerdict
from dhtorch.geometry import se3
from dhtorch.geometry.camera import to_matrix
from dhtorch.measure import CameraPin, PinResult, find_change_points
from dhtorch.pytree import collate
from dhtorch.synthetic.fixed_camera import ROOM_LIGHTS, LitRoom, hide_behind_arms, photograph_again
from dhtorch.synthetic.paths import hand_held_path

#: Offsets of the camera (rotation rad, translation m): none, a small one, a large one, none.
OFFSETS = torch.tensor(
    [[0.0] * 6, [0.004, -0.006, 0.003, 0.004, -0.003, 0.006], [0.02, -0.03, 0.01, 0.02, 0.01, 0.03], [0.0] * 6],
    dtype=torch.float64,
)

#: Offset of one more picture: ahead, where no rotation is like it.
AHEAD = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.04], dtype=torch.float64)


@cache
def room(light="day"):
    here = hand_held_path("static", 1, step_m=0.0, rate_hz=30.0, seed=3)
    poses = collate(se3.compose(here, se3.exp(xi[None])) for xi in (*OFFSETS, AHEAD))
    return LitRoom(light=light, seed=3, n_frames=len(OFFSETS) + 1, hw=(120, 160), supersample=2, true_poses=poses)


@cache
def pinned():
    return CameraPin(room()[0])


@cache
def found():
    return collate(pinned().check(room()[k].image) for k in range(4))


@pytest.mark.slow
def test_offsets_are_right_to_three_sigma():
    result = found()
    assert bool(result.metric.all()) and result.reason.tolist() == [PinReason.ANSWERED] * 4
    error = se3.log(se3.compose(result.T_ref_from_live, se3.invert(se3.exp(OFFSETS))))
    sigma = result.cov.diagonal(dim1=1, dim2=2).sqrt()
    assert bool((error.abs() < 3.5 * sigma).all())
    assert float(error[:, :3].norm(dim=1).max()) < math.radians(0.1) and float(error[:, 3:].norm(dim=1).max()) < 0.004
    assert torch.equal(result.moved, torch.tensor([False, True, True, False]))


def test_a_batch_gives_the_results_of_its_pictures():
    together = pinned().check(torch.cat([room()[k].image for k in (1, 3)]))
    for k, alone in enumerate(found()[i : i + 1] for i in (1, 3)):
        assert torch.equal(together.offset[k], alone.offset[0]) and torch.equal(together.cov[k], alone.cov[0])
    assert torch.equal(pinned().check(room()[1].image[0]).offset, found().offset[1:2])


@pytest.mark.parametrize(
    "light", [pytest.param(name, marks=[pytest.mark.slow] * (name != "day")) for name in ROOM_LIGHTS]
)
def test_other_light_exposure_and_arms_are_no_motion(light):
    frame, hidden = hide_behind_arms(room(light)[3], 0.4, arm_seed=1, draw=random.Random(5))
    assert 0.4 <= float(hidden.float().mean()) < 0.7
    result = pinned().check(photograph_again(frame, random.Random(6)).image)
    assert not bool(result.moved) and (int(result.verdict) == PinVerdict.CANNOT_KNOW or float(result.shift_px) < 0.4)


def test_half_hidden_offset_is_found():
    frame, _ = hide_behind_arms(room()[2], 0.3, arm_seed=1, draw=random.Random(4))
    result = pinned().check(frame.image)
    assert bool(result.moved)
    assert float((result.T_ref_from_live.t - se3.exp(OFFSETS[2:3]).t).norm()) < 0.006


def test_what_shows_nothing_of_the_reference_is_not_known():
    noise = torch.randint(0, 256, (1, 3, 120, 160), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    for image in (noise, torch.zeros(1, 3, 120, 160)):
        result = pinned().check(image)
        assert int(result.verdict) == PinVerdict.CANNOT_KNOW and int(result.reason) != PinReason.ANSWERED
        assert bool(result.offset.isnan().all()) and not bool(result.inlier.any())
    assert describe_pin(result).startswith("cannot know: ") and guide_pin(result) == [describe_pin(result)]


def test_without_depth_the_rotation_is_known_and_the_translation_up_to_scale():
    frame = room()[0]
    pin = CameraPin(frame.replace(depth=torch.zeros_like(frame.depth)))
    still, moved = pin.check(room()[3].image), pin.check(room()[2].image)
    assert not bool(still.moved) and not pin.metric and not bool(still.metric)
    assert float(still.T_ref_from_live.t.norm()) == 0 and bool(still.cov[0, 3:].isnan().all())
    assert bool(moved.moved)
    length = float(moved.T_ref_from_live.t.norm())
    assert length == pytest.approx(1.0) or length == 0
    assert "no length" in describe_pin(still)
    ahead = pin.check(room()[4].image)
    assert bool(ahead.moved) and float(ahead.distance) < 1, "the best rotation is none"
    assert float(ahead.T_ref_from_live.t[0, 2]) == pytest.approx(1, abs=0.02)


@cache
def zoomed(factor):
    """Picture of the camera that stands still, with another focal length."""
    lens = LitRoom(seed=3, n_frames=1, hw=(120, 160), supersample=2, true_poses=room().true_poses[:1])
    lens.camera = lens.camera.replace(f=factor * lens.camera.f)
    return lens[0].image


@pytest.mark.parametrize("factor", [0.96, 0.98, 1.02, 1.04])
def test_another_focal_length_is_no_motion(factor):
    result = pinned().check(zoomed(factor))
    assert not bool(result.moved) and int(result.reason) == PinReason.ZOOM and bool(result.offset.isnan().all())
    assert float(result.zoom) == pytest.approx(factor, abs=max(0.001, 4 * float(result.zoom_sigma)))
    assert "zoom or focus changed" in describe_pin(result) and f"({factor:.2f}" in describe_pin(result)


def test_a_motion_along_the_axis_is_no_zoom():
    result = pinned().check(room()[4].image)
    assert bool(result.moved) and float(result.T_ref_from_live.t[0, 2]) == pytest.approx(0.04, abs=0.002)
    assert float(result.zoom) == pytest.approx(1, abs=0.002)


@pytest.mark.parametrize("depth", [0.0, 1.5])
def test_without_differences_of_depth_a_zoom_may_be_a_motion(depth):
    frame = room()[0]
    result = CameraPin(frame.replace(depth=torch.full_like(frame.depth, depth))).check(zoomed(1.02))
    assert int(result.verdict) == PinVerdict.CANNOT_KNOW and int(result.reason) == PinReason.ZOOM_OR_MOTION
    assert "moved along the axis, or zoom or focus changed" in describe_pin(result)


def test_a_capture_as_reference_leaves_out_what_moves():
    frames = [hide_behind_arms(room()[0], 0.15, arm_seed=0, draw=random.Random(k))[0] for k in range(5)]
    clean = room()[0].image.float()
    pin = CameraPin(frames)
    assert not pin.notes
    far = (pin.frame.image.float() - clean).abs().amax(1) > 20
    first = (frames[0].image.float() - clean).abs().amax(1) > 20
    assert float(far.float().mean()) < 0.7 * float(first.float().mean())  # the arms' feet are in all frames
    moving = CameraPin([room()[0], room()[2], room()[1]])
    assert moving.notes and torch.equal(moving.frame.image, room()[0].image)


def test_given_intrinsics_replace_the_references():
    K = to_matrix(room()[0].camera)
    assert torch.allclose(pinned().check(room()[1].image, K[0]).offset, found().offset[1:2])
    K[:, :2, :2] *= 1.05
    assert not torch.allclose(pinned().check(room()[1].image, K).offset, found().offset[1:2], atol=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: CameraPin(room()[0], false_alarm_rate=1.5), "false_alarm_rate"),
        (lambda: CameraPin(room()[0].replace(image=torch.zeros(1, 3, 120, 160))), "texture"),
        (lambda: pinned().check(torch.zeros(120, 160)), "image"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --------------------------------------------------------------------------------------------------- series and words


def series(offsets, sigma_px=0.05):
    """Results of pictures with given offsets (n, 6), as a scene at 1 m before a focal length of 500 px has them."""
    n = len(offsets)
    form = torch.diag(torch.tensor([500.0] * 6, dtype=torch.float64) ** 2)
    cov = (sigma_px / 500) ** 2 * torch.eye(6, dtype=torch.float64)
    T = se3.exp(offsets.double())
    one = torch.ones(n, dtype=torch.float64)
    return PinResult(
        T_ref_from_live=T,
        cov=cov.expand(n, 6, 6),
        shift_px=500 * offsets.norm(dim=1),
        shift_sigma_px=sigma_px * one,
        distance=one,
        verdict=torch.zeros(n, dtype=torch.int32),
        reason=torch.zeros(n, dtype=torch.int32),
        metric=one > 0,
        flow_form=form.expand(n, 6, 6),
        inlier=torch.ones(n, 1) > 0,
        agreement=one,
        coverage=one,
        false_alarm_rate=0.01 * one,
        zoom=one,
        zoom_sigma=0 * one,
    )


def noisy(n, seed=0, sigma_px=0.05):
    return sigma_px / 500 * torch.randn(n, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_change_points_are_found_where_they_are_planted():
    offsets = noisy(30)
    offsets[12:, 1] += 4 / 500
    offsets[20:, 3] -= 8 / 500
    changes = find_change_points(series(offsets))
    assert [change.first for change in changes] == [12, 20]
    assert changes[0].shift_px == pytest.approx(4, rel=0.1) and changes[1].shift_px == pytest.approx(8, rel=0.1)
    result = series(offsets)
    verdict = result.verdict.clone()
    verdict[5:8] = PinVerdict.CANNOT_KNOW
    assert [change.first for change in find_change_points(result.replace(verdict=verdict))] == [12, 20]


def test_series_without_a_change_have_none():
    alarms = sum(bool(find_change_points(series(noisy(24, seed)), min_px=0.0)) for seed in range(100))
    assert alarms <= 6
    assert find_change_points(series(noisy(3))) == []


@pytest.mark.parametrize("wrong", [0, 1, 7, 23])
def test_one_wrong_picture_is_no_change(wrong):
    offsets = noisy(24)
    offsets[wrong, :3] += 8 / 500
    assert find_change_points(series(offsets)) == []


DEGREE = math.radians(1.0)


@pytest.mark.parametrize(
    ("offset", "metric", "guide"),
    [
        ([0.0, 0.0, 0.0, 0.010, 0.0, -0.005], True, ["← left 10.0 mm", "⊗ forward 5.0 mm"]),
        ([0.0, 0.0, 0.0, -0.010, 0.004, 0.005], True, ["→ right 10.0 mm", "↑ up 4.0 mm", "⊙ back 5.0 mm"]),
        ([0.0, DEGREE, 0.0, 0.0, 0.0, 0.0], True, ["↶ turn left 1.00°"]),
        ([0.0, -DEGREE, 0.0, 0.0, -0.003, 0.0], True, ["↓ down 3.0 mm", "↷ turn right 1.00°"]),
        ([2 * DEGREE, 0.0, -3 * DEGREE, 0.0, 0.0, 0.0], True, ["⤓ tilt down 2.00°", "⟳ roll right 3.00°"]),
        ([-2 * DEGREE, 0.0, 3 * DEGREE, 0.0, 0.0, 0.0], True, ["⤒ tilt up 2.00°", "⟲ roll left 3.00°"]),
        ([0.0] * 6, True, ["in place"]),
        ([0.0009 * DEGREE / 0.0175, 0.0, 0.0, 0.0019, 0.0, 0.0], True, ["in place"]),
        ([0.0, 0.0, 0.0, 0.010, -0.002, -0.005], False, ["mainly ← left, by an unknown length"]),
    ],
)
def test_the_guide_says_which_way_back_and_the_line_states_sigmas(offset, metric, guide):
    result = series(torch.tensor([offset])).replace(metric=torch.tensor([metric]))
    *lines, shift = guide_pin(result)
    px = 500 * math.hypot(*offset)
    assert lines == guide and shift == f"shift {px:.1f} ± 0.1 px"
    turn, length = math.degrees(math.hypot(*offset[:3])), 1e3 * math.hypot(*offset[3:])
    words = f"not moved, {px:.2f} ± 0.05 px, turned by {turn:.3f} ± 0.010°, displaced "
    assert describe_pin(result).startswith(words + (f"by {length:.1f} ± 0.2 mm" if metric else "along ("))
