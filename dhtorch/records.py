"""The records that travel between stages. Everything is batched: B pairs (or frames), N samples each.

Silent values: where there is no answer a field holds a defined value and a code says why. ``depth`` of a sample without
a return is 0 and its ``xyz`` NaN; ``depth`` and ``sigma`` of an unanswered estimate are NaN and its ``score`` 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Gate, PoseCode, State
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import all_finite
from dhtorch.geometry.coarse_flow import CoarseFlow
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.geometry.se3 import Pose
from dhtorch.pytree import KEEP_DTYPE, Record, record

__all__ = [
    "Camera",
    "DepthValidation",
    "Estimate",
    "Frame",
    "InitialPose",
    "MergedDepth",
    "Pose",
    "PoseFit",
    "PosePrior",
    "Samples",
    "Shutter",
    "TrackHint",
    "Tracks",
    "ViewSelection",
]


@record
class Frame(Record):
    """One RGB-D view."""

    image: Tensor  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    depth: Tensor  # (B, h, w) m, 0 = no return; its own resolution is allowed
    camera: Camera  # of the image
    depth_camera: Camera | None = None  # of the depth map, same pose; None = `camera` scaled to the depth's size
    conf: Tensor | None = None  # (B, h, w) uint8 sensor confidence 0 low, 1 medium, 2 high
    time: Tensor | None = field(default=None, metadata=KEEP_DTYPE)  # (B,) s, float64
    T_world_from_cam: Pose | None = None  # where the data set has one; stages never read it
    sparse: Tensor | None = None  # (B,) bool: depth is a projected LiDAR sweep, mostly empty between returns

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.image.shape[-2], self.image.shape[-1]


@record
class Samples(Record):
    """Where we look and what the sensor says there."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m, the sensor's value; 0 = no return
    sigma: Tensor  # (B, N) m, the sensor's noise at that value
    xyz: Tensor  # (B, N, 3) m in camera 0; NaN where there is no usable return
    confidence: Tensor  # (B, N) in [0, 1]
    flag: Tensor  # (B, N) int32, bits of codes.Flag
    trackability: Tensor  # (B, N) smaller eigenvalue of the local gradient matrix, image in [0, 1]
    hole: Tensor  # (B, N) int32, codes.Hole

    @property
    def usable(self) -> Tensor:
        """(B, N) bool: there is a point."""
        return all_finite(self.xyz, -1)


@record
class Tracks(Record):
    """The samples found again in the other image."""

    uv_0: Tensor  # (B, N, 2) px
    uv_1: Tensor  # (B, N, 2) px; the last position where not valid
    error: Tensor  # (B, N) px, forward-backward round trip
    photometric: Tensor  # (B, N) rms grey residual of the patch, image in [0, 1]
    cov: Tensor  # (B, N, 2, 2) px², of uv_1
    valid: Tensor  # (B, N) bool


@dataclass(frozen=True, eq=False)
class TrackHint:
    """What the caller of a tracker knows beforehand. Every tracker takes one and may ignore it."""

    start: Tensor | None = None  # (B, N, 2) px, where to look first in image 1; None or not finite = at ``uv_0``
    pyramid: PyramidCache | None = None  # of image 0, shared by all who search in it
    levels: int | None = None  # pyramid levels that the motion in this scene asks for; None = the tracker's own
    flows: tuple[CoarseFlow, CoarseFlow] | None = None  # coarse motion of the whole picture, to image 1 and back

    def replace(self, **changes: Any) -> TrackHint:
        """A copy with some fields replaced."""
        return replace(self, **changes)

    def __getitem__(self, part: slice) -> TrackHint:
        """The hint for some of the pairs."""
        start = None if self.start is None else self.start[part]
        pyramid = None if self.pyramid is None else self.pyramid[part]
        flows = None if self.flows is None else (self.flows[0][part], self.flows[1][part])
        return replace(self, start=start, pyramid=pyramid, flows=flows)


#: Nothing is known beforehand.
NO_HINT = TrackHint()


@record
class Shutter(Record):
    """How much further camera 1 is turned, row by row: y · turn, y the height of the reference view's ray (z = 1)."""

    shutter_rate: Tensor  # (B, 3) rad per unit of y; 0 for a global shutter
    cov: Tensor  # (B, 9, 9) of rotation (rad), translation (m) and turn together


@record
class PoseFit(Record):
    """Metric relative pose and how well it is known. Not ok: R, t and cov are NaN."""

    T_1_from_0: Pose
    cov: Tensor  # (B, 6, 6) of the left perturbation (rad, m)
    inlier: Tensor  # (B, N) bool
    n_inlier: Tensor  # (B,) int64
    rms_px: Tensor  # (B,) reprojection rms of the inliers
    sigma_px: Tensor  # (B,) estimated noise of one pixel coordinate
    t_snr: Tensor  # (B,) translation over its standard deviation, sqrt(tᵀ Σ_t⁻¹ t)
    code: Tensor  # (B,) int32, codes.PoseCode
    shutter: Shutter | None = None  # absent: one pose for all rows
    matched_convention: Tensor | None = (
        None  # (B,) int32, which of geometry.pose_conventions.CONVENTIONS fits where a pose is refuted
    )

    @property
    def ok(self) -> Tensor:
        """(B,) bool: there is a pose."""
        return (self.code == PoseCode.OK) | (self.code == PoseCode.KEPT_PNP)


@record
class PosePrior(Record):
    """A relative pose from elsewhere (kinematics, SLAM, a device's own tracker, a calibration), for ``fit=``.

    Near returns are held against it (:func:`dhtorch.stages.pose_prior.check_pose_prior`): a pose that they contradict
    is not used.
    """

    T_1_from_0: Pose  # not finite = not known
    cov: Tensor | None = None  # (B, 6, 6) of the left perturbation (rad, m); None = not stated
    hypotheses: Pose | None = None  # (B, K) the same numbers in geometry.pose_conventions.CONVENTIONS; None = not asked


@record
class InitialPose(PosePrior):
    """A relative pose from elsewhere that only starts the search for the most probable one."""


@record
class ViewSelection(Record):
    """Which of V offered views are asked, and why these."""

    index: Tensor  # (views, B) int64, rising
    gain: Tensor | None = None  # (views, B) what each added to those chosen before it; None = nobody said
    no_answer: Tensor | None = (
        None  # (V, B) bool: the view answered nothing, no pose or no baseline; None = nobody said
    )


@record
class Estimate(Record):
    """Depth in view 0 for every sample, or the reason for silence."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m; NaN where silent
    sigma: Tensor  # (B, N) m, standard deviation of depth, pose part included; NaN where silent
    sigma_shared: Tensor  # (B, N) m, the part of sigma that the points of a pair share (the pose)
    parallax_deg: Tensor  # (B, N) angle at the point between the rays to the two centres
    residual_px: Tensor  # (B, N) reprojection error, the larger of the two views
    n_views: Tensor  # (B, N) int32
    score: Tensor  # (B, N) in [0, 1]; 0 where silent
    gate: Tensor  # (B, N) int32, codes.Gate; 0 = answered

    @property
    def keep(self) -> Tensor:
        """(B, N) bool: answered."""
        return self.gate == Gate.ANSWER

    @classmethod
    def silent(cls, samples: Samples, gate: int, *, n_views: int) -> Estimate:
        """No answer for any sample, for one reason."""
        nan = torch.full_like(samples.depth, torch.nan)
        zero = torch.zeros_like(samples.depth)
        return cls(
            uv=samples.uv,
            depth=nan,
            sigma=nan,
            sigma_shared=nan,
            parallax_deg=zero,
            residual_px=zero,
            n_views=torch.full_like(samples.flag, n_views),
            score=zero,
            gate=torch.full_like(samples.flag, gate),
        )


@record
class DepthMap(Record):
    """Depth of every pixel of a view, or the reason for silence, on a picture of its own size over the same field."""

    depth: Tensor  # (B, h, w) m; NaN where silent
    sigma: Tensor  # (B, h, w) m, standard deviation of depth; NaN where silent
    score: Tensor  # (B, h, w) in [0, 1]; 0 where silent
    source: Tensor  # (B, h, w) int32, codes.Source
    gate: Tensor  # (B, h, w) int32, codes.Gate; 0 = there is a depth

    @property
    def keep(self) -> Tensor:
        """(B, h, w) bool: there is a depth."""
        return self.gate == Gate.ANSWER


@record
class MergedDepth(Record):
    """Sensor and recovered depth side by side: what a user of the pipeline wants."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m; 0 where neither source answers
    sigma: Tensor  # (B, N) m; 0 where neither source answers
    score: Tensor  # (B, N) in [0, 1]: sensor confidence or selective score
    source: Tensor  # (B, N) int32, codes.Source


@record
class DepthValidation(Record):
    """Whether a depth map is right: of every pixel, and of the frame as (value, low, high) with 95 % between.

    Evidence is in sigmas, positive where the map is too far, NaN where a kind of evidence says nothing.
    """

    depth: Tensor  # (B, h, w) m, the map on the grid that is judged; 0 = it says nothing
    state: Tensor  # (B, h, w) int32, codes.State
    evidence: Tensor  # (B, h, w) of the kind that decided
    view: Tensor  # (B, h, w) int32, the other view that decided, in the order asked; -1 = our own answers, -2 = none
    sparse_evidence: Tensor  # (B, h, w) against near returns and triangulated points
    photometric_evidence: Tensor  # (B, h, w) against the pictures of other views
    consistency_evidence: Tensor  # (B, h, w) against the same source's maps of other views; negative only: seen through
    scale: Tensor  # (B, 3) the map's metre over the true one; NaN where nothing but the map itself says what a metre is
    scale_near: Tensor  # (B, 3) by near returns alone
    scale_far: Tensor  # (B, 3) by triangulated points alone
    scale_vs_trajectory: Tensor  # (B, 3) the sensor's metre over that of the given trajectory
    shift: Tensor  # (B, 3) m, in the map = scale · truth + shift
    tilt: Tensor  # (B, 3) relative error from one side of the picture to the other, along its steepest direction
    wrong: Tensor  # (B, 3) share of wrong ones among pixels of which something is known
    clip_depth: Tensor  # (B,) m, where the map is cut: what is farther is said to lie there; NaN = it is not

    @property
    def known(self) -> Tensor:
        """(B, h, w) bool: something is said of the pixel."""
        return self.state != State.CANNOT_KNOW
