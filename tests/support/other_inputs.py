"""Small files of the inputs that are no captures: depth maps, results, calibrations, settings, models, references.

As in ``captures_by_format``: how to write one below a folder, and how to read all of it. Documented errors other than
FormatError count as one where they are one line that names the file.
"""

import contextlib
import io
import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import tifffile
import torch
import yaml
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from dhtorch import export
from dhtorch.cli import pin
from dhtorch.cli import run as commands
from dhtorch.data.codecs.exr import read_exr
from dhtorch.data.depth_maps import open_depth_maps
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models import read_model
from dhtorch.data.recording import Recording
from dhtorch.experiments import report
from dhtorch.export.frames import encode_png
from dhtorch.extract.enriched import DatasetCamera
from dhtorch.extract.features import FeatureTable
from dhtorch.extract.origin import LeRobotSource
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.shards import find_finished_shards
from dhtorch.measure.pin import CameraPin
from dhtorch.metrics import calibration
from dhtorch.runtime import results as result_files
from dhtorch.stages.score import LearnedScore
from dhtorch.viz.viewer.points import read_ply_exhibit
from support import room_models, writers
from support.captures_by_format import SAMPLES, Sample, small_walk
from support.damage_harness import read_all
from support.small_result import result

ROOT = Path(__file__).resolve().parents[2]


def as_format_error(read: Callable[[Path], Any], *kinds: type[Exception]) -> Callable[[Path], None]:
    """The reader with documented errors of one line that names the file as FormatError; others stay."""

    def guarded(path: Path) -> None:
        try:
            read(path)
        except FormatError:
            raise
        except kinds as error:
            if "\n" in str(error) or path.name not in str(error):
                raise
            raise FormatError(path, "content", error, "as documented") from None

    return guarded


# ---------------------------------------------------------------------------------------------------- depth maps


def recording() -> Recording:
    """Three frames in memory."""
    frames = [frame.replace(time=None, T_world_from_cam=None) for frame in small_walk()]
    return Recording("walk", "made", frames.__getitem__, torch.arange(3))


def write_maps(root: Path, suffix: str) -> None:
    """A map for every frame, in a folder as ``dhtorch complete`` writes it where they are PNG."""
    folder = root / "depth" if suffix == "png" else root
    folder.mkdir(exist_ok=True)
    maps = [frame.depth[0].numpy() for frame in small_walk()]
    if suffix == "npz":
        np.savez_compressed(root / "clip.npz", depth=np.stack(maps))
        return
    if suffix == "exr":
        writers.write_record3d_exr(root / "record", small_walk())
        for k, file in enumerate(sorted((root / "record").rglob("*.exr"))):
            read_exr(file)
            file.rename(root / f"{k}.exr")
        shutil.rmtree(root / "record")
        return
    for k, z in enumerate(maps):
        file = folder / f"{k}.{suffix}"
        if suffix == "npy":
            np.save(file, z)
        elif suffix == "tiff":
            tifffile.imwrite(file, z.astype(np.float32), compression="zlib", predictor=True)
        elif suffix == "pfm":
            file.write_bytes(f"Pf\n{z.shape[1]} {z.shape[0]}\n-1\n".encode() + z[::-1].astype("<f4").tobytes())
        else:
            file.write_bytes(encode_png((1000 * z).round().astype(np.uint16)))
    if suffix == "png":
        (root / "complete.json").write_text('{"unit_m": 0.001, "format": 1}')


def read_maps(path: Path) -> None:
    """Opens the folder, reads every map and what is doubted of them."""
    maps = open_depth_maps(path, recording())
    for i in range(3):
        depth = maps[i]
        if depth is not None:
            assert depth.ndim == 3 and depth.dtype == torch.float32
            assert bool(torch.isfinite(depth).all()) and 0 <= float(depth.min()) <= float(depth.max()) <= 10_000
    assert maps.doubts is not None and maps.notes and maps.report


# ------------------------------------------------------------------------------------ results, calibrations, settings


def write_result(root: Path, name: str | None) -> Path:
    """A result of the main job, or an archived one."""
    if name is None:
        return result_files.write_result(root / "result.json", result())
    return Path(shutil.copy(ROOT / "benchmarks" / "results" / f"{name}.json", root / "result.json"))


def read_result(path: Path) -> None:
    """Tables on the console and as Markdown."""
    with contextlib.redirect_stdout(io.StringIO()):
        for markdown in (False, True):
            options = {"result": [path], "html": None, "markdown": markdown}
            report.run(options, {}, progress=lambda items, *_: items)


def write_points(root: Path) -> Path:
    """Points as ``dhtorch complete`` writes them."""
    xyz = np.random.default_rng(0).normal(size=(40, 3))
    export.write_ply(root / "points.ply", xyz, sigma=np.ones(40), source=np.arange(40) % 3, comments=("up 0 1 0",))
    return root / "points.ply"


def write_calibration(root: Path) -> Path:
    """The table of the method ``map``."""
    return Path(shutil.copy(ROOT / "dhtorch" / "metrics" / "calibration" / "map.json", root / "mine.json"))


def read_calibration(path: Path) -> None:
    """Scores and sigmas after the calibration."""
    found = calibration.load_calibration(path)
    score = found.probability(torch.linspace(0, 1, 7, dtype=torch.float64))
    assert bool(((score >= 0) & (score <= 1)).all())


def write_learned_score(root: Path) -> Path:
    """A scorer with new weights."""
    return LearnedScore(4).save(root / "score.json")


#: Files of settings that a user may write, and the ones they are copied from.
USER_SETTINGS = {"method": "paper", "data": "synthetic"}


@cache
def _kept_folder(name: str) -> tempfile.TemporaryDirectory[str]:
    """A folder that is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix=f"dhtorch-{name}-")


@cache
def settings_folder() -> Path:
    """A copy of the settings with links to a user's files, which are set by :func:`read_settings`."""
    folder = Path(_kept_folder("settings").name)
    shutil.copytree(ROOT / "conf", folder, dirs_exist_ok=True)
    return folder


def write_settings(root: Path) -> None:
    """A method and data in files of a user."""
    for group, name in USER_SETTINGS.items():
        shutil.copy(ROOT / "conf" / group / f"{name}.yaml", root / f"{group}.yaml")


def read_settings(path: Path) -> None:
    """Composes the settings of ``dhtorch complete`` and makes their objects."""
    folder = settings_folder()
    for group in USER_SETTINGS:
        link = folder / group / "mine.yaml"
        if link.is_symlink() and link.readlink() != path / f"{group}.yaml":
            link.unlink()
        if not link.is_symlink():
            link.symlink_to(path / f"{group}.yaml")
    try:
        with mock.patch.object(commands, "config_dir", lambda: folder):
            commands.compose_settings("complete", ["method=mine", "data=mine", "out=x"])
    except FormatError:
        raise
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, ValueError, OSError, ImportError) as error:
        text = commands.format_error(commands.unwrap_cause(error))
        assert text and "\n" not in text
        raise FormatError(path, "settings", text, "as documented") from None


# ------------------------------------------------------------------------------------------------------- data sets


@cache
def _enriched() -> Path:
    folder = Path(_kept_folder("enriched").name)
    (folder / "source").mkdir()
    SAMPLES["lerobot_v3"][0](folder / "source")
    asked = ["method=paper", "method.n=32", "method.hypotheses=5", "gap=1", "dense=false", "report=false", "--quiet"]
    assert commands.main(["enrich", str(folder / "source"), str(folder / "set"), *asked]) == 0
    return folder / "set"


def write_enriched(root: Path) -> None:
    """A LeRobot set with depth of dhtorch."""
    shutil.copytree(_enriched(), root, dirs_exist_ok=True)


def read_source(path: Path) -> None:
    """All that ``dhtorch enrich`` reads of a LeRobot set beside its frames."""
    source = LeRobotSource.open(path, [0], bounds=path)
    tasks = list(source.tasks)
    rows = sum(part.num_rows for part in source.batches(0, tasks))
    assert source.fps > 0 and source.words(0) is not False and source.features
    assert (
        isinstance(source.meta_file("stats.json"), dict)
        and source.splits is not None
        and all(p.is_file() for p in source.more.values())
    )
    source.clips(0, rows)


def read_enriched(path: Path) -> None:
    """Frames, the tables as a source, and what a second run reads of the folder before it goes on."""
    read_all(path)
    read_source(path)
    shared = path / "meta" / "dhtorch.json"
    if shared.is_file():
        here = {"key": "another", "config": {}, "data": {"digest": ""}, "git": "x"}
        with contextlib.suppress(FileExistsError):
            result_files.check_same_run(path, shared, here, "enrich")
    camera = DatasetCamera("observation.images.front", (48, 64), (48, 64), posed=True)
    options = {"origin": None, "numbers": [0], "step": 0.0, "maps": ("depth",), "as_images": False, "fps": 30.0}
    target = LeRobotTarget(path, 3, {camera.key: camera}, **options, task=None, key="another")
    assert target.own(0) is None


@cache
def _extraction() -> Path:
    folder = Path(_kept_folder("extraction").name)
    (folder / "source").mkdir()
    SAMPLES["tum"][0](folder / "source")
    asked = ["method=paper", "method.n=32", "method.hypotheses=5", "gap=1", f"out={folder / 'set'}", "--quiet"]
    assert commands.main(["extract", str(folder / "source"), *asked]) == 0
    return folder / "set"


def write_extraction(root: Path) -> None:
    """Shards of ``dhtorch extract``."""
    shutil.copytree(_extraction(), root, dirs_exist_ok=True)


def read_extraction(path: Path) -> None:
    """Rows of the shards, and what a second run reads of them."""
    with contextlib.suppress(FileExistsError):
        find_finished_shards(path, {"key": "another", "config": {}, "data": {"digest": ""}, "git": "x"})
    table = FeatureTable(path)
    for i in range(len(table)):
        assert table[i]


# --------------------------------------------------------------------------------------------- models and references


def write_scale_model(root: Path, kind: str) -> Path:
    """A reconstruction of the room for ``dhtorch scale``."""
    write, what = {
        "colmap_txt": (room_models.write_colmap_text, "points"),
        "colmap_bin": (room_models.write_colmap_binary, "points"),
        "nerfstudio": (room_models.write_nerfstudio, "points"),
        "splat": (room_models.write_splat, "points"),
        "npz": (room_models.write_arrays, "maps"),
        "npz_views": (partial(room_models.write_arrays, one=False), "maps"),
    }[kind]
    write(root / "model", room_models.room_model(what)[0])
    return root / "model"


def read_scale_model(path: Path) -> None:
    """Every view of a model: camera, pose and depth of numbers."""
    model = read_model(path)
    assert bool(np.isfinite(model.xyz).all())
    for view in model.views:
        assert bool(np.isfinite(view.K).all()) and bool((view.K.diagonal() > 0).all())
        assert bool(np.isfinite(view.c2w).all()) and view.c2w.shape == (4, 4) and min(view.hw) > 0
        assert view.depth is None or bool(((view.depth >= 0) & np.isfinite(view.depth)).all())
        assert view.distortion is None or bool(np.isfinite(view.distortion).all())


def write_picture(root: Path) -> Path:
    """A picture of 96 x 72 of a camera that stands still."""
    image = np.random.default_rng(0).integers(0, 255, (18, 24, 3), dtype=np.uint8)
    cv2.imwrite(str(root / "before.png"), cv2.resize(image, (96, 72), interpolation=cv2.INTER_CUBIC))
    return root / "before.png"


def read_reference(path: Path) -> None:
    """A reference as ``dhtorch pin`` opens it."""
    stated = {"intrinsics": None, "K": None, "fov": None}
    settings = {"ref": path, "data": stated, "format": "auto", "ref_frames": 2}
    reference = pin._read_reference(settings)[0]
    try:
        CameraPin(reference)
    except ValueError as error:
        raise FormatError(path, "reference", error, "as documented") from None


#: By kind: a function that writes a small file or folder, and one that reads all of it.
OTHER_INPUTS: dict[str, Sample] = {
    **{
        f"depth_{suffix}": (partial(write_maps, suffix=suffix), read_maps)
        for suffix in ("npy", "npz", "png", "pfm", "tiff", "exr")
    },
    **{
        kind: (partial(write_result, name=name), as_format_error(read_result, ValueError, OSError))
        for kind, name in {"result": None, "result_census": "hole_census", "result_probe": "vo_probe"}.items()
    },
    "points": (write_points, as_format_error(read_ply_exhibit, ValueError)),
    "calibration": (write_calibration, as_format_error(read_calibration, ValueError, OSError)),
    "learned_score": (write_learned_score, as_format_error(LearnedScore.read, ValueError, OSError)),
    "settings": (write_settings, read_settings),
    "lerobot_source_v3": (SAMPLES["lerobot_v3"][0], read_source),
    "lerobot_source_v2": (SAMPLES["lerobot_v2"][0], read_source),
    "enriched": (write_enriched, read_enriched),
    "extraction": (write_extraction, read_extraction),
    **{
        f"model_{kind}": (partial(write_scale_model, kind=kind), read_scale_model)
        for kind in ("colmap_txt", "colmap_bin", "nerfstudio", "splat", "npz", "npz_views")
    },
    "pin_picture": (write_picture, as_format_error(read_reference, ValueError, OSError)),
    "pin_reference": (SAMPLES["tum"][0], as_format_error(read_reference, ValueError, OSError)),
}
