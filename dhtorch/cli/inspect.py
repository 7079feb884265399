"""``dhtorch inspect PATH``: facts, warnings and a contact sheet of a capture.

Captures are searched for at the path and up to two folders below it: recordings, else focal stacks, else loose images
of no known format.
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
from dhtorch.data.foreign_files import (
    NEEDS_DEPTH,
    PHONE_EXPORTS,
    describe_content,
    describe_foreign_file,
    describe_foreign_folder,
    describe_layout,
    list_files,
    may_hold_depth,
)
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.data.survey import Survey, survey_pictures, survey_recording
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.formats import survey_stacks
from dhtorch.experiments.focal.image_folder import list_camera_files
from dhtorch.geometry.sensor_noise import sensor_of_format
from dhtorch.pipeline.picture_matching import spread_evenly
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime import storage
from dhtorch.runtime.console import HELP_EPILOG, escape_markup, format_count, progress, unwrap_terminal
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.validation.capture_check import check_capture
from dhtorch.viz.plots import format_capture_name
from dhtorch.viz.plots.colours import DEPTH_CMAP, GREY_CMAP, INK, SCORE_CMAP, SERIES_COLOURS, UNANSWERED

_MAX_LEVELS = 2  # levels of folders searched below the path
_MAX_RECORDINGS = 12  # recordings shown of one capture
_NO_INTRINSICS_MESSAGE = (
    "no intrinsics: depth cannot be computed without them; set data.K=[fx,fy,cx,cy] or data.fov=DEGREES"
)
_ASSUMED_FOV_DEG = 60.0  # horizontal field of view assumed for a capture without intrinsics, degrees
_TILE_GAP = 0.02  # margin around a tile of the contact sheet, in widths of its cell
_ROW_LABELS = {"image": "Picture", "depth": "Depth", "conf": "Confidence\n0 dark, 2 bright"}
_BESIDE_TILES = {"textcoords": "offset points", "fontsize": 7, "color": INK, "ha": "right", "va": "center"}
_SPARSE_SHARE = 0.1  # fraction of pixels with a return below which returns are drawn larger
_CAPTURE_SUFFIXES = (  # of files that may be a whole capture
    (".r3d", ".mp4", ".mov", ".mkv", ".tar", ".h5", ".hdf5", ".bag", ".mcap", ".db3")
)
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class FoundCapture:
    """Path, format and kind of a capture, and the evidence for its format."""

    path: Path
    kind: str  # "recording", "stacks" or "pictures"
    format: str
    evidence: str
    follow_links: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)  # of the reader


def main(argv: Sequence[str]) -> int:
    """``dhtorch inspect PATH``: print the content of a capture, write a contact sheet.

    Raises:
        FormatError: no file, or no capture.
        KeyboardInterrupt: Ctrl-C; written contact sheets are kept.
    """
    parser = argparse.ArgumentParser(
        prog="dhtorch inspect",
        description="Print the content of a capture and write a contact sheet.",
        epilog=HELP_EPILOG,
    )
    parser.add_argument("path", type=Path, help="a capture: a file, its folder, or up to two folders above it")
    options_help = "reader option as data.NAME=VALUE: data.fov=69, data.K=[600,600,320,240], data.camera=[a,b]"
    parser.add_argument("options", nargs="*", default=[], metavar="data.NAME=VALUE", help=options_help)
    parser.add_argument("--out", type=Path, help="folder of the contact sheet (default: outputs/<date>/<time>)")
    parser.add_argument("--format", default="auto", help="name of the format (default: recognised from the content)")
    parser.add_argument("--max-frames", type=int, default=8, help="number of frames to decode and show (default: 8)")
    parser.add_argument("--traceback", action="store_true", help="show the traceback of an error")
    options = parser.parse_intermixed_args(argv)
    if options.max_frames < 1:
        raise ValueError(f"--max-frames: found {options.max_frames}, expected at least 1")
    reader_options = _parse_reader_options(options.options)
    links = reader_options.pop("follow_links", False)
    if not isinstance(links, bool):
        raise ValueError(f"data.follow_links: found {links!r}, expected true or false")
    if options.format == "auto":
        captures = find_captures(options.path, links)
    elif options.format in data.FORMATS or options.format in formats.STACK_FORMATS:
        kind = "stacks" if options.format in formats.STACK_FORMATS else "recording"
        captures = [FoundCapture(options.path, kind, options.format, "format= given")]
    else:
        known = ", ".join(("auto", *data.FORMATS, *formats.STACK_FORMATS))
        raise FormatError(options.path, "format", options.format, known)
    captures = [replace(capture, follow_links=links, options=reader_options) for capture in captures]
    now = datetime.now()
    out = options.out or Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S-%f}"
    root, sheets = options.path, list[Path]()
    with open_output_folder(out, "--out"):
        try:
            for capture in captures:
                for survey in survey_capture(capture, options.max_frames):
                    parts = capture.path.relative_to(root).parts
                    survey.name = "/".join((root.resolve().name, *parts[:-1], survey.name)) if parts else survey.name
                    print_survey(capture, survey)
                    sheets.append(write_contact_sheet(survey, out))
                    print(f"wrote {sheets[-1]}\n")
            if captures[0].kind == "pictures":
                print(f"{root}: {describe_pictures(root, captures)}")
        except KeyboardInterrupt:
            stay = f"{format_count(len(sheets), 'contact sheet')} in {out} kept; " if sheets else ""
            raise KeyboardInterrupt(f"{stay}run the same command again for the rest") from None
    return 0


def find_captures(path: Path, follow_links: bool = False) -> list[FoundCapture]:
    """Captures at ``path``, else one folder below, else two: the first level with any, folders before files.

    Recordings anywhere in these levels come before focal stacks and loose images.

    Raises:
        FormatError: no capture, or a folder that lacks a part of its layout.
    """
    doors.check_file_or_folder(path, "a capture")
    levels: list[list[Path]] = []
    for candidates in _list_levels(path):
        levels.append(candidates)
        if captures := _recognise_all(candidates, data.FORMATS, follow_links):
            return captures
        for folder in candidates:
            if foreign := describe_layout(folder):
                raise FormatError(folder, "content", foreign.what, foreign.remedy)
    for candidates in levels:
        if captures := _recognise_all(candidates, formats.STACK_FORMATS, follow_links) or [
            FoundCapture(folder, "pictures", "loose pictures", f"{format_count(count, 'picture')} of no known format")
            for folder in candidates
            if folder.is_dir()
            if (count := sum(file.suffix.lower() in _IMAGE_SUFFIXES for file in folder.iterdir()))
        ]:
            return captures
    content, remedy = _describe_content(path)
    expected = f"{PHONE_EXPORTS}; or one of the {len(data.FORMATS)} formats of docs/data.md"
    raise FormatError(path, "content", content, remedy or expected)


def _list_levels(path: Path) -> Iterator[list[Path]]:
    """The path, then the folders and those files one and two levels below that may be captures; folders are first."""
    level = [path]
    for _ in range(_MAX_LEVELS + 1):
        yield level
        inside = [
            entry
            for folder in level
            if folder.is_dir()
            for entry in sorted(folder.iterdir(), key=files.natural_sort_key)
        ]
        yield [entry for entry in inside if entry.suffix.lower() in _CAPTURE_SUFFIXES]
        level = [entry for entry in inside if entry.is_dir()]


def _describe_content(path: Path) -> tuple[str, str | None]:
    """Description of a path without a capture, and the step that would make it one."""
    if path.is_file():
        if foreign := describe_foreign_file(path):
            return foreign.what, foreign.remedy
        return f"a {path.suffix or 'plain'} file, which no reader supports", None
    if not any(path.iterdir()):
        return "an empty folder", None
    if foreign := describe_foreign_folder(path):
        return foreign.what, foreign.remedy
    # Files of upper folders first, in natural order
    for file in sorted(list_files(path), key=lambda file: (len(file.parts), files.natural_sort_key(file))):
        if foreign := describe_foreign_file(file):
            return f"{file.relative_to(path)}: {foreign.what}", foreign.remedy
    return f"no capture here or up to two folders below: {describe_content(path)}", None


def survey_capture(capture: FoundCapture, frames: int = 8) -> Iterator[Survey]:
    """Survey of each recording, focal stack or image folder of a capture.

    A folder that its reader rejects is surveyed as loose images, with the reader's message as a warning, unless reader
    options are set: these may be what it rejects.
    """
    links = capture.follow_links
    try:
        if capture.kind == "recording":
            surveys = _survey_recordings(capture, frames)
        elif capture.kind == "stacks":
            surveys = iter(
                [survey_stacks(formats.open_stacks(capture.path, capture.format, follow_links=links), frames)]
            )
        else:
            surveys = iter([_survey_loose_pictures(capture, frames)])
        for survey in surveys:
            if capture.options and capture.kind != "recording":
                survey.warn(f"not a recording: {', '.join(f'data.{name}' for name in capture.options)} not used")
            yield survey
    except FormatError as error:
        if capture.options or not capture.path.is_dir() or not any(classify_images(capture.path)):
            raise
        survey = _survey_loose_pictures(capture, frames)
        survey.warnings.insert(0, f"the {capture.format} reader rejects it: {error}")
        yield survey


def _parse_reader_options(arguments: Sequence[str]) -> dict[str, Any]:
    """Arguments ``data.NAME=VALUE`` -> reader options; a list is written a,b or [a,b].

    Raises:
        ValueError: another argument.
    """
    options: dict[str, Any] = {}
    for argument in arguments:
        name, sign, text = argument.partition("=")
        if not (sign and name.startswith("data.") and name.removeprefix("data.").isidentifier()):
            raise ValueError(f"{argument}: found an unknown argument, expected data.NAME=VALUE, e.g. data.fov=69")
        items: list[Any] = [item.strip() for item in text.removeprefix("[").removesuffix("]").split(",")]
        for k, item in enumerate(items):
            items[k] = {"true": True, "false": False, "null": None}.get(item.lower(), item)
            for kind in (float, int):
                with contextlib.suppress(ValueError):
                    items[k] = kind(item)
        options[name.removeprefix("data.")] = items if text.startswith("[") or len(items) > 1 else items[0]
    return options


# -------------------------------------------------------------------------------------------------------------- search


def _recognise_all(candidates: Sequence[Path], readers: Mapping[str, Any], follow_links: bool) -> list[FoundCapture]:
    """Captures at exactly these paths, each with the first of the formats that recognises it."""
    kind = "stacks" if readers is formats.STACK_FORMATS else "recording"
    captures = []
    for path in candidates:
        with doors.restrict_links(None if follow_links else path):
            formats_of_path = ((name, text) for name, reader in readers.items() if (text := reader.recognise(path)))
            captures += [FoundCapture(path, kind, *each) for each in islice(formats_of_path, 1)]
    return captures


def describe_pictures(path: Path, captures: Sequence[FoundCapture]) -> str:
    """Why images of no known format, found below ``path``, give no depth, and what is required instead."""
    lists = [classify_images(capture.path) for capture in captures]
    n_pictures, n_depths = (sum(len(each[k]) for each in lists) for k in (0, 1))
    pictures, depths = format_count(n_pictures, "picture"), format_count(n_depths, "depth map")
    if not n_pictures + n_depths:
        return f"no readable image ({describe_content(path)})"
    if n_pictures == n_depths == 1:
        return "one frame; recovering depth requires a second view from another position"
    if n_depths or may_hold_depth(path):
        what = " and ".join(text for n, text in ((n_pictures, pictures), (n_depths, depths)) if n)
        required = "a layout of docs/data.md is required, e.g. rgb/ beside depth/"
        return f"{what} of no known format ({describe_content(path)}); {required}"
    camera_files = list(dict.fromkeys(name for capture in captures for name in list_camera_files(capture.path)))
    cameras = f" (cameras in {', '.join(camera_files[:3])})" if camera_files else ""
    return f"{pictures} without depth{cameras}; {NEEDS_DEPTH}" + ("" if camera_files else f" ({PHONE_EXPORTS})")


def _survey_recordings(capture: FoundCapture, frames: int) -> Iterator[Survey]:
    """Survey of each recording; without images where these cannot be read and the reader supports it."""
    warning: list[str] = []
    links = capture.follow_links
    try:
        recordings = _open_recordings(capture, warning)
    except FormatError as error:
        if "images" not in inspect.signature(data.FORMATS[capture.format].read).parameters:
            raise
        recordings = data.open_all(capture.path, capture.format, follow_links=links, images=False)
        warning = [f"no images: {error}"]
    if len(recordings) > _MAX_RECORDINGS:
        warning.append(f"{len(recordings)} recordings in this capture, the first {_MAX_RECORDINGS} shown")
    for recording in islice(recordings, _MAX_RECORDINGS):
        survey = survey_recording(recording, frames, progress=progress)
        if _NO_INTRINSICS_MESSAGE in warning:
            survey.facts = [(what, text) for what, text in survey.facts if what != "intrinsics"]
            survey.warnings = [line for line in survey.warnings if intrinsics_options.find_guess_report([line]) is None]
        survey.warnings.extend(warning)
        check = check_capture(recording, survey.decoded)
        unit = check.assumed_unit or (str(recording.depth_unit) if recording.depth_unit is not None else "")
        if unit:
            survey.add_fact("unit", unit)
        if check.poses is not None:
            surfaces = check.poses.surfaces
            agreement = f"agree to {100 * surfaces.stated:.2f} % from frame to frame"
            survey.add_fact("depth and poses", f"{agreement} ({100 * surfaces.without:.2f} % without poses)")
        for limit in check.limits:
            survey.add_fact("not checked", limit)
        survey.warnings.extend(str(finding) for finding in check.findings)
        yield survey


def _open_recordings(capture: FoundCapture, warning: list[str]) -> Sequence[Recording]:
    """The recordings; without intrinsics, with an assumed field of view and a warning."""
    reader_options = {"follow_links": capture.follow_links, **capture.options}
    try:
        recordings = data.open_all(capture.path, capture.format, **reader_options)
        _ = recordings[0]
    except intrinsics_options.MissingIntrinsicsError:
        warning.append(_NO_INTRINSICS_MESSAGE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return data.open_all(capture.path, capture.format, **{**reader_options, "fov": _ASSUMED_FOV_DEG})
    return recordings


def classify_images(folder: Path) -> tuple[list[Path], list[Path]]:
    """Images and depth maps (16 bits, one channel) of a folder and of its direct subfolders."""
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


def _survey_loose_pictures(capture: FoundCapture, frames: int) -> Survey:
    """Survey of evenly picked images and depth maps of a folder; 16-bit images are taken as millimetres."""
    shown: dict[str, dict[str, Tensor]] = {"image": {}, "depth": {}}
    unreadable: list[str] = []
    with doors.restrict_links(None if capture.follow_links else capture.path):
        pictures, depths = classify_images(capture.path)
        for kind, sources in (("image", pictures), ("depth", depths)):
            for file in spread_evenly(sources, frames):
                try:
                    picture = files.read_image(file) if kind == "image" else files.read_depth_png(file, 1000.0)
                    shown[kind][file.name] = torch.from_numpy(picture)
                except FormatError as error:
                    unreadable.append(str(error))
    survey = survey_pictures(capture.path.resolve().name, shown["image"], shown["depth"])
    if depths:
        survey.warn("16-bit images are taken as depth in millimetres")
    survey.warnings.extend(unreadable)
    return survey


# ------------------------------------------------------------------------------------------------------------- output


def print_survey(capture: FoundCapture, survey: Survey, console: Any = None) -> None:
    """Print facts and warnings as a table (``console``: a ``rich.console.Console``; None = standard output)."""
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    console = console or Console(file=unwrap_terminal(sys.stdout))
    if not console.is_terminal:
        console.width = max(console.width, 140)  # no line wrapping in a file
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    table.add_row("path", escape_markup(str(capture.path)))
    table.add_row("format", escape_markup(f"{survey.format} ({capture.evidence})"))
    if sensor := sensor_of_format(survey.format):
        table.add_row("sensor", f"of this format, {sensor}; dhtorch PATH --sensor {sensor} states its noise")
    for what, text in survey.facts:
        table.add_row(escape_markup(what), escape_markup(text))
    for text in survey.warnings:
        table.add_row("[yellow]warning[/]", f"[yellow]{escape_markup(text)}[/]")
    console.print(f"[bold]{escape_markup(survey.name)}[/]")
    console.print(table)


def write_contact_sheet(survey: Survey, out: Path) -> Path:
    """Write the contact sheet into ``out``: images, depth, confidence; below, depth histogram and camera path.

    Returns:
        The PNG file, named after the recording.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows = [kind for kind in ("image", "depth", "conf") if any(getattr(t, kind) is not None for t in survey.tiles)]
    plot_conditions = ((_plot_depths, survey.depths.numel() > 0), (_plot_path, survey.path is not None))
    plots = [draw for draw, is_available in plot_conditions if is_available]
    first = next((x for t in survey.tiles for x in (t.image, t.depth) if x is not None), torch.zeros(3, 4))
    tiles_height = 1.6 * min(max(first.shape[-2] / first.shape[-1], 0.5), 1.5) * len(rows) + 0.15
    width = max(1.6 * len(survey.tiles), 3.2 * len(plots), 4.8)
    heights = [tiles_height, 1.9] if plots else [tiles_height]
    figure = Figure(figsize=(width, sum(heights) + 0.3), dpi=120, layout="constrained")
    title = f"{format_capture_name(survey.name)}: {survey.format}"
    figure.suptitle(title, fontsize=9, fontweight="bold", color=INK, x=0.01, ha="left")
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _draw_tiles(parts[0], rows, survey)
    for k, draw in enumerate(plots):
        draw(parts[1].add_subplot(1, len(plots), k + 1), survey)
    file = out / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', survey.name) or 'capture'}.png"
    with storage.replace_at_end(file) as unfinished:
        figure.savefig(unfinished, format="png")
    return file


def _draw_tiles(figure: Any, rows: Sequence[str], survey: Survey) -> None:
    """One axes a row, each tile in a cell of width 1: an axes a tile takes several times as long."""
    limits = _depth_limits(survey.depths)
    sizes = [
        getattr(tile, kind).shape[-2:] for tile in survey.tiles for kind in rows if getattr(tile, kind) is not None
    ]
    height = max((h / w for h, w in sizes), default=0.75)
    for r, kind in enumerate(rows):
        axes = figure.add_subplot(len(rows), 1, r + 1)
        axes.axis("off")
        axes.annotate(_ROW_LABELS[kind], (0, height / 2), (-4, 0), rotation=90, **_BESIDE_TILES)
        for k, tile in enumerate(survey.tiles):
            picture = getattr(tile, kind)
            if picture is None:
                continue
            hw = picture.shape[-2:]
            half_width = (0.5 - _TILE_GAP) * min(1.0, height * hw[1] / hw[0])
            half_height = half_width * hw[0] / hw[1]
            extent = k + 0.5 - half_width, k + 0.5 + half_width, height / 2 - half_height, height / 2 + half_height
            step = max(1, max(picture.shape[-2:]) // 400)
            if kind == "image":
                pixels = picture[:, ::step, ::step].permute(1, 2, 0).numpy()
                axes.imshow(pixels if pixels.shape[2] == 3 else pixels[..., 0], cmap=GREY_CMAP, extent=extent)
            elif kind == "depth":
                sparse = float((picture > 0).double().mean()) < _SPARSE_SHARE
                shown = _nearest_per_block(picture, 3 * step) if sparse else picture[::step, ::step]
                masked = np.ma.masked_equal(shown.numpy(), 0)
                axes.imshow(masked, cmap=DEPTH_CMAP, vmin=limits[0], vmax=limits[1], extent=extent)
                # Outline of a depth map, whose holes are white
                from matplotlib.patches import Rectangle  # noqa: PLC0415

                left, right, bottom, top = extent
                axes.add_patch(
                    Rectangle(
                        (left, bottom), right - left, top - bottom, fill=False, edgecolor=UNANSWERED, linewidth=0.6
                    )
                )
            else:
                pixels = picture[::step, ::step].numpy()
                axes.imshow(pixels, cmap=SCORE_CMAP, vmin=0, vmax=2, interpolation="nearest", extent=extent)
            if not any(getattr(tile, above) is not None for above in rows[:r]):
                place = (extent[0] + extent[1]) / 2, extent[3]
                words = f"frame {tile.title}" if tile.title.isdigit() else tile.title
                axes.annotate(words[:22], place, (0, 2), textcoords="offset points", fontsize=6, ha="center")
        axes.set(xlim=(-_TILE_GAP, len(survey.tiles) + _TILE_GAP), ylim=(0, height), aspect="equal")


def _depth_limits(depths: Tensor) -> tuple[float, float]:
    if not depths.numel():
        return 0.0, 1.0
    low, high = np.percentile(depths.numpy(), (1, 99))
    return float(low), float(max(high, low + 1e-3))


def _nearest_per_block(depth: Tensor, size: int) -> Tensor:
    """Nearest return in each block of ``size`` px, 0 without one: single sparse returns would be invisible."""
    negated = torch.where(depth > 0, -depth, -torch.inf)
    best = -torch.nn.functional.max_pool2d(negated[None], size, ceil_mode=True)[0]
    return torch.where(torch.isfinite(best), best, torch.zeros_like(best))


def _plot_depths(axes: Any, survey: Survey) -> None:
    """Histogram of depth in the colours of the depth maps."""
    from matplotlib import colormaps  # noqa: PLC0415

    low, high = _depth_limits(survey.depths)
    counts, edges = np.histogram(survey.depths.numpy(), bins=90, range=(0, 1.1 * high))
    middle = (edges[1:] + edges[:-1]) / 2
    axes.bar(middle, counts, edges[1] - edges[0], color=colormaps[DEPTH_CMAP]((middle - low) / (high - low)))
    axes.set_xlabel("depth, m, coloured as above (white: no return)", fontsize=7)
    axes.set_yticks([])
    axes.tick_params(labelsize=6)


def _plot_path(axes: Any, survey: Survey) -> None:
    """Camera path along the two axes of largest motion, both at one scale."""
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
    axes.set_xlabel(f"path of the camera: {'xyz'[a]}, m", fontsize=7)
    axes.set_ylabel(f"{'xyz'[b]}, m", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.legend(fontsize=6, frameon=False)
