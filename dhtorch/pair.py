"""The method: two RGB-D views in, far depth with abstention out. Seven seats in a straight line.

    anchor view ─ sample ─ backproject ─ classify ─┬─ near, with depth ──── pose ────┐
                                                   └─ trackable, without ─ track ────┴─ triangulate ─ score

Every seat is a function with keyword options; another method is the same line with other functions in its seats.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Gate, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry.shapes import check, is_transformed
from dhtorch.records import Camera, Estimate, Frame, Map, PoseFit, Samples, Tracks
from dhtorch.stages import backproject as _backproject
from dhtorch.stages import holes as _holes
from dhtorch.stages import pose as _pose
from dhtorch.stages import sample as _sample
from dhtorch.stages import score as _score
from dhtorch.stages import track as _track
from dhtorch.stages import triangulate as _triangulate
from dhtorch.tree import in_pieces

#: Pairs tracked at once: more are no faster, and their pyramids cost memory.
PAIRS = 8

#: Intermediates and milliseconds by stage name; fill one with ``extend(..., trace=trace)``.
Trace = dict[str, Any]


def extend(
    frame_0: Frame,
    frame_1: Frame,
    *,
    sample: Callable[..., Tensor] = _sample.spiral,
    backproject: Callable[..., Samples] = _backproject.backproject,
    classify: Callable[..., Samples] = _holes.classify,
    track: Callable[..., Tracks] = _track.lucas_kanade,
    pose: Callable[..., PoseFit] = _pose.pnp_ransac,
    triangulate: Callable[..., Estimate] = _triangulate.two_view,
    score: Callable[..., Estimate] = _score.rank,
    n: int = 2048,
    hypotheses: int = 200,
    min_trackability: float = 1e-5,
    seed: int | Tensor = 0,
    fit: PoseFit | None = None,
    trace: Trace | None = None,
) -> Estimate:
    """Extend the depth sensor of ``frame_0`` with the parallax between two views.

    Near returns fix the metric relative pose of the two views; every tracked sample, those without a return above
    all, is triangulated under that pose; gates leave a hole with a reason where the geometry is weak.

    Args:
        frame_0: B anchor views; answers are depths along their samples.
        frame_1: B other views. Their depth is not read. Cameras may differ.
        sample, backproject, classify, track, pose, triangulate, score: the seven seats.
        n: samples per pair.
        hypotheses: minimal samples drawn by the pose search.
        min_trackability: samples below it are not used (gate NO_TEXTURE).
        seed: an int gives every pair the same draws; a (B,) int64 tensor gives each pair its own.
        fit: a pose from elsewhere; seat 5 is then skipped.
        trace: a dict that receives ``samples``, ``tracks`` (as tracked), ``tracks_ideal`` (undistorted), ``fit``,
            ``estimate`` and ``ms`` (milliseconds by stage).

    Returns:
        Estimate for the B × n samples of view 0, silent ones with their reason; in the dtype of the intrinsics, float32
        where these are half precision. Images and depth may be of any floating dtype.

    Raises:
        ValueError: wrong shapes, or different batch sizes.

    Memory: grows with the answers; pyramids are held of eight pairs at most, unless a graph keeps them.
    Gradient: recovered depth to both images, to the near depth and to intrinsics; choices (flags, inliers, gates)
    carry none.
    Source: paper, section "Method".
    """
    check("extend", image_0=(frame_0.image, "B C H W"), f_0=(frame_0.camera.f, "B 2"), t=(frame_1.camera.f, "B 2"))
    check("extend", image_0=(frame_0.image, "B C H W"), image_1=(frame_1.image, "B c h w"))
    frame_0, frame_1 = lifted(frame_0), lifted(frame_1)
    clock = _Clock(trace)
    like = frame_0.camera.f
    uv = clock("sample", sample(frame_0.hw, n, device=like.device, dtype=like.dtype))
    samples = clock("backproject", backproject(frame_0, uv))
    samples = clock("classify", classify(frame_0, samples))
    tracks = clock("track", in_pieces(track, PAIRS, frame_0.image, frame_1.image, samples.uv))
    textured = samples.trackability >= min_trackability
    usable = tracks.replace(valid=tracks.valid & textured)
    usable = undistort_tracks(usable, frame_0.camera, frame_1.camera)
    camera_0, camera_1 = cam.ideal(frame_0.camera), cam.ideal(frame_1.camera)
    if fit is None:
        draws = uniform_draws(seed, like.shape[0], hypotheses).to(like)
        fit = pose(samples, usable, camera_0, camera_1, draws)
    clock("pose", fit)
    estimate = clock("triangulate", triangulate(samples, usable, fit, camera_0, camera_1))
    untextured = (estimate.gate == Gate.NO_TRACK) & tracks.valid & ~textured
    gate = torch.where(untextured, torch.full_like(estimate.gate, Gate.NO_TEXTURE), estimate.gate)
    estimate = clock("score", score(estimate.replace(gate=gate), samples, usable, fit))
    if trace is not None:
        trace.update(samples=samples, tracks=tracks, tracks_ideal=usable, fit=fit, estimate=estimate)
    return estimate


#: Methods by name, each called as :func:`extend`: the paper's, and pose and abstention by what the errors must be.
METHODS: dict[str, Callable[..., Estimate]] = {
    "paper": extend,
    "map": partial(
        extend,
        track=partial(_track.lucas_kanade_affine, levels=5),
        pose=_pose.map_pose,
        triangulate=partial(
            _triangulate.two_view,
            min_parallax_deg=None,
            max_sigma_rel=0.2,
            min_t_snr=30.0,
            max_mismatch_px=10.0,
            fitted_noise=True,
            mismatch_px=2.0,
            residual_px=0.5,
            round_trip_px=0.4,
            sensor_share=1.0,
        ),
        score=_score.rank_by_error,
    ),
}


def merge(samples: Samples, estimate: Estimate) -> Map:
    """The user's map: the sensor where it has a usable return, a recovered depth where it has none, else a hole.

    Gradient: to both sources.
    """
    sensed = samples.usable
    recovered = estimate.keep & ~sensed
    zero = torch.zeros_like(samples.depth)

    def choose(sensor: Tensor, answer: Tensor) -> Tensor:
        return torch.where(sensed, sensor, torch.where(recovered, answer.nan_to_num(), zero))

    source = torch.where(sensed, Source.SENSOR, torch.where(recovered, Source.RECOVERED, Source.NONE))
    return Map(
        uv=samples.uv,
        depth=choose(samples.depth, estimate.depth),
        sigma=choose(samples.sigma, estimate.sigma),
        score=choose(samples.confidence, estimate.score),
        source=source.to(torch.int32),
    )


def lifted(frame: Frame) -> Frame:
    """The frame with intrinsics of at least single precision: half a pixel is lost on the eleven bits of a half.

    Gradient: to the intrinsics.
    """

    def single(camera: Camera | None) -> Camera | None:
        if camera is None or camera.f.dtype.itemsize >= 4:
            return camera
        return camera.map(lambda x: x.float())

    return frame.replace(camera=single(frame.camera), depth_camera=single(frame.depth_camera))


def undistort_tracks(tracks: Tracks, camera_0: Camera, camera_1: Camera) -> Tracks:
    """Tracks in ideal pixels, covariances carried along; a pixel outside the lens model is no longer valid.

    Gradient: to pixels, intrinsics and distortion.
    """
    if camera_0.distortion is None and camera_1.distortion is None:
        return tracks
    given = tracks.uv_0.isfinite().all(-1) & tracks.uv_1.isfinite().all(-1)
    centre_0, centre_1 = (c.c.detach()[:, None] for c in (camera_0, camera_1))
    uv_0 = cam.undistort(camera_0, torch.where(given[..., None], tracks.uv_0, centre_0))
    uv_1 = cam.undistort(camera_1, torch.where(given[..., None], tracks.uv_1, centre_1))
    fine = given & uv_0.isfinite().all(-1) & uv_1.isfinite().all(-1)
    uv_0 = torch.where(fine[..., None], uv_0, tracks.uv_0)
    uv_1 = torch.where(fine[..., None], uv_1, tracks.uv_1)
    J = cam.undistort_jacobian(camera_1, torch.where(fine[..., None], uv_1, centre_1))
    # Products of 2×2 matrices written as sums: rounding then does not depend on the batch.
    known = tracks.cov.isfinite()
    half = (J[..., :, :, None] * torch.where(known, tracks.cov, 0)[..., None, :, :]).sum(-2)
    cov = torch.where(known, (half[..., :, None, :] * J[..., None, :, :]).sum(-1), tracks.cov)
    return tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=tracks.valid & fine)


def uniform_draws(seed: int | Tensor, batch: int, hypotheses: int) -> Tensor:
    """Random numbers for the pose search: (batch, hypotheses, 3) uniform in [0, 1), float64, on the CPU.

    They depend on the seed of each pair alone: not on its batch mates, its place, the worker or the device.

    Raises:
        ValueError: ``seed`` is a tensor of another shape than (batch,).
    """
    draws = _draws_op if is_transformed() else _drawn
    if isinstance(seed, int):
        return draws(torch.tensor([seed]), hypotheses).expand(batch, -1, -1)
    if seed.shape != (batch,):
        raise ValueError(f"extend: seed has shape {tuple(seed.shape)}, expected an int or ({batch},) int64")
    return draws(seed.cpu(), hypotheses)


def _drawn(seed: Tensor, hypotheses: int) -> Tensor:
    made = [torch.Generator().manual_seed(int(s)) for s in seed.tolist()]
    rows = [torch.rand(hypotheses, 3, generator=g, dtype=torch.float64) for g in made]
    return torch.stack(rows) if rows else torch.zeros(0, hypotheses, 3, dtype=torch.float64)


# One operation to torch.compile and vmap: neither can look into a generator, nor needs to, for nothing here is random.
# Others are spared it: its first call imports the compiler.
_draws_op = torch.library.custom_op("dhtorch::uniform_draws", _drawn, mutates_args=())


@_draws_op.register_fake
def _(seed: Tensor, hypotheses: int) -> Tensor:
    return torch.empty(len(seed), hypotheses, 3, dtype=torch.float64)


class _Clock:
    """Writes the milliseconds of each stage into a trace; does nothing without one."""

    def __init__(self, trace: Trace | None) -> None:
        self.ms = None if trace is None else trace.setdefault("ms", {})
        self.last = time.perf_counter() if trace is not None else 0.0

    def __call__(self, name: str, value: Any) -> Any:
        if self.ms is not None:
            now = time.perf_counter()
            self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self.last)
            self.last = now
        return value
