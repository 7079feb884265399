"""The drawing module: small SVG that is the same every time, figures that leave nothing behind, one page of colours."""

import gc
import io
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
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dhtorch.codes import Gate, Hole, Source, State, names
from dhtorch.pipeline.presets import METHODS
from dhtorch.viz import plots as drawing
from dhtorch.viz.plots import (
    Axis,
    LayeredPicture,
    LegendKey,
    Panel,
    PointLayer,
    colours,
    maps,
    notebook,
    previews,
    render_inline_svg,
)
from dhtorch.viz.plots.axis import fit_axis
from dhtorch.viz.viewer import html as pages
from dhtorch.viz.viewer import points

REPO = Path(__file__).resolve().parents[2]


def panel(title="a scene", **options):
    made = Panel(title, Axis(0, 1, "share, %", percent=True), Axis(0.01, 1, "error, %", log=True), **options)
    for k, stroke in enumerate(drawing.assign_strokes(["paper", "map", "mine", "yours"]).values()):
        made.line([0, 0.5, 1], [0.1, 0.2, 0.1 * (k + 1)], stroke)
        made.dot(0.5, 0.2, stroke, 'says <this>: "x" & more')
    made.diamond(0.7, 0.5, "published: 3")
    made.bar(0.1, 0.2, 0.01, 0.5, colours.HOLE_COLOURS[Hole.TOO_DARK], colours.SOFT)
    made.fill([0, 1, 1], [0.1, 0.1, 0.2], colours.FAINT)
    return made


# ---------------------------------------------------------------------------------------------------- SVG


def test_svg_is_small_the_same_every_time_and_has_no_names_to_meet():
    made = render_inline_svg(panel())
    assert made == render_inline_svg(panel()) and len(made) < 5000
    tree = ET.fromstring(made)
    assert tree.get("role") == "img" and tree.get("aria-label") == "a scene"
    for word in ("id=", "href", "url(", "http", "xmlns", "<style", "<metadata", "font-family", "clip", "NaN"):
        assert word not in made, word
    said = [e.text for e in tree.iter("title")]
    assert said.count('says <this>: "x" & more') == 4 and "published: 3" in said
    texts = ["".join(e.itertext()) for e in tree.iter("text")]
    assert {"share, %", "error, %", "a scene", "100", "0.1"} <= set(texts), "text stays text"


def test_svg_takes_the_colours_of_the_page_and_leaves_the_others():
    made = render_inline_svg(panel())
    assert "stroke:var(--ink)" in made and "fill:var(--theirs-ground)" in made and "stroke:var(--faint)" in made
    assert f"stroke:{colours.METHOD_COLOURS['map'].lower()}" in made and colours.INK not in made


@pytest.mark.parametrize(
    "name", ["$x_1$ and $", "<b>&amp;", "\x00\ud800 \n é", "部屋", "", "long " * 40, "#1c2024: a; b"]
)
def test_any_name_can_be_a_title_and_a_row(name):
    for made in (panel(name), Panel("", Axis(0, 1), None, size=(300, 0), rows=[name, "b"])):
        tree = ET.fromstring(render_inline_svg(made))
        said = "".join(tree.itertext())
        first = " ".join(name.encode("utf-8", "replace").decode().replace("\x00", "\ufffd").split())
        assert first in said, "whole, or cut with all of it in the title"
        made.figure().canvas.draw()


def test_what_is_drawn_is_where_its_numbers_say():
    made = Panel("t", Axis(0, 10), Axis(0, 1), size=(146, 136))
    made.dot(5, 0.25, drawing.Stroke(colours.SENSOR), width=6)
    (mark,) = made.marks
    left, bottom, width, height = made.box
    assert mark.places[0] == pytest.approx((146 * (left + width / 2), 136 * (bottom + height / 4)))
    (dot,) = [
        p for p in ET.fromstring(render_inline_svg(made)).iter("path") if colours.SENSOR.lower() in p.get("style")
    ]
    u, v = map(float, re.match(r"M(\S+) (\S+)h0", dot.get("d")).groups())
    assert (u, v) == pytest.approx((mark.places[0][0], 136 - mark.places[0][1]), abs=0.051), "SVG counts down"
    pixels = np.asarray(_pixels(made.figure(dpi=72)))
    y, x = np.argwhere(np.abs(pixels - colours.parse_rgb(colours.SENSOR)).max(-1) < 12).mean(0)
    assert (x + 0.5, y + 0.5) == pytest.approx((u, v), abs=0.75), "a picture file shows it in the same place"


def _pixels(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


def test_a_picture_lies_under_its_points(tmp_path):
    layers = [PointLayer("sensor", np.array([[0.0, 0.0], [3.0, 1.0]]), colours.SENSOR, "sensor")]
    layers.append(PointLayer("unanswered", np.array([[1.0, 1.0]]), colours.UNANSWERED, "unanswered"))
    shown = LayeredPicture("two", (2, 4), layers, np.full((1, 2, 4), 0.5), width=80)
    pixels = _pixels(shown.figure(dpi=72))
    blue = np.argwhere(np.abs(pixels - colours.parse_rgb(colours.SENSOR)).max(-1) < 40)
    assert {tuple(np.round((p - (20, 0) - (9.5, 9.5)) / 20).astype(int)) for p in blue} == {(0, 0), (1, 3)}


def test_figures_leave_nothing_behind(tmp_path):
    before = dict(mpl.rcParams)
    render_inline_svg(panel())
    figure = panel().figure(keys=[LegendKey("a", colours.INK), LegendKey("b", colours.SENSOR, "dot")])
    drawing.save_figure(figure, tmp_path / "a.png")
    gone = weakref.ref(figure)
    del figure
    gc.collect()
    assert gone() is None and dict(mpl.rcParams) == before and not _pylab_helpers.Gcf.figs


# ---------------------------------------------------------------------------------------------------- colours


def test_blue_is_the_sensor_orange_what_was_recovered_purple_what_was_swept_and_nothing_else():
    own = {colours.SENSOR, colours.RECOVERED, colours.SWEPT, colours.ALIGNED, colours.FILLED}
    others = [
        *colours.METHOD_COLOURS.values(),
        *colours.SERIES_COLOURS,
        *colours.GATE_COLOURS.values(),
        *colours.HOLE_COLOURS.values(),
    ]
    others += [c for pair in colours.PAGE_COLOURS.values() for c in pair] + [colours.PALE, colours.HIDDEN_RETURN]
    assert not own & {c.upper() for c in others}
    assert (
        colours.SOURCE_COLOURS[Source.SENSOR] == colours.SENSOR
        and colours.SOURCE_COLOURS[Source.RECOVERED] == colours.RECOVERED
    )
    assert colours.SOURCE_COLOURS[Source.SWEPT] == colours.SWEPT and set(colours.SOURCE_COLOURS) == set(names(Source))
    assert colours.colour_by_source(np.array([1, 2, 3]))[:, 0].tolist() == [0x00, 0xE6, 0xC6]


def test_every_code_and_every_method_has_a_colour_of_its_own():
    assert set(colours.GATE_COLOURS) == set(names(Gate)) - {Gate.ANSWER}
    assert set(colours.HOLE_COLOURS) == set(names(Hole)) - {Hole.NONE}
    assert set(colours.METHOD_COLOURS) >= {*METHODS, "opencv", "auto", "xfeat"}
    for table in (colours.GATE_COLOURS, colours.HOLE_COLOURS, colours.METHOD_COLOURS):
        assert len({c.upper() for c in table.values()}) == len(table)
    assert not {c.upper() for c in colours.METHOD_COLOURS.values()} & {c.upper() for c in colours.SERIES_COLOURS}


def test_a_method_has_the_same_colour_in_any_company():
    alone, among = (
        drawing.assign_strokes(["map"]),
        drawing.assign_strokes(["mine", "map", "paper", *map(str, range(30))]),
    )
    assert alone["map"] == among["map"] and list(among)[:3] == ["mine", "map", "paper"]
    first = [among[str(k)] for k in range(23)]
    assert len(set(first)) == 23, "what has used up the colours is dashed"


def test_what_is_drawn_on_a_page_is_seen_by_day_and_in_the_dark():
    """The contrast that WCAG 2 asks of graphics is 3:1; the two lightest series and orange fall a little short by day,
    and of the twelve gates the lightest by day and the darkest in the dark."""

    def luminance(colour):
        parts = [c / 255 for c in colours.parse_rgb(colour)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    for k in (0, 1):
        ground = luminance(colours.PAGE_COLOURS["ground"][k])
        for colour in (
            *colours.METHOD_COLOURS.values(),
            *colours.SERIES_COLOURS,
            colours.SENSOR,
            *colours.GATE_COLOURS.values(),
        ):
            shown = colours.PAGE_COLOURS["ink"][k] if colour == colours.INK else colour
            low, high = sorted((ground, luminance(shown)))
            assert (high + 0.05) / (low + 0.05) > (2.2 if colour in colours.GATE_COLOURS.values() else 2.7), colour


def test_the_viewer_draws_in_these_colours():
    script = "".join((REPO / "dhtorch/viz/viewer" / name).read_text() for name in pages._SCRIPTS)
    for name in ("sensor", "recovered", "swept", "unanswered", "pale", "hidden_return", "white", "black"):
        assert f"DATA.colours.{name}" in script and name.upper() in pages._COLOUR_NAMES
    assert (
        set(re.findall(r'new Scale\([^;]*?, "(\w+)", \{', script))
        == set(pages._CMAP_OF_QUANTITY)
        == {"depth", "score", "error"}
    )
    assert pages._CMAP_OF_QUANTITY["depth"] == colours.DEPTH_CMAP
    for name in pages._CMAP_OF_QUANTITY.values():
        stops = colours.sample_cmap(name)
        exact = mpl.colormaps[name](np.linspace(0, 1, len(stops)))[:, :3]
        assert np.abs(np.array([colours.parse_rgb(c) for c in stops]) / 255 - exact).max() < 0.003
        middle = mpl.colormaps[name](np.linspace(0, 1, 2 * len(stops) - 1))[1::2, :3]
        between = np.array([colours.parse_rgb(c) for c in stops]) / 255
        assert np.abs((between[1:] + between[:-1]) / 2 - middle).max() < 0.06, "straight lines between them do"


#: A colour in letters or numbers, or a colour map, as code would name it.
LITERAL = re.compile(
    r"""#[0-9a-fA-F]{6}\b|#[0-9a-fA-F]{3}\b(?=["';,)])|\brgba?\(\s*\d|"""
    r"""["'](?:turbo|viridis|plasma|magma|inferno|jet|coolwarm|tab10|Spectral|RdBu|RdYlBu)(?:_r)?["']|\bcmap=["']|"""
    r"""\bcolou?rs?=["'](?!none)\w+["']|["']C\d["']|\[\s*0\.\d+,\s*0\.\d+,\s*0\.\d+\s*\]\.map"""
)
HOME = REPO / "dhtorch/viz/plots/colours.py"


def code():
    """(file, its code): the package, scripts and notebooks."""
    for folder in ("dhtorch", "benchmarks", "docs"):
        for file in sorted((REPO / folder).rglob("*")):
            if file.suffix in (".py", ".js", ".css", ".html") and file != HOME:
                yield file, file.read_text(encoding="utf-8")
    for file in sorted((REPO / "notebooks").glob("*.ipynb")):
        cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
        yield file, "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")


def test_no_colour_is_written_down_anywhere_else():
    found = [f"{file.relative_to(REPO)}: {m[0]}" for file, text in code() for m in LITERAL.finditer(text)]
    assert not found, found
    assert len(LITERAL.findall(HOME.read_text())) > 40, "and this would find them"


def test_importing_costs_no_drawing_library():
    text = "import sys, dhtorch.viz.plots, dhtorch.experiments.report.page, dhtorch.viz.viewer.html\n"
    text += "print([m for m in ('matplotlib', 'rich', 'PIL') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_the_page_of_colours_shows_them_all():
    shown = (REPO / "docs/colours.md").read_text(encoding="utf-8")
    tables = (
        colours.SOURCE_COLOURS,
        colours.METHOD_COLOURS,
        colours.GATE_COLOURS,
        colours.HOLE_COLOURS,
        dict(colours.PAGE_COLOURS),
    )
    wanted = [c for table in tables for value in table.values() for c in ([value] if isinstance(value, str) else value)]
    assert all(f"`{c.lower()}`" in shown for c in [*wanted, *colours.SERIES_COLOURS])
    for name in (colours.DEPTH_CMAP, colours.SCORE_CMAP, colours.ERROR_CMAP, colours.SIGNED_CMAP):
        assert f"`{name}`" in shown and colours.sample_cmap(name, 33)[7] in shown


def test_a_long_title_is_set_smaller_then_cut_in_its_middle():
    canvas = drawing.Canvas(300, 100, 72)
    for n in (10, 40, 400):
        canvas.title(f"{'x' * n}, cutoff 3 m", 300, 100)
    short, smaller, cut = canvas.figure.artists
    assert short.get_fontsize() > smaller.get_fontsize() >= cut.get_fontsize() >= 8
    assert smaller.get_text() == f"{'x' * 40}, cutoff 3 m", "whole"
    assert "…" in cut.get_text() and cut.get_text().endswith("x, cutoff 3 m"), "what it ends in stays"
    assert canvas.tooltips == [f"{'x' * 400}, cutoff 3 m"]


def test_known_is_a_share_of_the_depth_in_the_figure_of_a_verdict(monkeypatch):
    said = []
    monkeypatch.setattr(drawing.Canvas, "title", lambda self, text, *_: said.append(text))
    depth, state = np.array([[1.0, 1.0], [1.0, 0.0]]), np.array([[State.CONSISTENT, State.WRONG], [0, 0]])
    drawing.draw_validation(io.BytesIO(), np.zeros((1, 2, 2)), depth, state, np.zeros((2, 2)), title="room, frame 3")
    assert "room, frame 3" in said and "Checked: 67 % of the depth, of which 50.0 % are wrong" in said


def test_figures_of_all_notebooks_have_the_same_sizes():
    assert (
        set(notebook.NOTEBOOK_RC_PARAMS) <= set(mpl.rcParams)
        and mpl.RcParams(notebook.NOTEBOOK_RC_PARAMS)["figure.dpi"] >= 150
    )
    for file in (REPO / "notebooks").glob("*.ipynb"):
        code = "".join("".join(c["source"]) for c in json.loads(file.read_text())["cells"] if c["cell_type"] == "code")
        if "matplotlib" not in code:
            continue  # it shows pictures of the command alone
        assert "rcParams |= notebook.NOTEBOOK_RC_PARAMS" in code, file.name
        widths = re.findall(r"figsize=\(([^,]*),", code)
        assert widths and all("notebook.FIGURE_WIDTH_IN" in width for width in widths), f"{file.name}: {widths}"


def test_axes_place_values_and_have_round_ticks():
    plain, log = Axis(2.0, 12.0), Axis(0.1, 10.0, log=True)
    assert [plain.place(x) for x in (2.0, 7.0, 12.0, 99.0, -1.0)] == [0.0, 0.5, 1.0, 1.0, 0.0]
    assert [log.place(x) for x in (0.1, 1.0, 10.0)] == pytest.approx([0.0, 0.5, 1.0])
    assert plain.ticks(5) == [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]
    assert {0.1, 1.0, 10.0} <= {round(t, 6) for t in log.ticks()}
    fitted = fit_axis([1.0, None, 3.0], "x")
    assert (fitted.low, fitted.high) == pytest.approx((0.88, 3.12))
    assert fit_axis([1.0, -1.0, 4.0], "x", log=True).low == pytest.approx(1 / 1.15)
    assert Axis(0, 1, percent=True).write(0.25) == "25"


def test_colours_of_a_map_follow_the_log_of_its_values():
    axis = Axis(1.0, 4.0, log=True)
    values, there = np.array([[1.0, 2.0, 4.0, 9.0, 2.0]]), np.array([[True, True, True, True, False]])
    shown = maps.apply_log_cmap(values, there, axis, colours.DEPTH_CMAP)
    expected = maps.apply_cmap(np.array([[0.0, 0.5, 1.0, 1.0]]), colours.DEPTH_CMAP)
    assert np.allclose(shown[:, :4], expected)
    assert np.allclose(shown[0, 4], np.array(colours.parse_rgb(colours.PICTURE)) / 255)
    depth_axis = maps.fit_depth_axis(np.linspace(1.0, 3.0, 1001))
    assert (depth_axis.low, depth_axis.high) == pytest.approx((1.02, 2.98))
    assert maps.fit_depth_axis(np.full(9, 2.0)).high == 2.5


def test_previews_are_resampled_at_pixel_centres():
    pixels = np.arange(12.0).reshape(3, 4, 1)
    assert previews._resample(pixels, 3, 2)[..., 0].tolist() == [[1.0, 3.0], [5.0, 7.0], [9.0, 11.0]]
    assert previews._resample(pixels, 6, 8)[::2, ::2, 0].tolist() == pixels[..., 0].tolist()


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
