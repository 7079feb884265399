"""Every writer writes the same bytes however its tensors lie in memory: expanded, transposed, backwards."""

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


def shots(lay: Lay) -> list[Frame]:
    frames = []
    for i in range(2):
        draw = torch.Generator().manual_seed(i)
        image = (256 * torch.rand(1, 3, *HW, generator=draw)).to(torch.uint8)
        depth, conf = 1 + 2 * torch.rand(1, *HW, generator=draw), 3 * torch.rand(1, *HW, generator=draw)
        camera = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[11.5, 7.5]]))
        pose = Pose(torch.eye(3).double()[None], torch.tensor([[0.1 * i, 0.0, 0.0]]).double())
        about = {"conf": lay(conf.to(torch.uint8)), "time": torch.tensor([10.0 + i / 10]).double()}
        frames.append(Frame(lay(image), lay(depth), camera, T_world_from_cam=pose, **about))
    return frames


#: Captures that the package writes itself.
WRITERS: dict[str, Callable[[Path, list[Frame]], object]] = {
    "rh20t": lambda root, frames: write_rh20t(root, {"036422060909": frames}),
    "stray": write_stray,
}
#: The same values, the last axis slowest in memory; the first row, or column, for all, and but once in memory.
LAYS: list[Lay] = [
    lambda x: x.movedim(-1, 0).contiguous().movedim(0, -1),
    lambda x: x[..., :1, :].expand(x.shape),
    lambda x: x[..., :1].expand(x.shape),
]


@pytest.mark.parametrize("lay", LAYS)
@pytest.mark.parametrize("name", WRITERS)
def test_memory_is_no_part_of_a_file(name: str, lay: Lay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 1e9)  # archives note when they were made
    written = []
    for folder, used in (("dense", lambda x: lay(x).clone(memory_format=torch.contiguous_format)), ("laid", lay)):
        (root := tmp_path / folder).mkdir()
        WRITERS[name](root, shots(used))
        written.append({file.relative_to(root): file.read_bytes() for file in root.rglob("*") if file.is_file()})
    assert written[0] and written[0] == written[1]


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("hw", [(16, 24), (48, 64)])
def test_a_film_of_few_pictures_is_written(n: int, hw: tuple[int, int], tmp_path: Path) -> None:
    """Sizes at which encoder and muxer once fell out over two pictures."""
    codes = (40 * np.arange(hw[1], dtype=np.uint16)).repeat(hw[0]).reshape(hw[1], hw[0]).T
    for k in range(4):
        write_lossless(tmp_path / f"{k}.mp4", [codes] * n, "gray12le")
        assert (tmp_path / f"{k}.mp4").stat().st_size > 0
