"""Check of a recording's stated poses against its depth: do surfaces seen from two frames coincide under the poses?

The returns of one frame are moved into another by the relative pose and compared with the depth there. This is done
under the stated poses and under every reading that they might have instead (camera axes, world-to-camera, quaternion
order, unit of translations, lag in frames): the best reading measures the noise of the depth itself, and names what the
poses are if the stated reading is clearly worse.

Where tracks of the pictures are at hand, near returns moved by the same motions are also compared with where they were
tracked to, which is far more precise for small motions and noisy depth.

Alphabet: K pairs of frames, H readings; the *disagreement* of a pair is the median of |z − z'| / z' over the returns
that meet a return, where z is the depth of a moved return and z' that of the frame there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.pose_convention import PoseConvention, right_handed_axes
from dhtorch.data.units import UNIT_METRES, DepthUnit, format_unit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.records import Frame, Pose, Samples, Tracks
from dhtorch.runtime.console import format_count
from dhtorch.validation.faults import MAX_LAG_FRAMES, MIN_LOSSES, bounded_loss
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS

#: Returns of a frame that are moved.
#: Source: derived, the median of 2000 values has a standard error of two hundredths of their spread.
_MAX_RETURNS: Final = 2000

#: Returns that must meet a return for a disagreement.
_MIN_MEETING_RETURNS: Final = 50

#: Factors on translations that are tried around 1, where a factor is not a confusion of units.
#: Source: derived, steps of 2.5 % resolve a factor that is wrong by a twentieth.
_FINE_FACTORS: Final = tuple(1.025**k for k in range(-16, 17) if k)

#: Factors on translations beyond these: units confused with one another, and ratios of common depth units.
#: Source: derived, ratios of the units.
_COARSE_FACTORS: Final = (
    1e-4,
    1e-3,
    1e-2,
    0.1,
    0.2,
    0.254,
    0.3048,
    0.5,
    2.0,
    3.2808,
    3.937,
    5.0,
    10.0,
    39.37,
    1e2,
    1e3,
)

#: Stated poses contradict the depth if their disagreement is at least this multiple of that of the best reading, and
#: larger by this difference; either pair of limits suffices.
#: Source: chosen on the sound captures of the shared data (largest: ratio 2.7 at a difference of 0.8 %) and on the
#: planted conventions, units and lags of benchmarks/results/faults.json.
_CONTRADICTION_LIMITS: Final = ((2.0, 0.01), (3.0, 0.003))

#: Disagreement from which on poses contradict the depth although no reading is better; no reading explains more.
#: Source: chosen on the sound captures of the shared data: at most 1.6 % between neighbouring views.
MAX_UNEXPLAINED_DISAGREEMENT: Final = 0.05

#: Disagreement under the best reading, and without poses, from which on the depth itself is doubted.
#: Source: derived, ten times the largest between neighbouring views of the sound captures of the shared data.
_MIN_NOISE_DISAGREEMENT: Final = 0.15

#: A factor near 1 is reported if the disagreement without it is larger by this ratio.
#: Source: chosen on the sound captures of the shared data (largest ratio 1.1) and on depth that is 10 % too long.
_MIN_FACTOR_GAIN: Final = 1.15

#: Least difference from 1 of a factor that is reported.
#: Source: chosen on the sound captures of the shared data and on depth that is 10 % too long.
_MIN_FACTOR_OFFSET: Final = 0.045

#: By tracks another reading is clearly better if its loss is at most this fraction of that of the stated poses.
#: Source: chosen on the sound captures of the shared data (at least 0.81) and on planted conventions and a factor of
#: 1.1 (at most 0.31).
_MAX_TRACK_LOSS_RATIO: Final = 0.6

#: Least loss of the stated poses for that. Source: chosen on the sound captures of the shared data: 0.15 or less where
#: the fraction is small.
_MIN_TRACK_LOSS: Final = 0.2

#: Pairs that must have tracks for these to count, or meeting surfaces for a factor near 1: fewer agree by chance.
#: Source: chosen on exact synthetic captures of 48 x 64 px, of which 1 or 2 pairs refuted true poses, 3 did not.
_MIN_DECIDING_PAIRS: Final = 3

#: Metres of one step of common depth files, tried where the depth unit may be the wrong one.
#: Source: derived, metres, cm, mm and inches, and the steps of TUM, KITTI, Replica and LeRobot's or ScanNet's files.
_COMMON_DEPTH_UNITS_M: Final = (1.0, 1e-2, 1e-3, 1e-4, 1 / 5000, 1 / 256, 1 / 6553.5, 1 / 4000, 0.0254)


class PoseReading(NamedTuple):
    """A reading of the stated poses: their convention, or frames by which they lead the depth."""

    convention: PoseConvention = PoseConvention()
    lag: int = 0  # the depth of a frame belongs to the pose of the frame ``lag`` later

    @property
    def factor(self) -> float:
        """Factor on the translations."""
        unit = self.convention.unit
        return UNIT_METRES[unit] if isinstance(unit, str) else unit

    @property
    def is_small_factor(self) -> bool:
        """Whether only the factor differs, and by too little for a confusion of units."""
        return self.convention.unit in _FINE_FACTORS


class ReadingScores(NamedTuple):
    """Score of the readings by one witness, medians or means over pairs; the smaller the better."""

    stated: float  # NaN: not measurable
    without: float  # under identity poses
    best: PoseReading
    best_score: float


@dataclass(frozen=True)
class PoseCheck:
    """Agreement of poses with depth under the stated and under other readings, by two witnesses."""

    surfaces: ReadingScores  # disagreement of depth between frames
    tracks: ReadingScores | None  # loss of near returns at their tracks, in [0, 1]; None with tracks in too few pairs
    surface_factor: float  # on translations, near 1, with the least disagreement; 1 = not distinguishable from 1
    n_pairs: int
    scale_error: float = math.inf  # largest relative error of the scale of depth or poses that would not be noticed

    @property
    def by_tracks(self) -> bool:
        """Whether the tracks show another reading of the poses clearly better than the stated one."""
        return (
            self.tracks is not None
            and self.tracks.stated >= _MIN_TRACK_LOSS
            and self.tracks.best_score <= _MAX_TRACK_LOSS_RATIO * self.tracks.stated
        )

    @property
    def best(self) -> PoseReading:
        """The best reading, by tracks where these are decisive."""
        return self.tracks.best if self.tracks is not None and self.by_tracks else self.surfaces.best

    @property
    def factor(self) -> float:
        """Factor on translations that is no confusion of units but clearly not 1; 1 where there is none."""
        if self.tracks is not None and self.by_tracks:
            return self.tracks.best.factor if self.tracks.best.is_small_factor else 1.0
        return self.surface_factor

    @property
    def contradicts(self) -> bool:
        """Whether the stated poses are refuted; a factor near 1 refutes neither the poses nor the depth."""
        if self.by_tracks and self.tracks is not None:
            return not self.tracks.best.is_small_factor
        return self.surfaces_contradict

    @property
    def surfaces_contradict(self) -> bool:
        """Whether surfaces seen from two frames refute the stated poses."""
        stated, best = self.surfaces.stated, self.surfaces.best_score
        if math.isnan(stated):
            return not math.isnan(best)
        if self.surfaces.best.is_small_factor:
            return False
        explained = any(stated >= ratio * best and stated - best >= least for ratio, least in _CONTRADICTION_LIMITS)
        return explained or stated > max(MAX_UNEXPLAINED_DISAGREEMENT, self.surfaces.without)

    @property
    def is_depth_noise(self) -> bool:
        """Whether the depths of two frames disagree widely under every reading of the poses and without any."""
        scores = self.surfaces.best_score, self.surfaces.without
        return all(score > _MIN_NOISE_DISAGREEMENT for score in scores)  # NaN: nothing meets

    @property
    def is_explained(self) -> bool:
        """Whether the best reading agrees clearly better than the stated poses and than no poses."""
        if self.by_tracks:
            return True
        best = self.surfaces.best_score
        if self.surfaces.best == PoseReading() or not best <= MAX_UNEXPLAINED_DISAGREEMENT:
            return False
        return best < 0.5 * min(_or_infinite(self.surfaces.stated), 2 * _or_infinite(self.surfaces.without))


def check_poses(
    poses: Pose,
    frames: Mapping[int, Frame],
    pairs: Sequence[tuple[int, int]],
    tracks: Sequence[tuple[Samples, Tracks]] = (),
) -> PoseCheck | None:
    """Poses of a recording and some of its frames -> their agreement; None where too few returns meet.

    Args:
        poses: (n) T_world_from_cam of all frames as stated.
        frames: position → frame (B = 1) with depth, of all frames in ``pairs``.
        pairs: positions of two frames each, in whose views most surfaces are the same.
        tracks: samples of the first picture of each pair and their tracks into the second; none = depth alone.

    Gradient: none.
    """
    if not pairs:
        return None
    poses = poses.map(lambda x: x.double())
    readings = pose_readings()
    surface = torch.full((len(pairs), len(readings) + 1), torch.nan, dtype=torch.float64)  # the last: identity poses
    track = surface.clone()
    with torch.no_grad():
        for k, (i, j) in enumerate(pairs):
            place, motions = _relative_poses(poses, i, j, readings)
            # Points (N, 3) m, float64, of returns spread over a frame's depth map
            frame = frames[i]
            v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
            step = max(1, len(v) // _MAX_RETURNS)
            v, u = v[step // 2 :: step], u[step // 2 :: step]
            uv = torch.stack((u, v), -1)[None].to(frame.camera.f.dtype)
            returns = cam.unproject(frame.map_camera, uv, frame.depth[0, v, u][None].to(uv.dtype))[0].double()
            if len(returns) >= _MIN_MEETING_RETURNS:
                surface[k, place] = depth_disagreement(returns, frames[j], motions)
            if tracks:
                track[k, place] = _track_loss(*tracks[k], frames[i], frames[j], motions)
    median, mean = _over_pairs(surface, surface.nanmedian(0).values), _over_pairs(track, track.nanmean(0))
    scores = _reading_scores(readings, median)
    if scores is None:
        return None
    is_tracked = int(track.isfinite().any(1).sum()) >= _MIN_DECIDING_PAIRS
    return PoseCheck(
        surfaces=scores,
        tracks=_reading_scores(readings, mean) if is_tracked else None,
        surface_factor=_distinguishable_factor(readings, median, surface),
        n_pairs=int(surface[:, 0].isfinite().sum()),
        scale_error=_unnoticed_scale_error(readings, median, mean if is_tracked else None),
    )


def _reading_scores(readings: Sequence[PoseReading], scores: Tensor) -> ReadingScores | None:
    """Scores (H + 1,) of the readings and of identity poses -> the stated and the best one; None without any."""
    if not bool(scores[:-1].isfinite().any()):
        return None
    best = int(scores[:-1].nan_to_num(torch.inf).argmin())
    return ReadingScores(float(scores[0]), float(scores[-1]), readings[best], float(scores[best]))


def _track_loss(samples: Samples, tracks: Tracks, a: Frame, b: Frame, motions: Pose) -> Tensor:
    """Mean loss (H,) of near returns moved by motions (H) at the ends of their tracks; NaN of too few.

    Misses are in pixels of a picture 640 wide; their loss is that of ``dhtorch.validation.faults``.
    """
    used = (samples.usable & tracks.valid)[0]
    if int(used.sum()) < MIN_LOSSES:
        return torch.full((len(motions.t),), torch.nan, dtype=torch.float64)
    xyz = cam.unproject(a.camera, samples.uv, samples.depth)[0, used].double()
    moved = se3.apply(motions, xyz.expand(len(motions.t), -1, -1))
    in_front = moved[..., 2] > 1e-6
    moved = torch.where(in_front[..., None], moved, 1.0)
    uv = cam.project(b.camera, moved.reshape(1, -1, 3).to(a.camera.f.dtype)).reshape(len(motions.t), -1, 2)
    miss = (uv - tracks.uv_1[0, used]).norm(dim=-1) * (640 / a.hw[1])
    half = DEFAULT_VALIDATION_OPTIONS.half_loss_px
    return torch.where(in_front, bounded_loss(miss, half), 1.0).double().mean(-1)


def pose_readings() -> list[PoseReading]:
    """All readings that are tried, the stated one first."""
    conventions = [PoseConvention(axes, inverse) for inverse in (False, True) for axes in right_handed_axes()]
    conventions += [
        PoseConvention(axes, quaternion=order)
        for order in ("wxyz", "xyzw")
        for axes in ("right_down_forward", "right_up_back")
    ]
    units = [PoseConvention(unit=unit) for unit in UNIT_METRES if unit != "m"]
    factors = [PoseConvention(unit=factor) for factor in (*_COARSE_FACTORS, *_FINE_FACTORS)]
    named_factors = {UNIT_METRES[unit] for unit in UNIT_METRES}
    factors = [each for each in factors if each.unit not in named_factors]
    readings = [PoseReading(each) for each in (*conventions, *units, *factors) if not each.is_trivial]
    lags = [PoseReading(lag=k) for k in range(-MAX_LAG_FRAMES, MAX_LAG_FRAMES + 1) if k]
    return [PoseReading(), *readings, *lags]


def depth_disagreement(xyz: Tensor, frame: Frame, T_frame_from_points: Pose) -> Tensor:
    """Points (N, 3) m moved by motions (H) into a frame (B = 1) -> median relative difference of depth (H,).

    NaN where too few points meet a return. Gradient: none.
    """
    n_motions = len(T_frame_from_points.t)
    moved = se3.apply(T_frame_from_points, xyz.expand(n_motions, -1, -1))
    uv = cam.project(frame.map_camera, moved.reshape(1, -1, 3).to(frame.camera.f.dtype))
    value, inside = sample_nearest(frame.depth, uv)
    value, inside = (x.reshape(n_motions, -1) for x in (value, inside))
    meets = inside & (value > 0) & (moved[..., 2] > 0)
    difference = torch.where(meets, (moved[..., 2] - value).abs() / value, torch.nan)
    return torch.where(meets.sum(-1) >= _MIN_MEETING_RETURNS, difference.nanmedian(-1).values, torch.nan)


def describe_contradiction(check: PoseCheck, unit: DepthUnit | None = None) -> tuple[str, str]:
    """A refuted set of poses -> (sentence, option that would mend it, empty where none does)."""
    start = f"poses and depth contradict each other ({_measured(check)})"
    if not check.is_explained:
        return f"{start}; no other reading of the poses explains it", ""
    reading = check.best
    if reading.lag:
        late = "late" if reading.lag < 0 else "early"
        return (
            f"{start}: depth is {format_count(abs(reading.lag), 'frame')} {late} against the poses",
            f"data.depth_lag={-reading.lag}",
        )
    option = f"data.pose_convention={reading.convention}"
    if reading.factor == 1 or isinstance(reading.convention.unit, str):
        return f"{start}: these look like {reading.convention.describe()}", option
    text = f"{start}: translations are {1 / reading.factor:.3g} times what the depth has"
    # A common depth unit, metres of one step, with which translations would agree
    metres = math.nan if unit is None else unit.metres / reading.factor
    other = next((x for x in _COMMON_DEPTH_UNITS_M if abs(math.log(x / metres)) < math.log(1.06)), None)
    if other is not None:
        return f"{text}; the depth unit may be {format_unit(other)}", f"data.depth_unit={other:.6g}"
    return f"{text}: the unit of the depth or of the poses is another one", option


def _measured(check: PoseCheck) -> str:
    """The measurement that decides, as text."""
    if check.by_tracks and check.tracks is not None:
        return (
            f"near returns miss their tracks: mean loss {check.tracks.stated:.2f} of 1, "
            f"{check.tracks.best_score:.2f} if read otherwise"
        )
    scores = check.surfaces
    stated = "no surface meets another" if math.isnan(scores.stated) else f"{100 * scores.stated:.1f} % of the depth"
    if check.is_explained:
        return f"{stated}, {100 * scores.best_score:.1f} % if read otherwise"
    return f"{stated}, {100 * scores.without:.1f} % without poses"


def describe_factor(check: PoseCheck) -> str:
    """Sentence on a factor between the depth and the poses that is distinguishable from 1."""
    return (
        f"depth is {check.factor:.2f} times what the poses' translations imply: the depth unit, the focal length "
        "or the scale of the poses is wrong; which one, depth and poses alone do not show"
    )


def _distinguishable_factor(readings: Sequence[PoseReading], median: Tensor, disagreements: Tensor) -> float:
    """Factor near 1 on translations with clearly less disagreement than 1, in most pairs; else 1."""
    near = [k for k, each in enumerate(readings) if each.is_small_factor or each == PoseReading()]
    values = median[near].nan_to_num(torch.inf)
    k = near[int(values.argmin())]
    factor, value = readings[k].factor, float(median[k])
    if not value * _MIN_FACTOR_GAIN <= float(median[0]) or abs(math.log(factor)) < math.log(1 + _MIN_FACTOR_OFFSET):
        return 1.0
    better = disagreements[:, k] < disagreements[:, 0]
    both = disagreements[:, k].isfinite() & disagreements[:, 0].isfinite()
    is_clear = int(both.sum()) >= _MIN_DECIDING_PAIRS and bool((better & both).sum() >= 0.75 * both.sum())
    return factor if is_clear else 1.0


def _unnoticed_scale_error(readings: Sequence[PoseReading], surface: Tensor, track: Tensor | None) -> float:
    """Largest relative error of the scale, within the factors near 1, under which neither score would be reported.

    If the scale were wrong by a factor, the poses as stated would score as they do under that factor now.
    """
    near = sorted((each.factor, k) for k, each in enumerate(readings) if each.is_small_factor or k == 0)
    places = [k for _, k in near]
    noticed = surface[places] > _MIN_FACTOR_GAIN * surface[places].nan_to_num(torch.inf).min()
    if track is not None:
        loss = track[places]
        best = loss.nan_to_num(torch.inf).min()
        noticed |= (loss >= _MIN_TRACK_LOSS) & (best <= _MAX_TRACK_LOSS_RATIO * loss)
    error = _MIN_FACTOR_OFFSET
    for (factor, _), seen in zip(near, noticed.tolist(), strict=True):
        if not seen:
            error = max(error, math.exp(abs(math.log(factor))) - 1)
    return math.inf if bool((~noticed[[0, -1]]).any()) else error


def _relative_poses(poses: Pose, i: int, j: int, readings: Sequence[PoseReading]) -> tuple[Tensor, Pose]:
    """Places (H') of the readings with a pose, and the motions (H') from frame i to frame j; the last is none."""
    place, motions = [], []
    for k, reading in enumerate(readings):
        a, b = i + reading.lag, j + reading.lag
        if min(a, b) >= 0 and max(a, b) < len(poses.t):
            both = reading.convention.apply(poses[torch.tensor([a, b])])
            motion = se3.relative(both[:1], both[1:])
            if bool(motion.t.isfinite().all() and motion.R.isfinite().all()):
                place.append(k)
                motions.append(motion)
    place.append(len(readings))
    motions.append(se3.identity(1, poses.t))
    return torch.tensor(place), Pose(torch.cat([m.R for m in motions]), torch.cat([m.t for m in motions]))


def _over_pairs(values: Tensor, summary: Tensor) -> Tensor:
    """Summary (H,) of values (K, H) over the pairs; NaN where less than half of the pairs have a value."""
    enough = 2 * values.isfinite().sum(0) >= max(1, int(values.isfinite().any(1).sum()))
    return torch.where(enough, summary, torch.nan)


def _or_infinite(value: float) -> float:
    return math.inf if math.isnan(value) else value
