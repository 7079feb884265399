"""Pair pipeline: the stages of a method in sequence, two RGB-D views -> far depth with abstention; and merged depth."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import all_finite, any_possible, check, is_transformed
from dhtorch.geometry.linalg import small_matmul
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.pytree import R, chunked_apply, stack
from dhtorch.records import (
    NO_HINT,
    Camera,
    Estimate,
    Frame,
    InitialPose,
    MergedDepth,
    PoseFit,
    PosePrior,
    Samples,
    TrackHint,
    Tracks,
)
from dhtorch.stages.pose import map_pose
from dhtorch.stages.pose_prior import check_pose_prior, reject_poses
from dhtorch.stages.sample import spiral

#: Most pairs tracked at once: more are no faster, and their pyramids cost memory. Source: origin not recorded.
TRACK_CHUNK_PAIRS = 8

#: Places, evenly spread over the image, among which :func:`sample_returns` finds returns, a count: a few returns in a
#: thousand pixels are met. Source: derived, 10 of them where one pixel in eight hundred has a return.
N_RETURN_PLACES = 8192

#: Fraction of the tracks with less motion than ``STATIC_FLOW_PX`` above which the camera stood still. Objects that move
#: in front of it are not the background, which only near returns could distinguish otherwise.
#: Source: origin not recorded.
STATIC_RATIO = 0.7

#: Fewest tracks from which a camera that stood still is detected. Source: origin not recorded.
MIN_STATIC_TRACKS = 16

#: Motion below which a track counts as static, px. Source: origin not recorded.
STATIC_FLOW_PX = 0.25

#: Largest residual of near returns under a pose that is only a start, for a ray with z = 1.
#: Source: origin not recorded.
MAX_START_RESIDUAL = 0.04

#: Fewest near inliers of a pose refined from a start, if near returns have no pose of their own: fewer fit almost any
#: pose. Source: origin not recorded.
MIN_NEAR_INLIERS = 8


def estimate_pair(
    method: MethodSpec,
    frame_0: Frame,
    frame_1: Frame,
    *,
    seed: int | Tensor = 0,
    fit: PoseFit | PosePrior | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> Estimate:
    """Estimate (B, n) of a method for B reference views with one other view each, for ``method(frame_0, frame_1)``.

    Arguments, result and errors are those of :class:`dhtorch.pipeline.method.Method`.
    """
    check("extend", image_0=(frame_0.image, "B C H W"), f_0=(frame_0.camera.f, "B 2"), t=(frame_1.camera.f, "B 2"))
    check("extend", image_0=(frame_0.image, "B C H W"), image_1=(frame_1.image, "B c h w"))
    frame_0, frame_1 = upcast_intrinsics(frame_0), upcast_intrinsics(frame_1)
    clock = StageTimer(trace)
    like = frame_0.camera.f
    uv = clock("sample", method.sample(frame_0.hw, method.n, device=like.device, dtype=like.dtype))
    samples = clock("backproject", method.backproject(frame_0, uv))
    samples = clock("classify", method.classify(frame_0, samples))
    n = samples.uv.shape[1]
    samples = add_pose_samples(method, frame_0, samples)
    tracks = clock("track", track_in_chunks(method, frame_0.image, frame_1.image, samples.uv, hint))
    cameras = frame_0.camera, frame_1.camera
    estimate, usable, solved = solve_pose_and_triangulate(
        method, samples, tracks, *cameras, seed=seed, fit=fit, clock=clock
    )
    if method.verify_views is not None:
        estimate = method.verify_views(samples, *(stack([x]) for x in (usable, solved, estimate)))[0]
    if samples.uv.shape[1] > n:
        samples = without_added(samples, n)
        tracks = without_added(tracks, n)
        usable = without_added(usable, n)
        estimate = without_added(estimate, n)
        solved = solved.replace(inlier=solved.inlier[:, :n])
    estimate = clock("score", method.score(estimate, samples, usable, solved))
    if trace is not None:
        trace.update(samples=samples, tracks=tracks, tracks_ideal=usable, fit=solved, estimate=estimate)
    return estimate


def sample_returns(method: MethodSpec, frame: Frame, n: int) -> Samples:
    """Samples (B, n) of a method at near returns with texture, evenly spread; of fewer returns all.

    The rest of the n has trackability 0, with which no sample is used. Gradient: as stages 2 and 3 of the method.
    """
    like = frame.camera.f
    uv = spiral(frame.hw, N_RETURN_PLACES, foveation=0.5, device=like.device, dtype=like.dtype)
    places = method.sample_depth_at(frame, uv)
    is_usable = places.usable & (places.trackability >= method.min_trackability)
    count = is_usable.sum(-1, keepdim=True)
    k = torch.arange(n, device=like.device)
    rank = torch.where(count > n, ((2 * k + 1) * count).div(2 * n, rounding_mode="floor"), k)
    index = (~is_usable).long().argsort(dim=-1, stable=True).gather(-1, rank)
    chosen = places[torch.arange(len(index), device=like.device)[:, None], index]
    return chosen.replace(trackability=torch.where(k < count, chosen.trackability, 0.0))


def add_pose_samples(method: MethodSpec, frame: Frame, samples: Samples) -> Samples:
    """The samples (B, N), or (B, N + ``method.pose_samples``) where a view of the batch has fewer near returns.

    The pose of a view whose sensor has few returns needs those that the samples miss. They are appended to the views
    that need them and unused (trackability 0) in the others.
    """
    if method.pose_samples < 1:
        return samples
    is_near = samples.usable & (samples.trackability >= method.min_trackability)
    is_short = is_near.sum(-1, keepdim=True) < method.pose_samples
    if not any_possible(is_short):
        return samples
    added = sample_returns(method, frame, method.pose_samples)
    added = added.replace(trackability=torch.where(is_short, added.trackability, 0.0))
    return pytree.collate((samples, added), dim=1)


def without_added(record: R, n: int) -> R:
    """A record of samples, tracks or estimates (…, N) without those after the n-th."""
    return record.map(lambda x: x[:, :n])


def track_in_chunks(method: MethodSpec, image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
    """Stage 4, the tracks (B, N) from ``image_0`` into ``image_1``, in chunks of pairs to bound memory."""

    def track_chunk(image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
        return method.track(image_0, image_1, uv, hint=hint)

    return chunked_apply(track_chunk, TRACK_CHUNK_PAIRS, image_0, image_1, uv, hint)


def solve_pose_and_triangulate(
    method: MethodSpec,
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    *,
    seed: int | Tensor,
    fit: PoseFit | PosePrior | None,
    clock: StageTimer,
) -> tuple[Estimate, Tracks, PoseFit]:
    """Stages 5 and 6: triangulate tracks under the pose estimated from them, or under a given one.

    Returns:
        The estimate, the tracks in ideal pixels, those without texture invalid, and the pose.
    """
    textured = samples.trackability >= method.min_trackability
    usable = tracks.replace(valid=tracks.valid & textured)
    usable = undistort_tracks(usable, camera_0, camera_1)
    camera_0, camera_1 = cam.ideal(camera_0), cam.ideal(camera_1)
    if not isinstance(fit, PoseFit):
        draws = uniform_draws(seed, camera_0.f.shape[0], method.hypotheses).to(camera_0.f)
        solved = method.pose(samples, usable, camera_0, camera_1, draws)
        fit = solved if fit is None else _apply_prior(fit, solved, samples, usable, camera_0, camera_1)
        fit = fit.replace(code=torch.where(_is_static(fit, usable), PoseCode.NO_BASELINE, fit.code).to(fit.code.dtype))
        if (verify := method.verify) is not None:
            fit = _verify(lambda pose: verify(samples, usable, pose, camera_0, camera_1), fit, solved)
    clock("pose", fit)
    estimate = clock("triangulate", method.triangulate(samples, usable, fit, camera_0, camera_1))
    untextured = (estimate.gate == Gate.NO_TRACK) & tracks.valid & ~textured
    gate = torch.where(untextured, torch.full_like(estimate.gate, Gate.NO_TEXTURE), estimate.gate)
    return estimate.replace(gate=gate), usable, fit


def _is_static(fit: PoseFit, tracks: Tracks) -> Tensor:
    """Whether (B,) the camera stood still: no pose, and most tracks without motion."""
    with torch.no_grad():
        square_flow = (tracks.uv_1 - tracks.uv_0).square().sum(-1)
        n_static = (tracks.valid & (square_flow < STATIC_FLOW_PX**2)).sum(-1)
        n_tracks = tracks.valid.sum(-1)
        no_pose = (fit.code == PoseCode.TOO_FEW) | (fit.code == PoseCode.DEGENERATE)
        return no_pose & (n_tracks >= MIN_STATIC_TRACKS) & (n_static > STATIC_RATIO * n_tracks)


def _verify(
    verify: Callable[[PoseFit], PoseFit],
    fit: PoseFit,
    solved: PoseFit,
) -> PoseFit:
    """The fit without the poses that ``verify`` rejects; returns at wrong pixels do not refute a given pose."""
    verified = verify(fit)
    refuted = fit.code == PoseCode.REFUTED
    if not any_possible(refuted):
        return verified
    misaligned = refuted & (verify(solved).code == PoseCode.MISALIGNED)
    return verified.without_pose(misaligned, PoseCode.MISALIGNED)


def _apply_prior(
    prior: PosePrior, solved: PoseFit, samples: Samples, tracks: Tracks, camera_0: Camera, camera_1: Camera
) -> PoseFit:
    """The pose of a prior after the test by near returns; of an InitialPose, the most probable pose from that start."""
    if not isinstance(prior, InitialPose):
        return check_pose_prior(prior, samples, tracks, camera_0, camera_1, solved)
    start = check_pose_prior(
        prior.replace(cov=None), samples, tracks, camera_0, camera_1, solved, max_residual=MAX_START_RESIDUAL
    )
    no_draws = samples.uv.new_zeros(len(samples.uv), 1, 3)
    refined = map_pose(samples, tracks, camera_0, camera_1, no_draws, start=lambda *_: start).replace(
        matched_convention=start.matched_convention
    )
    # A search from a distant start may end at a pose that near returns contradict: it is tested like any other prior.
    end = PosePrior(refined.T_1_from_0)
    checked = check_pose_prior(end, samples, tracks, camera_0, camera_1, solved, min_confirmed=MIN_NEAR_INLIERS)
    return reject_poses(refined, checked)


def merge(samples: Samples, estimate: Estimate | None) -> MergedDepth:
    """Merged depth at the samples: the sensor's return where it is usable, else the recovered depth, else a hole.

    Without an estimate, the sensor's returns alone.

    Gradient: to both sources.
    """
    if estimate is None:
        return MergedDepth(samples.uv, *_sensor_values(samples.depth, samples.sigma, samples.confidence, samples.xyz))
    is_sensed = samples.usable
    is_recovered = estimate.keep & ~is_sensed
    zero = torch.zeros_like(samples.depth)

    def choose(sensor: Tensor, answer: Tensor) -> Tensor:
        return torch.where(is_sensed, sensor, torch.where(is_recovered, answer.nan_to_num(), zero))

    source = torch.where(is_sensed, Source.SENSOR, torch.where(is_recovered, Source.RECOVERED, Source.NONE))
    return MergedDepth(
        uv=samples.uv,
        depth=choose(samples.depth, estimate.depth),
        sigma=choose(samples.sigma, estimate.sigma),
        score=choose(samples.confidence, estimate.score),
        source=source.to(torch.int32),
    )


def _sensor_values_kernel(
    depth: Tensor, sigma: Tensor, confidence: Tensor, xyz: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    z, noise, score = (torch.empty_like(x) for x in (depth, sigma, confidence))
    source = torch.empty_like(depth, dtype=torch.int32)
    outputs = z, noise, score, source
    torch.ops.dhtorch.sensor_values.default(depth, sigma, confidence, xyz, *outputs)
    return outputs


@operator(
    kernel=_sensor_values_kernel,
    dtypes={"depth": torch.float32, "sigma": torch.float32, "confidence": torch.float32, "xyz": torch.float32},
)
def _sensor_values(
    depth: Tensor, sigma: Tensor, confidence: Tensor, xyz: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth, sigma, score and source (B, N) of samples with a point (B, N, 3), 0 for the others."""
    is_sensed = all_finite(xyz, -1)
    depth, sigma, score = (torch.where(is_sensed, x, 0.0) for x in (depth, sigma, confidence))
    return depth, sigma, score, is_sensed.int() * Source.SENSOR


def upcast_intrinsics(frame: Frame) -> Frame:
    """The frame with intrinsics of at least single precision: the 11 bits of half precision err by up to half a pixel.

    Gradient: to the intrinsics.
    """

    def single(camera: Camera | None) -> Camera | None:
        if camera is None or camera.f.dtype.itemsize >= 4:
            return camera
        return camera.map(lambda x: x.float())

    return frame.replace(camera=single(frame.camera), depth_camera=single(frame.depth_camera))


def undistort_tracks(tracks: Tracks, camera_0: Camera, camera_1: Camera) -> Tracks:
    """Tracks in ideal pixels with propagated covariances; pixels outside the lens model become invalid.

    Gradient: to pixels, intrinsics and distortion.
    """
    if camera_0.distortion is None and camera_1.distortion is None:
        return tracks
    is_finite = tracks.uv_0.isfinite().all(-1) & tracks.uv_1.isfinite().all(-1)
    centre_0, centre_1 = (c.c.detach()[:, None] for c in (camera_0, camera_1))
    uv_0 = cam.undistort(camera_0, torch.where(is_finite[..., None], tracks.uv_0, centre_0))
    uv_1 = cam.undistort(camera_1, torch.where(is_finite[..., None], tracks.uv_1, centre_1))
    in_model = is_finite & uv_0.isfinite().all(-1) & uv_1.isfinite().all(-1)
    uv_0 = torch.where(in_model[..., None], uv_0, tracks.uv_0)
    uv_1 = torch.where(in_model[..., None], uv_1, tracks.uv_1)
    J = cam.undistort_jacobian(camera_1, torch.where(in_model[..., None], uv_1, centre_1))
    has_cov = tracks.cov.isfinite()
    ideal_cov = small_matmul(small_matmul(J, torch.where(has_cov, tracks.cov, 0)), J.mT)
    cov = torch.where(has_cov, ideal_cov, tracks.cov)
    return tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=tracks.valid & in_model)


def uniform_draws(seed: int | Tensor, batch: int, hypotheses: int) -> Tensor:
    """Random numbers for the pose search: (batch, hypotheses, 3) uniform in [0, 1), float64, on the CPU.

    They depend only on the seed of each pair: not on other pairs of the batch, their order, the worker or the device.

    Raises:
        ValueError: ``seed`` is a tensor of another shape than (batch,).
    """
    draws = _draws_op if is_transformed() else _draw_rows
    if isinstance(seed, int):
        return draws(torch.tensor([seed]), hypotheses).expand(batch, -1, -1)
    if seed.shape != (batch,):
        raise ValueError(f"extend: seed has shape {tuple(seed.shape)}, expected an int or ({batch},) int64")
    return draws(seed.cpu(), hypotheses)


def _draw_rows(seed: Tensor, hypotheses: int) -> Tensor:
    """Uniform numbers (batch, hypotheses, 3) from the seeds (batch,)."""
    generators = [torch.Generator().manual_seed(int(s)) for s in seed.tolist()]
    rows = [torch.rand(hypotheses, 3, generator=g, dtype=torch.float64) for g in generators]
    return torch.stack(rows) if rows else torch.zeros(0, hypotheses, 3, dtype=torch.float64)


# One operation for torch.compile and vmap, which cannot trace a generator; the result is a function of the seed alone.
# It is used only under transforms, since its first call imports the compiler.
_draws_op = torch.library.custom_op("dhtorch::uniform_draws", _draw_rows, mutates_args=())


@_draws_op.register_fake
def _(seed: Tensor, hypotheses: int) -> Tensor:
    return torch.empty(len(seed), hypotheses, 3, dtype=torch.float64)


class StageTimer:
    """Adds the milliseconds of each stage to a trace; does nothing without a trace."""

    def __init__(self, trace: Trace | None) -> None:
        self.ms = None if trace is None else trace.setdefault("ms", {})
        self.last = time.perf_counter() if trace is not None else 0.0

    def __call__(self, name: str, value: Any) -> Any:
        """The value unchanged; the time since the last call is added to stage ``name``."""
        if self.ms is not None:
            now = time.perf_counter()
            self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self.last)
            self.last = now
        return value
