"""``dhtorch pin``: was a camera moved since a reference view, when and by how much?

Prints a line per picture or episode, and writes ``pin.json`` and ``pin.html``, the worst first. The exit code is 1
where a limit of ``fail_on`` is exceeded, for use in data pipelines.
"""

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.cli.validate import list_exceeded_limits, parse_limits
from dhtorch.codes import PinReason, PinVerdict, name
from dhtorch.data import open_all
from dhtorch.data.intrinsics import MissingIntrinsicsError, parse_intrinsics
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.export import encode_png
from dhtorch.geometry import se3
from dhtorch.measure.change_points import ChangePoint, find_change_points
from dhtorch.measure.pin import CameraPin
from dhtorch.pytree import collate
from dhtorch.records import Camera, Frame, PinResult
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.viz.viewer import validation as pages

#: Names that ``fail_on`` accepts → the quantity compared with the limit.
_PIN_LIMITS = {
    "moved": "shift of the scene in the picture, px, less two standard deviations, of the worst episode",
    "unknown": "fraction of the pictures from which the camera's place cannot be known",
}

#: Columns of the page's table, after the episode's name.
_TABLE_COLUMNS = ("verdict", "median shift, px", "its sigma, px", "largest shift, px", "changes")

#: Horizontal field of view assumed where nothing is stated, degrees: shifts in px do not depend on it.
_ASSUMED_FOV_DEG = 60.0

#: Endings of the files that are single pictures.
_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass
class Episode:
    """Pictures of one episode, recording or camera, compared with the reference."""

    name: str
    numbers: list[int]
    result: PinResult
    worst: Tensor  # (C, H, W), the picture with the largest shift
    changes: list[ChangePoint] = field(default_factory=list)

    @property
    def shift(self) -> float | None:
        """The largest median shift of the parts between changes, less two standard deviations, px; None = not known."""
        edges = [0, *(change.first for change in self.changes), len(self.numbers)]
        low = self.result.shift_low_px
        values = [float(low[a:b].nanmedian()) for a, b in itertools.pairwise(edges)]
        return max((x for x in values if not math.isnan(x)), default=None)

    @property
    def verdict(self) -> int:
        """MOVED where there are changes, CANNOT_KNOW where fewer than half of the pictures are known, else what
        most known ones are; a code of PinVerdict."""
        counts = [int((self.result.verdict == code).sum()) for code in range(3)]
        if self.changes:
            return PinVerdict.MOVED
        if 2 * counts[PinVerdict.CANNOT_KNOW] > sum(counts):
            return PinVerdict.CANNOT_KNOW
        return PinVerdict.MOVED if counts[PinVerdict.MOVED] > counts[PinVerdict.NOT_MOVED] else PinVerdict.NOT_MOVED

    @property
    def middle(self) -> PinResult:
        """The result (1) of the picture with the median shift among those of the episode's verdict."""
        among = (self.result.verdict == self.verdict).nonzero()[:, 0]
        among = among if len(among) else torch.arange(len(self.result.verdict))  # changes, each part of them unknown
        shift = self.result.shift_px[among]
        k = int(among[(shift - shift.nanmedian()).abs().nan_to_num(math.inf).argmin()])
        return self.result[k : k + 1]


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Compare the pictures of a source with a reference; returns the exit code, 1 where a limit is exceeded.

    Raises:
        ValueError, OSError: bad options or data.
    """
    limits = parse_limits(re.sub(r"(\d)\s*px", r"\1", settings["fail_on"] or ""), _PIN_LIMITS)
    folder = Path(str(settings["output"])).expanduser()
    with open_output_folder(folder, "output") as output:
        output.check(folder / file for file in ("pin.json", "pin.html"))
        reference, camera_name = _read_reference(settings)
        rate = float(settings["false_alarm_rate"])
        pin = CameraPin(reference.to(settings["device"]), false_alarm_rate=rate, seed=settings["seed"])
        for note in pin.notes:
            print(note)
        episodes = []
        for episode in _compare(pin, settings, camera_name, progress):
            episodes.append(episode)
            # The printed line of an episode: that of its middle picture, and its changes
            n = len(episode.numbers)
            known = int((episode.result.verdict != PinVerdict.CANNOT_KNOW).sum())
            counted = "" if n == 1 else f" ({known} of {format_count(n, 'picture')} known)"
            changes = "".join(
                f"; from frame {episode.numbers[c.first]} by {c.shift_px:.1f} px" for c in episode.changes
            )
            print(f"{episode.name}: {describe_pin(episode.middle)}{counted}{changes}")
        # Totals over episodes, and the quantities that ``fail_on`` limits
        verdicts = [name(PinVerdict, episode.verdict).lower() for episode in episodes]
        unknown = torch.cat([episode.result.verdict for episode in episodes]) == PinVerdict.CANNOT_KNOW
        shifts = [shift for episode in episodes if (shift := episode.shift) is not None]
        summary = {
            "episodes": {word: verdicts.count(word) for word in ("moved", "not_moved", "cannot_know")},
            "limited": {"moved": max(shifts, default=None), "unknown": float(unknown.double().mean())},
        }
        exceeded = list_exceeded_limits(summary, limits, _PIN_LIMITS)
        content = {"ref": str(settings["ref"]), "source": str(settings["source"]), "metric": pin.metric}
        content |= {"false_alarm_rate": rate, "notes": pin.notes, "fail_on": settings["fail_on"]}
        content |= {"exceeded": exceeded, "whole": summary, "episodes": list(map(_row_of, episodes))}
        storage.write_json(folder / "pin.json", storage.to_strict_json(content))
        _write_pages(folder, pin, episodes, summary, exceeded, settings)
    print("\n".join([*(f"exceeded: {line}" for line in exceeded), f"Wrote pin.json, pin.html in {folder}."]))
    return int(bool(exceeded))


# ------------------------------------------------------------------------------------------------------------ reading


def _read_reference(settings: Mapping[str, Any]) -> tuple[Frame, str | None]:
    """Frames of the reference as one batch, and the name of their camera."""
    path = Path(str(settings["ref"])).expanduser()
    if path.suffix.lower() in _PICTURE_SUFFIXES:
        image = torch.from_numpy(files.read_image(path))[None]
        # Intrinsics of a single picture: those of the options, else of an assumed field of view
        stated, hw = settings["data"], (image.shape[-2], image.shape[-1])
        options = {key: stated[key] for key in ("intrinsics", "K", "fov") if stated[key] is not None}
        K = parse_intrinsics(path, hw, **(options or {"fov": _ASSUMED_FOV_DEG})).K
        if K is None:
            raise ValueError(f"data.intrinsics: found {stated['intrinsics']!r}, expected fx,fy,cx,cy or degrees")
        numbers = torch.tensor([K], dtype=torch.float32)
        return Frame(image, torch.zeros(1, *hw), Camera(numbers[:, :2], numbers[:, 2:])), None
    recording = _open(path, settings)[0]
    frames = [recording[k] for k in _spread(len(recording), settings["ref_frames"])]
    if 0 in frames[0].hw:
        raise ValueError(f"ref: found {recording.name} without images, expected images")
    batch = [frame.replace(time=None, T_world_from_cam=None, conf=None) for frame in frames]
    return collate(batch), recording.camera_name


def _open(path: Path, settings: Mapping[str, Any]) -> Sequence[Recording]:
    """The recordings of a capture; one that states no intrinsics is opened with an assumed field of view, with the
    warning that such a camera has."""
    options = {key: value for key, value in settings["data"].items() if value is not None}
    try:
        recordings = open_all(path, settings["format"], **options)
        _ = recordings[0]  # many are opened on access
        return recordings
    except MissingIntrinsicsError:
        return open_all(path, settings["format"], **{**options, "fov": _ASSUMED_FOV_DEG})


def _spread(n: int, wanted: int | None) -> list[int]:
    """Positions of ``wanted`` of n frames, evenly spread; all where None or more than n; the first where 1."""
    if wanted is None or wanted >= n:
        return list(range(n))
    return [k * n // wanted for k in range(wanted)]


# ---------------------------------------------------------------------------------------------------------- comparison


def _compare(
    pin: CameraPin, settings: Mapping[str, Any], camera_name: str | None, progress: Progress
) -> Iterator[Episode]:
    """The episodes of the source, one by one: of a live camera until ``max_frames`` or its end, each picture with its
    line."""
    source = str(settings["source"])
    path = Path(source).expanduser()
    if source.isdigit():
        numbers = itertools.count()

        def report(result: PinResult) -> None:
            lines = guide_pin(result) if settings["guide"] else [describe_pin(result)]
            print(f"{next(numbers)}: {'   '.join(lines)}", flush=True)

        live = itertools.islice(files.read_live_camera(int(source)), settings["max_frames"])
        images = (torch.from_numpy(picture) for picture in live)
        episode = _compare_pictures(pin, f"camera {source}", images, settings["device"], report)
        yield Episode(f"camera {source}", list(range(len(episode[0].verdict))), *episode)
    elif path.suffix.lower() in _PICTURE_SUFFIXES:
        image = torch.from_numpy(files.read_image(path))
        result = pin.check(image.to(settings["device"]))
        if settings["guide"]:
            print("\n".join(guide_pin(result)))
        yield Episode(path.name, [0], result, image)
    else:
        recordings = [r for r in _open(path, settings) if camera_name is None or r.camera_name in (None, camera_name)]
        if not recordings:
            raise ValueError(f"source: found no camera {camera_name!r} at {path}, expected the reference's")
        for recording in recordings:
            every = range(0, len(recording), settings["every"])
            chosen = [every[k] for k in _spread(len(every), settings["max_frames"])]
            loop = progress(chosen, f"{recording.name}: pictures", len(chosen))
            images = (recording[k].image[0] for k in loop)
            episode = _compare_pictures(pin, recording.name, images, settings["device"])
            yield Episode(recording.name, [int(recording.number[k]) for k in chosen], *episode)


def _compare_pictures(
    pin: CameraPin, title: str, images: Iterable[Tensor], device: str, report: Callable[[PinResult], None] | None = None
) -> tuple[PinResult, Tensor, list[ChangePoint]]:
    """Results of an episode's pictures, each also handed to ``report``, the picture with the largest shift, and lasting
    changes."""
    results: list[PinResult] = []
    worst, largest = None, -1.0
    for image in images:
        results.append(pin.check(image.to(device)))
        if report is not None:
            report(results[-1])
        shift = float(results[-1].shift_px.nan_to_num(0.0))
        if shift > largest:
            worst, largest = image, shift
    if worst is None:
        raise ValueError(f"{title}: found no picture, expected at least one")
    result = collate(results)
    return result, worst, find_change_points(result, false_alarm_rate=pin.false_alarm_rate)


# ------------------------------------------------------------------------------------------------------------- results


def _row_of(episode: Episode) -> dict[str, Any]:
    """An episode as a row of pin.json, with a row for every picture."""
    result = episode.result
    pictures = [
        {
            "frame": episode.numbers[k],
            "verdict": name(PinVerdict, int(result.verdict[k])).lower(),
            "reason": name(PinReason, int(result.reason[k])).lower(),
            "zoom": float(result.zoom[k]),
            "zoom_sigma": float(result.zoom_sigma[k]),
            "shift_px": float(result.shift_px[k]),
            "shift_sigma_px": float(result.shift_sigma_px[k]),
            "rotation_deg": (result.offset[k, :3] * (180 / math.pi)).tolist(),
            "translation_m" if bool(result.metric[k]) else "direction": result.offset[k, 3:].tolist(),
            "covariance": result.cov[k].tolist(),
            "agreement": float(result.agreement[k]),
            "coverage": float(result.coverage[k]),
        }
        for k in range(len(episode.numbers))
    ]
    changes = [{"frame": episode.numbers[c.first], "change_px": c.shift_px} for c in episode.changes]
    verdict = name(PinVerdict, episode.verdict).lower()
    return {
        "name": episode.name,
        "verdict": verdict,
        "moved_px": episode.shift,
        "changes": changes,
        "pictures": pictures,
    }


def _write_pages(
    folder: Path,
    pin: CameraPin,
    episodes: Sequence[Episode],
    summary: Mapping[str, Any],
    exceeded: Sequence[str],
    settings: Mapping[str, Any],
) -> None:
    """Write ``pin.html``."""
    order = sorted(range(len(episodes)), key=lambda k: -(episodes[k].shift or 0.0))
    before = encode_png(_to_rgb(pin.frame.image[0]))
    shown = []
    for rank, k in enumerate(order):
        episode = episodes[k]
        middle, largest = episode.middle, episode.result.shift_px.nan_to_num(-math.inf).max()
        numbers = torch.stack([middle.shift_px[0], middle.shift_sigma_px[0], largest]).tolist()
        verdict = name(PinVerdict, episode.verdict).lower().replace("_", " ")
        if episode.verdict == PinVerdict.CANNOT_KNOW:
            verdict += f": {PinReason.entries[int(middle.reason)].definition}"
        cells = [verdict, *(f"{x:.2f}" if math.isfinite(x) else "–" for x in numbers), str(len(episode.changes))]
        after = encode_png(_to_rgb(episode.worst)) if rank < settings["pictures"] else None
        shown.append(pages.ValidatedFrame(episode.name, cells, before if after else None, after))
    drift = [(episode.name, episode.numbers, episode.result.shift_px.tolist()) for episode in episodes]
    counts = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in summary["episodes"].items())
    sentences = [f"{settings['source']} against {settings['ref']}: {counts}.", *pin.notes]
    pages.write_validation_page(
        folder / "pin.html",
        "Was the camera moved?",
        sentences=sentences,
        columns=_TABLE_COLUMNS,
        frames=shown,
        failed=exceeded,
        word="pin",
        note=None,
        kind="episode",
        above=[pages.draw_drift(drift)],
        own=Path(pages.__file__).with_name("pin.css"),
    )


def _to_rgb(image: Tensor) -> np.ndarray:
    """Picture (C, H, W) -> (H, W, 3) uint8."""
    pixels = image.detach().cpu()
    pixels = (pixels * 255).round() if pixels.is_floating_point() else pixels
    return pixels.to(torch.uint8).expand(3, -1, -1).permute(1, 2, 0).numpy()


# ------------------------------------------------------------------------------------------------------------ in words

#: Distance and angle below which the guide calls a mount in place, mm and degrees: the median error of a half hidden
#: picture allowed for. Source: the required accuracy of the offset.
IN_PLACE_MM, IN_PLACE_DEG = 2.0, 0.1

#: Ways of the guide along and about the camera's axes (x right, y down, z forward): negative, positive.
_SHIFTS = (("← left", "→ right"), ("↑ up", "↓ down"), ("⊙ back", "⊗ forward"))
_TURNS = (("⤓ tilt down", "⤒ tilt up"), ("↶ turn left", "↷ turn right"), ("⟲ roll left", "⟳ roll right"))


def describe_pin(result: PinResult) -> str:
    """One picture's result (1) in a line: verdict, shift, offset with standard deviations, or the reason for none."""
    verdict = name(PinVerdict, int(result.verdict)).lower().replace("_", " ")
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        text = f"{verdict}: {PinReason.entries[int(result.reason)].definition}"
        focal = f" ({float(result.zoom):.4f} ± {float(result.zoom_sigma):.4f} of the stated one)"
        return text + focal if int(result.reason) == PinReason.ZOOM else text
    sigma = result.cov[0].diagonal().clamp_min(0).sqrt()
    turn, shift = result.offset[0].split(3)
    angle = math.degrees(float(turn.norm()))
    angle_sigma = math.degrees(float(sigma[:3].norm()))
    px = f"{verdict}, {float(result.shift_px):.2f} ± {float(result.shift_sigma_px):.2f} px"
    text = f"{px}, turned by {angle:.3f} ± {angle_sigma:.3f}°"
    if bool(result.metric):
        return f"{text}, displaced by {1e3 * float(shift.norm()):.1f} ± {1e3 * float(sigma[3:].norm()):.1f} mm"
    if float(shift.norm()) > 0:
        return f"{text}, displaced along ({', '.join(f'{x:.2f}' for x in shift.tolist())}) by an unknown length"
    return f"{text} (reference without depth: no length)"


def guide_pin(result: PinResult) -> list[str]:
    """One picture's result (1) -> lines that say how to put the camera back: arrows, mm and degrees.

    Directions are those of the live camera: right, down and forward in its own picture.
    """
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        return [describe_pin(result)]
    back = se3.invert(result.T_ref_from_live)  # the reference camera seen from the live one
    turn = [math.degrees(x) for x in se3.log(back)[0, :3].tolist()]
    shift = [1e3 * x for x in back.t[0].tolist()]
    lines = []
    if bool(result.metric):
        lines += [f"{_SHIFTS[k][x > 0]} {abs(x):.1f} mm" for k, x in enumerate(shift) if abs(x) >= IN_PLACE_MM]
    elif any(shift):
        k = max(range(3), key=lambda k: abs(shift[k]))
        lines.append(f"mainly {_SHIFTS[k][shift[k] > 0]}, by an unknown length")
    lines += [f"{_TURNS[k][x > 0]} {abs(x):.2f}°" for k, x in enumerate(turn) if abs(x) >= IN_PLACE_DEG]
    return [*(lines or ["in place"]), f"shift {float(result.shift_px):.1f} ± {float(result.shift_sigma_px):.1f} px"]
