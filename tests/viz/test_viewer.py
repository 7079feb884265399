"""Seeing: what is shown is what was computed, in a page that a browser draws and in a recording that Rerun reads."""

import base64
import contextlib
import copy
import html.parser
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
from dhtorch.codes import Gate, Source, names
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
    writers.write_counted_frames(tmp_path / "capture", [room[i] for i in range(3)])
    options = ["data=auto", "data.root=capture", "pairs.gap=2", "method.n=256", "holdout=none", "figures=false"]
    code, _, err = command(*options, "output=job")
    assert code == 0, err
    place = tmp_path / "far" / "away"
    place.mkdir(parents=True)
    (tmp_path / "job").rename(place / "job")
    monkeypatch.chdir(place)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    code, _, err = command("view", "job", "html=page.html")
    assert code == 0 and "alone" not in err and (place / "page.html").stat().st_size > 1000, err
    (tmp_path / "capture").rename(tmp_path / "moved")
    code, _, err = command("view", "job", "html=lost.html")
    assert code == 2 and "root=PATH" in err and not (place / "lost.html").exists(), err
    code, _, err = command("view", "job", f"root={tmp_path / 'moved'}", "html=found.html")
    assert code == 0 and (place / "found.html").is_file(), err


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


class Tags(html.parser.HTMLParser):
    """Scripts with their text, and every address that is asked for."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.addresses, self.inside = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "action")]
        self.inside = tag == "script"
        if self.inside:
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = False

    def handle_data(self, data):
        if self.inside:
            self.scripts[-1] += data


def data_of(page):
    return json.loads(Tags(page).scripts[0])


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["base64"]), f"<{packed['type']}")


def test_the_page_is_whole_and_small(scene):
    page = pages.build_viewer_page(scene)
    found = Tags(page)
    assert len(found.scripts) == 2 and not found.addresses
    code = len(page) - len(found.scripts[0])
    assert code < 100_000, "under a tenth of a megabyte beside the data"
    for word in ("http:", "https:", "import(", "@import", "url(", "fetch(", "XMLHttpRequest", "eval("):
        assert word not in found.scripts[1].replace("http://www.w3.org/2000/svg", ""), word
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
    named = replace(scene, name=HOSTILE, facts={HOSTILE: HOSTILE})
    named.shots[0].facts[HOSTILE] = HOSTILE
    try:
        page = pages.build_viewer_page(named)
    finally:
        del named.shots[0].facts[HOSTILE]
    found = Tags(page)
    assert len(found.scripts) == 2, "no script of theirs"
    data = json.loads(found.scripts[0])
    assert data["title"] == HOSTILE and data["facts"] == {HOSTILE: HOSTILE} == {
        k: v for k, v in data["shots"][0]["facts"].items() if k == HOSTILE
    }
    assert not set(found.scripts[0]) & set("<>&")


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


def column(reader, entity, component):
    """Values of a component of an entity, chunk by chunk, in the order of the pairs."""
    found = []
    for chunk in reader.stream():
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.split(":")[-1] == component:
                order = batch.column("pair").to_pylist() if "pair" in batch.schema.names else [0] * batch.num_rows
                found += list(zip(order, batch.column(name).to_pylist(), strict=True))
    return [value for _, value in sorted(found, key=lambda item: item[0])]


def test_a_recording_holds_everything(recorded):
    paths = set(recorded.store().schema().entity_paths())
    assert {f"/gates/{name.lower()}" for name in ("SENSOR", *names(Gate).values())} <= paths
    for name in (
        "path",
        "reference/picture",
        "reference/depth",
        "reference/picture/samples/unanswered",
        "source/picture/tracks",
    ):
        assert f"/world/{name}" in paths, name
    assert {"/pair", "/about", "/world/map/sensor", "/world/map/held_out", "/world/map/sigma"} <= paths
    assert "/world/map/swept" in paths


def test_a_recording_is_read_back_as_computed(recorded, scene):
    where = column(recorded, "/world/map/recovered", "positions")
    radii = column(recorded, "/world/map/recovered", "radii")
    counts = column(recorded, "/gates/answer", "scalars")
    swept = column(recorded, "/world/map/swept", "positions")
    for k, shot in enumerate(scene.shots):
        s, T = shot.samples, shot.T_world_from_0
        here = s["source"] == Source.RECOVERED
        assert np.allclose(where[k], s["xyz"][here] @ T[:3, :3].T + T[:3, 3], atol=1e-5)
        assert np.allclose(radii[k], s["sigma"][here].clip(rrd._MIN_RADIUS_M, rrd._MAX_RADIUS_M), atol=1e-6)
        assert counts[k] == [shot.gates()["ANSWER"]]
        assert np.allclose(swept[k], shot.swept.xyz @ T[:3, :3].T + T[:3, 3], atol=1e-5)


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
    result_files.write_result(tmp_path / "old" / "result.json", result)
    code, _, err = command("view", "old", "html=page.html")
    assert code == 2 and "gone" in err
    shutil.copytree(job / "synthetic_room", tmp_path / "old" / "synthetic_room")
    code, out, err = command("view", "old", "html=page.html")
    assert code == 0 and "points.ply" in err and "page.html" in out
    data = data_of((tmp_path / "page.html").read_text())
    assert data["title"] == "synthetic_room" and not data["views"]
    result_files.write_result(tmp_path / "old" / "result.json", result | {"data": result["data"] | {"scenes": []}})
    code, _, err = command("view", "old", "html=page.html")
    assert code == 2 and err.startswith("dhtorch: scene: found None, expected a number below 0")


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


def test_a_result_that_writes_is_refused(job, command, tmp_path):
    result = result_files.read_result(job)
    options = {"tasks": 1, "scenes": 1, "n_frames": 1, "hw": [36, 64]}
    result["config"]["data"] = {
        "_target_": "dhtorch.synthetic.robot.open_robot",
        "root": str(tmp_path / "new"),
        **options,
    }
    result_files.write_result(tmp_path / "old" / "result.json", result)
    code, _, err = command("view", "old", "html=page.html")
    assert code == 2 and len(err.splitlines()) == 1 and "config.data._target_: found 'dhtorch.synthetic.robot" in err
    assert not (tmp_path / "new").exists() and not (tmp_path / "page.html").exists()


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
