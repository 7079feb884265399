"""``dhtorch validate``, ``align``, ``pin`` and ``scale``: files, limits, exit codes; maps that lie beside a recording."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support import room_models as made
from support import stored_outputs, writers
from support.byte_damage import change_middle, overwrite
from support.rooms import moved_camera_capture
from support.sample_dicts import frames
from torch.utils.data import DataLoader

from dhtorch import data
from dhtorch.cli import run
from dhtorch.codes import State
from dhtorch.data.depth_maps import open_depth_maps
from dhtorch.data.io import decode
from dhtorch.experiments.compare import validate_study
from dhtorch.experiments.protocol import Settings
from dhtorch.export import encode_png
from dhtorch.measure import read_model
from dhtorch.pipeline.presets import AUTO
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import SampleError, ValidateDepth

ROOM = ["data=synthetic", "data.hw=[96,128]", "data.depth_hw=[96,128]", "data.supersample=1", "data.n_frames=6"]


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=6, hw=(96, 128), depth_hw=(96, 128), supersample=1)


@pytest.fixture
def maps(tmp_path, room):
    """Function that writes a map of every frame of the room, made from its true depth by a function: metres -> map."""

    def write(change=lambda z: z, n=6):
        for k in range(n):
            np.save(tmp_path / f"depth_{k:04d}.npy", change(room.truth(k)["depth"][0].numpy()))
        return tmp_path

    return write


def image(frame):
    return encode_png(frame.image[0].permute(1, 2, 0).numpy())


# ------------------------------------------------------------------------------------------------------------ validate


def validated(out, *words):
    little = ["method.n=256", "size=96", "window=0", "max_frames=2", "every=3"]
    code = run.main(["validate", *ROOM, *little, f"output={out}", *words])
    return code, json.loads((out / "validate.json").read_text()), (out / "validate.html").read_text()


def test_files_are_written_and_limits_decide_the_exit_code(tmp_path, maps, capsys):
    out = tmp_path / "out"
    code, found, page = validated(out, f"depth={maps()}", "depth_unit=mm", 'fail_on="scale>0.5,unknown>1"')
    assert code == run.EXIT_SOME_FAILED, "metres read as millimetres"
    stored_outputs.check("validate", tmp_path, printed=capsys.readouterr().out, folder=out)
    assert found["whole"]["limited"]["scale"] == pytest.approx(0.999, abs=0.002)
    assert [row["frame"] for row in found["frames"]] == [0, 3] and len(found["exceeded"]) == 1
    assert page.count("data:image/png;base64,") == 2 and "Exceeded: scale" in page
    code, found, page = validated(out, f"depth={tmp_path}", 'fail_on="scale>0.5"', "pictures=0", "views=false")
    assert code == run.EXIT_DONE and found["exceeded"] == [] and "data:image" not in page


@pytest.mark.slow
def test_a_single_frame_exceeds_a_limit_by_its_bound_alone(tmp_path, maps):
    words = [f"depth={maps(lambda z: 1.1 * z)}", "views=false", "max_frames=1"]
    code, found, _ = validated(tmp_path / "out", *words, 'fail_on="scale>0.05,wrong>0.9"')
    scale = found["frames"][0]["scale"]
    assert code == run.EXIT_SOME_FAILED and found["intrinsics_guessed"] is None
    assert found["whole"]["limited"]["scale"] == pytest.approx(scale["low"] - 1)
    assert scale["low"] - 1 < 0.099 < scale["value"] - 1 + 0.01
    assert validated(tmp_path / "out", *words, 'fail_on="scale>0.097"')[0] == run.EXIT_DONE, "its interval is not more"


@pytest.mark.slow
def test_maps_that_are_cut_are_named(tmp_path, maps):
    words = [f"depth={maps(lambda z: np.minimum(z, np.float32(2.55)))}", "window=6", "every=2", "max_frames=3"]
    code, found, page = validated(tmp_path / "out", *words, "method.n=512")
    assert code == run.EXIT_DONE and "2.55" in page and found["whole"]["clip_depth"] == pytest.approx(2.55)
    assert [row["clip_depth"] for row in found["frames"]] == pytest.approx([2.55] * 3)
    assert [(row["cause"], row["kind"]) for row in found["windows"]] == [("cut at 2.55 m", "cut")]


@pytest.mark.parametrize("has_intrinsics", [False, True])
def test_a_guessed_camera_is_stated_on_the_page_and_one_frame_is_one(tmp_path, room, has_intrinsics):
    capture, out = tmp_path / "capture", tmp_path / "out"
    writers.write_counted_frames(capture, [room[0], room[3]])
    if not has_intrinsics:
        (capture / "K.txt").unlink()
    words = ["data=frames_dir", f"data.root={capture}", *([] if has_intrinsics else ["data.fov=60"])]
    little = ["method.n=256", "size=96", "window=0", "max_frames=1", f"output={out}"]
    assert run.main(["validate", *words, *little]) == run.EXIT_DONE
    page, guessed = (out / "validate.html").read_text(), json.loads((out / "validate.json").read_text())
    assert "<p>Depth unit assumed: 1/1000 m (data.depth_unit= sets it)." in page
    assert "capture: 1 frame: " in page and "checked, of depth" in page
    assert ("<p>Intrinsics are a guess from a field of view of 60°" in page) == (not has_intrinsics)
    assert (guessed["intrinsics_guessed"] or "60°").count("60°") == 1


# ------------------------------------------------------------------------------------------------- maps of a recording


def folder_of(root, names, hw=(6, 8)):
    """A folder of maps, each of the depth of its place in the list, 1 m first."""
    root.mkdir()
    for k, name in enumerate(names):
        np.save(root / f"{name}.npy", np.full(hw, 1.0 + k, np.float32))
    return root


@pytest.mark.parametrize(
    ("names", "depths", "by", "notes"),
    [
        (["depth_3", "depth_1"], [None, 2.0, None, 1.0, None, None], "number",
         ["warning: 2 maps numbered 1 to 3 for 6 frames numbered 0 to 5", "4 of 6 frames have no map.", "unit assumed: 1 m"]),
        (range(11), [1, 2, 3, 4, 5, 6], "number", ["maps"]),
        ([f"{95 + k}" for k in range(6)], [1, 2, 3, 4, 5, 6], "order", ["in their order", "maps"]),
        ("abcdef", [1, 2, 3, 4, 5, 6], "order", ["", ""]),
    ],
)  # fmt: skip
def test_maps_are_matched_by_number_else_in_order(tmp_path, room, names, depths, by, notes):
    maps = open_depth_maps(folder_of(tmp_path / "maps", names), room)
    assert [None if maps[i] is None else float(maps[i][0, 0, 0]) for i in range(6)] == depths
    assert maps.frames == [i for i, z in enumerate(depths) if z is not None] and maps.report["matched_by"] == by
    assert len(maps.notes) == len(notes) and all(a in b for a, b in zip(notes, maps.notes, strict=True)), maps.notes
    assert maps.report["missing"] == depths.count(None) and maps.report["depth_unit_m"] == 1


NPY = {f"{k}.npy": np.ones((6, 8)) for k in range(6)}


@pytest.mark.parametrize(
    ("files", "unit", "message"),
    [
        ({}, None, "no such file"),
        ({"0.npy": np.array([{"a": 1}], dtype=object)}, None, "found object, expected real numbers"),
        ({"0.npy": np.zeros((2, 3, 4))}, None, "a file that holds 2 maps"),
        ({"0.npy": np.zeros((6, 8)), "0.png": b""}, None, r"1 \.npy and 1 \.png"),
        ({f"{k}.npy": np.ones((6, 8)) for k in range(5, 11)}, None, "one for each of 6 frames numbered 0 to 5"),
        ({f"{k}.npy": np.ones((6, 8)) for k in [*range(5), "x"]}, None, "one for each of 6 frames numbered 0 to 5"),
        ({f"{k}.npy": np.ones((6, 8)) for k in "ab"}, None, "one for each of 6 frames numbered 0 to 5"),
        ({f"{k}.npy": np.ones((6, 8)) for k in ("a_1", "b_1")}, None, r"b_1\.npy: name: .*number 1 as a_1\.npy has"),
        ({"0.npy": np.ones((128, 96))}, None, r"found depth 96x128 \(portrait\) beside pictures 128x96 \(landscape\)"),
        (NPY, "furlong", "depth_unit"),
    ],
)
def test_maps_that_do_not_fit_or_are_hostile_are_refused(tmp_path, room, files, unit, message):
    for name, content in files.items():
        if isinstance(content, bytes):
            (tmp_path / name).write_bytes(content)
        else:
            np.save(tmp_path / name, content, allow_pickle=True)
    with pytest.raises(ValueError, match=message):
        open_depth_maps(tmp_path, room, unit)[0]


def test_maps_of_another_shape_are_laid_over_the_whole_image(tmp_path, room):
    with pytest.warns(UserWarning, match="maps of 64x64 are stretched"):
        assert open_depth_maps(folder_of(tmp_path / "square", ["0"], (64, 64)), room)[0].shape == (1, 64, 64)


# ---------------------------------------------------------------------------------------------- transform and study

OPTIONS = {"image": "image", "depth": "depth", "intrinsics": "intrinsics", "depth_unit": "mm", "n": 256}


def test_a_loader_gets_verdicts_of_one_shape():
    transform = ValidateDepth(map="map", judging={"size": 64}, **OPTIONS)
    pairs = [(frames()[k], f * frames()[k]["depth"].astype(np.float32) / 1000) for k, f in ((0, 1.0), (1, 1.4))]
    batch = next(iter(DataLoader([transform({**sample, "map": z}) for sample, z in pairs], batch_size=2)))
    assert batch["dhtorch.clip_depth_known"].tolist() == [False, False] and not batch["dhtorch.clip_depth"].any()
    sample, metres = pairs[1][0], pairs[1][1] / np.float32(1.4)
    cut = transform({**sample, "map": np.minimum(metres, np.float32(1.6))})
    assert bool(cut["dhtorch.clip_depth_known"]) and float(cut["dhtorch.clip_depth"]) == pytest.approx(1.6)
    in_mm = ValidateDepth(map="map", map_unit=0.001, judging={"size": 64}, **OPTIONS)({**sample, "map": 1400 * metres})
    assert float(in_mm["dhtorch.scale"][0]) == pytest.approx(float(batch["dhtorch.scale"][1, 0]), abs=1e-4)
    assert batch["dhtorch.state"].shape == (2, 64, 64) and batch["dhtorch.scale_known"].all()
    assert batch["dhtorch.scale"][:, 0].tolist() == pytest.approx([1.0, 1.4], abs=0.02)
    shares = batch["dhtorch.state_share"]
    assert shares[0, State.CONSISTENT] > 0.5 and shares[1, State.WRONG] > 0.5
    assert all(x.isfinite().all() for k, x in batch.items() if k.startswith("dhtorch.") and x.is_floating_point())


def test_a_loader_judges_the_sensor_by_another_view():
    first, second = frames()[0], frames()[6]
    both = {k: np.stack([first[k], second[k]]) for k in ("image", "depth")}
    views = {"judging": {"size": 64, "views": False}, **OPTIONS}
    alone = ValidateDepth(**views)({**first})
    assert not alone["dhtorch.scale_known"] and (alone["dhtorch.state"] == State.CANNOT_KNOW).all()
    seen = ValidateDepth(judging={"size": 64}, other_at=-1, at=0, **OPTIONS)({**first, **both})
    assert seen["dhtorch.state"].shape == (64, 64) and (seen["dhtorch.state"] != State.CANNOT_KNOW).any()
    several = {k: np.stack([v, v]) for k, v in {**first, **both}.items() if isinstance(v, np.ndarray)}
    several["image_is_pad"] = np.array([[False, False], [False, True]])
    state = ValidateDepth(other_at=-1, at=0, batched=True, **views)(several)["dhtorch.state"]
    assert (state[0] != State.CANNOT_KNOW).any() and (state[1] == State.CANNOT_KNOW).all(), "one has another view"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"judging": {"colour": 1}}, "judging"),
        ({"method": "none"}, "method"),
        ({"map": "map", "map_unit": 0.0}, "map_unit"),
        ({"map": "map", "map_unit": -1.0}, "map_unit"),
        ({"map": "map"}, "no such key"),
    ],
)
def test_options_of_the_transform_that_cannot_be_are_refused(options, message):
    with pytest.raises((ValueError, SampleError), match=message):
        ValidateDepth(**options, **OPTIONS)(dict(frames()[0]))


def test_a_study_counts_what_was_planted():
    detected, known, worst = "validate.scale_detected", "validate.known", "validate.called_right_wrong"
    row = {"pair": None, "method": "validate", "role": None, "scene": "a"}
    window = {"scene": "a", "pair": [0, 19], "method": "causes"}
    names = ("fault", "planted_kind", "named_kind", "moved_px")
    rows = [
        {**row, detected: 1.0, known: 0.5},
        {**row, "scene": "b", detected: 0.5, known: None},
        {**row, "scene": "c", "role": "rotation", detected: 0.0},
        *(
            {**window, **dict(zip(names, planted, strict=True))}
            for planted in (
                ("unit_mm", "unit", "unit", 50.0),
                ("unit_m", "unit", None, 50.0),
                ("none", None, None, 0.0),
                ("mirrored", "mirrored", "mirrored", 9.0),
                ("mirrored", "mirrored", None, 1.0),  # what moves less than two pixels does not count
                ("none", None, "roll", 0),
            )
        ),
    ]
    found = validate_study.summarise_validation(rows)
    expected = {detected: 0.75, known: 0.5, "validate.named.unit": 0.5, "validate.named.mirrored": 1.0}
    expected |= {"validate.named_worst": 0.5, "validate.misnamed": 0.5}
    assert {name: found[name]["value"] for name in expected} == expected
    holds, why = validate_study.verdict(found)
    assert holds is False and "validate.scale_detected 0.750" in why and "not measured: " in why
    found = validate_study.summarise_validation([*rows, {**rows[0], worst: 0.02}])
    assert found[f"{worst}_worst"]["value"] == 0.02
    alarms = [[1.1, 1.05, 1.15], [1.1, 0.99, 1.2], [1.02, 1.01, 1.03], [math.nan] * 3]
    assert [validate_study.scale_alarm(torch.tensor(x)) for x in alarms] == [True, False, False, None]


@pytest.mark.slow
def test_the_study_runs_on_a_room(room):
    options = {"reference_views": 1, "windows": 0, "rooms": [], "size": 96}
    found = validate_study.run([room], {"auto": AUTO.replace(n=512)}, None, Settings(cutoff=2.0), **options)
    names = {"called_right_wrong", "called_right_wrong_worst", "called_right_wrong_cut"}
    assert {f"{who}.{name}" for who in ("validate", "quick", "photometric") for name in names} <= set(found.summary)
    assert found.summary["validate.scale_detected_quick_far"]["n"] <= 1
    assert found.verdict in ("supported", "refuted", "undecided")


# --------------------------------------------------------------------------------------------------------------- align

ALIGN = ["align", *ROOM, "method.n=256", "cutoff=2.0", "steps=[1,2]"]


def test_maps_are_written_in_metres_and_stay(tmp_path, maps, room, capsys):
    out = tmp_path / "out"
    folder = maps(lambda z: np.where(z > 0, 30 / np.maximum(z, 0.1) + 2, 0))
    words = [
        *ALIGN,
        "max_frames=2",
        "every=3",
        f"depth={folder}",
        f"out={out}",
        "kind=inverse",
        'fail_on="no_answer>0.9"',
    ]
    assert run.main(words) == run.EXIT_DONE
    printed = capsys.readouterr().out
    stored_outputs.check("align", tmp_path, printed=printed.replace(f"depth={folder}", "MAPS"), folder=out)
    found = json.loads((out / "align.json").read_text())
    assert [row["frame"] for row in found["frames"]] == [0, 3] and found["whole"]["limited"]["unaligned"] == 0
    for frame in found["frames"]:
        z, row = room.truth(frame["frame"])["depth"], frame["aligned"]
        assert 0 <= row["probability"] <= row["likeliest_probability"] <= 1
        assert (row["probability"] == row["likeliest_probability"]) == (row["model"] == row["likeliest"])
        assert row["near"] / 256 == pytest.approx(float(((z > 0) & (z < 2)).double().mean()), abs=0.1)
        assert 0 <= row["far"] <= 256 - row["near"]
        assert frame["views"] == [frame["frame"] + k for k in (-2, -1, 1, 2) if 0 <= frame["frame"] + k < 6]
    truth, depth = room.truth(3)["depth"], data.open(out)[1].depth
    known = (truth > 0) & (depth > 0)
    assert known.double().mean() > 0.9 and ((depth - truth).abs() / truth)[known].median() < 0.02
    assert (out / "align.html").read_text().count("data:image/png;base64,") == 2
    before = {p: p.stat().st_mtime_ns for p in (out / "depth").iterdir()}
    (out / "meta" / "000003.json").unlink()
    assert run.main(words) == run.EXIT_DONE and "1 left untouched" in capsys.readouterr().out
    after = {p: p.stat().st_mtime_ns for p in (out / "depth").iterdir()}
    assert before.keys() == after.keys() and sum(before[p] != after[p] for p in before) == 1
    assert run.main([*words, "kind=affine"]) == run.EXIT_FAILED, "other maps in the same folder"


def test_a_byte_of_a_map_or_its_unit_makes_another_run(tmp_path, room, capsys):
    """A change in the middle of a map of the same size and time is one of the data; so is another unit stated."""
    depth = np.zeros((6, 96, 128), np.float32)
    depth[0] = room.truth(0)["depth"][0].numpy()
    np.save(tmp_path / "maps.npy", depth)
    words = [*ALIGN, f"depth={tmp_path}", f"out={tmp_path / 'out'}", "max_frames=1"]
    change = lambda: change_middle(tmp_path / "maps.npy")  # noqa: E731
    state = lambda: (tmp_path / "complete.json").write_text('{"unit_m": 0.5}')  # noqa: E731
    for step, code, said in (
        (lambda: None, run.EXIT_DONE, "1 map"),
        (change, run.EXIT_FAILED, "files of another run (other data)"),
        (change, run.EXIT_DONE, "1 left untouched"),
        (state, run.EXIT_FAILED, "files of another run (other data)"),
    ):
        step()
        assert run.main(words) == code and said in "".join(capsys.readouterr())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words", "code", "lines"),
    [
        (lambda z: 1 - 0.01 / z, ["cutoff=null"], run.EXIT_DONE, [
            "none of 1 map could be aligned", "1 map: near returns show a z-buffer (non-linear depth)",
            "  maps: depth unit assumed: 1 m"]),
        (lambda z: 1.5 * z, ['fail_on="scale>0.2,no_answer>0.99"'], run.EXIT_SOME_FAILED, ["exceeded: scale is 0.33"]),
    ],
)  # fmt: skip
def test_other_families_are_named_and_limits_decide_the_exit_code(tmp_path, maps, capsys, change, words, code, lines):
    assert run.main([*ALIGN, f"depth={maps(change)}", f"out={tmp_path / 'out'}", "max_frames=1", *words]) == code
    printed = capsys.readouterr().out
    assert all(line in printed for line in lines), printed
    report = json.loads((tmp_path / "out/align.json").read_text())
    assert ("Exceeded" in (tmp_path / "out" / "align.html").read_text()) == bool(code)
    if not code:
        assert report["frames"][0]["aligned"]["family"] == "z-buffer" and report["whole"]["families"] == {"z-buffer": 1}
        assert report["maps"]["depth_unit"] == "depth unit assumed: 1 m" and "few" not in printed.splitlines()[0]


@pytest.mark.slow
def test_a_hole_in_a_file_is_no_value_and_a_sensor_beside_itself_is_named(tmp_path, room, capsys):
    for k in range(2):
        np.save(tmp_path / f"{k:04d}.npy", np.where(np.arange(128) < 20, 0, room[k].depth[0].numpy()))
    words = [f"depth={tmp_path}", "max_frames=1", "kind=affine", "method.n=256", f"out={tmp_path / 'out'}"]
    assert run.main(["align", *ROOM, *words]) == run.EXIT_DONE
    assert "from one sensor" in capsys.readouterr().out
    depth = data.open(tmp_path / "out")[0].depth
    assert (depth[..., :20] == 0).all() and (depth[..., 20:] > 0).double().mean() > 0.5


# ----------------------------------------------------------------------------------------------------------------- pin


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A capture whose camera stands still and is moved between frames 3 and 4; and its frames."""
    return moved_camera_capture(tmp_path_factory.mktemp("pin") / "capture")


def pinned(out, *words):
    code = run.main(["pin", *map(str, words), f"output={out}", "ref_frames=1"])
    return code, json.loads((out / "pin.json").read_text())


def test_an_episode_has_its_change_point_and_exceeds_its_limit(tmp_path, moved, capsys):
    root, _ = moved
    code, found = pinned(tmp_path / "out", root, root, "max_frames=null", "fail_on=moved>2px")
    assert code == run.EXIT_SOME_FAILED and found["metric"]
    (episode,) = found["episodes"]
    assert episode["verdict"] == "moved" and [change["frame"] for change in episode["changes"]] == [4]
    assert [row["verdict"] for row in episode["pictures"][:4]] == ["not_moved"] * 4
    shown = capsys.readouterr().out
    stored_outputs.check("pin", root, printed=shown.replace(str(tmp_path), "ROOT"), folder=tmp_path / "out")
    assert "exceeded: moved is" in shown and "from frame 4 by" in shown
    page = (tmp_path / "out" / "pin.html").read_text()
    assert page.count("data:image/png") == 2 and page.count("<img") + page.count("<svg") >= 3 and "moved" in page


def test_an_image_is_compared_guided_and_limited(tmp_path, moved, capsys):
    root, frames_ = moved
    picture = frames_[1].image.float()
    scale = torch.tensor([[[1 / 1.04, 0.0, 0.0], [0.0, 1 / 1.04, 0.0]]])
    grid = torch.nn.functional.affine_grid(scale, picture.shape, align_corners=False)
    zoomed = torch.nn.functional.grid_sample(picture, grid, mode="bicubic", align_corners=False).clamp(0, 255).byte()
    still, other, far = (tmp_path / f"{name}.png" for name in ("still", "moved", "zoomed"))
    for file, frame in ((still, frames_[1]), (other, frames_[5]), (far, frames_[1].replace(image=zoomed))):
        file.write_bytes(image(frame))
    for k, (words, code, row, said) in enumerate([
        ([root, still, "fail_on=moved>2px,unknown>0.5"], run.EXIT_DONE, {"verdict": "not_moved"}, "not moved"),
        ([root, other, "guide=true", "fail_on=moved>2px"], run.EXIT_SOME_FAILED, {"verdict": "moved"}, "mm"),
        ([still, other, "data.fov=60"], run.EXIT_DONE, {}, "moved.png: "),
        ([root, far, "fail_on=moved>2px"], run.EXIT_DONE, {"verdict": "cannot_know", "reason": "zoom"}, "zoom or focus changed"),
        ([root, far, "fail_on=unknown>0.5"], run.EXIT_SOME_FAILED, {"reason": "zoom"}, "exceeded: unknown"),
    ]):  # fmt: skip
        ended, found = pinned(tmp_path / str(k), *words)
        (first,) = found["episodes"][0]["pictures"]
        assert ended == code and all(first[k] == x for k, x in row.items()) and said in capsys.readouterr().out
        assert bool(found["exceeded"]) == bool(code) and found["metric"] == (words[0] == root) == (
            "direction" not in first
        )
    assert first["zoom"] == pytest.approx(1.04, abs=0.003) and 0 < first["zoom_sigma"] < 0.002
    assert "zoom or focus changed" in (tmp_path / "3" / "pin.html").read_text()


def test_a_live_camera_is_watched_until_its_end(tmp_path, moved, capsys, monkeypatch):
    root, frames_ = moved
    left = [np.ascontiguousarray(frame.image[0].permute(1, 2, 0).numpy()[..., ::-1]) for frame in frames_[3:6]]
    calls = []

    class Capture:
        def __init__(self, index):
            calls.append(index)

        def isOpened(self):
            return True

        def read(self):
            return (True, left.pop(0)) if left else (False, None)

        def release(self):
            calls.append("released")

    monkeypatch.setattr(decode.cv2, "VideoCapture", Capture)
    code, found = pinned(tmp_path / "out", root, "7", "guide=true")
    assert code == run.EXIT_DONE and calls == [7, "released"]
    assert [row["verdict"] for row in found["episodes"][0]["pictures"]] == ["not_moved", "moved", "moved"]
    shown = capsys.readouterr().out
    assert "0: in place" in shown and "mm" in shown


# --------------------------------------------------------------------------------------------------------------- scale


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "room"
    writers.write_counted_frames(folder, made.room_scene().frames)
    return folder


@pytest.fixture
def model(tmp_path):
    content, true = made.room_model("points")
    made.write_colmap_text(tmp_path / "sparse", content)
    made.write_pictures(tmp_path / "images")
    return tmp_path / "sparse", true


def scaled(capture, model, *words):
    return run.main(["scale", str(model), str(capture), "--cutoff", "2.5", *words])


def test_a_model_is_written_in_metres(capture, model, capsys):
    folder, true = model
    assert scaled(capture, folder) == run.EXIT_DONE
    out = folder.with_name("sparse_metres")
    report = json.loads((out / "scale.json").read_text())
    assert not report["refused"] and abs(report["scale"] / true - 1) < 0.01
    assert report["U"]["low"] < true < report["U"]["high"] and len(report["frames"]) == 12
    np.testing.assert_allclose(read_model(out).xyz, report["scale"] * read_model(folder).xyz, rtol=1e-6)
    printed = capsys.readouterr().out
    stored_outputs.check("scale", folder.parent, printed=printed.replace(str(capture), "CAPTURE"), folder=out)
    assert "1 unit = " in printed and (out / "scale.html").read_text().count("data:image/png;base64,") == 3


def test_a_model_whose_path_is_too_long_is_refused_with_where_and_how_much(capture, tmp_path, capsys):
    content, _ = made.room_model("points")
    c2w = np.stack([view.c2w for view in content.views])
    c2w[:, :3, 3] += 0.1 * (c2w[:, :3, 3] - c2w[:, :3, 3].mean(0))
    views = [replace(view, c2w=pose) for view, pose in zip(content.views, c2w, strict=True)]
    made.write_colmap_text(tmp_path / "sparse", replace(content, views=views))
    made.write_pictures(tmp_path / "images")
    assert scaled(capture, tmp_path / "sparse") == run.EXIT_SOME_FAILED
    report = json.loads((tmp_path / "sparse_metres" / "scale.json").read_text())
    (change,) = [(fault["change"], fault["sigma"]) for fault in report["faults"] if fault["kind"] == "path"]
    assert change[0] == pytest.approx(0.1, abs=2.5 * change[1]) and report["path"]["scale"] < report["scale"]
    assert "camera path against depths, by " in capsys.readouterr().out


@pytest.mark.slow
def test_the_folder_of_another_model_gets_this_ones_cameras_and_a_foreign_file_stays(capture, model, capsys):
    cameras, out = model[0] / "cameras.txt", model[0].with_name("out") / "cameras.txt"
    words = ["--max-frames", "3", "--out", str(out.parent)]
    assert scaled(capture, model[0], *words) == run.EXIT_DONE
    first, *lines = cameras.read_text().splitlines()
    overwrite(cameras, "\n".join([first, *(x[:-1] + "1" for x in lines), ""]).encode())
    assert out.read_bytes() != cameras.read_bytes() and scaled(capture, model[0], *words) == run.EXIT_DONE
    assert out.read_bytes() == cameras.read_bytes()
    change_middle(out)
    foreign = out.read_bytes()
    assert scaled(capture, model[0], *words) == run.EXIT_FAILED and out.read_bytes() == foreign
    assert "cameras.txt, a file that was changed since dhtorch wrote it, expected none" in capsys.readouterr().err


@pytest.mark.slow
def test_a_model_is_moved_into_the_world_of_the_capture_and_a_drifting_one_is_refused(capture, model, tmp_path, capsys):
    assert scaled(capture, model[0], "--frame", "capture", "--out", str(tmp_path / "out")) == run.EXIT_DONE
    found = np.stack([view.c2w for view in read_model(tmp_path / "out").views])
    np.testing.assert_allclose(found[:, :3, 3], made.room_scene().poses[:, :3, 3], atol=0.05)
    made.write_arrays(tmp_path / "model", made.room_model("maps", "drift", 0.08)[0])
    made.write_pictures(tmp_path / "model" / "images")
    assert scaled(capture, tmp_path / "model") == run.EXIT_SOME_FAILED
    out = tmp_path / "model_metres"
    assert not (out / "predictions.npz").exists() and json.loads((out / "scale.json").read_text())["refused"]
    printed = capsys.readouterr().out
    assert "refused" in printed and "from 000000.png to 000011.png" in printed
