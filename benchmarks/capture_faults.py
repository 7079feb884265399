"""Faults planted into captures: does opening and checking a capture read it right, or name what is wrong?

    python benchmarks/capture_faults.py --json benchmarks/results/capture_faults.json    all
    python benchmarks/capture_faults.py --only "holo_a counted_frames"                   windows with these words


A row is one window of frames, written in one layout with one fault, opened with ``format="auto"`` and checked by
``check_capture``. Its outcome:

* ``right``: depth, poses and pictures are read as they are in truth;
* ``refused``: the reader refuses with an error;
* ``named``: not right, and a finding has one of the fault's causes;
* ``otherwise``: not right, and there are findings or report lines, none with such a cause;
* ``unchecked``: not right, no finding, but ``inspect`` states that the window cannot show the scale;
* ``silent``: not right, without a word.

Windows: the built-in room in every layout of ``tests/support/writers``, and frames of holo_a, two pieces of
7-Scenes and desk9 of the shared data in folders of numbered frames and as TUM. A fault *counts* where the window has
3 cm of motion and 100 tracked near returns, where a lag moves the picture by 8 px of 640, and where the layout can show
it: poses for their convention and for the factors 0.2 and 1.1 of the unit.

The numbers: ``silent`` must be 0; ``named`` or ``right`` or ``refused`` at least 95 % of the counted rows; findings on
windows without a fault (false alarms) at most 2 %.
"""

import argparse
import concurrent.futures
import functools
import json
import multiprocessing
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from dhtorch import data
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose
from dhtorch.synthetic import SyntheticRoom
from dhtorch.validation import faults
from dhtorch.validation.capture_check import check_capture

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.writers import CAPTURE_WRITERS, CaptureWriter

Frames = list[Frame]


@dataclass(frozen=True)
class PlantedFault:
    """A fault of a capture: how frames are spoilt before or files after writing, and the causes that name it."""

    causes: tuple[str, ...]
    frames: Callable[[Frames, CaptureWriter], Frames] = lambda frames, _writer: frames
    files: Callable[[Path], bool] | None = None  # returns whether it could be planted
    needs: str = ""  # poses | turn | lost


def _depth(change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Frames, CaptureWriter], Frames]:
    return lambda frames, _writer: [frame.replace(depth=change(frame.depth)) for frame in frames]


def _poses(change: Callable[[Pose], Pose]) -> Callable[[Frames, CaptureWriter], Frames]:
    def apply(frames: Frames, _writer: CaptureWriter) -> Frames:
        return [frame.replace(T_world_from_cam=change(frame.T_world_from_cam)) for frame in frames]

    return apply


def _stated(convention: str) -> Callable[[Pose], Pose]:
    """True poses → poses as a file in a convention would have them read: the inverse of the convention."""
    meant = parse_pose_convention(convention)
    if meant.inverse:
        return se3.invert
    if meant.quaternion is not None:  # one order read as the other
        other = "xyzw" if meant.quaternion == "wxyz" else "wxyz"
        return parse_pose_convention(other).apply
    if meant.unit != "m":
        return lambda poses: Pose(poses.R, poses.t * 1000)
    return meant.apply  # OpenGL axes: a turn by 180 degrees about x, its own inverse


def _lag(by: int) -> Callable[[Frames, CaptureWriter], Frames]:
    def apply(frames: Frames, _writer: CaptureWriter) -> Frames:
        return [frame.replace(depth=earlier.depth) for frame, earlier in zip(frames[by:], frames, strict=False)]

    return apply


def _swap_bytes(frames: Frames, writer: CaptureWriter) -> Frames:
    step = writer.step_m or 0.001
    codes = [(frame.depth / step).round().clamp(0, 65535).to(torch.int32).numpy().astype(np.uint16) for frame in frames]
    return [
        f.replace(depth=torch.from_numpy(c.byteswap().astype(np.float32)) * step)
        for f, c in zip(frames, codes, strict=True)
    ]


def _fill_holes(root: Path) -> bool:
    """Codes 0 of 16-bit depth files become 65535, as some tools write holes."""
    planted = False
    for file in sorted(root.rglob("*.png")):
        codes = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if codes is not None and codes.ndim == 2 and codes.dtype == np.uint16 and bool((codes == 0).any()):
            cv2.imwrite(str(file), np.where(codes == 0, 65535, codes).astype(np.uint16))
            planted = True
    return planted


def _swap_k(frames: Frames, _writer: CaptureWriter) -> Frames:
    return [f.replace(camera=f.camera.replace(f=f.camera.f.flip(-1), c=f.camera.c.flip(-1))) for f in frames]


def _crop(frames: Frames, _writer: CaptureWriter) -> Frames:
    """Pictures cropped to their middle 80 % and resized, depth and K as before."""

    def crop(image: torch.Tensor) -> torch.Tensor:
        h, w = image.shape[-2:]
        inner = image[..., h // 10 : h - h // 10, w // 10 : w - w // 10].float()
        return F.interpolate(inner, (h, w), mode="bilinear").round().to(image.dtype)

    return [frame.replace(image=crop(frame.image)) for frame in frames]


def _turn_pictures(orientation: int) -> Callable[[Path], bool]:
    """Colour files stored turned, with the EXIF tag that turns them back."""
    back = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}[orientation]

    def apply(root: Path) -> bool:
        files = [f for f in root.rglob("*") if f.suffix.lower() in (".jpg", ".jpeg", ".png") and _is_colour(f)]
        for file in files:
            picture = Image.open(file).convert("RGB").transpose(back)
            exif = Image.Exif()
            exif[0x0112] = orientation
            picture.save(file, exif=exif, **({"quality": 97} if file.suffix != ".png" else {}))
        return bool(files)

    return apply


def _is_colour(file: Path) -> bool:
    picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    return picture is not None and picture.ndim == 3 and picture.dtype == np.uint8


def _lose_pictures(root: Path) -> bool:
    """Three colour files of a folder deleted."""
    files = sorted(f for f in root.rglob("*") if f.suffix.lower() in (".jpg", ".jpeg", ".png") and _is_colour(f))
    for file in files[4:7]:
        file.unlink()
    return len(files) > 8


#: Motion of the picture from which a lag counts, px of a picture 640 wide: less is within the registration of real
#: sensors (7-Scenes), from which a steady lag does not differ.
MIN_LAG_PX = 8.0

#: Outcomes of a planted fault that mislead nobody.
GOOD_OUTCOMES = ("right", "named", "refused")

_POSES = ("poses",)
FAULTS: dict[str, PlantedFault] = {
    "none": PlantedFault(()),
    "unit_0.1": PlantedFault(("plausibility", "poses", "scale"), _depth(lambda d: d * 0.1)),
    "unit_0.2": PlantedFault(("plausibility", "poses", "scale"), _depth(lambda d: d * 0.2), needs="poses"),
    "unit_1.1": PlantedFault(("scale", "poses"), _depth(lambda d: d * 1.1), needs="poses"),
    "unit_10": PlantedFault(("plausibility", "poses", "scale"), _depth(lambda d: d * 10)),
    "byte_order": PlantedFault(("plausibility",), _swap_bytes),
    "exif_3": PlantedFault(("rolled", "orientation"), files=_turn_pictures(3)),
    "exif_6": PlantedFault(("rolled", "orientation"), files=_turn_pictures(6)),
    "exif_8": PlantedFault(("rolled", "orientation"), files=_turn_pictures(8)),
    "rolled_90": PlantedFault(("rolled", "orientation"), _depth(lambda d: torch.rot90(d, 1, (-2, -1))), needs="turn"),
    "rolled_180": PlantedFault(("rolled",), _depth(lambda d: torch.rot90(d, 2, (-2, -1)))),
    "left_right": PlantedFault(("mirrored",), _depth(lambda d: d.flip(-1))),
    "upside_down": PlantedFault(("mirrored",), _depth(lambda d: d.flip(-2))),
    "w2c": PlantedFault(_POSES, _poses(_stated("world_to_camera")), needs="poses"),
    "opengl": PlantedFault(_POSES, _poses(_stated("opengl")), needs="poses"),
    "wxyz": PlantedFault(_POSES, _poses(_stated("wxyz")), needs="poses"),
    "mm_poses": PlantedFault(_POSES, _poses(_stated("mm")), needs="poses"),
    **{f"lag_{k}": PlantedFault(("time offset",), _lag(k)) for k in range(1, 6)},
    "lost_pictures": PlantedFault(("lost",), files=_lose_pictures),
    "sentinel": PlantedFault(("plausibility",), files=_fill_holes),
    "swapped_k": PlantedFault(("intrinsics", "registration", "scale", "poses"), _swap_k),
    "crop": PlantedFault(("registration", "focal length"), _crop),
}

#: Faults of which the causes are words of a report line or an error instead.
WORDS = {
    "orientation": "orientation",
    "lost": "no picture|without a picture|left out|no image|count",
    "intrinsics": "exchanged|intrinsics",
}


def windows() -> Iterator[tuple[str, Frames, Sequence[str]]]:
    """Name, frames and layouts of each window."""
    room = SyntheticRoom(hw=(240, 320), n_frames=16)
    yield "room", [room[i] for i in range(16)], list(CAPTURE_WRITERS)
    root = os.environ.get("DHTORCH_DATA")
    if root is None:
        return
    for name in ("holo_a", "7s_redkitchen_000", "7s_redkitchen_400", "tum_fr1_desk9"):
        recording = data.open(Path(root) / name)
        first = max(0, len(recording) // 2 - 8)
        frames = [recording[i] for i in range(first, min(first + 16, len(recording)))]
        yield name, [_upright(frame) for frame in frames], ("counted_frames", "tum")


def _upright(frame: Frame) -> Frame:
    """A frame without distortion of its own, which some layouts cannot state: the camera is taken as ideal."""
    return frame.replace(depth_camera=None)


def run_row(
    frames: Frames, layout: str, fault: PlantedFault, sound: "Sound | None", root: Path
) -> dict[str, Any] | None:
    """One window in one layout with one fault → outcome; None where it cannot be planted.

    ``sound``: the same window and layout read without a fault; None = this is that row.
    """
    writer = CAPTURE_WRITERS[layout]
    spoilt = fault.frames(list(frames), writer)
    if fault.needs == "poses" and not writer.has_poses:
        return None
    if not writer.holds(max(float(frame.depth.max()) for frame in spoilt)):
        return None
    try:
        path = writer(root, spoilt)
    except (ValueError, AssertionError, KeyError, OSError, RuntimeError):
        return None  # the layout does not hold such frames
    if fault.files is not None and not fault.files(root):
        return None
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            recording = data.open_all(path, **writer.options)[0]
            check = check_capture(recording)
            right = sound is not None and is_right(recording, sound, len(frames) - len(spoilt))
    except (data.FormatError, ValueError) as error:
        return {"outcome": "refused", "causes": [], "lines": [str(error).replace(str(root), "capture")[:300]]}
    lines = [*check.lines, *(str(w.message) for w in caught if issubclass(w.category, UserWarning))]
    lines = [line for line in lines if line != check.assumed_unit]
    causes = [finding.cause for finding in check.findings]
    words = [cause for cause in fault.causes if cause in WORDS and re.search(WORDS[cause], " ".join(lines))]
    if not fault.causes:
        outcome = "alarm" if causes else "right"
    elif right:
        outcome = "right"
    elif words or set(causes) & set(fault.causes):
        outcome = "named"
    else:
        outcome = "otherwise" if lines else "unchecked" if check.limits and "scale" in fault.causes else "silent"
    return {"outcome": outcome, "causes": causes, "lines": [line.replace(str(root), "capture")[:200] for line in lines]}


class Sound(NamedTuple):
    """A window as a layout without a fault is read."""

    frames: Frames
    numbers: list[int]
    poses: Pose | None


def read_sound(frames: Frames, layout: str) -> Sound | None:
    """The window written and read in a layout; None where it does not hold such frames."""
    writer = CAPTURE_WRITERS[layout]
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            recording = data.open_all(writer(Path(scratch) / "capture", frames), **writer.options)[0]
        except (ValueError, AssertionError, KeyError, OSError, RuntimeError):
            return None
        return Sound([recording[i] for i in range(len(recording))], recording.number.tolist(), recording.poses)


def is_right(recording: Recording, sound: Sound, lost: int) -> bool:
    """Whether depth, pictures and relative poses of a recording are those of the sound one.

    ``lost``: frames that a lag removes at the start; frames are otherwise matched by their number.
    """
    first = int(recording.number[0]) - sound.numbers[0] if lost == 0 else 0
    for i in (0, len(recording) - 1):
        at = i + lost if lost else int(recording.number[i]) - int(recording.number[0]) + first
        if at >= len(sound.frames) or not _is_same_frame(recording[i], sound.frames[at]):
            return False
    if recording.poses is None or sound.poses is None:
        return (recording.poses is None) == (sound.poses is None)
    last = int(recording.number[-1]) - int(recording.number[0])
    start = first + lost
    ours = se3.to_matrix(se3.relative(recording.poses[:1], recording.poses[-1:]))
    true = se3.to_matrix(se3.relative(sound.poses[start : start + 1], sound.poses[start + last : start + last + 1]))
    return float((ours - true).abs().max()) < 0.01


def _is_same_frame(frame: Frame, true: Frame) -> bool:
    """Whether depth, picture and intrinsics are equal up to compression."""
    if frame.depth.shape != true.depth.shape or frame.image.shape != true.image.shape:
        return False
    both = (frame.depth > 0) & (true.depth > 0)
    return (
        bool(both.any())
        and float(((frame.depth > 0) != (true.depth > 0)).double().mean()) < 0.05
        and float((frame.depth / true.depth - 1).abs()[both].median()) < 0.005
        and float((frame.depth / true.depth - 1).abs()[both].quantile(0.9)) < 0.02
        and float((frame.image.double() - true.image.double()).abs().mean()) < 12
        and float((frame.camera.f / true.camera.f - 1).abs().max()) < 0.01
        and float((frame.camera.c - true.camera.c).abs().max()) < 2
    )


def measure_motion(frames: Frames) -> tuple[bool, float]:
    """Whether a window has 3 cm of motion and 100 tracked near returns in the median pair, and its image motion.

    The latter is the median over tracks, px of a picture 640 wide per frame.
    """
    tracks = faults.track_window([frame.replace(T_world_from_cam=None) for frame in frames])
    if not tracks.pairs:
        return False, 0.0
    moved = [
        (t.uv_1 - s.uv).norm(dim=-1)[t.valid] * 640 / frames[0].hw[1] / (b - a)
        for (a, b), s, t in zip(tracks.pairs, tracks.samples, tracks.tracks, strict=True)
    ]
    near = [int((s.usable & t.valid).sum()) for s, t in zip(tracks.samples, tracks.tracks, strict=True)]
    t = torch.cat([frame.T_world_from_cam.t for frame in frames])
    has_motion = sorted(near)[len(near) // 2] >= 100 and float((t - t[0]).norm(dim=-1).max()) >= 0.03
    return has_motion, float(torch.cat(moved).median())


@functools.cache
def window_frames(name: str) -> tuple[Frames, bool, float]:
    """Frames of a window, whether its faults count, and its image motion per frame, px."""
    torch.set_num_threads(1)
    frames = next(frames for each, frames, _ in windows() if each == name)
    return frames, *measure_motion(frames)


@functools.lru_cache(maxsize=1)
def sound_window(name: str, layout: str) -> Sound | None:
    """A window as a layout is read without a fault."""
    return read_sound(window_frames(name)[0], layout)


def measure(task: tuple[str, str]) -> list[dict[str, Any]]:
    """Rows of all faults of (window, layout)."""
    window, layout = task
    frames, has_motion, motion_px = window_frames(window)
    sound = sound_window(window, layout)
    rows = []
    for name, fault in FAULTS.items() if sound is not None else ():
        with tempfile.TemporaryDirectory() as scratch:
            row = run_row(frames, layout, fault, sound, Path(scratch) / "capture")
        lag = int(name.removeprefix("lag_")) if name.startswith("lag_") else None
        counted = has_motion and (lag is None or lag * motion_px >= MIN_LAG_PX)
        rows += [] if row is None else [{"window": window, "layout": layout, "fault": name, "counted": counted, **row}]
    return rows


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="words that window and layout must contain")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    tasks = [(window, layout) for window, _, layouts in windows() for layout in layouts]
    tasks = [task for task in tasks if all(word in " ".join(task) for word in options.only.split())]
    tasks.sort(key=lambda task: task[0] == "room")  # real windows first
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for done in concurrent.futures.as_completed([pool.submit(measure, task) for task in tasks]):
            rows += done.result()
            for row in done.result():
                shown = "; ".join(row["lines"])[:150] if row["outcome"] != "right" else ""
                label = f"{row['window']} {row['layout']} {row['fault']}"
                print(f"{label:44} {row['outcome']:10} {','.join(row['causes']):16} {shown}", flush=True)
            if options.json:  # after each task: a run that is stopped leaves what it measured
                rows.sort(key=lambda row: (row["window"], row["layout"]))
                kept = [{**row, "lines": row["lines"][:1]} for row in rows]
                options.json.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(summarise(rows), indent=1))


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts of outcomes, and the three numbers."""
    planted = [row for row in rows if row["fault"] != "none"]
    sound = [row for row in rows if row["fault"] == "none"]
    counted = [row for row in planted if row["counted"]]
    good = [row for row in counted if row["outcome"] in GOOD_OUTCOMES]
    outcomes = {
        x: sum(row["outcome"] == x for row in planted)
        for x in ("right", "refused", "named", "otherwise", "unchecked", "silent")
    }
    return {
        "outcomes": outcomes,
        "n_counted": len(counted),
        "named_rightly": len(good) / len(counted) if counted else None,
        "false_alarms": sum(row["outcome"] == "alarm" for row in sound) / len(sound) if sound else None,
        "n_sound": len(sound),
    }


if __name__ == "__main__":
    sys.exit(main())
