"""Stage 5 on kornia: near returns and tracks → metric relative pose with a covariance, or a code without pose.

The minimal solver is :func:`dhtorch.geometry.p3p.p3p`, the one function that kornia lacks: its ``solve_pnp_dlt`` needs
six points and raises for the whole batch where those of one element lie in a plane.
"""

import kornia.geometry as kg
import torch
import torch.nn.functional as F
from kornia.geometry.liegroup import Se3
from torch import Tensor

from dhtorch.codes import PoseCode, first_reason
from dhtorch.geometry.camera import to_matrix
from dhtorch.geometry.p3p import p3p
from dhtorch.records import Camera, Pose, PoseFit, Samples, Tracks


@torch.inference_mode(False)  # it differentiates inside
def pnp_ransac_kornia(
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    *,
    threshold_px: float = 3.0,
    min_inlier: int = 8,
    steps: int = 10,
) -> PoseFit:
    """Metric pose of camera 1 relative to camera 0 from tracked samples with a return, or a code where there is none.

    The three points of each draw have up to four poses. The one of least cost Σ min(r², threshold²) is refined by
    Gauss–Newton steps T ← exp(ξ) T on its inliers. A last Newton step, with the exact derivative of Σ Jᵀ r, makes the
    result differentiable (implicit function theorem). Fields and codes: :func:`dhtorch.stages.pose.pnp_ransac`.

    Gradient: R and t to near ``xyz``, ``uv_1`` and camera 1; the other fields are detached. Float64 inside.
    Source: paper, "LiDAR-anchored relative pose", with P3P in place of EPnP.
    """
    K = to_matrix(camera_1).double()
    usable = tracks.valid & samples.usable & tracks.uv_1.isfinite().all(-1)
    xyz, uv = (torch.where(usable[..., None], x, 1.0).double() for x in (samples.xyz, tracks.uv_1))
    xyz, uv, usable = (F.pad(x, (0, 0) * (x.dim() - 2) + (0, 1), value=1) for x in (xyz, uv, usable))
    usable[:, -1] = False  # one more point, which is not used: no pair is without points
    with torch.no_grad():
        T, has_pose = _search(xyz, uv, usable, K, draws.double(), threshold_px)
        for _ in range(steps + 1):
            start = T
            g, H, square, inlier = _linearise(start, xyz, uv, K, usable, threshold_px)
            T = _move(start, _solve(H, -g)[0])
    # Row k of ∂(Σ Jᵀ r)/∂ξ of every pair at once: pairs are independent, so that the sum over them separates.
    data = (xyz.detach(), uv.detach(), K.detach(), inlier, torch.inf)
    rows = torch.func.jacrev(lambda xi: _linearise(_move(start, xi), *data)[0].sum(0))(torch.zeros_like(g))
    g, *_ = _linearise(start, xyz, uv, K, inlier, torch.inf)
    xi, solved = _solve(rows[:, 0, :, :, 0].detach().movedim(0, 1), -g)
    T = _move(start, xi)
    R, t = T.so3.matrix(), T.t
    if not (torch.is_grad_enabled() and any(x.requires_grad for x in (xyz, uv, K))):
        R, t = R.detach(), t.detach()  # kornia's groups hold parameters
    with torch.no_grad():
        n_inlier = inlier.sum(-1)
        total = torch.where(inlier, square, 0.0).sum(-1)
        sigma_px = (total / (2 * n_inlier - 6).clamp_min(1)).sqrt().clamp_min(1e-6)
        inverse, regular = _solve(H, torch.eye(6, dtype=H.dtype, device=H.device).expand_as(H))
        cov = inverse * sigma_px.square()[:, None, None]
        whitened, _ = _solve(cov[:, 3:, 3:], t[..., None])
        few, bad, enough = PoseCode.TOO_FEW, PoseCode.DEGENERATE, usable.sum(-1) >= min_inlier
        code = first_reason((~enough, few), (~has_pose, bad), (n_inlier < min_inlier, few), (~(regular & solved), bad))
    fit = PoseFit(
        T_1_from_0=Pose(R, t),
        cov=cov,
        inlier=inlier[:, :-1],
        n_inlier=n_inlier,
        rms_px=(total / n_inlier.clamp_min(1)).sqrt(),
        sigma_px=sigma_px,
        t_snr=(t.detach()[..., None] * whitened).sum((1, 2)).sqrt(),
        code=code,
    )
    return fit.without_pose(code != PoseCode.OK, code).to(samples.xyz.dtype)


def _search(xyz: Tensor, uv: Tensor, usable: Tensor, K: Tensor, draws: Tensor, limit: float) -> tuple[Se3, Tensor]:
    """The pose (B,) of least truncated cost among those of all triples, and whether there is one (B,)."""
    count = usable.sum(-1)
    order = (~usable).to(torch.uint8).argsort(stable=True, dim=-1)  # usable points first
    n = count.clamp_min(3)[:, None]
    first, second, third = (torch.minimum((draws[..., k] * (n - k)).long(), n - k - 1) for k in range(3))
    # Both are counted from the first point on; the third skips the second.
    triples = torch.stack((first, first + 1 + second, first + 1 + third + (third >= second).long()), -1) % n[..., None]
    index = order.gather(1, triples.flatten(1).clamp(max=order.shape[1] - 1))[..., None].expand(-1, -1, 3)
    rays = kg.camera.unproject_points(uv, torch.ones_like(uv[..., :1]), K)
    R, t, valid = (x.flatten(1, 2) for x in p3p(*(x.gather(1, index).unflatten(1, (-1, 3)) for x in (rays, xyz))))
    # As in ``PAPER``, more points are thinned evenly.
    slots = (torch.arange(256, device=n.device) + 0.5) / 256 * count[:, None]
    scored = order.gather(1, slots.long())[..., None]
    points = kg.convert_points_to_homogeneous(xyz.gather(1, scored.expand(-1, -1, 3)))
    projected = points[:, None] @ kg.epipolar.projection_from_KRt(K[:, None].expand_as(R), R, t[..., None]).mT
    r = kg.convert_points_from_homogeneous(projected) - uv.gather(1, scored.expand(-1, -1, 2))[:, None]
    square = torch.where(projected[..., 2] > 0, r.square().sum(-1), torch.inf).clamp(max=limit**2)
    best = torch.where(valid, square.sum(-1), torch.inf).argmin(1)  # of (B, 4 H)
    Rt = torch.cat((R, t[..., None]), -1)[torch.arange(len(best), device=best.device), best]
    return Se3.from_matrix(F.pad(Rt, (0, 0, 0, 1))), valid.any(1)


def _linearise(T: Se3, xyz: Tensor, uv: Tensor, K: Tensor, usable: Tensor, limit: float) -> tuple[Tensor, ...]:
    """Σ Jᵀ r (B, 6, 1) and Σ Jᵀ J (B, 6, 6) of inliers, r = projection − uv and J = ∂r/∂ξ; r² and inliers (B, N)."""
    Y = kg.transform_points(T.matrix(), xyz)
    in_front = Y[..., 2] > 1e-6
    Y = torch.where(in_front[..., None], Y, 1.0)
    r = kg.project_points(Y, K) - uv
    square = r.square().sum(-1)
    inlier = usable & in_front & (square < limit**2)
    J_point = K[:, None, :2, :2] @ kg.camera.dx_project_points_z1(Y)
    J = torch.cat((torch.linalg.cross(Y[..., None, :], J_point), J_point), -1)  # rotation, translation
    J = torch.where(inlier[..., None, None], J, 0.0)
    return torch.einsum("bnki,bnk->bi", J, r)[..., None], torch.einsum("bnki,bnkj->bij", J, J), square, inlier


def _solve(H: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """H⁻¹ rhs (B, n, m) of symmetric matrices, 0 where one is not positive (as in ``PAPER``); whether (B,) it is."""
    scale = H.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()[..., None]
    L, info = torch.linalg.cholesky_ex(scale * H * scale.mT)
    positive = ((info == 0) & (L.diagonal(dim1=1, dim2=2).amin(-1) > 1e-6))[:, None, None]
    x = scale * torch.cholesky_solve(scale * rhs, torch.where(positive, L, torch.eye(H.shape[-1]).to(H)))
    return torch.where(positive, x, 0.0), positive.flatten()


def _move(T: Se3, xi: Tensor) -> Se3:
    """exp(ξ) T of ξ (B, 6, 1) = (rotation rad, translation m); kornia's order is the reverse."""
    return Se3.exp(xi[..., 0].roll(3, -1)) * T
