"""What answers are held against beyond the range split, and where poses come from beyond seat 5."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dhtorch.data.recording import TruthRecording
from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.experiments.protocol import Batch, Method, Variant
from dhtorch.geometry import se3
from dhtorch.metrics import holdout
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Frame, Pose, PoseFit, Samples


def hide_nothing(frame: Frame, _cutoff: float | None) -> Frame:
    """Hides nothing: the sensor may say all it knows."""
    return frame


class PoseHalfClassifier:
    """Seat 3 of the hold-out: classifies, then takes the returns of set B away, so that only set A fixes the pose."""

    def __init__(self, classify: Any, seed: int, min_trackability: float) -> None:
        self.classify, self.seed, self.min_trackability = classify, seed, min_trackability

    def __call__(self, frame: Frame, samples: Samples) -> Samples:
        """Samples with the returns of set A alone."""
        whole: Samples = self.classify(frame, samples)
        _, second = holdout.split_half(whole, self.seed, min_trackability=self.min_trackability)
        return holdout.hide_returns(whole, second)


class HeldOut:
    """The cohorts of the hold-out: set B, and, naively, those inliers of set A that RANSAC itself chose."""

    def __init__(self, method: Method, seed: int) -> None:
        self.method, self.seed = method, seed

    def variant(self, **more: Any) -> Variant:
        """The method with set B hidden from it; views chosen by the returns of both sets would know B."""
        half = PoseHalfClassifier(self.method.classify, self.seed, self.method.min_trackability)
        return Variant(self.method.replace(classify=half), two_frames=True, **more)

    def whole(self, batch: Batch, uv: Tensor) -> Samples:
        """The samples with every return."""
        return self.method.sample_depth_at(batch.reference, uv)

    def heldout(self, batch: Batch, trace: Trace) -> holdout.Truth:
        """Set B: trackable samples whose return never took part in the pose."""
        whole, truth = self._truth(batch, trace)
        _, second = holdout.split_half(whole, self.seed, min_trackability=self.method.min_trackability)
        return _restrict_candidates(truth, second)

    def cyclic(self, batch: Batch, trace: Trace) -> holdout.Truth:
        """The inliers of the pose: what RANSAC optimised."""
        _, truth = self._truth(batch, trace)
        return _restrict_candidates(truth, trace["fit"].inlier)

    def _truth(self, batch: Batch, trace: Trace) -> tuple[Samples, holdout.Truth]:
        whole = self.whole(batch, trace["samples"].uv)
        found = holdout.sample_truth(batch.reference, whole.uv)
        return whole, holdout.select_candidates(whole, found, 0.0)


def real_holes(batch: Batch, trace: Trace) -> holdout.Truth:
    """The sensor's own drop-outs, held against independent truth; nothing where there is none."""
    samples: Samples = trace["samples"]
    found = holdout.sample_truth(batch.exact, samples.uv)
    if missing_truth_reason(batch.scene) is not None:
        return found.replace(code=torch.full_like(found.code, holdout.TruthCode.NO_RETURN))
    kinds = batch.kinds(samples.uv)
    if kinds is not None:
        odd = torch.isin(kinds, torch.tensor([*batch.odd], dtype=kinds.dtype).to(kinds.device))
        found = found.replace(code=torch.where(odd, holdout.TruthCode.EXCLUDED, found.code))
    return holdout.select_real_holes(batch.reference, samples, found)


def trajectory_pose(batch: Batch, *, raw: bool = False) -> Pose | None:
    """Relative pose of each pair from the device's trajectory; None where the capture has none.

    Args:
        batch: pairs of one scene.
        raw: as the device writes it. A trajectory in OpenGL axes is then used as if its axes were OpenCV's, the
            mistake that the conversion mends; one in OpenCV axes is the same either way.
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
    """The device's trajectory in the shape of seat 5's answer; not ok where there is none."""
    T, like = trajectory_pose(batch, raw=raw), batch.reference.camera.f
    if T is None:
        eye = se3.identity(like.shape[0], like)
        T = Pose(eye.R * torch.nan, eye.t)
    return known_pose_fit(T.to(like.dtype), n)


def missing_trajectory_reason(scene: Scene) -> str | None:
    """Why the device's trajectory cannot be used; None where it can."""
    return "no device trajectory" if scene.recording.poses is None else None


def missing_truth_reason(scene: Scene) -> str | None:
    """Why nothing but the sensor can be asked; None where an independent instrument was there."""
    return None if isinstance(scene.recording, TruthRecording) else "no independent truth"


def _restrict_candidates(truth: holdout.Truth, mask: Tensor) -> holdout.Truth:
    """The candidates among the masked samples; the others were not held back."""
    near = torch.full_like(truth.code, holdout.TruthCode.NEAR)
    return truth.replace(code=torch.where(mask, truth.code, near))
