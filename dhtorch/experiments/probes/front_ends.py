"""Front ends of the probes: B frames -> B feature vectors, from downsampled pixels, pooled depth tokens or a network.

Every front end computes feature vectors of a fixed length with finite values, whatever the frames; a frame's features
do not depend on the others of its batch. The frames of a batch have images of one size.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.data import default_collate

from dhtorch.experiments.baselines import dinov2, efficientnet, xfeat
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import check
from dhtorch.pipeline.method import Method
from dhtorch.records import NO_HINT, Frame, TrackHint
from dhtorch.transforms import TOKEN_CHANNELS, ExtendDepth, token_grid

#: Channels of a depth token that are defined only where the patch has a depth.
_ANSWER_CHANNELS = ("inverse_depth", "sigma")


class FrontEnd(Protocol):
    """Protocol of a front end: B frames and, with two views, a second one for each -> features (B, F) float32."""

    def __call__(self, frames: Sequence[Frame], others: Sequence[Frame] | None = None) -> Tensor:
        """Features of ``frames``."""
        ...


def resize_to_square(frames: Sequence[Frame], others: Sequence[Frame] | None = None, *, side: int = 16) -> Tensor:
    """Images averaged over areas to ``side`` × ``side`` pixels, three channels in [0, 1], flattened: (B, 3 · side²)."""
    image = torch.cat([frame.image for frame in frames])
    image = image / 255 if image.dtype == torch.uint8 else image
    small = torch.nn.functional.adaptive_avg_pool2d(image.float(), side)
    return small.expand(-1, 3, -1, -1).flatten(1)


def pool_tokens(tokens: Tensor, valid: Tensor, patches: tuple[int, int], cells: int) -> Tensor:
    """Depth tokens of a patch grid, averaged over ``cells`` × ``cells`` larger cells: (B, cells² · C).

    Fractions are averaged over all patches of a cell; inverse depth and sigma over the patches with a depth, 0 if none
    has one.

    Args:
        tokens: (B, P, C) of :data:`dhtorch.transforms.TOKEN_CHANNELS`.
        valid: (B, P).
        patches: rows and columns, P in all.
        cells: cells per side.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the tokens.
    """
    check("pool_tokens", tokens=(tokens, f"B P {len(TOKEN_CHANNELS)}"), valid=(valid, "B P"))
    if patches[0] * patches[1] != tokens.shape[1]:
        raise ValueError(f"pool_tokens: found {tokens.shape[1]} tokens, expected {patches[0]} x {patches[1]}")
    needs_depth = torch.tensor([name in _ANSWER_CHANNELS for name in TOKEN_CHANNELS], device=tokens.device)
    weight = torch.where(needs_depth, valid[..., None], True).to(tokens)

    def mean(x: Tensor) -> Tensor:
        return torch.nn.functional.adaptive_avg_pool2d(x.mT.unflatten(-1, patches), cells)

    return (mean(tokens * weight) / mean(weight).clamp_min(1e-6)).flatten(1)


def pool_depth_maps(frames: Sequence[Frame], others: Sequence[Frame] | None = None, *, cells: int = 4) -> Tensor:
    """Depth maps of frames as they are -> mean inverse depth (1/m) and share of answered pixels: (B, 2 · cells²).

    Of ``cells`` × ``cells`` parts of the map; inverse depth is 0 where no pixel of a part has a depth.
    """
    depth = torch.cat([frame.depth for frame in frames])
    answered = depth > 0
    inverse = torch.where(answered, depth, torch.inf).reciprocal()
    share, total = (
        torch.nn.functional.adaptive_avg_pool2d(x.float()[:, None], cells).flatten(1) for x in (answered, inverse)
    )
    return torch.cat((total / share.clamp_min(1e-6), share), 1)


class DepthTokens:
    """Pooled depth tokens of :class:`dhtorch.transforms.ExtendDepth`; ``views=1``: without a second view."""

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
        self._make_transform = partial(
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

    def __call__(self, frames: Sequence[Frame], others: Sequence[Frame] | None = None) -> Tensor:
        """Features (B, cells² · 10)."""
        return self.features_and_keys(frames, others)[0]

    def features_and_keys(
        self, frames: Sequence[Frame], others: Sequence[Frame] | None = None
    ) -> tuple[Tensor, Mapping[str, Any]]:
        """Features (B, cells² · 10), and the entries that the transform added, without its prefix."""
        alone = others is None or self.views == 1
        views = [[f] for f in frames] if alone else [[o, f] for f, o in zip(frames, others or (), strict=True)]
        batch = default_collate([_as_sample(v) for v in views])
        optional_keys: dict[str, Any] = {k: k for k in ("depth_intrinsics", "confidence") if k in batch}
        transform = self._make_transform(batched=True, **optional_keys)
        added = {k.removeprefix(transform.prefix): v for k, v in (transform(batch) or {}).items()}
        return pool_tokens(added["tokens"], added["tokens_valid"], self.patches, self.cells).float(), added


@torch.no_grad()
def patch_tokens(
    network: torch.nn.Module,
    frames: Sequence[Frame],
    others: Sequence[Frame] | None = None,
    *,
    cells: int = 1,
    side: int = 224,
) -> Tensor:
    """DINOv2 features (B, (1 + cells²) · hidden), by one forward pass: class token, and patch tokens averaged over
    ``cells`` × ``cells`` parts of the image."""
    image = dinov2.preprocess_image(torch.cat([f.image for f in frames]), side)
    tokens = network(pixel_values=image.float()).last_hidden_state
    patches = tokens[:, 1 + dinov2.register_count(network) :]
    n = round(patches.shape[1] ** 0.5)
    coarse = torch.nn.functional.adaptive_avg_pool2d(patches.mT.unflatten(-1, (n, n)), cells)
    return torch.cat((tokens[:, 0], coarse.flatten(1)), 1).float()


@torch.no_grad()
def _dense_features(
    network: torch.nn.Module,
    frames: Sequence[Frame],
    others: Sequence[Frame] | None = None,
    *,
    cells: int = 2,
    longest_px: int = 640,
) -> Tensor:
    """XFeat features (B, cells² · 64): unit-length descriptors averaged over ``cells`` × ``cells`` parts of images."""
    features = xfeat.extract_xfeat(network, torch.cat([f.image for f in frames]), scale=1.0, longest_px=longest_px)
    return torch.stack([torch.nn.functional.adaptive_avg_pool2d(f.D, cells).flatten() for f in features]).float()


def load_network_front_ends(
    build: Callable[..., torch.nn.Module] | None,
    *,
    cells: int,
    device: str,
    xfeat_too: bool = False,
    efficientnet_too: bool = False,
) -> tuple[dict[str, FrontEnd], str | None]:
    """Network front ends by the name of their block, and the origin of DINOv2's weights; None = random weights.

    Args:
        build: such as a partial of :func:`dhtorch.experiments.baselines.dinov2.load_dinov2`; None = leave it out.
        cells, device: of the front ends.
        xfeat_too, efficientnet_too: also load XFeat, EfficientNet-Lite0, with the weights of their packages.

    Raises:
        ImportError: a network's package is missing; the message says what to install.
        FormatError: the weights are not those of one DINOv2 network.
    """
    front_ends: dict[str, FrontEnd] = {}
    origin, options = None, getattr(build, "keywords", {})
    if build is not None:
        network = build().to(device)
        front_ends["dinov2"] = partial(patch_tokens, network, cells=cells, side=options.get("side", 224))
        origin = None if options.get("weights") is None else dinov2.describe_weights(network)
    if xfeat_too:
        front_ends["xfeat"] = partial(_dense_features, xfeat.load_xfeat(device).net)
    if efficientnet_too:
        network = efficientnet.load_efficientnet(device)
        front_ends["efficientnet"] = partial(efficientnet.map_features, network, cells=cells)
    return front_ends, origin


def _as_sample(frames: Sequence[Frame]) -> dict[str, Tensor]:
    """Frames in order of time as one sample dictionary; all have the camera of the last frame."""
    last = frames[-1]
    sample = {
        "image": torch.cat([f.image for f in frames]),
        "depth": torch.cat([f.depth for f in frames]),
        "intrinsics": cam.to_matrix(last.camera)[0],
        "distortion": last.camera.f.new_zeros(5) if last.camera.distortion is None else last.camera.distortion[0],
    }
    if last.depth_camera is not None:
        sample["depth_intrinsics"] = cam.to_matrix(last.depth_camera)[0]
    if all(f.conf is not None for f in frames):
        sample["confidence"] = torch.cat([f.conf for f in frames if f.conf is not None])
    return sample
