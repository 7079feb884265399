"""Stage 4 on kornia: two images and sample pixels → tracks, by pyramidal Lucas–Kanade there and back.

Alphabet: ``T`` (B, N, P) grey values of image 0 in the P pixels around each point ``x`` (B, N, 2), ``g`` (B, N, 2, P)
their gradient, ``J`` (B, N, P) those of image 1 around ``y`` (B, N, 2); A = Σ g gᵀ. The track y makes Σ g (J − T) zero.
"""

import torch
from kornia.filters import spatial_gradient
from kornia.geometry.transform import build_pyramid, remap
from torch import Tensor

from dhtorch.geometry.checks import constant
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import QUANTISATION_VARIANCE, is_inside_picture
from dhtorch.records import NO_HINT, TrackHint, Tracks

#: Least eigenvalue of A per pixel of a window that is tracked, squared grey values in [0, 1] per px².
#: Source: OpenCV calcOpticalFlowPyrLK default minEigThreshold 1e-4, derived, times 2^10 / 255².
MIN_EIGENVALUE = 1e-4 * 2**10 / 255**2

#: Pairs whose eigenvalues are computed at once. Source: chosen on an H100, whose cuSOLVER fails for 64 pairs of 2,048
#: points.
MAX_EIGEN_PAIRS = 8


@torch.inference_mode(False)  # it differentiates inside
def lucas_kanade_kornia(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    window: int = 21,
    levels: int = 4,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    max_round_trip_px: float = 1.0,
) -> Tracks:
    """Tracks of points uv_0 from image 0 to image 1 and back; a track that does not return to its start is not valid.

    From coarse to fine, every window takes Gauss–Newton steps y ← y − A⁻¹ Σ g (J − T) until one is shorter than
    ``epsilon_px``. A last Newton step, with the exact derivative of Σ g (J − T), makes the result differentiable
    (implicit function theorem). Options and fields: :func:`dhtorch.stages.track.lucas_kanade`.

    Gradient: ``uv_1`` to both images and ``uv_0``; the other fields are detached.
    Source: Lucas and Kanade 1981; Bouguet 2000 (pyramid).
    """
    grey_0, grey_1 = (grayscale(image).to(uv_0.dtype, copy=True) for image in (image_0, image_1))
    with torch.no_grad():
        side, most = min(*grey_0.shape[-2:], *grey_1.shape[-2:]), levels if hint.levels is None else hint.levels
        n_levels = max([k + 1 for k in range(most) if side >> k > window], default=1)
        pyramid_0, pyramid_1 = (build_pyramid(grey, n_levels) for grey in (grey_0, grey_1))
        start = uv_0 if hint.start is None else torch.where(hint.start.isfinite(), hint.start, uv_0)
        o = (window, iterations, epsilon_px)
        y, valid, A = _search(pyramid_0, pyramid_1, uv_0, start, o)
        x, returned, _ = _search(pyramid_1, pyramid_0, y, y + uv_0 - start, o)
        error = (x - uv_0).nan_to_num(0.0, 0.0, 0.0).norm(dim=-1)
    uv_1, difference = _newton_step(grey_0, grey_1, uv_0, y, valid, A=A, window=window)
    if not (torch.is_grad_enabled() and any(v.requires_grad for v in (image_0, image_1, uv_0))):
        uv_1 = uv_1.detach()
    square = difference.square().sum(-1)
    A = A + 1e-5 * A.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(1e-4)[..., None, None] * torch.eye(
        2, dtype=A.dtype, device=A.device
    )
    return Tracks(
        uv_0=uv_0,
        uv_1=uv_1,
        error=error,
        photometric=(square / window**2).sqrt(),
        cov=(square / (window**2 - 2)).clamp_min(QUANTISATION_VARIANCE)[..., None, None] * torch.linalg.inv(A),
        valid=valid & returned & (error < max_round_trip_px),
    )


def _search(
    source: list[Tensor], target: list[Tensor], x: Tensor, y: Tensor, o: tuple[int, int, float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (B, N, 2) in ``target`` of points x of ``source``, searched from y on; which are valid (B, N); A."""
    window, iterations, epsilon_px = o
    valid = is_inside_picture(x, source[0]) & y.isfinite().all(-1)
    x, y = (p.nan_to_num(0.0, 0.0, 0.0) for p in (x, y))
    pair = torch.arange(len(x), device=x.device)[:, None]
    for picture_0, picture_1 in zip(reversed(source), reversed(target), strict=True):
        T, g = _template(picture_0, _to_level(x, source[0], picture_0), window)
        A = torch.einsum("bnip,bnjp->bnij", g, g)
        eigenvalues = torch.cat([torch.linalg.eigvalsh(part) for part in A.split(MAX_EIGEN_PAIRS)])
        textured = eigenvalues[..., 0] > MIN_EIGENVALUE * window**2
        A_inv = torch.linalg.inv(
            torch.where(textured[..., None, None], A, torch.eye(2, dtype=A.dtype, device=A.device))
        )
        y = _to_level(y, target[0], picture_1)
        length = torch.zeros_like(y[..., 0])
        active = valid & textured & is_inside_picture(y, picture_1)
        for _ in range(iterations if active.any() else 0):
            n = int(active.sum(1).amax())
            some = pair, (~active).to(torch.uint8).argsort(stable=True, dim=1)[:, :n]  # the active points come first
            moving, J = active[some], _read(picture_1, y[some], window)
            step = torch.einsum("bnij,bnj->bni", A_inv[some], (g[some] @ (J - T[some])[..., None])[..., 0])
            y[some] = torch.where(moving[..., None], y[some] - step, y[some])
            length[some] = torch.where(moving, step.norm(dim=-1), length[some])
            active[some] = moving & (length[some] > epsilon_px) & is_inside_picture(y[some], picture_1)
        y = _to_level(y, picture_1, target[0])
    return y, valid & textured & is_inside_picture(y, target[0]) & (length < 1), A


def _newton_step(
    grey_0: Tensor, grey_1: Tensor, x: Tensor, y: Tensor, valid: Tensor, *, A: Tensor, window: int
) -> tuple[Tensor, Tensor]:
    """Positions after one differentiable Newton step from y, and the grey differences J − T (B, N, P) at y."""
    x, at = (torch.where(valid[..., None], p, 0.0) for p in (x, y))
    with torch.enable_grad():
        at.requires_grad_()
        T, g = _template(grey_0, x, window)
        difference = _read(grey_1, at, window) - T
        residual = (g @ difference[..., None])[..., 0]
        rows = [torch.autograd.grad(residual[..., k].sum(), at, retain_graph=True)[0] for k in (0, 1)]
    H = torch.stack(rows, -2)
    regular = (valid & (torch.linalg.det(H) > 0.1 * torch.linalg.det(A)))[..., None]  # else far from a parabola
    step = torch.linalg.solve(
        torch.where(regular[..., None], H, torch.eye(2, dtype=H.dtype, device=H.device)), residual
    )
    return y - torch.where(regular, step, 0.0), difference.detach()


def _template(picture: Tensor, x: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """T and g around points; beyond the border the picture is mirrored and g is 0."""
    return _read(picture, x, window), _read(spatial_gradient(picture)[:, 0], x, window, "zeros").transpose(1, 2)


def _read(picture: Tensor, x: Tensor, window: int, padding_mode: str = "reflection") -> Tensor:
    """Bilinear values (B, C, N, P) of pictures (B, C, H, W) in windows around points (B, N, 2); (B, N, P) for C = 1."""
    side = torch.arange(window, device=x.device) - window // 2
    dv, du = torch.cartesian_prod(side, side).unbind(-1)
    values = remap(picture, x[..., :1] + du, x[..., 1:] + dv, padding_mode=padding_mode, align_corners=True)
    return values[:, 0] if picture.shape[1] == 1 else values


def _to_level(x: Tensor, picture: Tensor, other: Tensor) -> Tensor:
    """Points (B, N, 2) of one level of a pyramid on another; kornia's levels cover the same area."""
    scale = constant(x, [other.shape[-1] / picture.shape[-1], other.shape[-2] / picture.shape[-2]])
    return (x + 0.5) * scale - 0.5
