"""Seeing: what is shown is what was computed, in a page that a browser draws and in a recording that Rerun reads."""

import base64
import contextlib
import copy
import html
import importlib.util
import io
import itertools
import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from support import damage_harness, writers
from support.room_truth import room_distance
from support.rooms import Changed, room_scene
from support.rooms import room as rendered

from dhtorch import export
from dhtorch.cli import run
from dhtorch.codes import Gate, Hole, Source, names
from dhtorch.data.pairs import by_choice, by_gap
from dhtorch.experiments.exhibits import MAX_CLOUD_POINTS, MAX_SWEPT_POINTS, make_exhibit
from dhtorch.experiments.protocol import Settings
from dhtorch.integrate.sweeps import DenseSweep
from dhtorch.pipeline.presets import METHODS
from dhtorch.runtime import code_dependencies
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz import viewer
from dhtorch.viz.viewer import again, points, rrd
from dhtorch.viz.viewer import html as pages
from dhtorch.viz.viewer.exhibit import (
    EMPTY_CLOUD,
    DepthImage,
    Exhibit,
    ExhibitView,
    PairExhibit,
    PointCloud,
    SweptPointCloud,
)

CUTOFF, N = 2.0, 700
HOSTILE = "</script><script>document.title='taken'</script><!-- & \u2028 ' \" ünï"
TINY = ["data.hw=[120,160]", "data.n_frames=4", "data.supersample=1", "pairs.gap=2", "method.n=1024"]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@pytest.fixture(scope="module")
def scene():
    room = rendered(hw=(180, 240), n_frames=6)
    method, sweep = METHODS["map"].replace(n=N), DenseSweep({"planes": 32})
    return make_exhibit(room, method, lambda r: by_gap(r, 4), Settings(cutoff=CUTOFF), sweep=sweep)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A result of the main job, with its pictures and points."""
    folder = tmp_path_factory.mktemp("job")
    assert run.main([*TINY, f"output={folder}"]) == 0
    return folder


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    def call(*args):
        code = run.main(list(map(str, args)))
        return code, *capsys.readouterr()

    return call


# ----------------------------------------------------------------------------------------------- what there is to see


@pytest.mark.slow
def test_a_result_finds_its_data_wherever_it_is_and_is_called_from(command, tmp_path, monkeypatch):
    room = SyntheticRoom(hw=(60, 80), n_frames=3, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "capture", list(room))
    options = ["data=auto", "data.root=capture", "pairs.gap=2", "method.n=256", "holdout=none", "figures=false"]
    assert command(*options, "output=job")[0] == 0
    place, moved = tmp_path / "far" / "away", tmp_path / "moved"
    place.mkdir(parents=True)
    (tmp_path / "job").rename(place / "job")
    monkeypatch.chdir(place)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    for words, ends, said in (([], 0, ""), ([], 2, "root=PATH"), ([f"root={moved}"], 0, "")):
        code, _, err = command("view", "job", "html=page.html", *words)
        assert code == ends and said in err and "alone" not in err and (code or Path("page.html").stat().st_size > 1000)
        Path("page.html").unlink(missing_ok=True)
        moved.exists() or (tmp_path / "capture").rename(moved)


def test_every_sample_has_one_fate(scene):
    assert [shot.label for shot in scene.shots] == ["0 → 4", "1 → 5"] and scene.placed
    assert [view.number for view in scene.views] == [0, 4, 1, 5]
    for shot in scene.shots:
        s = shot.samples
        assert sum(shot.gates().values()) == N == len(s["depth"])
        assert shot.gates()["ANSWER"] == (s["source"] == Source.RECOVERED).sum() > 50
        assert (np.isfinite(s["xyz"]).all(1) == (s["source"] != Source.NONE)).all()
        assert np.isfinite(s["error"]).sum() > 30 and not np.isfinite(s["error"][~s["candidate"]]).any()
        assert np.nanmedian(s["error"]) < 0.05


def test_points_seen_from_the_other_camera_lie_where_they_were_tracked(scene):
    """xyz, both poses and the pixels belong together."""
    for shot in scene.shots:
        s, view = shot.samples, scene.views[shot.view_1]
        here = s["source"] == Source.RECOVERED
        T = np.linalg.inv(shot.T_world_from_1) @ shot.T_world_from_0
        x = s["xyz"][here] @ T[:3, :3].T + T[:3, 3]
        uv = x[:, :2] / x[:, 2:] * view.f + view.c
        assert np.median(np.linalg.norm(uv - s["uv_1"][here], axis=1)) < 0.5


def test_what_was_held_back_is_apart(scene):
    for shot in scene.shots:
        assert 0 < len(shot.seen.xyz) <= MAX_CLOUD_POINTS and 0 < shot.seen.xyz[:, 2].max() <= CUTOFF
        assert 0 < len(shot.held_out.xyz) <= MAX_CLOUD_POINTS and shot.held_out.xyz[:, 2].min() > CUTOFF
        assert shot.depth_image.depth.max() <= CUTOFF and shot.seen.rgb.std() > 10


@pytest.mark.slow
def test_swept_pixels_are_a_cloud_of_their_own(scene):
    for shot in scene.shots:
        view, swept = scene.views[shot.view_0], shot.swept
        assert (
            1000 < len(swept.xyz) <= MAX_SWEPT_POINTS
            and swept.sigma.min() > 0
            and 0 < swept.score.min() < swept.score.max() < 1
        )
        uv = swept.xyz[:, :2] / swept.xyz[:, 2:] * view.f + view.c
        assert np.abs(uv - np.round(uv)).max() < 0.01, "pixels of the picture"
        assert len(np.unique(np.round(uv), axis=0)) == len(uv), "each once"
        colour = np.asarray(Image.open(io.BytesIO(view.jpeg)))[tuple(np.round(uv).astype(int).T[::-1])]
        assert np.abs(colour.astype(float) - swept.rgb).mean() < 12, "in its colour, but for the JPEG's"
        off = room_distance(torch.from_numpy(swept.xyz @ shot.T_world_from_0[:3, :3].T + shot.T_world_from_0[:3, 3]))
        assert float(off.median()) < 0.15 and float((off < 2 * torch.from_numpy(swept.sigma)).double().mean()) > 0.7


def test_without_a_sweep_there_are_no_swept_pixels():
    found = make_exhibit(
        room_scene(SyntheticRoom(hw=(40, 60), n_frames=2)), METHODS["paper"], lambda r: by_gap(r, 1), Settings()
    )
    data = data_of(pages.build_viewer_page(found))
    assert len(found.shots[0].swept.xyz) == 0 and "swept" not in data["about"]


def test_a_method_that_chooses_sweeps_what_it_chose():
    room = room_scene(rendered(hw=(180, 240), n_frames=6))
    method = METHODS["map"].replace(n=256, views=2)
    found = make_exhibit(
        room, method, lambda r: by_choice(r, stride=9), Settings(cutoff=CUTOFF), sweep=DenseSweep({"planes": 16})
    )
    assert len(found.shots) == 1 and found.shots[0].facts["views"] and len(found.shots[0].swept.xyz) > 500


@pytest.mark.slow
def test_without_a_trajectory_every_pair_stands_alone():
    whole = SyntheticRoom(hw=(60, 80), n_frames=4)
    room = Changed(whole, lambda frame: frame.replace(T_world_from_cam=None), poses=None)
    found = make_exhibit(room_scene(room), METHODS["paper"], lambda r: by_gap(r, 2), Settings())
    assert found.path is None and not found.placed and len(found.shots) == 2
    assert all((shot.T_world_from_0 == np.eye(4)).all() for shot in found.shots)


def test_of_many_pairs_some_are_shown():
    room = SyntheticRoom(hw=(40, 60), n_frames=8)
    found = make_exhibit(room_scene(room), METHODS["paper"], lambda r: by_gap(r, 1), Settings(), most=3)
    assert [shot.label for shot in found.shots] == ["0 → 1", "3 → 4", "6 → 7"]


# ------------------------------------------------------------------------------------------------------------ the page


SCRIPT = re.compile(r"<script[^>]*>(.*?)</script>", re.DOTALL)


def data_of(page):
    return json.loads(SCRIPT.search(page)[1])


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["base64"]), f"<{packed['type']}")


def test_the_page_is_whole_and_small(scene):
    page = pages.build_viewer_page(scene)
    data, code = SCRIPT.findall(page)
    assert not re.search(r"\b(src|href|srcset|action)=", SCRIPT.sub("", page)), "no address is asked for"
    assert len(page) - len(data) < 100_000, "under a tenth of a megabyte beside the data"
    for word in ("http:", "https:", "import(", "@import", "url(", "fetch(", "XMLHttpRequest", "eval("):
        assert word not in code.replace("http://www.w3.org/2000/svg", ""), word
    assert "default-src 'none'" in page


def test_the_page_holds_what_was_computed(scene):
    data = data_of(pages.build_viewer_page(scene))
    for shot, sent in zip(scene.shots, data["shots"], strict=True):
        assert sent["counts"] == shot.gates()
        for name in ("xyz", "depth", "sigma", "error"):
            assert np.array_equal(unpacked(sent["samples"][name]), shot.samples[name].ravel(), equal_nan=True), name
        for name in ("gate", "hole", "source", "tracked", "candidate", "cause"):
            assert (unpacked(sent["samples"][name]) == shot.samples[name]).all(), name
        has_depth = shot.samples["source"] > 0
        assert ((shot.samples["cause"] > 0) == has_depth).all() and (shot.swept.cause > 0).all()
        assert (shot.samples["cause"][shot.samples["source"] == Source.SENSOR] == 3).all(), "the reference"
        assert (unpacked(sent["swept"]["cause"]) == shot.swept.cause).all()
        jpeg = base64.b64decode(data["views"][sent["view_0"]]["jpeg"])
        assert jpeg[:2] == b"\xff\xd8"


def test_names_are_text_and_never_markup(scene):
    shot = replace(scene.shots[0], facts={**scene.shots[0].facts, HOSTILE: HOSTILE})
    named = replace(scene, name=HOSTILE, facts={HOSTILE: HOSTILE}, shots=[shot, *scene.shots[1:]])
    data, _ = SCRIPT.findall(pages.build_viewer_page(named))  # no script of theirs
    assert not set(data) & set("<>&")
    data = json.loads(data)
    assert data["title"] == HOSTILE and data["facts"] == {HOSTILE: HOSTILE}
    assert data["shots"][0]["facts"][HOSTILE] == HOSTILE


# --------------------------------------------------------------------------------------------------------- the browser


def chromium(folder, page, *flags, script=""):
    """Load a page; returns what was printed and what the console said."""
    file = folder / "page.html"
    file.write_text(page.replace("</script>\n</body>", f"\nsetTimeout(() => {{ {script} }}, 500);</script>\n</body>"))
    options = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    options += ["--hide-scrollbars", "--virtual-time-budget=8000", "--window-size=1300,900", "--enable-logging=stderr"]
    options += [f"--user-data-dir={folder / 'profile'}", *flags, file.as_uri()]
    done = subprocess.run([CHROMIUM, *options], check=True, capture_output=True, text=True, timeout=120)
    lines = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout, [line for line in lines if "GPU stall due to ReadPixels" not in line]  # the test's own readings


@browser
@pytest.mark.parametrize("dark", [False, True])
def test_a_browser_draws_the_points(scene, tmp_path, dark):
    shot = tmp_path / "shot.png"
    flags = [f"--screenshot={shot}", *["--force-dark-mode"] * dark]
    _, console = chromium(tmp_path, pages.build_viewer_page(scene), *flags, script='chooseColour("source")')
    assert console == []
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    stage = pixels[110:600, 30:700]
    red, green, blue = stage[..., 0], stage[..., 1], stage[..., 2]
    assert ((blue > red + 40) & (blue > 60)).sum() > 300, "returns of the sensor"
    assert ((red > blue + 90) & (green > blue + 40)).sum() > 300, "recovered points"
    assert ((red > green + 50) & (blue > green + 25)).sum() > 300, "swept pixels"
    colours, counts = np.unique(stage.reshape(-1, 3), axis=0, return_counts=True)
    ground = colours[counts.argmax()]
    empty = (np.abs(stage - ground).max(-1) < 12).mean()
    assert 0.1 < empty < 0.8 and (ground.mean() < 60) == dark, "the overview fills the canvas"


@browser
def test_a_browser_counts_and_obeys(scene, tmp_path):
    """The threshold changes what stays as the records say; keys, colours and places work; hostile names stay text."""
    named = replace(scene, name=HOSTILE)
    script = """
      const said = [];
      const set = (v) => { $("threshold").value = v; $("threshold").dispatchEvent(new Event("input")); };
      set(0.5); said.push($("coverage").textContent);
      document.dispatchEvent(new KeyboardEvent("keydown", { key: "]" })); set(0); said.push($("coverage").textContent);
      const before = $("space").toDataURL();
      for (const [mode] of MODES) chooseColour(mode);
      $("all").click(); for (const place of ["camera", "above", "side"]) lookFrom(place);
      pick(shots[1].source.indexOf(2)); drawSpace(); drawPictures(); said.push($("sample-facts").textContent);
      said.push($("read-out").hidden ? "" : $("read-out").textContent);
      said.push(String(before !== $("space").toDataURL()));
      for (const name of ["swept", "filled"]) {
        drawSpace();
        const all = $("space").toDataURL();
        toggle(name, false);
        drawSpace();
        said.push(String(all !== $("space").toDataURL()));
      }
      said.push(document.querySelector("h1").textContent, document.title);
      document.body.dataset.said = JSON.stringify(said);
    """
    dom, console = chromium(tmp_path, pages.build_viewer_page(named), "--dump-dom", script=script)
    assert console == []
    attribute = re.search(r'data-said="([^"]*)"', dom)
    first, second, sample, beside, changed, *hidden, heading, title = json.loads(html.unescape(attribute[1]))
    for k, (said, least) in enumerate([(first, 0.5), (second, 0.0)]):
        s = scene.shots[k].samples
        answers = s["source"] == Source.RECOVERED
        kept = answers & (s["score"] >= least)
        assert said.startswith(f"{kept.sum()} of {answers.sum()} answers shown")
        cloud = scene.shots[k].swept
        for name, code in (("recovered (swept)", Source.SWEPT), ("filled", Source.FILLED)):
            of_source = cloud.source == code
            shown = (of_source & (np.round(65535 * cloud.score) / 65535 >= least)).sum()
            assert f" {shown:,} of {of_source.sum():,} {name} points shown." in said
        right = np.isfinite(s["error"]) & (s["score"] >= least)
        assert f"Of {s['candidate'].sum()} held-out returns" in said and right.any()
    assert "recovered" in sample and "parallax" in sample and {changed, *hidden} == {"true"}
    assert " m ± " in beside and "recovered, score" in beside
    assert heading == title == f"{HOSTILE} · dhtorch"


# -------------------------------------------------------------------------------------------------------------- Rerun


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    chunks = pytest.importorskip("rerun.chunk")
    return chunks.RrdReader(rrd.write_rrd(tmp_path_factory.mktemp("rrd") / "view.rrd", scene))


def test_a_recording_holds_everything(recorded):
    expected = {f"/gates/{name.lower()}" for name in ("SENSOR", *names(Gate).values())} | {"/pair", "/about"}
    reference = ("", "/picture", "/depth", "/picture/samples/unanswered")
    expected |= {"/world/path", "/world/source/picture/tracks", *(f"/world/reference{each}" for each in reference)}
    expected |= {f"/world/map/{name}" for name in ("sensor", "held_out", "sigma", "swept")}
    assert expected <= set(recorded.store().schema().entity_paths())


# --------------------------------------------------------------------------------------------------------- the command


@pytest.mark.slow
def test_a_result_is_shown_as_it_was_archived(job, command, tmp_path):
    code, out, err = command("view", job, "html=page.html")
    assert (code, err) == (0, "") and "page.html" in out
    data = data_of((tmp_path / "page.html").read_text())
    rows = [row for row in result_files.read_result(job)["rows"] if row["pair"] is not None]
    assert [shot["label"] for shot in data["shots"]] == ["{} → {}".format(*row["pair"]) for row in rows]
    assert [shot["counts"]["ANSWER"] for shot in data["shots"]] == [row["n_recovered"] for row in rows]
    assert data["facts"]["data"] == "synthetic" and "2 m" in data["facts"]["sensor"]


@pytest.mark.parametrize(
    ("there", "screen", "name"),
    [(True, "", "view.rrd"), pytest.param(False, ":0", "view.html", marks=pytest.mark.slow)],
)
def test_without_a_screen_a_recording_is_written_and_without_rerun_a_page(command, monkeypatch, there, screen, name):
    if there:
        pytest.importorskip("rerun")
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: known(n) if there or n != "rerun" else None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", screen)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    code, out, err = command("view", *TINY, "max_frames=1", "output=new")
    path = Path("new", name)
    assert (code, err) == (0, "") and path.stat().st_size > 10_000 and str(path) in out.strip().splitlines()[-1]


def test_a_recording_of_ones_own(command, tmp_path):
    code, _, err = command("view", *TINY, "max_frames=1", "holdout=none", "html=own.html")
    assert (code, err) == (0, ""), err
    data = data_of((tmp_path / "own.html").read_text())
    assert len(data["shots"]) == 1 and data["facts"]["sensor"] == "all returns used"
    assert not unpacked(data["shots"][0]["held_out"]["xyz"]).size


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["nowhere"], ["nowhere"]),
        ([*TINY, "max_frames=0"], ["max_frames", "0"]),
        ([*TINY, "dense={sise: 3}"], ["dense", "sise", "source_views"]),
        ([*TINY, "scene=hall", "html=x.html"], ["scene", "hall", "synthetic_room"]),
        (["html=x.txt"], ["x.txt", ".html"]),
        (["save=view.rerun"], ["view.rerun", ".rrd"]),
        (["html=."], [".html"]),
        (["colour=red"], ["colour"]),
    ],
)
def test_bad_input_gets_one_clear_line(command, args, words):
    code, _, err = command("view", *args)
    assert code == 2 and len(err.strip().splitlines()) == 1 and all(word in err for word in words), err


def test_data_that_are_gone_leave_the_points(job, command, tmp_path):
    result = result_files.read_result(job)
    result["config"]["data"] = {"_target_": "dhtorch.data.open_all", "root": "gone", "format": "auto"}
    none = result | {"data": result["data"] | {"scenes": []}}
    for with_points, given, ends, said in (
        (False, result, 2, "gone"),
        (True, result, 0, "points.ply"),
        (True, none, 2, "dhtorch: scene: found None, expected a number below 0"),
    ):
        result_files.write_result(tmp_path / "old" / "result.json", given)
        if with_points:
            shutil.copytree(job / "synthetic_room", tmp_path / "old" / "synthetic_room", dirs_exist_ok=True)
        code, out, err = command("view", "old", "html=page.html")
        assert code == ends and said in err and (code or "page.html" in out)
    data = data_of((tmp_path / "page.html").read_text())
    assert data["title"] == "synthetic_room" and not data["views"]


# ------------------------------------------------------------------------------------------- files from anywhere


@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "builtins.eval",
        "dhtorch.runtime.results.os.system",
        "dhtorch.data.io.decode.read_image",
        "dhtorch.export.stray.write_stray",
        "dhtorch.data.os",
        "dhtorch.data.Path",
        "dhtorch.export.write_ply",
        "dhtorch.synthetic.recording._rotate_device_axes",
        "dhtorch.synthetic.recording.simulate_phone_lidar.__globals__",
        "dhtorch.synthetic.robot.open_robot",
        "dhtorch.synthetic.robot.write_robot",
        "dhtorch.data.rig.Rig",
        ["dhtorch.data.open_all"],
        7,
        None,
    ],
)
def test_a_result_calls_only_what_settings_are_meant_to_name(job, name):
    result = result_files.read_result(job)
    result["config"]["method"]["track"]["deep"] = [{"a": {"_target_": "x", "_partial_": True, "_recursive_": False}}]
    for place in (["data"], ["method"], ["method", "track"], ["method", "track", "deep", 0, "a"]):
        changed = copy.deepcopy(result)
        node = changed["config"]
        for key in place:
            node = node[key]
        node["_target_"] = name
        with pytest.raises(ValueError, match="_target_"):
            again.rebuild_parts(changed)


#: Of the settings that ship, those that write: they are not shown again.
WRITING = {"dhtorch.synthetic.robot.open_robot"}


def test_what_a_result_may_name_writes_nothing(job, tmp_path, monkeypatch):
    """The data settings that ship, their data at a new path or an empty folder, in a process that may not write."""
    pytest.importorskip("h5py")  # starts a program when it is imported
    result = result_files.read_result(job)
    settings = [OmegaConf.to_container(OmegaConf.load(file)) for file in (run.config_dir() / "data").glob("*.yaml")]

    def open_each(path):
        for data, root in itertools.product(settings, (path, path / "new")):
            result["config"]["data"] = data | {"root": str(root)}
            with contextlib.suppress(ValueError, OSError):
                again.rebuild_parts(result)

    settings = [data for data in settings if "root" in data]
    assert WRITING & {data["_target_"] for data in settings}
    monkeypatch.setattr(damage_harness, "SECONDS", 20)
    (tmp_path / "capture").mkdir()
    assert damage_harness.run(open_each, tmp_path / "capture", tmp_path).kind == "frames"


def test_options_that_a_function_has_not_are_named(job):
    result = result_files.read_result(job)
    result["config"]["method"]["track"]["windw"] = 3
    with pytest.raises(ValueError, match=r"config\.method\.track.*windw"):
        again.rebuild_parts(result)


@pytest.mark.parametrize(("group", "folder"), [("data", "data"), ("pairs", "pairs"), ("method", "method")])
def test_every_setting_that_ships_can_be_shown_again(job, group, folder):
    files = list((run.config_dir() / folder).glob("*.yaml"))
    named = {
        name for file in files for name in code_dependencies.iter_targets(OmegaConf.to_container(OmegaConf.load(file)))
    }
    assert named
    for name in named - WRITING:
        result = result_files.read_result(job)
        result["config"][group] = {"_target_": name, "_partial_": True}
        module, _, last = name.rpartition(".")
        found, expected = again.rebuild_parts(result)[group], getattr(importlib.import_module(module), last)
        assert found.func is expected


def test_null_stands_for_what_strict_json_cannot_hold(job):
    result = result_files.read_result(job)
    assert result["config"]["method"]["backproject"]["near_limit"] is None
    assert again.rebuild_parts(result)["method"].backproject.keywords["near_limit"] is None
    assert again.read_cutoff(result, "synthetic_room") == 2.0
    result["rows"][-1]["cutoff_m"] = None
    assert again.read_cutoff(result, "synthetic_room") == math.inf


def test_points_of_a_file(tmp_path):
    rng = np.random.default_rng(0)
    xyz, sigma, score = rng.normal(size=(50, 3)), rng.random(50), rng.random(50)
    source = rng.choice([Source.SENSOR, Source.RECOVERED, Source.SWEPT, Source.FILLED], 50)
    export.write_ply(tmp_path / "p.ply", xyz, sigma=sigma, score=score, source=source)
    (shot,) = points.read_ply_exhibit(tmp_path / "p.ply").shots
    dense = source >= Source.SWEPT
    for name, value in {"xyz": xyz, "sigma": sigma, "score": score, "source": source}.items():
        assert np.allclose(shot.samples[name], value[~dense], atol=1e-6), name
    for name, value in {"xyz": xyz, "sigma": sigma, "score": score, "source": source}.items():
        assert np.allclose(getattr(shot.swept, name), value[dense], atol=1e-6), name
    assert "points" in data_of(pages.build_viewer_page(points.read_ply_exhibit(tmp_path / "p.ply")))["about"]


def test_what_opens_a_page_is_text_and_its_picture_stands_below_the_space(tmp_path):
    evil = '</script><b onload="x">\udcff&'
    export.write_ply(tmp_path / "p.ply", np.ones((1, 3)))
    opening = viewer.PageOpening({evil: evil}, [evil], b"PNG", evil)
    made = pages.build_viewer_page(replace(points.read_ply_exhibit(tmp_path / "p.ply"), name=evil, opening=opening))
    made.encode("utf-8")
    assert "<b onload" not in made and made.count("&lt;/script&gt;&lt;b onload=&quot;x&quot;&gt;?&amp;") >= 6
    assert (
        made.index("</header>")
        < made.index("<dl class=")
        < made.index("<main>")
        < made.index("data:image/png;base64,UE5H")
    )
    assert '<section id="opening"' not in pages.build_viewer_page(points.read_ply_exhibit(tmp_path / "p.ply"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n0",
        b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty float x\nend_header\n0000",
        b"\xff\xfe<script>",
    ],
)
def test_broken_points_are_refused(tmp_path, content):
    (tmp_path / "p.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"p\.ply"):
        points.read_ply_exhibit(tmp_path / "p.ply")


def view(k):
    return ExhibitView(
        number=10 + k, hw=(60, 80), f=(50.0 + k, 60.0 + k), c=(40.0 + k, 30.0 + k), jpeg=b"\xff\xd8" + bytes([k]),
        jpeg_hw=(30, 20), time=1.5 + k,
    )  # fmt: skip


def pose(k):
    T = np.eye(4)
    c, s = np.cos(0.1 * k), np.sin(0.1 * k)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = k, 2 * k, 3 * k
    return T


def cloud(first, n=2):
    xyz = np.arange(first, first + 3 * n, dtype=np.float32).reshape(n, 3)
    return PointCloud(xyz, np.full((n, 3), first, np.uint8))


@pytest.fixture
def exhibit():
    n = 4
    whole = np.arange(n)
    samples = {
        "uv_0": np.stack([10.0 + whole, 20.0 + whole], 1).astype(np.float32),
        "uv_1": np.stack([15.0 + whole, 26.0 + whole], 1).astype(np.float32),
        "xyz": np.arange(3 * n, dtype=np.float32).reshape(n, 3),
        "rgb": np.arange(3 * n, dtype=np.uint8).reshape(n, 3),
        "depth": np.array([1.0, 2.0, 4.0, 8.0], np.float32),
        "sigma": np.array([0.01, 0.02, 0.4, 0.8], np.float32),
        "score": np.array([0.0, 0.25, 0.5, 1.0], np.float32),
        "parallax_deg": np.array([1.0, 2.0, 3.0, 4.0], np.float32),
        "residual_px": np.array([0.1, 0.2, 0.3, 0.4], np.float32),
        "error": np.array([0.01, 0.02, 0.03, np.nan], np.float32),
        "source": np.array([Source.SENSOR, Source.NONE, Source.RECOVERED, Source.RECOVERED], np.int32),
        "gate": np.array([Gate.NO_TRACK, Gate.PARALLAX, Gate.ANSWER, Gate.ANSWER], np.int32),
        "hole": np.array([Hole.NONE, Hole.TOO_DARK, Hole.TRACKABLE_NO_LIDAR, Hole.TRACKABLE_NO_LIDAR], np.int32),
        "tracked": np.array([False, True, True, True]),
        "candidate": np.array([False, False, True, False]),
    }  # fmt: skip
    swept = SweptPointCloud(
        *(getattr(cloud(60), name) for name in ("xyz", "rgb")),
        np.float32([0.3, 0.6]),
        np.float32([0.2, 0.9]),
        np.uint8([Source.SWEPT, Source.FILLED]),
    )
    shot = PairExhibit(
        "10 11", samples, pose(1), pose(2), view_0=0, view_1=1, seen=cloud(20), held_out=cloud(40), swept=swept,
        depth_image=DepthImage(np.ones((3, 5), np.float32), (7.0, 8.0), (2.0, 1.0)),
    )  # fmt: skip
    return Exhibit("two cameras", [shot], [view(0), view(1)])


def test_a_page_places_each_camera_where_it_stood(exhibit):
    page = pages.build_viewer_page(replace(exhibit, path=np.arange(6.0).reshape(2, 3)))
    data = json.loads(re.search(r"<script[^>]*json[^>]*>(.*?)</script>", page, re.DOTALL).group(1))
    (shot,) = data["shots"]
    for k in (1, 2):
        assert np.allclose(np.reshape(shot[f"T_world_from_{k - 1}"], (3, 4)), pose(k)[:3])
    assert (shot["view_0"], shot["view_1"]) == (0, 1)
    for k, sent in enumerate(data["views"]):
        assert (sent["number"], sent["time"], sent["hw"]) == (10 + k, 1.5 + k, [60, 80])
        assert (sent["f"], sent["c"]) == ([50.0 + k, 60.0 + k], [40.0 + k, 30.0 + k])
        assert base64.b64decode(sent["jpeg"])[2] == k
    for name in ("uv_0", "uv_1"):
        uv = unpacked(shot["samples"][name]).reshape(-1, 2) / data["per_pixel"] - data["margin_px"]
        assert np.allclose(uv, exhibit.shots[0].samples[name])
    for name in ("seen", "held_out", "swept"):
        xyz = unpacked(shot[name]["xyz"]).reshape(-1, 3) * shot[name]["step"] + shot[name]["low"]
        assert np.allclose(xyz, getattr(exhibit.shots[0], name).xyz, atol=1e-3)
        assert np.array_equal(unpacked(shot[name]["rgb"]), getattr(exhibit.shots[0], name).rgb.ravel())
    assert unpacked(data["path"]).tolist() == [0, 1, 2, 3, 4, 5]
    assert np.allclose(unpacked(shot["samples"]["score"]) / 65535, [0, 0.25, 0.5, 1], atol=1e-4)
    assert np.allclose(unpacked(shot["swept"]["score"]) / 65535, [0.2, 0.9], atol=1e-4)
    assert unpacked(shot["swept"]["source"]).tolist() == [Source.SWEPT, Source.FILLED]
    assert data["about"].endswith(", 1 swept and 1 filled pixels")


class Log:
    """A recording stream, and a rerun module whose archetypes are their arguments."""

    def __init__(self):
        self.entries = {}

    def log(self, name, *parts):
        self.entries.setdefault(name, []).extend(parts)

    def set_time(self, *args, **options):
        pass

    def __getattr__(self, kind):
        return lambda *args, **options: SimpleNamespace(kind=kind, args=args, **options)

    def of(self, name, kind):
        (entry,) = [part for part in self.entries[name] if part.kind == kind]
        return entry


def test_a_recording_places_each_camera_and_every_point_where_it_stood(exhibit):
    log, (shot,) = Log(), exhibit.shots
    rrd._log_points(log, log, shot, True)
    rrd._log_views(log, log, shot, *exhibit.views)
    for k, name in ((1, "reference"), (2, "source")):
        placed, camera = log.of(f"world/{name}", "Transform3D"), log.of(f"world/{name}/picture", "Pinhole")
        assert np.allclose(placed.translation, pose(k)[:3, 3]) and np.allclose(placed.mat3x3, pose(k)[:3, :3])
        own = exhibit.views[k - 1]
        assert np.allclose(camera.focal_length, np.array(own.f) * [20 / 80, 30 / 60])
        assert np.allclose(camera.principal_point, (np.array(own.c) + 0.5) * [20 / 80, 30 / 60])
        assert (camera.width, camera.height) == (20, 30)
        assert log.of(f"world/{name}/picture", "EncodedImage").contents == own.jpeg
    depth = log.of("world/reference/depth", "Pinhole")
    assert (
        depth.principal_point == [2.5, 1.5]
        and depth.focal_length == (7.0, 8.0)
        and (depth.width, depth.height) == (5, 3)
    )
    placed = lambda xyz: xyz @ pose(1)[:3, :3].T + pose(1)[:3, 3]  # noqa: E731
    points = log.of("world/map/recovered", "Points3D")
    assert np.allclose(points.args[0], placed(shot.samples["xyz"][2:])) and len(points.radii) == 2
    for name in ("held_out", "swept"):
        assert np.allclose(log.of(f"world/map/{name}", "Points3D").args[0], placed(getattr(shot, name).xyz))
    assert log.of("world/map/swept", "Points3D").class_ids.tolist() == [rrd._SWEPT_CLASS, rrd._FILLED_CLASS]
    assert np.allclose(log.of("world/map/sensor", "Points3D").args[0], placed(shot.seen.xyz))
    alone = Log()
    rrd._log_points(alone, alone, replace(shot, seen=EMPTY_CLOUD), False)
    sensed = alone.of("world/map/sensor", "Points3D")
    assert (
        np.allclose(sensed.args[0], placed(shot.samples["xyz"][:1]))
        and (sensed.colors == shot.samples["rgb"][:1]).all()
    )
    bars = log.of("world/map/sigma", "LineStrips3D").args[0]
    assert np.allclose(bars[:, 0], placed(0.9 * shot.samples["xyz"][2:]))
    assert np.allclose(bars[:, 1], placed(1.1 * shot.samples["xyz"][2:]))
    tracks = log.of("world/source/picture/tracks", "LineStrips2D").args[0]
    to_jpeg = lambda uv: (uv + 0.5) * [20 / 80, 30 / 60]  # noqa: E731
    tracked = shot.samples["tracked"]
    assert np.allclose(tracks[:, 0], to_jpeg(shot.samples["uv_0"][tracked]))
    assert np.allclose(tracks[:, 1], to_jpeg(shot.samples["uv_1"][tracked]))
    silent = log.of("world/reference/picture/samples/unanswered", "Points2D")
    assert np.allclose(silent.args[0], to_jpeg(shot.samples["uv_0"][1:2])) and silent.class_ids.tolist() == [
        Gate.PARALLAX
    ]
