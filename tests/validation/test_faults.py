"""Faults that all maps of a window share are named by undoing them, and nothing else is."""

import math
import re

import pytest
import torch

from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import rescale_field_of_view
from dhtorch.metrics.holdout import range_split
from dhtorch.records import Frame
from dhtorch.synthetic import SyntheticRoom
from dhtorch.synthetic.depth_faults import mirror_depth
from dhtorch.synthetic.paths import hand_held_path
from dhtorch.validation.faults import (
    KNOWN_FAULTS,
    NO_FAULT,
    TRACKING_METHOD,
    UNIT_FACTORS,
    FaultWindow,
    SampleLosses,
    WindowTracks,
    diagnose,
    ray_lengths,
    rot90_map,
    select_cause,
    track_window,
    undo_fault,
)
from dhtorch.validation.options import ValidationOptions

N, FIRST = 16, 4
METHOD = TRACKING_METHOD.replace(n=256)
UNWATCHED = WindowTracks((), (), ())  # no pair in which anything moves


@pytest.fixture(scope="module")
def frames():
    room = SyntheticRoom(n_frames=N, hw=(180, 240), depth_hw=(90, 120), supersample=1, seed=1, step_m=0.03)
    return [room[k] for k in range(N)]


@pytest.fixture(scope="module")
def watched(frames):
    return track_window(frames, METHOD)


def along_the_ray(depth):
    camera = SyntheticRoom(hw=(180, 240), n_frames=1, supersample=1)[0].camera
    return depth * ray_lengths(cam.resize(camera, (180, 240), (90, 120)), (90, 120))


#: Fault → its kind, and how it is planted; an inverse of the sensor's own has no returns to be held against.
FAULTS = {
    "unit": ("unit", lambda d: 1000 * d),
    "mirrored": ("mirrored", mirror_depth),
    "upside down": ("mirrored", lambda d: d.flip(-2)),
    "rolled": ("rolled", lambda d: rot90_map(d, 1)),
    "registration": ("registration", lambda d: rescale_field_of_view(d, 1 / 1.35)),
    "along the ray": ("along the ray", along_the_ray),
    "inverse": ("inverse", lambda d: torch.where(d > 0, 7 / d.clamp_min(0.1), 0.0)),
}


def planted(frames, spoilt, own):
    """Frames and maps: spoilt depths as the sensor's own, or beside a sensor that sees 2 m, without a trajectory."""
    if own:
        return [f.replace(depth=d) for f, d in zip(frames, spoilt, strict=True)], None
    return [range_split(f, 2.0).replace(T_world_from_cam=None) for f in frames], spoilt


@pytest.fixture(scope="module")
def panned():
    """A camera that walks and looks 3 degrees farther to the left each frame, so that maps of other frames differ."""
    poses = hand_held_path("walk", N, step_m=0.06, rate_hz=30.0, seed=1, pan=(24.0, -3.0))
    room = SyntheticRoom(n_frames=N, hw=(180, 240), depth_hw=(90, 120), supersample=1, seed=1, true_poses=poses)
    shown = [room[k] for k in range(N)]
    return shown, track_window(shown, METHOD)


SEEN = "not registered: seen over "


def late(frames, lag):
    return [frames[min(max(k - lag, 0), N - 1)].depth for k in range(N)]


def each(plant):
    return lambda frames: [plant(frame.depth) for frame in frames]


#: Fault -> (what it makes of the depths, kind or None, start of the cause); some of each with the slow tests.
PLANTED = {
    **{name: (each(plant), kind, "") for name, (kind, plant) in FAULTS.items()},
    **{f"unit {name}": (each(lambda d, x=x: d / x), "unit", name) for name, x in UNIT_FACTORS.items()},
    **{
        f"lag {k}": (lambda f, k=k: late(f, k), "time offset", f"3 frames {'late' if k > 0 else 'early'}")
        for k in (3, -3)
    },
    **{f"no unit {x}": (each(lambda d, x=x: x * d), None, "") for x in (1.6, 0.5, 7.0)},
    # Depths that are bent are explained a little as lengths of rays or as inverse depth, and not by half.
    **{f"bent {x}": (each(lambda d, x=x: d**x), None, "") for x in (1.15, 0.7)},
    **{
        f"field {x}": (each(lambda d, x=x: rescale_field_of_view(d, 1 / x)), "registration", f"{SEEN}{bound}")
        for x, bound in ((1.6, ""), (0.65, ""), (1.95, "at least "), (0.5, "at most "))
    },
}
OWN = [name for name in PLANTED if name in FAULTS or name[:4] in ("unit", "lag ")]
UNITS = [name for name in PLANTED if name.startswith("unit ")]


def is_slow(name, own):
    if name in FAULTS:
        return list(FAULTS).index(name) % 2 == own
    if name in UNITS:
        return UNITS.index(name) % 4 != 2 * own
    return name in ("field 0.65", "field 0.5") or name.startswith("no unit") or (name.startswith("lag") and own)


@pytest.mark.parametrize(
    ("name", "own"),
    [
        pytest.param(name, own, marks=[pytest.mark.slow] * is_slow(name, own))
        for name in PLANTED
        for own in (True, False)
        if not own or (name in OWN and name != "inverse")
    ],
)
def test_a_planted_fault_is_named(name, own, frames, watched, panned):
    plant, kind, cause = PLANTED[name]
    frames, watched = panned if name.startswith("lag") else (frames, watched)
    shown, maps = planted(frames, plant(frames), own)
    found = diagnose(shown, maps, method=METHOD, watched=watched)
    assert found.kind == kind and (kind is None or found.cause.startswith(cause)) and found.n_pairs >= 4
    if name.startswith("field") and "at " not in cause:
        field = float(re.fullmatch(rf"{SEEN}(?:at \w+ )?(\d\.\d\d) of the picture's field", found.cause)[1])
        assert field == pytest.approx(float(name[6:]), rel=0.13)


def test_what_the_window_cannot_show_is_not_named(frames, watched):
    """A lag as long as it; the unit of a sensor, or its focal length, without a trajectory; nothing that is tracked."""
    found = diagnose(frames[:5], method=METHOD)
    assert found.n_pairs == 4
    assert {"none", "4 frames late", "1 frames early"} < set(found.loss)
    assert not {"5 frames late", "5 frames early"} & set(found.loss)
    shown = [f.replace(depth=1000 * f.depth, T_world_from_cam=None) for f in frames]
    unknown = diagnose(shown, method=METHOD, watched=watched)
    assert unknown.cause is None and not any("focal" in name for name in unknown.loss)
    blank = diagnose([f.replace(image=torch.full_like(f.image, 128)) for f in frames], method=METHOD)
    assert blank.cause is None and blank.n_pairs == 0


@pytest.mark.slow
def test_a_wrong_focal_length_is_named_with_a_trajectory(frames, watched):
    long = [f.replace(camera=f.camera.replace(f=1.15 * f.camera.f)) for f in frames]
    assert diagnose(long, method=METHOD, watched=watched).kind == "focal length"


def test_pairs_are_as_wide_as_tracks_hold(frames):
    """Two takes of four frames, the second upside down: a pair across the cut shows no point twice."""
    takes = [*frames[:4], *(frame.replace(image=frame.image.flip(-2)) for frame in frames[4:8])]
    first = [(0, 2), (1, 3), (2, 3)]
    assert list(track_window(frames[:4], METHOD).pairs) == first
    assert list(track_window(takes, METHOD).pairs) == [*first, (4, 6), (5, 7), (6, 7)]
    assert track_window(frames[:4], METHOD, ValidationOptions(min_tracked_ratio=2.0)).pairs == []


def test_a_sound_recording_has_no_cause(frames, watched):
    own = diagnose(frames, method=METHOD, watched=watched)
    beside = diagnose(frames, [f.depth for f in frames], method=METHOD, watched=watched)
    assert own.cause is None is beside.cause and own.loss["none"] < 1
    inverse = next(cause.name for cause in KNOWN_FAULTS if cause.kind == "inverse")
    assert inverse in beside.loss and inverse not in own.loss, "its own returns cannot show their scale"
    with pytest.raises(ValueError, match="as many maps"):
        diagnose(frames, [frames[0].depth])


# ---------------------------------------------------------------------------------------------- a static camera


@pytest.fixture(scope="module")
def still(frames):
    """One view six times, its near returns each time with noise of their own."""
    near = range_split(frames[0], 2.5).replace(T_world_from_cam=None)
    noise = [torch.randn(near.depth.shape, generator=torch.Generator().manual_seed(k)) for k in range(6)]
    return [near.replace(depth=near.depth * (1 + 0.003 * x)) for x in noise]


#: Change of the true map -> kind of the fault. Maps that no fault explains have none.
STILL = [
    *((plant, kind) for kind, plant in FAULTS.values()),
    *((lambda d, x=x: x * d, None) for x in (1.0, 1.1, 0.4, 0.0)),
    *((lambda d, x=x: d**x, None) for x in (1.2, 0.7)),
    (lambda d: d * (1 + 0.3 * torch.linspace(-1, 1, d.shape[-1])), None),
    (lambda d: 0 * d + 2, None),
]


@pytest.mark.parametrize(("plant", "kind"), STILL)
def test_faults_of_maps_are_named_by_the_near_returns_of_a_static_camera(plant, kind, frames, still):
    maps = [plant(frames[0].depth)] * len(still)
    found = diagnose(still, maps, watched=UNWATCHED)
    assert found.kind == kind and (kind is None or (found.by, found.n_pairs) == ("returns", 6))
    strict = diagnose(still, maps, watched=UNWATCHED, options=ValidationOptions(min_loss_saved=1.0))
    assert strict.cause is None
    holes = [f.replace(depth=0 * f.depth) for f in still]
    assert diagnose(holes, maps, watched=UNWATCHED).n_pairs == 0


@pytest.mark.slow
def test_a_trajectory_that_does_not_move_is_that_of_a_static_camera(frames, still):
    """Tracks that do not move fit every depth alike, whatever the trajectory."""
    held = [f.replace(T_world_from_cam=frames[0].T_world_from_cam) for f in still]
    seen = track_window(held, METHOD)
    assert len(seen.pairs) >= 4
    maps = [mirror_depth(frames[0].depth)] * len(held)
    assert diagnose(held, maps, method=METHOD, watched=seen).kind == "mirrored"
    own = diagnose([f.replace(depth=maps[0]) for f in held], method=METHOD, watched=seen)
    assert own.cause is None, "its own returns are nothing to hold it against"


# ------------------------------------------------------------------------------------------- the choice of a cause

BASE, NAN = torch.linspace(0.5, 0.6, 8), math.nan
HARD = torch.tensor([0.6, 0.6, 0.2, 0.2, 0.2, 0.2])
MIRROR, MM, LATE = "mirrored left to right", "mm read as m", "1 frames late"
SIDEWAYS = torch.tensor([0.05, 0.06] * 3)


@pytest.mark.parametrize(
    ("base", "saved", "kind"),
    [
        (BASE, {MIRROR: 0.2}, "mirrored"),
        (BASE, {}, None),
        (BASE, {MIRROR: 0.02}, None),  # saves little
        (BASE, {MIRROR: 0.2, MM: 0.195}, None),  # two kinds explain it
        (BASE, {MIRROR: torch.tensor([0.9, -0.3] * 4)}, None),  # some pairs only
        (torch.cat([BASE[:3], torch.full((5,), NAN)]), {MIRROR: 0.2}, None),  # too few pairs tell
        # Two hard pairs fall out of the window's end for a late map: what is left is easier, and no explanation.
        (HARD, {LATE: torch.tensor([NAN, NAN, 0, 0, 0, 0])}, None),
        (HARD, {LATE: torch.tensor([NAN, NAN, 0, 0, 0, 0]), MIRROR: SIDEWAYS}, "mirrored"),
    ],
)
def test_an_explanation_must_be_clear_and_alone(base, saved, kind):
    assert (
        select_cause({cause.name: base - saved.get(cause.name, 0) for cause in (NO_FAULT, *KNOWN_FAULTS)}).kind == kind
    )


def test_a_fault_is_compared_over_samples_with_depth_under_both_hypotheses(monkeypatch):
    """Four groups of ten samples: without a fault the first three have a depth, with it undone the last three."""

    def losses(of_ten, used, *, defined=True):
        tens = torch.tensor([of_ten, used]).repeat_interleave(10, 1)
        return SampleLosses(tens[:1], tens[1:] > 0, torch.tensor([defined]))

    base, undone = losses([0.2, 0.4, 0.6, 1.0], [1, 1, 1, 0]), losses([1.0, 0.1, 0.1, 0.9], [0, 1, 1, 1])
    assert base.mean().tolist() == pytest.approx([0.4])
    assert losses([0.2, 0.4, 0.6, 1.0], [1, 1, 1, 0], defined=False).mean().isnan().all()
    window = FaultWindow(*[None] * 9)
    monkeypatch.setattr(FaultWindow, "sample_losses", lambda self, cause: undone)
    assert window.comparable_loss(KNOWN_FAULTS[0], base).tolist() == pytest.approx([0.4 + 0.1 - 0.5], abs=1e-6)


def test_inverses_of_faults():
    camera = cam.Camera(torch.tensor([[60.0, 50.0]]), torch.tensor([[40.0, 30.0]]))
    frame = Frame(torch.zeros(1, 1, 60, 80), torch.zeros(1, 60, 80), camera)
    undone = undo_fault(torch.full((1, 60, 80), 2.0), next(cause for cause in KNOWN_FAULTS if cause.ray), frame)
    assert float(undone[0, 5, 70]) == pytest.approx(2 / (1 + 0.5**2 + 0.5**2) ** 0.5, rel=1e-5)
    corner = torch.zeros(1, 4, 4).index_put(tuple(torch.tensor([[0], [0], [3]])), torch.tensor(1.0))
    assert rot90_map(corner, 1)[0, 0, 0] == rot90_map(corner, 3)[0, 3, 3] == 1, "counter-clockwise"
    depth = torch.arange(48.0).reshape(1, 6, 8).repeat_interleave(8, 1).repeat_interleave(8, 2)
    assert all((rot90_map(rot90_map(depth, k), 4 - k) == depth).float().mean() > 0.8 for k in (1, 2, 3))


@pytest.mark.parametrize(
    "fault", [c for c in KNOWN_FAULTS if re.search("too far|focal|frames", c.name)], ids=lambda c: c.name
)
def test_faults_are_named_as_they_are(fault):
    number, side = re.search(r"([\d.]+)[^\d]*?(left|right|late|early|one)?$", fault.name).groups()
    sign = 1 if side in ("right", "late") else -1
    if fault.kind == "focal length":
        assert float(number) * fault.focal == pytest.approx(1.0, abs=0.01), "undone, the focal length is the true one"
    elif fault.kind == "time offset":
        assert fault.lag == sign * int(number)
    else:  # a step at the middle, moved by the named fraction of the width, is at the middle when undone
        w, columns = 200, torch.arange(200)
        moved = w // 2 + round(w * int(number) / 100) * sign
        undone = fault.undo(torch.where(columns < moved, 1.0, 2.0).expand(1, 40, w))[0, 20]
        assert abs(int(columns[undone > 1.5].min()) - w // 2) <= 1
