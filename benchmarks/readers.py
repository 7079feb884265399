"""Streaming: time to open a capture, frames a second, and memory, for every format, from written captures.

A capture is written once for each format, then opened and read frame by frame in a fresh process. *first* is resident
memory after the tenth frame, *peak* the largest until the last one, both in MiB above the level before the call: where
a reader streams, they hardly differ. The same frames come round every ``PERIOD``, so that writing takes no hour; no
reader can tell.

    python benchmarks/readers.py [--json FILE] [--frames 100 | --full] [--only tum,stray]
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch

from dhtorch import data
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.stacks import FocalStack
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support import writers
from support.writers import focal as stack_writers

PERIOD = 20
HW, LOW_HW = (480, 640), (192, 256)
BOX = torch.tensor([2.0, 1.5, 3.0], dtype=torch.float64)


def frames(n: int, hw: tuple[int, int] = HW, low_hw: tuple[int, int] | None = None, rate: float = 30.0) -> list[Frame]:
    """A walk in a box: textured walls, depth at every pixel or at ``low_hw`` with confidence."""
    camera = _camera(hw)
    seen = [_render(camera, hw, low_hw, _pose(i)) for i in range(min(n, PERIOD))]
    return [seen[i % PERIOD].replace(time=torch.tensor([100 + i / rate], dtype=torch.float64)) for i in range(n)]


def _camera(hw: tuple[int, int]) -> Camera:
    return Camera(torch.tensor([[0.8 * hw[1]] * 2]), torch.tensor([[hw[1] / 2 - 0.5, hw[0] / 2 - 0.5]]))


def _pose(i: int) -> Pose:
    phase = 2 * math.pi * i / PERIOD
    return se3.exp(torch.tensor([[0.1, 0.3 + 0.02 * math.sin(phase), 0, 0.2 * math.cos(phase), 0, 0.1]]).double())


def _render(camera: Camera, hw: tuple[int, int], low_hw: tuple[int, int] | None, T: Pose) -> Frame:
    xyz, depth = _hit(camera, hw, T)
    noise = torch.rand(3, *hw, generator=torch.Generator().manual_seed(0)) * 12  # a sensor's, so that files have a size
    tone = torch.stack([torch.sin(7 * xyz[..., k % 3] + 3 * xyz[..., (k + 1) % 3]) for k in range(3)])
    image = (120 + 100 * tone + noise).clamp(0, 255).to(torch.uint8)
    conf = None
    if low_hw is not None:
        xyz, depth = _hit(cameras.resize(camera, hw, low_hw), low_hw, T)
        conf = (xyz[None, ..., 0] * 3).long().remainder(3).to(torch.uint8)
    return Frame(image[None], depth[None].float(), camera, conf=conf, T_world_from_cam=T)


def _hit(camera: Camera, hw: tuple[int, int], T: Pose) -> tuple[torch.Tensor, torch.Tensor]:
    v, u = torch.meshgrid(torch.arange(hw[0]), torch.arange(hw[1]), indexing="ij")
    ray = se3.rotate(T.R, cameras.rays(camera.to(torch.float64), torch.stack((u, v), -1).reshape(1, -1, 2).double()))[0]
    depth = ((torch.sign(ray) * BOX - T.t[0]) / ray).amin(-1)
    return (T.t[0] + depth[:, None] * ray).reshape(*hw, 3), depth.reshape(hw)


# ---------------------------------------------------------------------------------------------------------- one format


def _tum(root: Path, n: int) -> None:
    writers.write_tum(root, frames(n))


def _named(root: Path, n: int) -> None:
    writers.write_named_frames(root, frames(n), fps=30)


def _driving(root: Path, n: int) -> None:
    shots = frames(n, (240, 320))
    still = Pose(torch.eye(3).double().expand(n, 3, 3), torch.zeros(n, 3).double())
    writers.write_driving(root, {"FRONT": shots}, still)


def _stray(root: Path, n: int) -> None:
    writers.write_stray(root, frames(n, HW, LOW_HW, 60))


def _r3d(root: Path, n: int) -> Path:
    writers.write_r3d(root / "capture.r3d", frames(n, (960, 720), (256, 192), 60))
    return root / "capture.r3d"


def _record3d_exr(root: Path, n: int) -> None:
    writers.write_record3d_exr(root, frames(n, (960, 720), (256, 192), 60))


def _arkitscenes(root: Path, n: int) -> None:
    shots = frames(n, LOW_HW, LOW_HW, 60)
    writers.write_arkitscenes(root, {"lowres_wide": shots, "lowres_depth": shots}, trajectory=shots)


def _ca1m(root: Path, n: int) -> Path:
    writers.write_ca1m(root / "ca1m-val-42.tar", frames(n, (384, 512), LOW_HW), frames(n, (384, 512)))
    return root / "ca1m-val-42.tar"


def _rh20t(root: Path, n: int) -> Path | None:
    return writers.write_rh20t(root, {"036422060909": frames(n, (360, 640), rate=10)})


def _lerobot(root: Path, n: int) -> None:
    writers.write_lerobot(root, [frames(n)])


@cache
def _stack(seed: int, slices: int, hw: tuple[int, int]) -> FocalStack:
    draw = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (1, slices, 3, *hw), generator=draw).to(torch.uint8)
    return FocalStack(images, depth=(0.3 + torch.rand(1, *hw, generator=draw)).half().float())


def _fod500(root: Path, n: int) -> None:
    stack_writers.write_fod500(root, {i: _stack(i % PERIOD, 5, (256, 256)) for i in range(n)})


def _ddff12(root: Path, n: int) -> Path:
    stack_writers.write_ddff12(
        root / "ddff12.h5", {"val": [_stack(i % PERIOD, 10, (192, 276)) for i in range(n)]}, dtype="uint8"
    )
    return root / "ddff12.h5"


FORMATS: dict[str, Callable[[Path, int], Path | None]] = {
    "tum": _tum,
    "frames_dir": _named,
    "driving": _driving,
    "stray": _stray,
    "record3d_r3d": _r3d,
    "record3d_exr": _record3d_exr,
    "arkitscenes": _arkitscenes,
    "ca1m": _ca1m,
    "rh20t": _rh20t,
    "lerobot": _lerobot,
    "fod500": _fod500,
    "ddff12": _ddff12,
}


def measure(name: str, path: Path) -> dict[str, Any]:
    """Open and stream one capture; run in a process of its own."""
    torch.set_num_threads(1)
    opener = formats.open_stacks if name in formats.STACK_FORMATS else data.open
    _ = opener(path)[0]  # imports and file-system caches are not the reader's
    before = _resident()
    _reset_peak()
    start = time.perf_counter()
    recording = opener(path)
    opened = time.perf_counter() - start
    first = 0
    start = time.perf_counter()
    for i in range(len(recording)):
        _ = recording[i]
        if i == min(9, len(recording) - 1):
            first = _resident() - before
    seconds = time.perf_counter() - start
    frame = recording[0]
    image = frame.images if isinstance(frame, FocalStack) else frame.image
    return {
        "name": f"read {name}",
        "n": len(recording),
        "threads": 1,
        "device": "cpu",
        "image": list(image.shape[1:]),
        "open_ms": 1e3 * opened,
        "frames_per_s": len(recording) / seconds,
        "first_mib": first / 2**20,
        "peak_mib": (_peak() - before) / 2**20,
    }


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _reset_peak() -> None:
    """Let the kernel's high-water mark of this process start again."""
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def _work(name: str, n: int) -> dict[str, Any]:
    """Write in one process, read in a fresh one."""
    with (
        tempfile.TemporaryDirectory() as folder,
        multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool,
    ):
        root = Path(folder) / "capture"
        root.mkdir()
        path = pool.apply(_write, (name, root, n))
        size = sum(f.stat().st_size for f in root.rglob("*") if f.is_file())
        return pool.apply(measure, (name, path)) | {"mib": size / 2**20, "processor": result_files.describe_processor()}


def _write(name: str, root: Path, n: int) -> Path:
    torch.set_num_threads(1)
    return FORMATS[name](root, n) or root


def main() -> None:
    parser = argparse.ArgumentParser(description="Streaming of written captures, format by format.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--frames", type=int, default=100, help="frames of a capture (default: 100)")
    parser.add_argument("--full", action="store_true", help="1,000 frames each; takes long, most of it for writing")
    parser.add_argument("--only", default=",".join(FORMATS), help="formats, separated by commas")
    options = parser.parse_args()
    head = ("name", "n", "image", "MiB", "open ms", "frames/s", "first MiB", "peak MiB")
    print("{:22} {:>5} {:>14} {:>7} {:>8} {:>9} {:>10} {:>9}".format(*head))
    n = 1000 if options.full else options.frames
    rows = []
    for name in options.only.split(","):
        row = _work(name, n)
        rows.append(row)
        size = "x".join(map(str, row["image"]))
        print(
            f"{row['name']:22} {row['n']:5d} {size:>14} {row['mib']:7.0f} {row['open_ms']:8.1f} "
            f"{row['frames_per_s']:9.1f} {row['first_mib']:10.1f} {row['peak_mib']:9.1f}",
            flush=True,
        )
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        storage.write_json(options.json, rows)
        print(f"wrote {options.json}")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
