"""Every pixel: right where the room's truth says so, silent where nothing can be known, and the promises of a stage."""

import pytest
import torch
from support.board_scenes import Board, look

from dhtorch import MAP
from dhtorch.codes import Gate, Source, is_swept
from dhtorch.experiments.compare.dense_comparison import exact_pose_fit
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.dense import (
    sensor_depth_map,
)
from dhtorch.pytree import collate
from dhtorch.synthetic import SyntheticRoom

#: Where returns end in these tests, m.
NEAR = 2.0
FAST = {"method": MAP.replace(n=512), "planes": 48}


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(240, 320), depth_hw=(240, 320), lidar="exact", image_noise=0.0)


@pytest.fixture(scope="module")
def views(room):
    """A reference view whose returns end at two metres, another view, and what is true of all pixels."""
    return range_split(room[3], NEAR), range_split(room[11], NEAR), room[3].depth


@pytest.fixture(scope="module")
def found(views):
    with torch.no_grad():
        return complete_depth(views[0], views[1], **FAST)


def exact(room, i, j, n=1):
    """The pose from the room itself."""
    return exact_pose_fit(room[i], room[j], n)


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


def test_the_sensor_speaks_where_it_answers_and_is_no_input(views, found):
    reference, other, depth = views
    sensed = reference.depth > 0
    assert bool((found.source[sensed] == Source.SENSOR).all()) and torch.equal(found.depth[sensed], depth[sensed])
    assert bool((found.source[~sensed] != Source.SENSOR).all())
    half = reference.depth.clone()
    half[:, :, ::2] = 0  # every other column of returns
    with torch.no_grad():
        fewer = complete_depth(reference.replace(depth=half), other, fit=None, **FAST)
    swept = sensed & (half == 0) & (fewer.source == Source.SWEPT)
    assert swept.sum() > 500
    assert float(((fewer.depth - depth).abs() / depth)[swept].median()) < 0.03, "the sweep knows near surfaces, too"


def test_a_camera_that_only_turns_gets_the_sensor_alone():
    room = SyntheticRoom(n_frames=6, hw=(240, 320), depth_hw=(120, 160), path="rotation")
    with torch.no_grad():
        got = complete_depth(range_split(room[0], NEAR), range_split(room[4], NEAR), **FAST)
    assert bool((~is_swept(got.source)).all()) and bool((got.source == Source.SENSOR).any())
    assert bool((got.gate[got.source == Source.NONE] == Gate.NO_BASELINE).all())


def test_without_another_view_the_map_is_the_sensors(views):
    reference = views[0]
    got = sensor_depth_map(reference, method=FAST["method"])
    seen = reference.depth > 0
    assert torch.equal(got.depth[seen], reference.depth[seen]) and bool((got.source[seen] == Source.SENSOR).all())
    assert bool((got.gate[~seen] == Gate.NO_TRACK).all()) and bool(got.depth[~seen].isnan().all())


def test_a_batch_is_a_loop_bit_for_bit():
    torch.set_num_threads(1)
    room = SyntheticRoom(n_frames=12, hw=(120, 160), depth_hw=(60, 80))
    references = [range_split(room[k], NEAR) for k in (1, 3)]
    others = [range_split(room[k], NEAR) for k in (9, 11)]
    with torch.no_grad():
        together = complete_depth(collate(references), collate(others), **FAST)
        assert bool((together.source == Source.SWEPT).flatten(1).any(1).all())
        for b in range(2):
            alone = complete_depth(references[b], others[b], **FAST)
            for name in ("depth", "sigma", "score", "source", "gate"):
                x, y = getattr(together, name)[b : b + 1], getattr(alone, name)
                assert torch.equal(x.nan_to_num(-1), y.nan_to_num(-1)), name


def test_depth_carries_gradients_to_pictures_near_depth_and_intrinsics(views):
    reference, other, _ = views
    inputs = [reference.image.float(), other.image.float(), reference.depth, reference.camera.f]
    if reference.image.dtype == torch.uint8:
        inputs[:2] = [x / 255 for x in inputs[:2]]
    image_0, image_1, depth, f = (x.clone().requires_grad_() for x in inputs)
    asked = reference.replace(image=image_0, depth=depth, camera=reference.camera.replace(f=f))
    got = complete_depth(asked, other.replace(image=image_1), **FAST)
    swept = got.source == Source.SWEPT
    got.depth[swept].sum().backward()
    for x in (image_0, image_1, depth, f):
        assert bool(x.grad.isfinite().all()) and bool((x.grad != 0).any())
    # all near depths longer by a hundredth: a longer motion, and every depth longer by as much
    longer = float((depth.grad * depth.detach()).sum() / got.depth[swept].detach().sum())
    assert longer == pytest.approx(1.0, abs=0.03)


def test_between_the_returns_of_a_sparse_sensor_places_are_swept_as_near_as_they_are(room):
    """Returns at every depth, 2 % of the pixels."""
    told = torch.rand(room[3].depth.shape, generator=torch.Generator().manual_seed(0)) < 0.02
    reference = room[3].replace(depth=torch.where(told, room[3].depth, 0.0), sparse=torch.tensor([True]))
    fit = exact(room, 3, 11, n=512)
    with torch.no_grad():
        swept_near, dense_sensor = (
            complete_depth(one, room[11], fit=fit, **FAST) for one in (reference, reference.replace(sparse=None))
        )
    near = (room[3].depth < 0.6 * room[3].depth.amax()) & ~told
    found, missed = (near & (one.source == Source.SWEPT) for one in (swept_near, dense_sensor))
    assert float(found.sum()) > 2 * float(missed.sum())
    error = ((swept_near.depth - room[3].depth).abs() / room[3].depth)[found]
    assert float(found.sum()) > 0.2 * float((near & (swept_near.source != Source.SENSOR)).sum())
    assert float(error.median()) < 0.02 and float((error > 0.2).float().mean()) < 0.1


@pytest.mark.parametrize(
    "wrong", [{"source_views": 0}, {"source_views": 9}, {"planes": 2}, {"size": 8}, {"refinements": -1}]
)
def test_options_out_of_range_raise(views, wrong):
    with pytest.raises(ValueError, match=f"complete_depth: {next(iter(wrong))} is .*, expected at least"):
        complete_depth(views[0], views[1], **{**FAST, **wrong})


def boards(*far):
    """What the map of two views says of boards beyond the sensor, and what is true: (map, depth, which board)."""
    near = [Board(1.5, x=(-9, -0.35), seed=7), Board(1.5, y=(0.42, 9), seed=8)]
    reference, which = look([*near, *far], (0.0, 0.0, 0.0))
    other, _ = look([*near, *far], (0.15, 0.02, 0.01), angle=(0.01, -0.02, 0.01))
    fit = exact_pose_fit(reference, other, 512)
    with torch.no_grad():
        got = complete_depth(
            range_split(reference, NEAR), range_split(other, NEAR), fit=fit, method=FAST["method"], planes=64
        )
    return got, reference.depth, torch.where(reference.depth > NEAR, which - len(near), -1)


def judged(got, depth, where):
    """Share answered of the pixels asked for, relative errors of these answers, and errors in sigmas."""
    told = where & (got.source == Source.SWEPT)
    off = (got.depth - depth).abs()[told]
    return float(told.sum() / where.sum()), off / depth[told], off / got.sigma[told]


MIRROR = [Board(2.5, x=(0, 0.6), mirrored=5.0, seed=3), Board(2.6, seed=4)]
EDGE = [Board(2.2, x=(0.2, 0.6), y=(-0.4, 0.3), seed=5), Board(4.5, seed=6)]
STRIPES = [Board(3.0, x=(0, 0.8), y=(-0.5, 0.3), stripes=0.15), Board(3.01, seed=2)]


@pytest.mark.parametrize(
    ("far", "board", "truth", "least", "most", "limit", "beyond", "within"),
    [
        ([Board(3.0, slope=0.8)], 0, 1.0, 0.8, 1, 0.05, 0.03, 0.9),  # a slanted wall has no steps
        ([Board(3.4, stripes=0.1)], 0, 1.0, 0, 0.02, 0.05, 1, 0),  # texture repeats along the line
        (STRIPES, 0, 1.0, 0.5, 1, 0.05, 0.02, 0),  # the surroundings tell which
        (EDGE, 0, 1.0, 0.75, 1, 0.1, 0.02, 0.9),  # where one surface ends before another both keep their depth
        (EDGE, 1, 1.0, 0.7, 1, 0.1, 0.02, 0.9),
        (MIRROR, 1, 1.0, 0.8, 1, 0.05, 0.03, 0),  # a wall beside a mirror, and the image in it: as a room behind it
        (MIRROR, 0, 2.0, 0.0, 1, 0.2, 0.3, 0),
    ],
)
def test_boards_are_right_or_unsaid(far, board, truth, least, most, limit, beyond, within):
    got, depth, which = boards(*far)
    answered, error, sigmas = judged(got, truth * depth, which == board)
    assert least < answered <= most or answered == least == 0
    if len(error):
        assert (
            float(error.median()) < (0.006 if far[0].slope else 0.02)
            and float((error > limit).float().mean()) <= beyond
        )
        assert float((sigmas < 2).float().mean()) >= within
    if most < 1:
        assert bool((got.gate[(which == board) & ~got.keep] == Gate.UNCERTAIN).float().mean() > 0.8)


def test_thin_things_are_right_or_unsaid_and_do_not_bleed():
    got, depth, which = boards(Board(4.0, seed=1), Board(2.5, x=(0.0, 0.04)), Board(2.5, x=(0.5, 0.58)))
    for post in (1, 2):
        share, error, _ = judged(got, depth, which == post)
        assert share < 1 and float((error > 0.2).float().sum()) < 0.15 * (which == post).sum()
    share, error, _ = judged(got, depth, which == 0)
    assert share > 0.7 and float((error > 0.1).float().mean()) < 0.02, "the wall behind keeps its depth"
