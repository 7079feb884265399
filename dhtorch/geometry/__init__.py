"""Batched geometry on torch tensors: value types beside their functions, without data formats or stages."""

from dhtorch.geometry import (
    camera,
    coarse_flow,
    epipolar,
    filters,
    least_squares,
    linalg,
    lucas_kanade,
    p3p,
    pose_averaging,
    pose_conventions,
    pyramid,
    ransac,
    se3,
    thin_lens,
)

__all__ = [
    "camera",
    "coarse_flow",
    "epipolar",
    "filters",
    "least_squares",
    "linalg",
    "lucas_kanade",
    "p3p",
    "pose_averaging",
    "pose_conventions",
    "pyramid",
    "ransac",
    "se3",
    "thin_lens",
]
