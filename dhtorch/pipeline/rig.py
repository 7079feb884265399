"""Relative pose of two cameras of a rig: estimated once from many instants, then used as a prior.

At every instant near returns fix that pose with a covariance; a rigid rig has one pose at all instants.
"""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from dhtorch.geometry.pose_averaging import AveragePose, average_poses
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import MAP
from dhtorch.pipeline.spec import Trace
from dhtorch.records import NO_HINT, Frame, Pose, PosePrior, TrackHint
from dhtorch.stages.pose_prior import make_prior


def estimate_rig_pose(
    references: Frame,  # (B,), one camera at B instants
    others: Frame,  # (B,), the other one at the same instants
    *,
    method: Method = MAP,
    seed: int | Tensor = 0,
    places: int = 1,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
    **options: Any,
) -> AveragePose:
    """The pose ``T`` (1) of the other camera relative to the reference camera, with its covariance, from B instants.

    Instants that show one place share most of their errors: those of the sensor there and of tracks on its edges. So
    the covariance of their mean is that of a single instant; only further ``places`` reduce it.

    Args:
        references, others: views of the two cameras; both may move, together.
        method: its stages 1 to 5 are used. Where the cameras see the scene very differently a learned tracker helps.
        seed, hint, trace: as :class:`Method` takes them.
        places: number of places that the instants show, in about equal parts.
        options: of :func:`dhtorch.geometry.pose_averaging.average_poses`.

    Returns:
        The mean of B = 1 rig over V instants. Not ``ok`` where the instants contradict each other: the rig is not
        rigid, or most poses are wrong. ``agree`` marks the instants whose poses are consistent with the mean.

    Raises:
        ValueError: wrong shapes, or places below 1.

    Gradient: none; a calibration.
    """
    if places < 1:
        raise ValueError(f"estimate_rig_pose: places is {places}, expected at least 1")
    trace = {} if trace is None else trace
    method(references, others, seed=seed, hint=hint, trace=trace)
    fit = trace["fit"]
    T = fit.T_1_from_0.map(lambda x: x[None])
    mean = average_poses(T, fit.cov[None], fit.ok[None], **options)
    per_place = (mean.agree.sum(-1) / places).clamp_min(1)
    return mean._replace(cov=mean.cov * per_place[:, None, None].to(mean.cov))


@dataclass(frozen=True, eq=False)
class ConstantPose:
    """A ``pose_prior`` stage with one pose for all pairs, those of two cameras of a rig:
    ``method.replace(pose_prior=ConstantPose(…))``."""

    T_1_from_0: Pose  # (1)
    cov: Tensor | None = None  # (1, 6, 6); None = unknown

    def __call__(self, reference: Frame, others: Frame) -> PosePrior:
        """The prior of B reference views with B or V × B other views: (B,) or (V, B)."""
        batch_shape = others.camera.f.shape[:-1]
        prior = make_prior(self.T_1_from_0, cov=self.cov).to(reference.camera.f.dtype)
        return prior.map(lambda x: x[0].to(reference.camera.f.device).expand(*batch_shape, *x.shape[1:]))
