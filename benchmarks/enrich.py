"""``dhtorch enrich`` from every source format to every format it writes: opened again, compared, timed, weighed.

    python benchmarks/enrich.py --json benchmarks/results/enrich.json

Real sets come from DHTORCH_DATA; formats of which none is there are written by ``tests/support/writers`` with frames
of the built-in room. Few frames each: FRAMES of every recording. A process each; what counts is its processor time,
so that other work beside it matters little, less that of the same command once more, which finds everything done.

``compared`` counts the values of the result that were held against the source's, one by one: pictures, depth where
the sensor has one (within half a step), intrinsics, poses, columns, bytes of videos. What loaders of others make of
the sets is in ``benchmarks/results/clients.json``, by the same names of source and target.
"""

import argparse
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch import data
from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.recording import Recording
from dhtorch.extract.enriched import camera_key, to_rgb_uint8
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.records import Frame
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.synthetic.recording import SyntheticRoom

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support import writers
from support.writers.azure_kinect import write_azure_kinect
from support.writers.rosbag import write_rosbag
from support.writers.simulator_hdf5 import write_simulator_hdf5

FRAMES, STEP = 3, 2.0**-10
SHORT = (f"max_frames={FRAMES}", "dense={size: 160}")
TARGETS = {"lerobot v3.0": "lerobot", "lerobot v2.1": "v2.1", "nerfstudio": "nerfstudio", "the source's own": "same"}

#: Sources in DHTORCH_DATA: name → what the command is told beside the path.
REAL = {
    "tum_fr1_desk9": (),
    "holo_a": (),
    "r3d_door": (),
    "dgp_drive6cam": (),
    "middlebury_motorcycle": (),
    "gr00t_demo": ("data=lerobot", "data.fov=60", "data.episode=[0,1]", "without_depth=true"),
    "lerobot_g1": ("data=lerobot", "data.fov=69", "without_depth=true"),
    "rlds_bridge/bridge_dataset/1.0.0": (
        "data=rlds",
        "data.fov=60",
        "data.split=train",
        "data.episode=[0,1]",
        "without_depth=true",
    ),
    "apc_arm": (),
}
#: Written sources that have a writer of one signature, named by it.
LAYOUTS = ("bop", "replica", "scannet", "sens_folder", "open3d", "sun3d", "nerfstudio", "polycam", "colmap")


def written(folder: Path) -> dict[str, tuple[Path, tuple[str, ...]]]:
    """Sources of the other formats: name → path and the command's arguments beside it."""
    room = SyntheticRoom(hw=(72, 128), depth_hw=(72, 128), n_frames=4, supersample=1)
    frames = [room[i] for i in range(len(room))]
    makers: dict[str, Callable[[Path], Any]] = {
        "stray": lambda p: writers.write_stray(p, frames),
        "capture.r3d": lambda p: writers.write_r3d(p, frames),
        "arkitscenes/1": lambda p: writers.write_arkitscenes(
            p, {"lowres_wide": frames, "lowres_depth": frames}, trajectory=frames
        ),
        "ca1m/ca1m-val-1.tar": lambda p: writers.write_ca1m(p, frames, frames),
        "rh20t": lambda p: writers.write_rh20t(p, {"036422060909": frames}),
        "robot": lambda p: writers.write_lerobot(p, [frames, frames[:2]], depth="tiff"),
        **{f"layouts/{name}": partial(writers.CAPTURE_WRITERS[name].write, frames=frames) for name in LAYOUTS},
        "rosbag": lambda p: write_rosbag(p, frames),
        "azure_kinect.mkv": lambda p: write_azure_kinect(p, frames),
        "maniskill.h5": lambda p: write_simulator_hdf5(p, [frames, frames[:2]], "maniskill3"),
    }
    for name, make in makers.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        make(folder / name)
    paths = {name: next((folder / name).glob("task_*")) if name == "rh20t" else folder / name for name in makers}
    K = ",".join(f"{v:g}" for v in (*frames[0].camera.f[0].tolist(), *frames[0].camera.c[0].tolist()))
    options = {"azure_kinect.mkv": ("data=azure_kinect", f"data.K=[{K}]")}  # written without its calibration
    return {name: (path, options.get(name, ())) for name, path in paths.items()}


def run(words: Sequence[str]) -> tuple[subprocess.CompletedProcess[str], float]:
    """A command and the processor time that it took, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "dhtorch", *words], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def row(name: str, path: Path, arguments: Sequence[str], target: str, folder: Path) -> dict[str, Any]:
    """One source in one format."""
    out = folder / f"{name.replace('/', '_')}_{TARGETS[target]}"
    options = dict(word.removeprefix("data.").split("=", 1) for word in arguments if word.startswith("data."))
    source = data.open_all(path, **{k: json.loads(v) if v[0] in "[0123456789" else v for k, v in options.items()})
    record: dict[str, Any] = {"source": source[0].format, "data": name, "target": target}
    record |= {"options": " ".join([*arguments, *SHORT]), "origin": "written" if folder in path.parents else "real"}
    words = ["enrich", str(path), str(out), *arguments, *SHORT, f"format={TARGETS[target]}"]
    before = digest(path)
    done, seconds = run(words)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.startswith("dhtorch: ")]
        errors = [line for line in lines if not line.startswith("dhtorch: warning: ")]  # others: notes on the capture
        if len(errors) != 1 or out.exists():
            raise ValueError(f"{name} as {target}: found {errors} and {out.exists()=}, expected one line and no folder")
        return record | {"refused": errors[0].removeprefix("dhtorch: ").replace(f"{path.parent}{os.sep}", "")}
    again, idle = run(words)
    frames = sum(min(FRAMES, len(each)) for each in source)
    sizes = [p.stat().st_size for p in out.rglob("*") if p.is_file() and p.suffix != ".mp4" and p.parent.name != "meta"]
    about = out / "meta" / "info.json"  # of LeRobot sets
    rate = json.loads(about.read_text())["fps"] if about.is_file() else None
    return record | {
        "frames": frames,
        "s_per_frame": max(0.0, seconds - idle) / frames,
        "mb_per_minute": None
        if rate is None
        else sum(sizes) / 1e6 / frames * rate * 60 * len({camera_key(each) for each in source}),
        "mb_per_frame": sum(sizes) / 1e6 / frames,
        "printed": [line.strip() for line in done.stdout.splitlines()[1:]],
        "done_again": again.returncode == 0 and "left untouched" in again.stdout,
        "source_untouched": digest(path) == before,
        "compared": (nerfstudio if rate is None else robot)(path, source, out),
    }


def digest(path: Path) -> str:
    """Of all that lies there."""
    return result_files.compute_data_digest(result_files.list_files_below([(path, None)]))


# ------------------------------------------------------------------------------------------------------ comparing


def robot(path: Path, source: Sequence[Recording], out: Path) -> int:
    """A LeRobot set against its source; the number of values that are the same.

    Raises:
        ValueError: one that is not.
    """
    from pyarrow import parquet

    features = json.loads((out / "meta" / "info.json").read_text())["features"]
    rows = [r for table in sorted((out / "data").rglob("*.parquet")) for r in parquet.read_table(table).to_pylist()]
    by_camera: dict[str, list[Frame]] = {}
    for each in source:
        by_camera.setdefault(camera_key(each), []).extend(each[i] for i in range(min(FRAMES, len(each))))
    count = 0
    for key, frames in by_camera.items():
        column = next(k for k in (f"{key}_depth_enriched", f"{key}_depth") if k in features)
        opened = [
            f for each in data.open_all(out, camera=key, depth=column) for f in (each[i] for i in range(len(each)))
        ]
        for frame, again, cells in zip(frames, opened, rows[: len(frames)], strict=False):
            count += same(to_rgb_uint8(frame), to_rgb_uint8(again), f"{key} picture")
            stored = decode_tiff(cells[column]["bytes"], out, tuple(features[column]["shape"][:2]))
            count += same(again.depth[0].numpy(), stored, f"{key} depth")
            count += close(frame, again, f"{key}")
    return count + columns(path, rows, out)


def close(frame: Frame, again: Frame, what: str) -> int:
    """Camera and pose of a frame."""
    K, K_again = (cam.to_matrix(f.camera)[0].double().numpy() for f in (frame, again))
    count = same(K.astype(np.float32), K_again.astype(np.float32), f"{what} intrinsics")
    if frame.T_world_from_cam is not None and again.T_world_from_cam is not None:
        T, T_again = (se3.to_matrix(f.T_world_from_cam).numpy() for f in (frame, again))  # type: ignore[arg-type]
        if np.abs(T - T_again).max() > 1e-6:
            raise ValueError(f"{what} pose: off by {np.abs(T - T_again).max():.3g}")
        count += T.size
    return count


def columns(path: Path, rows: Sequence[Mapping[str, Any]], out: Path) -> int:
    """The columns and videos of a LeRobot source."""
    from pyarrow import parquet

    if not (path / "meta" / "info.json").is_file():
        return 0
    count, at = 0, 0
    for table in sorted((path / "data").rglob("*.parquet")):
        read = parquet.read_table(table).to_pylist()
        episodes = list(dict.fromkeys(r["episode_index"] for r in read))
        wanted = {r.get("source.episode_index", r["episode_index"]) for r in rows}
        for number in (n for n in episodes if n in wanted):
            for before in [r for r in read if r["episode_index"] == number][:FRAMES]:
                after = rows[at]
                kept = {k: after.get(f"source.{k}", after[k]) for k in before}
                if kept != before:
                    raise ValueError(f"columns of row {at}: {[k for k in before if kept[k] != before[k]]}")
                count, at = count + len(before), at + 1
    for video in out.rglob("*.mp4"):
        key = next(part for part in video.parts if part.startswith("observation."))
        if video.read_bytes() not in {p.read_bytes() for p in path.rglob("*.mp4") if key in str(p)}:
            raise ValueError(f"{video.name}: not the source's bytes")
        count += video.stat().st_size
    return count


def nerfstudio(path: Path, source: Sequence[Recording], out: Path) -> int:
    """nerfstudio folders against their source."""
    from PIL import Image

    count = 0
    for file in sorted(out.rglob("transforms.json")):
        about = json.loads(file.read_text())
        name = str(file.parent.relative_to(out))
        recording = next(each for each in source if name in (".", each.name))
        for i, shot in enumerate(about["frames"]):
            frame = recording[i]
            picture = np.array(Image.open(io.BytesIO((file.parent / shot["file_path"]).read_bytes())))
            count += same(to_rgb_uint8(frame), picture, "picture")
            K = cam.to_matrix(frame.camera)[0].double().numpy()
            stored = [shot["fl_x"], shot["fl_y"], shot["cx"] - 0.5, shot["cy"] - 0.5]
            count += same(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32), np.array(stored, np.float32), "K")
            depth = np.array(Image.open(file.parent / shot["depth_file_path"])) * about["depth_unit_scale_factor"]
            if not (depth >= 0).all() or depth.max() > 65.6:
                raise ValueError(f"{name}: depth up to {depth.max()} m")
            count += depth.size
    return count


def same(a: np.ndarray, b: np.ndarray, what: str) -> int:
    """Their number of values.

    Raises:
        ValueError: any is another.
    """
    if a.shape != b.shape or not np.array_equal(a, b):
        raise ValueError(
            f"{what}: {a.shape} and {b.shape} differ in {np.sum(a != b) if a.shape == b.shape else 'size'}"
        )
    return a.size


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="sources whose name contains one of these")
    options = parser.parse_args()
    home, rows = Path(os.environ["DHTORCH_DATA"]), []
    with tempfile.TemporaryDirectory(prefix="dhtorch-enrich-") as place:
        folder = Path(place)
        sources = {name: (home / name, arguments) for name, arguments in REAL.items() if (home / name).exists()}
        sources |= written(folder / "written")
        for target in TARGETS:
            for name, (path, arguments) in sources.items():
                if options.only is not None and not any(part in name for part in options.only):
                    continue
                record = row(name, path, arguments, target, folder)
                record |= {"processor": result_files.describe_processor(), "cores": os.cpu_count()}
                rows.append(record)
                print(record, flush=True)
                options.json.write_text(storage.dump_strict_json(storage.to_strict_json(rows), indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
