"""Measured motions between the views of a model -> the scale of its camera path, and where the path is wrong.

A model whose path and depths have different scales, whose path curls, or some of whose views stand elsewhere has no
single scale, though its depths alone may have one.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dhtorch.data.models import ModelView
from dhtorch.measure.local_scales import ScaleFault, ScaleTolerance
from dhtorch.metrics.camera_paths import CameraMotions, compare_motions

#: Fewest motions that can show a fault, and views that are off for one. Source: chosen, a tenth of 40 motions, since
#: single motions are measured wrongly; more motions than those of which three are off.
_MIN_MOTIONS, _MIN_VIEWS = 8, 3

#: Lower quartile of the length of a vector of three unit normal coordinates, to which two in five motions that are off
#: add little. Source: derived, chi-squared.
_QUARTILE_3D = 1.101


class PathScale(NamedTuple):
    """The camera path of a model against measured motions between its views."""

    source: str  # of the motions
    scale: float  # metres per unit of the path
    sigma: float  # of log(scale)
    changes: list[ScaleFault]  # path against depths, curl, views; beyond the tolerance or not
    faults: list[ScaleFault]  # those beyond it
    agrees: bool  # whether the motions exclude changes beyond the tolerance
    spread: float  # standard deviation of log(scale of depths) that covers the changes within the tolerance


def measure_path(
    source: str,
    motions: CameraMotions,
    views: Sequence[ModelView],
    *,
    scale: float,
    depth: float,
    tolerance: ScaleTolerance,
    own: float = 0.0,
) -> PathScale | None:
    """Motions between the F views of a path -> its scale and faults; None where too few follow each other.

    Args:
        source: of the motions, in words.
        motions: between the views.
        views: along the path.
        scale: metres per unit by the model's depths.
        depth: m, typical of the scene. A view is off by a fraction of it, or of the path's size where that is less.
        own: relative standard deviation of the motions' metres against those of the depths.
        tolerance: change from which a model is refused. A curl counts as the shift of the path's end over its length,
            a half of its angle.
    """
    c2w, names = np.stack([view.c2w for view in views]), [view.name for view in views]
    c2w[:, :3, 3] *= scale
    difference = compare_motions(motions, c2w)
    if difference is None:
        return None
    sigma = math.hypot(difference.length_sigma, own)
    angle = float(np.linalg.norm(difference.curl))
    axis = ", ".join(f"{x:+.2f}" for x in difference.curl / max(angle, 1e-9))
    curl = f"a curl by {math.degrees(angle):.1f}° about ({axis}) from {names[0]} to {names[-1]}, by {source}"
    length = ScaleFault("path", f"camera path against depths, by {source}", difference.length - 1, sigma)
    turned = ScaleFault("curl", curl, angle / 2, difference.curl_sigma / 2)
    rows = [  # change, its limit in standard deviations, what may be left of it
        (length, tolerance.deviations, math.hypot(length.change, 2 * difference.length_sigma)),
        (turned, tolerance.deviations, turned.change if turned.change > turned.sigma else 0.0),
    ]
    reach = max(abs(length.change) + 2 * difference.length_sigma, turned.change + 2 * turned.sigma)
    if len(motions.first) >= _MIN_MOTIONS:
        size = min(depth, float(np.sqrt(c2w[:, :3, 3].var(0).sum())))
        off = np.maximum(difference.shift / size, difference.turn)
        worst = np.argsort(-off)[:_MIN_VIEWS]
        pairs = ", ".join(f"{names[motions.first[k]]} to {names[motions.second[k]]}" for k in worst)
        noise = float(np.quantile(off, 0.25)) / _QUARTILE_3D
        views_off = ScaleFault("views", f"motions between views, by {source}: {pairs}", float(off[worst[-1]]), noise)
        shown = views_off.change if views_off.change > tolerance.scan_deviations * noise else 0.0
        rows.append((views_off, tolerance.scan_deviations, shown))
        reach = max(reach, shown)
    faults = [c for c, limit, _ in rows if abs(c.change) - tolerance.change > limit * c.sigma]
    spread = max((left for c, _, left in rows if c not in faults), default=0.0) / 2
    return PathScale(
        source=source,
        scale=scale / difference.length,
        sigma=sigma,
        changes=[change for change, _, _ in rows],
        faults=faults,
        agrees=reach <= tolerance.change,
        spread=spread,
    )
