"""Figures draw what is stored in ``drawn_figures.json``: every artist with its values, colour, width and words.

``DHTORCH_STORE=1 pytest tests/viz/test_drawn_figures.py`` stores them anew, after the images have been looked at.
"""

import base64
import gc
import math
import subprocess
import sys
import weakref
import xml.etree.ElementTree as ET
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib import _pylab_helpers
from matplotlib.figure import Figure
from support import result_files as archived
from support.digests import alike
from support.drawn import describe
from support.stored_values import stored_values

from dhtorch.cli import enrich, scale
from dhtorch.codes import Gate, Hole, Source, State, names
from dhtorch.experiments.report import figures, jobs
from dhtorch.pipeline.presets import METHODS
from dhtorch.viz import plots
from dhtorch.viz.plots import colours, maps
from dhtorch.viz.plots import figures as plot_figures
from dhtorch.viz.viewer import html as pages
from dhtorch.viz.viewer import points, validation

FILE = Path(__file__).with_name("drawn_figures.json")
HW = (24, 32)


def image(channels=3, hw=HW, seed=0):
    """An image of which no two pixels are equal, uint8."""
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (channels, *hw)).astype(np.uint8))


def depth_map(seed=1):
    """Depth (h, w) m that grows to the lower right, with holes of both kinds."""
    slope = np.add.outer(np.linspace(0, 0.4, HW[0]), np.linspace(0, 0.6, HW[1]))
    depth = 0.4 * 15 ** np.clip(slope + np.random.default_rng(seed).normal(0, 0.01, HW), 0, 1)
    depth[:3, :5], depth[-2:, 7] = 0, np.nan
    return depth


def completed_view(label="frame 3", channels=3):
    """A view of which the near part is the sensor's and the upper right corner has no answer."""
    depth = depth_map()
    source = np.where(depth < 2, Source.SENSOR, Source.RECOVERED)
    source[:4, -6:] = Source.NONE
    return plots.CompletedView(label, image(channels), depth, 0.01 * depth**1.5, source)


def curve(n, power):
    coverage = np.linspace(1 / n, 0.8, n)
    return coverage, 0.02 + 0.1 * coverage**power


def cases(folder):
    """Name -> what draws."""
    view, draw = completed_view(), np.random.default_rng(4)
    uv, gate, hole = draw.uniform(0, (31, 23), (60, 2)), *(draw.choice(list(names(kind)), 60) for kind in (Gate, Hole))
    source, true = draw.choice([Source.NONE, Source.SENSOR, Source.RECOVERED], 60), draw.uniform(1, 8, 50)
    depth = true * np.exp(draw.normal(0, 0.1, 50))
    true[3], depth[5], depth[7], depth[8], depth[9] = np.nan, np.nan, 40, 0.1, 0
    state = np.where(np.nan_to_num(view.depth) < 1, State.WRONG, State.CONSISTENT)
    state[10:14] = State.CANNOT_KNOW
    evidence = np.where(state == State.CANNOT_KNOW, np.nan, np.linspace(-8, 8, HW[1])[None])
    curves = {"map": curve(30, 1), "paper": curve(40, 2), "few": curve(5, 2)}
    no, file = np.zeros(0), folder / "a.png"
    swept = [archived.pair(), archived.pair()]
    swept[1] = {**swept[1], "config": {**swept[1]["config"], "seed": 20}}
    named = [{**r, "config": {**r["config"], "seed": s}} for r, s in zip(swept, ("a $x$ b", "c$"), strict=True)]
    episodes = [{"cameras": {"front": {"over_time": np.eye(6)[:3].tolist()}}}] * 2
    reasons = [{"cameras": {"front": {"no_answer_over_time": np.eye(2, 20).tolist()}}}]
    return {
        "samples": lambda: plots.draw_samples(file, image() / 255, uv, source, gate, title="Hall"),
        "holes": lambda: plots.draw_holes(file, image(1, (48, 64)), torch.from_numpy(uv), torch.from_numpy(hole)),
        "depth": lambda: plots.draw_depth(file, true, depth, draw.random(50), title="Hall"),
        "depth without a score": lambda: plots.draw_depth(file, torch.from_numpy(true), depth),
        "no depth": lambda: plots.draw_depth(file, no, no, no),
        "risk": lambda: plots.draw_risk_coverage(file, curves, oracle=curve(30, 3), title="Hall"),
        "no risk": lambda: plots.draw_risk_coverage(file, {}),
        "completed": lambda: plots.draw_completed(file, *view[1:], title="Hall, frame 3"),
        "completed, grey": lambda: plots.draw_completed(file, image(1, (48, 64)), *view[2:], dpi=80),
        "aligned": lambda: plots.draw_aligned(file, image(), depth_map(9)[None], view.depth, view.sigma),
        "contact sheet": lambda: plots.draw_contact_sheet(file, [view, completed_view("frame 9", 1)], title="Hall"),
        "validation": lambda: plots.draw_validation(file, view.image, view.depth, state, evidence, title="Hall"),
        "nothing validated": lambda: plots.draw_validation(
            file, view.image, 0 * view.depth, 0 * state, evidence * np.nan
        ),
        "strip": lambda: plots.Strip("Hall", (300, 1300), plots.fit_common_depth_axis([view])),
        "drift": lambda: validation.draw_drift([("a", [0, 1, 2], [0.5, math.nan, 3.0]), ("b", [0], [1.0])]),
        "scale": lambda: scale._plot("view", [(0.0, 0.01, 0.02), (1.0, -0.03, 0.001), (2.0, math.nan, 0.0)]),
        "enriched, over time": lambda: enrich._build_time_figure(episodes),
        "enriched, reasons": lambda: enrich._build_reason_figure(reasons),
        "sweep of a number": lambda: jobs.sweep_figure(swept),
        "sweep of names": lambda: jobs.sweep_figure(named),
        **{
            f"report of {kind}": lambda kind=kind: figures.result_figures(getattr(archived, kind)())
            for kind in ("range_split", "calibration", "motion", "latency", "hole_census")
        },
    }


@pytest.mark.parametrize("name", cases(Path()))
def test_a_figure_shows_what_is_stored(name, tmp_path, monkeypatch):
    made, begin = [], Figure.__init__
    monkeypatch.setattr(
        Figure, "__init__", lambda self, *args, **options: made.append(self) or begin(self, *args, **options)
    )
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: None)
    cases(tmp_path)[name]()
    lines = [line for figure in made for line in describe(figure)]
    stored = stored_values(FILE, {name: "\n".join(lines)}, list(cases(tmp_path)))[name].split("\n")
    wrong = [f"- {b}\n+ {a}" for a, b in zip(lines, stored, strict=False) if not alike(a, b, 1e-3, 2e-3)]
    assert len(lines) == len(stored) and not wrong, "\n".join(wrong)


def test_values_are_painted_by_their_logarithm_and_a_strip_shows_them_in_their_place():
    scale = maps.Scale("depth, m", colours.DEPTH_CMAP, 1.0, 4.0)
    shown = scale.paint(np.array([[1.0, 2.0, 4.0, 9.0, 2.0]]), np.array([[True, True, True, True, False]]))
    linear = maps.Scale("", colours.DEPTH_CMAP, 0.0, 1.0, log=False)
    assert np.allclose(shown[:, :4], linear.paint(np.array([[0, 0.5, 1, 1]]), np.ones((1, 4), bool)))
    assert np.allclose(255 * shown[0, 4], colours.parse_rgb(colours.PICTURE))
    fitted = maps._fit_depth_scale(np.linspace(1.0, 3.0, 1001))
    assert (fitted.low, fitted.high) == pytest.approx((1.02, 2.98)) and maps._fit_depth_scale(
        np.full(9, 2.0)
    ).high == 2.5
    view = completed_view()
    strip = plots.Strip("Hall", HW, plots.fit_common_depth_axis([view]))
    made = strip.render(view)
    assert made.shape == (*strip.picture_hw, 3) and not made.shape[0] % 2 and not made.shape[1] % 2
    blank = strip.render(view._replace(image=255 - view.image, depth=0 * view.depth))
    for (top, left), pixels in zip(strip._corners, view.paint(strip.axis), strict=True):
        box = made[top : top + HW[0], left : left + HW[1]]
        assert np.abs(box / 255 - pixels).max() < 0.003
        blank[top : top + HW[0], left : left + HW[1]] = box
    assert (blank == made).all(), "nothing else changes"
    pixels = np.arange(12.0).reshape(3, 4, 1)
    assert maps._resample(pixels, 3, 2)[..., 0].tolist() == [[1.0, 3.0], [5.0, 7.0], [9.0, 11.0]], "at pixel centres"


REPO = Path(__file__).resolve().parents[2]


def drawn(name="a scene"):
    """A figure of two axes with a name from a file wherever one can stand."""
    figure, panels = plots.make_figure(2)
    for axes, log in zip(panels, (False, True), strict=True):
        plots.draw_line(axes, [0, 0.5, None, 1], [0.1, 0.2, 0.3, 0.4], plots.Stroke(colours.INK, dashes=(4, 3)))
        plots.set_axis(axes, "x", name, percent=True, limits=(0.0, 1.0))
        plots.set_axis(axes, "y", log=log)
        plots.set_title(axes, name)
    plot_figures.set_rows(panels[0], [name, "b"])
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
    assert len(axes.get_title("left")) == 62 and plot_figures.shorten("x" * 62, 62) == "x" * 62


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
    known = (set(names(Gate)) - {Gate.ANSWER}, set(names(Hole)) - {Hole.NONE}, {*METHODS, "opencv", "auto", "xfeat"})
    for table, codes in zip(tables, known, strict=True):
        assert len({c.upper() for c in table.values()}) == len(table) and codes <= set(table)
    others = {c.upper() for c in (*(c for table in tables for c in table.values()), *colours.SERIES_COLOURS)}
    own = [colours.SENSOR, colours.RECOVERED, colours.SWEPT, colours.ALIGNED, colours.FILLED]
    assert not {*own} & others and set(colours.SOURCE_COLOURS) == set(names(Source))
    assert colours.colour_by_source(np.array([1, 2, 3])).tolist() == [list(colours.parse_rgb(c)) for c in own[:3]]


def test_a_method_has_the_same_colour_in_any_company():
    alone, among = (plots.assign_strokes(each) for each in (["map"], ["mine", "map", "paper", *map(str, range(30))]))
    assert alone["map"] == among["map"] and list(among)[:3] == ["mine", "map", "paper"]
    assert len({among[str(k)] for k in range(23)}) == 23, "what has used up the colours is dashed"


def test_the_viewer_draws_in_these_colours():
    for name in pages._CMAP_OF_QUANTITY.values():
        stops = np.array([colours.parse_rgb(c) for c in colours.sample_cmap(name)]) / 255
        exact = mpl.colormaps[name](np.linspace(0, 1, 2 * len(stops) - 1))[:, :3]
        assert np.abs(stops - exact[::2]).max() < 0.003
        assert np.abs((stops[1:] + stops[:-1]) / 2 - exact[1::2]).max() < 0.06, "straight lines between them do"


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
