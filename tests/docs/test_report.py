"""Tables from archived results alone; figures and point clouds read back from their files."""

import io
import math
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
import torch
from rich.console import Console

from dhtorch.codes import Gate, Hole, Source, names
from dhtorch.experiments import report
from dhtorch.metrics import errors, risk
from dhtorch.runtime import results as result_files
from dhtorch.viz import plots as drawing
from dhtorch.viz.plots import colours


def make_result(methods=("paper", "opencv"), **changes):
    rows, summary = [], {}
    for m, method in enumerate(methods):
        scenes = []
        for k, scene in enumerate(("kitchen [a]", "hall|b")):
            rows += [{"scene": scene, "pair": [i, i + 3], "method": method} for i in range(2 + k)]
            scenes.append(
                {
                    "scene": scene,
                    "pair": None,
                    "method": method,
                    "n_candidates": 100 * (k + 1),
                    "coverage": 0.5 + 0.1 * m,
                    "median_rel": 0.012345 * (k + 1),
                    "p90_rel": 0.25,
                    "corr": None,
                    "residual_px": 0.456,
                    "pnp_success": 1.0,
                    "n_dropped": {"close": 7, "wide": 21},
                    "hole_share": {"trackable_no_lidar": 0.6, "low_texture": 0.4},
                    "ms": {"track": 10.0 + m, "pose": 5.0},
                }
            )
        rows += scenes
        prefix = f"{method}." if len(methods) > 1 else ""
        summary |= {prefix + name: entry for name, entry in errors.summarise_scenes(scenes).items()}
    parts = {
        "experiment": "pair",
        "key": "0" * 64,
        "meta": result_files.collect_run_metadata(device="cpu", dtype="float32", threads=1, seed=0, operators="torch"),
        "config": {},
        "data": {"name": "rooms", "scenes": ["kitchen [a]", "hall|b"], "n_pairs": 5, "digest": ""},
    }
    return result_files.build_result(**{**parts, "summary": summary, "rows": rows, **changes})


# ---------------------------------------------------------------------------------------------------- tables


def test_tables_show_every_scene_and_method_side_by_side():
    main, dropped, holes, ms = report.tables(make_result())
    assert [row[:2] for row in main.rows[:4]] == [
        ["kitchen [a]", "paper"],
        ["kitchen [a]", "opencv"],
        ["hall|b", "paper"],
        ["hall|b", "opencv"],
    ]
    cell = lambda row, head: main.rows[row][main.head.index(head)]  # noqa: E731
    assert cell(0, "pairs") == "2" and cell(2, "pairs") == "3"
    assert cell(0, "median") == "1.23 %" and cell(0, "p90") == "25.0 %" and cell(0, "corr") == "–"
    assert cell(1, "coverage") == "60.0 %" and cell(0, "pose found") == "100 %" and cell(0, "residual px") == "0.46"
    assert main.footer == 4 and cell(4, "scene") == "2 scenes" and cell(4, "candidates") == "300"
    assert cell(4, "pairs") == "5" and cell(5, "scene") == report.INTERVAL_LABEL and cell(5, "median") == "1.23–2.47 %"
    assert dropped.rows == [["all methods", "14", "42"]] and dropped.head == ["method", "close", "wide"]
    assert holes.head[1] == "trackable, no LiDAR" and holes.rows[0][1:] == ["60.0 %", "40.0 %"]
    assert ms.head == ["method", "track", "pose", "total"]
    assert ms.rows == [["paper", "10.0", "5.0", "15.0"], ["opencv", "11.0", "5.0", "16.0"]]


def test_one_method_needs_no_method_column():
    main = report.tables(make_result(methods=("paper",)))[0]
    assert main.head[:2] == ["scene", "pairs"] and main.rows[0][0] == "kitchen [a]"
    assert main.rows[2][main.head.index("coverage")] == "50.0 %"


def test_metrics_that_a_result_has_beyond_the_usual_get_a_column():
    result = make_result()
    for row in result["rows"]:
        if row["pair"] is None:
            row["aurc"] = 0.0654
    main = report.tables(result)[0]
    assert main.head[-1] == "AURC" and main.rows[0][-1] == "0.065" and "ECE" not in main.head


def test_a_result_without_truth_has_tables_too():
    result = make_result(summary={}, rows=[{"scene": "a", "pair": None, "method": "paper", "pnp_success": 0.0}])
    (main,) = report.tables(result)
    assert main.rows[0] == ["a", "0", "–", "–", "–", "–", "–", "–", "0 %"]


def test_the_console_shows_all_cells_and_takes_names_literally():
    out = io.StringIO()
    report.print_tables(make_result(), Console(file=out))
    text = out.getvalue()
    for word in (
        "kitchen [a]",
        "hall|b",
        "1.23 %",
        "trackable, no LiDAR",
        "milliseconds per pair",
        report.INTERVAL_LABEL,
    ):
        assert word in text
    assert max(map(len, text.splitlines())) <= 140 and "…" not in text


def test_the_command_prints_both_forms_and_refuses_what_is_no_result(tmp_path, capsys):
    result_files.write_result(tmp_path / "result.json", make_result())
    assert report.main([str(tmp_path)]) == 0
    assert "pair on rooms" in capsys.readouterr().out
    assert report.main([str(tmp_path / "result.json"), "--markdown"]) == 0
    text = capsys.readouterr().out
    assert "| kitchen [a] | paper | 2 | 100 | 50.0 % | 1.23 % |" in text and "hall\\|b" in text
    for block in text.split("\n\n"):
        lines = [line for line in block.strip().splitlines() if line.startswith("|")]
        assert len({line.replace("\\|", "").count("|") for line in lines}) <= 1, "every row has as many cells"
    with pytest.raises(FileNotFoundError, match="expected a result"):
        report.main([str(tmp_path / "nothing")])


# ---------------------------------------------------------------------------------------------------- figures


def picture(path):
    pixels = matplotlib.image.imread(path)[..., :3]
    assert pixels.shape[0] > 300 and pixels.shape[1] > 300
    return pixels


def share_of(pixels, colour):
    """Share of the pixels that have this colour."""
    wanted = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return (np.abs(pixels - wanted).max(-1) < 0.02).mean()


def scene(n=300, seed=0):
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(3, 60, 80, generator=g)
    uv = torch.rand(n, 2, generator=g) * torch.tensor([79.0, 59.0])
    return image, uv, g


def test_samples_are_drawn_in_the_colour_of_what_became_of_them(tmp_path):
    image, uv, g = scene()
    source = torch.randint(0, 3, (300,), generator=g)
    gate = torch.where(source == Source.NONE, Gate.PARALLAX, Gate.ANSWER)
    drawing.draw_samples(tmp_path / "a.png", image, uv, source, gate)
    pixels = picture(tmp_path / "a.png")
    for colour in (colours.SENSOR, colours.RECOVERED, colours.GATE_COLOURS[Gate.PARALLAX]):
        assert share_of(pixels, colour) > 4e-4
    assert share_of(pixels, colours.GATE_COLOURS[Gate.RESIDUAL]) < 1e-4
    drawing.draw_samples(tmp_path / "b.png", (255 * image).to(torch.uint8), uv, 0 * source, 0 * source)
    without = picture(tmp_path / "b.png")
    assert share_of(without, colours.SENSOR) < 1e-4
    assert pixels.shape[1] > 1.1 * without.shape[1], "the legend stands beside the picture and is not cut off"


def test_holes_are_drawn_by_class(tmp_path):
    image, uv, g = scene()
    hole = torch.randint(0, 3, (300,), generator=g)
    drawing.draw_holes(tmp_path / "a.png", image[:1], uv, hole, title="one channel")
    pixels = picture(tmp_path / "a.png")
    assert share_of(pixels, colours.HOLE_COLOURS[Hole.TRACKABLE_NO_LIDAR]) > 1e-3
    assert share_of(pixels, colours.HOLE_COLOURS[Hole.AT_BORDER]) < 1e-4


def test_every_code_has_a_colour_of_its_own():
    assert set(colours.GATE_COLOURS) == set(names(Gate)) - {Gate.ANSWER}
    assert set(colours.HOLE_COLOURS) == set(names(Hole)) - {Hole.NONE}
    for table in (colours.GATE_COLOURS, colours.HOLE_COLOURS):
        assert len(set(table.values())) == len(table)


def test_depth_and_risk_figures_also_of_nothing(tmp_path):
    true = 2 + 4 * torch.rand(400, generator=torch.Generator().manual_seed(0))
    depth = torch.where(torch.arange(400) % 4 > 0, true * 1.05, math.nan)
    points = errors.make_points(depth, true, true / 10)
    drawing.draw_depth(tmp_path / "depth.png", points.true_depth, points.depth, points.score)
    drawing.draw_depth(tmp_path / "plain.png", true, depth)
    assert share_of(picture(tmp_path / "plain.png"), colours.SENSOR) > 5e-4
    curves = {"paper": risk.risk_coverage(points), "none": risk.risk_coverage(points[:0])}
    drawing.draw_risk_coverage(tmp_path / "risk.png", curves, oracle=risk.risk_coverage(points, oracle=True))
    assert share_of(picture(tmp_path / "risk.png"), colours.METHOD_COLOURS["paper"]) > 1e-3
    drawing.draw_depth(tmp_path / "empty.png", true[:0], depth[:0], depth[:0])
    drawing.draw_risk_coverage(tmp_path / "void.png", {})
    picture(tmp_path / "empty.png"), picture(tmp_path / "void.png")


def test_tables_need_no_drawing_library():
    code = "import sys, dhtorch.experiments.report, dhtorch.viz.plots; print([m for m in ('matplotlib', 'rich') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
