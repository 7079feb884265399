"""kornia's augmentations before ``ExtendDepth``: are its answers those of the given sample, moved?

    python benchmarks/kornia_adapters.py --json benchmarks/results/kornia_adapters.json

Pairs of the built-in rooms and of ``data=shared_scenes`` (where DHTORCH_DATA is set). Each pair is extended as it is,
and behind each augmentation (:class:`dhtorch.transforms.kornia.AugmentSample`) at the same points of the picture. Rows
``moved``: of the points that were triangulated both times, how many agree within two standard deviations of their
difference, taken as independent, and within two of the first answer alone. Rows ``alone``: the picture is moved (with
its depth, where a loader would crop or resize both) and its intrinsics are not: the pose's code, and the same
comparison.
"""

import argparse
import json
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import kornia
import torch
import yaml
from cells import percent, table
from kornia import augmentation
from torch import Tensor

from dhtorch import data
from dhtorch.codes import PoseCode, Source
from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.geometry import camera as cam
from dhtorch.pipeline.presets import get_method
from dhtorch.records import Frame
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.transforms import ExtendDepth
from dhtorch.transforms.kornia import AugmentSample

HERE = Path(__file__).resolve().parent
RESULT = HERE / "results" / "kornia_adapters.json"

#: Rooms, and what of a room is recorded.
SEEDS = range(5)
ROOM: dict[str, Any] = {"hw": (240, 320), "n_frames": 12, "lidar": "exact"}

#: Farthest return that a pair keeps, m, and frames from its source view to its reference view, in the rooms.
NEAR, GAP = 2.0, 6

#: Reference views of each scene at most.
PAIRS = 3

#: Samples of each pair.
SAMPLES = 1024

#: Name → augmentation of pictures (h, w): moving pixels, then colours.
AUGMENTATIONS: dict[str, Callable[[int, int], torch.nn.Module]] = {
    "flip": lambda h, w: augmentation.RandomHorizontalFlip(p=1.0),
    "crop": lambda h, w: augmentation.RandomCrop((3 * h // 4, 3 * w // 4), p=1.0),
    "resize": lambda h, w: augmentation.Resize((5 * h // 4, 5 * w // 4), p=1.0, antialias=True),
    "rot90": lambda h, w: augmentation.RandomRotation90((1, 3), p=1.0),
    "colour": lambda h, w: augmentation.ColorJiggle(0.1, 0.1, 0.1, 0.05, p=1.0),
    "blur": lambda h, w: augmentation.RandomGaussianBlur((5, 5), (0.8, 0.8), p=1.0),
}

#: Those that move pixels, and the keys that a loader moves without K.
ALONE = {"flip": ("image", "before"), "crop": ("image", "before", "depth"), "resize": ("image", "before", "depth")}


def pairs() -> Iterator[tuple[str, Frame, Frame]]:
    """Scene, reference view with its far returns hidden, source view."""
    for seed in SEEDS:
        yield from of_scene(f"room {seed}", Scene(SyntheticRoom(**ROOM, seed=seed), near=NEAR, gap=GAP))
    root = os.environ.get("DHTORCH_DATA")
    notes = yaml.safe_load((HERE.parent / "conf/data/shared_scenes.yaml").read_text(encoding="utf-8"))["scenes"]
    for scene in data.open_scenes(root=root, scenes=notes) if root else ():
        if scene.role is None:
            yield from of_scene(scene.recording.name, scene)


def of_scene(name: str, scene: Scene) -> Iterator[tuple[str, Frame, Frame]]:
    """The pairs of one scene."""
    found = by_gap(scene)
    for pair in found[:: -(-len(found) // PAIRS)]:
        reference, other = scene.recording[pair.reference], scene.recording[pair.other]
        near = torch.where(reference.depth <= (scene.near or NEAR), reference.depth, 0.0)
        yield name, reference.replace(depth=near), other


def as_sample(reference: Frame, other: Frame) -> tuple[dict[str, Tensor], dict[str, str]] | None:
    """The views as a collated batch of one, and the options that name its keys; None where they differ in size."""
    if reference.hw != other.hw or reference.depth_camera is not None:
        return None
    sample = {"image": reference.image, "before": other.image, "depth": reference.depth}
    sample |= {"intrinsics": cam.to_matrix(reference.camera), "K_before": cam.to_matrix(other.camera)}
    options = {"other_image": "before", "other_intrinsics": "K_before", "depth_unit": "m"}
    if reference.camera.distortion is not None:
        sample["lens"], options["distortion"] = reference.camera.distortion, "lens"
    return sample, options


def answers(sample: Mapping[str, Any], options: Mapping[str, Any], uv: Tensor | None, method: str) -> dict[str, Tensor]:
    """Columns of ``ExtendDepth``, at given points (N, 2) or its own."""
    record = get_method(method, SAMPLES)
    if uv is not None:
        record = record.replace(sample=lambda hw, n, **_: uv, n=len(uv))
    with torch.no_grad():
        out = ExtendDepth(method=record, batched=True, **options)(sample)
    return {key.removeprefix("dhtorch."): value[0] for key, value in out.items() if key.startswith("dhtorch.")}


def beside(before: Mapping[str, Tensor], out: Any, options: Any, A: Tensor, method: str) -> dict[str, Any]:
    """Answers of a moved sample beside those before, at the same points of the picture."""
    h, w = out["image"].shape[-2:]
    uv = before["uv"] @ A[:2, :2].mT + A[:2, 2]
    inside = (uv >= 1).all(-1) & (uv <= torch.tensor([w - 2.0, h - 2.0])).all(-1)
    behind = answers(out, options, uv[inside], method)
    first = {key: before[key][inside] for key in ("depth", "sigma", "source")}
    answered, still = (x["source"] == Source.RECOVERED for x in (first, behind))
    both = answered & still
    d = (behind["depth"] - first["depth"]).abs()[both]
    own, together = first["sigma"][both], torch.hypot(first["sigma"], behind["sigma"])[both]
    return {
        "pose_code": int(behind["pose_code"]),
        "n_before": int(answered.sum()),
        "n_behind": int(still.sum()),
        "n_both": int(both.sum()),
        "n_within_2sigma": int((d <= 2 * together).sum()),
        "n_within_2sigma_of_first": int((d <= 2 * own).sum()),
        "median_rel": float((d / first["depth"][both]).median()) if both.any() else None,
    }


def run() -> Iterator[dict[str, Any]]:
    """Rows of all pairs that have a pose as they are."""
    for scene, reference, other in pairs():
        found = as_sample(reference, other)
        if found is None:
            continue
        sample, options = found
        for method in ("map", "auto"):
            before = answers(sample, options, None, method)
            if not before["pose_ok"]:
                continue
            for name, make in AUGMENTATIONS.items():
                torch.manual_seed(0)
                move = AugmentSample(make(*sample["image"].shape[-2:]), batched=True, **options)
                out = move(sample)
                assert move.transform_matrix is not None
                A = move.transform_matrix[0].float()
                of = {"scene": scene, "augmentation": name, "method": method}
                if method == "map":
                    yield {"what": "moved", **of, **beside(before, out, options, A, method)}
                if name in ALONE:
                    alone = {**sample, **{key: out[key] for key in ALONE[name]}}
                    yield {"what": "alone", **of, **beside(before, alone, options, A, method)}


def rows_of(what: str, name: str, method: str) -> list[dict[str, Any]]:
    """Rows of the result file."""
    rows = json.loads(RESULT.read_text(encoding="utf-8"))
    return [row for row in rows if (row["what"], row["augmentation"], row["method"]) == (what, name, method)]


def total(rows: list[dict[str, Any]], key: str, of: str) -> str:
    """Share of a count in another, over rows."""
    n = sum(row[of] for row in rows)
    return percent(sum(row[key] for row in rows) / n if n else None)


def agreement() -> str:
    """Table of the rows ``moved``, by augmentation; see readme.py."""
    lines = []
    for name in AUGMENTATIONS:
        rows = rows_of("moved", name, "map")
        posed = [row for row in rows if row["pose_code"] == PoseCode.OK]
        cells = [f"{len(posed)} of {len(rows)}", total(posed, "n_both", "n_before")]
        cells += [total(posed, key, "n_both") for key in ("n_within_2sigma", "n_within_2sigma_of_first")]
        lines.append([name, *cells])
    head = ["augmentation", "pairs with a pose behind it", "of its points triangulated before, triangulated behind"]
    return table([*head, "agree within 2 sigma of the difference", "within 2 sigma of the answer before"], lines)


def contradicted() -> str:
    """Table of the rows ``alone``, by what was moved; see readme.py."""
    lines = []
    for name in ALONE:
        for method in ("map", "auto"):
            rows = rows_of("alone", name, method)
            codes = [row["pose_code"] for row in rows]
            posed = [row for row in rows if row["pose_code"] == PoseCode.OK]
            off = [row["median_rel"] for row in posed if row["median_rel"] is not None]
            counts = [str(sum(code != PoseCode.OK for code in codes)), str(codes.count(PoseCode.MISALIGNED))]
            cells = [str(len(rows)), *counts, percent(statistics.median(off)) if off else "–"]
            lines.append([name, f"`{method}`", *cells, total(posed, "n_within_2sigma", "n_both")])
    head = ["moved, and K not", "method", "pairs", "no pose", "of them MISALIGNED"]
    return table([*head, "the others' median difference of depth", "agree within 2 sigma"], lines)


#: Tables for readme.py.
TABLES = {"kornia adapters": agreement, "kornia without K": contradicted}


def main() -> int:
    """Run all pairs and write the JSON file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    path = parser.parse_args().json
    torch.set_num_threads(1)
    rows = list(run())
    versions = {"torch": torch.__version__, "kornia": kornia.__version__}
    text = json.dumps([{**row, "versions": versions} for row in rows], indent=1)
    path.write_text(text + "\n", encoding="utf-8")
    print(agreement() + "\n" + contradicted()) if path.resolve() == RESULT else None
    return 0


if __name__ == "__main__":
    sys.exit(main())
