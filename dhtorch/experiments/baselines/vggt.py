"""VGGT as a source of depth up to scale: the user's own installation of ``facebookresearch/vggt`` and local weights.

Code and weights have licences of their own (the first weights: non-commercial) and are no part of this package.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dhtorch.experiments.baselines.relative import RelativeDepth, resize_and_crop
from dhtorch.records import Frame

#: Installation of the package.
_INSTALL_HINT = "clone github.com/facebookresearch/vggt and pip install it"

#: Sides of the network's input are multiples of this, px.
_PATCH_PX = 14


class VGGT:
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
    """

    def __init__(self, weights: str | Path, *, width: int = 518, device: str = "cpu") -> None:
        try:
            from vggt.models.vggt import VGGT as Network  # noqa: PLC0415  (optional)
        except ImportError as error:
            raise ImportError(f"VGGT cannot be imported ({error}): {_INSTALL_HINT}") from error
        path = Path(weights)
        if not path.exists():
            raise FileNotFoundError(f"{weights}: found nothing, expected VGGT weights, a file or a folder")
        if path.is_dir():
            network = Network.from_pretrained(str(path))
        else:
            network = Network()
            network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        self.network: torch.nn.Module = network.to(device).eval()
        self.width, self.device = width, device

    def __call__(self, frame_0: Frame, frame_1: Frame) -> RelativeDepth:
        """Depth of view 0 from B pairs; the frames' own depth is not used.

        Raises:
            ValueError: the two views are of different size.
        """
        if frame_0.hw != frame_1.hw:
            raise ValueError(f"VGGT: views of {frame_0.hw} and {frame_1.hw} pixels, expected the same size")
        view_0, gain, shift = self._fit(frame_0.image)
        view_1, _, _ = self._fit(frame_1.image)
        depth, confidence = [], []
        device_type = torch.device(self.device).type
        for pair in torch.stack((view_0, view_1), 1).to(self.device):
            with torch.no_grad(), torch.autocast(device_type, dtype=torch.bfloat16, enabled=device_type == "cuda"):
                prediction = self.network(pair)
            depth.append(prediction["depth"][:, 0, ..., 0])
            confidence.append(prediction["depth_conf"][:, 0])
        like = frame_0.camera.f
        return RelativeDepth(
            depth=torch.cat(depth).to(like),
            confidence=torch.cat(confidence).to(like),
            gain=gain.to(like).expand(view_0.shape[0], 2),
            shift=shift.to(like).expand(view_0.shape[0], 2),
        )

    def _fit(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        height, width = image.shape[-2:]
        resized_height = max(round(height * self.width / width / _PATCH_PX), 1) * _PATCH_PX
        return resize_and_crop(image, (resized_height, self.width), (min(resized_height, self.width), self.width))
