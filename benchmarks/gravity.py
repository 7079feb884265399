"""Which way is up in every capture: what its format states, what its surfaces show, and what the written map says.

    python benchmarks/gravity.py --json benchmarks/results/gravity.json

Surfaces tell by the directions of their normals alone, weighed by area: the floor (or a table) is the direction most of
them share within 45° of the cameras' mean upward one, walls stand at right angles to it. That knows nothing of planes
that are fitted to points, as ``dhtorch.integrate.level`` does. A row for each recording of every capture below
DHTORCH_DATA; where nothing can be measured the row says why.
"""

import argparse
import json
import math
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data.recording import Recording
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.integrate.level import _UP_BY_FORMAT, _spiral_directions, mean_camera_up
from dhtorch.records import Frame
from dhtorch.runtime import storage

#: Frames that are looked at, and columns of a depth map that are kept.
FRAMES, COLUMNS = 12, 128

#: A neighbour farther away by this share of the depth is another surface; half the width of a bin, degrees; how far
#: from the cameras' upward direction a floor may be, degrees.
STEP, BIN_DEG, AROUND_DEG = 0.05, 8.0, 45.0

#: Below this share of the area a direction is no plane.
LEAST = 0.1

#: Options under which the command's files are written: few frames, small maps.
QUICK = ("minutes=0.2", "method=map", "size=160", "planes=16", "mesh=false", "recordings=3")

#: Options that a capture needs to open.
OPENED: dict[str, dict[str, Any]] = {"stray_room": {"images": False}}


def normals(frame: Frame) -> tuple[Tensor, Tensor]:
    """Unit normals (P, 3) of a frame's surfaces in its world, towards the camera, and the area (P,) of each in m²."""
    depth = frame.depth.double()
    h, w = depth.shape[-2:]
    camera = frame.depth_camera or cam.resize(frame.camera, frame.hw, (h, w))
    step = max(1, w // COLUMNS)
    v, u = torch.meshgrid(torch.arange(0, h, step), torch.arange(0, w, step), indexing="ij")
    uv = torch.stack((u, v), -1).double()
    z = depth[0, ::step, ::step]
    xyz = cam.unproject(camera.to(torch.float64), uv.reshape(1, -1, 2), z.reshape(1, -1)).view(*z.shape, 3)
    across, down = xyz[:-2, 2:] - xyz[:-2, :-2], xyz[2:, :-2] - xyz[:-2, :-2]
    corner, right, below = z[:-2, :-2], z[:-2, 2:], z[2:, :-2]
    near = ((right - corner).abs() < STEP * corner) & ((below - corner).abs() < STEP * corner)
    near &= (corner > 0) & (right > 0) & (below > 0)
    n = torch.linalg.cross(across, down)[near]
    n = n * torch.where((n * xyz[:-2, :-2][near]).sum(-1, keepdim=True) > 0, -1.0, 1.0)
    area = n.norm(dim=-1)
    good = area > 0
    assert frame.T_world_from_cam is not None
    R = frame.T_world_from_cam.R[0].double()
    return (n[good] / area[good, None]) @ R.T, area[good] / 4


def mode(n: Tensor, area: Tensor, guess: Tensor, within_deg: float) -> tuple[Tensor, float]:
    """The direction that most of the area shares, within an angle of ``guess``; and that share."""
    axes = _spiral_directions(4000)
    axes = axes[axes @ guess > math.cos(math.radians(within_deg))]
    kernel = math.cos(math.radians(BIN_DEG))
    mass = torch.zeros(len(axes), dtype=torch.float64)
    for some, weight in zip(n.split(5000), area.split(5000), strict=True):
        mass += ((some @ axes.T > kernel) * weight[:, None]).sum(0)
    axis = axes[int(mass.argmax())]
    for _ in range(10):
        inlier = n @ axis > kernel
        axis = torch.nn.functional.normalize((n[inlier] * area[inlier, None]).sum(0), dim=0)
    return axis, float(area[n @ axis > kernel].sum() / area.sum())


def straight(n: Tensor, area: Tensor, axis: Tensor) -> float:
    """Share of the area that lies level or stands upright under an upward axis."""
    up = (n @ axis).abs()
    edge = math.radians(BIN_DEG)
    return float(area[(up > math.cos(edge)) | (up < math.sin(edge))].sum() / area.sum())


def angle(a: Sequence[float] | Tensor, b: Sequence[float] | Tensor) -> float:
    """Degrees between two directions."""
    a, b = (torch.nn.functional.normalize(torch.as_tensor(x, dtype=torch.float64), dim=0) for x in (a, b))
    return math.degrees(math.atan2(float(torch.linalg.cross(a, b).norm()), float(a @ b)))


def shown(recording: Recording) -> dict[str, Any]:
    """What surfaces and cameras of a recording show."""
    assert recording.poses is not None
    count = len(recording)
    chosen = sorted({k * (count - 1) // max(min(FRAMES, count) - 1, 1) for k in range(min(FRAMES, count))})
    seen = [normals(recording[k]) for k in chosen]
    n, area = (torch.cat(parts) for parts in zip(*seen, strict=True))
    every = [recording.poses[k : k + 1] for k in range(count)]
    guess = mean_camera_up([T for T in every if bool(T.R.isfinite().all())])
    stated = _UP_BY_FORMAT.get(recording.format)
    row: dict[str, Any] = {"stated": None if stated is None else list(stated), "camera_up": guess.tolist()}
    if len(n) < 500:
        return row | {"why": "too little depth for normals"}
    axis, share = mode(n, area, guess, AROUND_DEG)
    largest, of_all = mode(n, area, guess, 180.0)
    row |= {"share": share, "largest_share": of_all}
    known = share >= LEAST
    row |= {"plane": axis.tolist()} if known else {"why": "no level surface in view"}
    if stated is not None:
        wanted = torch.tensor(stated, dtype=torch.float64)
        row |= {"straight_stated": straight(n, area, wanted), "largest_from_stated_deg": angle(largest, wanted)}
        row |= {"stated_from_plane_deg": angle(wanted, axis)} if known else {}
    return row | ({"straight_plane": straight(n, area, axis)} if known else {})


def written(path: Path, folder: Path) -> dict[str, dict[str, Any]]:
    """Recording → the upward direction in its PLY and how far the GLB's turn takes it from +y; of ``dhtorch PATH``."""
    words = [sys.executable, "-m", "dhtorch", str(path), f"out={folder}", *QUICK]
    subprocess.run(words, cwd=folder.parent, check=False, capture_output=True)
    directions = {}
    for ply in sorted(folder.rglob("map.ply")):
        head = ply.read_bytes().partition(b"end_header\n")[0].decode("ascii")
        match = re.search(r"^comment up (.+)\ncomment world_from_file (.+)$", head, re.MULTILINE)
        if match is None:
            up, turned = None, None
        else:
            up, turn = (torch.tensor([float(x) for x in text.split()], dtype=torch.float64) for text in match.groups())
            turned = angle(in_glb(ply.with_name("map.glb"), up.tolist()), (0.0, 1.0, 0.0))
            up = (turn.reshape(3, 3) @ up).tolist()
        inside = ply.parent.relative_to(folder).as_posix()
        directions["" if inside == "." else inside] = {"written": up, "glb_from_y_deg": turned}
    return directions


def in_glb(path: Path, up: Sequence[float]) -> Tensor:
    """Where the first node of a GLB file turns a direction."""
    raw = path.read_bytes()
    (size,) = struct.unpack("<I", raw[12:16])
    x, y, z, w = json.loads(raw[20 : 20 + size])["nodes"][0]["rotation"]
    half = 2 * math.acos(min(1.0, abs(w)))
    axis = torch.tensor([x, y, z], dtype=torch.float64) * (1 if w >= 0 else -1)
    xi = torch.cat((torch.nn.functional.normalize(axis, dim=0) * half, torch.zeros(3, dtype=torch.float64)))
    return se3.exp(xi[None]).R[0] @ torch.tensor(up, dtype=torch.float64)


def rows(path: Path, folder: Path) -> Iterator[dict[str, Any]]:
    """The rows of a capture."""
    try:
        recordings = list(data.open_all(path, **OPENED.get(path.name, {})))
    except (ValueError, OSError) as error:
        yield {"capture": path.name, "why": str(error).replace(f"{path.parent}/", "").partition(", expected")[0]}
        return
    posed = [r for r in recordings if r.poses is not None]
    if not posed:
        yield {"capture": path.name, "why": "no poses"}
        return
    files = written(path, folder / path.name)
    for recording in posed:
        inside = recording.name.partition("/")[2] if len(recordings) > 1 else ""
        row = {"capture": recording.name, "format": recording.format} | shown(recording)
        row |= files.get(inside, {"written": None})
        if row["written"] is not None:
            row |= {"written_from_plane_deg": angle(row["written"], row["plane"])} if "plane" in row else {}
            row |= {"written_from_stated_deg": angle(row["written"], row["stated"])} if row["stated"] else {}
        yield row


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", help="one capture")
    options = parser.parse_args()
    torch.set_num_threads(1)
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(p for p in data.scenes_root(None).iterdir() if p.is_dir()):
            if options.only in (None, path.name):
                records += rows(path, Path(folder))
                print(records[-1], flush=True)
    storage.write_json(options.json, storage.to_strict_json(records))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
