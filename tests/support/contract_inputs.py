"""Random inputs (batch, n, dtype) of the functions in the contract table: pixels, cameras, poses, tracks, pictures."""

import torch

from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import camera, se3
from dhtorch.records import Camera, Samples, Tracks

HW = (48, 64)


def generator(seed=0):
    """A random generator of this seed."""
    return torch.Generator().manual_seed(seed)


def uniform(*shape, dtype, low=0.0, high=1.0, seed=0):
    """Uniform numbers between ``low`` and ``high``, drawn in float64."""
    return (low + (high - low) * torch.rand(*shape, generator=generator(seed), dtype=torch.float64)).to(dtype)


def cameras(batch, dtype, distorted=False, seed=0):
    """Cameras of pictures of 48 x 64 pixels."""
    f = uniform(batch, 2, dtype=dtype, low=60, high=70, seed=seed)
    c = uniform(batch, 2, dtype=dtype, low=22, high=32, seed=seed + 1)
    k = torch.tensor([0.05, -0.02, 0.001, -0.002, 0.01], dtype=dtype).expand(batch, 5).clone() if distorted else None
    return Camera(f, c, k)


def pixels(batch, n, dtype, margin=3.0, seed=0):
    """Pixels (batch, n, 2) at least ``margin`` px inside the border."""
    low, high = torch.tensor([margin, margin]), torch.tensor([HW[1] - 1 - margin, HW[0] - 1 - margin])
    return uniform(batch, n, 2, dtype=dtype, seed=seed) * (high - low).to(dtype) + low.to(dtype)


def poses(batch, dtype, seed=0):
    """Poses with small rotations and a step of about 0.3 m along x."""
    xi = uniform(batch, 6, dtype=dtype, low=-0.1, high=0.1, seed=seed)
    xi[:, 3] += 0.3
    return se3.exp(xi)


def tracked(batch, n, dtype, noise=0.2):
    """(samples, tracks, the exact pose fit, camera 0, camera 1) of points 1 to 4 m away, tracked with ``noise`` px."""
    camera_0, camera_1 = cameras(batch, dtype), cameras(batch, dtype, seed=5)
    uv_0, depth, T = pixels(batch, n, dtype), uniform(batch, n, dtype=dtype, low=1, high=4, seed=3), poses(batch, dtype)
    uv_1 = camera.project(camera_1, se3.apply(T, camera.unproject(camera_0, uv_0, depth)))
    uv_1 = uv_1 + noise * uniform(batch, n, 2, dtype=dtype, low=-1, seed=4)
    xyz = camera.unproject(camera_0, uv_0, depth)
    zero = torch.zeros_like(depth)
    code = zero.to(torch.int32)
    samples = Samples(uv_0, depth, 0.01 * depth, xyz, zero + 1, code, zero + 1, code)
    eye = torch.eye(2, dtype=dtype).expand(batch, n, 2, 2) * 0.04
    tracks = Tracks(uv_0, uv_1, zero, zero, eye.clone(), zero == 0)
    cov = (1e-6 * torch.eye(6, dtype=dtype)).expand(batch, 6, 6).clone()
    return samples, tracks, known_pose_fit(T, n).replace(cov=cov), camera_0, camera_1


def shifted(batch, n, dtype):
    """(picture, the same moved by 2 and 1 px, pixels of it): smooth random textures."""
    size = (batch, 1, HW[0] + 4, HW[1] + 4)
    rough = uniform(*size, dtype=torch.float64, seed=7)
    smooth = torch.nn.functional.avg_pool2d(rough, 5, 1, 2)
    smooth = ((smooth - 0.5) * 4 + 0.5).clamp(0, 1).to(dtype)
    return smooth[..., :-4, :-4], smooth[..., 2:-2, 1:-3], pixels(batch, n, dtype, margin=14.0)
