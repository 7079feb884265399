"""Compare the results of two checkouts of this project bit for bit.

    python benchmarks/same_bits.py OLD NEW                     every shared scene, two anchors each
    python benchmarks/same_bits.py OLD NEW --quick             three scenes, one anchor each
    python benchmarks/same_bits.py OLD NEW --cache FOLDER      keep the results of OLD for the next comparison
    python benchmarks/same_bits.py OLD NEW --only "room auto"  items whose name contains the text

Each checkout runs in processes of its own (working directory and PYTHONPATH are the checkout), once in plain torch and
once with the compiled operators, which are built first. An item is one call: a method, dense completion, alignment,
validation, a transform of a sample, or a shard of ``dhtorch extract``. Every tensor of its result, traces included, is
reduced to the SHA-256 digest of dtype, shape and bytes, and the digests are compared.

Rows: item, mode, number of tensors, ``same`` or ``DIFFERENT`` with the tensors that differ and the largest absolute
difference over the values that were kept of them (at most 2048, evenly spaced). The last line is ``K of N equal``; the
exit code is 0 if all are equal, else 1. Real scenes are read from DHTORCH_DATA.

Names may differ between the checkouts: functions are found through ``NAMES``, arguments through ``ARGUMENTS``, files
through the lists beside them, the current name first. Fields and keys of results are matched by name, after ``FIELDS``,
and those left over by position. Where a lookup fails the row says so; the new name is then to be added here.
"""

import argparse
import dataclasses
import hashlib
import importlib
import inspect
import json
import math
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

#: Modules below are named without it.
PACKAGE = "dhtorch"

#: What a function, class or table is called here → where it may be, the current name first.
NAMES: dict[str, tuple[str, ...]] = {
    "methods": ("pipeline.presets.METHODS", "methods.METHODS"),
    "track_hint": ("TrackHint", "records.TrackHint"),
    "pose": ("Pose", "records.Pose"),
    "pose_prior": ("PosePrior", "records.PosePrior", "records.GivenPose"),
    "initial_pose": ("InitialPose", "records.InitialPose", "records.StartPose"),
    "collate": ("collate", "pytree.collate", "tree.collate"),
    "merge": ("merge", "pipeline.pair.merge", "pair.merge"),
    "room": ("synthetic.SyntheticRoom", "synthetic.recording.SyntheticRoom"),
    "complete_depth": (
        "complete_depth",
        "pipeline.completion.complete_depth",
        "pipeline.dense.complete",
        "dense.complete",
    ),
    "sensor_depth_map": (
        "pipeline.dense.sensor_depth_map",
        "pipeline.dense.sensed",
        "dense.sensed",
    ),
    "align_depth": (
        "align_depth",
        "alignment.align.align_depth",
        "alignment.align_depth",
        "alignment.align.anchor",
        "metric.anchor",
    ),
    "map_kinds": (
        "alignment.align.ALIGNMENT_KINDS",
        "alignment.ALIGNMENT_KINDS",
        "alignment.align.KINDS",
        "metric.KINDS",
    ),
    "validate_depth": (
        "validate_depth",
        "validation.validate.validate_depth",
        "validation.validate_depth",
        "validation.validate.judge",
        "verdict.judge",
    ),
    "quick_method": (
        "validation.validate.QUICK_METHOD",
        "validation.QUICK_METHOD",
        "validation.validate.QUICK",
        "verdict.QUICK",
    ),
    "ExtendDepth": ("transforms.ExtendDepth", "transform.ExtendDepth"),
    "ValidateDepth": (
        "transforms.ValidateDepth",
        "transforms.JudgeDepth",
        "transform.JudgeDepth",
    ),
    "SampleSpec": (
        "transforms.SampleSpec",
        "transforms.sample_spec.SampleSpec",
        "transforms.Views",
        "transform.Views",
    ),
}

#: Argument → how it may be spelled, the current name first; others are spelled as they are.
ARGUMENTS: dict[str, tuple[str, ...]] = {
    "fit": ("fit", "pose", "pose_fit", "pose_prior"),
    "hw": ("hw", "image_hw"),
    "kind": ("kind", "depth_kind", "map_kind"),
    "partners": ("max_sources", "source_views", "n_sources", "sources", "partners"),
    "views": ("photometric", "use_views", "views"),
    "map": ("depth_map", "map_key", "map"),
    "validation": ("validation", "validate", "options", "judging"),
    "dense": ("dense", "complete"),
}

#: Field or key of an old result → its current name; only where matching by position is not enough.
FIELDS: dict[str, str] = {
    "looks": "matched_convention",
    "pose_looks": "pose_matched_convention",
    "worth": "gain",
    "mute": "no_answer",
    "ruler": "scale_vs_trajectory",
    "by_answers": "sparse_evidence",
    "by_views": "photometric_evidence",
    "by_maps": "consistency_evidence",
    "ceiling": "clip_depth",
}

#: Modules whose command builds the compiled operators, the current one first, and the variables that switch them on.
BUILDERS = ("ops", "ops.loader", "ops.build", "native")
SWITCHES = ("DHTORCH_OPS", "DHTORCH_NATIVE")

#: Folders of the settings in a checkout.
SETTINGS = ("conf", "dhtorch/conf")

MODES = ("plain", "compiled")

METHODS = ("paper", "map", "window", "auto")

#: Scenes of the quick mode; those on which completion, alignment and validation run, the first of them in quick mode.
QUICK_SCENES = ("holo_a", "7s_redkitchen_000", "tum_fr1_desk9")
MAP_SCENES = ("holo_a", "7s_redkitchen_400", "dgp_drive6cam/CAMERA_01", "tum_fr1_desk9")

#: Frames around an anchor that are offered to a method which selects its views.
LADDER = (1, 2, 3, 5, 8, 12, 20, 30)

#: Frames between an anchor and the other view, at most, for a method of several views.
WINDOW = 5

#: Longer side of a map that is aligned, at most, px.
ALIGNED = 720

#: Values kept of a tensor for the size of a difference, and tensors named in a row.
KEPT, NAMED = 2048, 4

Item = tuple[str, Callable[[], Any]]


# -------------------------------------------------------------------------------------------------------------- names


def resolve(key: str) -> Any:
    """The object of that key in this checkout.

    Raises:
        LookupError: the checkout has none of the candidates.
    """
    failures = []
    for dotted in NAMES[key]:
        module, _, attribute = f"{PACKAGE}.{dotted}".rpartition(".")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ModuleNotFoundError, AttributeError) as error:
            failures.append(str(error))
    raise LookupError(f"{key}: no such name ({'; '.join(failures)})")


def call(function: Callable[..., Any], *args: Any, accepts: Sequence[Any] = (), **options: Any) -> Any:
    """``function(*args, **options)``, options spelled as this checkout does; ``accepts`` lists what may take them too.

    Raises:
        LookupError: an option has none of its known spellings.
    """
    known = {name for each in (function, *accepts) for name in inspect.signature(each).parameters}
    spelled = {}
    for option, value in options.items():
        names = [name for name in ARGUMENTS.get(option, (option,)) if name in known]
        if not names:
            raise LookupError(f"{option}: no such argument among {', '.join(sorted(known))}")
        spelled[names[0]] = value
    return function(*args, **spelled)


def settings_folder() -> Path:
    """The folder of settings of this checkout."""
    return next(path for path in map(Path, SETTINGS) if (path / "data").is_dir())


def composed(path: str) -> Any:
    """What a file of settings makes, as the command does."""
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    return instantiate(OmegaConf.load(settings_folder() / path), _convert_="all")


def method(name: str) -> Any:
    """The method of that name; ``window`` is ``map`` of five source views."""
    return resolve("methods")["map"].replace(views=5) if name == "window" else resolve("methods")[name]


# ------------------------------------------------------------------------------------------------------------- inputs


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """An anchor of a recording and the frames around it."""

    name: str
    recording: Any
    anchor: int  # position in the recording
    gap: int  # positions to the other view
    near: float  # m, returns beyond are held back
    levels: int | None = None  # pyramid levels that the motion asks for

    def frame(self, k: int) -> Any:
        """Frame ``k`` without the returns beyond the near limit.

        The image is contiguous: compiled operators decline others, such as those of the built-in room.
        """
        frame = self.recording[k]
        depth = torch.where(frame.depth > self.near, torch.zeros_like(frame.depth), frame.depth)
        return frame.replace(image=frame.image.contiguous(), depth=depth)

    @property
    def view(self) -> Any:
        """The anchor."""
        return self.frame(self.anchor)

    @property
    def other(self) -> Any:
        """The other view of a pair."""
        return self.frame(self.anchor + self.gap)

    @property
    def between(self) -> list[Any]:
        """The other view, and frames on the way to it."""
        steps = {math.ceil(self.gap * (k + 1) / WINDOW) for k in range(WINDOW)}
        return [self.frame(self.anchor + step) for step in sorted(steps)]

    @property
    def around(self) -> list[Any]:
        """Frames before and after the anchor."""
        places = sorted(self.anchor + way * step for step in LADDER for way in (-1, 1))
        return [self.frame(k) for k in places if 0 <= k < len(self.recording)]

    @property
    def depth(self) -> Tensor:
        """(1, h, w) m, 0 = not known: the truth of a room, else all returns of the sensor."""
        truth = getattr(self.recording, "truth", None)
        return self.recording[self.anchor].depth if truth is None else truth(self.anchor)["depth"]

    def options(self) -> dict[str, Any]:
        """What a method is told of the motion."""
        return {"hint": resolve("track_hint")(levels=self.levels)}


@cache
def room(hw: tuple[int, int] = (240, 320), supersample: int = 1) -> Any:
    """The built-in recording."""
    sizes = {"hw": hw, "depth_hw": (hw[0] * 2 // 5, hw[1] * 2 // 5), "supersample": supersample}
    return call(resolve("room"), seed=2, n_frames=12, **sizes)


@cache
def scenes() -> list[Any]:
    """The shared scenes of this checkout."""
    return list(composed("data/shared_scenes.yaml"))


def scene_cases(names: Sequence[str] | None, wanted: int) -> list[Case]:
    """Anchors of the shared scenes of these names, or of all."""
    selected = []
    for scene in scenes():
        # Notes of a scene by position: recording, near limit, gap, levels.
        recording, near, gap, levels = (getattr(scene, field.name) for field in dataclasses.fields(scene)[:4])
        if names is not None and recording.name not in names:
            continue
        last = len(recording) - 1 - gap
        anchors = {last // 2} if wanted == 1 else {last // 3, last - last // 3}
        selected += [Case(f"{recording.name}[{k}]", recording, k, gap, near, levels) for k in sorted(anchors)]
    return selected


def sample() -> dict[str, Any]:
    """A sample as a data loader has it: an anchor, the frames before it and a map to validate."""
    frames = [room()[k] for k in (0, 3, 6)]
    anchor = frames[-1]
    images = [frame.image[0].permute(1, 2, 0).contiguous().numpy() for frame in frames]
    poses = [_matrix(frame.T_world_from_cam) for frame in frames]
    (fx, fy), (cx, cy) = (x[0].tolist() for x in (anchor.camera.f, anchor.camera.c))
    return {
        "image": images[-1],
        "before": images[0],
        "images": np.stack(images),
        "depth": (anchor.depth[0] * 1000).round().numpy().astype(np.uint16),
        "intrinsics": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32),
        "pose": poses[-1],
        "pose_before": poses[0],
        "map": 1.1 * room().truth(6)["depth"][0].numpy(),
    }


def _matrix(pose: Any) -> np.ndarray:
    """A pose (1) as a 4×4 matrix."""
    matrix = torch.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.R[0], pose.t[0]
    return matrix.numpy()


# -------------------------------------------------------------------------------------------------------------- items


def items(quick: bool, data: bool) -> list[Item]:
    """Everything that is compared, by name."""
    small = Case("room", room(), 3, 6, 2.0)
    cases = [small]
    if not quick:
        cases.append(Case("large room", room((480, 640), 2), 2, 6, 2.0))
    on_maps = [small]
    if data:
        cases += scene_cases(QUICK_SCENES if quick else None, 1 if quick else 2)
        on_maps += scene_cases(MAP_SCENES[:1] if quick else MAP_SCENES, 1)
    items = [item for case in cases for item in method_items(case)]
    items += [item for case in on_maps for item in map_items(case, quick)]
    return items + room_items(small) + transform_items() + command_items(quick)


def method_items(case: Case) -> list[Item]:
    """The frames of a case, and every method on them."""
    items: list[Item] = [(f"{case.name} frames", lambda: {"view": case.recording[case.anchor], "other": case.other})]
    return items + [(f"{case.name} {name}", partial(run_method, case, name)) for name in METHODS]


def run_method(case: Case, name: str) -> Any:
    """The trace of a method with its answer, and the map of the user."""
    others = case.between if name.startswith("window") else case.around if name == "auto" else case.other
    trace: dict[str, Any] = {}
    estimate = call(method(name), case.view, others, trace=trace, **case.options())
    return {"estimate": estimate, "map": resolve("merge")(trace["samples"], estimate), "trace": trace}


def map_items(case: Case, quick: bool) -> list[Item]:
    """Completion, alignment and validation of depth maps."""
    size = 192 if quick else 320
    name, steps = case.name, {"size": size, "planes": 48}
    items: list[Item] = [
        (f"{name} complete, pair", lambda: completed(case, "map", case.other, **steps)),
        (f"{name} complete, views", lambda: completed(case, "auto", case.between, **steps)),
        (
            f"{name} complete, sensor alone",
            lambda: call(resolve("sensor_depth_map"), case.view, size=size, method=method("map")),
        ),
    ]
    kinds = range(5) if case.name == "room" or (case.name.startswith(MAP_SCENES[0]) and not quick) else range(1)
    items += [(f"{name} align, kind {k + 1}", partial(aligned, case, k)) for k in kinds]
    wrong = {"depth": 1.1 * case.depth, "size": size}
    items += [
        (f"{name} validate, map", lambda: validated(case, case.between, **wrong)),
        (f"{name} validate, sensor", lambda: validated(case, case.between, depth=None, size=size)),
        (f"{name} validate, no other view", lambda: validated(case, None, **wrong)),
        (f"{name} validate, quick", lambda: validated(case, case.other, quick=True, views=False, **wrong)),
    ]
    return items


def completed(case: Case, name: str, others: Any, **options: Any) -> Any:
    """A dense map and the trace of the sparse method."""
    trace: dict[str, Any] = {}
    more = {**case.options(), **options, "method": method(name).replace(n=1024), "trace": trace}
    return {"map": call(resolve("complete_depth"), case.view, others, **more), "trace": trace}


def aligned(case: Case, kind: int) -> Any:
    """A map of the kind at that place of the list of kinds, brought to metres by near returns and far answers."""
    every = -(-max(case.depth.shape[-2:]) // ALIGNED)
    depth = case.depth[:, ::every, ::every]
    known = depth > 0
    value = [0.9 * depth + 0.05, 7 * depth, 3 * depth - 1, 40 / depth.clamp_min(1e-3) + 3, depth.square()][kind]
    trace: dict[str, Any] = {}
    estimate = method("map")(case.view, case.other, trace=trace)
    references = [trace["samples"], estimate]
    chosen: dict[str, Any] = {}
    more = {"hw": case.view.hw, "kind": resolve("map_kinds")[kind], "trace": chosen}
    answer = call(resolve("align_depth"), torch.where(known, value, torch.nan), references, **more)
    return {"map": answer, "trace": chosen}


def validated(case: Case, others: Any, *, depth: Tensor | None, quick: bool = False, **options: Any) -> Any:
    """What is said of a depth map, of the sensor's own where it is None."""
    more = {**case.options(), **options, "method": resolve("quick_method") if quick else method("auto").replace(n=1024)}
    return call(resolve("validate_depth"), depth, case.view, others, **more)


def room_items(case: Case) -> list[Item]:
    """Other ways to call a method: from settings, in a batch, with a pose from elsewhere, with a graph."""
    items: list[Item] = []
    for name in ("paper", "map", "auto"):
        others = case.other if name in ("paper", "map") else case.between
        items.append((f"room {name} from settings", partial(from_settings, case, name, others)))
    items += [(f"room {name}, batch of 2", partial(batch_of_two, case, name)) for name in ("paper", "map")]
    items += [(f"room map, {key}", partial(with_pose, case, key)) for key in ("pose_prior", "initial_pose")]
    return [*items, ("room map, gradient", partial(gradient, case))]


def from_settings(case: Case, name: str, others: Any) -> Any:
    """The answer of a method as the settings compose it."""
    return composed(f"method/{name}.yaml")(case.view, others)


def batch_of_two(case: Case, name: str) -> Any:
    """Two pairs in one call."""
    anchor, other = (resolve("collate")([case.frame(k), case.frame(k + 1)]) for k in (1, 7))
    trace: dict[str, Any] = {}
    return {"estimate": method(name)(anchor, other, trace=trace), "trace": trace}


def with_pose(case: Case, key: str) -> Any:
    """A pair whose pose is given, of the class of that key."""
    views = case.view, case.other
    a, b = (torch.from_numpy(_matrix(view.T_world_from_cam)).double() for view in views)
    T = (torch.linalg.inv(b) @ a).float()
    prior = resolve(key)(resolve("pose")(T[None, :3, :3].contiguous(), T[None, :3, 3].contiguous()))
    trace: dict[str, Any] = {}
    return {"estimate": call(method("map"), *views, fit=prior, trace=trace), "trace": trace}


def gradient(case: Case) -> Any:
    """Derivatives of the recovered depths with respect to images and near depth."""
    images = [view.image.float().div(255).requires_grad_() for view in (case.view, case.other)]
    depth = case.view.depth.clone().requires_grad_()
    with torch.enable_grad():
        anchor, other = case.view.replace(image=images[0], depth=depth), case.other.replace(image=images[1])
        estimate = method("map")(anchor, other, n=512)
        return torch.autograd.grad(estimate.depth.nan_to_num().sum(), [*images, depth])


def transform_items() -> list[Item]:
    """Transforms of a sample."""
    small = {"size": 96, "planes": 32}
    several = {"method": "auto", "image": "images", "other_at": [0, 1]}
    posed = {"other_image": "before", "pose": "pose", "other_pose": "pose_before"}
    options: dict[str, dict[str, Any]] = {
        "one view": {},
        "one view, dense": {"dense": small},
        "two views, paper": {"other_image": "before"},
        "two views, map": {"method": "map", "other_image": "before"},
        "two views, pose": {"method": "map", **posed},
        "two views, dense": {"method": "map", "other_image": "before", "dense": small},
        "three views": several,
    }
    items: list[Item] = [(f"ExtendDepth, {name}", partial(extended, **o)) for name, o in options.items()]
    items.append(("ExtendDepth, batch", lambda: extended(batched=True)))
    for name, o in {"sensor": {}, "map": {"map": "map"}, "two views": {"map": "map", "other_image": "before"}}.items():
        items.append((f"ValidateDepth, {name}", partial(checked, **o)))
    return items


def extended(**options: Any) -> Any:
    """What ExtendDepth adds to the sample."""
    more = {"n": 512, "patch": 16, "depth_unit": "mm", **options}
    transform = call(resolve("ExtendDepth"), accepts=[resolve("SampleSpec")], **more)
    return _added(transform, two_of(sample()) if options.get("batched") else sample())


def checked(**options: Any) -> Any:
    """What ValidateDepth adds to the sample."""
    more = {"n": 512, "depth_unit": "mm", "validation": {"size": 160}, **options}
    return _added(call(resolve("ValidateDepth"), accepts=[resolve("SampleSpec")], **more), sample())


def two_of(sample: Mapping[str, Any]) -> dict[str, Any]:
    """A collated batch of the sample with itself."""
    return {key: torch.from_numpy(np.stack([value, value])) for key, value in sample.items()}


def _added(transform: Callable[[Any], Any], sample: Mapping[str, Any]) -> dict[str, Any]:
    """The keys that a transform adds."""
    return {key: value for key, value in transform(sample).items() if key not in sample}


def command_items(quick: bool) -> list[Item]:
    """Files that the command writes."""
    items: list[Item] = [("extract, map", lambda: shard("method=map"))]
    if not quick:
        items.append(("extract, auto, dense", lambda: shard("method=auto", "extract.dense={size: 96}")))
    return items


def shard(*words: str) -> dict[str, Any]:
    """The columns of the Parquet files of ``dhtorch extract`` on a small recording."""
    from pyarrow import parquet

    with tempfile.TemporaryDirectory() as folder:
        shown = ["data=synthetic", "data.n_frames=4", "data.hw=[120,160]", "data.depth_hw=[48,64]", "method.n=256"]
        command = [sys.executable, "-m", "dhtorch", "extract", *shown, *words, f"out={folder}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{shlex.join(command)}: exit code {done.returncode}, {done.stderr.strip()[-500:]}")
        tables = [parquet.read_table(file) for file in sorted(Path(folder).glob("*.parquet"))]
    return {name: [_column(table[name]) for table in tables] for name in tables[0].column_names}


def _column(column: Any) -> np.ndarray:
    """A column of a table as one array."""
    return np.asarray(column.to_pylist())


# ------------------------------------------------------------------------------------------------- one checkout, a mode


class Leaf(NamedTuple):
    """One tensor of a result."""

    label: str
    digest: str
    dtype: str
    shape: list[int]


def leaves(value: Any, label: str = "") -> Iterator[tuple[str, Tensor | np.ndarray]]:
    """The tensors and arrays in a result with their places; times, texts and options are left out."""
    if isinstance(value, Tensor | np.ndarray):
        yield label, value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from leaves(getattr(value, field.name), f"{label}.{field.name}")
    elif isinstance(value, Mapping):
        for key, part in value.items():
            yield from leaves(part, f"{label}.{key}")
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        for key, part in zip(value._fields, value, strict=True):
            yield from leaves(part, f"{label}.{key}")
    elif isinstance(value, list | tuple):
        for k, part in enumerate(value):
            yield from leaves(part, f"{label}.{k}")


def reduced(label: str, value: Tensor | np.ndarray) -> tuple[Leaf, np.ndarray]:
    """The digest of a tensor, and some of its values as float64."""
    array = value.detach().cpu().resolve_neg().numpy() if isinstance(value, Tensor) else value
    if array.dtype.kind in "OUS":  # texts
        kept, content = np.zeros(0), repr(array.tolist()).encode()
    else:
        flat = np.ascontiguousarray(array).reshape(-1)
        kept, content = flat[:: max(1, -(-flat.size // KEPT))].astype(np.float64), flat.tobytes()
    head = f"{array.dtype} {array.shape} ".encode()
    digest = hashlib.sha256(head + content).hexdigest()
    return Leaf(label.lstrip("."), digest, str(array.dtype), list(array.shape)), kept


def dump(path: Path, quick: bool, threads: int, only: str, data: bool) -> None:
    """Run all items in the checkout of the working directory; write digests to ``path`` and values beside it.

    Raises:
        RuntimeError: another copy of the project would be imported.
    """
    import cv2

    import dhtorch

    if Path.cwd() not in Path(dhtorch.__file__).resolve().parents:
        raise RuntimeError(f"found {dhtorch.__file__}, expected a file below {Path.cwd()}")
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    rows: dict[str, Any] = {}
    values: dict[str, np.ndarray] = {}
    with torch.no_grad():
        for name, compute in items(quick, data):
            if only in name:
                began = time.perf_counter()
                rows[name] = measured(compute, values)
                print(f"  {name}: {time.perf_counter() - began:.1f} s", file=sys.stderr, flush=True)
    loaded = any("dhtorch" in Path(file).name for file in torch.ops.loaded_libraries)
    np.savez(path.with_suffix(".npz"), **values)  # type: ignore[arg-type]
    path.write_text(json.dumps({"loaded": loaded, "items": rows}), encoding="utf-8")


def measured(compute: Callable[[], Any], values: dict[str, np.ndarray]) -> list[Leaf] | str:
    """The reduced tensors of an item, their values added by digest; the error where there is one."""
    digests = []
    try:
        for label, tensor in leaves(compute()):
            leaf, kept = reduced(label, tensor)
            values.setdefault(leaf.digest, kept)
            digests.append(leaf)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return digests if digests else "no tensor"


# ---------------------------------------------------------------------------------------------------- both checkouts


class Dump(NamedTuple):
    """What one checkout gave in one mode."""

    loaded: bool  # the compiled operators
    items: dict[str, list[Leaf] | str]
    values: Mapping[str, np.ndarray]

    @classmethod
    def read(cls, path: Path) -> "Dump":
        """The contents of the files that :func:`dump` wrote."""
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = {name: x if isinstance(x, str) else [Leaf(*leaf) for leaf in x] for name, x in content["items"].items()}
        return cls(content["loaded"], rows, np.load(path.with_suffix(".npz")))


def environment(checkout: Path, mode: str, threads: int) -> dict[str, str]:
    """Variables of a process that runs a checkout in a mode."""
    kept = {name: value for name, value in os.environ.items() if name not in SWITCHES}
    switched = dict.fromkeys(
        SWITCHES, "1" if mode == "compiled" else "0"
    )  # a library in the cache loads without a word
    return {**kept, **switched, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(threads)}


def build(checkout: Path) -> None:
    """Compile the operators of a checkout, unless that was done.

    Raises:
        RuntimeError: the checkout has no such command, or it fails.
    """
    for module in (f"{PACKAGE}.{builder}" for builder in BUILDERS):
        stem = checkout / module.replace(".", "/")
        if stem.with_suffix(".py").is_file() or (stem / "__main__.py").is_file():
            words = [sys.executable, "-m", module]
            plain = environment(checkout, "plain", 1)
            done = subprocess.run(words, cwd=checkout, env=plain, capture_output=True, text=True, check=False)
            if done.returncode:
                raise RuntimeError(f"{checkout}: {shlex.join(words)} failed, {done.stderr.strip()[-1000:]}")
            return
    raise RuntimeError(f"{checkout}: found none of {', '.join(BUILDERS)}")


def compiler() -> bool:
    """Whether there is a C++ compiler."""
    return any(map(shutil.which, [*shlex.split(os.environ.get("CXX", ""))[:1], "c++", "g++", "clang++"]))


def run(checkout: Path, mode: str, path: Path, options: argparse.Namespace) -> None:
    """Write what a checkout gives in a mode to ``path``.

    Raises:
        RuntimeError: the process failed.
    """
    words = [sys.executable, "-P", str(Path(__file__).resolve()), ".", ".", "--dump", str(path)]
    words += ["--threads", str(options.threads), "--only", options.only, *["--quick"] * options.quick]
    stderr = None if options.verbose else subprocess.PIPE
    env = environment(checkout, mode, options.threads)
    done = subprocess.run(words, cwd=checkout, env=env, stderr=stderr, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{checkout}, {mode}: exit code {done.returncode}\n{(done.stderr or '').strip()[-2000:]}")


def state(checkout: Path) -> str:
    """What tells the code of a checkout from another: its commit, or paths and contents where it has changes."""
    if shutil.which("git"):
        git = ["git", "--no-optional-locks", "-C", str(checkout)]
        commit, changes = (
            subprocess.run([*git, *words], capture_output=True, text=True, check=False)
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--", "dhtorch", "conf"])
        )
        if commit.returncode == 0 and changes.returncode == 0 and not changes.stdout.strip():
            return commit.stdout.strip()
    files = sorted(path for part in ("dhtorch", "conf") for path in (checkout / part).rglob("*") if path.is_file())
    sources = [path for path in files if "__pycache__" not in path.parts]
    return "\n".join(f"{path} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in sources)


def cache_key(checkout: Path, mode: str, options: argparse.Namespace) -> str:
    """The name of a cached result: it depends on the code, this script, the machine, and what is asked."""
    machine = (torch.__version__, platform.platform(), torch.backends.cpu.get_cpu_capability())
    request = (mode, options.quick, options.threads, options.only, os.environ.get("DHTORCH_DATA"))
    parts = (state(checkout), Path(__file__).read_text(encoding="utf-8"), *machine, *request)
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:24]


def obtained(task: tuple[str, str], folder: Path, temporary: Path, options: argparse.Namespace) -> Dump:
    """What OLD or NEW gives in a mode; OLD from the cache where it has it."""
    role, mode = task
    old = role == "OLD"
    checkout = (options.old if old else options.new).resolve()
    path = folder / f"{cache_key(checkout, mode, options)}.json" if old else temporary / f"new-{mode}.json"
    began, known = time.perf_counter(), path.is_file()
    if not known:
        run(checkout, mode, path, options)
    dump = Dump.read(path)
    took = "from the cache" if known else f"{time.perf_counter() - began:.0f} s"
    print(f"{role} {mode}: {len(dump.items)} items, {took}", file=sys.stderr, flush=True)
    return dump


# --------------------------------------------------------------------------------------------------------- comparison


def matched(old: Sequence[Leaf], new: Sequence[Leaf]) -> tuple[list[tuple[Leaf, Leaf]], list[str]]:
    """Tensors of both sides that belong together, and complaints about those without a partner.

    They are matched by label; those left over in the order in which they come, if there are equally many.
    """
    by_label = {leaf.label: leaf for leaf in new}
    pairs, left = [], []
    for leaf in old:
        renamed = ".".join(FIELDS.get(part, part) for part in leaf.label.split("."))
        other = by_label.pop(leaf.label, None) or by_label.pop(renamed, None)
        if other is None:
            left.append(leaf)
        else:
            pairs.append((leaf, other))
    rest = list(by_label.values())
    if len(rest) == len(left):
        return [*pairs, *zip(left, rest, strict=True)], []
    return pairs, [f"only in OLD: {x.label}" for x in left] + [f"only in NEW: {x.label}" for x in rest]


def difference(a: Leaf, b: Leaf, old: Dump, new: Dump) -> str:
    """How a tensor differs, with its new name."""
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return f"{b.label} ({a.dtype} {a.shape} → {b.dtype} {b.shape})"
    x, y = old.values[a.digest], new.values[b.digest]
    both = np.isfinite(x) & np.isfinite(y)
    largest = np.abs(x[both] - y[both]).max(initial=0.0)
    others = int((~both & ~(np.isnan(x) & np.isnan(y)) & (x != y)).sum())
    extra = f", {others} not finite on one side" if others else ""
    return f"{b.label} (max {largest:.3g} of {x.size} values{extra})"


def outcome(name: str, old: Dump, new: Dump) -> tuple[int, str]:
    """Number of tensors of an item, and what differs; empty where nothing does."""
    a, b = (side.items.get(name, "no such item") for side in (old, new))
    if isinstance(a, str) or isinstance(b, str):
        wrong = {role: x for role, x in (("OLD", a), ("NEW", b)) if isinstance(x, str)}
        return 0, "; ".join(f"{role}: {x}" for role, x in wrong.items())
    pairs, complaints = matched(a, b)
    differing = [(x, y) for x, y in pairs if x.digest != y.digest]
    shown = [difference(x, y, old, new) for x, y in differing[:NAMED]] + complaints[:NAMED]
    more = len(differing) + len(complaints) - len(shown)
    return len(b), ", ".join(shown) + (f" and {more} more" if more else "")


def compare(mode: str, old: Dump, new: Dump) -> tuple[int, int]:
    """Print the rows of a mode; how many are equal, and how many there are."""
    names = list(dict.fromkeys([*old.items, *new.items]))
    width, equal = max(map(len, names), default=0), 0
    for name in names:
        count, different = outcome(name, old, new)
        print(f"{name:{width}}  {mode:8}  {count:4}  {f'DIFFERENT: {different}' if different else 'same'}")
        equal += not different
    loaded = [role for role, side in (("OLD", old), ("NEW", new)) if side.loaded == (mode == "compiled")]
    good = len(loaded) == 2
    print(f"{'operators as asked for':{width}}  {mode:8}     0  {'same' if good else f'DIFFERENT: only {loaded}'}")
    return equal + good, len(names) + 1


def arguments() -> argparse.Namespace:
    """The options of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD", help="checkout before the change")
    parser.add_argument("new", type=Path, metavar="NEW", help="checkout after it")
    parser.add_argument("--quick", action="store_true", help="three scenes and one anchor each")
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV")
    parser.add_argument("--jobs", type=int, default=2, help="checkouts and modes that run at once")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--only", default="", metavar="TEXT", help="items whose name contains it")
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="keep the results of OLD here")
    parser.add_argument("--verbose", action="store_true", help="time of each item, on stderr")
    parser.add_argument("--dump", type=Path, help=argparse.SUPPRESS)  # run the items of the working directory
    return parser.parse_args()


def compare_all(options: argparse.Namespace) -> tuple[int, int]:
    """Run both checkouts in all modes and print the rows; how many items are equal, and how many there are.

    Raises:
        RuntimeError: the operators of a checkout cannot be built, or its process fails.
    """
    modes = [mode for mode in options.modes if mode != "compiled" or compiler()]
    if "compiled" in modes:
        for checkout in (options.old, options.new):
            build(checkout.resolve())
    equal = total = 0
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(options.jobs) as pool:
        folder = (options.cache or Path(temporary)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        tasks = [(role, mode) for mode in modes for role in ("OLD", "NEW")]
        dumps = dict(zip(tasks, pool.map(lambda t: obtained(t, folder, Path(temporary), options), tasks), strict=True))
        for mode in modes:
            counts = compare(mode, dumps["OLD", mode], dumps["NEW", mode])
            equal, total = equal + counts[0], total + counts[1]
    for mode in set(options.modes) - set(modes):
        print(f"{mode}: not run (no C++ compiler)")
    return equal, total


def main() -> int:
    """Compare, or write the results of one checkout."""
    options = arguments()
    data = bool(os.environ.get("DHTORCH_DATA"))
    if options.dump:
        dump(options.dump, options.quick, options.threads, options.only, data)
        return 0
    try:
        equal, total = compare_all(options)
    except RuntimeError as error:
        print(f"same_bits: {error}", file=sys.stderr)
        return 1
    if not data:
        print("shared scenes: not run (DHTORCH_DATA is not set)")
    print(f"{equal} of {total} equal")
    return int(equal != total or total == 0)


if __name__ == "__main__":
    sys.exit(main())
