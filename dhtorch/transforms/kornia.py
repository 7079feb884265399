"""kornia's augmentations on samples: pictures changed by kornia; depth, intrinsics and poses moved with them.

kornia's containers pass pictures, masks and boxes to their children, but no depth map and no camera.
:class:`AugmentSample` runs the children of a container on a whole sample, :class:`dhtorch.transforms.ExtendDepth` among
them.

Alphabet: ``A`` (B, 3, 3) takes a pixel of the picture to its pixel in the augmented one (kornia's
``transform_matrix``); ``Q`` (B, 3, 3) takes a point of the camera's axes to the new axes (see
:func:`dhtorch.geometry.camera.warp`); ``W`` (B, 3, 3) is the mirror of the world where Q mirrors, else the identity.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from kornia.augmentation import IntensityAugmentationBase2D, RigidAffineAugmentationBase2D
from kornia.augmentation.container import AugmentationSequential, ImageSequential, PatchSequential, VideoSequential
from kornia.augmentation.container.ops import InputSequentialOps
from kornia.augmentation.container.params import ParamItem
from kornia.constants import DataKey
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry.pose_conventions import STATED_AXES
from dhtorch.records import Camera
from dhtorch.transforms.extend_depth import ExtendDepth
from dhtorch.transforms.sample_access import (
    SampleError,
    SampleReader,
    get_value,
    intrinsic_rows,
    is_kornia_camera,
    replace_values,
    to_tensor,
)
from dhtorch.transforms.sample_spec import SampleSpec
from dhtorch.transforms.validate_depth import ValidateDepth

#: Options for the keys of a pair of kornia's LoFTR (``kornia.feature.loftr.utils.supervision``).
PAIR_KEYS = {
    "image": "image0",
    "depth": "depth0",
    "intrinsics": "K0",
    "other_image": "image1",
    "other_intrinsics": "K1",
    "pose": "T_0to1",
    "pose_kind": "1_from_0",
}

#: Limits shear as |q qᵀ − 1|, and perspective as a fraction of a pixel's distance from the corner, without unit: focal
#: lengths are written with three digits; rounding of kornia's matrices is far below.
_MAX_SHEAR = 2e-3

#: What a camera without skew sees as another camera: for messages.
_MOVES = "flips, crops, resizes, and rotations of square pixels"

#: Packages of kornia whose plain modules change colours or blur, and leave pixels where they are.
_COLOUR_PACKAGES = ("kornia.color.", "kornia.enhance.", "kornia.filters.")

#: Transforms that take a whole sample.
_SAMPLE_TRANSFORMS = (ExtendDepth, ValidateDepth)


class AugmentSample(torch.nn.Module):
    """Sample dict → augmented sample: pictures by kornia, depth, confidence, intrinsics and poses moved with them.

    Flips, crops, resizes, pads and rotations (by any angle where pixels are square) are read from kornia's
    ``transform_matrix``. Depth and confidence maps take the value of the nearest pixel; holes stay holes, and pixels
    from outside become holes. Colours and blur leave geometry alone. All views and frames of a sample are augmented
    with the same parameters, and each sample of a batch with its own. Masks, boxes and keypoints that
    ``AugmentationSequential(..., data_keys=None)`` recognises by their keys are moved by kornia.

    A mirrored picture is that of the mirrored scene: focal lengths stay positive, and the camera's axes are mirrored.
    Poses follow: between cameras Q T Q⁻¹, a rotation again; of cameras in a world W T Q⁻¹, whose world has its x
    mirrored. Mirror all views of a pair, or none: as here.

    Args:
        augmentation: an augmentation of kornia, ``ImageSequential`` or ``AugmentationSequential``, nested or not.
            Among its children may be transforms of whole samples, ``ExtendDepth`` and ``ValidateDepth``, behind all
            that moves pixels.
        batched: samples are collated batches.
        **views: keys, layouts and units, see :class:`dhtorch.transforms.SampleSpec`; none = those of the first such
            transform among the children, and its ``batched``. Intrinsics, distortion and poses must be keys of the
            sample, since they change.

    Returns:
        A new dict; images become float in [0, 1] (as far as kornia keeps them there) in their own layout, other values
        keep type and layout. ``transform_matrix`` (B, 3, 3) of the module is the A of the last call.

    Raises:
        ValueError: constants instead of keys; a child that moves pixels without a matrix, or is none of kornia's.
        SampleError: a bad sample; a shear or a perspective, which no camera without skew sees; pixels that move behind
            ``ExtendDepth``; views of several sizes that move.

    Gradient: to images, floating depth and intrinsics, as far as kornia's.
    """

    def __init__(self, augmentation: torch.nn.Module, *, batched: bool | None = None, **views: Any) -> None:
        super().__init__()
        self.container = augmentation if isinstance(augmentation, ImageSequential) else ImageSequential(augmentation)
        _check_children(self.container)
        inside = [module for module in augmentation.modules() if isinstance(module, _SAMPLE_TRANSFORMS)]
        if not views and not inside:
            raise ValueError("AugmentSample: found no views, expected the options of SampleSpec, or ExtendDepth inside")
        self.views = SampleSpec(**views) if views else inside[0].views
        self.batched = bool(inside[0].batched if batched is None and inside else batched)
        for name in ("intrinsics", "distortion", "depth_intrinsics", "other_intrinsics", "pose"):
            value = getattr(self.views, name)
            if value is not None and not isinstance(value, str):
                raise ValueError(
                    f"{name}: found numbers, expected a key of the sample, whose values move with its pictures"
                )
        if self.views.intrinsics_hw is not None:
            raise ValueError(
                "intrinsics_hw: found a size, expected None: moved intrinsics belong to the augmented pictures"
            )
        self.transform_matrix: Tensor | None = None

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Sample or batch → augmented copy."""
        state = _Augmented(sample, self.views, self.batched)
        params = self.container.forward_parameters(state.pictures[self.views.image][:, 0].shape)
        self._run(self.container, params, state)
        self.transform_matrix = state.A
        sample = state.write()
        # Masks, boxes, keypoints and other images are moved by kornia, with the same parameters.
        container = self.container
        if not isinstance(container, AugmentationSequential) or container.data_keys is not None:
            return sample
        own = {*self.views.keys(), self.views.metric_depth_key}
        names = tuple(k for k, x in sample.items() if k not in own and isinstance(x, Tensor | np.ndarray))
        unknown = container._read_datakeys_from_dict(names)[1] or ()
        others = {key: to_tensor(sample[key], key) for key in names if key not in unknown}
        if not others:
            return sample
        others = others if self.batched else {key: x[None] for key, x in others.items()}
        ours = [p for p in params if not isinstance(container.get_submodule(p.name), _SAMPLE_TRANSFORMS)]
        moved = container(others, params=ours)
        return sample | (moved if self.batched else {key: x[0] for key, x in moved.items()})

    def _run(self, container: ImageSequential, params: list[ParamItem], state: "_Augmented") -> None:
        """Run the children of a container that its parameters name, in their order."""
        for param in params:
            module = container.get_submodule(param.name)
            if isinstance(module, ImageSequential):
                self._run(module, param.data, state)  # type: ignore[arg-type]
            elif isinstance(module, _SAMPLE_TRANSFORMS):
                state.extend(module)
            else:
                extra = getattr(container, "extra_args", {}).get(DataKey.INPUT, {})
                state.apply(module, param, extra)


class _Augmented:
    """A sample under way: its pictures as augmented so far, and the matrix by which its other values must yet move."""

    def __init__(self, sample: Mapping[str, Any], views: SampleSpec, batched: bool) -> None:
        self.sample, self.views, self.batched = dict(sample), views, batched
        self.has_answers = False
        reader = self._reader()
        keys = [views.image] + ([] if views.other_image is None else [views.other_image])
        images = {key: reader.images(key, views.layout) for key in keys}  # (B, T, C, H, W)
        self.pictures = {k: x.to(reader.dtype) / 255 if x.dtype == torch.uint8 else x for k, x in images.items()}
        self.T, self.hw = images[views.image].shape[1], self._size()
        image = self.pictures[views.image]
        self.A = torch.eye(3, dtype=torch.float64, device=image.device).repeat(len(image), 1, 1)

    def apply(self, module: torch.nn.Module, param: ParamItem, extra: dict[str, Any]) -> None:
        """One augmentation, with the same parameters on all pictures."""
        name = type(module).__name__
        moves = not _is_colour(module)
        if moves and self.has_answers:
            raise SampleError(f"{name}: moves pixels behind ExtendDepth, expected it before")
        if moves and len({x.shape[-2:] for x in self.pictures.values()}) > 1:
            raise SampleError(f"{name}: found views of several sizes, expected one size")
        for key, x in self.pictures.items():
            frames = [InputSequentialOps.transform(frame, module, param, extra) for frame in x.unbind(1)]
            self.pictures[key] = torch.stack(frames, 1)
        if moves:
            A = torch.as_tensor(module.transform_matrix).to(self.A)
            A = A / A[:, 2:, 2:]
            if (A[:, 2, :2].abs() * max(self._size()) > _MAX_SHEAR).any():
                raise SampleError(f"{name}: found a perspective, expected {_MOVES}")
            self.A = torch.cat((A[:, :2], A.new_tensor([0.0, 0, 1]).expand(len(A), 1, 3)), 1) @ self.A

    def extend(self, module: torch.nn.Module) -> None:
        """Apply a transform of whole samples."""
        self.sample, self.has_answers = module(self.write()), True
        if self.sample is None:
            raise SampleError("a sample cannot be skipped here: use on_error='flag'")

    def write(self) -> dict[str, Any]:
        """The sample with its pictures as they are now, and everything else moved by A."""
        views, new_hw = self.views, self._size()
        values: dict[str, Any] = {key: self._in_layout(key, x) for key, x in self.pictures.items()}
        is_still = new_hw == self.hw and torch.equal(self.A, torch.eye(3).to(self.A).expand_as(self.A))
        if is_still or self.has_answers:
            return replace_values(self.sample, values)
        camera = self._camera(views.intrinsics)
        moved, Q = cam.warp(camera, self.A)
        shear = (Q @ Q.mT - torch.eye(3).to(Q)).abs().amax()
        if shear > _MAX_SHEAR:
            raise SampleError(f"augmentation: found a shear, expected {_MOVES}")
        # Size of the moved depth map, and the pixels (B, h' w', 2) of the given map under its own
        h, w = self._reader().planes(self.views.depth, self.T).shape[-2:]
        depth_camera, gain = None, self.A.new_tensor([w / self.hw[1], h / self.hw[0]])
        if self.views.depth_intrinsics is not None:
            if camera.distortion is not None:
                raise SampleError(f"{self.views.depth_intrinsics}: found a distortion beside it, expected none")
            depth_camera = self._camera(self.views.depth_intrinsics)
            gain = (depth_camera.f / camera.f).mean(0)
        size = (max(round(new_hw[0] * float(gain[1])), 1), max(round(new_hw[1] * float(gain[0])), 1))
        v, u = torch.meshgrid(*(torch.arange(n).to(self.A) for n in size), indexing="ij")
        uv = cam.resize_pixels(torch.stack((u, v), -1).flatten(0, 1), size, new_hw)
        uv = torch.nn.functional.pad(uv, (0, 1), value=1.0) @ torch.linalg.inv(self.A)[:, :2].mT
        places = cam.depth_pixels(camera, self.hw, depth_camera, (h, w), uv)
        maps = [key for key in (views.depth, views.confidence) if key is not None]
        values |= {key: self._moved_map(key, size, places) for key in maps}
        for key in (views.intrinsics, views.other_intrinsics):
            if isinstance(key, str):
                values[key] = self._moved_intrinsics(key, new_hw)
        if isinstance(views.depth_intrinsics, str):
            own = cam.resize(moved, new_hw, size)
            values[views.depth_intrinsics] = self._moved_intrinsics(views.depth_intrinsics, size, own)
        if isinstance(views.distortion, str):
            values[views.distortion] = self._moved_distortion(views.distortion, camera.f)
        return replace_values(self.sample, self._poses(Q, new_hw) | values)

    def _reader(self, dtype: torch.dtype = torch.float32) -> SampleReader:
        return SampleReader(self.sample, self.batched, dtype)

    def _camera(self, key: Any) -> Camera:
        """Camera (B,) of the first frame, in double precision."""
        reader = self._reader(torch.float64)
        reader.images(self.views.image, self.views.layout)
        lens = reader.numbers(self.views.distortion, self.T, 0) if key == self.views.intrinsics else None
        return reader.camera(key, self.T, 0, lens)

    def _size(self) -> tuple[int, int]:
        picture = self.pictures[self.views.image]
        return picture.shape[-2], picture.shape[-1]

    def _stored(self, key: str) -> Tensor:
        """Value of a key with B in front."""
        x = to_tensor(get_value(self.sample, key), key, signed=False).to(self.A.device)
        return x if self.batched else x[None]

    def _returned(self, x: Tensor) -> Tensor:
        """Value (B, …) as it stands in the sample."""
        return (x if self.batched else x[0]).contiguous()

    def _in_layout(self, key: str, x: Tensor) -> Tensor:
        """Pictures (B, T, C, H, W) in the layout that the sample has them in."""
        stored = self._stored(key)
        layout = self.views.layout or ("chw" if stored.shape[-3] in (1, 3) else "hwc")
        x = x.movedim(2, -1) if layout == "hwc" else x
        return self._returned(x if stored.ndim == 5 else x[:, 0])

    def _moved_map(self, key: str, size: tuple[int, int], places: Tensor) -> Tensor:
        """A depth or confidence map at other places, 0 outside; in the type and layout of the sample."""
        stored = self._stored(key)
        x = self._reader(stored.dtype).planes(key, self.T, signed=False)
        x = x.view(torch.int16) if x.dtype == torch.uint16 else x
        h, w = x.shape[-2:]
        # 1e-2 px, 100 times single precision at 1000 px: halves round alike whatever the rounding of A.
        u, v = (places + 0.5 + 1e-2).floor().long().unbind(-1)
        inside = ((u >= 0) & (u < w) & (v >= 0) & (v < h))[:, None]
        index = (v.clamp(0, h - 1) * w + u.clamp(0, w - 1))[:, None].expand(-1, x.shape[1], -1)
        values = x.flatten(-2).gather(-1, index)
        values = torch.where(inside, values, torch.zeros_like(values))
        axes = (-2, -1) if stored.shape[-2:] == (h, w) else (-3, -2)
        shape = list(stored.shape)
        shape[axes[0]], shape[axes[1]] = size
        if stored.dtype == torch.uint16:
            values = values.view(torch.uint16)  # for no other type: a view of a type has no gradient
        return self._returned(values.reshape(shape))

    def _per_value(self, M: Tensor, x: Tensor, tail: int) -> Tensor:
        """Matrices (B, k, k) as (B, 1, …, k, k) for values (B, …) whose last ``tail`` axes are one value."""
        return M.view(len(M), *(1,) * (x.ndim - 1 - tail), *M.shape[1:])

    def _moved_intrinsics(self, key: str, hw: tuple[int, int], own: Camera | None = None) -> Any:
        """Intrinsics under a key, moved by A, or those of ``own``, the moved depth map, in the form that the sample has
        them in."""
        stored = get_value(self.sample, key)
        if is_kornia_camera(stored):
            if own is not None:
                return _moved_kornia(stored, own, torch.eye(3).to(own.f).expand(len(own.f), 3, 3), hw)
            camera = Camera.from_kornia(stored)
            A = self.A.to(camera.f) if len(self.A) == len(camera.f) else self.A[:1].to(camera.f).expand_as(camera.f)
            return _moved_kornia(stored, *cam.warp(camera, A), hw)
        x = self._stored(key)
        rows = intrinsic_rows(x, self.T).double()
        if own is not None:
            if rows.ndim != 2:
                raise SampleError(f"{key}: found {tuple(x.shape[1:])}, expected one row of numbers or a matrix")
            return self._returned(_with_rows(x, rows, own))
        at_f, at_c = ((0, 1), (2, 3)) if rows.shape[-1] == 4 else ((0, 4), (2, 5))
        A = self._per_value(self.A, rows, 1).expand(*rows.shape[:-1], 3, 3).flatten(0, -3)
        camera = Camera(*(rows[..., at].flatten(0, -2) for at in (at_f, at_c)))
        return self._returned(_with_rows(x, rows, cam.warp(camera, A)[0]))

    def _moved_distortion(self, key: str, f: Tensor) -> Tensor:
        """Distortion under a key, turned with the picture."""
        x = self._stored(key)
        A = self._per_value(self.A, x, 1).expand(*x.shape[:-1], 3, 3).flatten(0, -3)
        f = f.view(len(f), *(1,) * (x.ndim - 2), 2).expand(*x.shape[:-1], 2).flatten(0, -2)
        turned = cam.warp(Camera(f, torch.zeros_like(f), x.to(f).flatten(0, -2)), A)[0].distortion
        assert turned is not None
        return self._returned(turned.view(x.shape).to(x.dtype))

    def _poses(self, Q: Tensor, hw: tuple[int, int]) -> dict[str, Any]:
        """Moved poses and their covariances by key."""
        views, W = self.views, _world_mirror(Q)
        if views.pose is None:
            return {}
        M = torch.tensor(STATED_AXES[views.pose_axes]).to(Q)
        right = M @ Q @ M.mT
        left = right if views.pose_kind == "1_from_0" else W
        values: dict[str, Any] = {}
        for key in {str(views.pose), views.other_pose or str(views.pose)}:
            if is_kornia_camera(get_value(self.sample, key)):
                values[key] = self._moved_intrinsics(key, hw)
                continue
            x = self._stored(key)
            L, inverse = (self._per_value(m, x, 2).to(x) for m in (left, right.mT))
            R, t = L @ x[..., :3, :3] @ inverse, L @ x[..., :3, 3:]
            values[key] = self._returned(torch.cat((torch.cat((R, t), -1), x[..., 3:, :]), -2))
        if isinstance(views.pose_cov, str):
            about = Q if views.pose_kind == "1_from_0" else W
            turn = torch.linalg.det(about).sign()[:, None, None] * about  # a rotation vector is axial
            zero = torch.zeros_like(about)
            x = self._stored(views.pose_cov)
            J = torch.cat((torch.cat((turn, zero), -1), torch.cat((zero, about), -1)), -2)
            J = self._per_value(J, x, 2).to(x)
            values[views.pose_cov] = self._returned(J @ x @ J.mT)
        return values


def _world_mirror(Q: Tensor) -> Tensor:
    """W (B, 3, 3): x mirrored where Q mirrors, else the identity."""
    W = torch.eye(3).to(Q).repeat(len(Q), 1, 1)
    W[:, 0, 0] = torch.linalg.det(Q).sign()
    return W


def _with_rows(x: Tensor, rows: Tensor, camera: Camera) -> Tensor:
    """Intrinsics x (B, …) of which ``rows`` (B, …, k) are the numbers, with those of cameras (L,) instead."""
    f, c = (v.view(*rows.shape[:-1], 2) for v in (camera.f, camera.c))
    if rows.shape[-1] == 4:
        return torch.cat((f, c), -1).to(x.dtype)
    rows = rows.clone()
    rows[..., 0:5:4], rows[..., 2:6:3] = f, c
    rows[..., 1] = 0  # skew is not read, and has not moved
    if x.shape == rows.shape:
        return rows.to(x.dtype)
    x = x.clone()
    x[..., :3, :3] = rows.unflatten(-1, (3, 3)).to(x.dtype)
    return x


def _moved_kornia(stored: Any, camera: Camera, Q: Tensor, hw: tuple[int, int]) -> Any:
    """A camera of kornia with other intrinsics, turned by Q, for pictures of another size."""
    if not isinstance(stored, PinholeCamera):
        lens = () if camera.distortion is None else (camera.distortion,)
        params = torch.cat((camera.f, camera.c, *lens), -1).view(stored.params.shape).to(stored.params)
        return type(getattr(stored, "_model", stored))(ImageSize(*hw), params)
    K, E = stored.intrinsics.clone(), stored.extrinsics
    K[:, :3, :3] = cam.to_matrix(camera).to(K)
    turn, mirror = (torch.nn.functional.pad(m, (0, 1, 0, 1)).to(E) for m in (Q, _world_mirror(Q)))
    last = torch.diag(E.new_tensor([0.0, 0, 0, 1]))
    height, width = (torch.full_like(K[:, 0, 0], float(n)) for n in hw)
    return PinholeCamera(K, (turn + last) @ E @ (mirror + last), height, width)


def _is_colour(module: torch.nn.Module) -> bool:
    """Whether a child changes colours or blurs, and leaves pixels where they are."""
    return isinstance(module, IntensityAugmentationBase2D) or type(module).__module__.startswith(_COLOUR_PACKAGES)


def _check_children(module: torch.nn.Module) -> None:
    """Raise ValueError for a child whose effect on geometry is unknown."""
    if isinstance(module, ImageSequential) and not isinstance(module, PatchSequential | VideoSequential):
        for child in module.children():
            _check_children(child)
        return
    if not (isinstance(module, (*_SAMPLE_TRANSFORMS, RigidAffineAugmentationBase2D)) or _is_colour(module)):
        expected = "an augmentation that has a transform_matrix or changes colours alone"
        raise ValueError(f"AugmentSample: found {type(module).__name__}, expected {expected}")
