"""Is a depth right: what speaks for and against pixels, numbers of a frame, and that silence is never called right."""

import math
from types import SimpleNamespace

import pytest
import torch

from dhtorch import AUTO, validate_depth
from dhtorch.codes import State
from dhtorch.metrics.detection import auroc
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pytree import collate, stack
from dhtorch.records import Pose
from dhtorch.synthetic import SyntheticRoom
from dhtorch.validation import validate
from dhtorch.validation.evidence import Evidence
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS, ValidationOptions
from dhtorch.validation.validate import (
    QUICK_METHOD,
    clipped_depth,
    combine_evidence,
    share_interval,
    validate_against,
)

NEAR, ANCHOR, OTHERS = 2.0, 5, (0, 2, 8, 11)
METHOD = AUTO.replace(n=768)
SMALL = {"method": METHOD, "size": 160}


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(180, 240), depth_hw=(90, 120), supersample=1, seed=0)


@pytest.fixture(scope="module")
def reference(room):
    return range_split(room[ANCHOR], NEAR)


@pytest.fixture(scope="module")
def others(room):
    return stack([range_split(room[k], NEAR) for k in OTHERS])


@pytest.fixture(scope="module")
def true(room):
    return room.truth(ANCHOR)["depth"]


@pytest.fixture(scope="module")
def asked(reference, others):
    """What the sparse method makes of the views: the same for every map of the reference view."""
    trace = {}
    return dense.selected_views(METHOD(reference, others, trace=trace), others, trace)


@pytest.fixture(scope="module")
def sound(true, reference, others):
    return validate_depth(true, reference, others, **SMALL)


def at_grid(x, verdict):
    return torch.nn.functional.interpolate(x[None].float(), verdict.state.shape[-2:], mode="nearest-exact")[0]


def test_a_true_map_is_consistent_and_its_numbers_hold(sound):
    known = sound.known
    assert known.float().mean() > 0.6
    assert (sound.state == State.WRONG).sum() < 0.1 * known.sum()
    for name in ("scale", "scale_near", "scale_far"):
        value, low, high = getattr(sound, name)[0]
        assert low < value < high
        assert low < 1.02
        assert high > 0.98
    assert sound.shift[0, 1] < 0 < sound.shift[0, 2]


@pytest.mark.parametrize(
    ("name", "good_for"),
    [
        ("scale_near", DEFAULT_VALIDATION_OPTIONS.sensor_scale_sigma),
        ("scale_vs_trajectory", DEFAULT_VALIDATION_OPTIONS.trajectory_scale_sigma),
    ],
)
def test_a_metre_is_told_no_closer_than_what_tells_it_is_good_for(name, good_for, sound):
    """However many points agree: they share one sensor, or one trajectory."""
    _, low, high = getattr(sound, name)[0]
    assert math.log(high / low) > 2 * 1.96 * good_for


def test_near_and_far_that_contradict_each_other_leave_the_scale_open(true, reference, asked):
    found = validate_against(torch.where(true > NEAR, 1.3 * true, true), reference, asked, **SMALL, views=False)
    near, far, both = (x[0].log() for x in (found.scale_near, found.scale_far, found.scale))
    assert near[2] < far[1]
    assert near[0] < both[0] < far[0]
    assert both[2] - both[1] > 5 * (near[2] - near[1]), "agreeing, they would make it narrower than the near alone"


@pytest.mark.parametrize("tilt", [0.2, 0.4])
@pytest.mark.parametrize("side", [-1, -2])
def test_a_tilt_is_the_error_from_one_side_of_the_picture_to_the_other(side, tilt, true, reference):
    n = true.shape[side]
    place = ((torch.arange(n) + 0.5) / n - 0.5).reshape((n, 1) if side == -2 else (n,))
    value, low, high = validate_depth((1 + tilt * place) * true, reference, **SMALL).tilt[0]
    assert value == pytest.approx(tilt, rel=0.05)
    assert 0 < low < tilt < high


@pytest.mark.parametrize("factor", [1.1, pytest.param(1 / 1.1, marks=pytest.mark.slow)])
def test_a_wrong_metre_is_found_by_near_returns_and_by_far_answers(factor, true, reference, others, sound):
    found = validate_depth(factor * true, reference, others, **SMALL, views=False)
    for name in ("scale", "scale_near", "scale_far"):
        value, low, high = getattr(found, name)[0] / factor
        assert abs(math.log(value)) < 0.03
        assert not low * factor <= 1 <= high * factor
    assert (found.state == State.CONSISTENT).sum() < 0.4 * (sound.state == State.CONSISTENT).sum()


def test_a_surface_that_stands_elsewhere_is_wrong_and_its_surroundings_are_not(true, reference, others):
    moved = torch.zeros_like(true, dtype=torch.bool)
    moved[:, 60:120, 70:140] = True
    found = validate_depth(torch.where(moved, 1.6 * true, true), reference, others, **SMALL)
    inside = at_grid(moved, found) > 0
    assert ((found.state == State.CONSISTENT) & inside).sum() <= 0.003 * inside.sum()
    assert auroc(found.evidence.abs()[found.known], inside[found.known]) > 0.97
    signs = found.evidence[inside & (found.state == State.WRONG)]
    assert (signs > 0).float().mean() > 0.9, "too far"


def test_without_another_view_near_returns_alone_speak(true, reference):
    found = validate_depth(true, reference, **SMALL)
    near = at_grid(true, found) < 0.9 * NEAR
    far = at_grid(true, found) > 1.2 * NEAR
    assert (found.known & near).sum() > 0.5 * near.sum()
    assert not (found.state == State.CONSISTENT)[far].any(), "nothing tells"
    assert found.known[far].float().mean() < 0.02, "but for returns that mix an edge"
    assert found.photometric_evidence.isnan().all()
    assert found.scale_far.isnan().all()


def test_a_single_sensor_view_can_know_nothing_of_itself(room):
    found = validate_depth(None, room[ANCHOR], **SMALL)
    assert not found.known.any()
    assert found.scale.isnan().all()
    assert (found.view == -2).all()


def test_a_camera_that_only_turns_knows_nothing_of_what_is_far():
    turning = SyntheticRoom(n_frames=6, hw=(180, 240), path="rotation", supersample=1, seed=0)
    near = [range_split(turning[k], NEAR) for k in (0, 2, 5)]
    true = turning.truth(2)["depth"]
    found = validate_depth(1.3 * true, near[1], stack([near[0], near[2]]), **SMALL)
    far = at_grid(true, found) > 1.2 * NEAR
    assert (found.state == State.CONSISTENT)[far].float().mean() < 0.003


@pytest.mark.slow
def test_quick_leaves_a_metre_unknown_where_the_motion_comes_out_short(room, true, reference):
    """Motions that few points hold loosely are too short: of a true map they would say that it is too far."""

    def by_points(method, k):
        return validate_depth(
            true, reference, range_split(room[k], NEAR), method=method, views=False, size=160
        ).scale_far[0]

    beside = (ANCHOR - 1, ANCHOR + 1)
    loose = torch.stack([by_points(QUICK_METHOD.replace(triangulate={"min_t_snr": 10.0}), k) for k in beside])
    assert (loose[:, 0] > 1.05).all()
    assert (loose[:, 1] > 1).any(), "a false alarm"
    assert all(by_points(QUICK_METHOD, k).isnan().all() for k in beside)
    assert by_points(QUICK_METHOD, ANCHOR + 3).isfinite().all(), "a wider way is known well enough"


@pytest.mark.slow
def test_the_sensors_own_metre_is_told_by_a_trajectory_alone(room, others):
    wrong = 1.25
    swollen = [room[k].replace(depth=wrong * room[k].depth) for k in (ANCHOR, *OTHERS)]
    found = validate_depth(None, swollen[0], stack(swollen[1:]), **SMALL, views=False)
    _, low, high = found.scale[0]
    assert low < wrong < high
    assert not low <= 1 <= high
    assert found.scale_near.isnan().all()
    lost = [frame.replace(T_world_from_cam=None) for frame in swollen]
    assert validate_depth(None, lost[0], stack(lost[1:]), **SMALL, views=False).scale.isnan().all()


@pytest.mark.slow
def test_exposure_of_other_views_changes_little(true, reference, others, sound):
    dim = others.replace(image=(others.image.float() / 255 * 0.7 + 0.05))
    found = validate_depth(true, reference.replace(image=reference.image.float() / 255), dim, **SMALL)
    both = found.known & sound.known
    assert both.sum() > 0.8 * sound.known.sum()
    assert (found.state == sound.state)[both].float().mean() > 0.95


def test_maps_of_other_views_see_through_what_stands_too_near(room, true, reference, others):
    maps = torch.stack([room.truth(k)["depth"] for k in OTHERS])
    blob = true.clone()
    blob[:, 60:120, 70:140] *= 0.6
    found = validate_depth(blob, reference, others, other_maps=maps, **SMALL)
    inside = at_grid(blob < 0.9 * true, found) > 0
    told = found.consistency_evidence.isfinite()
    assert (found.consistency_evidence[told & inside] < -3).float().mean() > 0.8
    assert (told & inside).sum() > 0.3 * inside.sum()
    assert (found.consistency_evidence[told & ~inside] < -3).float().mean() < 0.1


@pytest.mark.parametrize("fewer", [pytest.param(4, marks=pytest.mark.slow), 8])
def test_coarse_maps_of_other_views_see_through_no_true_outline(fewer, room, true, reference, asked):
    """An outline lies anywhere between two of their pixels, and what is before it may be either's."""
    maps = torch.stack([room.truth(k)["depth"][:, fewer // 2 :: fewer, fewer // 2 :: fewer] for k in OTHERS])
    assert not (validate_against(true, reference, asked, other_maps=maps, **SMALL).consistency_evidence < -3).any()


@pytest.mark.parametrize(
    ("n", "good"), [pytest.param(2, (1,), marks=pytest.mark.slow), (7, (3, 6))]
)  # more than are looked at, too
def test_a_view_that_tells_is_named_by_its_place_among_those_offered(n, good, true, reference, others):
    blank = torch.full_like(others.image[0], 128)
    offered = [others[k % len(OTHERS)] for k in range(n)]
    offered = [view if k in good else view.replace(image=blank) for k, view in enumerate(offered)]
    found = validate_depth(true, reference, stack(offered), **SMALL)
    assert set(found.view.unique().tolist()) == {-2, -1, *good}


def test_a_map_that_is_cut_is_wrong_or_unknown_where_it_is(true, reference, others):
    """A byte in centimetres: nothing is farther than 2.55 m, as windows at the outline of what is near would have it."""
    byte = (true * 100).round().clamp_max(255) / 100
    found = validate_depth(byte, reference, others, **SMALL)
    off = at_grid(true, found) > 1.2 * found.depth
    assert off.float().mean() > 0.3
    assert not (found.state == State.CONSISTENT)[off].any()
    assert ((found.state == State.CONSISTENT) & ~off).sum() > 0.5 * (~off).sum()
    assert found.clip_depth[0] == pytest.approx(2.55)


def test_a_wall_that_ends_a_map_is_no_cut_and_neither_is_a_wrong_metre():
    grid = torch.full((4, 20, 20), 2.0)
    grid[:, :, 10:] = 3.0
    state = torch.full(grid.shape, State.CONSISTENT)
    said = torch.zeros_like(grid)
    state[1:, :, 10:], said[1, :, 10:] = State.WRONG, 5.0  # too far
    state[2], said[2:] = State.WRONG, -5.0  # all too near
    depth, at = clipped_depth(grid, state, said)
    assert depth[:3].isnan().all() and not at[:3].any()
    assert depth[3] == 3 and torch.equal(at[3], grid[3] == 3)


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (lambda d: d > 1, "depth_map is of bool, expected real numbers"),
        (lambda d: d.to(torch.complex64), "depth_map is of complex64"),
        (lambda d: d[:, :1, :1], "at least 2×2 pixels"),
        (lambda d: d[:, :, :1], "at least 2×2 pixels"),
        (lambda d: d[:, :0, :0], r"depth_map has shape \(.*1, 0, 0\), expected at least 2×2 pixels"),
    ],
)
def test_what_is_no_map_is_refused(bad, said, true, reference):
    with pytest.raises(ValueError, match=said):
        validate_depth(bad(true), reference)
    with pytest.raises(ValueError, match=said.replace("depth_map", "other_maps")):
        validate_depth(true, reference, other_maps=bad(true)[None])


@pytest.mark.parametrize("fewer", [pytest.param(4, marks=pytest.mark.slow), 8])
def test_a_sound_map_of_few_pixels_is_not_wrong_at_its_outlines(fewer, room, true, reference, others, sound):
    """A value of a coarse map stands for many pixels of the grid: beside an outline either surface may be theirs."""

    def coarse(x):
        return x[:, fewer // 2 :: fewer, fewer // 2 :: fewer]

    maps = torch.stack([coarse(room.truth(k)["depth"]) for k in OTHERS])
    found = validate_depth(coarse(true), reference, others, other_maps=maps, **SMALL)

    def called(verdict):
        return float((verdict.state == State.WRONG).sum() / verdict.known.sum())

    assert called(found) < called(sound) + 0.02
    assert found.known.float().mean() > 0.6 * sound.known.float().mean()
    off = validate_depth(1.1 * coarse(true), reference, others, **SMALL, views=False)
    assert not off.scale[0, 1] <= 1 <= off.scale[0, 2]


def test_no_depth_is_never_right_or_wrong(true, reference, others):
    holes = true.clone()
    holes[:, :, :120] = torch.nan
    holes[:, :60] = 0
    found = validate_depth(holes, reference, others, **SMALL)
    assert not found.known[at_grid((~(holes > 0)), found) > 0].any()
    nothing = validate_depth(torch.zeros_like(true), reference, others, **SMALL)
    assert not nothing.known.any()
    assert nothing.wrong.isnan().all()


SILENT = (math.nan, False, -2)


@pytest.mark.parametrize(
    ("kinds", "state", "misfit", "view"),
    [
        ([(0.1, True, -1), SILENT, SILENT], State.CONSISTENT, 0.1, -1),
        ([(0.1, False, -1), SILENT, SILENT], State.CANNOT_KNOW, 0.1, -1),
        ([(-4.0, False, -1), SILENT, SILENT], State.WRONG, -4.0, -1),
        ([(-4.0, True, -1), (0.1, False, 3), SILENT], State.WRONG, -4.0, -1),
        ([(-4.0, True, -1), (0.1, True, 3), SILENT], State.CANNOT_KNOW, -4.0, -1),  # they contradict each other
        ([(2.5, True, -1), SILENT, SILENT], State.CANNOT_KNOW, 2.5, -1),
        ([SILENT, SILENT, SILENT], State.CANNOT_KNOW, math.nan, -2),
        ([(-4.0, True, -1), (6.0, False, 3), SILENT], State.WRONG, 6.0, 3),  # the largest of what refutes
        ([(0.5, True, -1), (0.1, True, 3), (0.01, False, 2)], State.CONSISTENT, 0.1, 3),  # the least of what supports
        ([SILENT, (2.5, True, 3), SILENT], State.CANNOT_KNOW, 2.5, 3),
        ([SILENT, SILENT], State.CANNOT_KNOW, math.nan, -2),
    ],
)
def test_kinds_of_evidence_are_combined(kinds, state, misfit, view):
    found = combine_evidence(*(Evidence(*(torch.tensor([[[x]]]) for x in kind)) for kind in kinds))
    assert [float(x) for x in found] == pytest.approx([state, misfit, view], nan_ok=True)


@pytest.mark.parametrize("n", [5.0, 50.0])
def test_a_fraction_of_few_has_a_wide_interval(n):
    """Wilson's interval; of none: from 0 to z² / (n + z²), not to 0."""
    few, many = (share_interval(torch.tensor([0.1 * k]), torch.tensor([k]))[0] for k in (n, 100 * n))
    assert few[1] < many[1] < 0.1 < many[2] < few[2]
    assert share_interval(torch.zeros(1), torch.zeros(1)).isnan().all()
    square = 1.96**2
    none, all_of = (share_interval(torch.tensor([part]), torch.tensor([n]))[0] for part in (0.0, n))
    torch.testing.assert_close(none, torch.tensor([0.0, 0.0, square / (n + square)]))
    torch.testing.assert_close(all_of, torch.tensor([1.0, n / (n + square), 1.0]))


@pytest.mark.parametrize(
    ("options", "batch"),
    [
        *(({name: x}, 1) for name, x in (("tolerance", 0.2), ("tolerance", 0), ("size", 4), ("source_views", 0))),
        ({}, 2),
    ],
)
def test_options_out_of_range_and_maps_of_another_batch_are_refused(options, batch, true, reference, others):
    with pytest.raises(ValueError, match="validate_depth: "):
        validate_depth(true.expand(batch, -1, -1), reference, others, **options)


def test_a_batch_is_judged_as_its_members_are(room, true, reference, others):
    other = range_split(room[6], NEAR)

    both = collate([reference, other])
    maps = torch.cat([true, 1.1 * room.truth(6)["depth"]])
    views = others[:2]
    found = validate_depth(maps, both, views.map(lambda x: x.expand(-1, 2, *x.shape[2:])), **SMALL, views=False)
    alone = validate_depth(maps[1:], other, views, **SMALL, views=False)
    assert torch.equal(found.state[1:], alone.state)
    assert torch.allclose(found.scale[1:], alone.scale)


@pytest.mark.slow
def test_options_change_what_they_name(true, reference, others, sound):
    """One option of each kind: evidence, states and numbers of the frame."""
    maps = {"depth_map": true, "reference": reference, "others": others}
    strict = validate_depth(**maps, **SMALL, options=ValidationOptions(min_filled_ratio=1.1))
    assert not strict.photometric_evidence.isfinite().any()
    harsh = validate_depth(**maps, **SMALL, views=False, options=ValidationOptions(refuting_evidence_sigmas=1.0))
    assert (harsh.state == State.WRONG).sum() > (sound.state == State.WRONG).sum()
    few = validate_depth(**maps, **SMALL, views=False, options=ValidationOptions(min_scale_references=10_000))
    assert few.scale.isnan().all()


def test_maps_of_other_views_are_those_of_the_views_they_are_compared_with(monkeypatch):
    """Six maps were passed; the method selected four of them and ranks these for each member of the batch."""
    seen, B, hw = {}, 2, (6, 8)
    number = torch.tensor([[5, 0], [3, 2], [1, 4], [0, 5]])  # of the selected views among those passed
    index = torch.tensor([[2, 0], [0, 3]])  # the two most informative, by member
    passed = torch.arange(6.0).view(6, 1, 1, 1) + 10 * torch.arange(B).view(1, B, 1, 1) + torch.ones(6, B, *hw)
    fits = SimpleNamespace(ok=torch.ones(4, B, dtype=torch.bool), t_snr=torch.full((4, B), 9.0))
    frames = SimpleNamespace(at=lambda k: k)
    selected = SimpleNamespace(fits=fits, frames=frames)
    grid = torch.ones(B, *hw)
    base = SimpleNamespace(hw=hw, image=None)
    monkeypatch.setattr(validate.plane_sweep, "make_reference_view", lambda *x: base)
    monkeypatch.setattr(validate.dense, "downscale_grey", lambda *x: x)
    monkeypatch.setattr(validate.dense, "top_views", lambda *x: (index, torch.ones(2, B, dtype=torch.bool)))
    monkeypatch.setattr(validate.dense, "source_view_of", lambda selected, k, *more: k)
    of_view = Evidence(torch.zeros_like(grid), grid > 0, torch.tensor([0, 1]).view(B, 1, 1).expand(B, *hw).int())
    monkeypatch.setattr(validate.evidence, "photometric_evidence", lambda *x: of_view)

    def consistency(grid, base, source_views, maps, tolerance, options):
        seen.update(views=source_views, maps=maps)
        return of_view

    monkeypatch.setattr(validate.evidence, "depth_consistency_evidence", consistency)
    validated = validate._ValidatedMap(grid, None, selected, number, False)
    kinds = validate._view_evidences(validated, passed, 2, grid, DEFAULT_VALIDATION_OPTIONS)
    for rank, (views, maps) in enumerate(zip(seen["views"], seen["maps"], strict=True)):
        for b in range(B):
            n = int(number[views[b], b])
            assert bool((maps[b] == passed[n, b]).all()), (rank, b)
    for kind in kinds:  # numbered among the views passed
        assert [int(kind.view[b, 0, 0]) for b in range(B)] == [int(number[index[b, b], b]) for b in range(B)] == [1, 5]


@pytest.mark.parametrize("snr", [20.0, 40.0, 1e6])
def test_a_trajectory_measures_a_scale_no_better_than_its_baselines_are_known(snr):
    V, spread = 3, 0.02
    world = Pose(torch.eye(3).expand(1, 3, 3), torch.zeros(1, 3))
    steps = torch.tensor([0.1, 0.2, 0.3])
    t = torch.stack([steps, torch.zeros(V), torch.zeros(V)], -1)[:, None]
    eye = torch.eye(3).expand(V, 1, 3, 3)
    factor = 1.1 * torch.tensor([-spread, 0.0, spread]).exp()
    fits = SimpleNamespace(
        ok=torch.ones(V, 1, dtype=torch.bool),
        t_snr=torch.full((V, 1), snr),
        T_1_from_0=Pose(eye, -t * factor[:, None, None]),
    )
    frames = SimpleNamespace(T_world_from_cam=[Pose(eye[k], t[k]) for k in range(V)])
    reference = SimpleNamespace(T_world_from_cam=world, camera=SimpleNamespace(f=torch.ones(1, 2)))
    selected = SimpleNamespace(fits=fits, frames=frames)
    ratio, low, high = validate._scale_vs_trajectory(reference, selected, DEFAULT_VALIDATION_OPTIONS)[0].tolist()
    sd = math.sqrt((1.483 * spread) ** 2 + 1 / snr**2 + DEFAULT_VALIDATION_OPTIONS.trajectory_scale_sigma**2)
    expected = validate._factor_interval(torch.tensor([math.log(1.1)]), torch.tensor([sd]))[0].tolist()
    assert (ratio, low, high) == pytest.approx(expected, rel=1e-5) and ratio == pytest.approx(1.1)
