"""A method that can be called: the record of stages and options, joined by the pair or the multi-view pipeline."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from torch import Tensor

from dhtorch.pipeline.dense import selected_views
from dhtorch.pipeline.inputs import validate_views
from dhtorch.pipeline.multiview import estimate_multiview
from dhtorch.pipeline.pair import StageTimer, estimate_pair
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, PosePrior, TrackHint
from dhtorch.runtime.numerics import standard_numerics


@dataclass(frozen=True, eq=False, kw_only=True)
class Method(MethodSpec):
    """A :class:`~dhtorch.pipeline.spec.MethodSpec` that extends the depth sensor of a reference view when called.

    Near returns fix the metric relative pose of two views; every tracked sample, those without a return above all, is
    triangulated under that pose; gates leave a hole with a reason where the geometry is weak. Several other views are
    solved as pairs, and ``fuse`` combines their estimates.

    The defaults are the paper's (:data:`dhtorch.pipeline.presets.PAPER`).
    """

    def __repr__(self) -> str:
        stages = {field.name: getattr(self, field.name) for field in fields(self)}
        shown = {name: _component_name(stage) for name, stage in stages.items() if callable(stage)}
        used = ", ".join(f"{name}={text}" for name, text in shown.items() if name != "fuse" or self.views > 1)
        return f"Method(n={self.n}, views={self.views}, {used})"

    @standard_numerics
    def __call__(
        self,
        reference: Frame,
        others: Frame | Sequence[Frame],
        *,
        seed: int | Tensor = 0,
        fit: PoseFit | PosePrior | None = None,
        hint: TrackHint = NO_HINT,
        trace: Trace | None = None,
        **changes: Any,
    ) -> Estimate:
        """Depth at the samples of ``reference``, triangulated from one other view or several.

        Args:
            reference: B views.
            others: B other views; or several of each reference view, V × B in one record or a sequence of V, in the
                order of capture. Their depth is not read. Cameras may differ.
            seed: an int gives every pair the same draws; a (B,) int64 tensor gives each pair its own. All views of a
                reference view have the same.
            fit: a pose that is used as it is, (B,) or (V, B): stage 5 is then skipped; or a :class:`PosePrior`, which
                near returns may refute (:func:`dhtorch.stages.pose_prior.check_pose_prior`). None = the prior of
                ``pose_prior``, if there is one.
            hint: prior knowledge of the motion, for the tracker. Images between the two views (``between``) are used
                with one other view only.
            trace: a dict that receives ``samples``, ``tracks`` (as tracked), ``tracks_ideal`` (undistorted), ``fit``,
                ``estimate`` and ``ms`` (milliseconds by stage). With several views those of the last, ``ms`` summed
                over all, and ``views``, the traces of all. A stage ``complete`` adds ``sparse``, the estimate before
                it, and ``dense``, the depth map.
            **changes: stages and options for this call alone, as :meth:`replace` takes them.

        Returns:
            Estimate for the B × n samples, with a stage ``complete`` the joint one, unanswered ones with their reason;
            in the dtype of the intrinsics, float32
            where these are half precision. Images and depth may be of any floating dtype, different for each frame
            (:func:`dhtorch.pipeline.inputs.validate_views`).

        Raises:
            ValueError: wrong shapes, different batch sizes or devices, an empty frame, no other view.
            TypeError: no such stage or option, or an argument that is not a Frame.

        Memory: linear in samples and views; pyramids of eight pairs at most exist at once, unless a graph keeps them.
        Gradient: recovered depth to all images, to the near depth and to intrinsics; choices (flags, inliers, gates)
        carry none.
        Cost: linear in views; the reference view's pyramid is built once.
        Source: paper, section "Method".
        """
        method = self.replace(**changes) if changes else self
        reference, others = validate_views(reference, others)
        if fit is None and method.pose_prior is not None:
            fit = method.pose_prior(reference, others)
        trace = {} if trace is None and method.complete is not None else trace
        estimate_views = estimate_pair if others.image.dim() == 4 else estimate_multiview
        estimate = estimate_views(method, reference, others, seed=seed, fit=fit, hint=hint, trace=trace)
        if method.complete is None or trace is None:
            return estimate
        clock = StageTimer(trace)
        joint, depth_map = method.complete(method, reference, selected_views(estimate, others, trace))
        clock("complete", joint)
        trace |= {"sparse": estimate, "estimate": joint, "dense": depth_map}
        return joint


def _component_name(stage: Any) -> str:
    """Name of a stage's function; a ``functools.partial`` is named by its function."""
    while isinstance(stage, partial):
        stage = stage.func
    return getattr(stage, "__name__", type(stage).__name__)
