"""Every command checks its capture first: notes and warnings are printed, refuted poses are removed, maps still joined."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support import box_scene as box
from support import textured_box, writers
from support.stated_poses import poses_of, state_poses, with_poses

from dhtorch.cli import capture_checks, inspect, process_capture, recover_page
from dhtorch.cli.capture_checks import check_data, check_scene, print_check
from dhtorch.codes import Source
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, Scenes
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import se3
from dhtorch.records import Pose
from dhtorch.runtime import console
from dhtorch.validation.capture_check import CaptureCheck, Finding
from dhtorch.validation.pose_check import PoseCheck, PoseReading, ReadingScores

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
    return process_capture.RecoveredFrames(task, list(frames), {}, 0)


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
        assert recover_page.describe_placing(check, stated, replace(none, poses=true)) == lines
    lines = recover_page.describe_check(CaptureCheck(none, ASSUMED, (FINDING,)))
    assert lines == [f"D{ASSUMED[1:]}.", f"Warning: {FINDING}."]
    assert recover_page.describe_check(CaptureCheck(none)) == []


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
    monkeypatch.setattr(recover_page.completed, "read_completed_maps", lambda *_: maps)
    stats = recover_page.measure_recovery(task, [0, 1, 2])
    _, sentence = recover_page.describe_recovery(task, stats, (4, 4), CaptureCheck(made, poses=check))
    moved = (
        f"Nothing was recovered: the stated poses move by {step:g} m between views, {step / 2:.1%} of the median depth"
    )
    assert sentence.startswith(moved) and said in sentence and "only turned" not in sentence
    none = replace(made, poses=None)
    stats = recover_page.measure_recovery(SimpleNamespace(**{**vars(task), "recording": none}), [0, 1, 2])
    _, sentence = recover_page.describe_recovery(task, stats, (4, 4), CaptureCheck(none))
    assert stats.motion is None and "recovered: near returns show no translation of the camera; moving it" in sentence
