"""Reference implementation of the reprojection problem of near and far tracks: loops over tracks, dense matrices.

Symbols are those of ``dhtorch.geometry.reprojection_problem``; ``J`` (2, 9) the derivative of a track's pixel to (rotation,
translation, turn), ``s`` (2,) to its inverse depth, ``r`` (2,) px, ``W`` the inverse of its noise's covariance, ``v``
the variance of the inverse depth. Everything is numpy, float64, of one pair.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import brentq

from dhtorch.geometry.reprojection_problem import PoseDepthProblem, Unknowns
from dhtorch.geometry.se3 import Pose

D = torch.float64


class Track(NamedTuple):
    """One linearised track."""

    J: np.ndarray
    s: np.ndarray
    r: np.ndarray
    W: np.ndarray
    v: float
    front: bool
    near: bool
    far: bool

    @property
    def gram(self) -> np.ndarray:
        """(10, 10): (J r)ᵀ W (J r) with the inverse depth, prior 1 / v, eliminated."""
        X = np.column_stack((self.J, self.r))
        whole, across, one = X.T @ self.W @ X, X.T @ self.W @ self.s, self.s @ self.W @ self.s
        if self.v == 0 or one < 1e-9:
            return whole
        return whole - np.outer(across, across) / (one + 1 / self.v)

    @property
    def square(self) -> float:
        """Squared length of the whitened residual."""
        return float(self.gram[9, 9]) if self.front else 1e4


def hat(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def tracks(problem: PoseDepthProblem, at: Unknowns, noise: torch.Tensor, b: int = 0) -> list[Track]:
    """All tracks of pair ``b``; ``noise`` (B, N) px²."""
    P = {k: getattr(problem, k)[b].double().numpy() for k in ("f", "c", "ray", "uv", "inverse", "variance", "shape")}
    near, far = problem.near[b].tolist(), problem.far[b].tolist()
    R, t, shutter_rate = at.T.R[b].double().numpy(), at.T.t[b].double().numpy(), at.shutter_rate[b].double().numpy()
    nearest = max((P["inverse"][k] for k in range(len(near)) if near[k]), default=0.0)
    tracks = []
    for k in range(len(near)):
        x, scale = P["ray"][:, k], float(noise[b, k])
        xx, xy, yy = P["shape"][:, k]
        W = np.linalg.inv(scale * np.array([[xx, xy], [xy, yy]]))
        y = x[1] / x[2]
        seen = np.append((P["uv"][:, k] - P["c"]) / P["f"], 1.0)
        seen = seen - y * np.cross(shutter_rate, seen)
        seen = P["f"] * seen[:2] / seen[2]

        def parts(q, x=x, seen=seen):
            """Residual, its slope in q, the derivative of the pixel to the point, the point."""
            Y = R @ x + q * t
            D_pixel = P["f"][:, None] * np.array([[1 / Y[2], 0, -Y[0] / Y[2] ** 2], [0, 1 / Y[2], -Y[1] / Y[2] ** 2]])
            return P["f"] * Y[:2] / Y[2] - seen, D_pixel @ t, D_pixel, Y

        q, v = P["inverse"][k], P["variance"][k]
        if not near[k]:
            rises = lambda q, parts=parts, W=W: parts(q)[1] @ W @ parts(q)[0]  # noqa: E731
            q, v = 0.0, 0.0
            if rises(0.0) < 0:
                most = next(m for m in 2.0 ** np.arange(-6, 8) if rises(m) > 0)
                q, v = brentq(rises, 0.0, most, xtol=1e-15, rtol=1e-14), np.inf
        r, s, D_pixel, Y = parts(q)
        J = D_pixel @ np.hstack((-hat(Y), q * np.eye(3), -y * hat(Y)))
        front = bool(Y[2] > 1e-6 and (near[k] or q < 2 * nearest))
        tracks.append(Track(J, s, r, W, float(v), front, near[k], far[k]))
    return tracks


def weight(square: float, kernel: str | None, k: float) -> tuple[float, float, float]:
    """rho, its derivative and its second derivative."""
    bend = 1 + square / k**2
    if kernel == "geman_mcclure":
        return square / bend, bend**-2, -2 / k**2 * bend**-3
    if kernel == "cauchy":
        return k**2 * np.log(bend), 1 / bend, -1 / (k * bend) ** 2
    if kernel == "huber" and square > k**2:
        return 2 * k * square**0.5 - k**2, k / square**0.5, -0.5 * k * square**-1.5
    return square, 1.0, 0.0


def cost(tracks: list[Track], far_weight: float, kernel: str | None, bend: float) -> float:
    """Robust cost of all tracks without any prior."""
    return sum(weight(x.square, kernel, bend)[0] * (x.near + far_weight * x.far) for x in tracks)


def reduced(tracks: list[Track], weights: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations H (9, 9) and g (9,) of weighted tracks: one matrix with a column for every unknown inverse
    depth, then its Schur complement."""
    used = [(x, w) for x, w in zip(tracks, weights, strict=True) if w > 0 and x.front]
    n = len(used)
    A, b = np.zeros((9 + n, 9 + n)), np.zeros(9 + n)
    for k, (x, w) in enumerate(used):
        known = x.v == 0 or x.s @ x.W @ x.s < 1e-9  # nothing is to be found about q
        X = np.hstack((x.J, np.zeros((2, n))))
        X[:, 9 + k] = 0 if known else x.s
        A, b = A + w * X.T @ x.W @ X, b + w * X.T @ x.W @ x.r
        A[9 + k, 9 + k] += w if known else w / x.v
    own = np.linalg.inv(A[9:, 9:])
    return A[:9, :9] - A[:9, 9:] @ own @ A[9:, :9], b[:9] - A[:9, 9:] @ own @ b[9:]


def problem_of(args: tuple, isotropic: float) -> PoseDepthProblem:
    """Arguments of ``map_pose`` -> its pose problem, one track at a time."""
    samples, seen, camera_0, camera_1, _ = args
    B, N = seen.valid.shape
    out = {k: torch.zeros(B, *s, N, dtype=D) for k, s in (("ray", (3,)), ("uv", (2,)), ("shape", (3,)))}
    out |= {k: torch.ones(B, N, dtype=D) for k in ("inverse", "variance")}
    near, far = torch.zeros(B, N, dtype=torch.bool), torch.zeros(B, N, dtype=torch.bool)
    for b in range(B):
        f, c = camera_0.f[b].double(), camera_0.c[b].double()
        finite = [
            bool(seen.valid[b, n] and seen.uv_0[b, n].isfinite().all() and seen.uv_1[b, n].isfinite().all())
            for n in range(N)
        ]
        good = [
            ok and bool((torch.linalg.eigvalsh(seen.cov[b, n].nan_to_num(-1.0)) > 0).all())
            for n, ok in enumerate(finite)
        ]
        sizes = sorted(float(torch.trace(seen.cov[b, n])) / 2 for n in range(N) if good[n])
        for n in range(N):
            S = torch.eye(2, dtype=D)
            if good[n]:
                S = (1 - isotropic) * seen.cov[b, n].double() / sizes[(len(sizes) - 1) // 2] + isotropic * S
            out["shape"][b, :, n] = torch.stack((S[0, 0], S[0, 1], S[1, 1]))
            out["ray"][b, :, n] = 1.0
            xyz, sigma = samples.xyz[b, n].double(), float(samples.sigma[b, n])
            if not finite[n]:
                continue
            out["uv"][b, :, n] = seen.uv_1[b, n].double()
            out["ray"][b, :2, n] = (seen.uv_0[b, n].double() - c) / f
            far[b, n] = not xyz.isfinite().all()
            near[b, n] = bool(xyz.isfinite().all() and xyz[2] > 0 and 0 < sigma < np.inf)
            if near[b, n]:
                out["ray"][b, :, n] = xyz / xyz[2]
                out["inverse"][b, n], out["variance"][b, n] = 1 / xyz[2], (sigma / xyz[2] ** 2) ** 2
    return PoseDepthProblem(f=camera_1.f.double(), c=camera_1.c.double(), near=near, far=far, **out)


def unknowns(R: torch.Tensor, t: torch.Tensor, shutter_rate: torch.Tensor | None = None) -> Unknowns:
    return Unknowns(
        Pose(R.to(D), t.to(D)), torch.zeros_like(t, dtype=D) if shutter_rate is None else shutter_rate.to(D)
    )
