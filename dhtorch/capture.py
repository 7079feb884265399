"""``dhtorch inspect PATH``: what a capture holds, before anything is made of it.

Prints facts and warnings and writes a contact sheet. It looks for captures at the path and up to two folders below; a
recording, a focal stack, and loose pictures that belong to no format are all shown, nothing is refused.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data import FormatError, files, focal_stacks
from dhtorch.data.survey import Survey, survey_pictures, survey_recording, survey_stacks

_LEVELS = 2  # folders below the path
_MOST = 12  # recordings that are shown of one capture
_PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Found:
    """A capture, and what makes it one."""

    path: Path
    kind: str  # "recording", "stacks" or "pictures"
    format: str
    evidence: str


def main(argv: Sequence[str]) -> int:
    """``dhtorch inspect PATH``: print what a capture holds, write a contact sheet.

    Raises:
        FormatError: nothing there, or nothing that could be shown.
    """
    parser = argparse.ArgumentParser(prog="dhtorch inspect", description="What a capture holds, and a contact sheet.")
    parser.add_argument("path", type=Path, help="a capture: a folder, up to two folders above it, or a file")
    parser.add_argument("--out", type=Path, help="folder of the contact sheet (default: outputs/<date>/<time>)")
    parser.add_argument("--format", default="auto", help="name of the format, where it is not to be recognised")
    parser.add_argument("--frames", type=int, default=8, help="frames to decode and show (default: 8)")
    parser.add_argument("--traceback", action="store_true", help="show where an error came from")
    options = parser.parse_args(argv)
    if options.frames < 1:
        raise ValueError(f"--frames: found {options.frames}, expected at least 1")
    found = find(options.path) if options.format == "auto" else [_named(options.path, options.format)]
    now = datetime.now()
    out = options.out or Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}"
    for capture in found:
        for survey in surveys(capture, options.frames):
            print_survey(capture, survey)
            print(f"wrote {write_sheet(survey, out)}\n")
    return 0


def find(path: Path) -> list[Found]:
    """The captures at ``path``, else one folder below, else two; the nearest level that has any.

    Raises:
        FormatError: there is none.
    """
    if not path.exists():
        raise FormatError(path, "path", "no such file or folder", "a capture")
    level = [path]
    for _ in range(_LEVELS + 1):
        found = [capture for folder in level if (capture := _recognised(folder)) is not None]
        if found:
            return found
        level = [entry for folder in level if folder.is_dir() for entry in sorted(folder.iterdir()) if entry.is_dir()]
    formats = ", ".join((*data.FORMATS, *focal_stacks.STACK_FORMATS))
    raise FormatError(path, "content", "no capture here or two folders below", f"one of {formats}, or pictures")


def surveys(capture: Found, frames: int = 8) -> Iterator[Survey]:
    """What each recording (stack, folder of pictures) of a capture holds.

    A recording that its reader refuses is shown as the loose pictures it has, with the reader's words as a warning.
    """
    if capture.kind == "stacks":
        yield survey_stacks(data.open_stacks(capture.path, capture.format), frames)
    elif capture.kind == "pictures":
        yield _survey_loose(capture.path, frames)
    else:
        try:
            recordings, warning = _opened(capture)
        except FormatError as error:
            if not capture.path.is_dir() or not any(_classified(capture.path)):
                raise
            survey = _survey_loose(capture.path, frames)
            survey.warnings.insert(0, f"the {capture.format} reader refuses it: {error}")
            yield survey
            return
        for recording in recordings[:_MOST]:
            survey = survey_recording(recording, frames)
            survey.warnings.extend(warning)
            if len(recordings) > _MOST:
                survey.warn(f"{len(recordings)} recordings in this capture: the first {_MOST} are shown")
            yield survey


# ------------------------------------------------------------------------------------------------------------- finding


def _named(path: Path, format: str) -> Found:
    if format in focal_stacks.STACK_FORMATS:
        return Found(path, "stacks", format, "as told")
    if format not in data.FORMATS:
        raise FormatError(path, "format", format, ", ".join(("auto", *data.FORMATS, *focal_stacks.STACK_FORMATS)))
    return Found(path, "recording", format, "as told")


def _recognised(path: Path) -> Found | None:
    """What stands at this very path: a recording wins over focal stacks, these over loose pictures."""
    for name, reader in data.FORMATS.items():
        if evidence := reader.recognise(path):
            return Found(path, "recording", name, evidence)
    for name, reader in focal_stacks.STACK_FORMATS.items():
        if evidence := reader.recognise(path):
            return Found(path, "stacks", name, evidence)
    if path.is_dir() and (count := sum(file.suffix.lower() in _PICTURES for file in path.iterdir())):
        return Found(path, "pictures", "loose pictures", f"{count} pictures of no known format")
    return None


def _opened(capture: Found) -> tuple[list[Any], list[str]]:
    """The recordings; without their pictures where these are missing and the reader can do so."""
    try:
        return data.open_all(capture.path, capture.format), []
    except FormatError as error:
        if "images" not in inspect.signature(data.FORMATS[capture.format].read).parameters:
            raise
        return data.open_all(capture.path, capture.format, images=False), [f"no pictures: {error}"]


def _classified(folder: Path) -> tuple[list[Path], list[Path]]:
    """Pictures and depth maps (16 bits, one channel) of a folder and of those directly in it."""
    pictures: list[Path] = []
    depths: list[Path] = []
    for file in sorted((*folder.glob("*"), *folder.glob("*/*"))):
        if file.suffix.lower() in _PICTURES and file.is_file():
            try:
                header = files.image_header(file)
            except FormatError:
                continue
            is_depth = (header.kind, header.channels, header.bits) == ("png", 1, 16)
            (depths if is_depth else pictures).append(file)
    return pictures, depths


def _survey_loose(folder: Path, frames: int) -> Survey:
    """Some of the pictures and depth maps, the latter taken to be in millimetres."""
    pictures, depths = _classified(folder)
    images: dict[str, Tensor] = {}
    metres: dict[str, Tensor] = {}
    unreadable: list[str] = []
    for file in _spread(pictures, frames):
        try:
            images[file.name] = torch.from_numpy(files.read_image(file))
        except FormatError as error:
            unreadable.append(str(error))
    for file in _spread(depths, frames):
        try:
            metres[file.name] = torch.from_numpy(files.read_depth_png(file, 1000.0))
        except FormatError as error:
            unreadable.append(str(error))
    survey = survey_pictures(folder.resolve().name, images, metres)
    if depths:
        survey.warn("16-bit pictures are taken to be depth in millimetres")
    survey.warnings.extend(unreadable)
    return survey


def _spread(items: Sequence[Path], count: int) -> list[Path]:
    n = len(items)
    return [items[i] for i in sorted({round(k * (n - 1) / max(count - 1, 1)) for k in range(min(count, n))})]


# ------------------------------------------------------------------------------------------------------------ showing


def print_survey(capture: Found, survey: Survey, console: Any = None) -> None:
    """Facts and warnings as a table (``console``: a ``rich.console.Console``; None = standard output)."""
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, 140)  # a file has no edge to wrap at
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    table.add_row("path", escape(str(capture.path)))
    table.add_row("format", escape(f"{survey.format} ({capture.evidence})"))
    for what, text in survey.facts:
        table.add_row(escape(what), escape(text))
    for text in survey.warnings:
        table.add_row("[yellow]warning[/]", f"[yellow]{escape(text)}[/]")
    console.print(f"[bold]{escape(survey.name)}[/]")
    console.print(table)


def write_sheet(survey: Survey, out: Path) -> Path:
    """Write the contact sheet into ``out``; pictures above their depth and confidence, then depth and path.

    Returns:
        The PNG file, named after the recording.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows = [kind for kind in ("image", "depth", "conf") if any(getattr(t, kind) is not None for t in survey.tiles)]
    plots = [kind for kind, there in (("depths", survey.depths.numel()), ("path", survey.path is not None)) if there]
    columns = max(len(survey.tiles), 2 * len(plots), 1)
    first = next((x for t in survey.tiles for x in (t.image, t.depth) if x is not None), torch.zeros(1, 3, 4))
    aspect = min(max(first.shape[-2] / first.shape[-1], 0.5), 1.5)
    heights = [1.6 * aspect] * len(rows) + [1.7] * bool(plots)
    figure = Figure(figsize=(1.6 * columns + 0.9, sum(heights) + 0.7), dpi=120, layout="constrained")
    figure.suptitle(f"{survey.name}: {survey.format}", fontsize=9)
    grid = figure.add_gridspec(max(len(heights), 1), columns, height_ratios=heights or None)
    limits = _limits(survey.depths)
    for r, kind in enumerate(rows):
        for k, tile in enumerate(survey.tiles):
            axes = figure.add_subplot(grid[r, k])
            axes.axis("off")
            _draw(axes, getattr(tile, kind), kind, limits)
            if r == 0 or (kind == "depth" and tile.image is None):
                axes.set_title(tile.title[:18], fontsize=6, pad=2)
    for k, kind in enumerate(plots):
        axes = figure.add_subplot(grid[len(rows), k * columns // len(plots) : (k + 1) * columns // len(plots)])
        (_plot_depths if kind == "depths" else _plot_path)(axes, survey)
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', survey.name) or 'capture'}.png"
    figure.savefig(file)
    return file


def _limits(depths: Tensor) -> tuple[float, float]:
    if not depths.numel():
        return 0.0, 1.0
    low, high = np.percentile(depths.numpy(), (1, 99))
    return float(low), float(max(high, low + 1e-3))


def _draw(axes: Any, picture: Tensor | None, kind: str, limits: tuple[float, float]) -> None:
    if picture is None:
        return
    step = max(1, max(picture.shape[-2:]) // 400)
    picture = picture[..., ::step, ::step]
    if kind == "image":
        pixels = picture.permute(1, 2, 0).numpy()
        axes.imshow(pixels if pixels.shape[2] == 3 else pixels[..., 0], cmap="gray")
    elif kind == "depth":
        axes.imshow(np.ma.masked_equal(picture.numpy(), 0), cmap="turbo_r", vmin=limits[0], vmax=limits[1])
        axes.add_patch(_frame(picture.shape))
    else:
        axes.imshow(picture.numpy(), cmap="viridis", vmin=0, vmax=2, interpolation="nearest")


def _frame(shape: Sequence[int]) -> Any:
    """The outline of a depth map, since its holes are white."""
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    return Rectangle((-0.5, -0.5), shape[1], shape[0], fill=False, edgecolor="#B4B4B4", linewidth=0.6)


def _plot_depths(axes: Any, survey: Survey) -> None:
    axes.hist(survey.depths.numpy(), bins=80, range=(0, _limits(survey.depths)[1] * 1.1), color="#0072B2")
    axes.set_xlabel("depth [m]", fontsize=7)
    axes.set_yticks([])
    axes.tick_params(labelsize=6)


def _plot_path(axes: Any, survey: Survey) -> None:
    """The two directions in which the camera moved most, both at the same scale."""
    assert survey.path is not None
    t = survey.path.double().numpy()
    wide = np.sort(np.argsort(np.ptp(t, axis=0))[1:])
    axes.plot(t[:, wide[0]], t[:, wide[1]], color="#333333", linewidth=0.8)
    axes.plot(*t[0, wide], "o", color="#009E73", markersize=4, label="first")
    axes.plot(*t[-1, wide], "s", color="#D55E00", markersize=4, label="last")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[wide[0]]} [m]", fontsize=7)
    axes.set_ylabel(f"{'xyz'[wide[1]]} [m]", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.legend(fontsize=6, frameon=False)
