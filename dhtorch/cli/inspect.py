"""``dhtorch inspect PATH``: what a capture holds, before anything is made of it.

Prints facts and warnings and writes a contact sheet. It looks for captures at the path and up to two folders below; a
recording, a focal stack, and loose pictures that belong to no format are all shown, nothing is refused.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data import FormatError
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io import safe_open as doors
from dhtorch.data.recording import Recording
from dhtorch.data.survey import Survey, survey_pictures, survey_recording
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.survey import survey_stacks
from dhtorch.runtime.console import HELP_EPILOG, escape_markup, format_count, progress, unwrap_terminal
from dhtorch.viz.plots.colours import DEPTH_CMAP, GREY_CMAP, INK, SCORE_CMAP, SERIES_COLOURS, SILENT

_MAX_LEVELS = 2  # folders below the path
_MAX_RECORDINGS = 12  # recordings that are shown of one capture
_NO_INTRINSICS_MESSAGE = (
    "no intrinsics: nothing can be measured in it before data.K=[fx,fy,cx,cy] or data.fov=DEGREES says them"
)
_ASSUMED_FOV_DEG = 60.0  # degrees, to look at what has no K
_SPARSE_SHARE = 0.1  # share of returns below which they are drawn larger
_CAPTURE_SUFFIXES = (".r3d", ".mp4", ".mov", ".tar", ".h5", ".hdf5")  # files that may be a whole capture
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_ARCHIVE_SUFFIXES = (".zip", ".gz", ".tgz", ".xz", ".bz2", ".zst", ".7z", ".rar")  # nothing is unpacked unasked
_VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm")
_VIDEO_MESSAGE = "a video without depth; the sensor's depth of what is near gives the metre"


@dataclass(frozen=True)
class FoundCapture:
    """A capture, and what makes it one."""

    path: Path
    kind: str  # "recording", "stacks" or "pictures"
    format: str
    evidence: str
    follow_links: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)  # of its reader


def main(argv: Sequence[str]) -> int:
    """``dhtorch inspect PATH``: print what a capture holds, write a contact sheet.

    Raises:
        FormatError: nothing there, or nothing that could be shown.
        KeyboardInterrupt: Ctrl-C; contact sheets that are written stay.
    """
    parser = argparse.ArgumentParser(
        prog="dhtorch inspect", description="What a capture holds, and a contact sheet.", epilog=HELP_EPILOG
    )
    parser.add_argument("path", type=Path, help="a capture: a folder, up to two folders above it, or a file")
    about = "option of the reader as data.NAME=VALUE: data.fov=69, data.K=[600,600,320,240], data.camera=[a,b]"
    parser.add_argument("options", nargs="*", default=[], metavar="data.NAME=VALUE", help=about)
    parser.add_argument("--out", type=Path, help="folder of the contact sheet (default: outputs/<date>/<time>)")
    parser.add_argument("--format", default="auto", help="name of the format, where it is not to be recognised")
    parser.add_argument("--frames", type=int, default=8, help="frames to decode and show (default: 8)")
    parser.add_argument("--follow-links", action="store_true", help="links may lead out of a capture")
    parser.add_argument("--traceback", action="store_true", help="show where an error came from")
    options = parser.parse_intermixed_args(argv)
    if options.frames < 1:
        raise ValueError(f"--frames: found {options.frames}, expected at least 1")
    auto = options.format == "auto"
    found = (
        find_captures(options.path, options.follow_links)
        if auto
        else [_capture_of_format(options.path, options.format)]
    )
    reading = _parse_reader_options(options.options)
    found = [replace(capture, follow_links=options.follow_links, options=reading) for capture in found]
    now = datetime.now()
    out = options.out or Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}"
    sheets: list[Path] = []
    try:
        for capture in found:
            for survey in survey_capture(capture, options.frames):
                survey.name = _full_name(options.path, capture.path, survey.name)
                print_survey(capture, survey)
                sheets.append(write_contact_sheet(survey, out))
                print(f"wrote {sheets[-1]}\n")
    except KeyboardInterrupt:
        stay = f"{format_count(len(sheets), 'contact sheet')} in {out} stay; " if sheets else ""
        raise KeyboardInterrupt(f"{stay}the same command looks again") from None
    return 0


def find_captures(path: Path, follow_links: bool = False) -> list[FoundCapture]:
    """The captures at ``path``, else one folder below, else two; the nearest level that has any, folders before files.

    Raises:
        FormatError: there is none.
    """
    if not path.exists():
        raise FormatError(path, "path", "no such file or folder", "a capture")
    level = [path]
    for _ in range(_MAX_LEVELS + 1):
        inside = [
            entry
            for folder in level
            if folder.is_dir()
            for entry in sorted(folder.iterdir(), key=files.natural_sort_key)
        ]
        for candidates in (level, [entry for entry in inside if entry.suffix.lower() in _CAPTURE_SUFFIXES]):
            found = [
                capture for entry in candidates if (capture := _recognise_capture(entry, follow_links)) is not None
            ]
            if found:
                return found
        level = [entry for entry in inside if entry.is_dir()]
    known = ", ".join((*data.FORMATS, *formats.STACK_FORMATS))
    raise FormatError(path, "content", _describe_content(path), f"one of {known}, or pictures")


def _describe_content(path: Path) -> str:
    """What there is where no capture is, and what would make it one, in words."""
    if path.is_file():
        kinds = {
            **dict.fromkeys(_ARCHIVE_SUFFIXES, "an archive, to be unpacked first"),
            **dict.fromkeys(_VIDEO_SUFFIXES, _VIDEO_MESSAGE),
        }
        return kinds.get(path.suffix.lower(), f"a {path.suffix or 'plain'} file, which no reader knows")
    if not any(path.iterdir()):
        return "an empty folder"
    below = {file.suffix.lower(): file.name for file in path.iterdir() if file.is_file()}
    for suffix in (*_ARCHIVE_SUFFIXES, *_VIDEO_SUFFIXES):
        if suffix in below:
            content = _VIDEO_MESSAGE if suffix in _VIDEO_SUFFIXES else "an archive, to be unpacked first"
            return f"{below[suffix]}: {content}"
    return "no capture here or two folders below"


def survey_capture(capture: FoundCapture, frames: int = 8) -> Iterator[Survey]:
    """What each recording (stack, folder of pictures) of a capture holds.

    A recording that its reader refuses is shown as the loose pictures it has, with the reader's words as a warning.
    """
    try:
        yield from _SURVEYS_BY_KIND[capture.kind](capture, frames)
    except FormatError as error:
        if not capture.path.is_dir() or not any(classify_images(capture.path)):
            raise
        (survey,) = _survey_loose_pictures(capture, frames)
        survey.warnings.insert(0, f"the {capture.format} reader refuses it: {error}")
        yield survey


def _parse_reader_options(said: Sequence[str]) -> dict[str, Any]:
    """Options of a reader, of words ``data.NAME=VALUE``; a list is written a,b or [a,b].

    Raises:
        ValueError: another word.
    """
    options: dict[str, Any] = {}
    for word in said:
        name, sign, text = word.partition("=")
        if not (sign and name.startswith("data.") and name.removeprefix("data.").isidentifier()):
            raise ValueError(f"{word}: found a word that says nothing here, expected data.NAME=VALUE, as data.fov=69")
        items = [_parse_value(item.strip()) for item in text.removeprefix("[").removesuffix("]").split(",")]
        options[name.removeprefix("data.")] = items if text.startswith("[") or len(items) > 1 else items[0]
    return options


def _parse_value(text: str) -> Any:
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return {"true": True, "false": False, "null": None}.get(text, text)


# ------------------------------------------------------------------------------------------------------------- finding


def _full_name(asked: Path, found: Path, name: str) -> str:
    """A capture further down is named after the way to it: the last folder alone may be called ``9``."""
    below = found.relative_to(asked).parts
    return "/".join((asked.resolve().name, *below[:-1], name)) if below else name


def _capture_of_format(path: Path, format: str) -> FoundCapture:
    if format in formats.STACK_FORMATS:
        return FoundCapture(path, "stacks", format, "as told")
    if format not in data.FORMATS:
        raise FormatError(path, "format", format, ", ".join(("auto", *data.FORMATS, *formats.STACK_FORMATS)))
    return FoundCapture(path, "recording", format, "as told")


def _recognise_capture(path: Path, follow_links: bool) -> FoundCapture | None:
    """What stands at this very path: a recording wins over focal stacks, these over loose pictures."""
    with doors.restrict_links(None if follow_links else path):
        for name, reader in (data.FORMATS | formats.STACK_FORMATS).items():
            if evidence := reader.recognise(path):
                return FoundCapture(path, "recording" if name in data.FORMATS else "stacks", name, evidence)
    if path.is_dir() and (count := sum(file.suffix.lower() in _IMAGE_SUFFIXES for file in path.iterdir())):
        return FoundCapture(path, "pictures", "loose pictures", f"{format_count(count, 'picture')} of no known format")
    return None


def _survey_recordings(capture: FoundCapture, frames: int) -> Iterator[Survey]:
    """Each recording; without its pictures where these are missing and the reader can do so."""
    warning: list[str] = []
    links = capture.follow_links
    try:
        recordings = _open_recordings(capture, warning)
    except FormatError as error:
        if "images" not in inspect.signature(data.FORMATS[capture.format].read).parameters:
            raise
        recordings = data.open_all(capture.path, capture.format, follow_links=links, images=False)
        warning = [f"no pictures: {error}"]
    if len(recordings) > _MAX_RECORDINGS:
        warning.append(f"{len(recordings)} recordings in this capture: the first {_MAX_RECORDINGS} are shown")
    for recording in islice(recordings, _MAX_RECORDINGS):
        survey = survey_recording(recording, frames, progress=progress)
        if _NO_INTRINSICS_MESSAGE in warning:
            survey.facts = [(what, text) for what, text in survey.facts if what != "intrinsics"]
            survey.warnings = [line for line in survey.warnings if intrinsics_options.find_guess_report([line]) is None]
        survey.warnings.extend(warning)
        yield survey


def _open_recordings(capture: FoundCapture, warning: list[str]) -> Sequence[Recording]:
    """The recordings; where nobody says K with one that serves to look at them, and a warning."""
    how = {"follow_links": capture.follow_links, **capture.options}
    try:
        recordings = data.open_all(capture.path, capture.format, **how)
        _ = recordings[0]
    except intrinsics_options.MissingIntrinsicsError:
        warning.append(_NO_INTRINSICS_MESSAGE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return data.open_all(capture.path, capture.format, **{**how, "fov": _ASSUMED_FOV_DEG})
    return recordings


def _survey_stacks(capture: FoundCapture, frames: int) -> Iterator[Survey]:
    yield survey_stacks(formats.open_stacks(capture.path, capture.format, follow_links=capture.follow_links), frames)


def classify_images(folder: Path) -> tuple[list[Path], list[Path]]:
    """Pictures and depth maps (16 bits, one channel) of a folder and of those directly in it."""
    pictures: list[Path] = []
    depths: list[Path] = []
    for file in sorted((*folder.glob("*"), *folder.glob("*/*")), key=files.natural_sort_key):
        if file.suffix.lower() in _IMAGE_SUFFIXES and file.is_file():
            try:
                header = files.read_image_header(file)
            except FormatError:
                continue
            is_depth = (header.kind, header.channels, header.bits) == ("png", 1, 16)
            (depths if is_depth else pictures).append(file)
    return pictures, depths


def _survey_loose_pictures(capture: FoundCapture, frames: int) -> Iterator[Survey]:
    """Some of the pictures and depth maps of a folder, the latter taken to be in millimetres."""
    with doors.restrict_links(None if capture.follow_links else capture.path):
        yield from _read_loose_pictures(capture, frames)


def _read_loose_pictures(capture: FoundCapture, frames: int) -> Iterator[Survey]:
    pictures, depths = classify_images(capture.path)
    shown: dict[str, dict[str, Tensor]] = {"image": {}, "depth": {}}
    unreadable: list[str] = []
    for kind, sources in (("image", pictures), ("depth", depths)):
        for file in _pick_evenly(sources, frames):
            try:
                picture = files.read_image(file) if kind == "image" else files.read_depth_png(file, 1000.0)
                shown[kind][file.name] = torch.from_numpy(picture)
            except FormatError as error:
                unreadable.append(str(error))
    survey = survey_pictures(capture.path.resolve().name, shown["image"], shown["depth"])
    if depths:
        survey.warn("16-bit pictures are taken to be depth in millimetres")
    survey.warnings.extend(unreadable)
    yield survey


_SURVEYS_BY_KIND = {"recording": _survey_recordings, "stacks": _survey_stacks, "pictures": _survey_loose_pictures}


def _pick_evenly(items: Sequence[Path], count: int) -> list[Path]:
    n = len(items)
    return [items[i] for i in sorted({round(k * (n - 1) / max(count - 1, 1)) for k in range(count)})] if n else []


# ------------------------------------------------------------------------------------------------------------ showing


def print_survey(capture: FoundCapture, survey: Survey, console: Any = None) -> None:
    """Facts and warnings as a table (``console``: a ``rich.console.Console``; None = standard output)."""
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    console = console or Console(file=unwrap_terminal(sys.stdout))
    if not console.is_terminal:
        console.width = max(console.width, 140)  # a file has no edge to wrap at
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    table.add_row("path", escape_markup(str(capture.path)))
    table.add_row("format", escape_markup(f"{survey.format} ({capture.evidence})"))
    for what, text in survey.facts:
        table.add_row(escape_markup(what), escape_markup(text))
    for text in survey.warnings:
        table.add_row("[yellow]warning[/]", f"[yellow]{escape_markup(text)}[/]")
    console.print(f"[bold]{escape_markup(survey.name)}[/]")
    console.print(table)


def write_contact_sheet(survey: Survey, out: Path) -> Path:
    """Write the contact sheet into ``out``: pictures above their depth and confidence, below them depth and path.

    Returns:
        The PNG file, named after the recording.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows = [kind for kind in ("image", "depth", "conf") if any(getattr(t, kind) is not None for t in survey.tiles)]
    wanted = ((_plot_depths, survey.depths.numel() > 0), (_plot_path, survey.path is not None))
    plots = [draw for draw, there in wanted if there]
    first = next((x for t in survey.tiles for x in (t.image, t.depth) if x is not None), torch.zeros(3, 4))
    tall = 1.6 * min(max(first.shape[-2] / first.shape[-1], 0.5), 1.5) * len(rows) + 0.15
    width = max(1.6 * len(survey.tiles), 3.2 * len(plots), 4.8)
    heights = [tall, 1.9] if plots else [tall]
    figure = Figure(figsize=(width, sum(heights) + 0.3), dpi=120, layout="constrained")
    figure.suptitle(f"{survey.name}: {survey.format}", fontsize=9)
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _draw_tiles(parts[0], rows, survey)
    for k, draw in enumerate(plots):
        draw(parts[1].add_subplot(1, len(plots), k + 1), survey)
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', survey.name) or 'capture'}.png"
    figure.savefig(file)
    return file


def _draw_tiles(figure: Any, rows: Sequence[str], survey: Survey) -> None:
    limits = _depth_limits(survey.depths)
    for k, tile in enumerate(survey.tiles):
        title = tile.title[:22]
        for r, kind in enumerate(rows):
            axes = figure.add_subplot(len(rows), len(survey.tiles), r * len(survey.tiles) + k + 1)
            axes.axis("off")
            picture = getattr(tile, kind)
            if picture is not None:
                _draw_tile(axes, picture, kind, limits)
                axes.set_title(title, fontsize=6, pad=2)
                title = ""  # above the first picture of a column only


def _depth_limits(depths: Tensor) -> tuple[float, float]:
    if not depths.numel():
        return 0.0, 1.0
    low, high = np.percentile(depths.numpy(), (1, 99))
    return float(low), float(max(high, low + 1e-3))


def _draw_tile(axes: Any, picture: Tensor, kind: str, limits: tuple[float, float]) -> None:
    step = max(1, max(picture.shape[-2:]) // 400)
    if kind == "image":
        pixels = picture[:, ::step, ::step].permute(1, 2, 0).numpy()
        axes.imshow(pixels if pixels.shape[2] == 3 else pixels[..., 0], cmap=GREY_CMAP)
    elif kind == "depth":
        sparse = float((picture > 0).double().mean()) < _SPARSE_SHARE
        shown = _nearest_per_block(picture, 3 * step) if sparse else picture[::step, ::step]
        axes.imshow(np.ma.masked_equal(shown.numpy(), 0), cmap=DEPTH_CMAP, vmin=limits[0], vmax=limits[1])
        axes.add_patch(_make_outline(shown.shape))
    else:
        axes.imshow(picture[::step, ::step].numpy(), cmap=SCORE_CMAP, vmin=0, vmax=2, interpolation="nearest")


def _nearest_per_block(depth: Tensor, size: int) -> Tensor:
    """The nearest return in each block, 0 where there is none: single returns would not be seen."""
    far = torch.where(depth > 0, -depth, -torch.inf)
    best = -torch.nn.functional.max_pool2d(far[None], size, ceil_mode=True)[0]
    return torch.where(torch.isfinite(best), best, torch.zeros_like(best))


def _make_outline(shape: Sequence[int]) -> Any:
    """Around a depth map, since its holes are white."""
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    return Rectangle((-0.5, -0.5), shape[1], shape[0], fill=False, edgecolor=SILENT, linewidth=0.6)


def _plot_depths(axes: Any, survey: Survey) -> None:
    """How often which depth occurs, in the colours of the depth maps."""
    from matplotlib import colormaps  # noqa: PLC0415

    low, high = _depth_limits(survey.depths)
    counts, edges = np.histogram(survey.depths.numpy(), bins=90, range=(0, 1.1 * high))
    middle = (edges[1:] + edges[:-1]) / 2
    axes.bar(middle, counts, edges[1] - edges[0], color=colormaps[DEPTH_CMAP]((middle - low) / (high - low)))
    axes.set_xlabel("depth [m]", fontsize=7)
    axes.set_yticks([])
    axes.tick_params(labelsize=6)


def _plot_path(axes: Any, survey: Survey) -> None:
    """The two directions in which the camera moved most, both at the same scale."""
    assert survey.path is not None
    t = survey.path.double().numpy()
    a, b = sorted(np.argsort(np.ptp(t, axis=0))[1:])
    axes.plot(t[:, a], t[:, b], color=INK, linewidth=0.8)
    for place, mark, colour, label in (
        (t[0], "o", SERIES_COLOURS[0], "first"),
        (t[-1], "s", SERIES_COLOURS[1], "last"),
    ):
        axes.plot(place[a], place[b], mark, color=colour, markersize=4, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"path: {'xyz'[a]} [m]", fontsize=7)
    axes.set_ylabel(f"{'xyz'[b]} [m]", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.legend(fontsize=6, frameon=False)
