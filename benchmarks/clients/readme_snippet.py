"""README's example of a LeRobot loader, verbatim, on a set of the built-in room, and what it recovers there.

LeRobot 0.6 writes the set itself, its depth as video with default options; for earlier versions, which know no depth,
it has depth images. It stands where LeRobot looks for ``you/your_set``. In an environment that has lerobot and dhtorch:
    python benchmarks/clients/readme_snippet.py NEW_FOLDER
"""

import copy
import dataclasses
import inspect
import io
import json
import os
import re
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

README = Path(__file__).resolve().parents[2] / "README.md"
CAMERA, FPS = "observation.images.front", 10


def rooms() -> tuple[Any, Any]:
    """The recording that is written, whose sensor reaches 2.5 m, and the same with exact depth."""
    from dhtorch.synthetic.recording import SyntheticRoom

    size = {"hw": (480, 640), "n_frames": 16, "step_m": 0.03, "supersample": 1}
    return SyntheticRoom(**size, range_limit=2.5), SyntheticRoom(**size, lidar="exact")


def write_video(root: Path, room: Any) -> None:
    """Two episodes with depth in whole millimetres and seven actions a frame, by LeRobot with its default options."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    picture = {"dtype": "video", "names": ["height", "width", "channels"]}
    features = {CAMERA: {**picture, "shape": (*room[0].hw, 3)}}
    features[f"{CAMERA}_depth"] = {
        **picture,
        "shape": (*room[0].depth.shape[1:], 1),
        "info": {"is_depth_map": True},
    }
    features["action"] = {"dtype": "float32", "shape": (7,), "names": None}
    dataset = LeRobotDataset.create("you/your_set", fps=FPS, root=root, features=features, use_videos=True)
    for i in range(len(room)):
        image = (room[i].image[0].permute(1, 2, 0) * 255).round().byte().numpy()
        depth = (room[i].depth[0] * 1000).round().numpy().astype(np.uint16)[..., None]
        frame = {CAMERA: image, f"{CAMERA}_depth": depth, "action": np.zeros(7, np.float32), "task": "look"}
        dataset.add_frame(frame)
        if i % 8 == 7:
            dataset.save_episode()
    dataset.finalize()


def write_images(root: Path, room: Any) -> None:
    """The same two episodes with depth images in metres."""
    from pyarrow import array, parquet

    from dhtorch.export import lerobot

    sys.path.insert(0, str(README.parent / "tests"))
    from support.writers import write_lerobot

    episodes = [[room[i] for i in range(k, k + 8)] for k in (0, 8)]
    write_lerobot(root, episodes, version=3, camera=CAMERA, image="image", depth="tiff", fps=FPS, poses=False)
    info = root / "meta" / "info.json"
    about = json.loads(info.read_text())
    about["features"]["action"] = lerobot.number_feature("float32", 7)
    info.write_text(json.dumps(about))
    for file in sorted((root / "data").rglob("*.parquet")):
        table = parquet.read_table(file)
        actions = np.zeros((table.num_rows, 7), np.float32)
        parquet.write_table(table.append_column("action", array(actions.tolist())), file)


def recovered(dataset: Any, exact: Any) -> dict[str, Any]:
    """Samples of README's data set with the room's intrinsics, in frames with a source view, by origin; their error."""
    from dhtorch.codes import Source
    from dhtorch.transforms import ExtendedDataset

    transform, camera = copy.copy(dataset.transform), exact[0].camera
    intrinsics = [*camera.f[0].tolist(), *camera.c[0].tolist()]
    transform.views = dataclasses.replace(transform.views, intrinsics=intrinsics)
    dataset = ExtendedDataset(dataset.dataset, transform, gap=dataset.gap)
    counts, errors = dict.fromkeys(("sensor", "nearer_than_2_cm", "recovered"), 0), []
    frames = [i for i in range(len(exact)) if i % 8 >= 5]
    for i in frames:
        item = dataset[i]
        uv, z, source = (item[f"observation.dh_{key}"] for key in ("uv", "depth", "source"))
        columns, rows = uv.round().long().T
        found, sensed = source == Source.RECOVERED, source == Source.SENSOR
        errors += (z / exact[i].depth[0, rows, columns] - 1).abs()[found].tolist()
        new = {"sensor": sensed, "nearer_than_2_cm": sensed & (z < 0.02), "recovered": found}
        counts = {name: n + int(new[name].sum()) for name, n in counts.items()}
    median = float(np.median(errors)) if errors else None
    return {"frames": len(frames), "samples": len(frames) * len(z), **counts, "median_error": median}


def main(folder: str) -> None:
    os.environ["HF_LEROBOT_HOME"] = folder  # before LeRobot is imported
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    (room, exact), root = rooms(), Path(folder) / "you" / "your_set"
    has_video = "depth_output_unit" in inspect.signature(LeRobotDataset).parameters
    (write_video if has_video else write_images)(root, room)
    code, said = next(
        each
        for each in re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README.read_text(), re.DOTALL)
        if "LeRobotDataset" in each[0]
    )
    printed = io.StringIO()
    with redirect_stdout(printed):
        names: dict[str, object] = {"__name__": "readme"}
        exec(compile(code, "README.md", "exec"), names)
    assert printed.getvalue() == said, f"found {printed.getvalue()!r}, expected {said!r}"
    batch, unit = names["batch"], names["dataset"].transform.views.depth_unit
    known = batch["observation.dh_valid"]
    assert known.any(), "no depth"
    median = float(batch["observation.dh_depth"][known].median())
    form = "video" if has_video else "image"
    print(json.dumps({"unit": unit, "depth": form, "median_m": median, **recovered(names["dataset"], exact)}))


if __name__ == "__main__":
    main(sys.argv[1])
