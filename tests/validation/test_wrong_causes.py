"""Why single pixels are wrong: ghosts below a sensor's minimum range, flying pixels, edges that bleed."""

import pytest
import torch

from dhtorch import AUTO, validate_depth
from dhtorch.codes import State, WrongCause
from dhtorch.geometry import plane_sweep
from dhtorch.metrics.detection import auroc
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pytree import stack
from dhtorch.synthetic import SyntheticRoom
from dhtorch.synthetic.depth_faults import apply_fault
from dhtorch.synthetic.near_card import CARD_DISTANCE_M, add_near_card, card_over_map
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS as OPTIONS
from dhtorch.validation.validate import validate_against
from dhtorch.validation.wrong_causes import extend_surface, flying_evidence, name_causes, outline_evidence

NEAR, ANCHOR, OTHERS = 2.0, 5, (3, 4, 6, 8, 11)
METHOD = AUTO.replace(n=768)
SMALL = {"method": METHOD, "size": 240}
NAN = float("nan")


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(180, 240), depth_hw=(90, 120), supersample=1, seed=0)


@pytest.fixture(scope="module")
def reference(room):
    return range_split(room[ANCHOR], NEAR)


@pytest.fixture(scope="module")
def true(room):
    return room.truth(ANCHOR)["depth"]


@pytest.fixture(scope="module")
def selected(room, reference):
    others = stack([range_split(room[k], NEAR) for k in OTHERS])
    trace = {}
    return dense.selected_views(METHOD(reference, others, trace=trace), others, trace)


def counted(validation, faulty, true):
    """Pixels with a state that are clearly wrong or clearly right, and which of them are wrong."""
    error = (faulty / true - 1).abs()
    used = validation.known & ((error > 0.2) | (error < 0.025))
    return used, (error > 0.2)


@pytest.mark.parametrize(
    ("name", "cause"), [("flying_pixel", WrongCause.FLYING_PIXEL), ("edge_bleed", WrongCause.EDGE_BLEED)]
)
def test_faults_at_outlines_are_detected_and_named(name, cause, true, reference, selected):
    faulty = apply_fault(name, true, seed=1)[0]
    validation = validate_against(faulty, reference, selected, **SMALL)
    used, wrong = counted(validation, faulty, true)
    assert auroc(validation.evidence.abs()[used], wrong[used]) > 0.93
    detected = wrong & (validation.state == State.WRONG)
    assert detected.sum() > 0.4 * wrong.sum()
    assert (validation.cause[detected] == cause).float().mean() > 0.8


def test_outlines_of_a_true_map_are_hardly_refuted(true, reference, selected):
    validation = validate_against(true, reference, selected, **SMALL)
    others = (validation.sparse_evidence, validation.photometric_evidence)
    refuted = torch.stack([x.abs() > OPTIONS.refuting_evidence_sigmas for x in others]).any(0)
    new = (validation.state == State.WRONG) & ~refuted
    assert new.sum() < 0.02 * validation.known.sum()
    assert ((validation.cause != WrongCause.NONE) == (validation.state == State.WRONG)).all()


def test_a_near_return_that_agrees_keeps_a_pixel(true, reference, selected):
    """A bleed that the depth sensor itself confirms at the pixel is no bleed; without other images none is found."""
    faulty = apply_fault("edge_bleed", true, seed=1)[0]
    confirmed = reference.replace(depth=faulty, depth_camera=None, conf=None)
    wrong = (faulty / true - 1).abs() > 0.2
    both, alone = (validate_against(faulty, each, selected, **SMALL) for each in (confirmed, reference))
    assert (both.state[wrong] == State.WRONG).sum() < 0.2 * (alone.state[wrong] == State.WRONG).sum()
    assert not validate_against(faulty, reference, selected, **SMALL, views=False).outline_evidence.isfinite().any()


def test_a_ghost_is_named_by_points_below_the_minimum_range(room, true):
    pose = room[ANCHOR].T_world_from_cam
    reference, card_depth = add_near_card(room[ANCHOR], pose, seed=0)
    others = stack([range_split(add_near_card(room[k], pose, seed=0)[0], NEAR) for k in OTHERS])
    with_card = card_over_map(true, card_depth)
    on_card = with_card < OPTIONS.min_sensor_range_m
    assert on_card.float().mean() > 0.02
    assert with_card[on_card].median().item() == pytest.approx(CARD_DISTANCE_M, rel=0.05)
    with pytest.raises(ValueError, match="has no pose"):
        add_near_card(room[ANCHOR].replace(T_world_from_cam=None), pose, seed=0)
    ghosts = apply_fault("ghost", with_card, seed=3)[0]
    assert (ghosts[on_card] >= 1).all() and torch.equal(ghosts[~on_card], with_card[~on_card])
    validation = validate_depth(ghosts, range_split(reference, NEAR), others, **SMALL)
    detected = on_card & (validation.state == State.WRONG)
    assert detected.sum() > 0.1 * on_card.sum()
    named = validation.cause == WrongCause.GHOST
    assert (named & on_card).sum() > 0.5 * detected.sum()
    assert (named & ~on_card).sum() < 0.1 * named.sum()


# -------------------------------------------------------------------------------------------------- on small maps


def two_sides(near=1.0, far=2.0):
    """Map (1, 12, 16) with its left half near and its right half far."""
    depth = torch.full((1, 12, 16), far)
    depth[..., :8] = near
    return depth


def test_a_pixel_between_two_sides_flies_and_a_thin_line_does_not():
    tolerance = torch.full((1, 12, 16), 0.025)
    depth = two_sides()
    assert not flying_evidence(depth, tolerance).misfit.isfinite().any(), "an outline is sound"
    depth[0, 5, 8], depth[0, 7, 7] = 1.7, 1.2
    misfit = flying_evidence(depth, tolerance).misfit
    assert misfit.isfinite().nonzero().tolist() == [[0, 5, 8], [0, 7, 7]]
    assert misfit[0, 5, 8] < -3, "nearer than the background that it belongs to"
    assert misfit[0, 7, 7] > 3, "farther than the foreground that it belongs to"
    line = two_sides()
    line[0, :, 8] = 1.5
    assert not flying_evidence(line, tolerance).misfit.isfinite().any()


def test_a_few_pixels_are_no_side():
    """Two pixels before one that is nearer than its background, or none."""
    depth = torch.full((1, 12, 16), 2.0)
    tolerance = torch.full_like(depth, 0.025)
    depth[0, 5, 8] = 1.5
    assert not flying_evidence(depth, tolerance).misfit.isfinite().any()
    depth[0, 5, 8], depth[0, 5, 9], depth[0, 6, 9] = 1.7, 1.0, 1.0
    assert not flying_evidence(depth, tolerance).misfit.isfinite().any()
    depth[0, 4, 9] = 1.0
    assert flying_evidence(depth, tolerance).misfit.isfinite().nonzero().tolist() == [[0, 5, 8]]


def test_a_surface_is_continued_by_as_many_pixels_as_steps():
    far = extend_surface(two_sides(), 3, 1.2, far=True)
    assert (far[..., 5:8] == 2).all() and (far[..., :5] == 1).all()
    near = extend_surface(two_sides(), 3, 1.2, far=False)
    assert (near[..., 8:11] == 1).all() and (near[..., 11:] == 2).all()
    assert torch.equal(extend_surface(two_sides(1.0, 1.1), 3, 1.2, far=True), two_sides(1.0, 1.1)), "no outline"
    hole = two_sides()
    hole[..., 6] = 0
    assert (extend_surface(hole, 3, 1.2, far=True)[..., 6] == 0).all(), "holes stay"


def test_outlines_without_views_are_not_examined(reference):
    base = plane_sweep.make_reference_view(*dense.downscale_grey(reference, 64))
    depth = torch.ones(1, *base.hw)
    depth[..., 20:] = 2
    found = outline_evidence(depth, base, [])
    assert not found.misfit.isfinite().any() and not found.unsupported.any() and (found.view == -2).all()


def test_the_cause_follows_from_where_a_pixel_lies_and_what_refutes_it():
    depth, none = two_sides(near=1.5, far=4.0), torch.full((1, 12, 16), NAN)
    state = torch.full((1, 12, 16), State.CONSISTENT)
    state[0, 5, 6:9] = State.WRONG
    misfit = torch.full((1, 12, 16), 5.0)
    misfit[0, 5, 6] = -5
    flying = torch.zeros_like(state, dtype=torch.bool)
    cause = name_causes(depth, state, misfit, none, flying)
    assert cause[0, 5, 6:9].tolist() == [WrongCause.EDGE_BLEED, WrongCause.OTHER, WrongCause.EDGE_BLEED]
    assert (cause == WrongCause.NONE).sum() == cause.numel() - 3
    flying[0, 5, 7] = True
    points = none.clone()
    points[0, 5, 8], points[0, 5, 6] = 0.2, 0.6
    cause = name_causes(depth, state, misfit, points, flying)
    assert cause[0, 5, 6:9].tolist() == [WrongCause.EDGE_BLEED, WrongCause.FLYING_PIXEL, WrongCause.GHOST]
    state[0, 9, 12] = State.WRONG
    assert name_causes(depth, state, misfit, points, flying)[0, 9, 12] == WrongCause.GHOST, "one surface of the map"


@pytest.mark.parametrize("size", [0.5, 5.0])
def test_evidence_of_any_size_points_to_one_side(size):
    depth, none = two_sides(near=1.5, far=4.0), torch.full((1, 12, 16), NAN)
    state, flying = torch.full((1, 12, 16), State.WRONG), torch.zeros(1, 12, 16, dtype=torch.bool)
    state[0, :5], state[0, 6:] = State.CONSISTENT, State.CONSISTENT
    for sign, bled in ((1.0, 8), (-1.0, 7)):
        cause = name_causes(depth, state, torch.full_like(depth, sign * size), none, flying)[0, 5]
        assert (cause[bled] == WrongCause.EDGE_BLEED) and (cause[15 - bled] == WrongCause.OTHER)


def test_a_wide_wrong_region_does_not_bleed():
    depth = torch.full((1, 40, 40), 1.0)
    depth[..., 20:] = 2
    state = torch.full((1, 40, 40), State.CONSISTENT)
    state[..., 20:] = State.WRONG
    misfit, flying = torch.full((1, 40, 40), 5.0), torch.zeros(1, 40, 40, dtype=torch.bool)
    cause = name_causes(depth, state, misfit, torch.full((1, 40, 40), NAN), flying)
    assert (cause[..., 20:] == WrongCause.OTHER).all()
    state[..., 24:] = State.CONSISTENT
    narrow = name_causes(depth, state, misfit, torch.full((1, 40, 40), NAN), flying)
    assert (narrow[..., 20:24] == WrongCause.EDGE_BLEED).all()
