"""Pictures of a completed recording: contact sheet of some frames, strip of picture, sensor and completed depth.

Arrays may be torch tensors or numpy arrays, on any device, of one view (no batch dimension).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from dhtorch.codes import Source
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.axis import Axis
from dhtorch.viz.plots.canvas import Canvas, save_figure
from dhtorch.viz.plots.maps import (
    HEADER_HEIGHT_PT,
    SCALE_HEIGHT_PT,
    TITLE_HEIGHT_PT,
    apply_log_cmap,
    as_array,
    draw_scale,
    fit_depth_axis,
    fit_sigma_axis,
    format_kinds,
    to_unit_rgb,
)

#: Width of an image of the contact sheet, points.
_SHEET_WIDTH_PT = 252.0
#: Gap between two images, points.
_GAP_PT = 8.0
#: Pixels per inch of the contact sheet: 1600 px and more in width.
_SHEET_DPI = 116.0
#: Largest width of an image of the strip, px.
_MAX_STRIP_WIDTH_PX = 640
#: Pixels per inch of the strip: two pixels per point, so that its sides are even, which video encoders require.
_STRIP_DPI = 144.0
#: Empty rows below the key of the strip, even.
_STRIP_MARGIN_PX = 12
#: Side of the square beside the key of pixels without depth, points.
_KEY_SIDE_PT = 11.0

_NO_DEPTH = "no sensor return, or no answer"
_COLUMNS = ("Picture", "Sensor", "Completed", "Sigma / depth")


class CompletedView(NamedTuple):
    """A frame and its completed maps."""

    label: str
    image: Any  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    depth: Any  # (h, w) m, 0 or NaN without an answer
    sigma: Any  # (h, w) m
    source: Any  # (h, w) codes.Source

    @property
    def masks(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels with a return of the sensor, and with any depth."""
        z, code = as_array(self.depth), as_array(self.source)
        answered = np.isfinite(z) & (z > 0) & (code != Source.NONE)
        return answered & (code == Source.SENSOR), answered


def fit_common_depth_axis(views: Sequence[CompletedView]) -> Axis:
    """Views -> log axis of all their depths."""
    return fit_depth_axis(np.concatenate([as_array(view.depth)[view.masks[1]] for view in views]))


def draw_contact_sheet(path: str | Path | IO[bytes], views: Sequence[CompletedView], *, title: str = "") -> None:
    """Draw a row per view: picture, sensor depth, completed depth on the same scale for all rows, sigma / depth."""
    axis, sigma_axis = fit_common_depth_axis(views), fit_sigma_axis()
    heights = [_SHEET_WIDTH_PT * hw[0] / hw[1] for hw in (as_array(view.depth).shape for view in views)]
    lefts = [k * (_SHEET_WIDTH_PT + _GAP_PT) for k in range(len(_COLUMNS))]
    width = lefts[-1] + _SHEET_WIDTH_PT
    top = SCALE_HEIGHT_PT + sum(heights) + len(views) * TITLE_HEIGHT_PT + HEADER_HEIGHT_PT
    canvas = Canvas(width, top + HEADER_HEIGHT_PT * bool(title), _SHEET_DPI)
    canvas.title(title, width, top + HEADER_HEIGHT_PT)
    for left, name in zip(lefts, _COLUMNS, strict=True):
        canvas.text(name, left + 2, top - 14, bold=True)
    bottom = top - HEADER_HEIGHT_PT
    for view, height in zip(views, heights, strict=True):
        sensed, answered = view.masks
        bottom -= height + TITLE_HEIGHT_PT
        canvas.text(f"{view.label}: {format_kinds(view.source, answered)} of the pixels", 2, bottom + height + 5)
        z, s = as_array(view.depth), as_array(view.sigma)
        ratio = np.where(answered, s / np.where(answered, z, 1), 1)
        pictures = (
            to_unit_rgb(view.image),
            apply_log_cmap(z, sensed, axis, colours.DEPTH_CMAP),
            apply_log_cmap(z, answered, axis, colours.DEPTH_CMAP),
            apply_log_cmap(ratio, answered, sigma_axis, colours.ERROR_CMAP),
        )
        for left, pixels in zip(lefts, pictures, strict=True):
            canvas.picture(pixels, (left, bottom, _SHEET_WIDTH_PT, height))
    _draw_no_depth_key(canvas, lefts[0])
    draw_scale(canvas, axis, colours.DEPTH_CMAP, lefts[1], lefts[2] + _SHEET_WIDTH_PT - lefts[1])
    draw_scale(canvas, sigma_axis, colours.ERROR_CMAP, lefts[3], _SHEET_WIDTH_PT)
    save_figure(canvas.figure, path)


class Strip:
    """Pictures of one size with picture, sensor depth and completed depth side by side, title and key.

    Args:
        title: above the pictures.
        hw: size of the maps; views of another size are resampled to it.
        axis: log axis of depth, common to all pictures.
    """

    def __init__(self, title: str, hw: tuple[int, int], axis: Axis) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

        self.axis = axis
        scale = min(1.0, _MAX_STRIP_WIDTH_PX / hw[1])
        self.hw = tuple(2 * max(1, round(scale * size / 2)) for size in hw)  # even, px
        height, width = (72 * size / _STRIP_DPI for size in self.hw)
        self._lefts = [_GAP_PT + k * (width + _GAP_PT) for k in range(3)]
        full, top = self._lefts[-1] + width, SCALE_HEIGHT_PT + height + TITLE_HEIGHT_PT
        canvas = Canvas(full + _GAP_PT, top + HEADER_HEIGHT_PT, _STRIP_DPI)
        canvas.title(title, full, top + HEADER_HEIGHT_PT, self._lefts[0])
        for left, name in zip(self._lefts, _COLUMNS[:3], strict=True):
            canvas.text(name, left + 2, top - 14, bold=True)
        _draw_no_depth_key(canvas, self._lefts[0])
        draw_scale(canvas, axis, colours.DEPTH_CMAP, self._lefts[1], full - self._lefts[1])
        agg = FigureCanvasAgg(canvas.figure)
        agg.draw()
        margin = (0, _STRIP_MARGIN_PX), (0, 0), (0, 0)
        self._background = np.pad(np.asarray(agg.buffer_rgba())[..., :3], margin, constant_values=255)
        self.picture_hw = self._background.shape[0], self._background.shape[1]  # even, px
        self._top = round((HEADER_HEIGHT_PT + TITLE_HEIGHT_PT) * _STRIP_DPI / 72)

    def render(self, view: CompletedView) -> np.ndarray:
        """View -> picture (H, W, 3) uint8."""
        sensed, answered = view.masks
        z = as_array(view.depth)
        image = to_unit_rgb(view.image)
        panels = (
            image if image.ndim == 3 else image[..., None].repeat(3, -1),
            apply_log_cmap(z, sensed, self.axis, colours.DEPTH_CMAP),
            apply_log_cmap(z, answered, self.axis, colours.DEPTH_CMAP),
        )
        picture = self._background.copy()
        for left, pixels in zip(self._lefts, panels, strict=True):
            u, (h, w) = round(left * _STRIP_DPI / 72), self.hw
            picture[self._top : self._top + h, u : u + w] = (255 * _resample(pixels, h, w)).round().astype(np.uint8)
        return picture


def _resample(pixels: np.ndarray, h: int, w: int) -> np.ndarray:
    """Image (H, W, 3) -> (h, w, 3), nearest pixel."""
    rows, columns = ((np.arange(n) + 0.5) * size / n for n, size in zip((h, w), pixels.shape[:2], strict=True))
    return pixels[rows.astype(int)[:, None], columns.astype(int)]


def _draw_no_depth_key(canvas: Canvas, left: float) -> None:
    """Draw the key of pixels without depth at the height of the colour scales."""
    low, side = SCALE_HEIGHT_PT - 19.0, _KEY_SIDE_PT
    corners = ((left, low), (left + side, low), (left + side, low + side), (left, low + side))
    canvas.area(corners, colours.PICTURE, edge=colours.SOFT)
    canvas.text(_NO_DEPTH, left + side + 6, low + 2)
