"""The pose of one camera of a rig relative to another: measured once, over many instants, and then given.

At every instant near returns fix that pose with a covariance; a rig that is rigid has one pose for all.
"""

from __future__ import annotations

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
    """The pose of the other camera relative to the reference views', ``T`` (1) with its covariance, from B instants.

    Instants that look at one place share most of their errors: those of the sensor there, of tracks on its edges. So
    their mean is called no surer than one of them is; only other ``places`` make it surer.

    Args:
        reference views, others: views of the two cameras; both may move, together.
        method: whose seats 1 to 5 are asked. Where the cameras see the scene very differently a learned tracker helps.
        seed, hint, trace: as :class:`Method` takes them.
        places: that the instants look at, in about equal shares.
        options: of :func:`dhtorch.geometry.pose_averaging.average_poses`.

    Returns:
        The mean of B = 1 rig over V instants. Not ``ok`` where the instants contradict each other: the rig is not
        rigid, or most poses are wrong. ``agree`` tells which instants hold the mean.

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
    shared = (mean.agree.sum(-1) / places).clamp_min(1)
    return mean._replace(cov=mean.cov * shared[:, None, None].to(mean.cov))


@dataclass(frozen=True, eq=False)
class ConstantPose:
    """What stands in a method's ``pose_prior`` where all pairs are of the same two cameras of a rig:
    ``pose_prior=ConstantPose(…)``."""

    T_1_from_0: Pose  # (1)
    cov: Tensor | None = None  # (1, 6, 6); None = not stated

    def __call__(self, reference: Frame, others: Frame) -> PosePrior:
        """The pose for B reference views, and for V × B other views."""
        lead = others.camera.f.shape[:-1]
        made = make_prior(self.T_1_from_0, cov=self.cov).to(reference.camera.f.dtype)
        return made.map(lambda x: x[0].to(reference.camera.f.device).expand(*lead, *x.shape[1:]))
