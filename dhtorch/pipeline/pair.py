"""Pair pipeline: the stages of a method in sequence, two RGB-D views -> far depth with abstention; and merged depth."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._pytree import tree_map

from dhtorch import pytree
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.checks import all_finite, any_possible, check, is_transformed, keep_beside, move_from_host
from dhtorch.geometry.epipolar import triangulate
from dhtorch.geometry.least_squares import select_batch
from dhtorch.geometry.linalg import small_matmul
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.pytree import R, chunked_apply, collate, stack
from dhtorch.records import (
    NO_HINT,
    Camera,
    Estimate,
    Frame,
    InitialPose,
    MergedDepth,
    Pose,
    PoseFit,
    PosePrior,
    Samples,
    Shutter,
    TrackHint,
    Tracks,
)
from dhtorch.stages.guided_search import GuidedMatches
from dhtorch.stages.pose import map_pose
from dhtorch.stages.pose_prior import check_pose_prior, reject_poses
from dhtorch.stages.sample import spiral
from dhtorch.stages.track import refine_tracks


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
    others = frame_1.map(lambda x: x[None])
    tracks, estimate, usable, solved = solve_pairs(
        method, frame_0, others, samples, tracks, seed=seed, fit=fit, hint=hint, clock=clock
    )
    if method.verify_views is not None:
        estimate = method.verify_views(samples, *(stack([x]) for x in (usable, solved, estimate)))[0]
    parts = {"samples": samples, "tracks": tracks, "tracks_ideal": usable, "fit": solved, "estimate": estimate}
    if samples.uv.shape[1] > n:
        parts = without_added(parts, n)
    estimate = method.score(*(parts[name] for name in ("estimate", "samples", "tracks_ideal", "fit")))
    estimate = clock("score", estimate)
    if trace is not None:
        trace.update({**parts, "estimate": estimate})
    return estimate


def sample_returns(method: MethodSpec, frame: Frame, n: int) -> Samples:
    """Samples (B, n) of a method at near returns with texture, evenly spread; of fewer returns all.

    The rest of the n has trackability 0, with which no sample is used. Gradient: as stages 2 and 3 of the method.
    """
    like = frame.camera.f
    # 8192 places, evenly spread: 10 of them meet a return where one pixel in eight hundred has one.
    uv = spiral(frame.hw, 8192, foveation=0.5, device=like.device, dtype=like.dtype)
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


def without_added(trace: Trace, n: int) -> Trace:
    """The trace of a pair without the samples (…, N) after the n-th, which only its pose used."""
    fit: PoseFit = trace["fit"]
    names = "samples", "tracks", "tracks_ideal", "estimate"
    cut = {name: trace[name].map(lambda x: x[:, :n]) for name in names}
    return {**trace, **cut, "fit": fit.replace(inlier=fit.inlier[:, :n])}


def track_in_chunks(method: MethodSpec, image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
    """Stage 4, the tracks (B, N) from ``image_0`` into ``image_1``, in chunks of pairs to bound memory."""

    def track_chunk(image_0: Tensor, image_1: Tensor, uv: Tensor, hint: TrackHint) -> Tracks:
        return method.track(image_0, image_1, uv, hint=hint)

    # More pairs at once are no faster, and their pyramids cost memory: 64 of 640×480 pixels, 700 MB.
    size = 8 if image_0.is_cpu else 64
    return chunked_apply(track_chunk, size, image_0, image_1, uv, hint)


#: Tracks, estimate, tracks in ideal pixels, and poses of pairs.
Solved = tuple[Tracks, Estimate, Tracks, PoseFit]


class _Views(NamedTuple):
    """V views of each of B reference views."""

    method: MethodSpec
    reference: Frame  # (B,)
    others: Frame  # (V, B)
    samples: Samples  # (V · B,)


def solve_pairs(
    method: MethodSpec,
    reference: Frame,  # (B,)
    others: Frame,  # (V, B)
    samples: Samples,  # (V · B,)
    tracks: Tracks,  # (V · B,)
    *,
    seed: int | Tensor,
    fit: PoseFit | PosePrior | None,  # (V · B,)
    hint: TrackHint,
    clock: "StageTimer",
) -> Solved:
    """Stages 5 and 6 of V views of each reference view, (V · B) pairs; with a prior ``method.guide`` searches, too.

    Without a prior a search lowers the coverage at a given error: matches are less exact than tracks. A prior's pose
    predicts where tracks begin a second time; of the poses with and without it that one is kept which answers most.
    Under the poses kept, samples without an answer are searched for in all views together. A method without a guide is
    not changed by any of this.

    Returns:
        Tracks, the estimate, the tracks in ideal pixels, and the poses.
    """
    views = _Views(method, reference, others, samples)
    flat = others.map(lambda x: x.flatten(0, 1))
    cameras = repeat_views(reference.camera, len(others.image)), flat.camera

    def solve(tracks: Tracks, use: PoseFit | PosePrior | None) -> Solved:
        run = partial(solve_pose_and_triangulate, samples=samples, tracks=tracks, seed=seed, clock=clock)
        estimate, usable, pose = run(method, camera_0=cameras[0], camera_1=cameras[1], fit=use)
        stage = method.triangulate
        limited = isinstance(stage, partial) and stage.keywords.get("max_far_noise") is not None
        if limited and method.guide is not None and use is not None and isinstance(fit, PosePrior):
            # Without the limit on far noise, from which near returns count as moving.
            unmoved = replace(method, triangulate=partial(stage, max_far_noise=None))
            free, _, _ = run(unmoved, camera_0=cameras[0], camera_1=cameras[1], fit=pose)
            estimate = select_batch(_agrees(pose, fit.T_1_from_0), free, estimate)
        return tracks, estimate, usable, pose

    if method.guide is not None:
        tracks = tracks.replace(valid=tracks.valid & ~_is_attached(method, samples, tracks))
    if method.guide is None or not isinstance(fit, PosePrior):
        return solve(tracks, fit)
    solved = solve(tracks, None)
    start = InitialPose(fit.T_1_from_0, fit.cov, fit.hypotheses)
    T, uses = fit.T_1_from_0, [] if isinstance(fit, InitialPose) else [fit]
    # Largest distances of tracks from where a pose allows, of a ray with z = 1: of a prior's pose (as of a start in
    # ``_apply_prior``), then of the pose refined from it (what ``check_pose_prior`` always tolerates).
    for tolerance in (0.04, 0.005):
        possible = _is_possible(samples, undistort_tracks(tracks, *cameras), *cameras, T, tolerance)
        matches = _search_matches(views, T, wanted=None)
        tracks = tracks.replace(valid=tracks.valid & possible)
        tracks = clock("guide", _track_again(views, tracks, matches, hint))
        started = solve(tracks, start)
        T = select_batch(started[3].ok, started[3].T_1_from_0.detach().to(T.t.dtype), T)
    solved = _most_answers(samples, [solved, solve(tracks, None), *(solve(tracks, use) for use in uses), started])
    return _answer_matches(views, solved, solve, clock)


def _agrees(fit: PoseFit, T_1_from_0: Pose) -> Tensor:
    """Whether poses (B,) are those of a prior up to its errors: near returns then do not move by themselves."""
    with torch.no_grad():
        T = select_batch(fit.ok, fit.T_1_from_0, T_1_from_0.to(fit.T_1_from_0.t.dtype))
        turn, shift = se3.log(se3.compose(T, se3.invert(T_1_from_0.to(T.t.dtype)))).split(3, -1)
        # Chosen on apc_arm, whose poses are off by .4 to 1.1 degrees and by 2 to 8 of 80 mm; a moving foreground is off
        # by more than half the translation.
        near_turn = turn.norm(dim=-1) <= 0.04
        return fit.ok & near_turn & (shift.norm(dim=-1) <= 0.25 * T_1_from_0.t.norm(dim=-1))


def _is_possible(
    samples: Samples, tracks: Tracks, camera_0: Camera, camera_1: Camera, T_1_from_0: Pose, tolerance: float
) -> Tensor:
    """Whether ideal tracks (B, N) end within ``tolerance`` (of a ray with z = 1) of where a pose allows."""
    with torch.no_grad():
        camera_0, camera_1 = cam.ideal(camera_0), cam.ideal(camera_1)
        uv_0, uv_1 = (torch.where(tracks.valid[..., None], x, 0.0) for x in (tracks.uv_0, tracks.uv_1))
        T = T_1_from_0.to(uv_1.dtype)
        off_line = triangulate(uv_0, uv_1, camera_0, camera_1, T).residual_px
        xyz = torch.where(samples.usable[..., None], samples.xyz, 1.0)
        off_point = (cam.project(camera_1, se3.apply(T, xyz)) - uv_1).norm(dim=-1)
        limit_px = tolerance * camera_1.f.amin(-1)[:, None]
        return ~(torch.where(samples.usable, off_point, off_line) > limit_px)


def _is_attached(method: MethodSpec, samples: Samples, tracks: Tracks) -> Tensor:
    """Near returns (B, N) that do not move in the picture while most others do: parts of the camera's carrier."""
    with torch.no_grad():
        near = tracks.valid & samples.usable & (samples.trackability >= method.min_trackability)
        static = near & ((tracks.uv_1 - tracks.uv_0).square().sum(-1) < 0.25**2)
        # Above this share the camera stood still: objects that move in front of it are not the background, which only
        # near returns could distinguish otherwise.
        return static & (static.sum(-1) < 0.7 * near.sum(-1))[:, None]


def _search_matches(views: _Views, T_1_from_0: Pose, wanted: Tensor | None) -> GuidedMatches:
    """Matches under the poses (V · B,), as (V, B, …); ``wanted`` (B, N)."""
    method, reference, others, samples = views
    assert method.guide is not None
    V, B = others.image.shape[:2]
    T = T_1_from_0.map(lambda x: x.detach().unflatten(0, (V, B)))
    arguments = samples[:B], reference.image, others.image, reference.camera, others.camera, T
    return method.guide(*arguments, wanted=wanted)


def _track_again(views: _Views, tracks: Tracks, matches: GuidedMatches, hint: TrackHint) -> Tracks:
    """The tracks, those that are not valid tracked once more from returns' predictions and unique matches (V, B, N)."""
    method, reference, others, samples = views
    V, B = others.image.shape[:2]
    known = samples.usable.unflatten(0, (V, B)) | matches.unique
    wanted = ~tracks.valid.unflatten(0, (V, B)) & known & matches.uv_1.isfinite().all(-1)
    outside = -2.0 * max(reference.hw)  # a point there costs nothing
    uv = torch.where(wanted[..., None], samples.uv.expand(V * B, -1, 2).unflatten(0, (V, B)), outside)
    start = hint.replace(levels=2)  # a track begins at a predicted place
    new = collate(
        track_in_chunks(method, reference.image, image, uv[k], start.replace(start=matches.uv_1[k]))
        for k, image in enumerate(others.image)
    )
    better = new.valid & wanted.flatten(0, 1)
    merged = _select_points(better, new, tracks)
    return merged.replace(uv_0=tracks.uv_0, valid=tracks.valid | better)


def _select_points(mask: Tensor, new: R, old: R) -> R:
    """Points of ``new`` where ``mask`` (B, N) holds, of ``old`` elsewhere; records of tensors (B, N, …)."""
    return tree_map(lambda a, b: torch.where(mask.view(*mask.shape, *[1] * (a.ndim - 2)), a, b), new, old)


def _most_answers(samples: Samples, results: list[Solved]) -> Solved:
    """Of several results the one with most answers without a return, pair by pair; the last of equals.

    The convention under which a refuted prior would fit stays known: it is the last result's.
    """
    count = torch.stack([(estimate.keep & ~samples.usable).sum(-1) for _, estimate, _, _ in results])
    best = (len(results) - 1) - count.flip(0).argmax(0)
    pair = torch.arange(len(best), device=best.device)
    tracks, estimates, usable, fits = (list(field) for field in zip(*results, strict=True))
    convention = fits[-1].matched_convention
    if any(fit.shutter is not None for fit in fits):
        still = [Shutter(torch.zeros_like(fit.T_1_from_0.t), F.pad(fit.cov, (0, 3, 0, 3))) for fit in fits]
        fits = [fit.replace(shutter=fit.shutter or shutter) for fit, shutter in zip(fits, still, strict=True)]
    fits = [fit.replace(matched_convention=None) for fit in fits]
    fit = stack(fits)[best, pair].replace(matched_convention=convention)
    return stack(tracks)[best, pair], stack(estimates)[best, pair], stack(usable)[best, pair], fit


def _answer_matches(
    views: _Views,
    solved: Solved,
    solve: Callable[[Tracks, PoseFit], Solved],
    clock: "StageTimer",
) -> Solved:
    """The result with unique matches of samples that no track answers as tracks of their own."""
    method, _, others, samples = views
    tracks, estimate, _, fit = solved
    V, B = others.image.shape[:2]
    textured = samples.trackability >= method.min_trackability
    answered = estimate.keep.unflatten(0, (V, B)).sum(0)
    # A sample that two views answer is not searched for: two can agree.
    few = (answered < min(V, 2)) & (textured & ~samples.usable)[:B]
    open_ = ~estimate.keep.unflatten(0, (V, B)) & few
    matches = _search_matches(views, fit.T_1_from_0, few)
    matched = (open_ & matches.unique & (matches.ncc >= 0.7) & matches.uv_1.isfinite().all(-1)).flatten(0, 1)
    uv_1, cov, rms = (x.flatten(0, 1) for x in (_differentiable_places(views, matches), matches.cov, matches.rms))
    matched_tracks = tracks.replace(uv_1=uv_1, cov=cov, photometric=rms, error=cov[..., 0, 0].sqrt(), valid=matched)
    return solve(clock("guide", _select_points(matched, matched_tracks, tracks)), fit)


def _differentiable_places(views: _Views, matches: GuidedMatches) -> Tensor:
    """The places (V, B, N, 2) of matches, with the gradient of a tracker's last step where a gradient is asked for."""
    _, reference, others, samples = views
    graph = reference.image.requires_grad or others.image.requires_grad or samples.uv.requires_grad
    if not (graph and torch.is_grad_enabled()):
        return matches.uv_1
    uv_0 = samples.uv.expand(*matches.uv_1.flatten(0, 1).shape).unflatten(0, matches.uv_1.shape[:2])
    steps = [
        refine_tracks(reference.image, image, uv_0[v], matches.uv_1[v], normalise="bias")
        for v, image in enumerate(others.image)
    ]
    step = torch.stack(steps)
    return matches.uv_1 + (step - step.detach())


def repeat_views(record: R, V: int) -> R:
    """A record of the reference view (B, …) repeated for every view: (V B, …)."""
    return record.map(lambda x: x.expand(V, *x.shape).flatten(0, 1))


def solve_pose_and_triangulate(
    method: MethodSpec,
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    *,
    seed: int | Tensor,
    fit: PoseFit | PosePrior | None,
    clock: "StageTimer",
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
        draws = _draws_beside(camera_0.f, seed, method.hypotheses)
        solved = method.pose(samples, usable, camera_0, camera_1, draws)
        fit = solved if fit is None else _apply_prior(fit, solved, samples, usable, camera_0, camera_1)
        fit = fit.replace(code=torch.where(_is_static(fit, usable), PoseCode.NO_BASELINE, fit.code).to(fit.code.dtype))
        if (verify := method.verify) is not None:
            refuted = fit.code == PoseCode.REFUTED
            fit = verify(samples, usable, fit, camera_0, camera_1)
            if any_possible(refuted):  # returns at wrong pixels do not refute a given pose
                code = verify(samples, usable, solved, camera_0, camera_1).code
                fit = fit.without_pose(refuted & (code == PoseCode.MISALIGNED), PoseCode.MISALIGNED)
    clock("pose", fit)
    estimate = clock("triangulate", method.triangulate(samples, usable, fit, camera_0, camera_1))
    untextured = (estimate.gate == Gate.NO_TRACK) & tracks.valid & ~textured
    gate = torch.where(untextured, torch.full_like(estimate.gate, Gate.NO_TEXTURE), estimate.gate)
    return estimate.replace(gate=gate), usable, fit


def _is_static(fit: PoseFit, tracks: Tracks) -> Tensor:
    """Whether (B,) the camera stood still: no pose, and most tracks without motion."""
    with torch.no_grad():
        square_flow = (tracks.uv_1 - tracks.uv_0).square().sum(-1)
        n_static = (tracks.valid & (square_flow < 0.25**2)).sum(-1)
        n_tracks = tracks.valid.sum(-1)
        no_pose = (fit.code == PoseCode.TOO_FEW) | (fit.code == PoseCode.DEGENERATE)
        return no_pose & (n_tracks >= 16) & (n_static > 0.7 * n_tracks)


def _apply_prior(
    prior: PosePrior, solved: PoseFit, samples: Samples, tracks: Tracks, camera_0: Camera, camera_1: Camera
) -> PoseFit:
    """The pose of a prior after the test by near returns; of an InitialPose, the most probable pose from that start."""
    if not isinstance(prior, InitialPose):
        return check_pose_prior(prior, samples, tracks, camera_0, camera_1, solved)
    start = check_pose_prior(prior.replace(cov=None), samples, tracks, camera_0, camera_1, solved, max_residual=0.04)
    no_draws = samples.uv.new_zeros(len(samples.uv), 1, 3)
    refined = map_pose(samples, tracks, camera_0, camera_1, no_draws, start=lambda *_: start).replace(
        matched_convention=start.matched_convention
    )
    # A search from a distant start may end at a pose that near returns contradict: it is tested like any other prior.
    end = PosePrior(refined.T_1_from_0)
    # Fewer inliers fit almost any pose.
    checked = check_pose_prior(end, samples, tracks, camera_0, camera_1, solved, min_confirmed=8)
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
    cam.check_lens(camera_0, camera_1)
    fields = tracks.uv_0, tracks.uv_1, tracks.cov, tracks.valid
    lenses = (x for camera in (camera_0, camera_1) for x in (camera.f, camera.c, camera.distortion))
    uv_0, uv_1, cov, valid = _undistort_tracks(*fields, *lenses)
    return tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=valid)


def _undistort_tracks_kernel(*tensors: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    no_lens = tensors[0].new_empty(0, 0)
    inputs = [no_lens if x is None else x.contiguous() for x in tensors]
    uv_0, uv_1, cov, valid = (torch.empty_like(x) for x in inputs[:4])
    torch.ops.dhtorch.undistort_tracks.default(*inputs, uv_0, uv_1, cov, valid, *cam.NEWTON_LIMITS)
    return uv_0, uv_1, cov, valid


#: What the kernel reads: pixels (B, N, 2), covariances (B, N, 2, 2) and validity (B, N), intrinsics of both cameras.
_TRACK_DTYPES = {
    name: torch.bool if name == "valid" else torch.float32
    for name in ("uv_0", "uv_1", "cov", "valid", *(f"{part}_{k}" for k in (0, 1) for part in ("f", "c", "distortion")))
}


@operator(kernel=_undistort_tracks_kernel, dtypes=_TRACK_DTYPES, any_layout=tuple(_TRACK_DTYPES))
def _undistort_tracks(*tensors: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`undistort_tracks` of the fields of tracks and the intrinsics of both cameras."""
    seen_0, seen_1, seen_cov, valid = tensors[:4]
    camera_0, camera_1 = (Camera(*intrinsics) for intrinsics in (tensors[4:7], tensors[7:]))
    is_finite = seen_0.isfinite().all(-1) & seen_1.isfinite().all(-1)
    centre_0, centre_1 = (c.c.detach()[:, None] for c in (camera_0, camera_1))
    uv_0 = cam.undistort(camera_0, torch.where(is_finite[..., None], seen_0, centre_0))
    uv_1 = cam.undistort(camera_1, torch.where(is_finite[..., None], seen_1, centre_1))
    in_model = is_finite & uv_0.isfinite().all(-1) & uv_1.isfinite().all(-1)
    uv_0 = torch.where(in_model[..., None], uv_0, seen_0)
    uv_1 = torch.where(in_model[..., None], uv_1, seen_1)
    J = cam.undistort_jacobian(camera_1, torch.where(in_model[..., None], uv_1, centre_1))
    has_cov = seen_cov.isfinite()
    ideal_cov = small_matmul(small_matmul(J, torch.where(has_cov, seen_cov, 0)), J.mT)
    return uv_0, uv_1, torch.where(has_cov, ideal_cov, seen_cov), valid & in_model


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


def _draws_beside(like: Tensor, seed: int | Tensor, hypotheses: int) -> Tensor:
    """:func:`uniform_draws` of a batch (B, …) in its dtype, on its device; on an accelerator cached for an int seed."""
    if like.is_cpu or is_transformed() or not isinstance(seed, int):
        return move_from_host(uniform_draws(seed, len(like), hypotheses), like)
    return keep_beside(_draws_of_int(seed, hypotheses), like.dtype, like.device).expand(len(like), -1, -1)


@lru_cache(maxsize=64)
def _draws_of_int(seed: int, hypotheses: int) -> Tensor:
    return _draw_rows(torch.tensor([seed]), hypotheses)


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
