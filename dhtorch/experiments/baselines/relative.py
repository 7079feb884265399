"""Depth up to scale on a network's own pixels: what learned two-view models give, and how our samples read it.

A network sees a resized and cropped picture and answers in a unit of its own. So its map carries the way from image
pixels to its pixels, and becomes an :class:`Estimate` only with a scale from elsewhere.
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
    """Dense z-depth of view 0 in its own camera, up to one scale for each picture."""

    depth: Tensor  # (B, h, w) in a unit of its own; not finite or not positive = none
    confidence: Tensor  # (B, h, w) at least 1, larger is surer
    gain: Tensor  # (B, 2) network pixel (u, v) = gain · image pixel + shift
    shift: Tensor  # (B, 2)


class ConstantDepth:
    """The control: a "network" without weights that says the same depth everywhere.

    With an oracle's scale it shows what the oracle alone is worth on a scene.
    """

    def __init__(self, *, device: str = "cpu") -> None:
        self.device = device

    def __call__(self, frame_0: Frame, _frame_1: Frame) -> RelativeDepth:
        """One for every pixel, all equally sure."""
        like = frame_0.camera.f
        one = like.new_ones(like.shape[0], 1, 1)
        return RelativeDepth(one, 2 * one, torch.zeros_like(like), torch.zeros_like(like))


def resize_and_crop(image: Tensor, hw: tuple[int, int], crop_hw: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """The picture resized to ``hw`` and cropped to ``crop_hw`` around its centre, with the way there.

    Args:
        image: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8.
        hw, crop_hw: (height, width) after resizing and after cropping.

    Returns:
        Picture (B, 3, h, w) float32 in [0, 1], ``gain`` (2,) and ``shift`` (2,) of :class:`RelativeDepth`.

    Raises:
        ValueError: wrong shapes, or a crop larger than the picture.
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
    place = uv * relative.gain[:, None].to(uv) + relative.shift[:, None].to(uv)
    depth, inside = sample_nearest(relative.depth.to(uv), place)
    confidence, _ = sample_nearest(relative.confidence.to(uv), place)
    known = inside & depth.isfinite() & (depth > 0)
    return torch.where(known, depth, torch.nan), torch.where(known, confidence, torch.ones_like(confidence))


def to_estimate(relative: RelativeDepth, uv: Tensor, scale: Tensor) -> Estimate:
    """The map at our samples, in metres.

    Args:
        relative: of B pairs.
        uv: (B, N, 2) px, the samples.
        scale: (B,) metres per unit of the network; NaN where it is not known.

    Returns:
        Estimate. ``score`` is 1 − 1 / confidence, for a confidence of 1 + exp(x) the logistic function of x. Such a
        model states no noise and no geometry: ``sigma``, ``parallax_deg`` and ``residual_px`` are NaN. Gates: NO_POSE
        without a scale, NO_TRACK where the network has no depth (cut away, not positive).
    """
    check("to_estimate", uv=(uv, "B N 2"), scale=(scale, "B"))
    depth, confidence = sample_relative_depth(relative, uv)
    depth = depth * scale[:, None].to(depth)
    gate = torch.where(depth.isfinite(), Gate.ANSWER, Gate.NO_TRACK)
    gate = torch.where(scale.isfinite()[:, None], gate, Gate.NO_POSE).to(torch.int32)
    silent = torch.full_like(depth, torch.nan)
    return Estimate(
        uv=uv,
        depth=depth,
        sigma=silent,
        sigma_shared=silent,
        parallax_deg=silent,
        residual_px=silent,
        n_views=torch.full_like(gate, 2),
        score=torch.where(gate == Gate.ANSWER, 1 - 1 / confidence.clamp_min(1), torch.zeros_like(depth)),
        gate=gate,
    )
