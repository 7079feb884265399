"""Figures of a view's maps as images with colour scales: completed, aligned, validated; frames of a recording.

Arrays may be torch tensors or numpy arrays, on any device, of one view (no batch dimension).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from dhtorch.codes import Source, State, count_kinds, names
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.colours import INK
from dhtorch.viz.plots.figures import add_legend, mark_options, save_figure, set_axis, set_title, shorten

#: Gap between two images, height of the title of an image and above all of them, of a colour scale below; points.
_GAP, _TITLE, _HEADER, _SCALE = 10.0, 20.0, 22.0, 52.0
_NO_DEPTH = "no sensor return, or no answer"
_COLUMNS = ("Image", "Sensor", "Completed", "Sigma / depth")


class Scale(NamedTuple):
    """Colours of a quantity between two ends."""

    label: str
    cmap: str
    low: float
    high: float
    log: bool = True
    percent: bool = False

    def norm(self) -> Any:
        """matplotlib's norm."""
        from matplotlib.colors import LogNorm, Normalize  # noqa: PLC0415

        return (LogNorm if self.log else Normalize)(self.low, self.high, clip=True)

    def paint(self, values: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Values (h, w) -> colours (h, w, 3) in [0, 1]; background colour where ``there`` is False."""
        from matplotlib import colormaps  # noqa: PLC0415

        painted = colormaps[self.cmap](self.norm()(np.where(there, values, self.low)))[..., :3]
        return np.where(there[..., None], painted, np.array(colours.parse_rgb(colours.PICTURE)) / 255)


#: Scale of sigma / depth, the same in every figure.
SIGMA_SCALE = Scale("sigma / depth, %", colours.ERROR_CMAP, 0.005, 0.2, percent=True)


def _fit_depth_scale(depth: np.ndarray) -> Scale:
    """Depths -> log scale: the nearest and farthest 1 % have the colours of its ends, near blue, far red."""
    low, high = np.quantile(depth, (0.01, 0.99)).tolist() if depth.size else (0.5, 5.0)
    return Scale("depth, m", colours.DEPTH_CMAP, low, max(high, 1.25 * low))


def make_image_grid(
    title: str,
    rows: Sequence[Sequence[tuple[str, np.ndarray]]],  # title of the image → (H, W) grey or (H, W, 3) in [0, 1]
    scales: Sequence[tuple[Scale, int, int]] = (),  # below the columns from a first to a last one
    *,
    width: float = 340.0,  # of an image, points
    dpi: float = 160.0,
) -> tuple[Any, list[list[Any]]]:
    """Figure of images of one width, with their titles, and colour scales below → figure, axes of the images."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    heights = [width * row[0][1].shape[0] / row[0][1].shape[1] for row in rows]
    base, whole = _SCALE * bool(scales), len(rows[0]) * (width + _GAP) - _GAP
    top = base + sum(heights) + len(rows) * _TITLE
    figure = Figure((whole / 72, (top + _HEADER * bool(title)) / 72), dpi=dpi)
    figure.text(0, 1, shorten(title, int(whole / 7)), va="top", fontsize=11, fontweight="bold", color=INK)
    size = np.array((whole, 72 * figure.get_figheight(), whole, 72 * figure.get_figheight()))
    made: list[list[Any]] = []
    bottom = top
    for row, height in zip(rows, heights, strict=True):
        bottom -= height + _TITLE
        made.append([figure.add_axes((k * (width + _GAP), bottom, width, height) / size) for k in range(len(row))])
        for axes, (name, pixels) in zip(made[-1], row, strict=True):
            axes.imshow(pixels, cmap=colours.GREY_CMAP, vmin=0, vmax=1, aspect="auto")
            axes.axis("off")
            set_title(axes, name, width)
    for scale, first, last in scales:
        box = (first * (width + _GAP) + 6, base - 18, (last - first) * (width + _GAP) + width - 12, 9)
        bar = figure.add_axes(tuple(box / size))
        colours_of = ScalarMappable(scale.norm(), scale.cmap)
        figure.colorbar(colours_of, cax=bar, orientation="horizontal").outline.set_visible(False)
        set_axis(bar, "x", scale.label, log=scale.log and scale.high > 8 * scale.low, percent=scale.percent)
        bar.tick_params(labelsize=9, colors=INK, length=3)
    return figure, made


def draw_completed(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN without an answer
    sigma: Any,  # (h, w) m
    source: Any,  # (h, w) codes.Source
    *,
    title: str = "",
    dpi: float = 160.0,
    kind: str = "png",
) -> None:
    """Draw image, sensor depth, completed depth on the same scale, and its sigma / depth.

    ``kind`` is the format where ``path`` is an open file. Pixels without an answer are blank.
    """
    z, code = as_array(depth), as_array(source)
    answered = np.isfinite(z) & (z > 0) & (code != Source.NONE)
    sensed, scale = answered & (code == Source.SENSOR), _fit_depth_scale(z[answered])
    maps = [
        (f"Sensor: {100 * sensed.mean():.0f} % of the pixels", scale.paint(z, sensed)),
        (f"Completed: {_format_kinds(code, answered)}", scale.paint(z, answered)),
        (_COLUMNS[3], _paint_sigma(z, sigma, answered)),
    ]
    save_figure(_make_four(title, image, maps, (scale, SIGMA_SCALE), dpi), path, kind)


def draw_aligned(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    input_map: Any,  # (1, h, w) or (h, w), any unit, 0 or NaN without a value
    depth: Any,  # (h, w) m, 0 or NaN without an answer
    sigma: Any,  # (h, w) m
    *,
    title: str = "",
) -> None:
    """Draw image, input map, aligned map, and its sigma / depth; both maps on log scales over their own ranges."""
    x, z = (as_array(q).reshape(as_array(q).shape[-2:]) for q in (input_map, depth))
    known, answered = (np.isfinite(q) & (q > 0) for q in (x, z))
    scale = _fit_depth_scale(z[answered])
    maps = [
        (f"Input map: {100 * known.mean():.0f} %, own range", _fit_depth_scale(x[known]).paint(x, known)),
        (f"Aligned: {100 * answered.mean():.0f} %, the rest no answer", scale.paint(z, answered)),
        (_COLUMNS[3], _paint_sigma(z, sigma, answered)),
    ]
    save_figure(_make_four(title, image, maps, (scale, SIGMA_SCALE)), path)


def draw_validation(
    path: str | Path | IO[bytes],
    image: Any,  # (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN without depth
    state: Any,  # (h, w) codes.State
    evidence: Any,  # (h, w) sigmas, positive where the map is too far; NaN without evidence
    *,
    title: str = "",
) -> None:
    """Draw image, states, log depth and evidence.

    Evidence is red where the map is too far and blue where it is too near; blank without evidence.
    """
    z, code, sigmas = (as_array(x) for x in (depth, state, evidence))
    there = np.isfinite(z) & (z > 0)
    wrong, consistent = (int(((code == k) & there).sum()) for k in (State.WRONG, State.CONSISTENT))
    checked, n = wrong + consistent, int(there.sum())
    fraction = f", of which {100 * wrong / checked:.1f} % are wrong" if checked else ""
    scale, evidence_scale = (
        _fit_depth_scale(z[there]),
        Scale("evidence, sigmas", colours.SIGNED_CMAP, -6.0, 6.0, log=False),
    )
    maps = [
        (
            f"Checked: {100 * checked / n:.0f} % of the depth{fraction}" if n else "No depth",
            colours.colour_by_code(colours.STATE_COLOURS, code.astype(np.int64)) / 255,
        ),
        ("Depth", scale.paint(z, there)),
        ("Evidence: red too far, blue too near", evidence_scale.paint(sigmas, ~np.isnan(sigmas))),
    ]
    save_figure(_make_four(title, image, maps, (scale, evidence_scale)), path)


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

    def paint(self, scale: Scale) -> list[np.ndarray]:
        """Image, sensor depth and completed depth as colours."""
        z = as_array(self.depth)
        return [to_unit_rgb(self.image), *(scale.paint(z, mask) for mask in self.masks)]


def fit_common_depth_axis(views: Sequence[CompletedView]) -> Scale:
    """Views -> log scale of all their depths."""
    return _fit_depth_scale(np.concatenate([as_array(view.depth)[view.masks[1]] for view in views]))


def draw_contact_sheet(path: str | Path | IO[bytes], views: Sequence[CompletedView], *, title: str = "") -> None:
    """Draw a row per view: image, sensor depth, completed depth on the same scale for all rows, sigma / depth."""
    scale, rows = fit_common_depth_axis(views), []
    for view in views:
        answered = view.masks[1]
        columns = (f"{view.label}: {_format_kinds(view.source, answered)}", *_COLUMNS[1:])
        images = [*view.paint(scale), _paint_sigma(as_array(view.depth), view.sigma, answered)]
        rows.append(list(zip(columns, images, strict=True)))
    figure, _ = make_image_grid(title, rows, ((scale, 1, 2), (SIGMA_SCALE, 3, 3)), width=252.0, dpi=116.0)
    _add_no_depth_key(figure)
    save_figure(figure, path)


class Strip:
    """Images of one size with image, sensor depth and completed depth side by side, title and key.

    Args:
        title: above the images.
        hw: size of the maps; views of another size are resampled to it.
        axis: scale of depth, common to all images.
    """

    def __init__(self, title: str, hw: tuple[int, int], axis: Scale) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

        self.axis, dpi = axis, 144.0  # two pixels per point: even sides, which video encoders require
        scale = min(1.0, 640 / hw[1])
        self.hw = tuple(2 * max(1, round(scale * size / 2)) for size in hw)  # even, px
        blank = [(name, np.ones((*self.hw, 3))) for name in _COLUMNS[:3]]
        figure, (images,) = make_image_grid(title, [blank], ((axis, 1, 2),), width=72 * self.hw[1] / dpi, dpi=dpi)
        _add_no_depth_key(figure)
        agg = FigureCanvasAgg(figure)
        agg.draw()
        pixels = np.asarray(agg.buffer_rgba())[..., :3]
        self._corners = [(round(pixels.shape[0] - box.y1), round(box.x0)) for box in (a.bbox for a in images)]
        margin = [(0, 12 + pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)]
        self._background = np.pad(pixels, margin, constant_values=255)
        self.picture_hw = self._background.shape[0], self._background.shape[1]  # even, px

    def render(self, view: CompletedView) -> np.ndarray:
        """View -> image (H, W, 3) uint8."""
        picture, (h, w) = self._background.copy(), self.hw
        for (top, left), pixels in zip(self._corners, view.paint(self.axis), strict=True):
            colour = np.broadcast_to(np.atleast_3d(pixels), (*pixels.shape[:2], 3))
            picture[top : top + h, left : left + w] = (255 * _resample(colour, h, w)).round().astype(np.uint8)
        return picture


def _make_four(
    title: str,
    image: Any,
    maps: Sequence[tuple[str, np.ndarray]],
    scales: tuple[Scale, Scale],  # of the two columns
    dpi: float = 160.0,
) -> Any:
    """Figure of an image and three maps, two by two."""
    rows = [[("Image", _resample(to_unit_rgb(image), *maps[0][1].shape[:2])), maps[0]], maps[1:]]
    return make_image_grid(title, rows, ((scales[0], 0, 0), (scales[1], 1, 1)), dpi=dpi)[0]


def _paint_sigma(depth: np.ndarray, sigma: Any, answered: np.ndarray) -> np.ndarray:
    """sigma / depth as colours."""
    return SIGMA_SCALE.paint(as_array(sigma) / np.where(answered, depth, 1), answered)


def _resample(pixels: np.ndarray, h: int, w: int) -> np.ndarray:
    """Image (H, W, …) -> (h, w, …), nearest pixel."""
    rows, columns = ((np.arange(n) + 0.5) * size / n for n, size in zip((h, w), pixels.shape[:2], strict=True))
    return pixels[rows.astype(int)[:, None], columns.astype(int)]


def _add_no_depth_key(figure: Any) -> None:
    """Key of pixels without depth, below the first image."""
    square = mark_options(colours.PICTURE, "s") | {"markersize": 9, "markeredgecolor": colours.SOFT}
    add_legend(figure, {_NO_DEPTH: square}, loc="lower left", bbox_to_anchor=(0.0, 0.0))


def _format_kinds(source: Any, answered: np.ndarray) -> str:
    """Fractions of the pixels by kind as text, recovered first; ``answered`` (h, w): those with a depth."""
    code = np.where(answered, as_array(source), Source.NONE).astype(np.int64)
    counts = count_kinds(np.bincount(code.ravel(), minlength=len(names(Source))))
    return ", ".join(f"{kind} {100 * n / code.size:.0f} %" for kind, n in counts.items() if kind != "no_answer")


def to_unit_rgb(image: Any) -> np.ndarray:
    """Image (C, H, W) -> (H, W) or (H, W, 3) in [0, 1]."""
    pixels = as_array(image)
    pixels = np.clip(pixels / 255.0 if pixels.dtype == np.uint8 else pixels, 0, 1)
    return pixels[0] if len(pixels) == 1 else pixels.transpose(1, 2, 0)


def as_array(x: Any) -> np.ndarray:
    """Tensor or array -> numpy array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)
