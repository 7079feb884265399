"""DUSt3R as a source of depth up to scale: the user's own checkout of ``naver/dust3r`` and local weights.

The code and the weights are for non-commercial use and are no part of this package. A checkpoint file is run as code
by DUSt3R's own loader: use files you trust.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.experiments.baselines.relative import RelativeDepth, resize_and_crop
from dhtorch.records import Frame

#: Installation of the package.
_INSTALL_HINT = (
    "clone github.com/naver/dust3r with its submodules, install its requirements, put the clone on PYTHONPATH"
)

#: Sides of the network's input are multiples of this, px.
_SIDE_MULTIPLE_PX = 16


class DUSt3R:
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
        if not Path(weights).exists():
            raise FileNotFoundError(f"{weights}: found nothing, expected DUSt3R weights, a file or a folder")
        # The file holds the options of its training run, which torch loads only with their class declared safe.
        with torch.serialization.safe_globals([argparse.Namespace]):
            network = AsymmetricCroCo3DStereo.from_pretrained(str(weights))
        self.network: torch.nn.Module = network.to(device).eval()
        self.size, self.device, self._inference = size, device, inference

    def __call__(self, frame_0: Frame, frame_1: Frame) -> RelativeDepth:
        """Depth of view 0 from B pairs; the frames' own depth is not used."""
        view_0, gain, shift = self._fit(frame_0.image)
        view_1, _, _ = self._fit(frame_1.image)
        depth, confidence = [], []
        for b in range(view_0.shape[0]):
            pair = (_view(view_0[b : b + 1], 0), _view(view_1[b : b + 1], 1))
            prediction: Any = self._inference([pair], self.network, self.device, batch_size=1, verbose=False)["pred1"]
            depth.append(prediction["pts3d"][..., 2])
            confidence.append(prediction["conf"])
        like = frame_0.camera.f
        return RelativeDepth(
            depth=torch.cat(depth).to(like),
            confidence=torch.cat(confidence).to(like),
            gain=gain.to(like).expand(view_0.shape[0], 2),
            shift=shift.to(like).expand(view_0.shape[0], 2),
        )

    def _fit(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        height, width = image.shape[-2:]
        scale = self.size / max(height, width)
        hw = (round(height * scale), round(width * scale))
        crop_h, crop_w = (side // _SIDE_MULTIPLE_PX * _SIDE_MULTIPLE_PX for side in hw)
        if hw[0] == hw[1]:
            crop_h = 3 * crop_w // 4 // _SIDE_MULTIPLE_PX * _SIDE_MULTIPLE_PX
        return resize_and_crop(image, hw, (crop_h, crop_w))


def _view(image: Tensor, index: int) -> dict[str, Any]:
    """Image (1, 3, h, w) in [0, 1] → input view of DUSt3R, with colours in [-1, 1]."""
    shape = torch.tensor([list(image.shape[-2:])], dtype=torch.int32)
    return {"img": 2 * image - 1, "true_shape": shape, "idx": index, "instance": str(index)}
