"""Which other views of a reference view to ask: those that are expected to say most, told by small pictures.

Every candidate answers a few samples as a pair, on pictures of a few ten thousand pixels. That costs a small part of
asking it in full, and what a view is worth there (does the motion leave enough in sight, is it wide enough for a depth,
is there a pose at all) it is worth in full.
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

#: Longest side of the pictures on which candidates are asked, px.
PREVIEW_SIDE_PX = 240

#: How a candidate is asked: everything that has a sigma counts, and how much is what the sigma says. Few samples, few
#: hypotheses and no turn of rows: what is asked is which view is better, not where its points are.
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
    """The views to ask of many candidates, and what each is worth.

    Args:
        reference: B views.
        others: V candidates of each.
        views: how many to choose.
        fit: known poses of the candidates; their search is then skipped.
        long: longest side of the small pictures, px; smaller images stay as they are.
        good_sigma_rel: see :func:`rank_views`.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    Cost: V pairs of :data:`PREVIEW_METHOD` on small pictures.
    """
    check("select_views_by_preview", image_0=(reference.image, "B C H W"), images=(others.image, "V B c h w"))
    with torch.no_grad():
        reference, k = downscale_frame(reference, long)
        V, B = others.image.shape[:2]
        flat = others.map(lambda x: x.flatten(0, 1))
        several = reference.map(lambda x: x.expand(V, *x.shape).flatten(0, 1))
        known = None if fit is None else fit.map(lambda x: x.flatten(0, 1))
        estimate = estimate_pair(PREVIEW_METHOD, several, downscale_frame(flat, long)[0], fit=known)
        estimate = estimate.map(lambda x: x.unflatten(0, (V, B)))
        return rank_views(estimate.replace(sigma=estimate.sigma / k), views, good_sigma_rel=good_sigma_rel)


def downscale_frame(frame: Frame, long: int) -> tuple[Frame, int]:
    """The frame with a grey picture whose longer side is at most ``long``, and how many pixels make one of its.

    Depth stays as it is. Gradient: to the image and the intrinsics.
    """
    frame = upcast_intrinsics(frame)
    picture = downscale(frame.image, long)
    depth_camera = frame.depth_camera
    if depth_camera is None:
        depth_camera = cam.resize(frame.camera, frame.hw, (frame.depth.shape[-2], frame.depth.shape[-1]))
    camera = frame.camera.replace(f=frame.camera.f / picture.scale, c=(frame.camera.c - picture.first) / picture.scale)
    return frame.replace(image=picture.grey, camera=camera, depth_camera=depth_camera), picture.scale


def rank_views(
    estimates: Estimate,  # (V, B, N), one per view
    views: int,
    *,
    good_sigma_rel: float = 0.1,
) -> ViewSelection:
    """Which views to keep, by the sigma to expect of the points together, and what each adds to those before it.

    A wide view is sure of what it sees, a near one sees more. What a set of views is worth is the sum over the points
    of log(1 + sum of (good_sigma_rel · depth / sigma)² over its views); views are added one by one, each the one that
    adds most, the wider of equals.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    """
    V = check("rank_views", gate=(estimates.gate, "V B N"), sigma=(estimates.sigma, "V B N"))["V"]
    if not 1 <= views <= V:
        raise ValueError(f"rank_views: views is {views}, expected 1 to {V}")
    said = estimates.keep & (estimates.sigma > 0) & estimates.sigma.isfinite()
    ratio = good_sigma_rel * estimates.depth / torch.where(said, estimates.sigma, 1.0)
    information = torch.where(said, ratio, 0.0).detach().double().square().flip(0)  # argmax takes the first of equals
    known = torch.zeros_like(information[0])
    free = torch.ones_like(information[:, :, 0], dtype=torch.bool)
    added = torch.zeros_like(information[:, :, 0])
    for _ in range(views):
        gain = pad_elementwise(torch.log1p, known + information).sum(-1).masked_fill(~free, -torch.inf)
        best = F.one_hot(gain.argmax(0), V).T.bool()
        added = torch.where(best, gain - pad_elementwise(torch.log1p, known).sum(-1), added)
        known = known + torch.where(best[..., None], information, 0.0).sum(0)
        free = free & ~best
    index = free.flip(0).long().argsort(dim=0, stable=True)[:views]
    return ViewSelection(index, added.flip(0).gather(0, index), ~said.any(-1))
