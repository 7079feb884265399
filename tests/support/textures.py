"""Textures with an exact motion, and pyramid levels made, filtered and padded by OpenCV."""

import cv2
import numpy as np
import torch

#: How far beyond half a window levels are padded.
REACH = 8


def waves(B, H, W, shift=(0.0, 0.0), seed=0, shortest=7.0, linear=((1.0, 0.0), (0.0, 1.0))):
    """Texture (B, 1, H, W) float64 in about [0, 1], mapped by ``linear`` about the middle and moved by ``shift`` px."""
    draw = np.random.default_rng(seed)
    length = shortest * (60 / shortest) ** draw.random((B, 25, 1, 1))
    turn, phase = 2 * np.pi * draw.random((2, B, 25, 1, 1))
    v, u = np.mgrid[:H, :W].astype(float)
    back, middle = np.linalg.inv(linear), ((W - 1) / 2, (H - 1) / 2)
    u, v = u - middle[0] - shift[0], v - middle[1] - shift[1]
    u, v = back[0, 0] * u + back[0, 1] * v + middle[0], back[1, 0] * u + back[1, 1] * v + middle[1]
    angle = 2 * np.pi / length * (np.cos(turn) * u + np.sin(turn) * v) + phase
    weight = np.sqrt(length) / np.sqrt(length).sum(1, keepdims=True)
    return torch.from_numpy(0.5 + 1.5 * (weight * np.sin(angle)).sum(1))[:, None]


def places(B, N, H, W, margin, seed=1):
    """Random pixels (B, N, 2) float64, at least ``margin`` px inside the border."""
    draw = np.random.default_rng(seed)
    return torch.from_numpy(margin + draw.random((B, N, 2)) * (np.array([W - 1, H - 1]) - 2 * margin))


class Level:
    """One level of one image: grey mirrored beyond the border, gradients zero there."""

    def __init__(self, grey, window):
        self.grey, self.pad, (self.H, self.W) = grey, window // 2 + REACH, grey.shape
        border = (self.pad,) * 4
        slopes = [cv2.Scharr(grey, cv2.CV_64F, *order, borderType=cv2.BORDER_REFLECT_101) for order in ((1, 0), (0, 1))]
        self.planes = [cv2.copyMakeBorder(grey, *border, cv2.BORDER_REFLECT_101)]
        self.planes += [cv2.copyMakeBorder(s / 32, *border, cv2.BORDER_CONSTANT, value=0) for s in slopes]

    def half(self, window):
        return Level(cv2.pyrDown(self.grey), window)

    def read(self, plane, u, v):
        """Values at places (u, v) between pixels, of plane 0 (grey), 1 or 2 (its slopes); the padding's last beyond."""
        x = self.planes[plane]
        u, v = (np.clip(y + self.pad, 0, n - 1) for y, n in ((u, x.shape[1]), (v, x.shape[0])))
        i, j = np.floor(v).astype(int), np.floor(u).astype(int)
        a, b = v - i, u - j
        i2, j2 = np.minimum(i + 1, x.shape[0] - 1), np.minimum(j + 1, x.shape[1] - 1)
        top, bottom = (1 - b) * x[i, j] + b * x[i, j2], (1 - b) * x[i2, j] + b * x[i2, j2]
        return (1 - a) * top + a * bottom

    def window(self, plane, uv, window):
        """Values (window²,) around a place."""
        h = window // 2
        v, u = np.mgrid[-h : h + 1, -h : h + 1]
        return self.read(plane, uv[0] + u, uv[1] + v).ravel()


def levels(image, n, window):
    """Levels of one picture (1, H, W), finest first."""
    levels = [Level(image[0].double().numpy(), window)]
    while len(levels) < n:
        levels.append(levels[-1].half(window))
    return levels
