"""The line that joins the seats of a method: two RGB-D views in, far depth with abstention out; and their map."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import all_finite, check, is_transformed
from dhtorch.geometry.linalg import small_matmul
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.pytree import chunked_apply
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

#: Pairs tracked at once: more are no faster, and their pyramids cost memory.
TRACK_CHUNK_PAIRS = 8

#: The camera stood still where more than this share of at least so many tracks moved by fewer pixels. What moves in
#: front of it is not the background, and without near returns nothing else can tell.
STATIC_RATIO, MIN_STATIC_TRACKS, STATIC_FLOW_PX = 0.7, 16, 0.25

#: Residual of near returns that a pose may leave from which a search only starts, of a ray with z = 1.
MAX_START_RESIDUAL = 0.04

#: Near returns that must lie where a search ends, if they have no pose of their own: fewer fit almost anywhere.
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
    """The method's answer for B reference views with one other view each; what ``method(frame_0, frame_1)`` calls.

    Arguments, answer and errors are those of :class:`dhtorch.pipeline.method.Method`.
    """
    check("extend", image_0=(frame_0.image, "B C H W"), f_0=(frame_0.camera.f, "B 2"), t=(frame_1.camera.f, "B 2"))
    check("extend", image_0=(frame_0.image, "B C H W"), image_1=(frame_1.image, "B c h w"))
    frame_0, frame_1 = upcast_intrinsics(frame_0), upcast_intrinsics(frame_1)
    clock = StageTimer(trace)
    like = frame_0.camera.f
    uv = clock("sample", method.sample(frame_0.hw, method.n, device=like.device, dtype=like.dtype))
    samples = clock("backproject", method.backproject(frame_0, uv))
    samples = clock("classify", method.classify(frame_0, samples))
    tracks = clock("track", track_in_chunks(method, frame_0.image, frame_1.image, samples.uv, hint))
    cameras = frame_0.camera, frame_1.camera
    estimate, usable, fit = solve_pose_and_triangulate(
        method, samples, tracks, *cameras, seed=seed, fit=fit, clock=clock
    )
    estimate = clock("score", method.score(estimate, samples, usable, fit))
    if trace is not None:
        trace.update(samples=samples, tracks=tracks, tracks_ideal=usable, fit=fit, estimate=estimate)
    return estimate


def track_in_chunks(method: MethodSpec, image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
    """Seat 4, so many pairs at a time that memory stays bounded."""

    def some(image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
        return method.track(image_0, image_1, uv, hint=hint)

    return chunked_apply(some, TRACK_CHUNK_PAIRS, image_0, image_1, uv, hint)


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
    """Seats 5 and 6: what tracks say under the pose that they give, or under a known one.

    Returns:
        The estimate, the tracks in ideal pixels with those that have no texture no longer valid, and the pose.
    """
    textured = samples.trackability >= method.min_trackability
    usable = tracks.replace(valid=tracks.valid & textured)
    usable = undistort_tracks(usable, camera_0, camera_1)
    camera_0, camera_1 = cam.ideal(camera_0), cam.ideal(camera_1)
    if not isinstance(fit, PoseFit):
        draws = uniform_draws(seed, camera_0.f.shape[0], method.hypotheses).to(camera_0.f)
        found = method.pose(samples, usable, camera_0, camera_1, draws)
        fit = found if fit is None else _apply_prior(fit, found, samples, usable, camera_0, camera_1)
        fit = fit.replace(code=torch.where(_is_static(fit, usable), PoseCode.NO_BASELINE, fit.code).to(fit.code.dtype))
    clock("pose", fit)
    estimate = clock("triangulate", method.triangulate(samples, usable, fit, camera_0, camera_1))
    untextured = (estimate.gate == Gate.NO_TRACK) & tracks.valid & ~textured
    gate = torch.where(untextured, torch.full_like(estimate.gate, Gate.NO_TEXTURE), estimate.gate)
    return estimate.replace(gate=gate), usable, fit


def _is_static(fit: PoseFit, tracks: Tracks) -> Tensor:
    """Whether (B,) a pose is missing and most of the picture stayed where it was: the camera stood still."""
    with torch.no_grad():
        way = (tracks.uv_1 - tracks.uv_0).square().sum(-1)
        stayed = (tracks.valid & (way < STATIC_FLOW_PX**2)).sum(-1)
        seen = tracks.valid.sum(-1)
        lost = (fit.code == PoseCode.TOO_FEW) | (fit.code == PoseCode.DEGENERATE)
        return lost & (seen >= MIN_STATIC_TRACKS) & (stayed > STATIC_RATIO * seen)


def _apply_prior(
    given: PosePrior, found: PoseFit, samples: Samples, tracks: Tracks, camera_0: Camera, camera_1: Camera
) -> PoseFit:
    """A pose from elsewhere as the near returns leave it: held against them, or the start of the most probable one."""
    if not isinstance(given, InitialPose):
        return check_pose_prior(given, samples, tracks, camera_0, camera_1, found)
    held = check_pose_prior(
        given.replace(cov=None), samples, tracks, camera_0, camera_1, found, max_residual=MAX_START_RESIDUAL
    )
    unused = samples.uv.new_zeros(len(samples.uv), 1, 3)
    refined = map_pose(samples, tracks, camera_0, camera_1, unused, start=lambda *_: held).replace(
        matched_convention=held.matched_convention
    )
    # From far off a search may end where near returns do not: they are asked again, now as of any pose.
    end = PosePrior(refined.T_1_from_0)
    ended = check_pose_prior(end, samples, tracks, camera_0, camera_1, found, min_confirmed=MIN_NEAR_INLIERS)
    return reject_poses(refined, ended)


def merge(samples: Samples, estimate: Estimate | None) -> MergedDepth:
    """The user's map: the sensor where it has a usable return, a recovered depth where it has none, else a hole.

    Without an estimate the sensor's returns alone.

    Gradient: to both sources.
    """
    if estimate is None:
        return MergedDepth(samples.uv, *_sensor_values(samples.depth, samples.sigma, samples.confidence, samples.xyz))
    sensed = samples.usable
    recovered = estimate.keep & ~sensed
    zero = torch.zeros_like(samples.depth)

    def choose(sensor: Tensor, answer: Tensor) -> Tensor:
        return torch.where(sensed, sensor, torch.where(recovered, answer.nan_to_num(), zero))

    source = torch.where(sensed, Source.SENSOR, torch.where(recovered, Source.RECOVERED, Source.NONE))
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
    sensed = all_finite(xyz, -1)
    depth, sigma, score = (torch.where(sensed, x, 0.0) for x in (depth, sigma, confidence))
    return depth, sigma, score, sensed.int() * Source.SENSOR


def upcast_intrinsics(frame: Frame) -> Frame:
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
    known = tracks.cov.isfinite()
    turned = small_matmul(small_matmul(J, torch.where(known, tracks.cov, 0)), J.mT)
    cov = torch.where(known, turned, tracks.cov)
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


class StageTimer:
    """Writes the milliseconds of each stage into a trace; does nothing without one."""

    def __init__(self, trace: Trace | None) -> None:
        self.ms = None if trace is None else trace.setdefault("ms", {})
        self.last = time.perf_counter() if trace is not None else 0.0

    def __call__(self, name: str, value: Any) -> Any:
        """The value, with the time since the last one put down to that name."""
        if self.ms is not None:
            now = time.perf_counter()
            self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self.last)
            self.last = now
        return value
