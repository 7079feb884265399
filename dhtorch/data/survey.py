"""Summary of a recording for inspection: facts, warnings, and a contact sheet of a few frames.

Only a few frames, spread over the recording, are decoded, so that large captures are summarised quickly. Nothing here
raises for bad content: an unreadable frame, a missing pose or an empty depth map becomes a warning.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording
from dhtorch.geometry import patches, se3
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime.console import format_count

_DEPTH_PERCENTILES = (1, 5, 25, 50, 75, 95, 99)

#: Total translation (m) and rotation (rad) below which a trajectory counts as constant.
_MIN_MOTION_M = 1e-3


@dataclass(frozen=True, eq=False)
class Tile:
    """One frame of the contact sheet: its image, depth and confidence as stored."""

    title: str
    image: Tensor | None = None  # (C, H, W)
    depth: Tensor | None = None  # (h, w) m
    conf: Tensor | None = None  # (h, w)


@dataclass(eq=False)
class Survey:
    """Facts, warnings and contact sheet of one recording, stack or folder; filled in while it is read."""

    name: str
    format: str
    facts: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    tiles: list[Tile] = field(default_factory=list)
    depths: Tensor = field(default_factory=lambda: torch.zeros(0))  # (M,) m, returns of the decoded frames
    decoded: dict[int, Frame] = field(default_factory=dict)  # position → frame that was read

    def add_fact(self, what: str, text: str) -> None:
        """Add a fact."""
        self.facts.append((what, text))

    def warn(self, text: str, when: bool = True) -> None:
        """Add a warning, unless ``when`` is false."""
        self.warnings += [text] * when


def survey_recording(
    recording: Recording,
    frames: int = 8,
    *,
    progress: Callable[..., Iterable[int]] = lambda items, _text, _total: items,
) -> Survey:
    """Survey of a recording, from its tables and ``frames`` decoded frames spread over it.

    ``progress`` wraps the decoding loop: (items, text, number of items) → items.
    """
    out = Survey(recording.name, recording.format)
    n = len(recording)
    skipped = int(recording.number[-1] - recording.number[0]) + 1 - n
    out.add_fact("frames", f"{n}" + (f", {format_count(skipped, 'number')} missing in between" if skipped else ""))
    _report_times(recording.times, recording.rate_hz, out)
    places = sorted({round(k * (n - 1) / max(frames - 1, 1)) for k in range(frames)})
    shots = out.decoded
    for i in progress(places, recording.name, len(places)):
        try:
            shots[i] = recording[i]
        except FormatError as error:
            out.warn(f"frame {int(recording.number[i])} cannot be read: {error}")
    if shots:
        _report_pictures(list(shots.values()), out)
        remark = ", not registered to the picture" * (next(iter(shots.values())).depth_camera is not None)
        remark += ", sparse returns" * recording.sparse
        report_depths([s.depth[0] for s in shots.values()], out, remark, recording.sparse)
        _report_confidence([s.conf for s in shots.values() if s.conf is not None], out)
        _report_cameras(list(shots.values()), out)
    _report_poses(recording, out)
    out.warnings.extend(recording.report)
    for i, shot in shots.items():
        conf = None if shot.conf is None else shot.conf[0]
        image = shot.image[0] if shot.image.numel() else None
        out.tiles.append(Tile(f"{int(recording.number[i])}", image, shot.depth[0], conf))
    return out


def survey_pictures(name: str, images: dict[str, Tensor], depths: dict[str, Tensor]) -> Survey:
    """Survey of loose images and depth maps of no recognised format: without intrinsics, poses and order."""
    out = Survey(name, "loose pictures")
    for what, maps in (("pictures", images), ("depth maps", depths)):
        if maps:
            sizes = sorted({f"{x.shape[-1]}x{x.shape[-2]}" for x in maps.values()})
            out.add_fact(what, f"{len(maps)}, {', '.join(sizes)}")
    if depths:
        report_depths(list(depths.values()), out)
    out.warn("read as loose images, without intrinsics and poses: nothing can be measured in them")
    out.tiles.extend(Tile(title, image=image) for title, image in images.items())
    out.tiles.extend(Tile(title, depth=depth) for title, depth in depths.items())
    return out


# -------------------------------------------------------------------------------------------------------------- facts


def _report_times(times: Tensor | None, rate_hz: float | None, out: Survey) -> None:
    nominal = f"nominal {rate_hz:.3g} Hz" if rate_hz else ""
    if times is None or len(times) < 2:
        out.add_fact("rate", nominal or "not known")
        out.warn("no time stamps", times is None)
        return
    step = times.diff()
    median_step = float(step.median())
    measured = f"{1 / median_step:.4g} Hz" if median_step > 0 else "0 s from frame to frame"
    out.add_fact("rate", f"{measured} measured" + (f", {nominal}" if nominal else ""))
    out.add_fact("duration", f"{float(times[-1] - times[0]):.3f} s")
    backward, gaps = int((step <= 0).sum()), int((step > 2.5 * median_step).sum())
    out.warn(f"time stamps do not increase at {format_count(backward, 'place')}", backward > 0)
    out.warn(f"{format_count(gaps, 'gap')} in time, the longest {float(step.max()):.3f} s", gaps > 0)


def _report_pictures(shots: Sequence[Frame], out: Survey) -> None:
    image = shots[0].image
    if image.numel() == 0:
        out.add_fact("pictures", "none")
        out.warn("depth only: there are no pictures")
        return
    h, w = shots[0].hw
    out.add_fact("pictures", f"{w}x{h}, {describe_pixels(image.shape[1], image)}")
    warn_of_duplicates([s.image[0] for s in shots], out, "frames")
    brightness = torch.stack([patches.luma(s.image[:, :, ::4, ::4], 1).mean() for s in shots])
    out.warn("all pictures are black", float(brightness.max()) < 0.02)


def describe_pixels(channels: int, images: Tensor) -> str:
    """Channels and bit depth of pixels as text, such as ``colour, 8 bits``."""
    return f"{'colour' if channels == 3 else 'grey'}, {'8 bits' if images.dtype == torch.uint8 else 'float'}"


def warn_of_duplicates(images: Sequence[Tensor], out: Survey, what: str) -> None:
    """Add a warning where several images are all equal."""
    alike = len(images) > 1 and all(x.shape == images[0].shape and torch.equal(x, images[0]) for x in images[1:])
    out.warn(f"all {what} that were read are the same picture", alike)


def report_depths(depths: Sequence[Tensor], out: Survey, remark: str = "", sparse: bool = False) -> None:
    """Add facts and warnings on depth maps (h, w) in m: sizes, fraction of holes, percentiles, range."""
    sizes = sorted({f"{d.shape[1]}x{d.shape[0]}" for d in depths})
    out.add_fact("depth", ", ".join(sizes) + remark)
    holes = torch.stack([(d == 0).double().mean() for d in depths])
    out.add_fact("holes", _format_range([100 * h for h in holes.tolist()], "{:.1f}") + " % of the depth map")
    values = torch.cat([x[:: max(1, -(-x.numel() // 200_000))] for x in (d[d > 0] for d in depths)])
    out.depths = values
    if values.numel() == 0:
        out.warn("no depth at all in the frames that were read")
        return
    ranks = torch.quantile(values.double(), torch.tensor(_DEPTH_PERCENTILES).double() / 100)
    table = ", ".join(f"{p} %: {x:.3f}" for p, x in zip(_DEPTH_PERCENTILES, ranks.tolist(), strict=True))
    out.add_fact("depth percentiles", f"{table} m")
    out.add_fact("depth range", f"{float(values.min()):.3f} to {float(values.max()):.3f} m")
    empty, mean = int((holes == 1).sum()), float(holes.mean())
    out.warn(f"{empty} of {len(depths)} depth maps that were read are empty", empty > 0)
    out.warn(f"most of the depth map is holes ({100 * mean:.0f} %)", not empty and mean > 0.5 and not sparse)
    out.warn("depth is the same everywhere", float(values.max() - values.min()) < 1e-3)


def _report_confidence(maps: Sequence[Tensor], out: Survey) -> None:
    if not maps:
        return
    counts = torch.stack([torch.bincount(m.flatten().long(), minlength=3)[:3] for m in maps]).sum(0)
    percent = (100 * counts / counts.sum().clamp(min=1)).tolist()
    levels = zip(("low", "medium", "high"), percent, strict=True)
    out.add_fact("confidence", ", ".join(f"{word} {x:.1f} %" for word, x in levels))
    out.warn("confidence is the same everywhere", max(percent) > 99.99)


def _report_cameras(shots: Sequence[Frame], out: Survey) -> None:
    hw, first = shots[0].hw, shots[0].camera
    if min(hw) == 0 and shots[0].depth_camera is not None:
        first, hw = shots[0].depth_camera, (shots[0].depth.shape[-2], shots[0].depth.shape[-1])
    out.add_fact("intrinsics", describe_camera(first, hw))
    f = torch.cat([s.camera.f for s in shots])
    if float((f.amax(0) / f.amin(0)).max()) > 1 + 1e-6:
        out.add_fact("focal length", _format_range(f[:, 0].tolist(), "{:.2f}") + " px: it changes from frame to frame")
    if shots[0].depth_camera is not None and min(shots[0].hw) > 0:
        out.add_fact("of the depth", describe_camera(shots[0].depth_camera, tuple(shots[0].depth.shape[-2:])))  # type: ignore[arg-type]
    fx, fy = first.f[0].tolist()
    out.warn(f"focal lengths {fx:.1f} and {fy:.1f} px: pixels are not square", not 0.95 < fx / fy < 1.05)
    centre = torch.tensor([hw[1], hw[0]]) / 2
    off = min(hw) > 0 and bool(((first.c[0] - centre).abs() > 0.3 * centre).any())
    out.warn("the principal point is far from the middle of the picture", off)


def describe_camera(camera: Camera, hw: tuple[int, int]) -> str:
    """Focal lengths, principal point, field of view and distortion of a camera as text."""
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    view = [2 * math.degrees(math.atan(n / 2 / f)) for n, f in ((hw[1], fx), (hw[0], fy))]
    lens = "no distortion" if camera.distortion is None else f"{camera.distortion.shape[-1]} distortion coefficients"
    return f"f {fx:.2f} {fy:.2f}, c {cx:.2f} {cy:.2f} px, field of view {view[0]:.0f}° x {view[1]:.0f}°, {lens}"


def _format_range(values: Sequence[float], form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"


# -------------------------------------------------------------------------------------------------------------- poses


def _report_poses(recording: Recording, out: Survey) -> None:
    poses: Pose | None = recording.poses
    if poses is None:
        out.add_fact("poses", "none")
        return
    determinant_error = float((torch.linalg.det(poses.R) - 1).abs().max())
    out.add_fact("poses", f"{len(recording)}, determinant within {determinant_error:.1e} of 1")
    if len(recording) < 2:
        return
    step = poses.t.diff(dim=0).norm(dim=-1)
    rotation = se3.rotation_angle(se3.relative(poses[1:], poses[:-1]).R)
    extent = float((poses.t.amax(0) - poses.t.amin(0)).norm())
    length, total_deg = float(step.sum()), math.degrees(float(rotation.sum()))
    out.add_fact("path", f"{length:.3f} m long inside a box of {extent:.3f} m, {total_deg:.1f}° of turning")
    median = f"{float(step.median()):.4f} m and {math.degrees(float(rotation.median())):.2f}° from frame to frame"
    out.add_fact("step", f"{median}, at most {float(step.max()):.3f} m")
    is_constant = length < _MIN_MOTION_M and float(rotation.sum()) < 1e-3
    out.warn("poses are constant", is_constant)
    out.warn("the camera turns but does not move: there is no baseline", not is_constant and extent < _MIN_MOTION_M)
    if recording.times is not None:
        speed = step / recording.times.diff().clamp(min=1e-9)
        out.add_fact("speed", f"{float(speed.median()):.3f} m/s, at most {float(speed.max()):.3f} m/s")
        # Speed in m/s above which a step of the trajectory counts as a jump: hand-held cameras do not move so fast.
        fastest, number = float(speed.max()), int(recording.number[int(speed.argmax()) + 1])
        out.warn(f"the camera jumps: {fastest:.1f} m/s at frame {number}", fastest > 5.0 and not recording.sparse)
