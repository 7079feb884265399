"""Every writer writes the same bytes however its tensors lie in memory: expanded, transposed, backwards."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dhtorch.export.stray import write_stray
from dhtorch.export.video import write_lossless
from dhtorch.records import Camera, Frame, Pose
from dhtorch.synthetic.rh20t import write_rh20t

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


#: Captures that the package writes itself.
WRITERS: dict[str, Callable[[Path, list[Frame]], object]] = {
    "rh20t": lambda root, frames: write_rh20t(root, {"036422060909": frames}),
    "stray": write_stray,
}


def files(root: Path) -> dict[str, bytes]:
    return {str(file.relative_to(root)): file.read_bytes() for file in sorted(root.rglob("*")) if file.is_file()}


@pytest.mark.parametrize("lay", [transposed, expanded, column])
@pytest.mark.parametrize("name", WRITERS)
def test_memory_is_no_part_of_a_file(name: str, lay: Lay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 1e9)  # archives note when they were made
    for folder, used in (("dense", lambda x: lay(x).clone(memory_format=torch.contiguous_format)), ("laid", lay)):
        (tmp_path / folder).mkdir()
        WRITERS[name](tmp_path / folder, shots(used))
    dense, laid = files(tmp_path / "dense"), files(tmp_path / "laid")
    assert dense and list(dense) == list(laid)
    assert not [file for file in dense if dense[file] != laid[file]]


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("hw", [(16, 24), (48, 64)])
def test_a_film_of_few_pictures_is_written(n: int, hw: tuple[int, int], tmp_path: Path) -> None:
    """Sizes at which encoder and muxer once fell out over two pictures."""
    codes = (40 * np.arange(hw[1], dtype=np.uint16)).repeat(hw[0]).reshape(hw[1], hw[0]).T
    for k in range(4):
        write_lossless(tmp_path / f"{k}.mp4", [codes] * n, "gray12le")
        assert (tmp_path / f"{k}.mp4").stat().st_size > 0
