"""Check of a capture before it is used: unit, poses, orientation, time and registration of its depth.

A capture's files may mean something else than its reader assumes. One window of its frames is examined: values of
depth for their unit, tracks against near returns for faults that all frames share (:mod:`dhtorch.validation.faults`),
surfaces seen from two frames for the stated poses (:mod:`dhtorch.validation.pose_check`). Each finding has a cause, a
sentence and the option that corrects it. Refuted poses are removed from the recording, so that no command uses them.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import torch
import torch.nn.functional as F

from dhtorch.data.intrinsics import MAX_CENTRE_OFFSET
from dhtorch.data.io.decode import FormatError
from dhtorch.data.plausibility import plausibility_findings
from dhtorch.data.recording import Recording
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose, Samples, Tracks
from dhtorch.runtime.console import format_count
from dhtorch.validation import faults
from dhtorch.validation.edges import do_edges_refute, find_edge_fault, find_edge_lag
from dhtorch.validation.faults import Diagnosis, KnownFault, WindowTracks
from dhtorch.validation.options import ValidationOptions
from dhtorch.validation.picture_field import PictureField, measure_picture_field
from dhtorch.validation.pose_check import PoseCheck, check_poses, describe_contradiction, describe_factor

#: Frames of the window that is examined: pairs of up to 8 frames apart, and maps up to 5 frames late.
#: Source: derived, more than three times the largest lag of dhtorch.validation.faults, whose references need it.
WINDOW_FRAMES: Final = 16

#: Name of a fault of orientation → value of the option ``depth_turn`` that corrects it.
_TURN_OPTIONS: Final = {
    "mirrored left to right": "left_right",
    "mirrored upside down": "upside_down",
    "rolled by 90 degrees": "270",
    "rolled by 180 degrees": "180",
    "rolled by 270 degrees": "90",
}

#: Longer side of the pictures that are tracked, px. Limits the time; misses are measured in pixels of 640.
#: Source: derived, the losses of dhtorch.validation.faults.
_MAX_TRACKED_PX: Final = 640

#: Options of the diagnosis: five pairs instead of eight limit the time.
_OPTIONS: Final = ValidationOptions(max_window_pairs=5)

#: Mean loss of tracks under the motions of near returns up to which the latter explain them.
#: Source: chosen on the sound captures of the shared data: 0.11 to 0.23 where motion is moderate.
MAX_EXPLAINED_LOSS: Final = 0.3


@dataclass(frozen=True)
class Finding:
    """One thing that a capture's files mean otherwise than assumed, or that contradict each other."""

    cause: str  # plausibility | intrinsics | poses | scale, or the kind of a KnownFault
    text: str
    remedy: str = ""  # option that corrects it, empty where none does

    def __str__(self) -> str:
        return f"{self.text} (remedy: {self.remedy})" if self.remedy else self.text


@dataclass(frozen=True, eq=False)
class CaptureCheck:
    """Findings on one recording, and the recording as it can be used."""

    recording: Recording  # without poses where they are refuted
    assumed_unit: str = ""  # the unit that nothing states, as a sentence
    findings: tuple[Finding, ...] = ()
    poses: PoseCheck | None = None
    diagnosis: Diagnosis | None = None

    @property
    def poses_refuted(self) -> bool:
        """Whether the stated poses contradict the depth and are not used."""
        return any(finding.cause == "poses" for finding in self.findings)

    @property
    def limits(self) -> list[str]:
        """What the window cannot show, each a sentence."""
        error = None if self.poses is None or self.findings else self.poses.scale_error
        if error is None or error <= 0.09:  # twice the least factor that is reported
            return []
        size = "of a third or less" if math.isinf(error) else f"up to {error:.0%}"
        return [f"the scale of depth and poses is not checked exactly: an error {size} would not show in this motion"]

    @property
    def lines(self) -> list[str]:
        """The assumed unit, the reader's report and the findings, each a line."""
        assumed = [self.assumed_unit] if self.assumed_unit else []
        return [*assumed, *self.recording.report, *map(str, self.findings)]

    @property
    def reported(self) -> Recording:
        """The recording as it can be used, with these lines as its report."""
        return replace(self.recording, report=tuple(self.lines))


def check_capture(recording: Recording, frames: Mapping[int, Frame] | None = None, *, seed: int = 0) -> CaptureCheck:
    """A recording -> findings on unit, poses, orientation, time and registration of its depth.

    Args:
        recording: of any format; unreadable frames are left out.
        frames: frames of it that are decoded already, by position.
        seed: of the pose search.

    Gradient: none.
    Cost: decodes up to :data:`WINDOW_FRAMES` frames and tracks five pairs of them, about a second.
    """
    unit = recording.depth_unit
    assumed = f"{unit} (data.depth_unit= sets it)" if unit is not None and unit.is_assumed else ""
    window = _read_window(recording, frames or {})
    depths = [frame.depth[0] for frame in window.values() if bool((frame.depth > 0).any())]
    findings = [
        Finding("plausibility", each.text, each.remedy)
        for each in plausibility_findings(depths, recording.depth_unit, recording.sparse)
    ]
    findings += _intrinsics_findings(list(window.values()))
    if len(depths) < 2 or recording.sparse:
        return CaptureCheck(recording, assumed, tuple(findings))
    views = {i: _reduced(frame.replace(T_world_from_cam=None)) for i, frame in window.items() if 0 not in frame.hw}
    tracks, diagnosis = _diagnose_window(list(views.values()), seed)
    positions = list(views)
    pairs = [(positions[i], positions[j]) for i, j in tracks.pairs] or list(itertools.pairwise(list(window)))[:8]
    tracked = list(zip(tracks.samples, tracks.tracks, strict=True))
    poses = None if recording.poses is None else check_poses(recording.poses, {**window, **views}, pairs, tracked)
    cause = None if diagnosis is None else diagnosis.cause
    fault = next((each for each in faults.KNOWN_FAULTS if each.name == cause), None)
    if fault is None or do_edges_refute(list(views.values()), fault):
        fault = _edge_fault(list(views.values()), diagnosis)
    field = _field_of_pictures(recording, poses, fault, views, list(zip(pairs, tracked, strict=False)))
    if field is not None:
        view = next(iter(views.values()))
        camera = field.camera(view.camera, view.hw)
        K = ", ".join(f"{x:.0f}" for x in (*camera.f[0].tolist(), *camera.c[0].tolist()))
        text = (
            f"depth does not lie over its pictures: these show {1 / field.zoom:.2f} of the field of view that K "
            "states, while depth and poses agree: they are cropped or resized alone, "
            f"and their own K is about fx, fy, cx, cy = {K} px at {view.hw[1]}x{view.hw[0]}"
        )
        findings.append(Finding("registration", text))
    else:
        findings += _combined_findings(recording, poses, fault, {**window, **views}, pairs, tracks)
    check = CaptureCheck(recording, assumed, tuple(findings), poses, diagnosis)
    return replace(check, recording=replace(recording, poses=None)) if check.poses_refuted else check


def _read_window(recording: Recording, known: Mapping[int, Frame]) -> dict[int, Frame]:
    """Up to :data:`WINDOW_FRAMES` consecutive readable frames where the camera moves most, by position."""
    first = _first_of_window(recording)
    window: dict[int, Frame] = {}
    for i in range(first, min(first + WINDOW_FRAMES, len(recording))):
        with suppress(FormatError):
            window[i] = known[i] if i in known else recording[i]
    return window


def _first_of_window(recording: Recording) -> int:
    """First frame of the window with the longest path; of the middle one without poses."""
    last = max(len(recording) - WINDOW_FRAMES, 0)
    if recording.poses is None or last == 0:
        return last // 2
    step = recording.poses.t.diff(dim=0).norm(dim=-1).nan_to_num(0.0)
    # Steps far above the others are jumps of the tracking, not motion.
    moving = step[step > 0]
    step = step.clamp(max=4 * float(moving.median())) if len(moving) else step
    total = torch.cat((torch.zeros(1, dtype=step.dtype), step.cumsum(0)))
    length = total[WINDOW_FRAMES - 1 :] - total[: len(total) - WINDOW_FRAMES + 1]
    return int(length[: last + 1].argmax())


def _diagnose_window(frames: Sequence[Frame], seed: int) -> tuple[WindowTracks, Diagnosis | None]:
    """Tracks between pairs of a window, and the fault that its depth shares; none where a picture is missing."""
    hws = {(frame.hw, tuple(frame.depth.shape)) for frame in frames}
    if len(frames) < 2 or len(hws) != 1:
        return WindowTracks([], [], []), None
    tracks = faults.track_window(frames, options=_OPTIONS)
    if not tracks.pairs:
        return tracks, None
    return tracks, faults.diagnose(frames, seed=seed, watched=tracks, options=_OPTIONS)


def _reduced(frame: Frame) -> Frame:
    """A frame with its picture at most :data:`_MAX_TRACKED_PX` wide; its depth stays, over the same field of view."""
    h, w = frame.hw
    scale = _MAX_TRACKED_PX / max(h, w)
    if scale >= 1:
        return frame
    hw = round(h * scale), round(w * scale)
    image = F.interpolate(frame.image.float(), hw, mode="area").round().to(frame.image.dtype)
    return frame.replace(image=image, camera=cam.resize(frame.camera, frame.hw, hw))


def _intrinsics_findings(frames: Sequence[Frame]) -> list[Finding]:
    """Findings on a principal point that is far from the middle of the picture, with what it would fit."""
    if not frames or 0 in frames[0].hw:
        return []
    c, (h, w) = frames[0].camera.c[0].double() + 0.5, frames[0].hw
    size = torch.tensor([w, h], dtype=torch.float64)
    relative = c / size
    if float((relative - 0.5).abs().max()) <= MAX_CENTRE_OFFSET:
        return []
    start = f"the principal point {c[0]:.0f}, {c[1]:.0f} px is far from the middle of pictures of {w}x{h}"
    larger = f"the intrinsics look like those of pictures {2 * float(relative.mean()):.3g} times as large"
    for offset, text in (
        (c.flip(-1) / size - 0.5, "cx and cy (and fx and fy) look exchanged"),
        (relative / relative.mean() - 1, larger),
    ):
        if float(offset.abs().max()) <= MAX_CENTRE_OFFSET:
            return [Finding("intrinsics", f"{start}: {text}", "data.K=[fx,fy,cx,cy]")]
    return []


def _edge_fault(frames: Sequence[Frame], diagnosis: Diagnosis | None) -> KnownFault | None:
    """The fault that coinciding edges show; None without one.

    Faults other than a lag are looked for where near returns explain the tracks badly, or there are no tracks.
    """
    if len(frames) < 2:
        return None
    if lag := find_edge_lag(frames).lag:
        return KnownFault("time offset", f"{abs(lag)} frames {'late' if lag > 0 else 'early'}", lag=lag)
    explained = diagnosis is not None and diagnosis.loss.get(faults.NO_FAULT.name, 1.0) < MAX_EXPLAINED_LOSS
    return None if explained else find_edge_fault(frames)


def _field_of_pictures(
    recording: Recording,
    poses: PoseCheck | None,
    fault: KnownFault | None,
    views: Mapping[int, Frame],
    tracked: Sequence[tuple[tuple[int, int], tuple[Samples, Tracks]]],
) -> PictureField | None:
    """The field of view of the pictures where it is not the stated one; None where it is, or is not measurable.

    Poses and depth must agree, and no fault of another kind may explain the tracks.
    """
    is_other = fault is not None and fault.kind not in ("registration", "focal length", "along the ray")
    if poses is None or recording.poses is None or poses.surfaces_contradict or is_other or not tracked:
        return None
    pairs, tracks = zip(*tracked, strict=True)
    field = measure_picture_field(recording.poses, views, pairs, tracks)
    if field is None or not field.differs:
        return None
    by_poses = 1.0 if poses.tracks is None else poses.tracks.best_score
    return field if field.loss < by_poses else None


# ----------------------------------------------------------------------------------------------------------- findings


def _combined_findings(
    recording: Recording,
    poses: PoseCheck | None,
    fault: KnownFault | None,
    window: Mapping[int, Frame],
    pairs: Sequence[tuple[int, int]],
    tracks: WindowTracks,
) -> list[Finding]:
    """Findings from the two checks: the fault of depth beside its pictures, and the poses beside the depth."""
    mended, stated_poses = None, recording.poses
    if poses is not None and stated_poses is not None and fault is not None:
        undone = {
            i: frame.replace(depth=faults.undo_fault(window[i + fault.lag].depth, fault, frame))
            for i, frame in window.items()
            if i + fault.lag in window
        }
        mended = check_poses(stated_poses, undone, [(i, j) for i, j in pairs if i in undone and j in undone])
    if poses is None or stated_poses is None or not poses.contradicts:
        # Pictures instead of depth have the fault if undoing it in the depth makes surfaces disagree more.
        stated, other = (math.nan if each is None else each.surfaces.stated for each in (poses, mended))
        is_of_pictures = other > 1.5 * stated and other - stated > 0.003
        findings = [] if fault is None else [_fault_finding(fault, pictures=is_of_pictures)]
        if poses is not None and poses.factor != 1:
            findings.append(Finding("scale", describe_factor(poses)))
        if poses is not None and poses.is_depth_noise:
            best = 100 * min(poses.surfaces.best_score, poses.surfaces.without)
            text = (
                f"depths of two frames disagree by {best:.0f} % at best: these are no distances (encoding, byte order)"
            )
            findings.append(Finding("plausibility", text))
        return findings
    if fault is not None and mended is not None and not mended.contradicts:
        return [_fault_finding(fault)]
    text, remedy = describe_contradiction(poses, recording.depth_unit)
    lag = poses.best.lag if poses.is_explained else 0
    by_lag = (
        [_epipolar_distance(stated_poses, by, window, pairs, tracks) for by in (0, lag)] if lag else [math.inf, 0.0]
    )
    if by_lag[0] <= 0.7 * by_lag[1]:  # the tracks fit the stated poses clearly better: the depth is off
        return [Finding("time offset", _lag_text(-lag, "pictures and poses"), f"data.depth_lag={-lag}")]
    findings = [Finding("poses", f"{text}; they are not used", remedy)]
    return findings if fault is None or lag else [*findings, _fault_finding(fault)]


def _fault_finding(fault: KnownFault, *, pictures: bool = False) -> Finding:
    """Sentence and option for a fault of the depth beside its pictures; ``pictures``: these contradict the poses."""
    which, seen = ("pictures are", "; depth and poses agree") if pictures else ("depth is", "")
    turned = f"depth and pictures differ in orientation: {which} {fault.name}{seen}"
    turn = f"data.depth_turn={_TURN_OPTIONS.get(fault.name)}"
    apart = f"depth does not lie over its pictures ({fault.name}){seen}: one of them is cropped, or depth has a K"
    late = _lag_text(-fault.lag, "depth and poses", "the pictures are") if pictures else _lag_text(fault.lag)
    text, remedy = {
        "time offset": (late, f"data.depth_lag={fault.lag}"),
        "mirrored": (turned, turn),
        "rolled": (turned, turn),
        "registration": (f"{apart} of its own (data.K_depth=)", ""),
    }.get(fault.kind, (f"depth is wrong: {fault.name}", ""))
    return Finding(fault.kind, text, "" if pictures else remedy)


def _lag_text(lag: int, against: str = "the pictures", subject: str = "depth is") -> str:
    return f"{subject} {format_count(abs(lag), 'frame')} {'late' if lag > 0 else 'early'} against {against}"


# ---------------------------------------------------------------------------------------------- pictures beside poses


def _epipolar_distance(
    poses: Pose, by: int, window: Mapping[int, Frame], pairs: Sequence[tuple[int, int]], tracks: WindowTracks
) -> float:
    """Median angle of tracks from their epipolar planes under the poses ``by`` frames later, rad; NaN without any."""
    angles = []
    for (i, j), samples, track in zip(pairs, tracks.samples, tracks.tracks, strict=False):
        if min(i, j) + by < 0 or max(i, j) + by >= len(poses.t):
            continue
        T = se3.relative(*(poses[k + by : k + by + 1].map(lambda x: x.double()) for k in (i, j)))
        rays = (cam.rays(window[i].camera, samples.uv).double(), cam.rays(window[j].camera, track.uv_1).double())
        normal = torch.linalg.cross(T.t[:, None].expand_as(rays[0]), se3.rotate(T.R, rays[0]))
        sine = (normal * rays[1]).sum(-1).abs() / (normal.norm(dim=-1) * rays[1].norm(dim=-1)).clamp_min(1e-12)
        angles.append(sine[track.valid])
    return float(torch.cat(angles).median()) if angles else float("nan")
