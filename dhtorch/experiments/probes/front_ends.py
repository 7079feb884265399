"""What a probe is given of a picture: downsampled pixels, pooled depth tokens, or pooled patch tokens of a network.

Every front end turns frames into one row of numbers each, of fixed length and finite, whatever the frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines import dinov2, xfeat
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import check
from dhtorch.pipeline.method import Method
from dhtorch.records import NO_HINT, Frame, TrackHint
from dhtorch.transforms import TOKEN_CHANNELS, ExtendDepth, token_grid

#: Channels of a depth token that say something only where the patch has an answer.
_ANSWER_CHANNELS = ("inverse_depth", "sigma")

#: Pictures that a network is given at once.
_MAX_IMAGES_PER_CALL = 8


class FrontEnd(Protocol):
    """A frame, and another one where there are two views, → features (1, F) float32."""

    def __call__(self, frame: Frame, other: Frame | None = None) -> Tensor:
        """Features of ``frame``."""
        ...


def resize_to_square(frame: Frame, other: Frame | None = None, *, side: int = 16) -> Tensor:
    """The picture shrunk to ``side`` × ``side`` by area, three channels in [0, 1]."""
    image = frame.image / 255 if frame.image.dtype == torch.uint8 else frame.image
    small = torch.nn.functional.adaptive_avg_pool2d(image.float(), side)
    return small.expand(-1, 3, -1, -1).flatten(1)


def pool_tokens(tokens: Tensor, valid: Tensor, patches: tuple[int, int], cells: int) -> Tensor:
    """Depth tokens of a patch grid → ``cells`` × ``cells`` larger cells, (B, cells² · C).

    Shares are averaged over the patches of a cell; what speaks of answers (inverse depth, sigma) over the patches that
    have one, 0 where none has.

    Args:
        tokens: (B, P, C) of :data:`dhtorch.transforms.TOKEN_CHANNELS`.
        valid: (B, P).
        patches: rows and columns, P in all.
        cells: cells a side.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the tokens.
    """
    check("pool_tokens", tokens=(tokens, f"B P {len(TOKEN_CHANNELS)}"), valid=(valid, "B P"))
    if patches[0] * patches[1] != tokens.shape[1]:
        raise ValueError(f"pool_tokens: found {tokens.shape[1]} tokens, expected {patches[0]} x {patches[1]}")
    of_answers = torch.tensor([name in _ANSWER_CHANNELS for name in TOKEN_CHANNELS], device=tokens.device)
    use = torch.where(of_answers, valid[..., None], True).to(tokens)

    def mean(x: Tensor) -> Tensor:
        return torch.nn.functional.adaptive_avg_pool2d(x.mT.unflatten(-1, patches), cells)

    return (mean(tokens * use) / mean(use).clamp_min(1e-6)).flatten(1)


class DepthTokens:
    """Depth tokens of :class:`dhtorch.transforms.ExtendDepth`, pooled; with ``views=1`` of the front end alone."""

    def __init__(
        self,
        method: Method,
        *,
        views: int = 2,
        cells: int = 4,
        side: int = 224,
        patch: int = 14,
        seed: int = 0,
        hint: TrackHint = NO_HINT,
        sparse: bool = False,
    ) -> None:
        self.views, self.cells = views, cells
        self.patches = token_grid((side, side), patch=patch)
        self._extended = partial(
            ExtendDepth,
            method=method,
            patch=patch,
            tokens_hw=(side, side),
            seed=seed,
            hint=hint,
            sparse=sparse,
            depth_unit="m",
            distortion="distortion",
        )

    def __call__(self, frame: Frame, other: Frame | None = None) -> Tensor:
        """Features (1, cells² · 10)."""
        return self.features_and_keys(frame, other)[0]

    def features_and_keys(self, frame: Frame, other: Frame | None = None) -> tuple[Tensor, Mapping[str, Any]]:
        """Features, and all that the transform added."""
        frames = [frame] if other is None or self.views == 1 else [other, frame]
        sample = _as_sample(frames)
        given: dict[str, Any] = {k: k for k in ("depth_intrinsics", "confidence") if k in sample}
        transform = self._extended(**given)
        added = {k.removeprefix(transform.prefix): v for k, v in (transform(sample) or {}).items()}
        features = pool_tokens(added["tokens"][None], added["tokens_valid"][None], self.patches, self.cells)
        return features.float(), added


class PatchTokens:
    """DINOv2: its class token, and its patch tokens averaged over ``cells`` × ``cells`` parts of the picture."""

    def __init__(self, network: torch.nn.Module, *, cells: int = 1, side: int = 224) -> None:
        self.network, self.cells, self.side = network, cells, side

    def __call__(self, frame: Frame, other: Frame | None = None) -> Tensor:
        """Features (1, (1 + cells²) · hidden)."""
        return self.many([frame])

    @torch.no_grad()
    def many(self, frames: list[Frame]) -> Tensor:
        """Features (len(frames), (1 + cells²) · hidden)."""
        found = []
        for k in range(0, len(frames), _MAX_IMAGES_PER_CALL):
            image = torch.cat(
                [dinov2.preprocess_image(f.image, self.side) for f in frames[k : k + _MAX_IMAGES_PER_CALL]]
            )
            hidden = self.network(pixel_values=image.float()).last_hidden_state
            across = round((hidden.shape[1] - 1) ** 0.5)
            patches = hidden[:, 1:].mT.unflatten(-1, (across, across))
            coarse = torch.nn.functional.adaptive_avg_pool2d(patches, self.cells)
            found.append(torch.cat((hidden[:, 0], coarse.flatten(1)), 1))
        return torch.cat(found).float()


class DenseFeatures:
    """XFeat: its descriptors of unit length, averaged over ``cells`` × ``cells`` parts of the picture."""

    def __init__(self, network: torch.nn.Module, *, cells: int = 2, longest_px: int = 640) -> None:
        self.network, self.cells, self.longest_px = network, cells, longest_px

    @torch.no_grad()
    def __call__(self, frame: Frame, other: Frame | None = None) -> Tensor:
        """Features (1, cells² · 64)."""
        (found,) = xfeat.extract_xfeat(self.network, frame.image, scale=1.0, longest_px=self.longest_px)
        return torch.nn.functional.adaptive_avg_pool2d(found.D[None], self.cells).flatten(1).float()


def load_visual_front_end(
    build: Callable[..., torch.nn.Module] | None, *, cells: int, device: str
) -> tuple[PatchTokens | None, bool]:
    """The DINOv2 front end that the settings ask for, and whether its weights are real; None where left out.

    Args:
        build: such as a partial of :func:`dhtorch.experiments.baselines.dinov2.load_dinov2`; None = leave it out.
        cells, device: of the front end.

    Raises:
        ImportError: ``transformers`` is missing; the message says what to install.
    """
    if build is None:
        return None, False
    options = getattr(build, "keywords", {})
    network = build().to(device)
    return PatchTokens(network, cells=cells, side=options.get("side", 224)), options.get("weights") is not None


def load_network_front_ends(
    dinov2: Callable[..., torch.nn.Module] | None, *, cells: int, xfeat_too: bool, device: str
) -> tuple[dict[str, FrontEnd], bool]:
    """The front ends of networks by the name of their block, and whether DINOv2's weights are real.

    Args:
        dinov2, cells, device: as :func:`load_visual_front_end` takes them.
        xfeat_too: XFeat as well, with the weights of its package.

    Raises:
        ImportError: a network's package is missing; the message says what to install.
    """
    network, real = load_visual_front_end(dinov2, cells=cells, device=device)
    found: dict[str, FrontEnd] = {} if network is None else {"dinov2": network}
    return found | ({"xfeat": DenseFeatures(xfeat.load_xfeat(device))} if xfeat_too else {}), real


def depth_tokens_for_scene(method: Method, scene: Scene, **options: Any) -> DepthTokens:
    """Depth tokens of a method with what a scene asks for."""
    return DepthTokens(method, hint=scene.hint, sparse=scene.recording.sparse, **options)


def _as_sample(frames: list[Frame]) -> dict[str, Tensor]:
    """Frames along time as the dict of one sample; their cameras are one."""
    last = frames[-1]
    sample = {
        "image": torch.cat([f.image for f in frames]),
        "depth": torch.cat([f.depth for f in frames]),
        "intrinsics": cam.to_matrix(last.camera)[0],
        "distortion": _lens(last),
    }
    if last.depth_camera is not None:
        sample["depth_intrinsics"] = cam.to_matrix(last.depth_camera)[0]
    if all(f.conf is not None for f in frames):
        sample["confidence"] = torch.cat([f.conf for f in frames if f.conf is not None])
    return sample


def _lens(frame: Frame) -> Tensor:
    lens = frame.camera.distortion
    return frame.camera.f.new_zeros(5) if lens is None else lens[0]
