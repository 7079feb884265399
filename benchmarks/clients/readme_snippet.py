"""README's example of a LeRobot loader, verbatim, on a set of depth images as LeRobot 0.6 writes them.

The set is written where LeRobot looks for ``you/your_set``. In an environment that has lerobot and dhtorch:
    python benchmarks/clients/readme_snippet.py NEW_FOLDER
"""

import io
import json
import os
import re
import sys
from contextlib import redirect_stdout
from pathlib import Path

README = Path(__file__).resolve().parents[2] / "README.md"


def write_set(root: Path) -> None:
    """Two episodes of a camera that walks through the built-in room, with depth in metres and seven actions a frame."""
    import numpy as np
    from pyarrow import array, parquet

    from dhtorch.export import lerobot
    from dhtorch.synthetic.recording import SyntheticRoom
    from dhtorch.testing import write_lerobot

    room = SyntheticRoom(hw=(480, 640), n_frames=16, supersample=1, lidar="exact")
    episodes = [[room[i] for i in range(k, k + 8)] for k in (0, 8)]
    camera = "observation.images.front"
    write_lerobot(root, episodes, version=3, camera=camera, image="image", depth="tiff", fps=10, poses=False)
    info = root / "meta" / "info.json"
    about = json.loads(info.read_text())
    about["features"]["action"] = lerobot.number_feature("float32", 7)
    info.write_text(json.dumps(about))
    for file in sorted((root / "data").rglob("*.parquet")):
        table = parquet.read_table(file)
        actions = np.zeros((table.num_rows, 7), np.float32)
        parquet.write_table(table.append_column("action", array(actions.tolist())), file)


def main(folder: str) -> None:
    os.environ["HF_LEROBOT_HOME"] = folder  # before LeRobot is imported
    write_set(Path(folder) / "you" / "your_set")
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
    print(json.dumps({"unit": unit, "median_m": float(batch["observation.dh_depth"][known].median())}))


if __name__ == "__main__":
    main(sys.argv[1])
