"""Figures leave nothing behind and take any name; colours of the project keep apart; a PLY file as an exhibit."""

import base64
import gc
import json
import re
import subprocess
import sys
import weakref
import xml.etree.ElementTree as ET
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import _pylab_helpers

from dhtorch.codes import Gate, Hole, Source, names
from dhtorch.pipeline.presets import METHODS
from dhtorch.viz import plots
from dhtorch.viz.plots import colours, figures, notebook
from dhtorch.viz.viewer import html as pages
from dhtorch.viz.viewer import points

REPO = Path(__file__).resolve().parents[2]


def drawn(name="a scene"):
    """A figure of two axes with a name from a file wherever one can stand."""
    figure, panels = plots.make_figure(2)
    for axes, log in zip(panels, (False, True), strict=True):
        plots.draw_line(axes, [0, 0.5, None, 1], [0.1, 0.2, 0.3, 0.4], plots.Stroke(colours.INK, dashes=(4, 3)))
        plots.set_axis(axes, "x", name, percent=True, limits=(0.0, 1.0))
        plots.set_axis(axes, "y", log=log)
        plots.set_title(axes, name)
    figures.set_rows(panels[0], [name, "b"])
    plots.add_legend(figure, {name: plots.Stroke(colours.INK).options()})
    return figure


@pytest.mark.parametrize("name", ["$x_1$ and $y$", "<b>&amp;", "\x00\ud800 \n é", "部屋", "", "long " * 40])
def test_any_name_can_stand_in_a_figure_and_an_svg_is_the_same_every_time(name):
    made = plots.encode_uri(drawn(name))
    assert made == plots.encode_uri(drawn(name))
    tree = ET.fromstring(base64.b64decode(made.removeprefix("data:image/svg+xml;base64,")))
    texts = " ".join("".join(e.itertext()) for e in tree.iter() if e.tag.endswith("text"))
    shown = " ".join(name.encode("utf-8", "replace").decode().replace("\x00", "\ufffd").split())
    assert shown[:10] in texts and shown in texts + shown * (len(shown) > 50), "whole, or cut"


def test_figures_leave_nothing_behind(tmp_path):
    before, figure = dict(mpl.rcParams), drawn()
    plots.save_figure(figure, tmp_path / "a.png")
    gone = weakref.ref(figure)
    del figure
    gc.collect()
    assert gone() is None and dict(mpl.rcParams) == before and not _pylab_helpers.Gcf.figs
    text = "import sys, dhtorch.viz.plots, dhtorch.experiments.report.page, dhtorch.viz.viewer.html\n"
    text += "print([m for m in ('matplotlib', 'rich', 'PIL') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]", "importing costs no drawing library"


def test_a_long_title_is_set_smaller_then_cut_in_its_middle():
    _, (axes,) = plots.make_figure()
    sizes = []
    for n in (10, 35, 400):
        plots.set_title(axes, f"{'x' * n}, cutoff 3 m")
        sizes.append(axes._left_title.get_fontsize())
    assert sizes == sorted(sizes, reverse=True) and sizes[0] == 11 > sizes[1] > sizes[2] == 8
    assert "…" in axes.get_title("left") and axes.get_title("left").endswith("x, cutoff 3 m")
    assert len(axes.get_title("left")) == 62 and figures.shorten("x" * 62, 62) == "x" * 62


@pytest.mark.parametrize(
    ("limits", "log", "percent", "expected"),
    [
        ((0.0, 1.0), False, True, ["0", "20", "40", "60", "80", "100"]),
        ((2.0, 12.0), False, False, ["2", "4", "6", "8", "10", "12"]),
        ((0.01, 1.0), True, True, ["1", "2", "5", "10", "20", "50", "100"]),
        ((1.2, 1.9), True, False, ["1.2", "1.3", "1.4", "1.5", "1.6", "1.7", "1.8", "1.9"]),
    ],
)
def test_ticks_are_round(limits, log, percent, expected):
    _, (axes,) = plots.make_figure()
    plots.set_axis(axes, "x", log=log, percent=percent, limits=limits)
    ticks = [t for t in axes.xaxis.get_majorticklocs() if limits[0] * 0.999 <= t <= limits[1] * 1.001]
    assert axes.xaxis.get_major_formatter().format_ticks(ticks) == expected


# ---------------------------------------------------------------------------------------------------- colours


def test_every_code_and_every_method_has_a_colour_of_its_own_and_those_of_depth_are_nobody_else_s():
    tables = (colours.GATE_COLOURS, colours.HOLE_COLOURS, colours.METHOD_COLOURS)
    for table in tables:
        assert len({c.upper() for c in table.values()}) == len(table)
    assert set(colours.GATE_COLOURS) == set(names(Gate)) - {Gate.ANSWER}
    assert set(colours.HOLE_COLOURS) == set(names(Hole)) - {Hole.NONE}
    assert set(colours.METHOD_COLOURS) >= {*METHODS, "opencv", "auto", "xfeat"}
    others = [*(c for table in tables for c in table.values()), *colours.SERIES_COLOURS]
    others += [c for pair in colours.PAGE_COLOURS.values() for c in pair] + [colours.PALE, colours.HIDDEN_RETURN]
    own = {colours.SENSOR, colours.RECOVERED, colours.SWEPT, colours.ALIGNED, colours.FILLED}
    assert not own & {c.upper() for c in others} and set(colours.SOURCE_COLOURS) == set(names(Source))
    assert not {c.upper() for c in colours.METHOD_COLOURS.values()} & {c.upper() for c in colours.SERIES_COLOURS}
    of_source = [colours.SENSOR, colours.RECOVERED, colours.SWEPT]
    assert colours.colour_by_source(np.array([1, 2, 3])).tolist() == [list(colours.parse_rgb(c)) for c in of_source]


def test_a_method_has_the_same_colour_in_any_company():
    alone, among = (plots.assign_strokes(each) for each in (["map"], ["mine", "map", "paper", *map(str, range(30))]))
    assert alone["map"] == among["map"] and list(among)[:3] == ["mine", "map", "paper"]
    assert len({among[str(k)] for k in range(23)}) == 23, "what has used up the colours is dashed"


def test_what_is_drawn_on_a_page_is_seen_by_day_and_in_the_dark():
    """The contrast that WCAG 2 asks of graphics is 3:1; the two lightest series and orange fall a little short by day,
    and of the gates the lightest by day and the darkest in the dark."""

    def luminance(colour):
        parts = [c / 255 for c in colours.parse_rgb(colour)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    series = dict.fromkeys([*colours.METHOD_COLOURS.values(), *colours.SERIES_COLOURS, colours.SENSOR], 2.7)
    for k in (0, 1):
        ground = luminance(colours.PAGE_COLOURS["ground"][k])
        for colour, least in (series | dict.fromkeys(colours.GATE_COLOURS.values(), 2.2)).items():
            shown = colours.PAGE_COLOURS["ink"][k] if colour == colours.INK else colour
            low, high = sorted((ground, luminance(shown)))
            assert (high + 0.05) / (low + 0.05) > least, colour


def test_the_viewer_draws_in_these_colours():
    script = "".join((REPO / "dhtorch/viz/viewer" / name).read_text() for name in pages._SCRIPTS)
    assert {name.upper() for name in re.findall(r"DATA\.colours\.(\w+)", script)} <= set(pages._COLOUR_NAMES)
    scales = set(re.findall(r'new Scale\([^;]*?, "(\w+)", \{', script))
    assert scales == set(pages._CMAP_OF_QUANTITY) and pages._CMAP_OF_QUANTITY["depth"] == colours.DEPTH_CMAP
    for name in pages._CMAP_OF_QUANTITY.values():
        stops = np.array([colours.parse_rgb(c) for c in colours.sample_cmap(name)]) / 255
        exact = mpl.colormaps[name](np.linspace(0, 1, 2 * len(stops) - 1))[:, :3]
        assert np.abs(stops - exact[::2]).max() < 0.003
        assert np.abs((stops[1:] + stops[:-1]) / 2 - exact[1::2]).max() < 0.06, "straight lines between them do"


def test_figures_of_all_notebooks_have_the_same_sizes():
    assert mpl.RcParams(notebook.NOTEBOOK_RC_PARAMS)["figure.dpi"] >= 150
    for file in (REPO / "notebooks").glob("*.ipynb"):
        code = "".join("".join(c["source"]) for c in json.loads(file.read_text())["cells"] if c["cell_type"] == "code")
        widths = re.findall(r"figsize=\(([^,]*),", code)
        assert all("notebook.FIGURE_WIDTH_IN" in width for width in widths), f"{file.name}: {widths}"


def test_a_ply_file_is_shown_with_its_colours_and_up(tmp_path):
    head = "ply\nformat ascii 1.0\ncomment up 0 0 1\nelement vertex 3\n"
    head += "".join(f"property float {a}\n" for a in "xyz") + "property uchar red\nproperty uchar green\n"
    path = tmp_path / "a.ply"
    path.write_text(head + "property uchar blue\nend_header\n1 2 3 10 20 30\n4 5 6 40 50 60\nnan 0 0 0 0 0\n")
    (shot,) = points.read_ply_exhibit(path).shots
    assert shot.samples["rgb"].tolist() == [[10, 20, 30], [40, 50, 60]]
    up = shot.samples["xyz"][1] - shot.samples["xyz"][0]
    assert np.allclose(np.linalg.norm(up), np.sqrt(27), atol=1e-5)
    assert np.allclose(shot.samples["xyz"][:, 1], [-3, -6], atol=1e-5), "up is against the camera's y"
    vertices = points.read_ply_vertices(path)
    assert np.allclose(vertices.xyz[:2], [[1, 2, 3], [4, 5, 6]])
    moved = vertices.vertex.copy()
    moved["x"] += 1
    path.write_bytes(vertices.encode(moved))
    assert np.allclose(points.read_ply_vertices(path).xyz[:2], [[2, 2, 3], [5, 5, 6]])
