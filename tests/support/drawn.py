"""What a matplotlib figure shows, as lines of text: limits, ticks, words, and every artist with its values and colours.

Without layout: places that depend on the size of letters are left out.
"""

import numpy as np
from matplotlib.colors import to_hex

from support.digests import summary


def describe(figure):
    """Lines of text of a figure."""
    lines = [f"figure {_numbers(figure.get_size_inches())} dpi {figure.dpi:g}"]
    lines += [f"  text {t.get_text()!r} {_numbers(t.get_position())} {t.get_fontsize():g}" for t in figure.texts]
    for axes in figure.axes:
        place = "" if figure.get_layout_engine() else _numbers(axes.get_position().bounds)
        titles = [axes.get_title(at) for at in ("left", "center")]
        lines.append(f"axes {place} {titles} {axes.get_xlabel()!r} {axes.get_ylabel()!r} {axes.axison}")
        for axis in (axes.xaxis, axes.yaxis):
            labels = axis.get_major_formatter().format_ticks(axis.get_majorticklocs()) if axes.axison else []
            lines.append(f"  {axis.get_scale()} {_numbers(axis.get_view_interval())} {' | '.join(labels)}")
        lines += [line for artist in axes.get_children() for line in _artist(artist)]
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    for legend in legends:
        lines += [
            f"  key {text.get_text()!r} {' '.join(_artist(handle))}"
            for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)
        ]
    return lines


def _artist(artist):
    kind = type(artist).__name__
    if kind == "Line2D":
        style = f"{artist.get_linestyle()} {artist.get_linewidth():g} {artist.get_marker()} {artist.get_markersize():g}"
        colours = to_hex(artist.get_color()), to_hex(artist.get_markerfacecolor()), artist.get_alpha()
        marked = sum(artist.get_markevery() or ())
        yield f"  line {_numbers(summary(artist.get_xydata())[1:])} {style} {colours} {artist.get_label()!r} {marked}"
    elif hasattr(artist, "get_offsets"):
        sizes = np.atleast_1d(artist.get_sizes()) if hasattr(artist, "get_sizes") else []
        face = [to_hex(c, keep_alpha=True) for c in artist.get_facecolor()[:2]]
        places = [*(xy for path in artist.get_paths() for xy in path.vertices), *artist.get_offsets()]
        values = [] if artist.get_array() is None else summary(artist.get_array())[1:]
        widths = artist.get_linewidth()
        yield f"  points {_numbers(summary(np.array(places))[1:])} {_numbers(sizes)} {face} {_numbers(values)} {widths}"
    elif hasattr(artist, "get_extent"):
        limits = artist.norm.vmin, artist.norm.vmax
        array = np.asarray(artist.get_array(), np.float64)
        yield f"  image {artist.get_extent()} {artist.get_cmap().name} {limits} {array.shape} {_numbers(summary(array)[1:])}"
    elif kind == "Rectangle":
        yield f"  bar {_numbers(artist.get_bbox().bounds)} {to_hex(artist.get_facecolor())} {artist.get_linewidth():g}"
    elif kind in ("Text", "Annotation") and artist.get_text():
        yield f"  text {artist.get_text()!r} {_numbers(artist.get_position())} {artist.get_fontsize():g}"


def _numbers(values):
    return " ".join(f"{float(v):.4g}" for v in np.ravel(values))
