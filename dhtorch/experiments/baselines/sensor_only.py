"""Baseline without a second view: the sensor's own returns."""

from __future__ import annotations

import time
from typing import Any

import torch

from dhtorch.codes import Gate
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import se3
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Estimate, Frame


def sensor_only(
    method: Method, frame_0: Frame, _frame_1: Frame, *, trace: Trace | None = None, **_options: Any
) -> Estimate:
    """Estimate from the front end's usable returns; every other sample is unanswered (gate NO_TRACK).

    Replaces the call of a method: it runs stages 1 to 3 and does not use the second view.

    Returns:
        Estimate whose ``depth`` and ``sigma`` are the sensor's.
    """
    start = time.perf_counter()
    like = frame_0.camera.f
    samples = method.sample_depth(frame_0)
    keep = samples.usable
    nan = torch.full_like(samples.depth, torch.nan)
    zero = torch.zeros_like(samples.depth)
    estimate = Estimate(
        uv=samples.uv,
        depth=torch.where(keep, samples.depth, nan),
        sigma=torch.where(keep, samples.sigma, nan),
        sigma_shared=torch.where(keep, zero, nan),
        parallax_deg=zero,
        residual_px=zero,
        n_views=torch.ones_like(samples.hole),
        score=torch.where(keep, samples.confidence, zero),
        gate=torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).to(torch.int32),
    )
    if trace is not None:
        eye = se3.identity(like.shape[0], like)
        fit = known_pose_fit(eye.replace(t=torch.full_like(eye.t, torch.nan)), samples.uv.shape[1])
        trace.update(samples=samples, fit=fit, estimate=estimate, ms={"sensor": 1e3 * (time.perf_counter() - start)})
    return estimate
