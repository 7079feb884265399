"""Every writer writes the same bytes however its tensors lie in memory: expanded, transposed, backwards."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support import writers
from support.writers import focal as stack_writers
from torch import Tensor

from dhtorch.data.codecs import exr
from dhtorch.experiments.focal.stacks import FocalStack
from dhtorch.export.video import write_lossless
from dhtorch.records import Camera, Frame, Pose

HW = (16, 24)

Lay = Callable[[Tensor], Tensor]


def transposed(x: Tensor) -> Tensor:
    """The same values, the last axis slowest in memory."""
    return x.movedim(-1, 0).contiguous().movedim(0, -1)


def expanded(x: Tensor) -> Tensor:
    """The first row for all rows, and but once in memory."""
    return x[..., :1, :].expand(x.shape)


def column(x: Tensor) -> Tensor:
    """The first column for all columns."""
    return x[..., :1].expand(x.shape)


def frame(lay: Lay, i: int = 0) -> Frame:
    draw = torch.Generator().manual_seed(i)
    pose = Pose(torch.eye(3).double()[None], torch.tensor([[0.1 * i, 0.0, 0.0]]).double())
    image = (256 * torch.rand(1, 3, *HW, generator=draw)).to(torch.uint8)
    depth, conf = 1 + 2 * torch.rand(1, *HW, generator=draw), 3 * torch.rand(1, *HW, generator=draw)
    stamp = torch.tensor([10.0 + i / 10]).double()
    laid = {"image": lay(image), "depth": lay(depth), "conf": lay(conf.to(torch.uint8))}
    return Frame(
        **laid,
        camera=Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[11.5, 7.5]])),
        time=stamp,
        T_world_from_cam=pose,
    )


def shots(lay: Lay) -> list[Frame]:
    return [frame(lay, i) for i in range(2)]


def stack(lay: Lay) -> FocalStack:
    images = torch.cat([frame(lay, i).image for i in range(10)])[None]
    return FocalStack(lay(images), depth=frame(lay).depth)


def _lerobot(**options: str) -> Callable[[Path, Lay], None]:
    return lambda root, lay: writers.write_lerobot(root, [shots(lay)], **options)


def _two(write: Callable[[Path, Frame, Frame], None]) -> Callable[[Path, Lay], None]:
    return lambda root, lay: write(root, *shots(lay))


def _arkitscenes(root: Path, lay: Lay) -> None:
    writers.write_arkitscenes(root / "1", {"lowres_wide": shots(lay), "lowres_depth": shots(lay)})


def _driving(root: Path, lay: Lay) -> None:
    still = Pose(torch.eye(3).double().expand(2, 3, 3), torch.zeros(2, 3).double())
    writers.write_driving(root, {"A": shots(lay)}, still)


def _light_field(root: Path, lay: Lay) -> None:
    views = (256 * torch.rand(3, 3, 3, *HW, generator=torch.Generator().manual_seed(0))).to(torch.uint8)
    stack_writers.write_light_field(root, "train/a", 0, lay(views).movedim(2, -1), frame(lay).depth)


def _frames(write: Callable[[Path, list[Frame]], None]) -> Callable[[Path, Lay], None]:
    return lambda root, lay: write(root, shots(lay))


#: Layouts of image folders whose writers take a folder and frames alone.
IMAGE_FOLDERS = ("bop", "icl_nuim", "open3d", "replica", "ros_tum", "scannet", "sens_folder", "sun3d")

WRITERS: dict[str, Callable[[Path, Lay], None]] = {
    **{name: _frames(getattr(writers, f"write_{name}")) for name in IMAGE_FOLDERS},
    "arkitscenes": _arkitscenes,
    "ca1m": lambda root, lay: writers.write_ca1m(root / "ca1m-val-1.tar", shots(lay), shots(lay)),
    "calib_pair": _two(writers.write_calib_pair),
    "counted_frames": lambda root, lay: writers.write_counted_frames(root, shots(lay)),
    "ddff12": lambda root, lay: stack_writers.write_ddff12(root / "a.h5", {"val": [stack(lay)]}),
    "driving": _driving,
    "fod500": lambda root, lay: stack_writers.write_fod500(root, {0: stack(lay)}),
    "image_folder": lambda root, lay: stack_writers.write_image_folder(root, stack(lay)),
    "lerobot array": _lerobot(image="image", depth="array"),
    "lerobot png": _lerobot(image="image", depth="png"),
    "lerobot tiff": _lerobot(image="image", depth="tiff"),
    "lerobot video": _lerobot(),
    "light_field": _light_field,
    "nerfstudio": lambda root, lay: writers.write_nerfstudio(root, shots(lay)),
    "polycam": lambda root, lay: writers.write_polycam(root, shots(lay)),
    "colmap_capture": lambda root, lay: writers.write_colmap_capture(root, shots(lay)),
    "named_frames": lambda root, lay: writers.write_named_frames(root, shots(lay)),
    "npz_pair": _two(writers.write_npz_pair),
    "r3d": lambda root, lay: writers.write_r3d(root / "a.r3d", shots(lay)),
    "record3d_exr": lambda root, lay: writers.write_record3d_exr(root, shots(lay)),
    "record3d_mp4": lambda root, lay: writers.write_record3d_mp4(root / "a.mp4", shots(lay)),
    "rh20t": lambda root, lay: writers.write_rh20t(root, {"036422060909": shots(lay)}),
    "rlds": lambda root, lay: writers.write_rlds(root, [shots(lay)]),
    "rlds array": lambda root, lay: writers.write_rlds(root, [shots(lay)], depth="array"),
    "stray": lambda root, lay: writers.write_stray(root, shots(lay)),
    "stray npy": lambda root, lay: writers.write_stray(root, shots(lay), depth_format="npy", confidence_channels=3),
    "tum": lambda root, lay: writers.write_tum(root, shots(lay)),
}


def files(root: Path) -> dict[str, bytes]:
    return {str(file.relative_to(root)): file.read_bytes() for file in sorted(root.rglob("*")) if file.is_file()}


@pytest.mark.parametrize("lay", [transposed, expanded, column])
@pytest.mark.parametrize("name", WRITERS)
def test_memory_is_no_part_of_a_file(name: str, lay: Lay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 1e9)  # archives note when they were made
    for folder, used in (("dense", lambda x: lay(x).clone(memory_format=torch.contiguous_format)), ("laid", lay)):
        (tmp_path / folder).mkdir()
        WRITERS[name](tmp_path / folder, used)
    dense, laid = files(tmp_path / "dense"), files(tmp_path / "laid")
    assert dense and list(dense) == list(laid)
    assert not [file for file in dense if dense[file] != laid[file]]


def test_every_writer_is_asked() -> None:
    assert {f"write_{name.split()[0]}" for name in WRITERS} == {
        *(n for n in writers.__all__ if n.startswith("write_")),
        *(n for n in vars(stack_writers) if n.startswith("write_")),
    }


def test_expanded_depth_of_a_focal_stack_is_written_where_it_belongs(tmp_path: Path) -> None:
    depth = torch.linspace(0.5, 2.0, HW[1]).half().float().expand(1, *HW)
    images = torch.zeros(1, 5, 3, *HW, dtype=torch.uint8)
    stack_writers.write_fod500(tmp_path, {0: FocalStack(images, depth=depth)})
    found = exr.read_exr(tmp_path / "000000Dpt.exr")
    np.testing.assert_array_equal(found, depth[0].numpy())


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("hw", [(16, 24), (48, 64)])
def test_a_film_of_few_pictures_is_written(n: int, hw: tuple[int, int], tmp_path: Path) -> None:
    """Sizes at which encoder and muxer once fell out over two pictures."""
    codes = (40 * np.arange(hw[1], dtype=np.uint16)).repeat(hw[0]).reshape(hw[1], hw[0]).T
    for k in range(4):
        write_lossless(tmp_path / f"{k}.mp4", [codes] * n, "gray12le")
        assert (tmp_path / f"{k}.mp4").stat().st_size > 0
