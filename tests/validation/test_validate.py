"""Validation of depth maps: evidence for and against pixels, numbers of a frame, and causes of wrong pixels."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import interpolate

from dhtorch import AUTO, validate_depth
from dhtorch.codes import Flag, Gate, State, WrongCause
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.camera import Camera
from dhtorch.metrics.detection import auroc
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.surface import SourceView
from dhtorch.pytree import collate, stack
from dhtorch.records import Estimate, Pose, Samples
from dhtorch.synthetic import SyntheticRoom
from dhtorch.synthetic.depth_faults import apply_fault
from dhtorch.synthetic.near_card import CARD_DISTANCE_M, add_near_card, card_over_map
from dhtorch.validation import evidence, validate
from dhtorch.validation.evidence import (
    Evidence,
    ValidationReferences,
    depth_consistency_evidence,
    inflate_sigma,
    photometric_evidence,
    resolution_sigma,
    sparse_evidence,
    triangulated_depth,
    validation_references,
)
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS as OPTIONS
from dhtorch.validation.options import ValidationOptions
from dhtorch.validation.validate import (
    QUICK_METHOD,
    clipped_depth,
    combine_evidence,
    share_interval,
    validate_against,
)
from dhtorch.validation.wrong_causes import extend_surface, flying_evidence, name_causes, outline_evidence

NEAR, REFERENCE = 2.0, 5
SMALL = {"method": AUTO.replace(n=768), "size": 160}
SLOW = pytest.mark.slow


class Views(SimpleNamespace):
    """A reference view of the room with near returns alone, its true map, and source views."""

    @classmethod
    def numbered(cls, room, numbers):
        views = [range_split(room[k], NEAR) for k in (REFERENCE, *numbers)]
        true, maps = room.truth(REFERENCE)["depth"], torch.stack([room.truth(k)["depth"] for k in numbers])
        reference, others, trace = views[0], stack(views[1:]), {}
        estimate = SMALL["method"](reference, others, trace=trace)
        return cls(room=room, reference=reference, others=others, true=true, maps=maps,
                   selected=dense.selected_views(estimate, others, trace), moved=torch.zeros_like(true) > 0)  # fmt: skip

    def validate(self, depth, **options):
        return validate_depth(depth, self.reference, self.others, **SMALL | options)

    def against(self, depth, **options):
        return validate_against(depth, self.reference, self.selected, **SMALL | options)

    def alone(self, depth, **options):
        return validate_depth(depth, self.reference, **SMALL | options)


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(180, 240), depth_hw=(90, 120), supersample=1, seed=0)


@pytest.fixture(scope="module")
def s(room):
    views = Views.numbered(room, (0, 2, 8, 11))
    views.moved[:, 60:120, 70:140] = True
    views.sound = views.validate(views.true)
    return views


def on_grid(x, found):
    return interpolate(x[None].float(), found.state.shape[-2:], mode="nearest-exact")[0]


def right(found):
    return found.state == State.CONSISTENT


def wrong(found):
    return found.state == State.WRONG


def coarse(x, step):
    return x[..., step // 2 :: step, step // 2 :: step]


def is_near_one(interval):
    value, low, high = interval[0]
    return low < value < high and low < 1.02 and high > 0.98


def without_pose(frame):
    return frame.replace(T_world_from_cam=None)


def is_sound(s, found):
    # However many points agree, they share one sensor, or one trajectory.
    spans = {"scale_near": OPTIONS.sensor_scale_sigma, "scale_vs_trajectory": OPTIONS.trajectory_scale_sigma}
    return (
        found.known.float().mean() > 0.6,
        wrong(found).sum() < 0.1 * found.known.sum(),
        *(is_near_one(getattr(found, name)) for name in ("scale", "scale_near", "scale_far")),
        found.shift[0, 1] < 0 < found.shift[0, 2],
        *(getattr(found, k)[0, 1:].log().diff() > 2 * 1.96 * sigma for k, sigma in spans.items()),
    )


def is_of_contradicting_scales(s, found):
    near, far, both = (x[0].log() for x in (found.scale_near, found.scale_far, found.scale))
    # Agreeing, they would make it narrower than the near alone.
    return near[2] < far[1], near[0] < both[0] < far[0], both[2] - both[1] > 5 * (near[2] - near[1])


def tilted(side, tilt):
    def values(s):
        n = s.true.shape[side]
        place = ((torch.arange(n) + 0.5) / n - 0.5).reshape((n, 1) if side == -2 else (n,))
        return s.alone((1 + tilt * place) * s.true)

    return values


def has_tilt(tilt):
    return lambda s, found: (
        float(found.tilt[0, 0]) == pytest.approx(tilt, rel=0.05),
        0 < found.tilt[0, 1] < tilt < found.tilt[0, 2],
    )


def has_scale(factor):
    return lambda s, found: (
        *(
            abs(math.log(x[0, 0] / factor)) < 0.03 and not x[0, 1] <= 1 <= x[0, 2]
            for x in (found.scale, found.scale_near, found.scale_far)
        ),
        right(found).sum() < 0.4 * right(s.sound).sum(),
    )


def is_wrong_where_moved(s, found):
    inside = on_grid(s.moved, found) > 0
    return (
        (right(found) & inside).sum() <= 0.003 * inside.sum(),
        auroc(found.evidence.abs()[found.known], inside[found.known]) > 0.97,
        (found.evidence[inside & wrong(found)] > 0).float().mean() > 0.9,  # too far
    )


def is_unknown_where_far(s, found):
    near, far = on_grid(s.true, found) < 0.9 * NEAR, on_grid(s.true, found) > 1.2 * NEAR
    return (
        (found.known & near).sum() > 0.5 * near.sum(),
        not right(found)[far].any(),
        found.known[far].float().mean() < 0.02,  # returns that mix an edge
        found.photometric_evidence.isnan().all(),
        found.scale_far.isnan().all(),
    )


def knows_nothing(s, found):
    return not found.known.any(), found.scale.isnan().all(), (found.view == -2).all()


def is_contradicted_where_near(s, found):
    inside, compared = on_grid(s.moved, found) > 0, found.consistency_evidence.isfinite()
    refuted = found.consistency_evidence < -3
    return (
        refuted[compared & inside].float().mean() > 0.8,
        (compared & inside).sum() > 0.3 * inside.sum(),
        refuted[compared & ~inside].float().mean() < 0.1,
    )


def is_clipped(s, found):
    off = on_grid(s.true, found) > 1.2 * found.depth
    return (
        off.float().mean() > 0.3,
        not right(found)[off].any(),
        (right(found) & ~off).sum() > 0.5 * (~off).sum(),
        float(found.clip_depth[0]) == pytest.approx(2.55),
    )


def is_as_sound_as_fine(s, found):
    of = [float(wrong(x).sum() / x.known.sum()) for x in (found, s.sound)]
    return of[0] < of[1] + 0.02, found.known.float().mean() > 0.6 * s.sound.known.float().mean()


def turning(_):
    """A camera that only turns knows nothing of what is far."""
    room = SyntheticRoom(n_frames=6, hw=(180, 240), path="rotation", supersample=1, seed=0)
    near = [range_split(room[k], NEAR) for k in (0, 2, 5)]
    true = room.truth(2)["depth"]
    found = validate_depth(1.3 * true, near[1], stack([near[0], near[2]]), **SMALL)
    return right(found)[on_grid(true, found) > 1.2 * NEAR].float().mean()


def of_sensor(change):
    """The sensor's own map, 1.25 times too long, with or without a trajectory."""

    def values(s):
        views = [change(s.room[k].replace(depth=1.25 * s.room[k].depth)) for k in (REFERENCE, 0, 2, 8, 11)]
        return validate_depth(None, views[0], stack(views[1:]), **SMALL, views=False)

    return values


def dimmed(s):
    dim = s.others.replace(image=s.others.image.float() / 255 * 0.7 + 0.05)
    return validate_depth(s.true, s.reference.replace(image=s.reference.image.float() / 255), dim, **SMALL)


def is_like_sound(s, found):
    both = found.known & s.sound.known
    return both.sum() > 0.8 * s.sound.known.sum(), (found.state == s.sound.state)[both].float().mean() > 0.95


def with_blanks(n, good):
    """n views, of which all but the good ones show nothing and have maps that are ten times too far."""

    def values(s):
        blank = torch.full_like(s.others.image[0], 128)
        views = [s.others[k % 4] if k in good else s.others[k % 4].replace(image=blank) for k in range(n)]
        maps = torch.stack([s.maps[k % 4] * (1 if k in good else 10) for k in range(n)])
        return validate_depth(s.true, s.reference, stack(views), other_maps=maps, **SMALL)

    return values


def holed(s):
    return s.true.clone().index_fill_(2, torch.arange(120), torch.nan).index_fill_(1, torch.arange(60), 0.0)


def of_quick(method, step):
    """Scale of far points by one view beside the reference."""
    return lambda s: validate_depth(
        s.true, s.reference, range_split(s.room[REFERENCE + step], NEAR), method=method, views=False, size=160
    ).scale_far[0]


LOOSE = QUICK_METHOD.replace(triangulate={"min_t_snr": 10.0})

#: Case -> (answer for the views, what holds of it).
CASES = {
    "true map": (lambda s: s.sound, is_sound),
    "near and far contradict": (
        lambda s: s.against(torch.where(s.true > NEAR, 1.3 * s.true, s.true), views=False), is_of_contradicting_scales),
    **{f"tilt {k} {x}": (tilted(k, x), has_tilt(x)) for k in (-1, -2) for x in (0.2, 0.4)},
    **{
        f"scale {x:.1f}": (lambda s, x=x: s.validate(x * s.true, views=False), has_scale(x), *[SLOW] * (x < 1))
        for x in (1.1, 1 / 1.1)
    },
    "moved": (lambda s: s.validate(torch.where(s.moved, 1.6 * s.true, s.true)), is_wrong_where_moved),
    "near returns alone": (lambda s: s.alone(s.true), is_unknown_where_far),
    "sensor alone": (lambda s: validate_depth(None, s.room[REFERENCE], **SMALL), knows_nothing),
    "turning": (turning, lambda s, found: (found < 0.003,)),
    # Motions that few points hold loosely are too short: of a true map they would say that it is too far.
    **{
        f"quick {step}": (of_quick(QUICK_METHOD, step), lambda s, found: (found.isnan().all(),), SLOW)
        for step in (-1, 1)
    },
    "quick, loose": (
        lambda s: torch.stack([of_quick(LOOSE, step)(s) for step in (-1, 1)]),
        lambda s, found: ((found[:, 0] > 1.05).all(), (found[:, 1] > 1).any()), SLOW),
    "quick, wide": (of_quick(QUICK_METHOD, 3), lambda s, found: (found.isfinite().all(),), SLOW),
    "sensor beside a trajectory": (
        of_sensor(lambda x: x),
        lambda s, found: (
            found.scale[0, 1] < 1.25 < found.scale[0, 2], not found.scale[0, 1] <= 1 <= found.scale[0, 2],
            found.scale_near.isnan().all()), SLOW),
    "sensor without one": (of_sensor(without_pose), lambda s, found: (found.scale.isnan().all(),), SLOW),
    "exposure": (dimmed, is_like_sound, SLOW),
    "maps of views": (
        lambda s: s.validate(torch.where(s.moved, 0.6 * s.true, s.true), other_maps=s.maps), is_contradicted_where_near),
    # An outline lies anywhere between two pixels of a coarse map, and what is before it may be either's.
    **{
        f"maps of views, coarse {k}": (
            lambda s, k=k: s.against(s.true, other_maps=coarse(s.maps, k)),
            lambda s, found: (not (found.consistency_evidence < -3).any(),), *[SLOW] * (k == 4))
        for k in (4, 8)
    },
    **{
        f"coarse {k}": (
            lambda s, k=k: s.validate(coarse(s.true, k), other_maps=coarse(s.maps, k)), is_as_sound_as_fine,
            *[SLOW] * (k == 4))
        for k in (4, 8)
    },
    "coarse, scaled": (
        lambda s: s.validate(1.1 * coarse(s.true, 8), views=False),
        lambda s, found: (not found.scale[0, 1] <= 1 <= found.scale[0, 2],)),
    **{
        f"views {good} of {n}": (
            with_blanks(n, good), lambda s, found, g=good: (
                set(found.view.unique().tolist()) == {-2, -1, *g}, (found.consistency_evidence < -3).float().mean() < 0.02),
            *[SLOW] * (n == 2))
        for n, good in ((2, (1,)), (7, (3, 6)))
    },
    # A byte in centimetres: nothing is farther than 2.55 m.
    "clipped": (lambda s: s.validate((s.true * 100).round().clamp_max(255) / 100), is_clipped),
    "holes": (
        lambda s: s.validate(holed(s)), lambda s, found: (not found.known[on_grid(~(holed(s) > 0), found) > 0].any(),)),
    "no depth": (
        lambda s: s.validate(torch.zeros_like(s.true)),
        lambda s, found: (not found.known.any(), found.wrong.isnan().all())),
    # One option of each kind: evidence, states and numbers of the frame.
    "option of evidence": (
        lambda s: s.validate(s.true, options=ValidationOptions(min_filled_ratio=1.1)),
        lambda s, found: (not found.photometric_evidence.isfinite().any(),), SLOW),
    "option of states": (
        lambda s: s.validate(s.true, views=False, options=ValidationOptions(refuting_evidence_sigmas=1.0)),
        lambda s, found: (wrong(found).sum() > wrong(s.sound).sum(),), SLOW),
    "option of numbers": (
        lambda s: s.validate(s.true, views=False, options=ValidationOptions(min_scale_references=10_000)),
        lambda s, found: (found.scale.isnan().all(),), SLOW),
}  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(case[:2], id=name, marks=case[2:]) for name, case in CASES.items()])
def test_states_of_pixels_and_numbers_of_a_frame(case, s):
    values, check = case
    conditions = check(s, values(s))
    assert all(conditions), conditions


def test_a_batch_is_validated_as_its_members(s):
    """Members select other views, whose maps are compared and whose numbers are reported."""
    numbers, other = (11, 3, 0, 8, 2, 9, 7), range_split(s.room[1], NEAR)
    views = stack([range_split(s.room[k], NEAR) for k in numbers])
    of_views = torch.stack([s.room.truth(k)["depth"] for k in numbers])
    maps = torch.cat([torch.where(s.moved, 0.6 * s.true, s.true), 0.9 * s.room.truth(1)["depth"]])
    both, options = collate([s.reference, other]), {**SMALL, "size": 80}
    wide, wide_maps = views.map(lambda x: x.expand(-1, 2, *x.shape[2:])), of_views.expand(-1, 2, -1, -1)
    together = validate_depth(maps, both, wide, other_maps=wide_maps, **options)
    for k, reference in enumerate((s.reference, other)):
        alone = validate_depth(maps[k : k + 1], reference, views, other_maps=of_views, **options)
        assert torch.equal(together.state[k], alone.state[0]) and torch.equal(together.view[k], alone.view[0])
        torch.testing.assert_close(together.consistency_evidence[k], alone.consistency_evidence[0], equal_nan=True)
        assert torch.allclose(together.scale[k], alone.scale[0])


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda d: d > 1, {}, "depth_map is of bool, expected real numbers"),
        (lambda d: d.to(torch.complex64), {}, "depth_map is of complex64"),
        (lambda d: d[:, :1, :1], {}, "at least 2×2 pixels"),
        (lambda d: d[:, :, :1], {}, "at least 2×2 pixels"),
        (lambda d: d[:, :0, :0], {}, r"depth_map has shape \(.*1, 0, 0\), expected at least 2×2 pixels"),
        (lambda d: d, {"tolerance": 0.2}, "validate_depth: "),
        (lambda d: d, {"tolerance": 0}, "validate_depth: "),
        (lambda d: d, {"size": 4}, "validate_depth: "),
        (lambda d: d, {"source_views": 0}, "validate_depth: "),
        (lambda d: d.expand(2, -1, -1), {}, "validate_depth: "),
    ],
)
def test_wrong_maps_and_options_are_refused(change, options, message, s):
    with pytest.raises(ValueError, match=message):
        validate_depth(change(s.true), s.reference, **options)
    if "2×2" in message or "is of" in message:
        with pytest.raises(ValueError, match=message.replace("depth_map", "other_maps")):
            validate_depth(s.true, s.reference, other_maps=change(s.true)[None])


def test_a_wall_at_the_end_of_a_map_is_not_clipped_and_neither_is_a_wrong_scale():
    grid = torch.full((4, 20, 20), 2.0)
    grid[:, :, 10:] = 3.0
    state, misfit = torch.full(grid.shape, State.CONSISTENT), torch.zeros_like(grid)
    state[1:, :, 10:], misfit[1, :, 10:] = State.WRONG, 5.0  # too far
    state[2], misfit[2:] = State.WRONG, -5.0  # all too near
    depth, at = clipped_depth(grid, state, misfit)
    assert depth[:3].isnan().all() and not at[:3].any()
    assert depth[3] == 3 and torch.equal(at[3], grid[3] == 3)


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
    bound = 1.96**2 / (n + 1.96**2)
    extremes = share_interval(torch.tensor([0.0, n]), torch.tensor([n, n]))
    torch.testing.assert_close(extremes, torch.tensor([[0.0, 0.0, bound], [1.0, 1 - bound, 1.0]]))


@pytest.mark.parametrize("snr", [20.0, 40.0, 1e6])
def test_a_trajectory_measures_a_scale_no_better_than_its_baselines_are_known(snr):
    V, spread, eye = 3, 0.02, torch.eye(3).expand(1, 3, 3)
    t = torch.tensor([[[0.1 * k, 0.0, 0.0]] for k in range(1, V + 1)])
    factor = 1.1 * torch.tensor([-spread, 0.0, spread]).exp()
    motions = Pose(eye.expand(V, 1, 3, 3), -t * factor[:, None, None])
    fits = SimpleNamespace(ok=torch.ones(V, 1) > 0, t_snr=torch.full((V, 1), snr), T_1_from_0=motions)
    frames = SimpleNamespace(T_world_from_cam=[Pose(eye, t[k]) for k in range(V)])
    reference = SimpleNamespace(T_world_from_cam=Pose(eye, 0 * t[0]), camera=SimpleNamespace(f=torch.ones(1, 2)))
    found = validate._scale_vs_trajectory(reference, SimpleNamespace(fits=fits, frames=frames), OPTIONS)[0].tolist()
    sd = math.sqrt((1.483 * spread) ** 2 + 1 / snr**2 + OPTIONS.trajectory_scale_sigma**2)
    assert found == pytest.approx([1.1 * math.exp(k * 1.96 * sd) for k in (0, -1, 1)], rel=1e-3)


# ---------------------------------------------------------------------------------------------------- kinds of evidence

HW = (24, 32)
FLAT = torch.full((1, *HW), 2.0)


def references(uv, depth, sigma=0.01, shared=0.0, near=False):
    """References at pixels (N, 2) of an image of ``HW``."""
    uv = torch.tensor(uv, dtype=torch.float32)[None]
    full = [torch.as_tensor(x, dtype=torch.float32).expand(1, uv.shape[1]) for x in (depth, sigma, shared)]
    return ValidationReferences(uv, *full, used=full[0] > 0, near=torch.full_like(full[0], near) > 0)


def beside(t, use=True):
    """A reference view, and a source view ``t`` m to its right."""
    camera = Camera(torch.tensor([[40.0, 40.0]]), torch.tensor([[15.5, 11.5]]))
    image = torch.rand(1, 1, *HW, generator=torch.Generator().manual_seed(0))
    T = se3.exp(torch.tensor([[0.0, 0.0, 0.0, t, 0.0, 0.0]]))
    fit = SimpleNamespace(cov=1e-8 * torch.eye(6)[None], shutter=None, ok=torch.tensor([True]), T_1_from_0=T)
    view = plane_sweep.SweptView(image, camera, T)
    return plane_sweep.make_reference_view(image, camera), SourceView(
        view, image.expand(-1, 3, -1, -1), fit, torch.tensor([use])
    )


def test_a_return_replaces_the_answer_at_its_pixel():
    zero, two = torch.zeros(1, 2), torch.tensor([[1.0, 2.0]])
    flag, xyz = torch.tensor([[0, Flag.BEYOND_NEAR]]).int(), torch.tensor([[[1.0] * 3, [torch.nan] * 3]])
    uv = torch.tensor([[[3.0, 3.0], [9.0, 9.0]]])
    samples = Samples(uv, two, 0.01 * two, xyz, zero + 1, flag, zero + 1, zero.int())
    answers = Estimate.unanswered(samples, Gate.ANSWER, n_views=2)
    answers = answers.replace(depth=3 * two, sigma=0.1 * two, sigma_shared=0.05 * two)
    found = validation_references(samples, answers, near=True)
    assert found.depth.tolist() == [[1.0, 6.0]] and found.near.tolist() == [[True, False]]
    assert found.shared[0, 0] == 0 < found.shared[0, 1], "a return shares no motion"


def test_references_that_disagree_have_the_sigma_of_their_difference():
    middle, spread = (0.5 * (math.log(2 / 1.2) + k * math.log(2 / 1.9)) for k in (1, -1))
    for depths, mean, sd in (([1.5, 1.5], math.log(2 / 1.5), 0), ([1.2, 1.9], middle, spread)):
        found = sparse_evidence(FLAT, HW, references([[10, 10], [14, 10]], depths), 0.02)
        assert found.misfit[0, 10, 12] == pytest.approx(mean / math.sqrt(0.01**2 + 0.02**2 + sd**2), rel=1e-3)
        assert found.sure[0, 10, 12] == (sd == 0)


def test_a_reference_counts_on_its_own_surface_of_the_map_with_the_resolution_of_its_pixel():
    step = torch.where(torch.arange(HW[1]) < 16, 1.0, 3.0).expand(1, *HW)
    found = sparse_evidence(step, HW, references([[15, 10]], 1.0), 0.02).misfit
    assert found[0, 10, 14] == found[0, 10, 15] == 0 and found[..., 16:].isnan().all()
    resolution = torch.zeros(1, 12, 16)
    resolution[0, 5, 5] = 0.03
    found = inflate_sigma(references([[10.5, 10.5], [20, 20]], 2.0, sigma=0.04), resolution, HW)
    torch.testing.assert_close(found.sigma, torch.tensor([[0.05, 0.04]]))


STEP = torch.tensor([[[1.0, 1.0, 3.0, 3.0]]]).expand(1, 2, 4)
HOLED = torch.where(torch.arange(4) == 2, 0.0, STEP)  # a step to no value is none
EXTENT = math.log(3) * torch.tensor([0, 0, 0, 0.25, 0.25, 0, 0, 0]).sqrt()


@pytest.mark.parametrize(
    ("depth", "hw", "extent"),
    [
        (STEP, (2, 4), 0.0),  # as fine as its grid
        (STEP, (1, 2), 0.0),  # finer
        (STEP.mT, (2, 4), 0.0),  # finer down, and coarser across, without a step there
        (HOLED, (4, 8), 0.0),
        (STEP, (4, 8), EXTENT),
    ],
)
def test_the_extent_of_a_pixel_is_how_far_the_next_one_may_be_true(depth, hw, extent):
    torch.testing.assert_close(resolution_sigma(depth, hw), torch.as_tensor(extent).expand(1, *hw))


def test_of_several_views_the_least_misfit_counts_and_a_pixel_without_a_depth_has_none(monkeypatch):
    base, view = beside(0.1)
    misfit = (5.0, -2.0, 4.0, 0.5)
    of_view = lambda q, base, p, tolerance, options: (torch.full_like(q, misfit[p.fit]), q > 0)  # noqa: E731
    monkeypatch.setattr(evidence, "_view_evidence", of_view)
    views = [view._replace(fit=k, use=torch.tensor([k < 3])) for k in range(4)]
    depth = FLAT.clone()
    depth[0, 10, 10] = 0
    found = photometric_evidence(depth, base, views, 0.02)
    assert (found.misfit[depth > 0] == -2).all() and (found.view[depth > 0] == 1).all()
    assert found.misfit[0, 10, 10].isnan()


def test_the_best_rival_depth_is_named_with_its_factor(monkeypatch):
    likes = dict.fromkeys(OPTIONS.rival_factors, 0.1) | {0.58: 0.95, 1.14: 0.6}

    def fit(base, view, image, at, *, radius):
        value = likes[min(likes, key=lambda k: abs(k - float(at[0, 0, 0]) / 0.5))]
        return SimpleNamespace(correlation=torch.full_like(at, value), seen=torch.ones_like(at) > 0)

    monkeypatch.setattr(plane_sweep, "fit_windows", fit)
    best, factor, neighbour = (float(x[0, 5, 5]) for x in evidence._rivals(1 / FLAT, *beside(0.1), OPTIONS))
    is_neighbour = 0.7 < -math.log(0.58) / OPTIONS.detectable_log_ratio < 3
    assert (best, factor, neighbour) == pytest.approx((0.95, 0.58, 0.95 if is_neighbour else 0.6))


def test_no_evidence_outside_the_other_view_or_where_the_lens_has_no_ray(monkeypatch):
    base, view = beside(0.4)
    misfit, sure = evidence._view_evidence(0 * FLAT + 1, base, view, 0.02, OPTIONS)
    assert misfit[0, :, -10:].isnan().all() and not sure[0, :, -10:].any(), "its field ends there"
    base, view = beside(0.1)
    q = 1 / FLAT
    window = SimpleNamespace(
        seen=q > 0, correlation=q * 0 + 0.99, noise=q * 1e-6, contrast=q, step=q * 0.1,
        motion=torch.full((1, *HW, 2), 4.0),
    )  # fmt: skip
    monkeypatch.setattr(plane_sweep, "fit_windows", lambda *args, **options: window)
    monkeypatch.setattr(evidence, "_rivals", lambda *args: (q * 0 + 0.1, q * 0 + 1.14, q * 0 + 0.1))
    known = (torch.arange(HW[1]) >= 5).expand(1, *HW)
    misfit, sure = evidence._view_evidence(q, base.replace(known=known.flatten(1)), view, 0.02, OPTIONS)
    assert torch.equal(misfit.isfinite(), known) and torch.equal(sure, known)


def test_maps_refute_only_nearer_surfaces_between_views_that_stand_apart():
    """A surface in front of the other view's map: one of the two is wrong. What lies behind may be occluded."""
    for near, far, t, refuted in ((1.0, 3.0, 0.6, True), (1.0, 3.0, 1e-4, False), (3.0, 1.0, 0.6, False)):
        base, view = beside(t)
        found = depth_consistency_evidence(FLAT * 0 + near, base, [view], [FLAT * 0 + far], 0.02)
        known = found.misfit.isfinite()
        assert bool(known.any()) == refuted and (found.misfit[known] < -3).all() and not found.sure.any()


def test_sparse_evidence_of_a_batch_is_that_of_its_members():
    draw = torch.Generator().manual_seed(3)
    maps = [1 + k + torch.rand(1, *HW, generator=draw).cumsum(-1) / 9 for k in range(3)]
    place = [(torch.rand(12, 2, generator=draw) * torch.tensor([31.0, 23.0])).tolist() for _ in range(3)]
    points = [references(place[k], 1.2 + k, 0.01 + 0.02 * k) for k in range(3)]
    batch = ValidationReferences(*(torch.cat(part) for part in zip(*points, strict=True)))
    together = (*sparse_evidence(torch.cat(maps), HW, batch, 0.02), triangulated_depth(torch.cat(maps), HW, batch))
    for k in range(3):
        alone = (*sparse_evidence(maps[k], HW, points[k], 0.02), triangulated_depth(maps[k], HW, points[k]))
        torch.testing.assert_close([x[k] for x in together], [x[0] for x in alone], equal_nan=True)
        assert alone[0].isfinite().any() and alone[3].isfinite().any()


# ----------------------------------------------------------------------------------------------- causes of wrong pixels


@pytest.fixture(scope="module")
def outlines(room):
    views = Views.numbered(room, (3, 4, 6, 8, 11))
    views.faulty = apply_fault("edge_bleed", views.true, seed=1)[0]
    return views


def fine(outlines, depth, **options):
    return outlines.against(depth, size=240, **options)


@pytest.mark.parametrize(
    ("name", "cause"), [("flying_pixel", WrongCause.FLYING_PIXEL), ("edge_bleed", WrongCause.EDGE_BLEED)]
)
def test_faults_at_outlines_are_detected_and_named(name, cause, outlines):
    faulty = apply_fault(name, outlines.true, seed=1)[0]
    found, error = fine(outlines, faulty), (faulty / outlines.true - 1).abs()
    used, is_wrong = found.known & ((error > 0.2) | (error < 0.025)), error > 0.2
    detected = is_wrong & wrong(found)
    assert auroc(found.evidence.abs()[used], is_wrong[used]) > 0.93 and detected.sum() > 0.4 * is_wrong.sum()
    assert (found.cause[detected] == cause).float().mean() > 0.8


def test_outlines_of_a_true_map_are_hardly_refuted_and_returns_that_agree_keep_a_pixel(outlines):
    """A bleed that the depth sensor itself confirms at the pixel is no bleed; without other images none is found."""
    found = fine(outlines, outlines.true)
    others = (found.sparse_evidence, found.photometric_evidence)
    refuted = torch.stack([x.abs() > OPTIONS.refuting_evidence_sigmas for x in others]).any(0)
    assert (wrong(found) & ~refuted).sum() < 0.02 * found.known.sum()
    assert ((found.cause != WrongCause.NONE) == wrong(found)).all()
    confirmed = outlines.reference.replace(depth=outlines.faulty, depth_camera=None, conf=None)
    is_wrong = (outlines.faulty / outlines.true - 1).abs() > 0.2
    alone, both = (
        (wrong(fine(Views(**vars(outlines) | {"reference": x}), outlines.faulty)) & is_wrong).sum()
        for x in (outlines.reference, confirmed)
    )
    assert both < 0.2 * alone
    assert not fine(outlines, outlines.faulty, views=False).outline_evidence.isfinite().any()
    base = plane_sweep.make_reference_view(*dense.downscale_grey(outlines.reference, 64))
    none = outline_evidence(torch.where(torch.arange(base.hw[1]) < 20, 1.0, 2.0).expand(1, *base.hw), base, [])
    assert not none.misfit.isfinite().any() and not none.unsupported.any() and (none.view == -2).all()


def test_a_ghost_is_named_by_points_below_the_minimum_range(room, outlines):
    pose = room[REFERENCE].T_world_from_cam
    reference, card_depth = add_near_card(room[REFERENCE], pose, seed=0)
    others = stack([range_split(add_near_card(room[k], pose, seed=0)[0], NEAR) for k in (3, 4, 6, 8, 11)])
    with_card = card_over_map(outlines.true, card_depth)
    on_card = with_card < OPTIONS.min_sensor_range_m
    assert on_card.float().mean() > 0.02
    assert with_card[on_card].median().item() == pytest.approx(CARD_DISTANCE_M, rel=0.05)
    with pytest.raises(ValueError, match="has no pose"):
        add_near_card(without_pose(room[REFERENCE]), pose, seed=0)
    ghosts = apply_fault("ghost", with_card, seed=3)[0]
    assert (ghosts[on_card] >= 1).all() and torch.equal(ghosts[~on_card], with_card[~on_card])
    found = validate_depth(ghosts, range_split(reference, NEAR), others, **SMALL | {"size": 240})
    detected, named = on_card & wrong(found), found.cause == WrongCause.GHOST
    assert detected.sum() > 0.1 * on_card.sum() and (named & on_card).sum() > 0.5 * detected.sum()
    assert (named & ~on_card).sum() < 0.1 * named.sum()


def two_sides(near=1.0, far=2.0, hw=(12, 16), at=8, **pixels):
    """Map (1, h, w) that is near left of a column and far right of it, with some pixels of its own."""
    depth = torch.where(torch.arange(hw[1]) < at, near, far).repeat(1, hw[0], 1)
    for name, value in pixels.items():
        depth[0, int(name[1:3]), int(name[3:])] = value
    return depth


@pytest.mark.parametrize(
    ("depth", "flying"),
    [
        (two_sides(), {}),  # an outline is sound
        # nearer than the background that it belongs to, and farther than the foreground
        (two_sides(p0508=1.7, p0707=1.2), {(5, 8): -1, (7, 7): 1}),
        (two_sides(**{f"p{k:02d}08": 1.5 for k in range(12)}), {}),  # a thin line
        (two_sides(2.0, p0508=1.5), {}),  # nothing, and two pixels, before one that is nearer than its background
        (two_sides(2.0, p0508=1.7, p0509=1.0, p0609=1.0), {}),
        (two_sides(2.0, p0508=1.7, p0509=1.0, p0609=1.0, p0409=1.0), {(5, 8): -1}),
    ],
)
def test_a_pixel_between_two_sides_flies(depth, flying):
    misfit = flying_evidence(depth, torch.full_like(depth, 0.025)).misfit[0]
    assert {tuple(x): int(misfit[tuple(x)].sign()) for x in misfit.isfinite().nonzero().tolist()} == flying
    assert (misfit[misfit.isfinite()].abs() > 3).all()


@pytest.mark.parametrize(
    ("depth", "is_far", "expected"),
    [
        (two_sides(), True, two_sides(at=5)),
        (two_sides(), False, two_sides(at=11)),
        (two_sides(1.0, 1.1), True, two_sides(1.0, 1.1)),  # no outline
    ],
)
def test_a_surface_is_continued_by_as_many_pixels_as_steps(depth, is_far, expected):
    assert torch.equal(extend_surface(depth, 3, 1.2, far=is_far), expected)
    holed = torch.where(torch.arange(16) == 6, 0.0, depth)
    assert (extend_surface(holed, 3, 1.2, far=is_far)[..., 6] == 0).all(), "holes stay"


BLEED, FLIES, GHOST, OTHER = WrongCause.EDGE_BLEED, WrongCause.FLYING_PIXEL, WrongCause.GHOST, WrongCause.OTHER
WIDE = {"hw": (40, 40), "at": 20}


@pytest.mark.parametrize(
    ("sides", "is_wrong", "misfit", "points", "flying", "expected"),
    [
        # Pixels 6 to 8 of a row: too near, too far, too far beside an outline between 7 and 8
        ({}, (5, slice(6, 9)), {6: -5.0}, {}, (), {6: BLEED, 7: OTHER, 8: BLEED}),
        ({}, (5, slice(6, 9)), {6: -5.0}, {8: 0.2, 6: 0.6}, (7,), {6: BLEED, 7: FLIES, 8: GHOST}),
        ({}, (5, 12), {}, {12: 0.2}, (), {12: GHOST}),  # one surface of the map
        *(
            ({}, (5, slice(None)), dict.fromkeys(range(16), sign * size), {}, (), {bled: BLEED, 15 - bled: OTHER})
            for size in (0.5, 5.0)
            for sign, bled in ((1.0, 8), (-1.0, 7))
        ),
        (WIDE, (slice(None), slice(20, 40)), {}, {}, (), dict.fromkeys(range(20, 40), OTHER)),  # too wide to bleed
        (WIDE, (slice(None), slice(20, 24)), {}, {}, (), dict.fromkeys(range(20, 24), BLEED)),
    ],
)
def test_the_cause_follows_from_where_a_pixel_lies_and_what_refutes_it(
    sides, is_wrong, misfit, points, flying, expected
):
    depth = two_sides(1.5, 4.0, **sides) if not sides else two_sides(**sides)
    state, flies = torch.full(depth.shape, State.CONSISTENT), torch.zeros_like(depth) > 0
    off, triangulated = torch.full_like(depth, 5.0), torch.full_like(depth, torch.nan)
    state[0, *is_wrong] = State.WRONG
    for values, row in ((misfit, off), (points, triangulated), (dict.fromkeys(flying, True), flies)):
        for column, value in values.items():
            row[0, 5, column] = value
    cause = name_causes(depth, state, off, triangulated, flies)
    assert {k: int(cause[0, 5, k]) for k in expected} == expected
    assert torch.equal(cause != WrongCause.NONE, state == State.WRONG)
