"""``dhtorch inspect PATH``: facts, warnings and a contact sheet of a capture.

Captures are searched for at the path and up to two folders below it: recordings, else focal stacks, else loose images
of no known format.
"""

import inspect
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from dhtorch.experiments.focal.formats import list_camera_files, survey_stacks
from dhtorch.geometry.sensor_noise import sensor_of_format
from dhtorch.pipeline.picture_matching import spread_evenly
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime.console import escape_markup, format_count, progress, unwrap_terminal
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.validation.capture_check import check_capture
from dhtorch.viz.plots import format_capture_name, make_image_grid, save_figure
from dhtorch.viz.plots.colours import DEPTH_CMAP, SCORE_CMAP
from dhtorch.viz.plots.maps import Scale, to_unit_rgb

_MAX_LEVELS = 2  # levels of folders searched below the path
_MAX_RECORDINGS = 12  # recordings shown of one capture
_NO_INTRINSICS_MESSAGE = (
    "no intrinsics: depth cannot be computed without them; set data.K=[fx,fy,cx,cy] or data.fov=DEGREES"
)
_ASSUMED_FOV_DEG = 60.0  # horizontal field of view assumed for a capture without intrinsics, degrees
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


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Any) -> int:
    """``dhtorch inspect PATH``: print the content of a capture, write a contact sheet.

    Raises:
        FormatError: no file, or no capture.
        KeyboardInterrupt: Ctrl-C; written contact sheets are kept.
    """
    root, out, format = Path(str(settings["path"])).expanduser(), Path(settings["output"]), settings["format"]
    reader_options = {name: value for name, value in settings["data"].items() if value is not None}
    links = reader_options.pop("follow_links", False)
    if format == "auto":
        captures = find_captures(root, links)
    elif format in data.FORMATS or format in formats.STACK_FORMATS:
        kind = "stacks" if format in formats.STACK_FORMATS else "recording"
        captures = [FoundCapture(root, kind, format, "format= given")]
    else:
        known = ", ".join(("auto", *data.FORMATS, *formats.STACK_FORMATS))
        raise FormatError(root, "format", format, known)
    captures = [replace(capture, follow_links=links, options=reader_options) for capture in captures]
    sheets = list[Path]()
    with open_output_folder(out, "output"):
        try:
            for capture in captures:
                for survey in survey_capture(capture, settings["max_frames"]):
                    parts_below = capture.path.relative_to(root).parts
                    if parts_below:
                        survey.name = "/".join((root.resolve().name, *parts_below[:-1], survey.name))
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
        if capture.options or not capture.path.is_dir() or not any(_classify_images(capture.path)):
            raise
        survey = _survey_loose_pictures(capture, frames)
        survey.warnings.insert(0, f"the {capture.format} reader rejects it: {error}")
        yield survey


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
    lists = [_classify_images(capture.path) for capture in captures]
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


def _classify_images(folder: Path) -> tuple[list[Path], list[Path]]:
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
        pictures, depths = _classify_images(capture.path)
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
    """Write the contact sheet into ``out``: images, depth on one scale, confidence.

    Returns:
        The PNG file, named after the recording.
    """
    tiles = survey.tiles
    low, high = np.percentile(survey.depths.numpy(), (1, 99)).tolist() if survey.depths.numel() else (0.0, 1.0)
    scales = {"depth": Scale("depth, m; blank: no return", DEPTH_CMAP, low, max(high, low + 1e-3), log=False)}
    scales["conf"] = Scale("", SCORE_CMAP, 0.0, 2.0, log=False)
    rows = []
    for kind, label in (("image", "frame"), ("depth", "depth"), ("conf", "confidence")):
        given = [getattr(tile, kind) for tile in tiles]
        ratio = max((x.shape[-2] / x.shape[-1] for x in given if x is not None), default=None)
        if ratio is not None:
            painted = [_paint_tile(x, scales.get(kind), ratio) for x in given]
            rows.append([(f"{label} {tile.title[:22]}", x) for tile, x in zip(tiles, painted, strict=True)])
    has_depth = any(tile.depth is not None for tile in tiles)
    shown = ((scales["depth"], 0, len(tiles) - 1),) if has_depth else ()
    title = f"{format_capture_name(survey.name)}: {survey.format}"
    width = max(150.0, 340.0 / max(1, len(tiles)))
    figure, _ = make_image_grid(title, rows or [[("no frame", np.ones((3, 4)))]], shown, width=width, dpi=120.0)
    file = out / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', survey.name) or 'capture'}.png"
    save_figure(figure, file)
    return file


def _paint_tile(pixels: Tensor | None, scale: Scale | None, ratio: float) -> np.ndarray:
    """Image, or values on a scale, as colours in a white frame with this ratio of height to width; blank for None."""
    if pixels is None:
        return np.ones((3, 4))
    step = max(1, max(pixels.shape[-2:]) // 400)
    if scale is None:
        image = to_unit_rgb(pixels[:, ::step, ::step])
        painted = np.stack([image] * 3, -1) if image.ndim == 2 else image
    else:
        values = pixels[::step, ::step]
        if scale.low > 0 and float((pixels > 0).double().mean()) < _SPARSE_SHARE:
            # The nearest return in each block of pixels: single sparse returns would be invisible
            negated = torch.where(pixels > 0, -pixels, -torch.inf)[None]
            values = -torch.nn.functional.max_pool2d(negated, 3 * step, ceil_mode=True)[0]
        shown = values.double().numpy()
        painted = scale.paint(shown, np.isfinite(shown) & ((shown > 0) | (scale.low == 0)))
    h, w = painted.shape[:2]
    framed = np.ones((max(h, round(ratio * w)), max(w, round(h / ratio)), 3))
    top, left = (framed.shape[0] - h) // 2, (framed.shape[1] - w) // 2
    framed[top : top + h, left : left + w] = painted
    return framed
