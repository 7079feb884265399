"""Selection of source views of a reference view by their expected information, from estimates on small images.

Every candidate is solved as a pair for a few samples, on images of a few ten thousand pixels. That costs a small
fraction of the full estimate, and overlap, baseline and the existence of a pose are the same at full size.
"""

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import pytree
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.coarse_flow import downscale
from dhtorch.geometry.determinism import pad_elementwise
from dhtorch.geometry.patches import is_inside_picture
from dhtorch.pipeline.pair import (
    StageTimer,
    repeat_views,
    sample_returns,
    solve_pose_and_triangulate,
    track_in_chunks,
    upcast_intrinsics,
)
from dhtorch.pipeline.spec import MethodSpec
from dhtorch.records import NO_HINT, Estimate, Frame, Pose, PoseFit, PosePrior, Tracks, ViewSelection
from dhtorch.stages.pose import map_pose
from dhtorch.stages.sample import spiral
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.triangulate import two_view

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
    long: int = 240,
    near: int = 128,
    good_sigma_rel: float = 0.1,
    prefer_tracked: bool = True,
    reserve: int | None = None,
) -> ViewSelection:
    """The best of many candidate views, and the gain of each, from previews on small images.

    The pose of a preview needs near returns, which a few evenly spread samples miss where the sensor has few:
    ``near`` further samples lie at returns, wherever these are. They enter the pose and not the ranking.

    Args:
        reference: B views.
        others: V candidates of each.
        views: how many to select.
        fit: given poses of the candidates; the pose search is then skipped.
        long: longest side of the small images, px; smaller images stay as they are.
        near: most further samples at near returns.
        good_sigma_rel: see :func:`rank_views`.
        prefer_tracked: whether views without an estimate are ordered by their tracks (:func:`tracked_motion`), not by
            their place alone.
        reserve: how many of the next best replace selected views that turn out to have no pose; None = ``views``.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    Cost: V pairs of :data:`PREVIEW_METHOD` on small images.
    """
    check("select_views_by_preview", image_0=(reference.image, "B C H W"), images=(others.image, "V B c h w"))
    with torch.no_grad():
        reference, scale = downscale_frame(reference, long)
        V, B = others.image.shape[:2]
        samples = PREVIEW_METHOD.sample_depth(reference)
        if near > 0:
            samples = pytree.collate((samples, sample_returns(PREVIEW_METHOD, reference, near)), dim=1)
        references, samples = repeat_views(reference, V), repeat_views(samples, V)
        flat = downscale_frame(others.map(lambda x: x.flatten(0, 1)), long)[0]
        fit = None if fit is None else fit.map(lambda x: x.flatten(0, 1))
        tracks = track_in_chunks(PREVIEW_METHOD, references.image, flat.image, samples.uv, NO_HINT)
        cameras = references.camera, flat.camera
        estimate, tracks, _ = solve_pose_and_triangulate(
            PREVIEW_METHOD, samples, tracks, *cameras, seed=0, fit=fit, clock=StageTimer(None)
        )
        estimate = estimate.map(lambda x: x[:, : PREVIEW_METHOD.n].unflatten(0, (V, B)))
        motion = tracked_motion(tracks, long).unflatten(0, (V, B)) if prefer_tracked else None
        return rank_views(
            estimate.replace(sigma=estimate.sigma / scale),
            views,
            good_sigma_rel=good_sigma_rel,
            motion=motion,
            reserve=min(views if reserve is None else reserve, V - views),
        )


def select_views_by_pose(
    reference: Frame,
    others: Frame,  # (V, B)
    views: int,
    T_1_from_0: Pose,  # (V, B)
    depth: Tensor,  # (B,) m
    *,
    good_sigma_rel: float = 0.1,
) -> ViewSelection:
    """The best of many candidate views by their poses: parallax of points that the view shows, from a similar side.

    The points lie at one depth in all directions of the reference view. A window is recognised less and less the more
    its line of sight has turned; the information of a point is weighted accordingly. Views whose pose is not finite
    come last.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    """
    V = check("select_views_by_pose", image_0=(reference.image, "B C H W"), t=(T_1_from_0.t, "V B 3"))["V"]
    check("select_views_by_pose", image_0=(reference.image, "B C H W"), depth=(depth, "B"))
    if not 1 <= views <= V:
        raise ValueError(f"select_views_by_pose: views is {views}, expected 1 to {V}")
    with torch.no_grad():
        uv = spiral(reference.hw, PREVIEW_METHOD.n, device=depth.device, dtype=reference.camera.f.dtype)
        uv = uv.expand(len(depth), *uv.shape)
        xyz = cam.unproject(reference.camera, uv, depth[:, None].expand(uv.shape[:2]).to(uv.dtype))
        information = [_information(xyz, others[v], T_1_from_0[v], good_sigma_rel) for v in range(V)]
        return _select_greedily(torch.stack(information).double(), views)


def _information(xyz: Tensor, frame: Frame, T: Pose, good_sigma_rel: float) -> Tensor:
    """Expected information (B, N) of points (B, N, 3) of view 0 in a view with pose T; 0 where not shown."""
    T = T.to(xyz.dtype)
    there = se3.apply(T, xyz)
    pixel = cam.project(frame.camera, there)
    shown = (there[..., 2] > 0) & is_inside_picture(pixel, frame.image)
    line = F.normalize(se3.rotate(T.R, xyz), dim=-1)
    turn = (line * F.normalize(there, dim=-1)).sum(-1).clamp(-1, 1).acos()
    precision = good_sigma_rel * turn * frame.camera.f.amin(-1)[:, None]  # with tracks to 1 px
    # At a turn of 0.2 rad a window is recognised with e^-1/2 of the certainty.
    seen = (-0.5 * (turn / 0.2).square()).exp()
    return torch.where(shown, (precision * seen).square(), 0.0).nan_to_num(0.0)


def tracked_motion(tracks: Tracks, long: int) -> Tensor:
    """How many points are tracked how far: sum (P,) over the tracks (P, N) of log(1 + (10 motion / ``long``)²).

    It orders views without an estimate: more tracks are better, and so is a wider motion, less and less from a tenth
    of the longer side on. Gradient: none.
    """
    motion = (tracks.uv_1 - tracks.uv_0).detach().norm(dim=-1) * (10 / long)
    return torch.where(tracks.valid, motion.square().log1p(), 0.0).sum(-1)


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
    motion: Tensor | None = None,  # (V, B)
    reserve: int = 0,
) -> ViewSelection:
    """The best views, greedily by the information of their estimates, and the gain of each over those before it.

    A wide view has a smaller sigma, a near one sees more points. The information of a set of views is the sum over the
    points of log(1 + sum of (good_sigma_rel · depth / sigma)² over its views); views are added one by one, each time
    the one of largest gain; of equals, that of more ``motion`` (:func:`tracked_motion`), then the later one.
    The ``reserve`` are those that would be added next, the best first.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.

    Gradient: none; a choice.
    """
    V = check("rank_views", gate=(estimates.gate, "V B N"), sigma=(estimates.sigma, "V B N"))["V"]
    if not 1 <= views <= V:
        raise ValueError(f"rank_views: views is {views}, expected 1 to {V}")
    is_answered = estimates.keep & (estimates.sigma > 0) & estimates.sigma.isfinite()
    ratio = good_sigma_rel * estimates.depth / torch.where(is_answered, estimates.sigma, 1.0)
    information = torch.where(is_answered, ratio, 0.0).detach().double().square()
    # Small enough to order equal gains alone: gains differ by more than 1e-6, and a sum over 256 tracks is below 2000.
    preference = None if motion is None else 1e-10 * motion.detach().double()
    selection = _select_greedily(information, views, preference, reserve)
    return selection.replace(no_answer=~is_answered.any(-1))


def _select_greedily(
    information: Tensor, views: int, preference: Tensor | None = None, reserve: int = 0
) -> ViewSelection:
    """Views of most information (V, B, N), added one by one, with their gains, and the ``reserve`` next ones.

    ``preference`` (V, B) is added to the gain where the best is chosen.
    """
    V = len(information)
    information = information.flip(0)  # argmax takes the first of equals
    preference = torch.zeros_like(information[..., 0]) if preference is None else preference.flip(0)
    selected_information = torch.zeros_like(information[0])
    rank = torch.full_like(preference, V, dtype=torch.int64)
    added = torch.zeros_like(preference)
    for k in range(min(V, views + reserve)):
        gain = (
            pad_elementwise(torch.log1p, selected_information + information).sum(-1).masked_fill(rank < V, -torch.inf)
        )
        best = F.one_hot((gain + preference).argmax(0), V).T.bool()
        added = torch.where(best, gain - pad_elementwise(torch.log1p, selected_information).sum(-1), added)
        selected_information = selected_information + torch.where(best[..., None], information, 0.0).sum(0)
        rank = torch.where(best, k, rank)
    order = rank.flip(0).argsort(dim=0, stable=True)
    index = order[:views].sort(dim=0).values
    next_best = order[views : min(V, views + reserve)] if reserve > 0 else None
    return ViewSelection(index, added.flip(0).gather(0, index), reserve=next_best)
