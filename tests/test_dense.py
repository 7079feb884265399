"""Every pixel: right where the room's truth says so, silent where nothing can be known, and the promises of a stage."""

import pytest
import torch

from dhtorch import MAP
from dhtorch.codes import Gate, Source
from dhtorch.dense import complete, resized
from dhtorch.evaluate.holdout import range_split
from dhtorch.geometry import se3
from dhtorch.records import PoseFit
from dhtorch.synthetic import SyntheticRoom
from dhtorch.tree import collate, stack

#: Where returns end in these tests, m.
NEAR = 2.0
FAST = {"method": MAP.replace(n=512), "planes": 48}


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(240, 320), depth_hw=(240, 320), lidar="exact", image_noise=0.0)


@pytest.fixture(scope="module")
def views(room):
    """An anchor whose returns end at two metres, another view, and what is true of all pixels."""
    return range_split(room[3], NEAR), range_split(room[11], NEAR), room[3].depth


@pytest.fixture(scope="module")
def found(views):
    with torch.no_grad():
        return complete(views[0], views[1], **FAST)


def exact(room, i, j, n=1):
    """The pose from the room itself, as a fit that is known to a tenth of a millimetre."""
    T = se3.compose(se3.invert(room[j].T_world_from_cam), room[i].T_world_from_cam)
    T = T.map(lambda x: x.float())
    one, cov = torch.ones(1), 1e-8 * torch.eye(6)[None]
    inlier = torch.ones(1, n, dtype=torch.bool)
    return PoseFit(T, cov, inlier, inlier.sum(-1), one, 0.1 * one, 1e3 * one, torch.zeros(1, dtype=torch.int32))


def test_far_pixels_of_the_room_are_found_and_know_how_well(views, found):
    depth = views[2]
    far = (depth > NEAR) & (found.source == Source.SWEPT)
    error = (found.depth - depth).abs() / depth
    assert far.sum() > 0.6 * (depth > NEAR).sum()
    assert float(error[far].median()) < 0.015 and float((error[far] > 0.2).float().mean()) < 0.1  # a mirror hangs there
    within = (error[far] <= found.sigma[far] / found.depth[far]).float().mean()
    assert 0.4 < float(within) < 0.95
    sure = error[far][found.score[far].argsort(descending=True)]
    assert float(sure[: len(sure) // 2].mean()) < 0.7 * float(sure.mean()), "the score ranks"


def test_under_the_true_motion_textured_pixels_are_within_hundredths(room, views):
    """Exact pose and depth: what both views show and bears texture."""
    fit = exact(room, 3, 11, n=512)
    with torch.no_grad():
        got = complete(views[0], views[1], fit=fit, method=FAST["method"], planes=96)
    depth, picture = views[2], resized(views[0], 640)[0][:, 0]
    mean = torch.nn.functional.avg_pool2d(picture, 9, 1, 4)
    contrast = (torch.nn.functional.avg_pool2d(picture.square(), 9, 1, 4) - mean.square()).clamp_min(0).sqrt()
    low = -torch.nn.functional.max_pool2d(-depth, 11, 1, 5)
    smooth = torch.nn.functional.max_pool2d(depth, 11, 1, 5) < 1.05 * low  # no edge within a window
    asked = (depth > NEAR) & (contrast > 0.02) & smooth & (got.source == Source.SWEPT)
    error = (got.depth - depth).abs() / depth
    assert asked.sum() > 3000
    assert float(error[asked].median()) < 0.006
    assert float((error[asked] < 0.01).float().mean()) > 0.7 and float((error[asked] < 0.02).float().mean()) > 0.82


def test_the_sensor_speaks_where_it_answers_and_is_no_input(views, found):
    anchor, other, depth = views
    sensed = anchor.depth > 0
    assert bool((found.source[sensed] == Source.SENSOR).all()) and torch.equal(found.depth[sensed], depth[sensed])
    assert bool((found.source[~sensed] != Source.SENSOR).all())
    half = anchor.depth.clone()
    half[:, :, ::2] = 0  # every other column of returns
    with torch.no_grad():
        fewer = complete(anchor.replace(depth=half), other, fit=None, **FAST)
    swept = sensed & (half == 0) & (fewer.source == Source.SWEPT)
    assert swept.sum() > 500
    assert float(((fewer.depth - depth).abs() / depth)[swept].median()) < 0.03, "the sweep knows near surfaces, too"


def test_silence_has_reasons_and_no_value(found):
    silent = ~found.keep
    assert silent.any() and bool(found.depth[silent].isnan().all()) and bool(found.sigma[silent].isnan().all())
    assert bool((found.score[silent] == 0).all()) and bool((found.source[silent] == Source.NONE).all())
    assert set(found.gate.unique().tolist()) <= {Gate.ANSWER, Gate.NO_TRACK, Gate.UNCERTAIN}
    assert bool((found.depth[found.keep] > 0).all()) and bool((found.sigma[found.keep] > 0).all())


def test_a_camera_that_only_turns_gets_the_sensor_alone():
    room = SyntheticRoom(n_frames=6, hw=(240, 320), depth_hw=(120, 160), path="rotation")
    with torch.no_grad():
        got = complete(range_split(room[0], NEAR), range_split(room[4], NEAR), **FAST)
    assert bool((got.source != Source.SWEPT).all()) and bool((got.source == Source.SENSOR).any())
    assert bool((got.gate[got.source == Source.NONE] == Gate.NO_BASELINE).all())


def test_a_motion_that_the_sensor_refutes_is_not_believed(room, views):
    """A pose with half as much again of translation: depths in sensor's reach would be wrong by a third."""
    fit = exact(room, 3, 11, n=512)
    wrong = fit.replace(T_1_from_0=fit.T_1_from_0.replace(t=1.5 * fit.T_1_from_0.t))
    with torch.no_grad():
        got = complete(views[0], views[1], fit=wrong, **FAST)
    assert not bool((got.source == Source.SWEPT).any())
    assert bool((got.gate[got.source == Source.NONE] != Gate.ANSWER).all())


@pytest.mark.slow
def test_more_views_say_more(room, views):
    others = stack([range_split(room[k], NEAR) for k in (0, 11)])
    method = MAP.replace(n=512, views=2)
    with torch.no_grad():
        one = complete(views[0], others, method=method, planes=48, partners=1)
        two = complete(views[0], others, method=method, planes=48, partners=2)
    share = [float((m.source == Source.SWEPT).float().mean()) for m in (one, two)]
    assert share[1] > share[0] > 0.1


def test_a_batch_is_a_loop_bit_for_bit():
    torch.set_num_threads(1)
    room = SyntheticRoom(n_frames=12, hw=(120, 160), depth_hw=(60, 80))
    anchors = [range_split(room[k], NEAR) for k in (1, 3)]
    others = [range_split(room[k], NEAR) for k in (9, 11)]
    with torch.no_grad():
        together = complete(collate(anchors), collate(others), **FAST)
        assert bool((together.source == Source.SWEPT).flatten(1).any(1).all())
        for b in range(2):
            alone = complete(anchors[b], others[b], **FAST)
            for name in ("depth", "sigma", "score", "source", "gate"):
                x, y = getattr(together, name)[b : b + 1], getattr(alone, name)
                assert torch.equal(x.nan_to_num(-1), y.nan_to_num(-1)), name


def test_depth_carries_gradients_to_pictures_near_depth_and_intrinsics(views):
    anchor, other, _ = views
    inputs = [anchor.image.float(), other.image.float(), anchor.depth, anchor.camera.f]
    if anchor.image.dtype == torch.uint8:
        inputs[:2] = [x / 255 for x in inputs[:2]]
    image_0, image_1, depth, f = (x.clone().requires_grad_() for x in inputs)
    asked = anchor.replace(image=image_0, depth=depth, camera=anchor.camera.replace(f=f))
    got = complete(asked, other.replace(image=image_1), **FAST)
    swept = got.source == Source.SWEPT
    got.depth[swept].sum().backward()
    for x in (image_0, image_1, depth, f):
        assert bool(x.grad.isfinite().all()) and bool((x.grad != 0).any())
    # all near depths longer by a hundredth: a longer motion, and every depth longer by as much
    longer = float((depth.grad * depth.detach()).sum() / got.depth[swept].detach().sum())
    assert longer == pytest.approx(1.0, abs=0.25)


def test_half_precision_goes_in_and_single_comes_out(views, found):
    anchor, other, depth = views

    def half(frame):
        image = frame.image.float() / 255 if frame.image.dtype == torch.uint8 else frame.image
        return frame.replace(image=image.half(), depth=frame.depth.half())

    with torch.no_grad():
        got = complete(half(anchor), half(other), **FAST)
    assert got.depth.dtype == got.sigma.dtype == torch.float32
    swept = (got.source == Source.SWEPT) & (found.source == Source.SWEPT)
    assert swept.sum() > 0.8 * (found.source == Source.SWEPT).sum()
    assert float(((got.depth - found.depth).abs() / depth)[swept].median()) < 0.01


def test_a_large_picture_is_swept_at_the_size_asked(views):
    picture, camera = resized(views[0], 160)
    assert picture.shape == (1, 1, 120, 160)
    torch.testing.assert_close(camera.f, views[0].camera.f / 2)
    torch.testing.assert_close(camera.c, (views[0].camera.c + 0.5) / 2 - 0.5)
    with torch.no_grad():
        got = complete(views[0], views[1], size=160, **FAST)
    assert got.depth.shape == (1, 120, 160) and bool((got.source == Source.SWEPT).any())


@pytest.mark.parametrize("wrong", [{"partners": 0}, {"partners": 9}, {"planes": 2}, {"size": 8}, {"refinements": -1}])
def test_options_out_of_range_raise(views, wrong):
    with pytest.raises(ValueError, match=f"complete: {next(iter(wrong))} is .*, expected at least"):
        complete(views[0], views[1], **{**FAST, **wrong})
