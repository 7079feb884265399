"""What a protocol answers, as something to see: pictures, points, camera path, and what became of every sample."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from dhtorch.codes import Source
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.experiments import protocol
from dhtorch.experiments.protocol import Answer, Method, Progress, Protocol, ScenePairs, Settings, Variant
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.integrate.sweeps import DenseSweep
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.view_report import report_selection
from dhtorch.records import Camera, DepthMap, Frame, Pose
from dhtorch.viz.viewer.exhibit import (
    EMPTY_CLOUD,
    EMPTY_SWEPT_CLOUD,
    DepthImage,
    Exhibit,
    ExhibitView,
    PairExhibit,
    PointCloud,
    SweptPointCloud,
)

#: Points of a depth map that are shown, drawn at random: enough to know the place, few enough for a page.
MAX_CLOUD_POINTS = 12_000

#: Swept pixels that are shown of one view, in rows and columns as far apart as that takes.
MAX_SWEPT_POINTS = 24_000

#: Longer side of the pictures, px, and quality of their JPEG.
_MAX_SIDE_PX, _JPEG_QUALITY = 800, 82


def make_exhibit(
    given: SceneLike,
    method: Method,
    pairs: ScenePairs,
    settings: Settings,
    *,
    most: int = 12,
    sweep: DenseSweep | None = None,
    progress: Progress = protocol.no_progress,
) -> Exhibit:
    """Run the method on pairs of the recording, as the main job does, and keep what there is to see.

    Args:
        given: one scene, or a recording as a scene without notes.
        method: of one other view or several.
        pairs: scene → list of :class:`dhtorch.data.pairs.Pair`, or plain (reference view, other).
        settings: cutoff, seed, device, batch, workers.
        most: pairs that are shown; of more, as many spread evenly.
        sweep: also make a map of every pixel of the reference views.
        progress: wraps the loop over the pairs.

    Raises:
        ValueError: bad data or options, as :func:`dhtorch.experiments.protocol.run` raises them.
    """
    shown = Scene.of(given)
    recording = shown.recording
    shots: list[PairExhibit] = []
    views: dict[int, ExhibitView] = {}

    def keep(answer: Answer) -> protocol.Row:
        batch = answer.batch
        for k, frame in ((batch.pairs[0][0], batch.reference), answer.other):
            if k not in views:
                views[k] = _make_picture(recording, k, frame)
        shots.append(_make_shot(answer, list(views)))
        return {}

    seen = Protocol({"view": Variant(method, ask=sweep, chooses=True)}, columns=keep, min_candidates=0)
    protocol.run([shown], seen, lambda scene: _evenly_spaced(pairs(scene), most), settings, progress=progress)
    path = None if recording.poses is None else recording.poses.t.detach().cpu().numpy()
    return Exhibit(recording.name, shots, list(views.values()), path)


def _make_shot(answer: Answer, shown: Sequence[int]) -> PairExhibit:
    batch, samples, estimate = answer.batch, answer.samples, answer.estimate
    tracks, fit, truth = answer.trace["tracks"], answer.trace["fit"], answer.truths["full"]
    whole, reference, i, j = merge(samples, estimate), batch.reference, batch.pairs[0].reference, answer.other[0]
    filled = whole.source != Source.NONE
    xyz = cam.unproject(reference.camera, whole.uv, whole.depth)
    error = (estimate.depth - truth.depth).abs() / truth.depth.clamp_min(1e-9)
    columns = {
        "uv_0": whole.uv,
        "uv_1": tracks.uv_1,
        "tracked": tracks.valid,
        "xyz": torch.where(filled[..., None], xyz, torch.nan),
        "rgb": _sample_colours(reference, whole.uv),
        **{name: getattr(whole, name) for name in ("depth", "sigma", "score", "source")},
        "gate": estimate.gate,
        "hole": samples.hole,
        "parallax_deg": estimate.parallax_deg,
        "residual_px": estimate.residual_px,
        "error": torch.where(truth.ok & estimate.keep, error, torch.nan),
        "candidate": truth.ok,
    }
    T_world_from_0 = _in_world(reference)
    held = reference.replace(depth=batch.exact.depth, depth_camera=batch.exact.depth_camera)
    ok = bool(fit.ok[0])
    cutoff = batch.cutoff if batch.cutoff is not None else float("inf")
    facts = {"pose": "none found"}
    if ok:
        facts["pose"] = f"{int(fit.n_inlier[0])} near returns agree, {float(fit.rms_px[0]):.2f} px"
        facts["baseline"] = f"{100 * float(fit.T_1_from_0.t.norm()):.1f} cm"
    if offered := batch.pairs[0].candidates:
        facts["views"] = str(report_selection(i, offered, answer.trace)).partition(": ")[2]
    return PairExhibit(
        label=f"{i} → {j}",
        samples={name: x[0].detach().cpu().numpy() for name, x in columns.items()},
        T_world_from_0=T_world_from_0,
        T_world_from_1=T_world_from_0 @ _pose_matrix(se3.invert(fit.T_1_from_0)) if ok else None,
        view_0=shown.index(i),
        view_1=shown.index(j),
        seen=_return_cloud(reference, (reference.depth > 0) & (reference.depth <= cutoff)),
        held=_return_cloud(held, held.depth > cutoff),
        swept=_swept_cloud(reference, answer.trace["dense"]) if "dense" in answer.trace else EMPTY_SWEPT_CLOUD,
        depth_image=_depth_image(reference, cutoff),
        facts=facts,
    )


def _make_picture(recording: Recording, k: int, frame: Frame) -> ExhibitView:
    time = None if recording.times is None else float(recording.times[k] - recording.times[0])
    return ExhibitView(
        int(recording.number[k]), time, *_encode_jpeg(_image_uint8(frame)), frame.hw, *_focal_and_centre(frame.camera)
    )


def _depth_image(frame: Frame, cutoff: float) -> DepthImage:
    depth = frame.depth[0].cpu()
    return DepthImage(
        torch.where(depth <= cutoff, depth, 0.0).float().numpy(), *_focal_and_centre(_depth_camera(frame))
    )


def _depth_camera(frame: Frame) -> Camera:
    hw = frame.depth.shape[-2], frame.depth.shape[-1]
    return (frame.depth_camera or cam.resize(frame.camera, frame.hw, hw)).to("cpu")


def _focal_and_centre(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    return (fx, fy), (cx, cy)


def _return_cloud(frame: Frame, wanted: torch.Tensor) -> PointCloud:
    """Some of the returns that are wanted, (1, h, w) bool, as points in the colours of the picture."""
    places = wanted[0].cpu().nonzero()
    if not len(places):
        return EMPTY_CLOUD
    v, u = _random_subset(places, MAX_CLOUD_POINTS).unbind(-1)
    camera = _depth_camera(frame)
    xyz = cam.unproject(camera, torch.stack((u, v), -1)[None].to(camera.f), frame.depth[:, v, u].cpu())
    rgb = _sample_colours(frame, cam.project(frame.camera.to("cpu"), xyz).nan_to_num())
    fine = xyz[0].isfinite().all(-1)
    return PointCloud(xyz[0, fine].float().numpy(), rgb[0, fine].numpy())


def _swept_cloud(frame: Frame, found: DepthMap) -> SweptPointCloud:
    """The swept pixels of a map (B = 1), or those in every second, third … row and column."""
    found = found.to("cpu")
    hw = found.depth.shape[-2], found.depth.shape[-1]
    apart = math.ceil(math.sqrt(max(1, int((found.source == Source.SWEPT).sum())) / MAX_SWEPT_POINTS))
    lattice = torch.zeros(hw, dtype=torch.bool)
    lattice[::apart, ::apart] = True
    some = ((found.source == Source.SWEPT)[0] & lattice).flatten().nonzero()[:, 0][:MAX_SWEPT_POINTS]
    uv = map_pixel_centres(frame, hw)[some].cpu()[None]
    depth, sigma, score = (x.flatten(1)[:, some].float() for x in (found.depth, found.sigma, found.score))
    xyz = cam.unproject(frame.camera.to("cpu"), uv, depth)
    step = apart * frame.hw[1] / hw[1]
    points, rgb, sigmas, scores = (x[0].numpy() for x in (xyz.float(), _sample_colours(frame, uv), sigma, score))
    return SweptPointCloud(points, rgb, sigmas, scores, step_px=step)


def _random_subset(places: torch.Tensor, most: int) -> torch.Tensor:
    """At most so many rows of these, drawn at random."""
    return places[torch.randperm(len(places), generator=torch.Generator().manual_seed(0))[:most]]


def _sample_colours(frame: Frame, uv: torch.Tensor) -> torch.Tensor:
    """(1, N, 3) uint8: the picture at pixels."""
    picture = torch.from_numpy(_image_uint8(frame)).permute(2, 0, 1)[None]
    return torch.stack([sample_nearest(picture[:, k], uv.cpu())[0] for k in range(3)], -1)


def _image_uint8(frame: Frame) -> np.ndarray:
    """(H, W, 3) uint8."""
    image = frame.image[0].detach().cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return image.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()


def _encode_jpeg(pixels: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """The picture, made smaller where it is large, and its (height, width)."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    picture = Image.fromarray(pixels)
    out = io.BytesIO()
    picture.thumbnail((_MAX_SIDE_PX, _MAX_SIDE_PX))
    picture.save(out, "JPEG", quality=_JPEG_QUALITY)
    return out.getvalue(), (picture.height, picture.width)


def _in_world(frame: Frame) -> np.ndarray:
    return np.eye(4) if frame.T_world_from_cam is None else _pose_matrix(frame.T_world_from_cam)


def _pose_matrix(pose: Pose) -> np.ndarray:
    return se3.to_matrix(pose)[0].detach().cpu().double().numpy()


def _evenly_spaced(items: Sequence[Any], most: int) -> list[Any]:
    """At most ``most`` of them, evenly spread, the first and the last among them."""
    n = len(items)
    if n <= most:
        return list(items)
    return [items[k] for k in sorted({round(k * (n - 1) / max(most - 1, 1)) for k in range(most)})]
