"""``dhtorch PATH``: a capture of one's own, or one sentence that says why nothing comes of it."""

import base64
import json
import shlex
import shutil
from dataclasses import replace
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image
from support import box_scene as box
from support import stored_outputs, textured_box, writers
from support.stated_poses import poses_of, state_poses, with_poses

from dhtorch.cli import capture_checks, complete, inspect, process_capture
from dhtorch.cli.capture_checks import check_data, check_scene, print_check
from dhtorch.cli.complete import count_pixels
from dhtorch.cli.run import main
from dhtorch.codes import Source
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, Scenes
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import se3
from dhtorch.metrics.holdout import range_split
from dhtorch.records import Pose
from dhtorch.runtime import console
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.validation.capture_check import CaptureCheck, Finding
from dhtorch.validation.pose_check import PoseCheck, PoseReading, ReadingScores
from dhtorch.viz.plots import colours

SMALL = ["method=map", "method.n=256", "planes=32", "steps=[1]", "mesh=false", "threads=1"]


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
    assert main([str(capture), f"out={out}", *SMALL]) == 0
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
    assert main(["recover", str(capture), f"out={made}", *SMALL]) == 0
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
    words, out = [str(capture), f"out={tmp_path / 'x'}", *SMALL], tmp_path / "x"
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
    assert main([str(broken), f"out={tmp_path / 'out'}", *SMALL, "steps=[1,2]"]) == 0
    said = capsys.readouterr().out
    assert "1 frame of broken could not be read" in said and picture.name in said
    assert len(list((tmp_path / "out/meta").iterdir())) == 2


@pytest.mark.slow
def test_one_capture_that_cannot_be_opened_does_not_stop_the_others(capture, tmp_path, capsys):
    room = SyntheticRoom(hw=(48, 64), n_frames=3)
    writers.write_stray(tmp_path / "both" / "alone", list(room), video=False)
    shutil.copytree(capture, tmp_path / "both" / "kitchen")
    assert main([str(tmp_path / "both"), f"out={tmp_path / 'out'}", "minutes=0.01", *SMALL]) == 0
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


def test_a_recording_is_checked_and_its_report_has_all_lines(checked, tmp_path, capsys):
    with pytest.warns(UserWarning, match=r"^box: poses and depth contradict each other \(remedy: data\.pose_con"):
        scene = check_data(recording(tmp_path))
    assert isinstance(scene, Scene) and scene.recording.poses is None
    assert scene.recording.report == (ASSUMED, "a frame was left out", str(FINDING))
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines() == [f"box: {ASSUMED}", "box: a frame was left out"]


def test_notes_of_a_scene_are_kept_and_recordings_that_are_not_from_disk_left_alone(checked, tmp_path):
    with pytest.warns(UserWarning, match="contradict"):
        scene = check_data(Scene(recording(tmp_path), near=1.5, gap=4))
    assert (scene.near, scene.gap, scene.recording.poses) == (1.5, 4, None)
    checked.clear()
    scene = Scene(recording(None))
    assert check_scene(scene) is scene and checked == []


@pytest.mark.parametrize("level", ["quiet", "normal"])
def test_quiet_prints_no_notes_but_warns(tmp_path, capsys, monkeypatch, level):
    monkeypatch.setenv(console._VERBOSITY_VARIABLE, level)
    with pytest.warns(UserWarning, match="^name: poses"):
        print_check("name", CaptureCheck(recording(tmp_path), ASSUMED, (FINDING,)))
    notes = f"name: {ASSUMED}\nname: a frame was left out\n"
    assert capsys.readouterr() == ("", "" if level == "quiet" else notes)


def test_a_list_is_checked_up_to_its_first_dozen(checked, tmp_path):
    scenes = [recording(tmp_path, f"box{k}", poses=k != 1) for k in range(14)]
    with pytest.warns(UserWarning, match="contradict") as caught:
        got = check_data(scenes)
    assert checked == [f"box{k}" for k in range(12)] and len(caught) == 11
    assert [scene.name for scene in got] == [each.name for each in scenes]
    assert [scene.recording.poses is None for scene in got] == [True] * 12 + [False] * 2


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


def test_an_opened_capture_is_checked_recording_by_recording(checked, tmp_path):
    """Scenes of a few opened recordings, as of a car with several cameras, keep all lines for the files."""
    scenes = check_data(Scenes([recording(tmp_path, name, poses=False) for name in "ab"], lambda r: Scene(r, near=2.0)))
    assert checked == ["a", "b"] and [scene.near for scene in scenes] == [2.0, 2.0]
    assert [scene.recording.report for scene in scenes] == [(ASSUMED, "a frame was left out")] * 2


def test_a_sound_lazy_set_keeps_its_poses_and_notes(monkeypatch, tmp_path):
    monkeypatch.setattr(capture_checks, "check_capture", CaptureCheck)
    whole = Scenes(Recordings(["a", "b"], lambda k: recording(tmp_path, "ab"[k])), lambda r: Scene(r, near=2.0))
    scenes = check_data(whole)
    assert scenes[1].recording.poses is not None and scenes[1].near == 2.0


@pytest.mark.parametrize("other", [None, "text", 3, [1, 2], {"a": 1}])
def test_other_data_are_returned_as_they_are(other):
    assert check_data(other) is other


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
    lines = process_capture.describe_check(CaptureCheck(none, ASSUMED, (FINDING,)))
    assert lines == [f"D{ASSUMED[1:]}.", f"Warning: {FINDING}."]
    assert process_capture.describe_check(CaptureCheck(none)) == []


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
