"""Dense completion: depth, sigma and score for every pixel of a view, by one call.

method ─ sparse answers, poses ─┐
reference image, sensor ────────┼─ sweep joined with the sparse answers ─ DepthMap
source images ──────────────────┘
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.metrics.calibration import Calibration, load_calibration
from dhtorch.pipeline.dense import check_dense_options, selected_views, sweep_depth
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import FUSED
from dhtorch.pipeline.spec import Trace
from dhtorch.records import NO_HINT, DepthMap, Frame, PoseFit, PosePrior, TrackHint
from dhtorch.runtime.numerics import standard_numerics


@standard_numerics
def complete_depth(
    reference: Frame,
    others: Frame | Sequence[Frame],
    *,
    method: Method = FUSED,
    source_views: int = DenseOptions.source_views,
    planes: int = DenseOptions.planes,
    size: int = DenseOptions.size,
    refinements: int = DenseOptions.refinements,
    min_correlation: float = DenseOptions.min_correlation,
    max_sigma_rel: float = DenseOptions.max_sigma_rel,
    calibration: Calibration | None = None,
    seed: int | Tensor = 0,
    fit: PoseFit | PosePrior | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> DepthMap:
    """Complete depth maps of the reference views: near returns, and where there is none the depth that images give.

    Args:
        reference: B views.
        others: as :class:`dhtorch.pipeline.method.Method` takes them: B views, or V × B of them, or a sequence of V.
        method: the sparse method that gives the poses; it selects views as it does when called alone. Its stage
            ``complete`` joins sweep and sparse answers; without one the map is the sweep alone.
        source_views: most views that are swept, those of largest gain (at most eight).
        planes: inverse depths that are tested, evenly spaced from infinity to within the sensor's reach; where a
            reference view's returns are ``sparse``, to the nearest of them.
        size: longer side of the map and of the images that are swept, px; smaller images keep their size.
        refinements: Gauss-Newton steps from the best plane.
        min_correlation: correlation of a pixel's window in the view that fits best, below which it is unanswered.
        max_sigma_rel: sigma / depth above which a pixel is unanswered, before ``calibration``.
        calibration: corrects sigma and score of pixels without a return; None leaves them as they are.
        seed, fit, hint, trace: as :class:`dhtorch.pipeline.method.Method` takes them; the trace also gets ``sparse``,
            the sparse estimate, and ``fused``, the joint one at the same samples.
        options: the other tuning constants; its fields that are keywords here are ignored.

    Returns:
        DepthMap (B, h, w) over the field of view of the reference image: near returns where they are usable (as
        ``method.backproject`` reads them), recovered depths, unanswered pixels; ``source`` names the evidence of each.
        Score is h / (h + sigma / depth), h = 0.1, before ``calibration``.

    Gates: that of the pair for all pixels where no source view is usable (NO_BASELINE, NO_POSE, CONTRADICTED, or
    UNCERTAIN where the gain of all is too small); NO_TRACK (visible in no view, nearer than the sweep, or without a
    match), UNCERTAIN. CONTRADICTED where near returns refute the sweep.

    Raises:
        ValueError: wrong shapes, no other view, or an option out of range.

    Gradient: recovered depth to all images, to intrinsics and through the poses to the near depth, by the implicit
    function theorem where the last fit ends; planes, source views, sigma and gates carry none.
    Memory: less than four bytes for every pixel and plane, whatever the number of views, and images.
    Cost: linear in planes, pixels and source views.
    """
    keywords: dict[str, Any] = {
        "source_views": source_views,
        "planes": planes,
        "size": size,
        "refinements": refinements,
        "min_correlation": min_correlation,
        "max_sigma_rel": max_sigma_rel,
    }
    check_dense_options("complete_depth", keywords)
    trace = {} if trace is None else trace
    sparse = method.replace(complete=None)(reference, others, seed=seed, fit=fit, hint=hint, trace=trace)
    selected = selected_views(sparse, others, trace)
    if method.complete is None:
        estimate = sparse
        depth_map = sweep_depth(reference, selected, method=method, **keywords, options=options)
    else:
        estimate, depth_map = method.complete(method, reference, selected, **keywords, options=options)
    trace |= {"sparse": sparse, "fused": estimate}
    if calibration is None:
        return depth_map
    sensed = depth_map.source == Source.SENSOR
    calibrated = calibration.apply(depth_map)
    return calibrated.replace(
        sigma=torch.where(sensed, depth_map.sigma, calibrated.sigma),
        score=torch.where(sensed, depth_map.score, calibrated.score),
    )


def default_calibration() -> Calibration:
    """The calibration of ``FUSED`` in the package's data."""
    return load_calibration("fused")
