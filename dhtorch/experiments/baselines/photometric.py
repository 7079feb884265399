"""A fixed-threshold photometric check: the peer of :func:`dhtorch.validation.validate.validate_depth`.

A pixel is sent into one other view by its depth and the motion; what differs there by more than a fixed grey value is
wrong, all else consistent. Nothing is said of texture, baseline, exposure or what hides it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.codes import State
from dhtorch.geometry import plane_sweep
from dhtorch.pipeline import dense
from dhtorch.records import Frame

#: Difference of grey values, of 1, from which on a pixel counts as wrong.
_WRONG_GREY_DIFFERENCE = 0.1


@torch.no_grad()
def photometric_difference(depth: Tensor, reference: Frame, asked: dense.SelectedViews) -> tuple[Tensor, Tensor]:
    """Difference of grey values (B, h, w) of a map (B, h, w) in m and the view that is worth most, and its states.

    CANNOT_KNOW: no depth, no motion, or outside the other picture. Gradient: none.
    """
    size = max(depth.shape[-2:])
    base = plane_sweep.make_reference_view(*dense.downscale_grey(reference, size))
    index, _ = dense.top_views(asked, 1)
    use = asked.fits.ok.gather(0, index)[0]
    source_view = dense.source_view_of(asked, index[0], size, use, base.image)
    q = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    uv, front = plane_sweep.project_inverse_depth(source_view.view, base.ray, q.flatten(1))
    grey, inside = plane_sweep.sample_bilinear(source_view.view.image, uv)
    seen = (inside & front).unflatten(-1, base.hw) & (depth > 0) & use[:, None, None]
    miss = (grey[:, 0].unflatten(-1, base.hw) - base.image[:, 0]).abs()
    state = torch.where(miss > _WRONG_GREY_DIFFERENCE, State.WRONG, State.CONSISTENT)
    return torch.where(seen, miss, torch.nan), torch.where(seen, state, State.CANNOT_KNOW).to(torch.int32)
