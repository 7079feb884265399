"""Record of a method: its stages, each a function, and the few options that belong to no stage.

    reference view ─ sample ─ backproject ─ classify ─┬─ near, with depth ──── pose ────┐
                                                      └─ trackable, without ─ track ────┴─ triangulate ─ score

A stage is any callable with the stage's signature: a function, a ``functools.partial`` of one, a lambda, an
``nn.Module``. Only its result is used. Prior knowledge of the motion, such as where a track may start, is passed to the
tracker as its ``hint``.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from dhtorch.records import (
    MIN_TRACKABILITY,
    DepthMap,
    Estimate,
    Frame,
    PoseFit,
    PosePrior,
    Samples,
    Tracks,
    ViewSelection,
)
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.guided_search import GuidedMatches
from dhtorch.stages.holes import classify
from dhtorch.stages.misalignment import reject_misaligned
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import confidence
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.track_chain import track_chain
from dhtorch.stages.triangulate import two_view

#: The paper's short tracks: through the images between the two views where the hint has them.
_PAPER_TRACK = partial(track_chain, track=lucas_kanade)

#: Intermediates and milliseconds by stage name; fill one with ``method(..., trace=trace)``.
Trace = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodSpec:
    """Stages and options of a method that extends the depth sensor of a reference view.

    Near returns fix the metric relative pose of two views; every tracked sample, those without a return above all, is
    triangulated under that pose; gates leave a hole with a reason where the geometry is weak. Several other views are
    solved as pairs, and ``fuse`` combines their estimates.

    The defaults are the paper's (:data:`dhtorch.pipeline.presets.PAPER`).
    """

    # stages: (positional arguments) -> answer
    sample: Callable[..., Tensor] = spiral  # (hw, n, *, device, dtype) -> uv (n, 2) px
    backproject: Callable[..., Samples] = backproject  # (frame, uv)
    classify: Callable[..., Samples] = classify  # (frame, samples) -> samples with their holes
    track: Callable[..., Tracks] = _PAPER_TRACK  # (image_0, image_1, uv_0, *, hint)
    pose: Callable[..., PoseFit] = pnp_ransac  # (samples, tracks, camera_0, camera_1, draws)
    verify: Callable[..., PoseFit] | None = reject_misaligned  # (samples, tracks, fit, camera_0, camera_1)
    triangulate: Callable[..., Estimate] = two_view  # (samples, tracks, fit, camera_0, camera_1)
    score: Callable[..., Estimate] = confidence  # (estimate, samples, tracks, fit)
    verify_views: Callable[..., Estimate] | None = None  # (samples, tracks, fits, estimates (V, B, N)) -> estimates
    fuse: Callable[..., Estimate] = inverse_variance  # (estimates (V, B, N)); called with several views only
    select_views: Callable[..., Tensor | ViewSelection] | None = (
        None  # (reference, others, views, *, fit) -> (views, B)
    )
    pose_prior: Callable[..., PosePrior] | None = None  # (reference, others) -> relative poses, or None
    guide: Callable[..., GuidedMatches] | None = None  # (samples, image_0, images_1, camera_0, cameras_1, T_1_from_0)
    complete: Callable[..., tuple[Estimate, DepthMap]] | None = (
        None  # (method, reference, selected views) -> answers at the samples and at every pixel
    )

    n: int = 2048  # samples per reference view
    pose_samples: int = (
        0  # near returns that the pose has at least, where the samples meet fewer and the sensor has them
    )
    hypotheses: int = 200  # minimal samples drawn by the pose search
    min_trackability: float = MIN_TRACKABILITY  # samples below it are not used (gate NO_TEXTURE)
    views: int = 1  # most other views that are used; of more, the best are selected
    chain: bool = True  # start the track in each view at the extrapolated track of the view before

    def replace(self, **changes: Any) -> Self:
        """The method with some stages or options replaced.

        A dict for a stage changes options of the stage's function: ``PAPER.replace(track={"levels": 6})``.

        Raises:
            TypeError: no such stage or option.
        """
        names = [f.name for f in fields(self)]
        if unknown := [name for name in changes if name not in names]:
            raise TypeError(f"method: found {', '.join(unknown)}, expected stages and options among {', '.join(names)}")
        values: Any = {k: partial(getattr(self, k), **v) if isinstance(v, Mapping) else v for k, v in changes.items()}
        return replace(self, **values)

    @property
    def states_sigma(self) -> bool:
        """Whether sigma is a statement of the method: its score is made of sigma, or stage 6 fits the tracks' noise.

        Neither holds for the paper's method: its score, of parallax and residual, only orders answers, and the sigma
        that stage 6 computes beside it is fitted to nothing. Experiments leave such a sigma and score unevaluated.
        """
        score, fits_noise = self.score, False
        if isinstance(self.triangulate, partial):
            fits_noise = bool(self.triangulate.keywords.get("fitted_noise"))
        while isinstance(score, partial):
            score = score.func
        return fits_noise or score is not confidence

    def sample_depth(self, frame: Frame) -> Samples:
        """Stages 1 to 3, frame -> samples (B, n): pixels, near returns, the reason where a return is missing."""
        like = frame.camera.f
        return self.sample_depth_at(frame, self.sample(frame.hw, self.n, device=like.device, dtype=like.dtype))

    def sample_depth_at(self, frame: Frame, uv: Tensor) -> Samples:
        """Stages 2 and 3: the samples (B, N) at pixels ``uv`` (N, 2) or (B, N, 2)."""
        return self.classify(frame, self.backproject(frame, uv))


def iter_components(*stages: Any) -> Iterator[Any]:
    """The components of stages: callables, and the functions and arguments of ``functools.partial`` objects, including
    arguments that are plain options."""
    for stage in stages:
        if isinstance(stage, MethodSpec):
            yield from iter_components(*(getattr(stage, f.name) for f in fields(stage)))
        elif isinstance(stage, partial):
            yield from iter_components(stage.func, *stage.args, *stage.keywords.values())
        else:
            yield stage


def iter_networks(*stages: Any) -> Iterator[torch.nn.Module]:
    """The networks of stages: modules, also within ``functools.partial`` objects."""
    return (part for part in iter_components(*stages) if isinstance(part, torch.nn.Module))
