"""Selection of source views of a reference view by their expected information, from estimates on small images.

Every candidate is solved as a pair for a few samples, on images of a few ten thousand pixels. That costs a small
fraction of the full estimate, and overlap, baseline and the existence of a pose are the same at full size.
"""

from __future__ import annotations

from functools import partial

import torch
import torch.nn.functional as F

from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import check
from dhtorch.geometry.coarse_flow import downscale
from dhtorch.geometry.determinism import pad_elementwise
from dhtorch.pipeline.pair import estimate_pair, upcast_intrinsics
from dhtorch.pipeline.spec import MethodSpec
from dhtorch.records import Estimate, Frame, PoseFit, PosePrior, ViewSelection
from dhtorch.stages.pose import map_pose
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.triangulate import two_view

#: Longest side of the images on which candidates are compared, px. Source: origin not recorded.
PREVIEW_SIDE_PX = 240

#: Method of the previews: every estimate with a sigma counts, weighted by it. Few samples, few hypotheses and no
#: rolling-shutter rotation are enough to order views, where accurate points are not needed.
PREVIEW_METHOD = MethodSpec(
    n=128,
    hypotheses=100,
    track=partial(lucas_kanade, levels=4, window=15, normalise="bias"),
    pose=partial(map_pose, shutter_sigma=0.0),
    triangulate=partial(two_view, min_parallax_deg=None, min_t_snr=1.0, fitted_noise=True, sensor_share=1.0),
)


def select_views_by_preview(
    reference: Frame,
    others: Frame,  # (V, B)
    views: int,
    *,
    fit: PoseFit | PosePrior | None = None,  # (V, B)
    long: int = PREVIEW_SIDE_PX,
    good_sigma_rel: float = 0.1,
) -> ViewSelection:
    """The best of many candidate views, and the gain of each, from previews on small images.

    Args:
        reference: B views.
        others: V candidates of each.
        views: how many to select.
        fit: given poses of the candidates; the pose search is then skipped.
        long: longest side of the small images, px; smaller images stay as they are.
        good_sigma_rel: see :func:`rank_views`.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    Cost: V pairs of :data:`PREVIEW_METHOD` on small images.
    """
    check("select_views_by_preview", image_0=(reference.image, "B C H W"), images=(others.image, "V B c h w"))
    with torch.no_grad():
        reference, scale = downscale_frame(reference, long)
        V, B = others.image.shape[:2]
        flat = others.map(lambda x: x.flatten(0, 1))
        references = reference.map(lambda x: x.expand(V, *x.shape).flatten(0, 1))
        flat_fit = None if fit is None else fit.map(lambda x: x.flatten(0, 1))
        estimate = estimate_pair(PREVIEW_METHOD, references, downscale_frame(flat, long)[0], fit=flat_fit)
        estimate = estimate.map(lambda x: x.unflatten(0, (V, B)))
        return rank_views(estimate.replace(sigma=estimate.sigma / scale), views, good_sigma_rel=good_sigma_rel)


def downscale_frame(frame: Frame, long: int) -> tuple[Frame, int]:
    """The frame with a grey image whose longer side is at most ``long`` px, and the scale: full-size pixels per pixel.

    Depth stays as it is. Gradient: to the image and the intrinsics.
    """
    frame = upcast_intrinsics(frame)
    small = downscale(frame.image, long)
    depth_camera = frame.depth_camera
    if depth_camera is None:
        depth_camera = cam.resize(frame.camera, frame.hw, (frame.depth.shape[-2], frame.depth.shape[-1]))
    camera = frame.camera.replace(f=frame.camera.f / small.scale, c=(frame.camera.c - small.first) / small.scale)
    return frame.replace(image=small.grey, camera=camera, depth_camera=depth_camera), small.scale


def rank_views(
    estimates: Estimate,  # (V, B, N), one per view
    views: int,
    *,
    good_sigma_rel: float = 0.1,
) -> ViewSelection:
    """The best views, greedily by the information of their estimates, and the gain of each over those before it.

    A wide view has a smaller sigma, a near one sees more points. The information of a set of views is the sum over the
    points of log(1 + sum of (good_sigma_rel · depth / sigma)² over its views); views are added one by one, each time
    the one of largest gain, the wider of equals.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    """
    V = check("rank_views", gate=(estimates.gate, "V B N"), sigma=(estimates.sigma, "V B N"))["V"]
    if not 1 <= views <= V:
        raise ValueError(f"rank_views: views is {views}, expected 1 to {V}")
    is_answered = estimates.keep & (estimates.sigma > 0) & estimates.sigma.isfinite()
    ratio = good_sigma_rel * estimates.depth / torch.where(is_answered, estimates.sigma, 1.0)
    information = (
        torch.where(is_answered, ratio, 0.0).detach().double().square().flip(0)
    )  # argmax takes the first of equals
    selected_information = torch.zeros_like(information[0])
    is_free = torch.ones_like(information[:, :, 0], dtype=torch.bool)
    added = torch.zeros_like(information[:, :, 0])
    for _ in range(views):
        gain = (
            pad_elementwise(torch.log1p, selected_information + information).sum(-1).masked_fill(~is_free, -torch.inf)
        )
        best = F.one_hot(gain.argmax(0), V).T.bool()
        added = torch.where(best, gain - pad_elementwise(torch.log1p, selected_information).sum(-1), added)
        selected_information = selected_information + torch.where(best[..., None], information, 0.0).sum(0)
        is_free = is_free & ~best
    index = is_free.flip(0).long().argsort(dim=0, stable=True)[:views]
    return ViewSelection(index, added.flip(0).gather(0, index), ~is_answered.any(-1))
