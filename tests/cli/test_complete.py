"""``dhtorch complete``: files that say what was found, that are a recording again, and that a kill cannot spoil.
``dhtorch PATH``: a capture of one's own, or one sentence that says why nothing comes of it. Every command checks its
capture first: notes and warnings are printed, refuted poses are removed, maps still joined."""

import base64
import contextlib
import io
import json
import shlex
import shutil
import warnings
from dataclasses import replace
from functools import cache
from inspect import signature
from types import SimpleNamespace

import av
import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from support import box_scene as box
from support import stored_outputs, textured_box, writers
from support.stated_poses import poses_of, state_poses, with_poses

from dhtorch import MAP, data, export
from dhtorch.cli import capture_checks, complete, inspect, process_capture, run
from dhtorch.cli.capture_checks import check_data, print_check
from dhtorch.cli.complete import count_pixels
from dhtorch.cli.run import main
from dhtorch.codes import Gate, Source, names
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, Scenes
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import se3
from dhtorch.geometry.camera import resize
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import completion, dense
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import Pose
from dhtorch.runtime import console, storage
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.validation.capture_check import CaptureCheck, Finding
from dhtorch.validation.pose_check import PoseCheck, PoseReading, ReadingScores
from dhtorch.viz.plots import colours, draw_completed

NEAR = 2.0
METHOD = MAP.replace(n=256)
SMALL = {"planes": 16, "refinements": 1, "cutoff": NEAR, "figures": False, "steps": [1]}


@pytest.fixture(scope="module")
def room():
    """Four views, far enough apart."""
    whole = SyntheticRoom(hw=(120, 160), n_frames=22, lidar="exact", supersample=1, image_noise=0.0)
    chosen = [0, 7, 14, 21]
    frames = [whole[k] for k in chosen]
    parts = {"times": whole.times[chosen], "poses": whole.poses[torch.tensor(chosen)]}
    return Recording("room", "made", frames.__getitem__, torch.arange(4), **parts)


@pytest.fixture(scope="module")
def captures(room, tmp_path_factory):
    """The room as numbered frames and as a TUM sequence."""
    folder = tmp_path_factory.mktemp("captures")
    writers.write_counted_frames(folder / "numbered", list(room))
    writers.write_tum(folder / "stamped", list(room)[:3])
    return folder


@pytest.fixture(scope="module")
def numbered(captures, tmp_path_factory):
    """Three frames of the numbered capture, complete."""
    out = tmp_path_factory.mktemp("out") / "maps"
    said(captures / "numbered", out, max_frames=3, arrays=True, points=True, figures=True)
    return out


@cache
def composed():
    """The settings as Hydra hands them over."""
    with hydra.initialize_config_dir(str(run.config_dir()), version_base="1.3"):
        cfg = hydra.compose("complete", ["data=synthetic", "out=x"])
    return {**OmegaConf.to_container(cfg, resolve=True), "choices": {"data": "auto", "method": "map"}}


def said(capture, out, progress=lambda items, *_: items, **settings):
    """What the command says of a capture, or of recordings, without Hydra."""
    asked = {**composed(), **SMALL, "out": str(out), **settings}
    given = capture if isinstance(capture, list) else data.open(capture)
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert complete.run(asked, {"data": given, "method": METHOD}, progress=progress) == 0
    return text.getvalue()


def pixels(path):
    return np.array(Image.open(path))


def stamps(folder):
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


# ------------------------------------------------------------------------------------------------------------ the files


def test_the_files_hold_what_complete_says(room, captures, numbered):
    """Against the function itself, asked for the same frame."""
    kinds = ("depth", "sigma", "source", "images", "meta", "arrays")
    assert {p.parent.name for p in numbered.rglob("0000*")} == {*kinds, "figures", "points"}
    for kind in kinds:
        assert sorted(p.stem for p in (numbered / kind).iterdir()) == ["000000", "000001", "000002"], kind
    recording = data.open(captures / "numbered")
    offered = candidate_frames(recording, 1, [1])
    frames = [range_split(recording[k], NEAR) for k in (1, *offered)]
    options = {
        "method": with_view_selection(METHOD),
        "planes": 16,
        "refinements": 1,
        "calibration": completion.default_calibration(),
    }
    with torch.no_grad():
        found = completion.complete_depth(frames[0], stack(frames[1:]), **options)[0]
    depth, sigma, source = (pixels(numbered / kind / "000001.png") for kind in ("depth", "sigma", "source"))
    assert depth.dtype == sigma.dtype == np.uint16 and source.dtype == np.uint8
    assert np.array_equal(source, found.source.numpy()) and {0, 1, 3} <= set(np.unique(source))
    there = found.keep.numpy()
    assert not depth[~there].any() and not sigma[~there].any()
    assert np.abs(depth[there] * 0.001 - found.depth.numpy()[there]).max() <= 0.000501
    assert np.abs(sigma[there] * 0.0002 - found.sigma.numpy()[there]).max() <= 0.000101
    exact = np.load(numbered / "arrays" / "000001.npz")
    for name in ("depth", "sigma", "score", "source", "gate"):
        assert np.array_equal(exact[name], getattr(found, name).numpy(), equal_nan=name in ("depth", "sigma")), name


def test_the_meta_file_tells_what_the_others_are(room, numbered):
    row = storage.parse_strict_json((numbered / "meta" / "000001.json").read_text())
    about = storage.parse_strict_json((numbered / "complete.json").read_text())
    assert row["unit_m"] == 0.001 and row["sigma_unit_m"] == 0.0002 and row["cutoff_m"] == NEAR
    assert row["method"] == "map" and row["version"] == about["version"] and row["key"] == about["key"]
    assert row["frame"] == 1 and row["hw"] == [120, 160] and set(row["views"]) <= {0, 2} and row["views"]
    assert torch.allclose(torch.tensor(row["K"])[[0, 1], [0, 1]], room[0].camera.f[0]) and row["distortion"] is None
    source = pixels(numbered / "source" / "000001.png")
    counts = {name: (source == k).sum() for k, name in ((0, "none"), (1, "sensor"), (3, "swept"), (5, "filled"))}
    assert row["pixels"] == counts and all(counts.values())
    assert sum(row["no_answer"].values()) == pytest.approx((source == Source.NONE).mean())
    assert set(row["no_answer"]) <= {name.lower() for name in names(Gate).values()} | {"unfit"}
    assert about["codes"]["source"] == {str(k): v for k, v in names(Source).items()}


def test_figure_and_points_are_of_the_first_frame(room, numbered):
    files = [p.relative_to(numbered).as_posix() for k in complete.EXTRA_FILES for p in sorted((numbered / k).glob("*"))]
    assert files == ["figures/000000.png", "points/000000.glb", "points/000000.ply"]
    assert pixels(numbered / "figures" / "000000.png").shape[1] > 1000


def test_a_tum_sequence_stays_one_with_its_own_step_and_stamps(captures, tmp_path):
    out = said(captures / "stamped", tmp_path / "maps", every=2)
    assert "2 frames of 160x120" in out and "0.2 mm, up to 13.1 m" in out
    source, depth, sigma = (
        np.stack([pixels(p) for p in sorted((tmp_path / "maps" / kind).iterdir())])
        for kind in ("source", "depth", "sigma")
    )
    recovered, filled, sensor = (np.isin(source, codes) for codes in ([2, 3], [5], [1]))
    median = np.median(sigma[recovered] / complete.SIGMA_STEPS_PER_DEPTH_STEP / depth[recovered])
    counts = f"recovered {recovered.mean():.1%} (median sigma {median:.1%} of the depth)"
    assert f"{counts}, filled {filled.mean():.1%}, sensor {sensor.mean():.1%}, no answer" in out and filled.any()
    there, back = data.open(captures / "stamped"), data.open(tmp_path / "maps")
    assert back.format == "tum" and torch.equal(back.times, there.times[::2])
    assert torch.equal(back[1].image, there[2].image) and torch.allclose(back.poses.t, there.poses.t[::2], atol=1e-9)
    assert torch.allclose(back.poses.R, there.poses.R[::2], atol=1e-9)
    near = (there[2].depth > 0) & (there[2].depth <= NEAR)
    assert torch.allclose(back[1].depth[near], there[2].depth[near], atol=1e-6)
    assert (back[1].depth > NEAR).any()


def test_a_stray_capture_stays_one_with_confidence_and_video(room, tmp_path):
    pytest.importorskip("av")
    conf = torch.full((1, 60, 80), 2, dtype=torch.uint8)
    frames = [room[i].replace(conf=conf, depth=room[i].depth[:, ::2, ::2]) for i in range(3)]
    writers.write_stray(tmp_path / "capture", frames, codec="libx264")
    assert "2 frames of 80x60" in said(tmp_path / "capture", tmp_path / "maps", max_frames=2, size=80)
    there, back = data.open(tmp_path / "capture"), data.open(tmp_path / "maps")
    assert back.format == "stray" and back.number.tolist() == [0, 1] and len(there) == 3
    assert torch.equal(back[0].image, there[0].image) and torch.equal(back.poses.t, there.poses.t[:2])
    source = pixels(tmp_path / "maps" / "source" / "000000.png")
    assert np.array_equal(back[0].conf[0], np.array([0, 2, 1, 1, 1, 1])[source])
    row = storage.parse_strict_json((tmp_path / "maps" / "meta" / "000000.json").read_text())
    assert torch.allclose(torch.tensor(row["K"])[[0, 1], [0, 1]], resize(there[0].camera, (120, 160), (60, 80)).f[0])


# ------------------------------------------------------------------------------------------------- no step too far


def test_steps_never_clip_and_never_wrap():
    depth = torch.tensor([[0.0004, 0.0006, 1.23449, 65.534, 65.5346, 131.07, torch.inf, torch.nan, 3.0, 3.0]])
    sigma = torch.full_like(depth, 0.01)
    sigma[0, 1], sigma[0, 8], sigma[0, 9] = 1e-9, 13.2, torch.nan
    source = torch.full(depth.shape, Source.SWEPT)
    source[0, 7] = Source.NONE
    steps = export.quantise_depth(depth, sigma, source, 0.001)
    assert steps.depth[0].tolist() == [0, 1, 1234, 65534, 0, 0, 0, 0, 0, 0]
    assert steps.sigma[0].tolist() == [0, 1, 50, 50, 0, 0, 0, 0, 0, 0], "no sigma is 0"
    assert steps.source[0].tolist() == [0, 3, 3, 3, 0, 0, 0, 0, 0, 0]
    assert steps.unfit[0].tolist() == [True, False, False, False, True, True, True, False, True, True]
    with pytest.raises(ValueError, match=r"\(1, 10\), \(1, 10\), \(10,\), expected equal shapes"):
        export.quantise_depth(depth, sigma, source[0], 0.001)


def test_what_does_not_fit_is_silent_counted_and_said(captures, tmp_path):
    out = said(captures / "numbered", tmp_path / "maps", max_frames=1, unit=0.00005)
    row = storage.parse_strict_json((tmp_path / "maps" / "meta" / "000000.json").read_text())
    assert row["no_answer"]["unfit"] > 0.01 and "are beyond it" in out and "up to 3.3 m" in out
    back = data.open(tmp_path / "maps")[0].depth
    assert float(back.max()) <= 3.2768 and (back > NEAR).any()
    assert row["pixels"]["none"] / back.numel() == pytest.approx(sum(row["no_answer"].values()))


def test_png_loses_nothing():
    generator = np.random.default_rng(0)
    for shape, kind in (((7, 5), "uint16"), ((7, 5), "uint8"), ((7, 5, 3), "uint8")):
        values = generator.integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
        assert np.array_equal(np.array(Image.open(io.BytesIO(export.encode_png(values)))), values)


def test_faces_join_neighbours_of_one_surface_alone():
    depth = np.array([[1.0, 1.01, 2.0], [1.0, 1.01, 2.0], [1.0, 0.0, 2.0]])
    assert sorted(map(sorted, export.mesh_depth_map(depth).tolist())) == [[0, 1, 3], [1, 3, 4], [3, 4, 6]]
    flat = export.mesh_depth_map(np.ones((3, 4)))
    assert len(flat) == 2 * 2 * 3 and {tuple(sorted(f)) for f in flat.tolist()} >= {(0, 1, 4), (1, 4, 5)}


# --------------------------------------------------------------------------------------------------- going on, refusing


def test_said_again_it_makes_what_is_missing_and_no_more(captures, numbered, monkeypatch):
    asked = []
    whole = complete.complete_depth
    monkeypatch.setattr(complete, "complete_depth", lambda *a, **k: asked.append(1) or whole(*a, **k))
    before = stamps(numbered)
    more = {"arrays": True, "points": True, "figures": True}
    assert "3 frames (3 left untouched)" in said(captures / "numbered", numbered, max_frames=3, **more) and not asked
    closing = {"K.txt", "meta.json", "poses.txt"}
    after = stamps(numbered)
    assert before.keys() == after.keys() and all(after[k] == before[k] for k in before if k not in closing)
    (numbered / "depth" / "000002.png").unlink()
    assert "4 frames (2 left untouched)" in said(captures / "numbered", numbered, **more) and len(asked) == 2
    assert len(data.open(numbered)) == 4 and (numbered / "depth" / "000002.png").is_file()


def test_ctrl_c_leaves_whole_frames_and_a_recording_of_them(captures, tmp_path):
    def stopped(items, *_):
        yield items[0]
        raise KeyboardInterrupt

    (tmp_path / ".complete.json.abc.tmp").write_bytes(b"half")  # killed while the first file was written
    with pytest.raises(
        KeyboardInterrupt, match=r"1 of 4 frames in .* are complete and kept; run the same command again"
    ):
        said(captures / "numbered", tmp_path, stopped)
    assert len(data.open(tmp_path)) == 1
    before = stamps(tmp_path)
    assert "(1 left untouched)" in said(captures / "numbered", tmp_path, max_frames=2)
    assert stamps(tmp_path)["depth/000000.png"] == before["depth/000000.png"] and len(data.open(tmp_path)) == 2


def test_a_broken_frame_ends_it_and_the_others_stay(captures, tmp_path):
    shutil.copytree(captures / "numbered", tmp_path / "set")
    broken = tmp_path / "set" / "images" / "00003.png"
    broken.write_bytes(broken.read_bytes()[:200])
    with pytest.raises(data.FormatError, match=r"00003\.png"):
        said(tmp_path / "set", tmp_path / "maps")
    assert len(data.open(tmp_path / "maps")) == 2


# --------------------------------------------------------------------------------------------- alone, several, defaults


def test_a_frame_alone_gets_the_sensor_and_maps_without_poses_are_maps_alone(room, tmp_path):
    one = Recording("one", "made", room.load, room.number[:1])
    out = said([one], tmp_path)
    assert "1 frame of 160x120" in out and "maps only" in out
    source = pixels(tmp_path / "source" / "000000.png")
    depth = room[0].depth[0].numpy()
    assert np.array_equal(source == Source.SENSOR, (depth > 0) & (depth <= NEAR))
    assert {0, 1} <= set(np.unique(source)) <= {0, 1, Source.FILLED}
    assert not (tmp_path / "poses.txt").exists() and not (tmp_path / "images").exists()
    row = storage.parse_strict_json((tmp_path / "meta" / "000000.json").read_text())
    assert row["views"] == [] and row["T_world_from_cam"] is None and row["time"] is None


def test_without_poses_the_meta_files_state_the_motions_that_were_solved(room, tmp_path):
    said([Recording("three", "made", room.load, room.number[:3])], tmp_path)
    for i in range(3):
        row = storage.parse_strict_json((tmp_path / "meta" / f"{i:06d}.json").read_text())
        assert row["motions"] and {*row["motions"]} <= {*map(str, row["views"])}
        for number, matrix in row["motions"].items():
            k = int(number)
            true = se3.to_matrix(se3.relative(room.poses[i : i + 1], room.poses[k : k + 1]))[0]
            torch.testing.assert_close(torch.tensor(matrix, dtype=torch.float64), true, atol=0.02, rtol=0)


def test_several_scenes_have_a_folder_each_and_a_name_once(room, tmp_path):
    made = [Recording(name, "made", room.load, room.number[:1], poses=room.poses[:1]) for name in ("a", "b/c")]
    said(made, tmp_path)
    assert data.open(tmp_path / "a")[0].depth.any() and data.open(tmp_path / "b" / "c")[0].depth.any()
    with pytest.raises(ValueError, match="two scenes named a"):
        said([made[0], made[0]], tmp_path)


def test_the_sweeps_options_have_the_functions_defaults():
    defaults = {k: p.default for k, p in signature(completion.complete_depth).parameters.items()}
    settings = composed()
    assert {k: settings[k] for k in dense.DENSE_OPTIONS} == {k: defaults[k] for k in dense.DENSE_OPTIONS}


def test_a_figure_of_silence_is_a_figure(tmp_path):
    nothing = np.zeros((6, 8))
    draw_completed(tmp_path / "empty.png", np.zeros((1, 12, 16)), nothing, nothing, nothing, title="part $1$")
    assert pixels(tmp_path / "empty.png").size
    assert result_files.describe_difference({"config": {"a": 1}}, {"config": {"a": 2}}) == "a 1 there, 2 here"


def test_budget_files_hold_the_largest_cause_and_sigma_follows_a_stated_sensor(captures, tmp_path):
    out = tmp_path / "maps"
    said(captures / "numbered", out, max_frames=1, budget=True, sensor=[0.02, 0.0, 0.0])
    causes, source, sigma = (pixels(out / kind / "000000.png") for kind in ("budget", "source", "sigma"))
    sensed = source == Source.SENSOR
    assert sensed.any() and (causes[sensed] == 3).all(), "of a return all is the reference"
    assert ((causes > 0) == (source > 0)).all()
    row = json.loads((out / "meta" / "000000.json").read_text())
    assert np.abs(sigma[sensed] * row["sigma_unit_m"] - 0.02).max() < row["sigma_unit_m"]
    assert list(row["sigma_shares"]) == ["track", "pose", "reference", "lens", "model"]
    assert sum(row["sigma_shares"].values()) == pytest.approx(1) and min(row["sigma_shares"].values()) >= 0


LITTLE = ["method=map", "method.n=256", "planes=32", "steps=[1]", "mesh=false", "threads=1"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three views of the room, a sensor that ends at two metres."""
    whole = SyntheticRoom(hw=(120, 160), n_frames=22, lidar="exact", supersample=1, image_noise=0.0)
    path = tmp_path_factory.mktemp("captures") / "kitchen"
    writers.write_counted_frames(path, [range_split(whole[k], 2.0) for k in (0, 7, 14)])
    return path


@pytest.fixture(scope="module")
def made(capture, tmp_path_factory):
    """What the command makes of it."""
    out = tmp_path_factory.mktemp("out") / "room"
    assert main([str(capture), f"out={out}", *LITTLE]) == 0
    return out


def test_one_word_makes_maps_a_map_a_page_and_a_picture(made):
    assert {
        "depth",
        "sigma",
        "source",
        "meta",
        "previews",
        "overview.png",
        "preview.mp4",
        "map.ply",
        "map.glb",
        "view.html",
    } <= {p.name for p in made.iterdir()}
    rows = [json.loads(p.read_text()) for p in (made / "meta").iterdir()]
    assert len(rows) == 3 and all(row["pixels"]["swept"] > 1000 for row in rows)
    assert b"comment up " in (made / "map.ply").read_bytes()[:2000]
    width, height = Image.open(made / "overview.png").size
    assert width >= 1600 and height > 600, "a row for each of three frames"


def test_what_the_command_writes_is_stored(made):
    stored_outputs.check("recover", made.parent, folder=made)


def test_every_frame_has_a_preview_and_all_frames_are_in_the_video(made):
    names = sorted(p.stem for p in (made / "meta").iterdir())
    previews = sorted((made / "previews").iterdir())
    assert [p.name for p in previews] == [f"{name}.jpg" for name in names]
    for path in previews:
        pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
        assert pixels.shape[1] > 900
        assert (pixels.max(-1) - pixels.min(-1) > 100).mean() > 0.1, "coloured depth"
    with av.open(str(made / "preview.mp4")) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(shown) == 3 and shown[0].shape[1] > 3 * 160
    thirds = np.array_split(shown[1][80:180], 3, axis=1)
    blank = np.array(colours.parse_rgb(colours.PICTURE))
    sensor, completed = ((np.abs(third - blank).max(-1) < 12).mean() for third in thirds[1:])
    assert completed < sensor - 0.05, "blank where the sensor has no depth, less where it is completed"


def test_the_page_begins_with_the_numbers_and_the_picture(made):
    page = (made / "view.html").read_text(encoding="utf-8")
    rows = [json.loads(p.read_text()) for p in (made / "meta").iterdir()]
    pixels = sum(count_pixels(row)["recovered"] for row in rows) / len(rows)
    opening = page[page.index('<section id="opening"') : page.index("<main>")]
    assert f"<dd>{pixels:,.0f}</dd>" in opening and "Recovered, median sigma / depth" in opening
    poster = page[page.index('<section id="poster"') :]
    assert page.index("</main>") < page.index('<section id="poster"'), "the map comes first"
    assert base64.b64encode((made / "overview.png").read_bytes()).decode() in poster
    assert "Recovered " in opening and "Most frequent reasons for no answer: " in opening and "no_track" not in opening
    assert "Kitchen, frames 0, 1, 2: picture, sensor depth" in poster and "<h1>Kitchen · dhtorch</h1>" in page


@pytest.mark.slow
def test_it_says_what_it_is_what_was_recovered_and_what_to_do_next(capture, made, tmp_path, capsys):
    before = {p: p.stat().st_mtime_ns for p in (made / "meta").iterdir()}
    assert main(["recover", str(capture), f"out={made}", *LITTLE]) == 0
    what, found, then, wrote = capsys.readouterr().out.strip().splitlines()
    assert what.startswith("kitchen: a frames_dir capture, 3 frames of 160x120; the sensor has depth at")
    assert found.startswith("Recovered ") and " pixels per frame from other views, at " in found
    assert then.startswith("Next: ") and str(made) in wrote
    assert {p: p.stat().st_mtime_ns for p in (made / "meta").iterdir()} == before, "complete frames are kept"
    command = then.partition("on your capture: dhtorch ")[2].rstrip(".")
    assert main([*command.split(), "method=map", "method.n=64", f"hydra.run.dir={tmp_path / 'job'}"]) == 0, "as printed"


@pytest.mark.slow
def test_the_beginning_is_made_where_time_is_short_and_said_again_it_goes_on(capture, made, tmp_path, capsys):
    """Interrupted after each frame and resumed as printed, or in one go: the same files."""
    words, out = [str(capture), f"out={tmp_path / 'x'}", *LITTLE], tmp_path / "x"
    assert main([*words, "minutes=1e-6"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("Next: "))
    assert "; 2 of 3 frames left at the time limit, to complete them: dhtorch " in line
    assert [p.stem for p in (out / "meta").iterdir()] == ["000001"], "the middle comes first"
    assert main([*words, "minutes=1e-6"]) == 0
    assert main(shlex.split(line.rpartition(": dhtorch ")[2])) == 0, "as printed"
    for kind in ("depth/*", "sigma/*", "source/*", "previews/*", "overview.png", "preview.mp4"):
        for path in made.glob(kind):
            assert (out / path.relative_to(made)).read_bytes() == path.read_bytes(), path.name


def test_a_frame_that_cannot_be_read_is_left_out_and_named(capture, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(capture, broken)
    picture = broken / "images/00001.png"
    picture.write_bytes(picture.read_bytes()[:100])
    assert main([str(broken), f"out={tmp_path / 'out'}", *LITTLE, "steps=[1,2]"]) == 0
    said = capsys.readouterr().out
    assert "1 frame of broken could not be read" in said and picture.name in said
    assert len(list((tmp_path / "out/meta").iterdir())) == 2


@pytest.mark.slow
def test_one_capture_that_cannot_be_opened_does_not_stop_the_others(capture, tmp_path, capsys):
    room = SyntheticRoom(hw=(48, 64), n_frames=3)
    writers.write_stray(tmp_path / "both" / "alone", list(room), video=False)
    shutil.copytree(capture, tmp_path / "both" / "kitchen")
    assert main([str(tmp_path / "both"), f"out={tmp_path / 'out'}", "minutes=0.01", *LITTLE]) == 0
    said = capsys.readouterr().out
    assert "kitchen" in said and "alone: depth without images" in said and (tmp_path / "out/overview.png").is_file()


FINDING = Finding("poses", "poses and depth contradict each other", "data.pose_convention=opengl")
ASSUMED = "depth unit assumed: 1/1000 m (data.depth_unit= sets it)"


def recording(root, name="box", poses=True, n=3):
    frames = box.walk(n, hw=(6, 8))
    return Recording(
        name,
        "made",
        frames.__getitem__,
        torch.arange(n),
        root=root,
        poses=poses_of(frames) if poses else None,
        report=("a frame was left out",),
        depth_unit=DepthUnit(0.001),
    )


@pytest.fixture
def checked(monkeypatch):
    """Names of the recordings that were checked; every check refutes the poses, if there are any."""
    names = []

    def check(recording, frames=None, *, seed=0):
        names.append(recording.name)
        findings = () if recording.poses is None else (FINDING,)
        return CaptureCheck(replace(recording, poses=None), ASSUMED, findings)

    monkeypatch.setattr(capture_checks, "check_capture", check)
    return names


@pytest.mark.parametrize(
    ("make", "names", "refuted", "near"),
    [
        (recording, ["box"], [True], None),
        (lambda root: Scene(recording(root), near=2.0), ["box"], [True], 2.0),
        (lambda root: [recording(root, f"{k}", poses=k != 1) for k in range(14)], [f"{k}" for k in range(12)], [True] * 12 + [False] * 2, None),
        (lambda root: Scenes([recording(root, name) for name in "ab"], lambda r: Scene(r, near=2.0)), ["a", "b"], [True] * 2, 2.0),
        (lambda _: Scene(recording(None)), [], [False], None),
    ],
)  # fmt: skip
def test_recordings_are_checked_up_to_a_dozen_and_their_report_has_all_lines(
    checked, tmp_path, capsys, make, names, refuted, near
):
    """Those that are not from disk are left alone; notes of a scene are kept."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        got = check_data(make(tmp_path))
    scenes = [got] if isinstance(got, Scene) else list(got)
    assert checked == names and [scene.recording.poses is None for scene in scenes] == refuted
    assert {scene.near for scene in scenes} == {near}
    lines, found = (ASSUMED, "a frame was left out"), [name for name in names if name != "1"]  # that has no poses
    assert [str(each.message) for each in caught] == [f"{name}: {FINDING}" for name in found]
    for scene in scenes[: len(names)]:
        assert scene.recording.report == (*lines, *[str(FINDING)] * (scene.name in found))
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines() == [f"{name}: {line}" for name in names for line in lines]
    assert all(check_data(other) is other for other in (None, "text", 3, [1, 2], {"a": 1}))


@pytest.mark.parametrize("level", ["quiet", "normal"])
def test_quiet_prints_no_notes_but_warns(tmp_path, capsys, monkeypatch, level):
    monkeypatch.setenv(console._VERBOSITY_VARIABLE, level)
    with pytest.warns(UserWarning, match="^name: poses"):
        print_check("name", CaptureCheck(recording(tmp_path), ASSUMED, (FINDING,)))
    notes = f"name: {ASSUMED}\nname: a frame was left out\n"
    assert capsys.readouterr() == ("", "" if level == "quiet" else notes)


def test_a_lazy_set_is_judged_by_its_first_recording(checked, tmp_path):
    opened = []

    def make(k):
        opened.append(k)
        return recording(tmp_path, f"box{k}")

    names = [f"box{k}" for k in range(1000)]
    with pytest.warns(UserWarning, match="contradict") as caught:
        scenes = check_data(Recordings(names, make))
    assert len(caught) == 1 and checked == ["box0"] and set(opened) == {0}, "the others stay unopened"
    assert isinstance(scenes, Scenes) and len(scenes) == 1000
    assert scenes[0].recording.poses is None and scenes[777].recording.poses is None
    assert scenes[777].name == "box777"
    assert scenes[777].recording.report == ("a frame was left out", ASSUMED, str(FINDING))


def test_a_sound_lazy_set_keeps_its_poses_and_notes(monkeypatch, tmp_path):
    monkeypatch.setattr(capture_checks, "check_capture", CaptureCheck)
    whole = Scenes(Recordings(["a", "b"], lambda k: recording(tmp_path, "ab"[k])), lambda r: Scene(r, near=2.0))
    scenes = check_data(whole)
    assert scenes[1].recording.poses is not None and scenes[1].near == 2.0


# ------------------------------------------------------------------------------------------------------------- commands


@pytest.fixture(scope="module")
def refuted(tmp_path_factory):
    """A capture whose poses have OpenGL camera axes."""
    frames = [textured_box.near(textured_box.view(textured_box.at(k))) for k in range(8)]
    root = tmp_path_factory.mktemp("captures") / "walk"
    opengl = state_poses(poses_of(frames), parse_pose_convention("opengl"))
    writers.write_counted_frames(root, with_poses(frames, opengl))
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "unit", "warned"),
    [
        ({}, ASSUMED, True),
        ({"pose_convention": "opengl", "depth_unit": "mm"}, "depth unit: 1/1000 m (option depth_unit)", False),
    ],
)
def test_inspect_shows_unit_agreement_and_findings(refuted, options, unit, warned):
    (survey,) = inspect.survey_capture(inspect.FoundCapture(refuted, "recording", "frames_dir", "", options=options))
    facts = dict(survey.facts)
    assert facts["unit"] == unit and "% without poses" in facts["depth and poses"]
    assert "agree to" in facts["depth and poses"]
    found = [text for text in survey.warnings if "OpenGL camera axes" in text]
    assert [text.endswith("(remedy: data.pose_convention=opengl)") for text in found] == [True] * warned


@pytest.mark.slow
def test_a_refuted_capture_is_joined_by_the_motion_of_near_returns(refuted, tmp_path, command):
    little = ["method=map", "method.n=512", "planes=16", "steps=[2]", "mesh=false", "threads=1"]
    with pytest.warns(UserWarning, match="these look like OpenGL camera axes"):
        code, out, err = command(str(refuted), f"out={tmp_path / 'out'}", *little)
    assert code == 0, err
    assert f"walk: {ASSUMED}" in err
    assert "The map is joined by the motion that near returns give (" in out and "the stated poses are refuted" in out
    page = (tmp_path / "out" / "view.html").read_text(encoding="utf-8")
    assert "Depth unit assumed: 1/1000 m" in page and "Warning: poses and depth contradict each other" in page
    rows = [json.loads(file.read_text()) for file in (tmp_path / "out" / "meta").iterdir()]
    motions = [row["motions"] for row in rows]
    assert any(motions) and all(np.shape(matrix) == (4, 4) for each in motions for matrix in each.values())


# ------------------------------------------------------------------------------------------------------ chained motions


def recovered(rows, poses=None, frames=(2, 0, 4)):
    """Completed frames of a recording of 6, numbered from 10, with rows by frame."""
    task = SimpleNamespace(
        recording=Recording("box", "made", lambda i: None, torch.arange(10, 16), poses=poses),
        done={f"{i:06d}": rows[i] for i in frames},
        name=lambda i: f"{i:06d}",
    )
    return process_capture._RecoveredFrames(task, list(frames), {}, 0)


def motion(true, i, j):
    """Matrix (4, 4) of the pose of view j relative to frame i, as a row has it."""
    return se3.to_matrix(se3.relative(true[i : i + 1], true[j : j + 1]))[0].tolist()


def test_motions_are_chained_from_the_first_frame():
    true = poses_of(box.walk(6, hw=(2, 2)))
    rows = {2: {"motions": {"11": motion(true, 2, 1)}}, 0: {"motions": {"11": motion(true, 0, 1)}}, 4: {"motions": {}}}
    placed = process_capture._place_frames(recovered(rows)).poses
    assert placed.t.isfinite().all(-1).tolist() == [True, True, True, False, False, False]
    for k in (0, 1):
        got = se3.to_matrix(se3.relative(placed[2:3], placed[k : k + 1]))
        torch.testing.assert_close(got, se3.to_matrix(se3.relative(true[2:3], true[k : k + 1])), atol=1e-9, rtol=0)
    torch.testing.assert_close(se3.to_matrix(placed[2:3])[0], torch.eye(4, dtype=torch.float64))


def test_usable_poses_are_kept_and_the_page_states_what_joins_the_map():
    true = poses_of(box.walk(6, hw=(2, 2)))
    whole = recovered({2: {}, 0: {}, 4: {}}, poses=true)
    assert process_capture._place_frames(whole) is whole.task.recording
    none = replace(whole.task.recording, poses=None)
    said = "The map is joined by the motion that near returns give (6 frames): "
    for check, stated, lines in (
        (CaptureCheck(whole.task.recording), whole.task.recording, []),
        (CaptureCheck(none), none, [f"{said}the capture has no poses."]),
        (CaptureCheck(none, findings=(FINDING,)), none, [f"{said}the stated poses are refuted."]),
    ):
        assert process_capture.describe_placing(check, stated, replace(none, poses=true)) == lines


def scores(stated):
    return ReadingScores(stated, 0.5, PoseReading(), stated)


#: Stated distance in m and turn in rad between neighbours, check of the poses → what is printed of the reason.
MOTIONS = {
    "turned": (
        0.04,
        0.3,
        PoseCheck(scores(0.005), scores(0.7), 1.0, 4),
        "and turn by 17 degrees; moving sideways by a",
    ),
    "still": (
        0.0,
        0.0,
        None,
        "move by 0 m between views, 0.0% of the median depth, and turn by 0 degrees; moving side",
    ),
    "noise": (
        0.2,
        0.1,
        PoseCheck(scores(0.14), scores(0.7), 1.0, 4),
        "but poses and depth disagree by 14.0% of the dept",
    ),
    "dark": (0.2, 0.1, PoseCheck(scores(0.003), None, 1.0, 4), "but too few near returns were tracked; slower motion"),
    "resized": (
        0.2,
        0.1,
        PoseCheck(scores(0.003), scores(0.38), 1.0, 4),
        "do not fit each other (near returns miss thei",
    ),
    "unknown": (
        0.2,
        0.1,
        PoseCheck(scores(0.003), scores(0.2), 1.0, 4),
        "which the near returns do not show; more textu",
    ),
    "unchecked": (0.2, 0.1, None, "which the near returns do not show; more texture, and returns nearby, would help"),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_no_translation_is_explained_by_what_the_stated_poses_and_the_check_show(name, tmp_path, monkeypatch):
    step, turn, check, said = MOTIONS[name]
    xi = torch.zeros(4, 6, dtype=torch.float64)
    xi[:, 3], xi[:, 1] = step * torch.arange(4), turn * torch.arange(4)
    made = replace(
        recording(tmp_path, n=4), poses=Pose(se3.exp(xi).R, xi[:, 3:]), number=torch.tensor([10, 20, 30, 40])
    )
    row = {"pixels": {"sensor": 80, "none": 20}, "no_answer": {"parallax": 0.01, "no_baseline": 0.19}}
    done = {"0": {**row, "views": [20]}, "1": {**row, "views": [10, 20]}, "2": {**row, "views": []}}
    task = SimpleNamespace(name=str, done=done, recording=made, scene=SimpleNamespace(name="box"))
    maps = {"depth": np.full((4, 4), 2.0), "sigma": np.full((4, 4), 0.1)}, np.full((4, 4), int(Source.SENSOR))
    monkeypatch.setattr(complete, "read_completed_maps", lambda *_: maps)
    stats = complete.measure_recovery(task, [0, 1, 2])
    _, sentence = process_capture.describe_recovery(task, stats, (4, 4), CaptureCheck(made, poses=check))
    moved = (
        f"Nothing was recovered: the stated poses move by {step:g} m between views, {step / 2:.1%} of the median depth"
    )
    assert sentence.startswith(moved) and said in sentence and "only turned" not in sentence
    none = replace(made, poses=None)
    stats = complete.measure_recovery(SimpleNamespace(**{**vars(task), "recording": none}), [0, 1, 2])
    _, sentence = process_capture.describe_recovery(task, stats, (4, 4), CaptureCheck(none))
    assert stats.motion is None and "recovered: near returns show no translation of the camera; moving it" in sentence
