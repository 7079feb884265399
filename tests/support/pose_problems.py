"""Random pose problems with near and far tracks and their true solutions, for ``map_pose`` and its solver."""

import math

import torch

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.reprojection_problem import PoseDepthProblem, Unknowns
from dhtorch.records import Camera, Samples, Tracks

D = torch.float64

#: Draws of the minimal sets (1, 64, 3), the same for every pair: they only choose the start of the solver.
DRAWS = torch.rand(1, 64, 3, generator=torch.Generator().manual_seed(7), dtype=D)


def map_pose_inputs(
    batch, near=60, far=140, *, noise=0.3, depth=0.01, turn=0.0, baseline=0.1, planar=False, rotation=0.05, seed=0
):
    """(arguments of ``map_pose``, true T_1_from_0, true shutter rate, true depths) of random pairs of views.

    ``noise`` px is anisotropic; ``depth`` is the relative noise of the sensor's returns, ``turn`` the deviation of the
    shutter rate; ``planar`` puts the near points on a plane.
    """
    g = torch.Generator().manual_seed(seed)
    rand = lambda *s: torch.rand(*s, generator=g, dtype=D)  # noqa: E731
    randn = lambda *s: torch.randn(*s, generator=g, dtype=D)  # noqa: E731
    n = near + far
    camera_0 = Camera(500 + 50 * rand(batch, 2), 10 * rand(batch, 2) + torch.tensor([315.0, 235.0], dtype=D))
    camera_1 = Camera(450 + 50 * rand(batch, 2), 10 * rand(batch, 2) + torch.tensor([315.0, 235.0], dtype=D))
    uv_0 = rand(batch, n, 2) * torch.tensor([600.0, 440.0], dtype=D) + 20
    z = torch.cat((0.6 + 1.0 * rand(batch, near), 2.5 + 3 * rand(batch, far)), 1)
    ray = cam.rays(camera_0, uv_0)
    if planar:
        z[:, :near] = 1 / (1 + 0.3 * ray[:, :near, 0] + 0.8 * ray[:, :near, 1])
    direction = torch.nn.functional.normalize(randn(batch, 3), dim=-1)
    T = se3.exp(torch.cat((rotation * randn(batch, 3), baseline * direction), -1))
    b = turn * randn(batch, 3)
    Y = se3.apply(T, ray * z[..., None])
    Y = Y + torch.linalg.cross(ray[..., 1:2] * b[:, None], Y)
    uv_1 = cam.project(camera_1, Y)
    angle, spread = math.pi * rand(batch, n), 1 + 2 * rand(batch, n)
    axis = torch.stack((angle.cos(), angle.sin()), -1)
    cov = torch.eye(2, dtype=D) + (spread**2 - 1)[..., None, None] * axis[..., None] * axis[..., None, :]
    uv_1 = uv_1 + noise * (torch.linalg.cholesky(cov) @ randn(batch, n, 2, 1))[..., 0]
    sensed = z * (1 + depth * randn(batch, n))
    xyz = torch.where((torch.arange(n) < near)[:, None], ray * sensed[..., None], torch.nan)
    zero = torch.zeros(batch, n, dtype=D)
    code = zero.to(torch.int32)
    sigma = max(depth, 1e-3) * sensed
    samples = Samples(uv_0, sensed * (torch.arange(n) < near), sigma, xyz, zero + 1, code, zero + 1, code)
    tracks = Tracks(uv_0, uv_1, zero, zero, cov * 0.01, zero == 0)
    return (samples, tracks, camera_0, camera_1, DRAWS.expand(batch, -1, -1)), T, b, z


N = 16
NOISE = torch.linspace(0.05, 0.4, N, dtype=D).expand(2, N)
#: What tracks 8 to 15 are.
FAR, BEYOND, EPIPOLE, NEARLY, BEHIND, UNUSED = (8, 9, 10), 11, 12, 13, 14, 15


def pose_depth_problem(off=0.5, turn=0.02, seed=0):
    """(two problems of N tracks, their true unknowns): tracks 0 to 7 are near, the others far; noise of ``off`` px."""
    g = torch.Generator().manual_seed(seed)
    rand = lambda *s: torch.rand(*s, generator=g, dtype=D)  # noqa: E731
    randn = lambda *s: torch.randn(*s, generator=g, dtype=D)  # noqa: E731
    f, c = 400 + 90 * rand(2, 2), 300 + 20 * rand(2, 2)
    T = se3.exp(torch.cat((0.1 * randn(2, 3), torch.tensor([[0.3, 0.1, 0.05], [-0.2, 0.2, 0.1]], dtype=D)), -1))
    turn = turn * randn(2, 3)
    ray = torch.cat((1.2 * rand(2, 2, N) - 0.6, torch.ones(2, 1, N, dtype=D)), 1)
    ray = ray * (1 + (torch.arange(N) < 8) * rand(2, 1, N))  # rays of any length
    q = 0.4 + 0.6 * rand(2, N)
    q[:, 8:] = 0.2 * rand(2, 8)
    nearest = q[:, :8].amax(-1)
    q[:, EPIPOLE], q[:, NEARLY] = 2.1 * nearest, 1.9 * nearest
    true = torch.where(torch.arange(N) == BEYOND, -0.3, q)
    Y = T.R @ ray + true[:, None] * T.t[..., None]
    height = (ray[:, 1] / ray[:, 2])[:, None]
    Y = Y + torch.linalg.cross(height * turn[..., None], Y, dim=1)  # the rows turn
    uv = Y[:, :2] / Y[:, 2:] * f[..., None] + c[..., None]
    ray[:, :, BEHIND] *= -1
    L = torch.tril(randn(2, N, 2, 2)) + torch.eye(2, dtype=D)
    S = L @ L.mT
    uv = uv + off * randn(2, 2, N)
    number = torch.arange(N).expand(2, N)
    near, far = (number < 8) | (number == BEHIND), (number >= 8) & (number < BEHIND)
    variance = (0.02 * (1 + rand(2, N))) ** 2
    variance[:, 3] = 0
    shape = torch.stack((S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]), 1)
    return PoseDepthProblem(f, c, ray, uv, q, variance, shape, near, far), Unknowns(T, turn)
