"""Two episodes of a robot with two cameras, whose every number is a known function of camera, episode and frame.

No number is the same for two frames, cameras or episodes, so that a value of another frame is noticed. An episode is
longer than the rows of one table in memory.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pyarrow import parquet

from dhtorch.records import Camera, Frame, Pose
from support import writers

HW, CAMERAS, LENGTHS, FPS = (48, 64), ("front", "wrist"), (10, 9), 20
TASKS = ("pick up", "put down", "wait")

#: Coefficients of the second camera's lens; the first has none.
LENS = (0.02, -0.01, 0.001, -0.002, 0.003)


def number(camera: int, episode: int, i: int) -> int:
    """A number that no other frame has."""
    return 1000 * camera + 100 * episode + i


def intrinsics(camera: int, episode: int, i: int) -> np.ndarray:
    """K (3, 3), px."""
    n = number(camera, episode, i) / 64
    return np.array([[60 + n, 0, 31.5 + n / 16], [0, 61 + n, 23.5 - n / 16], [0, 0, 1]])


def pose(camera: int, episode: int, i: int) -> np.ndarray:
    """Camera to world (4, 4): a turn about y, then one about x; as small a motion as that of the depth."""
    a, b = 0.3 * camera + 0.02 * episode + 0.0004 * i, 0.1 + 0.0003 * i
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = about_y @ about_x, (0.0005 * i, camera + 0.1 * episode, -0.001 * i)
    return T


def picture(camera: int, episode: int, i: int) -> np.ndarray:
    """(h, w, 3) uint8, neither dark nor saturated."""
    return np.random.default_rng(number(camera, episode, i)).integers(40, 200, (*HW, 3)).astype(np.uint8)


def depth(camera: int, episode: int, i: int) -> np.ndarray:
    """(h, w) float32 m in whole millimetres: a slanted wall; 0 in a block without returns."""
    v, u = np.mgrid[: HW[0], : HW[1]]
    z = np.round(1e3 * (1 + 0.002 * u + 0.001 * v) + number(camera, episode, i)) / 1e3
    z[10 : 20 + i, 5 : 15 + episode] = 0
    return z.astype(np.float32)


def time(camera: int, episode: int, i: int) -> float:
    """Irregular time stamp, s; the cameras of an instant share it to 1 ms."""
    return 1000.0 + 50 * episode + i / FPS + 0.003 * (i % 3) + 0.001 * camera


def joints(episode: int, i: int) -> np.ndarray:
    """Seven joint angles, rad, float32."""
    return (np.arange(7) + 10 * episode + i / 16).astype(np.float32)


def action(episode: int, i: int) -> np.ndarray:
    """Four numbers, float32."""
    return (-np.arange(4) - 100 * episode - i / 8).astype(np.float32)


def task(episode: int, i: int) -> int:
    """Index of the task of a row."""
    return (episode + i // 5) % len(TASKS)


def frame(camera: int, episode: int, i: int, *, lens: bool = True) -> Frame:
    """All that a camera knows of an instant; ``lens``: the second camera has its distortion."""
    K, T = torch.from_numpy(intrinsics(camera, episode, i)), torch.from_numpy(pose(camera, episode, i))
    k = torch.tensor([LENS]) if camera and lens else None
    return Frame(
        image=torch.from_numpy(picture(camera, episode, i)).permute(2, 0, 1)[None].contiguous(),
        depth=torch.from_numpy(depth(camera, episode, i))[None],
        camera=Camera(torch.stack((K[0, 0], K[1, 1]))[None].float(), K[None, :2, 2].float(), k),
        time=torch.tensor([time(camera, episode, i)], dtype=torch.float64),
        T_world_from_cam=Pose(T[None, :3, :3], T[None, :3, 3]),
    )


def episodes(camera: int, *, lens: bool = True) -> list[list[Frame]]:
    """The frames of a camera by episode."""
    return [[frame(camera, e, i, lens=lens) for i in range(n)] for e, n in enumerate(LENGTHS)]


def rows() -> list[tuple[int, int]]:
    """(episode, frame) of every row of a set, in order."""
    return [(e, i) for e, n in enumerate(LENGTHS) for i in range(n)]


def write_robot(root: Path, *, version: int = 3) -> None:
    """Write a LeRobot set of both cameras with joints, actions, tasks and a text; video frames are lossless."""
    parts = [root, root.with_name(f"{root.name}-wrist")]
    for camera, part in enumerate(parts):
        part.mkdir(parents=True)
        key = f"observation.images.{CAMERAS[camera]}"
        writers.write_lerobot(part, episodes(camera, lens=False), version=version, camera=key, fps=FPS, depth="tiff")
    first, second = parts
    (second / "videos").rename(first / "wrist-videos")
    for file in sorted((first / "wrist-videos").rglob("*.mp4")):
        place = first / "videos" / file.relative_to(first / "wrist-videos")
        place.parent.mkdir(parents=True, exist_ok=True)
        file.rename(place)
    start = 0
    for file in sorted((first / "data").rglob("*.parquet")):
        table = _joined(file, second / file.relative_to(first))
        where = rows()[start : start + table.num_rows]
        start += table.num_rows
        more = {
            "observation.state": [joints(e, i).tolist() for e, i in where],
            "action": [action(e, i).tolist() for e, i in where],
            "note": [f"step {i} of {e}" for e, i in where],
        }
        for name, values in more.items():
            table = table.append_column(name, [_array(values)])
        position = table.column_names.index("task_index")
        parquet.write_table(table.set_column(position, "task_index", [[task(e, i) for e, i in where]]), file)
    _join_meta(first, second, version)


def _array(values: list[Any]) -> Any:
    import pyarrow  # noqa: PLC0415

    if isinstance(values[0], str):
        return pyarrow.array(values)
    return pyarrow.array(values, pyarrow.list_(pyarrow.float32(), len(values[0])))


def _joined(file: Path, other: Path) -> Any:
    """The table of one file with the columns that another has more."""
    table, more = parquet.read_table(file), parquet.read_table(other)
    for name in more.column_names:
        table = table if name in table.column_names else table.append_column(name, more[name])
    return table


def _join_meta(first: Path, second: Path, version: int) -> None:
    info, other = (json.loads((root / "meta" / "info.json").read_text()) for root in (first, second))
    number = {"dtype": "float32", "names": None}
    info["features"] |= other["features"] | {
        "observation.state": {**number, "shape": [7]},
        "action": {**number, "shape": [4]},
        "note": {"dtype": "string", "shape": [1], "names": None},
    }
    info |= {"total_tasks": len(TASKS), "robot_type": "known arm", "splits": {"train": "0:1", "val": "1:2"}}
    (first / "meta" / "info.json").write_text(json.dumps(info))
    entry = {"dist": list(LENS)}
    (first / "meta" / "intrinsics.json").write_text(json.dumps({f"observation.images.{CAMERAS[1]}": entry}))
    by_episode = [list(dict.fromkeys(TASKS[task(e, i)] for i in range(n))) for e, n in enumerate(LENGTHS)]
    if version == 2:
        lines = [{"task_index": k, "task": text} for k, text in enumerate(TASKS)]
        (first / "meta" / "tasks.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        rows = [{"episode_index": e, "tasks": by_episode[e], "length": n} for e, n in enumerate(LENGTHS)]
        (first / "meta" / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return
    import pyarrow  # noqa: PLC0415

    parquet.write_table(
        pyarrow.table({"task_index": range(len(TASKS)), "task": TASKS}), first / "meta" / "tasks.parquet"
    )
    file = first / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table = _joined(file, second / file.relative_to(first))
    parquet.write_table(table.set_column(table.column_names.index("tasks"), "tasks", [by_episode]), file)
