"""Depth up to scale from learned two-view models, on the pixels of the network, and its values at our samples.

A network's input is a resized and cropped image, and its unit of depth is arbitrary. The map therefore has the affine
transform from image pixels to its pixels, and becomes an :class:`Estimate` only with a scale from another source.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pytree import Record, record
from dhtorch.records import Estimate, Frame


@record
class RelativeDepth(Record):
    """Dense z-depth of view 0 in its own camera, up to one scale for each image."""

    depth: Tensor  # (B, h, w) in an arbitrary unit; not finite or not positive = none
    confidence: Tensor  # (B, h, w) at least 1, larger is more certain
    gain: Tensor  # (B, 2) network pixel (u, v) = gain · image pixel + shift
    shift: Tensor  # (B, 2)


class ConstantDepth:
    """Control: a "network" without weights that predicts the same depth everywhere.

    With an oracle's scale its error is that of the scale alone.
    """

    def __init__(self, *, device: str = "cpu") -> None:
        self.device = device

    def __call__(self, frame_0: Frame, _frame_1: Frame) -> RelativeDepth:
        """Depth 1 and confidence 2 at every pixel."""
        like = frame_0.camera.f
        ones = like.new_ones(like.shape[0], 1, 1)
        return RelativeDepth(ones, 2 * ones, torch.zeros_like(like), torch.zeros_like(like))


def resize_and_crop(image: Tensor, hw: tuple[int, int], crop_hw: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Image resized to ``hw`` and cropped to ``crop_hw`` around its centre, with the transform of its pixels.

    Args:
        image: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8.
        hw, crop_hw: (height, width) after resizing and after cropping.

    Returns:
        Image (B, 3, h, w) float32 in [0, 1], ``gain`` (2,) and ``shift`` (2,) of :class:`RelativeDepth`.

    Raises:
        ValueError: wrong shapes, or a crop larger than the image.
    """
    sizes = check("resize_and_crop", image=(image, "B C H W"))
    if crop_hw[0] > hw[0] or crop_hw[1] > hw[1]:
        raise ValueError(f"resize_and_crop: crop is {crop_hw[0]}x{crop_hw[1]}, expected at most {hw[0]}x{hw[1]}")
    x = (image / 255 if image.dtype == torch.uint8 else image).float().expand(-1, 3, -1, -1)
    x = torch.nn.functional.interpolate(x, hw, mode="bicubic", antialias=True, align_corners=False).clamp(0, 1)
    top, left = (hw[0] - crop_hw[0]) // 2, (hw[1] - crop_hw[1]) // 2
    gain = torch.tensor([hw[1] / sizes["W"], hw[0] / sizes["H"]], device=x.device)
    shift = gain / 2 - 0.5 - torch.tensor([left, top], device=x.device)
    return x[..., top : top + crop_hw[0], left : left + crop_hw[1]], gain, shift


def sample_relative_depth(relative: RelativeDepth, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (B, N), NaN where there is none, and confidence (B, N) at image pixels ``uv`` (B, N, 2).

    The nearest network pixel is read, so values are never mixed across an edge.
    """
    check("sample_relative_depth", depth=(relative.depth, "B h w"), uv=(uv, "B N 2"), gain=(relative.gain, "B 2"))
    network_uv = uv * relative.gain[:, None].to(uv) + relative.shift[:, None].to(uv)
    depth, inside = sample_nearest(relative.depth.to(uv), network_uv)
    confidence, _ = sample_nearest(relative.confidence.to(uv), network_uv)
    valid = inside & depth.isfinite() & (depth > 0)
    return torch.where(valid, depth, torch.nan), torch.where(valid, confidence, torch.ones_like(confidence))


def to_estimate(relative: RelativeDepth, uv: Tensor, scale: Tensor) -> Estimate:
    """Relative depth at our samples, scaled to metres → estimate.

    Args:
        relative: relative depth of B pairs.
        uv: (B, N, 2) px, the samples.
        scale: (B,) metres per unit of the network; NaN where there is none.

    Returns:
        Estimate. ``score`` is 1 − 1 / confidence, for a confidence of 1 + exp(x) the logistic function of x. The
        networks have no noise model and no geometry: ``sigma``, ``parallax_deg`` and ``residual_px`` are NaN. Gates:
        NO_POSE without a scale, NO_TRACK where the network has no depth (cropped away, not positive).
    """
    check("to_estimate", uv=(uv, "B N 2"), scale=(scale, "B"))
    depth, confidence = sample_relative_depth(relative, uv)
    depth = depth * scale[:, None].to(depth)
    gate = torch.where(depth.isfinite(), Gate.ANSWER, Gate.NO_TRACK)
    gate = torch.where(scale.isfinite()[:, None], gate, Gate.NO_POSE).to(torch.int32)
    nan = torch.full_like(depth, torch.nan)
    return Estimate(
        uv=uv,
        depth=depth,
        sigma=nan,
        sigma_shared=nan,
        parallax_deg=nan,
        residual_px=nan,
        n_views=torch.full_like(gate, 2),
        score=torch.where(gate == Gate.ANSWER, 1 - 1 / confidence.clamp_min(1), torch.zeros_like(depth)),
        gate=gate,
    )
