"""A fixed-threshold photometric check: the peer of :func:`dhtorch.validation.validate.validate_depth`.

A pixel is projected into one source view by its depth and the relative pose; it is wrong if the grey values differ by
more than a fixed threshold, else consistent. Texture, baseline, exposure and occlusion are ignored.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.codes import State
from dhtorch.geometry import plane_sweep
from dhtorch.pipeline import dense
from dhtorch.records import Frame

#: Difference of grey values in [0, 1] above which a pixel counts as wrong.
_WRONG_GREY_DIFFERENCE = 0.1


@torch.no_grad()
def photometric_difference(depth: Tensor, reference: Frame, selected: dense.SelectedViews) -> tuple[Tensor, Tensor]:
    """Depth map (B, h, w) in m → (grey difference to the best source view, states), (B, h, w) each.

    CANNOT_KNOW: no depth, no relative pose, or outside the source image. Gradient: none.
    """
    size = max(depth.shape[-2:])
    base = plane_sweep.make_reference_view(*dense.downscale_grey(reference, size))
    index, _ = dense.top_views(selected, 1)
    has_pose = selected.fits.ok.gather(0, index)[0]
    source_view = dense.source_view_of(selected, index[0], size, has_pose, base.image)
    inverse_depth = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    uv, front = plane_sweep.project_inverse_depth(source_view.view, base.ray, inverse_depth.flatten(1))
    grey, inside = plane_sweep.sample_bilinear(source_view.view.image, uv)
    visible = (inside & front).unflatten(-1, base.hw) & (depth > 0) & has_pose[:, None, None]
    difference = (grey[:, 0].unflatten(-1, base.hw) - base.image[:, 0]).abs()
    state = torch.where(difference > _WRONG_GREY_DIFFERENCE, State.WRONG, State.CONSISTENT)
    return torch.where(visible, difference, torch.nan), torch.where(visible, state, State.CANNOT_KNOW).to(torch.int32)
