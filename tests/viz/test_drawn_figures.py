"""Figures draw what is stored in ``drawn_figures.json``: every artist with its place, colour, width and letters.
``DHTORCH_STORE=1 pytest tests/viz/test_drawn_figures.py`` stores them anew, after the pictures have been looked at.
"""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from support import drawn
from support.stored_values import stored_values

from dhtorch.cli import inspect as capture
from dhtorch.codes import Gate, Hole, Source, State, names
from dhtorch.data.survey import Survey, Tile
from dhtorch.viz import plots
from dhtorch.viz.plots import Axis, LegendKey, Panel, colours, maps, previews, render_inline_svg
from dhtorch.viz.plots.panel import save_panels

FILE = Path(__file__).with_name("drawn_figures.json")
HW = (24, 32)


def picture(channels=3, hw=HW, seed=0):
    """A picture of which no two pixels are equal, uint8."""
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (channels, *hw)).astype(np.uint8))


def depth_map(seed=1, hw=HW, low=0.4, high=6.0):
    """Depth (h, w) m that grows to the lower right, with holes of both kinds."""
    draw = np.random.default_rng(seed)
    slope = np.add.outer(np.linspace(0, 0.4, hw[0]), np.linspace(0, 0.6, hw[1]))
    depth = low * (high / low) ** np.clip(slope + draw.normal(0, 0.01, hw), 0, 1)
    depth[:3, :5], depth[-2:, 7] = 0, np.nan
    return depth


def completed_view(label="frame 3", channels=3):
    """A view of which the near part is the sensor's and the upper right corner has no answer."""
    depth = depth_map()
    source = np.where(depth < 2, Source.SENSOR, Source.RECOVERED)
    source[:4, -6:] = Source.NONE
    return previews.CompletedView(label, picture(channels), depth, 0.01 * depth**1.5, source)


def panels():
    """Panels of every kind of mark, with linear, logarithmic and named axes."""
    first = Panel("a scene", Axis(0, 1, "share, %", percent=True), Axis(0.01, 1, "error, %", log=True))
    strokes = plots.assign_strokes(["paper", "map", "mine", "yours"])
    for k, stroke in enumerate(strokes.values()):
        first.line([0, 0.25, None, 0.5, None, 0.6, 1], [0.1, 0.15, None, 0.2, None, 0.3, 0.1 * (k + 1)], stroke)
        first.dot(0.5, 0.2, stroke, 'says <this>: "x" & more')
    first.diamond(0.7, 0.5, "published: 3")
    first.bar(0.1, 0.2, 0.01, 0.5, colours.HOLE_COLOURS[Hole.TOO_DARK], colours.SOFT)
    first.fill([0, 1, 1], [0.1, 0.1, 0.2], colours.FAINT)
    rows = Panel("", Axis(-2, 30, ""), None, rows=["one", "a name that is much longer than the others are", "three"])
    rows.bar(0, 12, -0.3, 0.3, colours.SENSOR)
    rows.dot(20, 2, strokes["mine"], "twenty")
    wide = Panel("a long title that is set smaller and cut in its middle because it is so long", *first_axes())
    narrow = Panel("four", Axis(0.2, 0.21, "x"), Axis(1, 3000, "y", log=True), size=(120, 90))
    narrow.line([0.2, 0.21], [1, 3000], plots.Stroke(colours.INK, 0.5, (4, 3), 0.4))
    return [first, rows, wide, narrow]


def first_axes():
    return Axis(0, 12, "seconds"), Axis(-3, 3, "metres")


def all_keys():
    """Legend entries of every shape."""
    shapes = ("line", "dot", "box", "cross", "diamond")
    dashed = LegendKey("dashed", colours.INK, stroke=plots.Stroke(colours.INK, 2, (4, 3)))
    return [*(LegendKey(shape, colours.RECOVERED, shape) for shape in shapes), dashed]


def samples():
    """Pixels (N, 2) with a source, a gate and a hole of every code."""
    draw = np.random.default_rng(4)
    n = 60
    codes = [draw.choice(list(names(kind)), n) for kind in (Gate, Hole)]
    source = draw.choice([Source.NONE, Source.SENSOR, Source.RECOVERED], n)
    return draw.uniform(0, (HW[1] - 1, HW[0] - 1), (n, 2)), source, *codes


def answers():
    """True depth, depth and score of answers, some missing, some far off."""
    draw = np.random.default_rng(5)
    true = draw.uniform(1, 8, 50)
    depth = true * np.exp(draw.normal(0, 0.1, 50))
    true[3], depth[5], depth[7], depth[8], depth[9] = np.nan, np.nan, 40, 0.1, 0
    return true, depth, draw.random(50)


def curve(n, seed):
    coverage = np.linspace(1 / n, 0.8, n)
    return coverage, 0.02 + 0.1 * coverage ** (1 + seed)


def survey(**changes):
    """What is found in a capture with pictures, maps and confidence of different shapes."""
    depth = torch.from_numpy(np.nan_to_num(depth_map()))
    sparse = torch.where(torch.rand(HW, generator=torch.Generator().manual_seed(0)) < 0.05, depth, 0.0)
    conf = torch.from_numpy(np.random.default_rng(6).integers(0, 3, HW))
    tiles = [
        Tile("7", picture(), depth, conf),
        Tile("a picture with a long name.png", picture(1, (40, 30)), sparse, None),
        Tile("12", None, depth.T, None),
    ]
    path = torch.tensor([[0.0, 0, 0], [0.5, 0.1, 1], [0.4, 0.05, 2]])
    return Survey("hall/scan 3", "tum", tiles=tiles, depths=depth[depth > 0].flatten(), path=path, **changes)


def strip(hw):
    """The strip's background and one picture."""
    view = completed_view()
    made = previews.Strip("Hall", hw, previews.fit_common_depth_axis([view]))
    return made, made.render(view)


def cases(folder):
    """Name -> what draws."""
    view, (uv, source, gate, hole), (true, depth, score) = completed_view(), samples(), answers()
    full, grey = (view.image, view.depth, view.sigma, view.source), picture(1, (48, 64))
    state = np.where(np.nan_to_num(view.depth) < 1, State.WRONG, State.CONSISTENT)
    state[10:14] = State.CANNOT_KNOW
    evidence = np.where(state == State.CANNOT_KNOW, np.nan, np.linspace(-8, 8, HW[1])[None])
    curves = {"map": curve(30, 0), "paper": curve(40, 1), "few": curve(5, 1)}
    no = np.zeros(0)
    return {
        "panels": lambda: save_panels(folder / "a.png", panels(), all_keys()),
        "one panel": lambda: panels()[0].figure(keys=all_keys()[:2], dpi=90),
        "samples": lambda: plots.draw_samples(folder / "b.png", picture() / 255, uv, source, gate, title="Hall"),
        "holes": lambda: plots.draw_holes(folder / "c.png", grey, torch.from_numpy(uv), torch.from_numpy(hole)),
        "depth": lambda: plots.draw_depth(folder / "d.png", true, depth, score, title="Hall"),
        "depth without a score": lambda: plots.draw_depth(folder / "e.png", torch.from_numpy(true), depth),
        "no depth": lambda: plots.draw_depth(folder / "f.png", no, no, no),
        "risk": lambda: plots.draw_risk_coverage(folder / "g.png", curves, oracle=curve(30, 2), title="Hall"),
        "completed": lambda: plots.draw_completed(folder / "h.png", *full, title="Hall, frame 3"),
        "completed, open file": lambda: plots.draw_completed(io.BytesIO(), grey, *full[1:], dpi=80, kind="jpeg"),
        "aligned": lambda: plots.draw_aligned(folder / "i.png", picture(), depth_map(9)[None], view.depth, view.sigma),
        "contact sheet": lambda: plots.draw_contact_sheet(
            folder / "j.png", [view, completed_view("frame 9", 1)], title="Hall"
        ),
        "validation": lambda: plots.draw_validation(
            folder / "k.png", view.image, view.depth, state, evidence, title="Hall"
        ),
        "nothing validated": lambda: plots.draw_validation(
            folder / "l.png", view.image, 0 * view.depth, 0 * state, np.nan * evidence
        ),
        "strip": lambda: strip(HW),
        "wide strip": lambda: strip((300, 1300)),
        "inspected": lambda: capture.write_contact_sheet(survey(), folder),
    }


def found_figures(monkeypatch, folder):
    """Name -> lines of its figures."""
    found = {}
    for name, call in cases(folder).items():
        figures = drawn.figures_of(call, monkeypatch)
        found[name] = [line for figure in figures for line in drawn.describe(figure)]
    for k, panel in enumerate(panels()):
        found[f"SVG {k}"] = [render_inline_svg(panel)]
    for hw in (HW, (300, 1300)):
        made, pixels = strip(hw)
        found[f"pixels of the strip {hw}"] = [f"{made.picture_hw} {made.hw}", drawn.summarise(pixels)]
    found["colours of depths"] = [
        drawn.summarise(maps.apply_log_cmap(depth_map(), depth_map() > 0, Axis(0.5, 5, "", log=True), kind))
        for kind in (colours.DEPTH_CMAP, colours.ERROR_CMAP)
    ]
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        figures = found_figures(patch, tmp_path_factory.mktemp("drawn"))
    stored_values(FILE, figures, figures)
    return figures


def test_every_figure_is_stored(found):
    assert list(found) == list(stored_values(FILE))


@pytest.mark.parametrize("name", stored_values(FILE))
def test_a_figure_shows_what_is_stored(found, name):
    assert not drawn.differences(found[name], stored_values(FILE)[name])


def test_a_changed_figure_is_noticed():
    lines = ["  Text 1.00 2.00 'a' 10 normal", "image 3x4 0.51"]
    assert not drawn.differences(["  Text 1.004 2.00 'a' 10 normal", lines[1]], lines)
    assert drawn.differences(["  Text 1.010 2.00 'a' 10 normal", lines[1]], lines).count("\n") == 1
    assert drawn.differences(["  Text 1.00 2.00 'b' 10 normal", lines[1]], lines)
    assert drawn.differences(lines[:1], lines) == "1 lines, stored are 2"
    one, other = np.zeros((4, 5)), np.zeros((4, 5))
    other[2, 3] = 1
    assert drawn.summarise(one) != drawn.summarise(other) != drawn.summarise(other[::-1])
