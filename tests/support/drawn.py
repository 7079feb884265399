"""What a matplotlib figure shows, as lines of text: artists with their places in points, colours, widths and letters.

Without layout: places that depend on the size of letters (legends, ticks that matplotlib places) are left out.
"""

import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from support.digests import alike

#: Difference of two numbers of a line that counts as none: absolute (points, grey values), and relative.
TOLERANCE, TOLERANCE_REL = 0.006, 1e-3


def figures_of(call, monkeypatch):
    """The figures that a call makes."""
    made, begin = [], Figure.__init__

    def keep(self, *args, **options):
        begin(self, *args, **options)
        made.append(self)

    with monkeypatch.context() as patch:
        patch.setattr(Figure, "__init__", keep)
        call()
    return made


def describe(figure):
    """Lines of text of a figure."""
    lines = [f"figure {_numbers(figure.get_size_inches())} dpi {figure.dpi:g}"]
    lines += [line for artist in [*figure.artists, *figure.texts] for line in _artist(artist, figure.dpi)]
    for legend in figure.legends:
        lines += _legend(legend)
    for axes in figure.axes:
        lines += _axes(axes, figure.dpi)
    return lines + [line for part in figure.subfigs for text in part.texts for line in _artist(text, figure.dpi)]


def differences(found, stored):
    """Lines that differ by more than the tolerance, as a text; empty where none does."""
    wrong = [f"- {b}\n+ {a}" for a, b in zip(found, stored, strict=False) if not alike(a, b, TOLERANCE, TOLERANCE_REL)]
    if len(found) != len(stored):
        wrong.append(f"{len(found)} lines, stored are {len(stored)}")
    return "\n".join(wrong)


def summarise(values):
    """Shape and weighted means of an array of any size: two that differ anywhere differ here."""
    array = np.ma.filled(np.ma.asarray(values, np.float64), -1.0)
    rows = np.linspace(0, 1, array.shape[0]).reshape(-1, *[1] * (array.ndim - 1))
    columns = np.linspace(0, 1, array.shape[1]).reshape(1, -1, *[1] * (array.ndim - 2))
    unit = 255 / max(1.0, np.abs(array).max())
    means = [unit * (array * w).mean((0, 1)) for w in (np.ones_like(rows), rows, columns)]
    return f"{'x'.join(map(str, array.shape))} {_numbers(np.concatenate([np.atleast_1d(m) for m in means]))}"


def _numbers(values):
    return " ".join(f"{v + 0.0:.3f}" for v in np.asarray(values, np.float64).ravel())


def _colour(colour):
    return "none" if colour is None else to_hex(colour, keep_alpha=True)


def _axes(axes, dpi):
    yield f"axes {_numbers(axes.get_position().bounds)} x {_numbers(axes.get_xlim())} y {_numbers(axes.get_ylim())}"
    yield f"  {axes.get_xlabel()!r} {axes.get_ylabel()!r} {axes.get_title()!r} {axes.axison} {axes.get_aspect()}"
    for image in axes.images:
        limits = image.norm.vmin, image.norm.vmax
        yield f"  image {_numbers(image.get_extent())} {image.get_cmap().name} {limits} {summarise(image.get_array())}"
    for artist in [*axes.lines, *axes.patches, *axes.texts]:
        yield from _artist(artist, dpi)
    for group in axes.collections:
        sizes = np.atleast_1d(group.get_sizes()) if hasattr(group, "get_sizes") else []
        yield f"  {type(group).__name__} {_numbers(group.get_offsets())} sizes {_numbers(sizes)}"
        values = group.get_array()
        faces = " ".join(map(_colour, group.get_facecolor()[:2]))
        yield f"  {faces} {'' if values is None else _numbers(values)}"
    if axes.get_legend() is not None:
        yield from _legend(axes.get_legend())


def _legend(legend):
    for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True):
        style = f"{handle.get_linestyle()} {handle.get_linewidth():g} {handle.get_marker()} {handle.get_markersize():g}"
        colours = [_colour(handle.get_color()), handle.get_markerfacecolor(), handle.get_markeredgecolor()]
        yield f"  key {text.get_text()!r} {text.get_fontsize():g} {style} {colours}"


def _artist(artist, dpi):
    name = type(artist).__name__
    if hasattr(artist, "get_text"):
        at = artist.xyann if hasattr(artist, "xyann") else ()
        where = _places(artist, [artist.get_unitless_position()], dpi) if not len(at) else f"{artist.xy} {at}"
        style = f"{artist.get_fontsize():g} {artist.get_fontweight()} {artist.get_rotation():g} {artist.get_ha()}"
        yield f"  {name} {where} {artist.get_text()!r} {style} {_colour(artist.get_color())} {artist.get_gid()}"
    elif hasattr(artist, "get_marker"):
        style = f"{artist.get_linewidth():g} {artist.get_marker()} {artist.get_markersize():g}"
        yield f"  {name} {_numbers(artist.get_xydata())} {style} {_colour(artist.get_color())} {artist.get_label()}"
    else:
        edge, face = _colour(artist.get_edgecolor()), _colour(artist.get_facecolor())
        style = f"{artist.get_linewidth():g} {artist.get_linestyle()} {artist.get_capstyle()} {edge} {face}"
        path = artist.get_path()
        places = artist.get_patch_transform().transform(path.vertices)
        if artist.axes is None:
            places = path.vertices
        codes = "" if path.codes is None else summarise(path.codes[None])
        shown = _places(artist, places, dpi) if artist.axes is None else _numbers(places)
        yield f"  {name} {shown} {codes} {style} {artist.get_gid()}"


def _places(artist, places, dpi):
    """Points (1/72 inch) from the lower left corner; of more than sixteen their weighted means."""
    at = artist.get_transform().transform(np.asarray(places, np.float64)) * 72 / dpi
    return _numbers(at) if len(at) <= 16 else f"{len(at)}: {_numbers(at.mean(0))} {_numbers(at[::3].mean(0))}"
