"""The records passed between stages. All are batched: B pairs (or frames), N samples each.

Missing values: an unanswered element holds a defined value, and a code gives the reason. ``depth`` of a sample without
a return is 0 and its ``xyz`` NaN; ``depth`` and ``sigma`` of an unanswered estimate are NaN and its ``score`` 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Cause, Gate, PinVerdict, PoseCode, Source, State
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera, resize
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
    "SigmaBudget",
    "TrackHint",
    "Tracks",
    "ViewSelection",
]


#: Least trackability (smaller eigenvalue of the mean gradient matrix, grey values in [0, 1]) of a sample that is used:
#: the default of every ``min_trackability``.
MIN_TRACKABILITY = 1e-5


@record
class Frame(Record):
    """One RGB-D view."""

    image: Tensor  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    depth: Tensor  # (B, h, w) m, 0 = no return; its own resolution is allowed
    camera: Camera  # of the image
    depth_camera: Camera | None = None  # of the depth map, same pose; None = `camera` scaled to the depth's size
    conf: Tensor | None = None  # (B, h, w) uint8 sensor confidence 0 low, 1 medium, 2 high
    time: Tensor | None = field(default=None, metadata=KEEP_DTYPE)  # (B,) s, float64
    T_world_from_cam: Pose | None = None  # if the data set has one; stages never read it
    sparse: Tensor | None = None  # (B,) bool: depth is a projected LiDAR sweep, mostly empty between returns

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.image.shape[-2], self.image.shape[-1]

    @property
    def map_camera(self) -> Camera:
        """The camera of the depth map: its own, else the image's at the map's size. Gradient: to the intrinsics."""
        hw = (self.depth.shape[-2], self.depth.shape[-1])
        if self.depth_camera is not None:
            return self.depth_camera
        return self.camera if hw == self.hw else resize(self.camera, self.hw, hw)


@record
class Samples(Record):
    """Sample points in the reference view, with the sensor's return at each."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m, the sensor's return; 0 = none
    sigma: Tensor  # (B, N) m, standard deviation of the return
    xyz: Tensor  # (B, N, 3) m in camera 0; NaN where there is no usable return
    confidence: Tensor  # (B, N) in [0, 1]
    flag: Tensor  # (B, N) int32, bits of codes.Flag
    trackability: Tensor  # (B, N) smaller eigenvalue of the local gradient matrix, image in [0, 1]
    hole: Tensor  # (B, N) int32, codes.Hole

    @property
    def usable(self) -> Tensor:
        """(B, N) bool: the sample has a 3D point."""
        return all_finite(self.xyz, -1)


@record
class Tracks(Record):
    """The samples tracked from the reference view (image 0) into the source view (image 1)."""

    uv_0: Tensor  # (B, N, 2) px
    uv_1: Tensor  # (B, N, 2) px; the last position where not valid
    error: Tensor  # (B, N) px, forward-backward round trip
    photometric: Tensor  # (B, N) rms grey residual of the patch, image in [0, 1]
    cov: Tensor  # (B, N, 2, 2) px², of uv_1
    valid: Tensor  # (B, N) bool


@dataclass(frozen=True, eq=False)
class TrackHint:
    """Prior information for a tracker. Every tracker accepts one and may ignore it."""

    start: Tensor | None = None  # (B, N, 2) px, initial position in image 1; None or not finite = ``uv_0``
    pyramid: PyramidCache | None = None  # of image 0, shared between the tracker calls
    levels: int | None = None  # pyramid levels for the motion in this scene; None = the tracker's own
    flows: tuple[CoarseFlow, CoarseFlow] | None = None  # coarse flow of the whole image, to image 1 and back
    between: Sequence[Tensor] | Tensor | None = None  # K × (B, C, H, W), images between image 0 and 1, in their order

    def replace(self, **changes: Any) -> "TrackHint":
        """A copy with some fields replaced."""
        return replace(self, **changes)

    def __getitem__(self, part: slice) -> "TrackHint":
        """The hint for a slice of the pairs."""
        start = None if self.start is None else self.start[part]
        pyramid = None if self.pyramid is None else self.pyramid[part]
        flows = None if self.flows is None else (self.flows[0][part], self.flows[1][part])
        between = None if self.between is None else tuple(image[part] for image in self.between)
        return replace(self, start=start, pyramid=pyramid, flows=flows, between=between)


#: A hint without any information.
NO_HINT = TrackHint()


@record
class Shutter(Record):
    """Rolling-shutter rotation of camera 1 per row: y · shutter_rate, y of the reference view's ray (z = 1)."""

    shutter_rate: Tensor  # (B, 3) rad per unit of y; 0 for a global shutter
    cov: Tensor  # (B, 9, 9) of rotation (rad), translation (m) and shutter rate jointly


@record
class PoseFit(Record):
    """Metric relative pose and its covariance. Not ok: R, t and cov are NaN."""

    T_1_from_0: Pose
    cov: Tensor  # (B, 6, 6) of the left perturbation (rad, m)
    inlier: Tensor  # (B, N) bool
    n_inlier: Tensor  # (B,) int64
    rms_px: Tensor  # (B,) reprojection rms of the inliers
    sigma_px: Tensor  # (B,) estimated noise of one pixel coordinate
    t_snr: Tensor  # (B,) translation over its standard deviation, sqrt(tᵀ Σ_t⁻¹ t)
    code: Tensor  # (B,) int32, codes.PoseCode
    shutter: Shutter | None = None  # None: one pose for all rows
    matched_convention: Tensor | None = None  # (B,) int32, index of the fitting pose_conventions.CONVENTIONS if refuted

    @property
    def ok(self) -> Tensor:
        """(B,) bool: there is a pose."""
        return (self.code == PoseCode.OK) | (self.code == PoseCode.KEPT_PNP)

    def without_pose(self, rejected: Tensor, code: Tensor | int) -> "PoseFit":
        """The fit without the ``rejected`` (B,) poses, which get ``code``. Gradient: to the poses that stay."""

        def mask(x: Tensor) -> Tensor:
            return torch.where(rejected.view(-1, *[1] * (x.dim() - 1)), torch.nan, x)

        return self.replace(
            T_1_from_0=self.T_1_from_0.map(mask),
            cov=mask(self.cov),
            inlier=self.inlier & ~rejected[:, None],
            rms_px=mask(self.rms_px),
            sigma_px=mask(self.sigma_px),
            t_snr=mask(self.t_snr),
            shutter=None if self.shutter is None else self.shutter.map(mask),
            code=torch.where(rejected, code, self.code).to(self.code.dtype),
        )


@record
class PosePrior(Record):
    """A relative pose from elsewhere (kinematics, SLAM, a device's own tracker, a calibration), for ``fit=``.

    Near returns may refute it (:func:`dhtorch.stages.pose_prior.check_pose_prior`); a pose that they
    contradict is not used.
    """

    T_1_from_0: Pose  # not finite = none
    cov: Tensor | None = None  # (B, 6, 6) of the left perturbation (rad, m); None = not stated
    hypotheses: Pose | None = (
        None  # (B, K) the same numbers in geometry.pose_conventions.CONVENTIONS; None = not tested
    )


@record
class InitialPose(PosePrior):
    """A relative pose from elsewhere that only initialises the pose optimisation."""


@record
class ViewSelection(Record):
    """Source views selected among V candidates, with the gain of each."""

    index: Tensor  # (views, B) int64, rising
    gain: Tensor | None = None  # (views, B) gain over the views selected before it; None = not computed
    no_answer: Tensor | None = None  # (V, B) bool: view without estimates, no pose or no baseline; None = not computed
    reserve: Tensor | None = None  # (R, B) int64, the next best, best first: they replace views without a pose


@record
class SigmaBudget(Record):
    """Variance of depth by cause, m², in the shape of depth; the terms sum to sigma². NaN where unanswered."""

    track: Tensor  # of the point's own match: grey noise, window, residual, round trip; of a swept pixel also edges
    pose: Tensor  # of the relative pose by its covariance, rolling shutter and single returns' noise included
    reference: Tensor  # of what all returns of the sensor have in common, a wrong scale; of a return all of it
    lens: Tensor  # of intrinsics, distortion and rows: an error of direction that grows with the turn between views
    model: Tensor  # of joining views, of filling, of a calibration of sigma: beyond what the other terms explain

    def values(self) -> tuple[Tensor, ...]:
        """The five terms in their order."""
        return self.track, self.pose, self.reference, self.lens, self.model

    def shares(self, where: Tensor) -> dict[str, float]:
        """Name of a term → its mean share in sigma² over the answers ``where`` (bool); empty without one."""
        values = torch.stack([x[where].detach() for x in self.values()])
        mean = (values / values.sum(0)).mean(1).tolist() if values.numel() else []
        return dict(zip(("track", "pose", "reference", "lens", "model"), mean, strict=False))

    @property
    def dominating(self) -> Tensor:
        """Code of the largest term, int32, codes.Cause; NONE where unanswered."""
        terms = torch.stack([x.detach() for x in self.values()])
        return torch.where(terms.isfinite().all(0), Cause.TRACK + terms.argmax(0), Cause.NONE).int()

    @classmethod
    def single(cls, term: str, variance: Tensor) -> "SigmaBudget":
        """A budget with all ``variance`` in one term."""
        zero = torch.zeros_like(variance)
        return cls(zero, zero, zero, zero, zero).replace(**{term: variance})

    def scaled_to(self, sigma: Tensor) -> "SigmaBudget":
        """The terms in the same proportions with sum ``sigma``²; all in ``model`` where there are no proportions.

        Gradient: to sigma and to the terms.
        """
        defined = torch.stack([x.isfinite() for x in self.values()]).all(0) & sigma.isfinite()
        terms = [torch.where(defined, x, 0.0) for x in self.values()]
        total = terms[0] + terms[1] + terms[2] + terms[3] + terms[4]
        split = total > 0
        factor = sigma.square() / torch.where(split, total, 1.0)
        track, pose, reference, lens, model = (torch.where(split, x, 0.0) * factor for x in terms)
        model = model + torch.where(split, 0.0, 1.0) * sigma.square()
        return SigmaBudget(track, pose, reference, lens, model)


def depth_interval(depth: Tensor, sigma: Tensor, k: float = 2.0) -> tuple[Tensor, Tensor]:
    """Ends of the interval of ``k`` standard deviations, in m: symmetric in inverse depth, as errors of matches are.

    With q = 1 / depth and sigma_q = sigma / depth², from 1 / (q + k sigma_q) to 1 / (q - k sigma_q); infinite where
    k sigma_q is at least q. For a normal error of inverse depth it holds 68 % at k = 1 and 95 % at k = 2.

    Gradient: to depth and sigma; none to an infinite end.
    """
    reach = k * sigma / depth
    bounded = reach < 1
    high = torch.where(bounded, depth / (1 - torch.where(bounded, reach, 0.0)), torch.inf)
    return depth / (1 + reach), torch.where(depth.isnan() | sigma.isnan(), torch.nan, high)


@record
class Estimate(Record):
    """Depth in the reference view (view 0) of every sample, or the gate that rejected it."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m; NaN where unanswered
    sigma: Tensor  # (B, N) m, standard deviation of depth, pose part included; NaN where unanswered
    sigma_shared: Tensor  # (B, N) m, part of sigma common to the points of a pair (from the pose)
    parallax_deg: Tensor  # (B, N) angle at the point between the rays to the two camera centres
    residual_px: Tensor  # (B, N) reprojection error, the larger of the two views
    n_views: Tensor  # (B, N) int32
    score: Tensor  # (B, N) in [0, 1]; 0 where unanswered
    gate: Tensor  # (B, N) int32, codes.Gate; 0 = answered
    parts: SigmaBudget | None = None  # (B, N) what `budget` is made of, any value where unanswered; None = not kept

    @property
    def keep(self) -> Tensor:
        """(B, N) bool: answered."""
        return self.gate == Gate.ANSWER

    @property
    def budget(self) -> SigmaBudget:
        """(B, N) sigma² by cause. Without ``parts`` the shared part is ``pose`` and the rest ``track``.

        Gradient: as that of sigma.
        """
        return self.kept_parts.scaled_to(self.sigma)

    @property
    def kept_parts(self) -> SigmaBudget:
        """(B, N) ``parts``, or those that follow from sigma alone."""
        if self.parts is not None:
            return self.parts
        shared = self.sigma_shared.nan_to_num().square()
        zero = torch.zeros_like(shared)
        return SigmaBudget((self.sigma.square() - shared).clamp_min(0), shared, zero, zero, zero)

    def interval(self, k: float = 2.0) -> tuple[Tensor, Tensor]:
        """Lower and upper end (B, N) of :func:`depth_interval`, m; NaN where unanswered."""
        return depth_interval(self.depth, self.sigma, k)

    def withheld(self, rejected: Tensor, gate: int) -> "Estimate":
        """The estimate without the ``rejected`` (…, N) answers, which get ``gate``. Gradient: as that of the others."""
        lost = self.keep & rejected
        return self.replace(
            depth=self.depth.masked_fill(lost, torch.nan),
            sigma=self.sigma.masked_fill(lost, torch.nan),
            sigma_shared=self.sigma_shared.masked_fill(lost, torch.nan),
            score=self.score.masked_fill(lost, 0.0),
            gate=self.gate.masked_fill(lost, gate),
        )

    @classmethod
    def unanswered(cls, samples: Samples, gate: int, *, n_views: int) -> "Estimate":
        """An estimate in which every sample is unanswered, rejected by the same gate."""
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
            parts=SigmaBudget.single("track", zero),
        )


@record
class DepthMap(Record):
    """Depth of every pixel of a view, or the gate that rejected it; its size may differ from the image's."""

    depth: Tensor  # (B, h, w) m; NaN where unanswered
    sigma: Tensor  # (B, h, w) m, standard deviation of depth; NaN where unanswered
    score: Tensor  # (B, h, w) in [0, 1]; 0 where unanswered
    source: Tensor  # (B, h, w) int32, codes.Source
    gate: Tensor  # (B, h, w) int32, codes.Gate; 0 = answered
    parts: SigmaBudget | None = None  # (B, h, w) what `budget` is made of at matched pixels; None = not kept

    @property
    def keep(self) -> Tensor:
        """(B, h, w) bool: answered."""
        return self.gate == Gate.ANSWER

    @property
    def budget(self) -> SigmaBudget:
        """(B, h, w) sigma² by cause: of a return all ``reference``; of a filled pixel, and without ``parts``, all
        ``model``."""
        zero = torch.zeros_like(self.depth)
        parts = SigmaBudget.single("model", zero + 1) if self.parts is None else self.parts
        sensed, filled = (self.source == code for code in (Source.SENSOR, Source.FILLED))
        either = sensed | filled
        terms = SigmaBudget(*(torch.where(either, zero, x) for x in parts.values()))
        return terms.replace(
            reference=torch.where(sensed, zero + 1, terms.reference), model=torch.where(filled, zero + 1, terms.model)
        ).scaled_to(self.sigma)

    def interval(self, k: float = 2.0) -> tuple[Tensor, Tensor]:
        """Lower and upper end (B, h, w) of :func:`depth_interval`, m; NaN where unanswered."""
        return depth_interval(self.depth, self.sigma, k)


@record
class MergedDepth(Record):
    """Sensor depth and recovered depth merged: the result of the pipeline."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # (B, N) m; 0 where neither source has depth
    sigma: Tensor  # (B, N) m; 0 where neither source has depth
    score: Tensor  # (B, N) in [0, 1]: sensor confidence or selective score
    source: Tensor  # (B, N) int32, codes.Source


@record
class PinResult(Record):
    """Offset of the camera from the reference for each of B pictures; NaN where it cannot be known."""

    T_ref_from_live: Pose  # where the camera is now, in its axes at the reference (x right, y down, z forward), m
    cov: Tensor  # (B, 6, 6) of the left perturbation (rotation rad, translation m); translation NaN if not metric
    shift_px: Tensor  # (B,) median motion of the scene in the picture
    shift_sigma_px: Tensor  # (B,) its standard deviation
    distance: Tensor  # (B,) length of the offset in standard deviations, sway of a still camera included
    verdict: Tensor  # (B,) int32, codes.PinVerdict
    reason: Tensor  # (B,) int32, codes.PinReason
    metric: Tensor  # (B,) bool: translation in metres; False: unit direction, or zero where none shows
    flow_form: Tensor  # (B, 6, 6) mean square motion of the scene in the picture, px², as a form of the offset
    inlier: Tensor  # (B, N) bool, places of the reference that agree with the motion
    agreement: Tensor  # (B,) fraction of the tracks that agree
    coverage: Tensor  # (B,) fraction of the reference's groups of places with agreeing tracks
    false_alarm_rate: Tensor  # (B,) stated for "moved" of a camera that stands still
    zoom: Tensor  # (B,) focal length over the stated one, fitted with the motion; NaN where it is not known
    zoom_sigma: Tensor  # (B,) its standard deviation

    @property
    def offset(self) -> Tensor:
        """(B, 6) rotation vector, rad, and translation, m."""
        T = self.T_ref_from_live
        return torch.cat((se3.log(T)[:, :3], T.t), -1)

    @property
    def shift_low_px(self) -> Tensor:
        """(B,) shift less two standard deviations, px, at least 0; NaN where it cannot be known."""
        return (self.shift_px - 2 * self.shift_sigma_px).clamp_min(0)

    @property
    def moved(self) -> Tensor:
        """(B,) bool: the verdict is *moved*."""
        return self.verdict == PinVerdict.MOVED


@record
class DepthValidation(Record):
    """Validation of a depth map: a state per pixel, and frame quantities as (value, low, high) with 95 % intervals.

    Evidence is in standard deviations, positive where the map is too far, NaN where that kind of evidence is missing.
    """

    depth: Tensor  # (B, h, w) m, the map resampled to the validation grid; 0 = none
    state: Tensor  # (B, h, w) int32, codes.State
    evidence: Tensor  # (B, h, w) of the kind that decided the state
    view: Tensor  # (B, h, w) int32, index of the deciding source view; -1 = the triangulated points, -2 = none
    sparse_evidence: Tensor  # (B, h, w) from near returns and triangulated points
    photometric_evidence: Tensor  # (B, h, w) from the images of the source views
    consistency_evidence: Tensor  # (B, h, w) from the same source's maps of other views; only negative: seen through
    outline_evidence: Tensor  # (B, h, w) from the surface beyond an outline near the pixel, and of flying pixels
    cause: Tensor  # (B, h, w) int32, codes.WrongCause, of wrong pixels
    scale: Tensor  # (B, 3) map depth over true depth; NaN without a metric reference besides the map
    scale_near: Tensor  # (B, 3) from near returns alone
    scale_far: Tensor  # (B, 3) from triangulated points alone
    scale_vs_trajectory: Tensor  # (B, 3) scale of the sensor's depth over that of the given trajectory
    shift: Tensor  # (B, 3) m, in the map = scale · truth + shift
    tilt: Tensor  # (B, 3) relative error from one side of the picture to the other, along its steepest direction
    wrong: Tensor  # (B, 3) fraction of wrong pixels among those with evidence
    clip_depth: Tensor  # (B,) m, depth at which the map is clipped; NaN = not clipped

    @property
    def known(self) -> Tensor:
        """(B, h, w) bool: the pixel has evidence, so its state is not CANNOT_KNOW."""
        return self.state != State.CANNOT_KNOW
