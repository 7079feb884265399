"""Writers of focal stacks for tests: FoD500, DDFF-12 (HDF5 and raw light fields), a plain folder of images."""

import io
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from dhtorch.data.io.decode import import_optional
from dhtorch.experiments.focal.stacks import FocalStack
from dhtorch.export.arrays import encode_depth_codes
from support.writers.parts import encode_unfiltered_png, save_file


def write_fod500(root: Path, stacks: Mapping[int, FocalStack]) -> None:
    """Write ``<index>_<slice>All.tif`` and ``<index>Dpt.exr`` (half floats) of each index."""
    exr = import_optional("OpenEXR")
    for index, stack in stacks.items():
        for k, image in enumerate(stack.images[0]):
            save_file(root / f"{index:06d}_{k:02d}All.tif", rgb_tiff(image.permute(1, 2, 0).numpy()))
        if stack.depth is not None:
            # The library ignores the strides of an array.
            plane = np.ascontiguousarray(stack.depth[0].numpy(), np.float16)
            picture = io.BytesIO()
            header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
            exr.File(header, dict.fromkeys("RGB", plane)).write(picture)
            save_file(root / f"{index:06d}Dpt.exr", picture.getvalue())


def write_ddff12(
    file: Path,
    splits: Mapping[str, Sequence[FocalStack]],
    *,
    depth_disparity: float = 0.1412376,
    dtype: str = "float32",
    compression: str | None = None,
) -> None:
    """Write ``stack_<split>`` (N, S, H, W, 3), 0 to 255; with depth, ``disp_<split>`` (N, H, W) px, 0 = invalid."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with import_optional("h5py").File(file, "w") as group:
        for split, stacks in splits.items():
            values = np.stack([stack.images[0].permute(0, 2, 3, 1).numpy() for stack in stacks]).astype(dtype)
            group.create_dataset(f"stack_{split}", data=values, compression=compression)
            depths = [stack.depth[0].double().numpy() for stack in stacks if stack.depth is not None]
            if depths:
                disparity = [np.where(z > 0, depth_disparity / np.where(z > 0, z, 1), 0) for z in depths]
                group.create_dataset(f"disp_{split}", data=np.stack(disparity).astype("float32"))


def write_light_field(
    root: Path,
    scene: str,  # "train/kitchen"
    number: int,
    light_field: Tensor,  # (U, V, H, W, 3) uint8
    depth: Tensor | None = None,  # (1, H, W) m
) -> None:
    """Write ``LightField/<scene>/LF_<n>.npy`` and ``DepthRegistered/<scene>/DEPTH_<n>.png`` (16 bits, mm)."""
    content = io.BytesIO()
    np.save(content, light_field.contiguous().numpy())
    save_file(root / "LightField" / scene / f"LF_{number:04d}.npy", content.getvalue())
    if depth is not None:
        save_file(
            root / "DepthRegistered" / scene / f"DEPTH_{number:04d}.png",
            encode_unfiltered_png(encode_depth_codes(depth, 1000.0)),
        )


def write_image_folder(root: Path, stack: FocalStack) -> None:
    """Write ``image<n>.png``, n from 1 without leading zeros."""
    for k, image in enumerate(stack.images[0], 1):
        save_file(root / f"image{k}.png", encode_unfiltered_png(image.permute(1, 2, 0).numpy()))


def rgb_tiff(picture: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 or uint16 as TIFF: one strip, little-endian, uncompressed."""
    h, w, n = picture.shape
    bits = 8 * picture.dtype.itemsize
    body = picture.astype(picture.dtype.newbyteorder("<")).tobytes()
    extra = struct.pack(f"<{n}H", *[bits] * n)  # one number per channel exceeds the four bytes of an entry
    tags = [(256, 1, w), (257, 1, h), (258, n, 8), (259, 1, 1), (262, 1, 2), (273, 1, 8 + len(extra)), (277, 1, n)]
    tags += [(278, 1, h), (279, 1, len(body)), (284, 1, 1)]
    entries = b"".join(struct.pack("<HHII", tag, 3 if tag == 258 else 4, count, value) for tag, count, value in tags)
    head = struct.pack("<2sHI", b"II", 42, 8 + len(extra) + len(body))
    return head + extra + body + struct.pack("<H", len(tags)) + entries + bytes(4)
