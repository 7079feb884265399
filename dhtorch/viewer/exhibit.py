"""What there is to see, before any medium: pictures, points, camera path, and what became of every sample.

Everything is a numpy array in metres and pixels of the full picture, so that a page, a Rerun recording or a notebook
can show it without torch.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from dhtorch.codes import Gate, Source, names
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Given, Scene
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.lookup import nearest
from dhtorch.pair import merge
from dhtorch.records import Camera, Frame, Pose
from dhtorch.studies import protocol
from dhtorch.studies.protocol import Answer, Method, Pairs, Progress, Protocol, Settings, Variant

#: Points of a depth map that are shown, drawn at random: enough to know the place, few enough for a page.
DENSE = 12_000

#: Longer side of the pictures, px, and quality of their JPEG.
LONGEST, QUALITY = 800, 82


@dataclass(frozen=True)
class Picture:
    """A picture and where it was taken."""

    number: int  # place of the frame in the recording
    time: float | None  # s since the recording's first frame
    jpeg: bytes
    jpeg_hw: tuple[int, int]
    hw: tuple[int, int]  # of the full picture, to which pixels refer
    f: tuple[float, float]  # px
    c: tuple[float, float]  # px


@dataclass(frozen=True)
class Cloud:
    """Points of a depth map in the colours of its picture."""

    xyz: np.ndarray  # (P, 3) m, camera 0, float32
    rgb: np.ndarray  # (P, 3) uint8


@dataclass(frozen=True)
class DepthMap:
    """A depth map and its intrinsics."""

    depth: np.ndarray  # (h, w) m float32, 0 = no return
    f: tuple[float, float]  # px of the depth map
    c: tuple[float, float]  # px


NO_POINTS = Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Shot:
    """One pair: what the sensor said, what was answered, and what became of the N samples.

    ``samples`` holds arrays of N rows: ``uv_0``, ``uv_1`` (N, 2) px, ``tracked`` bool, ``xyz`` (N, 3) m in camera 0
    (NaN where neither source answers), ``rgb`` (N, 3) uint8 of the picture, ``depth``, ``sigma`` m, ``score``,
    ``source``, ``gate``, ``hole``, ``parallax_deg``, ``residual_px``, ``error`` (|z − z*| / z* where a held-back return
    passes the truth test, else NaN) and ``candidate`` (whether it does).
    """

    label: str
    samples: Mapping[str, np.ndarray]
    T_world_from_0: np.ndarray  # (4, 4)
    T_world_from_1: np.ndarray | None = None  # (4, 4), by the pose that was fitted; None = there is none
    view_0: int | None = None  # positions in ``Exhibit.views``; None = no pictures
    view_1: int | None = None
    seen: Cloud = NO_POINTS  # returns that the method saw
    held: Cloud = NO_POINTS  # returns that it did not see, or the exact depth there
    depth_map: DepthMap | None = None  # that the method saw
    facts: Mapping[str, str] = field(default_factory=dict)

    def gates(self) -> dict[str, int]:
        """Samples by what became of them: a usable return of the sensor, an answer, or the reason for silence."""
        sensed = self.samples["source"] == Source.SENSOR
        counts = {"SENSOR": int(sensed.sum())}
        for code, name in names(Gate).items():
            counts[name] = int((~sensed & (self.samples["gate"] == code)).sum())
        return counts


@dataclass(frozen=True)
class Exhibit:
    """All that is shown of one recording."""

    name: str
    shots: Sequence[Shot]
    views: Sequence[Picture] = ()
    path: np.ndarray | None = None  # (n, 3) m, camera centres of the whole recording; None = no trajectory
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def placed(self) -> bool:
        """Whether all pairs stand in one world; otherwise each stands in its own anchor's frame."""
        return self.path is not None or len(self.shots) == 1


def look(
    given: Given,
    method: Method,
    pairs: Pairs,
    settings: Settings,
    *,
    most: int = 12,
    progress: Progress = protocol.quiet,
) -> Exhibit:
    """Run the method on pairs of the recording, as the main job does, and keep what there is to see.

    Args:
        given: one scene, or a recording as a scene without notes.
        method: of one other view or several.
        pairs: scene → list of (anchor, other).
        settings: cutoff, seed, device, batch, workers.
        most: pairs that are shown; of more, as many spread evenly.
        progress: wraps the loop over the pairs.

    Raises:
        ValueError: bad data or options, as :func:`dhtorch.studies.protocol.run` raises them.
    """
    shown = Scene.of(given)
    recording = shown.recording
    shots: list[Shot] = []
    views: dict[int, Picture] = {}

    def keep(answer: Answer) -> protocol.Row:
        batch = answer.batch
        for k, frame in zip(batch.pairs[0], (batch.anchor, batch.others[-1]), strict=True):
            if k not in views:
                views[k] = _view(recording, k, frame)
        shots.append(_shot(answer, list(views)))
        return {}

    seen = Protocol({"view": Variant(method)}, columns=keep, min_candidates=0)
    protocol.run([shown], seen, lambda scene: _spread(pairs(scene), most), settings, progress=progress)
    path = None if recording.poses is None else recording.poses.t.detach().cpu().numpy()
    return Exhibit(recording.name, shots, list(views.values()), path)


def _shot(answer: Answer, shown: Sequence[int]) -> Shot:
    batch, samples, estimate = answer.batch, answer.samples, answer.estimate
    tracks, fit, truth = answer.trace["tracks"], answer.trace["fit"], answer.truths["full"]
    whole, anchor, (i, j) = merge(samples, estimate), batch.anchor, batch.pairs[0]
    filled = whole.source != Source.NONE
    xyz = cam.unproject(anchor.camera, whole.uv, whole.depth)
    error = (estimate.depth - truth.depth).abs() / truth.depth.clamp_min(1e-9)
    columns = {
        "uv_0": whole.uv,
        "uv_1": tracks.uv_1,
        "tracked": tracks.valid,
        "xyz": torch.where(filled[..., None], xyz, torch.nan),
        "rgb": _colours(anchor, whole.uv),
        **{name: getattr(whole, name) for name in ("depth", "sigma", "score", "source")},
        "gate": estimate.gate,
        "hole": samples.hole,
        "parallax_deg": estimate.parallax_deg,
        "residual_px": estimate.residual_px,
        "error": torch.where(truth.ok & estimate.keep, error, torch.nan),
        "candidate": truth.ok,
    }
    T_world_from_0 = _in_world(anchor)
    held = anchor.replace(depth=batch.exact.depth, depth_camera=batch.exact.depth_camera)
    ok = bool(fit.ok[0])
    cutoff = batch.cutoff if batch.cutoff is not None else float("inf")
    facts = {"pose": "none found"}
    if ok:
        facts["pose"] = f"{int(fit.n_inlier[0])} near returns agree, {float(fit.rms_px[0]):.2f} px"
        facts["baseline"] = f"{100 * float(fit.T_1_from_0.t.norm()):.1f} cm"
    return Shot(
        label=f"{i} → {j}",
        samples={name: x[0].detach().cpu().numpy() for name, x in columns.items()},
        T_world_from_0=T_world_from_0,
        T_world_from_1=T_world_from_0 @ _matrix(se3.invert(fit.T_1_from_0)) if ok else None,
        view_0=shown.index(i),
        view_1=shown.index(j),
        seen=_cloud(anchor, (anchor.depth > 0) & (anchor.depth <= cutoff)),
        held=_cloud(held, held.depth > cutoff),
        depth_map=_depth_map(anchor, cutoff),
        facts=facts,
    )


def _view(recording: Recording, k: int, frame: Frame) -> Picture:
    time = None if recording.times is None else float(recording.times[k] - recording.times[0])
    return Picture(int(recording.number[k]), time, *_jpeg(_pixels(frame)), frame.hw, *_intrinsics(frame.camera))


def _depth_map(frame: Frame, cutoff: float) -> DepthMap:
    depth = frame.depth[0].cpu()
    return DepthMap(torch.where(depth <= cutoff, depth, 0.0).float().numpy(), *_intrinsics(_depth_camera(frame)))


def _depth_camera(frame: Frame) -> Camera:
    hw = frame.depth.shape[-2], frame.depth.shape[-1]
    return (frame.depth_camera or cam.resize(frame.camera, frame.hw, hw)).to("cpu")


def _intrinsics(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    return (fx, fy), (cx, cy)


def _cloud(frame: Frame, wanted: torch.Tensor) -> Cloud:
    """Some of the returns that are wanted, (1, h, w) bool, as points in the colours of the picture."""
    places = wanted[0].cpu().nonzero()
    if not len(places):
        return NO_POINTS
    some = torch.randperm(len(places), generator=torch.Generator().manual_seed(0))[:DENSE]
    v, u = places[some].unbind(-1)
    camera = _depth_camera(frame)
    xyz = cam.unproject(camera, torch.stack((u, v), -1)[None].to(camera.f), frame.depth[:, v, u].cpu())
    rgb = _colours(frame, cam.project(frame.camera.to("cpu"), xyz).nan_to_num())
    fine = xyz[0].isfinite().all(-1)
    return Cloud(xyz[0, fine].float().numpy(), rgb[0, fine].numpy())


def _colours(frame: Frame, uv: torch.Tensor) -> torch.Tensor:
    """(1, N, 3) uint8: the picture at pixels."""
    picture = torch.from_numpy(_pixels(frame)).permute(2, 0, 1)[None]
    return torch.stack([nearest(picture[:, k], uv.cpu())[0] for k in range(3)], -1)


def _pixels(frame: Frame) -> np.ndarray:
    """(H, W, 3) uint8."""
    image = frame.image[0].detach().cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return image.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()


def _jpeg(pixels: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """The picture, made smaller where it is large, and its (height, width)."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    picture = Image.fromarray(pixels)
    out = io.BytesIO()
    picture.thumbnail((LONGEST, LONGEST))
    picture.save(out, "JPEG", quality=QUALITY)
    return out.getvalue(), (picture.height, picture.width)


def _in_world(frame: Frame) -> np.ndarray:
    return np.eye(4) if frame.T_world_from_cam is None else _matrix(frame.T_world_from_cam)


def _matrix(pose: Pose) -> np.ndarray:
    return se3.to_matrix(pose)[0].detach().cpu().double().numpy()


def _spread(items: Sequence[tuple[int, int]], most: int) -> list[tuple[int, int]]:
    """At most ``most`` of them, evenly spread, the first and the last among them."""
    n = len(items)
    if n <= most:
        return list(items)
    return [items[k] for k in sorted({round(k * (n - 1) / max(most - 1, 1)) for k in range(most)})]
