"""Stage 6 on kornia: two views' tracks and pose → depth with a sigma, or a gate where the geometry is weak."""

import kornia.geometry as kg
import torch
from torch import Tensor

from dhtorch.codes import Gate, PoseCode, first_reason
from dhtorch.geometry.camera import to_matrix
from dhtorch.records import Camera, Estimate, PoseFit, Samples, SigmaBudget, Tracks


def two_view_kornia(
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    camera_0: Camera,
    camera_1: Camera,
    *,
    min_parallax_deg: float = 0.3,
    max_residual_px: float = 3.0,
) -> Estimate:
    """Triangulate every track under the metric pose → depth with a sigma, or a gate where the geometry is weak.

    The pixel of view 0 is exact. That of view 1 moves perpendicularly onto its epipolar line, by ``residual_px``, and
    the rays meet. Fields and gates: :func:`dhtorch.stages.triangulate.two_view`; a rolling shutter is ignored.

    With s = ∂uv_1/∂depth and g = s / (sᵀ s), sigma² = gᵀ Σ_track g + gᵀ J Σ_pose Jᵀ g, J = ∂uv_1/∂pose; the last term
    is ``sigma_shared``², common to the points of a pair.

    Gradient: depth, sigma, parallax and residual to pixels, cameras and pose; gates carry none. Float64 inside.
    Source: paper, "Gated two-view triangulation and abstention".
    """
    posed, eye = fit.ok[:, None], torch.eye(3, dtype=fit.T_1_from_0.t.dtype, device=fit.T_1_from_0.t.device).double()
    tracked = tracks.valid & tracks.uv_0.isfinite().all(-1) & tracks.uv_1.isfinite().all(-1)
    usable = tracked & posed
    # What is missing is replaced by valid numbers, so that values and gradients are finite.
    R = torch.where(posed[..., None], fit.T_1_from_0.R.double(), eye)
    t = torch.where(posed, fit.T_1_from_0.t.double(), eye[0])
    uv_0, uv_1 = (torch.where(usable[..., None], x, 0.0).double() for x in (tracks.uv_0, tracks.uv_1))
    K_0, K_1 = (to_matrix(camera).double() for camera in (camera_0, camera_1))
    P_0 = kg.epipolar.projection_from_KRt(K_0, eye.expand_as(R), torch.zeros_like(t)[..., None])
    P_1 = kg.epipolar.projection_from_KRt(K_1, R, t[..., None])
    F = kg.epipolar.fundamental_from_projections(P_0, P_1)
    residual_px = kg.epipolar.left_to_right_epipolar_distance(uv_0, uv_1, F)
    on_line = kg.epipolar.get_closest_point_on_epipolar_line(uv_0, uv_1, F)
    X = kg.epipolar.triangulate_points(P_0, P_1, uv_0, on_line, solver="cofactor")
    meet = X.isfinite().all(-1) & (X[..., 2].abs() > 1e-9)
    X = torch.where(meet[..., None], X, eye[2])
    along, depth = X @ R.mT, X[..., 2]  # from the centre of camera 0 to the point, in the axes of camera 1
    Y = along + t[:, None]
    in_front = meet & (depth > 0) & (Y[..., 2] > 0)
    parallax_deg = torch.atan2(_root(torch.linalg.cross(along, Y).square().sum(-1)), (along * Y).sum(-1)).rad2deg()

    J_point = K_1[:, None, :2, :2] @ kg.camera.dx_project_points_z1(torch.where(in_front[..., None], Y, 1.0))
    s = (J_point @ (along / depth[..., None])[..., None])[..., 0]
    g = s / s.square().sum(-1, keepdim=True).clamp_min(1e-18)
    by_point = (g[..., None, :] @ J_point)[..., 0, :]
    by_pose = torch.cat((torch.linalg.cross(Y, by_point), by_point), -1)
    own = torch.einsum("bni,bnij,bnj->bn", g, torch.where(usable[..., None, None], tracks.cov, 0.0).double(), g)
    cov_pose = torch.where(posed[..., None], fit.cov, 0.0).double()
    shared = torch.einsum("bni,bij,bnj->bn", by_pose, cov_pose, by_pose)
    gates = {Gate.NO_BASELINE: PoseCode.NO_BASELINE, Gate.POSE_REFUTED: PoseCode.REFUTED}
    gates[Gate.MISALIGNED] = PoseCode.MISALIGNED
    gate = first_reason(
        (~tracked, Gate.NO_TRACK),
        *(((fit.code == code)[:, None].expand_as(tracked), gate) for gate, code in gates.items()),
        (~usable, Gate.NO_POSE),
        (~in_front, Gate.BEHIND),
        (parallax_deg <= min_parallax_deg, Gate.PARALLAX),
        (residual_px >= max_residual_px, Gate.RESIDUAL),
    )
    keep = gate == Gate.ANSWER
    return Estimate(
        uv=samples.uv,
        depth=torch.where(keep, depth, torch.nan),
        sigma=torch.where(keep, _root(own + shared), torch.nan),
        sigma_shared=torch.where(keep, _root(shared), torch.nan),
        parallax_deg=torch.where(usable, parallax_deg, 0.0),
        residual_px=torch.where(usable, residual_px, 0.0),
        n_views=torch.where(usable, 2, 1).int(),
        score=keep.double(),
        gate=gate,
        parts=SigmaBudget(own, shared, *[torch.zeros_like(own)] * 3),
    ).to(samples.uv.dtype)


def _root(x: Tensor) -> Tensor:
    """Square root with a finite gradient, 0, where the value is not positive."""
    return torch.where(x > 0, torch.where(x > 0, x, 1.0).sqrt(), 0.0)
