"""Exhibits for the viewer: images, point clouds, camera path and samples of a method's run on a recording."""

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from dhtorch.codes import Cause, Source, is_estimated
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.experiments.protocol import (
    Answer,
    Method,
    Progress,
    Protocol,
    Row,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
    run_protocol,
)
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

#: Maximum number of points of a depth map that are shown, drawn at random.
MAX_CLOUD_POINTS = 12_000

#: Maximum number of swept and filled pixels that are shown of one view, in rows and columns evenly spaced.
MAX_SWEPT_POINTS = 24_000


def make_exhibit(
    source: SceneLike,
    method: Method,
    pairs: ScenePairs,
    settings: Settings,
    *,
    most: int = 12,
    sweep: DenseSweep | None = None,
    progress: Progress = no_progress,
) -> Exhibit:
    """Run a method on pairs of a recording, as the main job does → exhibit of its images, samples and point clouds.

    Args:
        source: one scene, or a recording as a scene without a near limit or role.
        method: of one source view or several.
        pairs: scene → list of :class:`dhtorch.data.pairs.Pair`, or plain (reference view, other).
        settings: cutoff, seed, device, batch, workers.
        most: maximum number of pairs; of more, as many evenly spaced, the first and the last included.
        sweep: adds a dense map of the reference views.
        progress: wraps the loop over the pairs.

    Raises:
        ValueError: bad data or options, as :func:`dhtorch.experiments.protocol.run` raises them.
    """
    shown_scene = Scene.of(source)
    recording = shown_scene.recording
    pair_exhibits: list[PairExhibit] = []
    views: dict[int, ExhibitView] = {}

    def keep(answer: Answer) -> Row:
        batch = answer.batch
        for k, frame in ((batch.pairs[0][0], batch.reference), answer.other):
            if k not in views:
                time = None if recording.times is None else float(recording.times[k] - recording.times[0])
                jpeg = _encode_jpeg(_image_uint8(frame))
                views[k] = ExhibitView(int(recording.number[k]), time, *jpeg, frame.hw, *_intrinsics(frame.camera))
        pair_exhibits.append(_make_pair_exhibit(answer, list(views)))
        return {}

    def choose(scene: Scene) -> list[Any]:
        found = list(pairs(scene))
        last, n = len(found) - 1, min(most, len(found))
        return [found[k] for k in sorted({round(i * last / max(n - 1, 1)) for i in range(n)})]

    viewer_protocol = Protocol({"view": Variant(method, estimate=sweep, chooses=True)}, columns=keep, min_candidates=0)
    run_protocol([shown_scene], viewer_protocol, choose, settings, progress=progress)
    path = None if recording.poses is None else recording.poses.t.detach().cpu().numpy()
    return Exhibit(recording.name, pair_exhibits, list(views.values()), path)


def _make_pair_exhibit(answer: Answer, view_numbers: Sequence[int]) -> PairExhibit:
    batch, samples, estimate = answer.batch, answer.samples, answer.estimate
    tracks, fit, truth = answer.trace["tracks"], answer.trace["fit"], list(answer.truths.values())[-1]
    whole, reference, i, j = merge(samples, estimate), batch.reference, batch.pairs[0].reference, answer.other[0]
    # the largest cause of sigma; of a return the reference
    cause = torch.where(whole.source == Source.NONE, Cause.NONE, estimate.budget.dominating)
    xyz = cam.unproject(reference.camera, whole.uv, whole.depth)
    error = (estimate.depth - truth.depth).abs() / truth.depth.clamp_min(1e-9)
    columns = {
        "uv_0": whole.uv,
        "uv_1": tracks.uv_1,
        "tracked": tracks.valid,
        "xyz": torch.where((whole.source != Source.NONE)[..., None], xyz, torch.nan),
        "rgb": _sample_colours(reference, whole.uv),
        **{name: getattr(whole, name) for name in ("depth", "sigma", "score", "source")},
        "gate": estimate.gate,
        "hole": samples.hole,
        "parallax_deg": estimate.parallax_deg,
        "residual_px": estimate.residual_px,
        "error": torch.where(truth.ok & estimate.keep, error, torch.nan),
        "candidate": truth.ok,
        "cause": torch.where(whole.source == Source.SENSOR, Cause.REFERENCE, cause),
    }
    pose = reference.T_world_from_cam
    T_world_from_0 = np.eye(4) if pose is None else _pose_matrix(pose)
    held_back = reference.replace(depth=batch.exact.depth, depth_camera=batch.exact.depth_camera)
    ok = bool(fit.ok[0])
    cutoff = batch.cutoff if batch.cutoff is not None else float("inf")
    facts = {"pose": "none"}
    if ok:
        facts["pose"] = f"{int(fit.n_inlier[0])} near returns agree, {float(fit.rms_px[0]):.2f} px"
        facts["baseline"] = f"{100 * float(fit.T_1_from_0.t.norm()):.1f} cm"
    if offered := batch.pairs[0].candidates:
        facts["views"] = str(report_selection(i, offered, answer.trace)).partition(": ")[2]
    depth = reference.depth[0].cpu()
    shown_depth = torch.where(depth <= cutoff, depth, 0.0).float().numpy()
    return PairExhibit(
        label=f"{i} → {j}",
        samples={name: x[0].detach().cpu().numpy() for name, x in columns.items()},
        T_world_from_0=T_world_from_0,
        T_world_from_1=T_world_from_0 @ _pose_matrix(se3.invert(fit.T_1_from_0)) if ok else None,
        view_0=view_numbers.index(i),
        view_1=view_numbers.index(j),
        seen=_return_cloud(reference, (reference.depth > 0) & (reference.depth <= cutoff)),
        held_out=_return_cloud(held_back, held_back.depth > cutoff),
        swept=_swept_cloud(reference, answer.trace["dense"]) if "dense" in answer.trace else EMPTY_SWEPT_CLOUD,
        depth_image=DepthImage(shown_depth, *_intrinsics(_depth_camera(reference))),
        facts=facts,
    )


def _depth_camera(frame: Frame) -> Camera:
    hw = frame.depth.shape[-2], frame.depth.shape[-1]
    return (frame.depth_camera or cam.resize(frame.camera, frame.hw, hw)).to("cpu")


def _intrinsics(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    return (fx, fy), (cx, cy)


def _return_cloud(frame: Frame, mask: torch.Tensor) -> PointCloud:
    """Random subset of the returns in ``mask`` (1, h, w) → points with the colours of the image."""
    pixels = mask[0].cpu().nonzero()
    if not len(pixels):
        return EMPTY_CLOUD
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    v, u = pixels[order[:MAX_CLOUD_POINTS]].unbind(-1)
    camera = _depth_camera(frame)
    xyz = cam.unproject(camera, torch.stack((u, v), -1)[None].to(camera.f), frame.depth[:, v, u].cpu())
    rgb = _sample_colours(frame, cam.project(frame.camera.to("cpu"), xyz).nan_to_num())
    finite = xyz[0].isfinite().all(-1)
    return PointCloud(xyz[0, finite].float().numpy(), rgb[0, finite].numpy())


def _swept_cloud(frame: Frame, depth_map: DepthMap) -> SweptPointCloud:
    """Swept and filled pixels of a map (B = 1), thinned to every second, third … row and column → points."""
    depth_map = depth_map.to("cpu")
    hw = depth_map.depth.shape[-2], depth_map.depth.shape[-1]
    stride = math.ceil(math.sqrt(max(1, int(is_estimated(depth_map.source).sum())) / MAX_SWEPT_POINTS))
    lattice = torch.zeros(hw, dtype=torch.bool)
    lattice[::stride, ::stride] = True
    index = (is_estimated(depth_map.source)[0] & lattice).flatten().nonzero()[:, 0][:MAX_SWEPT_POINTS]
    uv = map_pixel_centres(frame, hw)[index].cpu()[None]
    depth, sigma, score = (x.flatten(1)[:, index].float() for x in (depth_map.depth, depth_map.sigma, depth_map.score))
    xyz = cam.unproject(frame.camera.to("cpu"), uv, depth)
    step = stride * frame.hw[1] / hw[1]
    points, rgb, sigmas, scores = (x[0].numpy() for x in (xyz.float(), _sample_colours(frame, uv), sigma, score))
    causes = depth_map.budget.dominating.flatten(1)[0, index].to(torch.uint8).numpy()
    filled = depth_map.source.flatten(1)[0, index].numpy() == Source.FILLED
    sources = np.where(filled, Source.FILLED, Source.SWEPT).astype(np.uint8)
    return SweptPointCloud(points, rgb, sigmas, scores, sources, step_px=step, cause=causes)


def _sample_colours(frame: Frame, uv: torch.Tensor) -> torch.Tensor:
    """Colours (1, N, 3) uint8 of the image at pixels, nearest neighbour."""
    image = torch.from_numpy(_image_uint8(frame)).permute(2, 0, 1)[None]
    return torch.stack([sample_nearest(image[:, k], uv.cpu())[0] for k in range(3)], -1)


def _image_uint8(frame: Frame) -> np.ndarray:
    """Image of a frame (B = 1) as (H, W, 3) uint8."""
    image = frame.image[0].detach().cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return image.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()


def _encode_jpeg(pixels: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """(JPEG of an image, its longer side at most 800 px; its (height, width))."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    image, out = Image.fromarray(pixels), io.BytesIO()
    image.thumbnail((800, 800))
    image.save(out, "JPEG", quality=82)
    return out.getvalue(), (image.height, image.width)


def _pose_matrix(pose: Pose) -> np.ndarray:
    return se3.to_matrix(pose)[0].detach().cpu().double().numpy()
