"""Cohorts beyond the range split (hold-out, real holes), and relative poses from the device's trajectory."""

from typing import Any

import torch
from torch import Tensor

from dhtorch.data.recording import TruthRecording
from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.experiments.protocol import Batch, Method, Settings, Variant, far_truth
from dhtorch.geometry import se3
from dhtorch.metrics import holdout
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Frame, Pose, PoseFit, Samples


def hide_nothing(frame: Frame, _cutoff: float | None) -> Frame:
    """Frame with all its returns: hides nothing."""
    return frame


class _PoseHalfClassifier:
    """Classify stage of the hold-out: removes the returns of set B after it, so that only set A determines the pose."""

    def __init__(self, classify: Any, seed: int, min_trackability: float) -> None:
        self.classify, self.seed, self.min_trackability = classify, seed, min_trackability

    def __call__(self, frame: Frame, samples: Samples) -> Samples:
        """Classified samples with the returns of set A alone."""
        all_returns: Samples = self.classify(frame, samples)
        _, set_b = holdout.split_half(all_returns, self.seed, min_trackability=self.min_trackability)
        return holdout.hide_returns(all_returns, set_b)


class HeldOut:
    """Cohorts of the hold-out: set B, and for the naive protocol the pose's own inliers of set A."""

    def __init__(self, method: Method, settings: Settings) -> None:
        self.method, self.seed, self.test = method, settings.seed, settings.truth[-1]

    def variant(self, **more: Any) -> Variant:
        """Variant with set B hidden from the method; without view selection, which would use the returns of set B."""
        half = _PoseHalfClassifier(self.method.classify, self.seed, self.method.min_trackability)
        return Variant(self.method.replace(classify=half), two_frames=True, **more)

    def whole(self, batch: Batch, uv: Tensor) -> Samples:
        """Samples at pixels ``uv`` (B, N, 2) with every return."""
        return self.method.sample_depth_at(batch.reference, uv)

    def heldout(self, batch: Batch, trace: Trace) -> holdout.Truth:
        """Truth of set B: trackable samples whose return took no part in the pose."""
        samples, truth = self._truth(batch, trace)
        _, set_b = holdout.split_half(samples, self.seed, min_trackability=self.method.min_trackability)
        return _restrict_candidates(truth, set_b)

    def cyclic(self, batch: Batch, trace: Trace) -> holdout.Truth:
        """Truth of the pose's inliers, which RANSAC optimised."""
        _, truth = self._truth(batch, trace)
        return _restrict_candidates(truth, trace["fit"].inlier)

    def _truth(self, batch: Batch, trace: Trace) -> tuple[Samples, holdout.Truth]:
        samples = self.whole(batch, trace["samples"].uv)
        truth_at_samples = holdout.sample_truth(batch.reference, samples.uv, truth=self.test)
        return samples, holdout.select_candidates(samples, truth_at_samples, 0.0)


def far_real_holes(batch: Batch, trace: Trace, *, test: str = "full") -> holdout.Truth:
    """Independent truth beyond the cutoff where the sensor has no return: the real holes beside the range split."""
    uv = trace["samples"].uv
    no_return = holdout.sample_truth(batch.reference, uv, truth="raw").depth <= 0
    return _restrict_candidates(far_truth(batch, trace, test=test), no_return)


def real_holes(batch: Batch, trace: Trace, *, test: str = "full") -> holdout.Truth:
    """Truth of the sensor's own drop-outs, from independent truth; no candidates where there is none."""
    samples: Samples = trace["samples"]
    truth = holdout.sample_truth(batch.exact, samples.uv, truth=test)
    if missing_truth_reason(batch.scene) is not None:
        return truth.replace(code=torch.full_like(truth.code, holdout.TruthCode.NO_RETURN))
    kinds = batch.kinds(samples.uv)
    if kinds is not None:
        odd = torch.isin(kinds, torch.tensor([*batch.odd], dtype=kinds.dtype).to(kinds.device))
        truth = truth.replace(code=torch.where(odd, holdout.TruthCode.EXCLUDED, truth.code))
    return holdout.select_real_holes(batch.reference, samples, truth)


def trajectory_pose(batch: Batch, *, raw: bool = False) -> Pose | None:
    """Relative pose of each pair of a batch from the device's trajectory; None if the recording has none.

    Args:
        batch: pairs of one scene.
        raw: without conversion of axes: a trajectory in OpenGL axes is used as if its axes were OpenCV's. One in
            OpenCV axes is the same either way.
    """
    first, second = batch.reference.T_world_from_cam, batch.others[-1].T_world_from_cam
    if first is None or second is None:
        return None
    T = se3.relative(first, second)
    if not raw or batch.scene.recording.pose_axes != "gl":
        return T
    flip = T.R.new_tensor([1.0, -1.0, -1.0])
    return Pose(flip[:, None] * T.R * flip, flip * T.t)


def trajectory_pose_fit(batch: Batch, n: int, *, raw: bool = False) -> PoseFit:
    """Relative pose from the device's trajectory as a pose fit over ``n`` samples; not ok where there is none."""
    T, like = trajectory_pose(batch, raw=raw), batch.reference.camera.f
    if T is None:
        eye = se3.identity(like.shape[0], like)
        T = Pose(eye.R * torch.nan, eye.t)
    return known_pose_fit(T.to(like.dtype), n)


def missing_trajectory_reason(scene: Scene) -> str | None:
    """Reason why the device's trajectory cannot be used; None if it can."""
    return "no device trajectory" if scene.recording.poses is None else None


def missing_truth_reason(scene: Scene) -> str | None:
    """Reason for missing independent truth; None if the recording has it."""
    return None if isinstance(scene.recording, TruthRecording) else "no independent ground truth"


def _restrict_candidates(truth: holdout.Truth, mask: Tensor) -> holdout.Truth:
    """Truth whose candidates are restricted to ``mask``; the others get the code NEAR."""
    near = torch.full_like(truth.code, holdout.TruthCode.NEAR)
    return truth.replace(code=torch.where(mask, truth.code, near))
