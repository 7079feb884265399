"""Changes by a stranger: a tracker, a reader, a column, a gate, an experiment with its table.

Each is made in a copy of the package, where it touches two files at most, and works in every place that shows it.
"""

import filecmp
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
PARTS = ("dhtorch", "conf", "docs")
ROOM = ["data.hw=[96,128]", "data.depth_hw=[48,64]", "data.n_frames=3", "data.supersample=1", "method.n=256"]

#: What every script begins with.
HEAD = f"""
import json
from pathlib import Path
import torch
import dhtorch
from dhtorch.cli.run import main

ROOM = {ROOM!r}
assert Path(dhtorch.__file__).is_relative_to(Path.cwd().parent / "fork"), dhtorch.__file__

def command(*words):
    assert main(list(words)) == 0, words
"""


class Fork:
    """A copy of the package with its settings and documentation, and an empty folder to run in."""

    def __init__(self, folder):
        self.home, self.desk = folder / "fork", folder / "desk"
        self.desk.mkdir()
        without = shutil.ignore_patterns("__pycache__", "assets", "results")
        for part in PARTS:
            shutil.copytree(REPO / part, self.home / part, ignore=without)

    def insert(self, name, before, text):
        """Put a text in front of a line that the file has once."""
        path = self.home / name
        found = path.read_text(encoding="utf-8")
        assert found.count(before) == 1, (name, before, found.count(before))
        path.write_text(found.replace(before, text + before), encoding="utf-8")

    def write(self, name, text):
        assert not (self.home / name).exists()
        (self.home / name).write_text(text, encoding="utf-8")

    def changed(self):
        """Files of the copy that are new or differ."""
        found = [p for part in PARTS for p in (self.home / part).rglob("*") if p.is_file() and p.suffix != ".pyc"]
        names = [p.relative_to(self.home) for p in found]
        return [str(n) for n in names if not (REPO / n).is_file() or not filecmp.cmp(self.home / n, REPO / n, False)]

    def run(self, script):
        """What a script prints that sees the copy alone."""
        env = {k: v for k, v in os.environ.items() if k not in ("DHTORCH_DATA", "PYTHONPATH")}
        env |= {"PYTHONPATH": f"{self.home}{os.pathsep}{self.home / 'docs'}", "OMP_NUM_THREADS": "1"}
        run = [sys.executable, "-c", HEAD + script]
        done = subprocess.run(run, cwd=self.desk, env=env, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
        return done.stdout


@pytest.fixture
def fork(tmp_path):
    return Fork(tmp_path)


@pytest.mark.slow
def test_a_tracker_is_one_file(fork):
    (fork.desk / "mine.py").write_text(
        "from dhtorch.stages.track import lucas_kanade\n\n\n"
        "def track(image_0, image_1, uv_0, *, hint):\n"
        "    return lucas_kanade(image_0, image_1, uv_0, hint=hint)\n"
    )
    fork.run("""
import sys; sys.path.insert(0, ".")
import mine
from dhtorch.synthetic import SyntheticRoom
room = SyntheticRoom(hw=(96, 128), n_frames=3, supersample=1)
method = dhtorch.MAP.replace(track=mine.track, n=256)
trace = {}
estimate = method(room[0], room[2], trace=trace)
assert method.track is mine.track and trace["tracks"].valid.any() and estimate.depth.shape == (1, 256)
""")
    assert fork.changed() == []


READER = '''
"""Stacked arrays: image.npy and depth.npy in a folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dhtorch.data.recording import Recording, consecutive_frame_numbers
from dhtorch.records import Camera, Frame


@dataclass(frozen=True)
class _Load:
    root: Path

    def __call__(self, i):
        image, depth = (torch.from_numpy(np.load(self.root / f"{name}.npy")[i]) for name in ("image", "depth"))
        camera = Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[31.5, 23.5]]))
        return Frame(image[None], depth[None], camera)


def recognise(root):
    return "image.npy and depth.npy" if (root / "image.npy").is_file() else None


def read(root):
    n = len(np.load(Path(root) / "image.npy"))
    return [Recording(name=Path(root).name, format="stacked", load=_Load(Path(root)), number=consecutive_frame_numbers(n), root=Path(root))]
'''


@pytest.mark.slow
def test_a_reader_is_a_module_and_a_line(fork):
    fork.write("dhtorch/data/readers/stacked.py", READER)
    fork.insert("dhtorch/data/__init__.py", "    frames_dir,\n", "    stacked,\n")
    fork.insert("dhtorch/data/__init__.py", '    "frames_dir": frames_dir,\n', '    "stacked": stacked,\n')
    assert len(fork.changed()) == 2
    said = fork.run("""
import numpy as np
Path("walk").mkdir()
np.save("walk/image.npy", np.random.default_rng(0).integers(0, 255, (3, 3, 48, 64), np.uint8))
np.save("walk/depth.npy", np.full((3, 24, 32), 2, np.float32))
assert dhtorch.data.open("walk").format == "stacked" and list(dhtorch.data.FORMATS)[-2:] == ["stacked", "frames_dir"]
command("inspect", "walk")
command("extract", "data=auto", "data.root=walk", "out=features", "extract.gap=1", "method=paper", "method.n=64")
from dhtorch.runtime.code_dependencies import find_reachable_modules
assert "data/readers/stacked.py" in find_reachable_modules(["dhtorch.data.open_capture"])
""")
    assert "stacked" in said and "3 rows" in said


@pytest.mark.slow
def test_a_column_is_an_entry_and_its_function(fork):
    schema = "dhtorch/transforms/schema.py"
    function = "def _trackability(found: SampleResults) -> Tensor:\n    return found.samples.trackability\n\n\n"
    fork.insert(schema, "def _xyz(results", function)
    entry = (
        '    ColumnSpec("trackability", _N, _F, "1", "texture there", _trackability, half=True, enrich="numbers"),\n'
    )
    fork.insert(schema, '    ColumnSpec(\n        "problem",\n', entry)
    assert fork.changed() == [schema]
    fork.run("""
import pyarrow.parquet
from dhtorch.extract import FeatureTable
keys = {"image": "image", "depth": "depth", "intrinsics": "K", "depth_unit": "m", "n": 64, "tokens_hw": (28, 42)}
transform = dhtorch.ExtendDepth(**keys, on_error="flag")
image = torch.rand(3, 48, 64, generator=torch.manual_seed(0))
sample = {"image": image, "depth": torch.full((48, 64), 2.0), "K": torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])}
added = transform(sample)["dhtorch.trackability"]
assert added.shape == (64,) and added.isfinite().all() and added.any()
import warnings; warnings.simplefilter("ignore")
blank = transform({"image": image})
assert blank["dhtorch.problem"] == 3 and torch.equal(blank["dhtorch.trackability"], torch.zeros(64))

command("extract", *ROOM, "out=features", "extract.gap=1", "extract.half=true", "method=paper")
table = FeatureTable("features")
assert table.about["columns"]["trackability"]["kind"] == "float16" and table[1]["dhtorch.trackability"].any()

command("enrich", "data=synthetic", *ROOM, "out=set", "dense=false", "gap=1", "method=paper")
features = json.loads(Path("set/meta/info.json").read_text())["features"]
(key,) = [key for key in features if key.endswith("dhtorch_trackability")]
assert features[key]["shape"] == [256] and features[key]["dtype"] == "float32"
(file,) = Path("set/data").rglob("*.parquet")
cells = pyarrow.parquet.read_table(file).column(key).to_pylist()
assert [len(cell) for cell in cells] == [256] * 3 and any(cells[0])

command("enrich", "data=synthetic", *ROOM, "out=nerf", "format=nerfstudio", "dense=false", "gap=1", "method=paper")
frames = json.loads(Path("nerf/transforms.json").read_text())["frames"]
assert all(len(frame["dhtorch_trackability"]) == 256 for frame in frames)

import hooks
assert "| `trackability` | (N,) | float32 | 1 | texture there |  |" in hooks.generate("sample_columns")
""")


@pytest.mark.slow
def test_a_gate_is_an_entry_and_the_line_that_sets_it(fork):
    entry = '    TOO_FAR: Final = code(13, "beyond a metre", meaning="too far for a test", advice="go closer")\n\n\n'
    fork.insert("dhtorch/codes.py", "class PoseCode(CodeTable):", entry)
    fork.insert(
        "dhtorch/stages/triangulate.py",
        "        (behind, Gate.BEHIND),\n",
        "        (geometry.depth > 1.0, Gate.TOO_FAR),\n",
    )
    assert len(fork.changed()) == 2
    fork.run("""
from dhtorch.codes import Gate
assert type(Gate.TOO_FAR) is int
command("data.hw=[120,160]", "data.n_frames=3", "pairs.gap=2", "method=paper", "method.n=1024", "hydra.run.dir=job")
result = json.loads(Path("job/result.json").read_text())
(row,) = [row for row in result["rows"] if row["pair"]]
assert row["gate_share"]["too_far"] > 0
assert list(Path("job").rglob("samples.png"))
command("report", "job", "--html", "report.html")
command("view", *ROOM, "method=paper", "pairs=gap", "pairs.gap=2", "html=view.html")
assert '"too far"' in Path("view.html").read_text()
command("enrich", "data=synthetic", *ROOM, "out=set", "dense=false", "gap=2", "method=paper")
assert "too far for a test" in Path("set/meta/report.html").read_text()
from dhtorch.cli.gate_messages import suggest_remedy
assert suggest_remedy("too_far") == "too far for a test; go closer"
from dhtorch.experiments.report.figures import overlay_layers
(layer,) = overlay_layers({"u": [1.0], "v": [2.0], "source": [0], "gate": [Gate.TOO_FAR]})
assert layer.label == "unanswered: too far"
import hooks
assert "| 13 | `TOO_FAR` | beyond a metre | go closer |" in hooks.generate("codes") and "too far" in hooks.generate("colours")
""")


EXPERIMENT = '''
"""Question: is the picture bright?

Expectation (written before the run): yes.
What would refute it: its mean is below a tenth.
"""

from dhtorch.data.scene import scenes_of
from dhtorch.experiments.protocol import Outcome, no_progress


def run(scenes, methods, pairs, settings, *, least=0.1, progress=no_progress):
    """Mean brightness of the first frame of every scene."""
    outcome = Outcome()
    for scene in scenes_of(scenes):
        mean = float(scene.recording[0].image.double().mean()) / 255
        row = {"scene": scene.name, "pair": None, "method": "mean", "truth": None, "brightness": mean}
        outcome.rows.append(row)
    outcome.summary = {"brightness": {"value": mean, "low": None, "high": None, "n": 1, "unit": "1"}}
    return outcome.decide("Is the picture bright?", "Yes.", mean > least, f"its mean is {mean:.2f}")
'''


@pytest.mark.slow
def test_an_experiment_is_a_file_and_its_settings(fork):
    fork.write("dhtorch/experiments/paper/brightness.py", EXPERIMENT)
    settings = "# How bright is the picture?\n_target_: dhtorch.experiments.paper.brightness.run\n_partial_: true\nleast: 0.1\n"
    fork.write("conf/experiment/brightness.yaml", settings)
    assert len(fork.changed()) == 2
    said = fork.run("""
command("experiment=brightness", *ROOM, "experiment.least=0.05", "hydra.run.dir=job")
print("REPORT")
command("report", "job")
""")
    table = said.partition("REPORT")[2]
    assert "brightness" in table and "supported: its mean is" in table
