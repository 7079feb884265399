"""What dhtorch had before it called kornia, word for word: the left side of :mod:`beside_kornia`."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry.filters import correlate_separable, gaussian_taps
from dhtorch.records import Camera, Pose

_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def distort(camera: Camera, uv: Tensor) -> Tensor:
    """``geometry.camera.distort``: the value beside the Jacobian that Newton's method asks for."""
    assert camera.distortion is not None
    xy = (uv - camera.c[:, None]) / camera.f[:, None]
    seen = cam._distort(camera.distortion, xy.movedim(-1, 0))[0].movedim(0, -1)
    return seen * camera.f[:, None] + camera.c[:, None]


def to_matrix(T: Pose) -> Tensor:
    """``geometry.se3.to_matrix``."""
    last = torch.zeros_like(T.t[..., None, :1]).expand(*T.t.shape[:-1], 1, 4).clone()
    last[..., 3] = 1
    return torch.cat((torch.cat((T.R, T.t[..., None]), -1), last), -2)


def gaussian(x: Tensor, sigma_px: float) -> Tensor:
    """``geometry.filters.gaussian``."""
    taps = gaussian_taps(sigma_px)
    return correlate_separable(x, taps, taps)


def to_c2w(quaternion: np.ndarray, t: np.ndarray) -> np.ndarray:
    """``data.convert.to_c2w``."""
    norm = np.linalg.norm(quaternion, axis=-1)
    x, y, z, w = (quaternion / norm[:, None]).T
    c2w = np.zeros((len(t), 4, 4), quaternion.dtype)
    c2w[:, 0, :3] = np.stack((1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)), -1)
    c2w[:, 1, :3] = np.stack((2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)), -1)
    c2w[:, 2, :3] = np.stack((2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)), -1)
    c2w[:, :3, 3], c2w[:, 3, 3] = t, 1
    return c2w


def to_quaternions(rotation: np.ndarray) -> np.ndarray:
    """``data.convert.to_quaternions``."""
    half = np.linalg.norm(rotation, axis=-1, keepdims=True) / 2
    return np.concatenate((rotation * np.sinc(half / np.pi) / 2, np.cos(half)), -1)


def slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """``data.convert.slerp``."""
    dot = (a * b).sum(-1)
    b = np.where(dot < 0, -1.0, 1.0)[:, None] * b
    angle = np.arctan2(np.linalg.norm(b - a, axis=-1), np.linalg.norm(b + a, axis=-1)) * 2
    scale = np.sinc(angle / np.pi)
    weight_a = (1 - share) * np.sinc((1 - share) * angle / np.pi) / scale
    weight_b = share * np.sinc(share * angle / np.pi) / scale
    return weight_a[:, None] * a + weight_b[:, None] * b


def cv_from_gl(c2w: np.ndarray) -> np.ndarray:
    """``data.convert.cv_from_gl``."""
    return c2w @ _GL_FROM_CV


def quaternion(R: list[list[float]]) -> list[float]:
    """That of ``export.colmap``: w, x, y, z from the largest component."""
    d = [R[k][k] for k in range(3)]
    four = [1 + d[0] + d[1] + d[2], 1 + d[0] - d[1] - d[2], 1 - d[0] + d[1] - d[2], 1 - d[0] - d[1] + d[2]]
    wx, wy, wz = R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    xy, xz, yz = R[0][1] + R[1][0], R[0][2] + R[2][0], R[1][2] + R[2][1]
    rows = [[four[0], wx, wy, wz], [wx, four[1], xy, xz], [wy, xy, four[2], yz], [wz, xz, yz, four[3]]]
    best = rows[max(range(4), key=lambda k: four[k])]
    length = math.copysign(math.sqrt(sum(v * v for v in best)), best[0] or 1.0)
    return [v / length for v in best]


def resample(picture: Tensor, motion: Tensor) -> Tensor:
    """That of ``experiments.focal.sharpness``: pictures read at x (1 + m) + shift, bicubic."""
    H, W = picture.shape[-2:]
    x = torch.arange(W, dtype=picture.dtype, device=picture.device)[None] - (W - 1) / 2
    y = torch.arange(H, dtype=picture.dtype, device=picture.device)[:, None] - (H - 1) / 2
    m, du, dv = (motion[:, k, None, None] for k in range(3))
    u, v = x * (1 + m) + du, y * (1 + m) + dv
    grid = torch.stack(((2 * u / W).expand(-1, H, W), (2 * v / H).expand(-1, H, W)), -1)
    return F.grid_sample(picture, grid, mode="bicubic", padding_mode="border", align_corners=False)
