"""Stage 4 from a matcher of kornia: matches where it finds them → tracks of the samples, with covariance.

A matcher of ``kornia.feature`` pairs points of its own choice. The motion of a sample is that of the matches around it:
a plane fitted through the positions that the nearest matches predict for it, by robust weighted least squares.

Alphabet: a pair has M matches, ``uv_0`` to ``uv_1`` (M, 2) px with the local motion ``A`` (M, 2, 2); a sample uses the
K nearest of them, at offsets ``o`` (N, K, 2) px, which predict it at ``p`` (N, K, 2) px.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.checks import constant, shaped
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import is_inside_picture
from dhtorch.geometry.pyramid import PyramidCache, build_pyramid
from dhtorch.geometry.reprojection_problem import MEDIAN_2D
from dhtorch.records import NO_HINT, TrackHint, Tracks

if TYPE_CHECKING:
    Matcher = torch.nn.Module | Callable[[Tensor, Tensor], Any]

#: Parameters of the plane through the predictions of a sample, a count.
#: Source: derived, a constant and two slopes.
_PLANE_PARAMETERS = 3


class _Matches(NamedTuple):
    """Matches of a pair of pictures."""

    uv_0: Tensor  # (M, 2) px
    uv_1: Tensor  # (M, 2) px
    A: Tensor  # (M, 2, 2) d uv_1 / d uv_0, the identity where the matcher does not estimate it


@shaped("image_0: B C H W, uv_0: B N 2, image_1: B c h w")
def match_features(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    matcher: "Matcher",
    hint: TrackHint = NO_HINT,
    neighbours: int = 12,
    reach: float = 0.1,
    noise_px: float = 0.25,
    max_round_trip_px: float = 3.0,
    window: int = 21,
) -> Tracks:
    """Track stage by a matcher of kornia: the matches around a sample → its track.

    The samples' matches are a guess within a pixel or two: ``partial(lucas_kanade_affine, track=partial(match_features,
    matcher=…), levels=1, max_shift_px=4.0)`` registers their windows, too.

    Args:
        matcher: of ``kornia.feature`` a ``LocalFeatureMatcher`` or ``LoFTR`` (its local affine frames are used), a
            ``LocalFeature`` (``SIFTFeature``, ``KeyNetAffNetHardNet``, …), ``XFeat``, ``DISK`` or ``ALIKED``; or any
            function of two pictures (1, C, H, W), float in [0, 1], that returns matched pixels (M, 2), (M, 2).
        hint: its pyramid of image 0 serves ``photometric``; start, levels and flows are not used.
        neighbours: matches that a sample uses at most.
        reach: largest distance of a sample from its nearest match, in longer sides of the picture.
        noise_px: least standard deviation of a track.
        max_round_trip_px: a track with a longer round trip is not valid.
        window: side of the windows that ``photometric`` compares, odd, px.

    Returns:
        Tracks in the dtype of ``uv_0``. ``error``: the way back by the matches around ``uv_1``. ``cov``: of the
        prediction of a new point by the fitted plane, from its neighbours' residuals: s² (1 + leverage), at least
        ``noise_px``². ``valid``: inside both pictures, a match within reach, more matches that agree than the plane has
        parameters, and back within the limit. Not valid and not finite: ``uv_1`` is ``uv_0``, 0 where that is not.

    Raises:
        ValueError: wrong shapes or options.
        TypeError: a matcher of another kind.

    Gradient: none; ``lucas_kanade_affine(track=match_features)`` adds one.
    Cost: that of the matcher for each pair, and samples × matches.
    """
    if neighbours <= _PLANE_PARAMETERS or not reach > 0:
        raise ValueError(f"match_features: neighbours {neighbours}, reach {reach}, expected > 3 and > 0")
    with torch.no_grad():
        x = uv_0.detach().float().nan_to_num(-1.0, -1.0, -1.0)
        rows = []
        for b in range(len(uv_0)):
            matches = _find_matches(matcher, _unit(image_0[b : b + 1]), _unit(image_1[b : b + 1]))
            there = _predict(matches, x[b], neighbours, reach * max(image_0.shape[-2:]))
            back = _predict(_reversed(matches), there[0], neighbours, reach * max(image_1.shape[-2:]))
            rows.append((*there, back[0], back[2]))
        uv_1, cov, is_near, returned, is_back = (torch.stack(column) for column in zip(*rows, strict=True))
        error = torch.linalg.vector_norm(returned - x, dim=-1)
        inside = is_inside_picture(x, image_0) & is_inside_picture(uv_1, image_1)
        valid = is_near & is_back & inside & (error < max_round_trip_px)
        safe = torch.where(valid[..., None], uv_1, x.clamp(min=0))
        pyramids = PyramidCache(image_0) if hint.pyramid is None else hint.pyramid
        target = build_pyramid(image_1, 1, window, gradients=False)
        options = lk.SearchOptions(window, 1, 0.0, 0.0, "none")
        rms, _ = lk.compare_windows(pyramids(1, window), target, options, x.clamp(min=0), safe)
        kept = uv_1.isfinite().all(-1, keepdim=True) & uv_0.isfinite().all(-1, keepdim=True)
        floor = noise_px**2 * torch.eye(2, device=cov.device, dtype=cov.dtype)
        return Tracks(
            uv_0=uv_0,
            uv_1=torch.where(kept, uv_1.to(uv_0), uv_0.detach().nan_to_num(0.0, 0.0, 0.0)),
            error=error.nan_to_num(torch.inf).to(uv_0),
            photometric=rms.to(uv_0),
            cov=(cov.nan_to_num(0.0, 0.0, 0.0) + floor).to(uv_0),
            valid=valid,
        )


def _find_matches(
    matcher: "Matcher",
    image_0: Tensor,  # (1, C, H, W) float in [0, 1]
    image_1: Tensor,  # (1, C, H', W')
) -> _Matches:
    """Matches of two pictures by a matcher of kornia, or by a function: see :func:`match_features`. Gradient: none.

    Raises:
        TypeError: a module of another kind.
    """
    from kornia import feature  # noqa: PLC0415  (imported where it is used: 0.2 s)

    if isinstance(matcher, feature.XFeat):
        matcher = matcher.match_xfeat_star
    if isinstance(matcher, feature.LocalFeatureMatcher | feature.LoFTR):
        output = matcher({"image0": grayscale(image_0), "image1": grayscale(image_1)})
        lafs = [output.get(f"lafs{k}") for k in (0, 1)]
        return _as_matches(output["keypoints0"], output["keypoints1"], *lafs)
    if isinstance(matcher, feature.LocalFeature):
        (lafs_0, d_0), (lafs_1, d_1) = (_described_lafs(matcher, grayscale(x)) for x in (image_0, image_1))
        # Lowe's ratio, loosened: a sample needs agreeing neighbours as well.
        pairs = feature.match_smnn(d_0, d_1, 0.95)[1]
        lafs_0, lafs_1 = lafs_0[pairs[:, 0]], lafs_1[pairs[:, 1]]
        return _as_matches(lafs_0[..., 2], lafs_1[..., 2], lafs_0[None], lafs_1[None])
    if isinstance(matcher, feature.DISK | feature.ALIKED):
        options = {"pad_if_not_divisible": True} if isinstance(matcher, feature.DISK) else {}
        (a,), (b,) = (matcher(x.expand(-1, 3, -1, -1), **options) for x in (image_0, image_1))
        pairs = feature.match_mnn(a.descriptors, b.descriptors)[1]
        return _as_matches(a.keypoints[pairs[:, 0]], b.keypoints[pairs[:, 1]])
    if isinstance(matcher, torch.nn.Module) and type(matcher).__module__.startswith("kornia."):
        expected = "LocalFeatureMatcher, LoFTR, LocalFeature, XFeat, DISK, ALIKED or a function"
        raise TypeError(f"match_features: found {type(matcher).__name__}, expected {expected}")
    return _as_matches(*matcher(image_0, image_1))


def _described_lafs(matcher: Any, image: Tensor) -> tuple[Tensor, Tensor]:
    """Local affine frames (M, 2, 3) of a picture and their descriptors (M, D), without the slots that are empty."""
    from kornia.feature import laf_is_filled  # noqa: PLC0415

    lafs, _, descriptors = matcher(image)
    filled = laf_is_filled(lafs)[0]
    return lafs[0][filled], descriptors[0][filled]


def _as_matches(uv_0: Tensor, uv_1: Tensor, lafs_0: Tensor | None = None, lafs_1: Tensor | None = None) -> _Matches:
    """Matched pixels, and frames (1, M, 2, 3) or None → matches; also of tensors of inference mode."""
    uv_0, uv_1 = uv_0.clone().float(), uv_1.clone().float()
    if lafs_0 is None or lafs_1 is None:
        return _Matches(uv_0, uv_1, torch.eye(2, dtype=uv_0.dtype, device=uv_0.device).expand(len(uv_0), 2, 2))
    frame_0, frame_1 = (x[0, :, :, :2].float() for x in (lafs_0, lafs_1))
    regular = torch.linalg.det(frame_0).abs() > torch.finfo(frame_0.dtype).eps
    inverse = torch.linalg.inv(
        torch.where(regular[:, None, None], frame_0, torch.eye(2, dtype=frame_0.dtype, device=frame_0.device))
    )
    return _Matches(
        uv_0,
        uv_1,
        torch.where(regular[:, None, None], frame_1 @ inverse, torch.eye(2, dtype=uv_0.dtype, device=uv_0.device)),
    )


def _reversed(matches: _Matches) -> _Matches:
    """The matches from image 1 to image 0."""
    regular = (torch.linalg.det(matches.A).abs() > torch.finfo(matches.A.dtype).eps)[:, None, None]
    eye = torch.eye(2, dtype=matches.A.dtype, device=matches.A.device)
    inverse = torch.where(regular, torch.linalg.inv(torch.where(regular, matches.A, eye)), eye)
    return _Matches(matches.uv_1, matches.uv_0, inverse)


def _predict(matches: _Matches, x: Tensor, neighbours: int, reach_px: float) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (N, 2) px in image 1 of points x (N, 2) of image 0, covariance (N, 2, 2), whether there is one."""
    count = min(neighbours, len(matches.uv_0))
    if count <= _PLANE_PARAMETERS:
        nothing = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        return x.clone(), torch.zeros(len(x), 2, 2).to(x), nothing
    distance, index = torch.cdist(x.nan_to_num(), matches.uv_0).topk(count, largest=False)
    o = matches.uv_0[index] - x.nan_to_num()[:, None]
    p = matches.uv_1[index] - (matches.A[index] @ o[..., None])[..., 0]
    scale = distance[:, -1:].clamp_min(1.0)
    X = torch.cat((torch.ones_like(o[..., :1]), o / scale[..., None]), -1)
    near = (-(distance**2) / scale**2).exp()
    # Slopes are held at zero, in matches at the distance of the farthest (0.03 and 4 steps: chosen on built-in rooms).
    ridge = 0.03 * torch.diag(constant(X, [0.0, 1, 1]))
    residual = p - p.median(1, keepdim=True).values
    for _ in range(4):
        size = torch.linalg.vector_norm(residual, dim=-1)
        spread = size.median(-1, keepdim=True).values / (MEDIAN_2D * (1 - _PLANE_PARAMETERS / count) ** 0.5)
        # The kernel of stage 5, COST_BEND = 2; keypoints are rounded to whole pixels, by .29 px on average.
        weight = near * (4 / (4 + (size / spread.clamp_min(0.29)) ** 2)) ** 2
        normal = (X * weight[..., None]).mT @ X + ridge
        plane = torch.linalg.solve(normal, (X * weight[..., None]).mT @ p)
        residual = p - X @ plane
    total = weight.sum(-1)
    effective = total**2 / (weight**2).sum(-1)
    scatter = ((residual * weight[..., None]).mT @ residual) / total[:, None, None]
    freedom = (effective - _PLANE_PARAMETERS).clamp_min(1.0) / effective
    row = torch.linalg.solve(normal, constant(ridge, [1.0, 0, 0]).expand(len(x), 3)[..., None])[..., 0]
    leverage = ((X @ row[..., None])[..., 0] * weight).square().sum(-1)
    # E[w r²] / (2 E[w]) = .606 of a normal vector r with w = (1 + r² / bend²)⁻².
    cov = scatter * ((1 + leverage) / (freedom * 0.606))[:, None, None]
    is_near = (distance[:, 0] <= reach_px) & (effective > _PLANE_PARAMETERS) & x.isfinite().all(-1)
    return plane[:, 0], cov, is_near


def _unit(image: Tensor) -> Tensor:
    """Pictures as floats in [0, 1]."""
    return image.float() / 255 if image.dtype == torch.uint8 else image.float()
