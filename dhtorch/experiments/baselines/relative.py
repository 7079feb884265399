"""Depth up to scale from learned two-view models, on the pixels of the network, and its values at our samples.

A network's input is a resized and cropped image, and its unit of depth is arbitrary. The map therefore has the affine
transform from image pixels to its pixels, and becomes an :class:`Estimate` only with a scale from another source.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pytree import Record, record
from dhtorch.records import Estimate, Frame

# Both networks come from the user's own installation with local weights; their code and weights have licences of their
# own and are no part of this package. A checkpoint of DUSt3R is run as code by its own loader: use files you trust.

#: Installation of the package.
_VGGT_HINT = "clone github.com/facebookresearch/vggt and pip install it"

#: Sides of the network's input are multiples of this, px.
_PATCH_PX = 14


class _PairNetwork:
    """A network of two views; a pair is computed alone."""

    def _sizes(self, height: int, width: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """Size to which an image is resized, and that of the crop around its centre."""
        raise NotImplementedError

    def _predict(self, view_0: Tensor, view_1: Tensor) -> tuple[Tensor, Tensor]:
        """Two inputs (1, 3, h, w) in [0, 1] → depth and confidence (1, h, w) in the first."""
        raise NotImplementedError

    def _check_weights(self, weights: str | Path) -> Path:
        if not Path(weights).exists():
            name = type(self).__name__
            raise FileNotFoundError(f"{weights}: found nothing, expected {name} weights, a file or a folder")
        return Path(weights)

    @torch.no_grad()
    def __call__(self, frame_0: Frame, frame_1: Frame) -> "RelativeDepth":
        """Depth of view 0 from B pairs; the frames' own depth is not used."""
        (view_0, gain, shift), (view_1, _, _) = (
            _resize_and_crop(f.image, *self._sizes(*f.hw)) for f in (frame_0, frame_1)
        )
        answers = [self._predict(*pair) for pair in zip(view_0.split(1), view_1.split(1), strict=True)]
        depth, confidence = (torch.cat(x).to(frame_0.camera.f) for x in zip(*answers, strict=True))
        return RelativeDepth(depth, confidence, *(x.to(depth).expand(len(view_0), 2) for x in (gain, shift)))


class VGGT(_PairNetwork):
    """Pairs of frames → :class:`RelativeDepth` of the first, one pair at a time.

    Images are resized to ``width`` and a multiple of 14 in height, which is cropped around the centre to at most
    ``width``, as VGGT's own loader does. The depth head of view 0 gives z-depth in that view's camera. On a GPU the
    trunk runs in bfloat16, as in the authors' examples; on a CPU in float32.

    Args:
        weights: a state dict (``model.pt``), or a folder as ``save_pretrained`` writes it.
        width: width of the input, px.
        device: device of the network.

    Raises:
        ImportError: VGGT is not importable.
        FileNotFoundError: no such weights; nothing is ever downloaded.
        ValueError: of the call, two views of different size.
    """

    def __init__(self, weights: str | Path, *, width: int = 518, device: str = "cpu") -> None:
        try:
            from vggt.models.vggt import VGGT as Network  # noqa: PLC0415  (optional)
        except ImportError as error:
            raise ImportError(f"VGGT cannot be imported ({error}): {_VGGT_HINT}") from error
        path = self._check_weights(weights)
        if path.is_dir():
            network = Network.from_pretrained(str(path))
        else:
            network = Network()
            network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        self.network: torch.nn.Module = network.to(device).eval()
        self.width, self.device = width, device

    def __call__(self, frame_0: Frame, frame_1: Frame) -> "RelativeDepth":
        """Depth of view 0 from B pairs of views of one size; the frames' own depth is not used."""
        if frame_0.hw != frame_1.hw:
            raise ValueError(f"VGGT: views of {frame_0.hw} and {frame_1.hw} pixels, expected the same size")
        return super().__call__(frame_0, frame_1)

    def _sizes(self, height: int, width: int) -> tuple[tuple[int, int], tuple[int, int]]:
        resized_height = max(round(height * self.width / width / _PATCH_PX), 1) * _PATCH_PX
        return (resized_height, self.width), (min(resized_height, self.width), self.width)

    def _predict(self, view_0: Tensor, view_1: Tensor) -> tuple[Tensor, Tensor]:
        device_type = torch.device(self.device).type
        with torch.autocast(device_type, dtype=torch.bfloat16, enabled=device_type == "cuda"):
            prediction = self.network(torch.cat((view_0, view_1)).to(self.device))
        return prediction["depth"][:, 0, ..., 0], prediction["depth_conf"][:, 0]


#: Installation of the package.
_INSTALL_HINT = (
    "clone github.com/naver/dust3r with its submodules, install its requirements, put the clone on PYTHONPATH"
)

#: Sides of the network's input are multiples of this, px.
_SIDE_MULTIPLE_PX = 16


class DUSt3R(_PairNetwork):
    """Pairs of frames → :class:`RelativeDepth` of the first, one pair at a time.

    Images are resized so that the longer side is ``size``, then cropped around the centre to multiples of 16, and
    square ones to 4:3, as DUSt3R's own loader does (which shrinks by Lanczos, this by antialiased bicubic). The
    network runs on (view 0, view 1) alone: its first head gives points in view 0's camera, of which z is the depth.

    Args:
        weights: a checkpoint file, or a folder as ``save_pretrained`` writes it.
        size: longer side of the input, px.
        device: device of the network.

    Raises:
        ImportError: DUSt3R is not importable.
        FileNotFoundError: no such weights; nothing is ever downloaded.
    """

    def __init__(self, weights: str | Path, *, size: int = 512, device: str = "cpu") -> None:
        try:
            from dust3r.inference import inference  # noqa: PLC0415  (optional)
            from dust3r.model import AsymmetricCroCo3DStereo  # noqa: PLC0415
        except ImportError as error:
            raise ImportError(f"DUSt3R cannot be imported ({error}): {_INSTALL_HINT}") from error
        path = self._check_weights(weights)
        # The file holds the options of its training run, which torch loads only with their class declared safe.
        with torch.serialization.safe_globals([argparse.Namespace]):
            network = AsymmetricCroCo3DStereo.from_pretrained(str(path))
        self.network: torch.nn.Module = network.to(device).eval()
        self.size, self.device, self._inference = size, device, inference

    def _sizes(self, height: int, width: int) -> tuple[tuple[int, int], tuple[int, int]]:
        scale = self.size / max(height, width)
        hw = (round(height * scale), round(width * scale))
        crop_h, crop_w = (side // _SIDE_MULTIPLE_PX * _SIDE_MULTIPLE_PX for side in hw)
        if hw[0] == hw[1]:
            crop_h = 3 * crop_w // 4 // _SIDE_MULTIPLE_PX * _SIDE_MULTIPLE_PX
        return hw, (crop_h, crop_w)

    def _predict(self, view_0: Tensor, view_1: Tensor) -> tuple[Tensor, Tensor]:
        pair = []
        for index, image in enumerate((view_0, view_1)):  # with colours in [-1, 1]
            shape = torch.tensor([list(image.shape[-2:])], dtype=torch.int32)
            pair.append({"img": 2 * image - 1, "true_shape": shape, "idx": index, "instance": str(index)})
        run: Any = self._inference
        prediction = run([tuple(pair)], self.network, self.device, batch_size=1, verbose=False)["pred1"]
        return prediction["pts3d"][..., 2], prediction["conf"]


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


def _resize_and_crop(image: Tensor, hw: tuple[int, int], crop_hw: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
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
