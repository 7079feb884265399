"""``dhtorch validate``: files, limits and exit codes; maps beside a recording; the transform; what a study counts."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support import stored_outputs, writers
from support.sample_dicts import SIDE, frames
from torch.utils.data import DataLoader

from dhtorch.cli import run, validate
from dhtorch.cli.validate import (
    _deviation_lower_bound,
    _drift_lower_bound,
    _find_shared_clip_depth,
    _format_factor,
    _format_summary,
    _share_lower_bound,
    _wrong_lower_bound,
    list_exceeded_limits,
    parse_limits,
)
from dhtorch.codes import State
from dhtorch.data.depth_maps import open_depth_maps
from dhtorch.data.io.decode import FormatError
from dhtorch.data.units import DepthUnit
from dhtorch.experiments.compare import validate_study
from dhtorch.experiments.protocol import Settings
from dhtorch.export import encode_png
from dhtorch.pipeline.presets import AUTO
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import SampleError, ValidateDepth

ROOM = ["data=synthetic", "data.hw=[96,128]", "data.depth_hw=[96,128]", "data.supersample=1", "data.n_frames=6"]
LITTLE = ["method.n=256", "size=96", "window=0", "max_frames=2", "every=3"]


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=6, hw=(96, 128), depth_hw=(96, 128), supersample=1)


@pytest.fixture
def maps(tmp_path, room):
    for k in range(len(room)):
        np.save(tmp_path / f"depth_{k:04d}.npy", room.truth(k)["depth"][0].numpy())
    return tmp_path


def validated(out, *words, capsys=None):
    code = run.main(["validate", *ROOM, *LITTLE, f"output={out}", *words])
    return code, json.loads((out / "validate.json").read_text())


def test_files_are_written_and_limits_decide_the_exit_code(tmp_path, maps, capsys):
    out = tmp_path / "out"
    code, found = validated(out, f"depth={maps}", "depth_unit=mm", 'fail_on="scale>0.5,unknown>1"')
    assert code == run.EXIT_SOME_FAILED, "metres read as millimetres"
    stored_outputs.check("validate", tmp_path, printed=capsys.readouterr().out, folder=out)
    assert len(found["exceeded"]) == 1
    assert found["whole"]["limited"]["scale"] == pytest.approx(0.999, abs=0.002)
    assert [row["frame"] for row in found["frames"]] == [0, 3]
    page = (out / "validate.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "Exceeded: scale" in page
    code, found = validated(out, f"depth={maps}", 'fail_on="scale>0.5"', "pictures=0", "views=false")
    assert code == run.EXIT_DONE
    assert found["exceeded"] == []
    assert "data:image" not in (out / "validate.html").read_text()


def test_a_guessed_camera_is_told_on_the_page_and_one_frame_is_one(tmp_path, room):
    capture = tmp_path / "capture"
    writers.write_counted_frames(capture, [room[0], room[3]])
    (capture / "K.txt").unlink()
    words = [
        "data=frames_dir",
        f"data.root={capture}",
        "data.fov=60",
        *LITTLE,
        "max_frames=1",
        f"output={tmp_path / 'out'}",
    ]
    assert run.main(["validate", *words]) == run.EXIT_DONE
    page = (tmp_path / "out/validate.html").read_text()
    assert "<p>Intrinsics are a guess from a field of view of 60°" in page
    assert "<p>Depth unit assumed: 1/1000 m (data.depth_unit= sets it)." in page
    assert "capture: 1 frame: " in page and "checked, of depth" in page
    assert "60°" in json.loads((tmp_path / "out/validate.json").read_text())["intrinsics_guessed"]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("fail_on=wrong", "fail_on"),
        ("fail_on='colour>1'", "fail_on"),
        ("depth=/nowhere", "no folder"),
        ("window=1", "window"),
        ("every=0", "every"),
        ("tolerance=0.5", "tolerance"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(word, said, tmp_path, capsys):
    assert run.main(["validate", *ROOM, *LITTLE, f"output={tmp_path}", word]) == run.EXIT_FAILED
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


@pytest.mark.slow
def test_a_single_frame_exceeds_a_limit_by_its_bound_alone(tmp_path, maps):
    for file in maps.glob("*.npy"):
        np.save(file, 1.1 * np.load(file))
    out = tmp_path / "out"
    code, found = validated(out, f"depth={maps}", "views=false", "max_frames=1", 'fail_on="scale>0.05,wrong>0.9"')
    scale = found["frames"][0]["scale"]
    assert code == run.EXIT_SOME_FAILED
    assert found["whole"]["limited"]["scale"] == pytest.approx(scale["low"] - 1)
    assert scale["low"] - 1 < 0.099 < scale["value"] - 1 + 0.01
    code, _ = validated(out, f"depth={maps}", "views=false", "max_frames=1", 'fail_on="scale>0.097"')
    assert code == run.EXIT_DONE, "the value is more, its interval is not"
    assert found["intrinsics_guessed"] is None


def test_bounds_of_a_recording():
    def row(low, high):
        return {"scale": {"value": (low + high) / 2, "low": low, "high": high}}

    assert _deviation_lower_bound([row(0.98, 1.03)], "scale", 1.0) == 0
    assert _deviation_lower_bound([row(1.02, 1.08), row(1.03, 1.2), row(0.5, 0.6)], "scale", 1.0) == pytest.approx(0.02)
    assert _deviation_lower_bound([row(0.8, 0.9)], "scale", 1.0) == pytest.approx(0.1)
    assert _deviation_lower_bound([{"scale": None}], "scale", 1.0) is None
    sound, far = row(0.97, 1.02), row(1.1, 1.2)
    assert _drift_lower_bound([sound, far]) == pytest.approx(1.1 - 1.02)
    assert _drift_lower_bound([sound, row(0.99, 1.05), {"scale": None}]) == 0
    assert _drift_lower_bound(10 * [sound] + [far]) == 0, "one of eleven"
    assert _drift_lower_bound(9 * [sound] + 3 * [far]) == pytest.approx(1.1 - 1.02)
    assert _drift_lower_bound([far, {"scale": None}]) is None
    assert _share_lower_bound(0, 0) is None
    assert _share_lower_bound(1, 1) < 0.3 < _share_lower_bound(20, 20)
    few = {"wrong": {"value": 0.5, "low": 0.1, "high": 0.9}, "pixels": 100, "share_cannot_know": 0.9}
    many = {"wrong": {"value": 0.5, "low": 0.4, "high": 0.6}, "pixels": 100, "share_cannot_know": 0.7}
    nothing = {"wrong": None, "pixels": 100, "share_cannot_know": 1.0}
    assert _wrong_lower_bound([few, many, nothing]) == pytest.approx((10 * 0.1 + 30 * 0.4) / 40)
    assert _wrong_lower_bound([nothing]) is None


@pytest.mark.slow
def test_maps_that_are_cut_are_told(tmp_path, maps, room):
    for file in maps.glob("*.npy"):
        np.save(file, np.minimum(np.load(file), np.float32(2.55)))
    code, found = validated(tmp_path / "out", f"depth={maps}", "window=6", "every=2", "max_frames=3", "method.n=512")
    assert code == run.EXIT_DONE
    assert [row["clip_depth"] for row in found["frames"]] == pytest.approx([2.55] * 3)
    assert [(row["cause"], row["kind"]) for row in found["windows"]] == [("cut at 2.55 m", "cut")]
    assert (
        found["whole"]["clip_depth"] == pytest.approx(2.55) and "2.55" in (tmp_path / "out/validate.html").read_text()
    )
    unnamed = _format_summary("room", found["whole"] | {"causes": {}})
    assert unnamed[-1] == "  cut at 2.55 m: larger depths are set to this value"
    assert not any("farther" in line for line in _format_summary("room", found["whole"])), "said once"


def test_the_depth_at_which_most_maps_end_is_that_of_the_recording():
    def shared(*depths):
        return _find_shared_clip_depth([{"clip_depth": depth} for depth in depths])

    assert shared(2.55, 2.56, None) == pytest.approx(2.555) and shared(3.0, 2.0, 2.0, 2.01) == pytest.approx(2.005)
    assert shared(2.55, None) is None and shared() is None, "not most of them"
    assert shared(2.55, 3.0) is None and shared(2.0, 2.03, 2.06) is None, "not at one depth"


class Windows:
    """A recording of frames numbered from 20 whose diagnosis and rows are made up."""

    def __init__(self, monkeypatch, n, maps=None, cause="", clips=()):
        self.scene = SimpleNamespace(name="hall", recording=Numbered(range(20, 20 + n)), role=None, hint=None)
        self.validated = validate.RecordingValidation(self.scene, maps)
        self.diagnosed, self.clips, self.cause = [], dict(clips), cause
        monkeypatch.setattr(validate, "_load_frame", lambda scene, settings, i: f"frame {i}")
        monkeypatch.setattr(validate, "_validate_frame", lambda validated, frame, i, method, settings: frame)
        monkeypatch.setattr(validate, "_summarise_frame", lambda number, found: self.row(number))
        monkeypatch.setattr(validate, "_keep_worst", lambda *_: None)
        monkeypatch.setattr(validate.faults, "diagnose", self.diagnose)

    def row(self, number):
        return {"frame": number, "clip_depth": self.clips.get(number)}

    def diagnose(self, frames, maps=None, seed=None):
        self.diagnosed.append((frames, maps, seed))
        return validate.faults.Diagnosis(self.cause or None, "unit" if self.cause else None, {"unit": 0.5}, 3, "tracks")

    def windows(self, **settings):
        options = {"every": 1, "max_frames": None, "window": 4, "seed": 5} | settings
        progress = lambda items, text, n: self.texts.append((text, n)) or items  # noqa: E731
        self.texts = []
        return validate._validate_recording(self.validated, None, options, progress).windows


class Numbered(list):
    """Frames with numbers."""

    @property
    def number(self):
        return torch.tensor(list(self))


def test_windows_cover_the_validated_frames_and_are_of_one_size(monkeypatch):
    made = Windows(monkeypatch, 10, cause="millimetres")
    rows = made.windows()
    assert [row["frames"] for row in rows] == [[20, 23], [24, 27]], "a rest that is shorter has none"
    assert made.diagnosed[1] == ([f"frame {k}" for k in range(4, 8)], None, 5)
    assert rows[0] == {
        **{"frames": [20, 23], "pairs": 3, "by": "tracks"},
        **{"cause": "millimetres", "kind": "unit", "loss": {"unit": 0.5}},
    }
    assert [row["frame"] for row in made.validated.rows] == list(range(20, 30))
    assert made.texts == [("hall: frames", 10), ("hall: windows", 2)]
    assert [row["frames"] for row in Windows(monkeypatch, 10).windows(max_frames=6)] == [[20, 23]]
    assert [row["frames"] for row in Windows(monkeypatch, 10).windows(every=3)] == [[20, 23], [24, 27]]
    assert [row["frames"] for row in Windows(monkeypatch, 3).windows()] == [[20, 22]], "fewer frames than a window"
    assert Windows(monkeypatch, 1).windows() == [] and Windows(monkeypatch, 10).windows(window=0) == []


def test_a_window_without_a_cause_is_cut_where_its_maps_end(monkeypatch):
    clips = {20: 2.5, 21: 2.5, 22: 2.51, 24: 2.5}
    first, second = Windows(monkeypatch, 8, clips=clips).windows()
    assert (first["cause"], first["kind"], first["loss"]) == ("cut at 2.5 m", "cut", {"unit": 0.5})
    assert (second["cause"], second["kind"]) == (None, None)
    (named, _) = Windows(monkeypatch, 8, clips=clips, cause="millimetres").windows()
    assert (named["cause"], named["kind"]) == ("millimetres", "unit"), "a cause that is named comes first"


def test_maps_of_a_window_have_one_size_or_no_diagnosis(monkeypatch):
    class Maps(list):
        frames = [0, 1, 2, 3]  # noqa: RUF012
        doubts = notes = ()

    maps = Maps([torch.ones(1, 2, 3), None, torch.full((1, 2, 3), 2.0), None])
    made = Windows(monkeypatch, 4, maps, cause="millimetres")
    (row,) = made.windows()
    ((frames, given, _),) = made.diagnosed
    assert row["cause"] == "millimetres" and frames == [f"frame {k}" for k in range(4)]
    assert [float(each.mean()) for each in given] == [1, 0, 2, 0] and {each.shape for each in given} == {(1, 2, 3)}
    for other in (Maps([torch.ones(1, 2, 3), torch.ones(1, 4, 6), None, None]), Maps([None] * 4)):
        made = Windows(monkeypatch, 4, other, cause="millimetres")
        (row,) = made.windows()
        assert made.diagnosed == [] and (row["pairs"], row["cause"], row["loss"]) == (0, None, {})


def test_a_guessed_field_of_view_is_told(tmp_path, room):
    for k in range(2):
        for name, picture in (("rgb", room[k].image[0]), ("depth", (1000 * room[k].depth[0]).to(torch.uint16))):
            (tmp_path / "capture" / name).mkdir(parents=True, exist_ok=True)
            array = picture.permute(1, 2, 0).numpy() if name == "rgb" else picture.numpy()
            (tmp_path / "capture" / name / f"{k}.png").write_bytes(encode_png(np.ascontiguousarray(array)))
    words = [
        "validate",
        str(tmp_path / "capture"),
        "data.fov=60",
        "method.n=256",
        "size=96",
        "window=0",
        "max_frames=1",
    ]
    with pytest.warns(UserWarning, match="intrinsics are a guess"):
        assert run.main([*words, f"output={tmp_path}"]) == run.EXIT_DONE
    told = json.loads((tmp_path / "validate.json").read_text())["intrinsics_guessed"]
    assert told.startswith("intrinsics are a guess") and "60" in told


def test_a_factor_is_legible_whatever_it_is():
    assert [_format_factor(x) for x in (1.0004, 999.19, 0.00099945, 9.99e29)] == [
        "1.000",
        "999.190",
        "0.0009995",
        "9.99e+29",
    ]


def test_limits():
    assert parse_limits("wrong>0.05, scale > 0.1") == {"wrong": 0.05, "scale": 0.1}
    assert parse_limits(None) == {}
    limited = {"wrong": 0.06, "scale": None}
    assert list_exceeded_limits({"limited": limited}, {"wrong": 0.06, "scale": 0.0}) == [], "not more, and not known"
    assert len(list_exceeded_limits({"limited": limited}, {"wrong": 0.05})) == 1


def test_maps_are_matched_by_number_unit_and_kind(tmp_path, maps, room):
    found = open_depth_maps(maps, room)
    assert torch.equal(found[3], room.truth(3)["depth"])
    (maps / "depth_0002.npy").unlink()
    assert open_depth_maps(maps, room)[2] is None
    shorter = tmp_path / "png"
    shorter.mkdir()
    steps = (room.truth(1)["depth"][0].numpy() * 500).round().astype(np.uint16)
    (shorter / "1.png").write_bytes(encode_png(steps))
    assert torch.allclose(open_depth_maps(shorter, room, 0.002)[1], room.truth(1)["depth"], atol=0.0011)
    (shorter / "complete.json").write_text('{"unit_m": 0.002}')
    assert open_depth_maps(shorter, room).unit == DepthUnit(0.002, "complete.json: unit_m")
    with pytest.raises(ValueError, match="depth_unit"):
        open_depth_maps(shorter, room, "furlong")


def test_damaged_or_hostile_maps_are_refused(tmp_path, room):
    with pytest.raises(FormatError, match="no such file"):
        open_depth_maps(tmp_path, room)
    np.save(tmp_path / "0.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="found object, expected real numbers"):
        open_depth_maps(tmp_path, room)[0]
    np.save(tmp_path / "0.npy", np.zeros((2, 3, 4)))
    with pytest.raises(FormatError, match="a file that holds 2 maps"):
        open_depth_maps(tmp_path, room)[0]
    (tmp_path / "0.png").write_bytes(b"")
    with pytest.raises(FormatError, match=r"1 \.npy and 1 \.png"):
        open_depth_maps(tmp_path, room)


def folder_of(root, names, hw=(6, 8)):
    """A folder of maps, each of the depth of its place in the list, 1 m first."""
    root.mkdir()
    for k, name in enumerate(names):
        np.save(root / f"{name}.npy", np.full(hw, 1.0 + k, np.float32))
    return root


def depths(maps):
    return [None if maps[i] is None else float(maps[i][0, 0, 0]) for i in range(len(maps.files))]


def test_files_are_matched_by_number_else_in_order_and_never_by_halves(tmp_path, room):
    n = len(room)
    some = open_depth_maps(folder_of(tmp_path / "some", ["depth_3", "depth_1"]), room)
    assert depths(some)[:4] == [None, 2.0, None, 1.0] and some.frames == [1, 3]
    counted = f"2 maps numbered 1 to 3 for {n} frames numbered 0 to {n - 1}"
    assert [note.partition(":")[0] for note in some.notes] == ["warning", f"{n - 2} of {n} frames have no map.", "maps"]
    assert counted in some.notes[0] and "numbered from 1" in some.notes[0] and "unit assumed: 1 m" in some.notes[-1]
    assert (
        some.report["missing"] == n - 2 and some.report["matched_by"] == "number" and some.report["depth_unit_m"] == 1
    )
    more = open_depth_maps(folder_of(tmp_path / "more", range(n + 5)), room)
    assert depths(more) == [1.0 + k for k in range(n)] and not more.warnings and len(more.notes) == 1
    later = open_depth_maps(folder_of(tmp_path / "later", [f"{95 + k}" for k in range(n)]), room)
    assert depths(later) == [1.0 + k for k in range(n)], "99 comes before 100"
    assert later.report["matched_by"] == "order" and "in their order" in later.notes[0]
    named = open_depth_maps(folder_of(tmp_path / "named", "abcdefghijklmnopqrstuvwxyz"[:n]), room)
    assert depths(named) == [1.0 + k for k in range(n)] and named.by == "order"
    for k, names in enumerate((range(n - 1, 2 * n - 1), [*range(n - 1), "x"], ["a", "b"])):
        with pytest.raises(FormatError, match=f"one for each of {n} frames numbered 0 to {n - 1}"):
            open_depth_maps(folder_of(tmp_path / f"wrong{k}", names), room)
    with pytest.raises(FormatError, match=r"b_1\.npy: name: .*number 1 as a_1\.npy has"):
        open_depth_maps(folder_of(tmp_path / "twice", ["a_1", "b_1"]), room)


def test_a_map_is_laid_over_the_whole_picture(tmp_path, room):
    h, w = room[0].hw
    with pytest.raises(
        FormatError, match=rf"orientation: found depth {h}x{w} \(portrait\) beside pictures {w}x{h} \(landscape\)"
    ):
        open_depth_maps(folder_of(tmp_path / "upright", ["0"], (w, h)), room)[0]
    with pytest.warns(UserWarning, match="maps of 64x64 are stretched"):
        assert open_depth_maps(folder_of(tmp_path / "square", ["0"], (64, 64)), room)[0].shape == (1, 64, 64)


OPTIONS = {"image": "image", "depth": "depth", "intrinsics": "intrinsics", "depth_unit": "mm", "n": 256}


def test_a_loader_gets_verdicts_of_one_shape():
    transform = ValidateDepth(map="map", judging={"size": 64}, **OPTIONS)
    samples = []
    for k, factor in ((0, 1.0), (1, 1.4)):
        sample = frames()[k]
        metres = sample["depth"].astype(np.float32) / 1000
        samples.append(transform({**sample, "map": factor * metres}))
    batch = next(iter(DataLoader(samples, batch_size=2)))
    assert batch["dhtorch.clip_depth_known"].tolist() == [False, False] and not batch["dhtorch.clip_depth"].any()
    cut = transform({**sample, "map": np.minimum(metres, np.float32(1.6))})
    assert bool(cut["dhtorch.clip_depth_known"]) and float(cut["dhtorch.clip_depth"]) == pytest.approx(1.6)
    in_mm = ValidateDepth(map="map", map_unit=0.001, judging={"size": 64}, **OPTIONS)({**sample, "map": 1400 * metres})
    assert float(in_mm["dhtorch.scale"][0]) == pytest.approx(float(batch["dhtorch.scale"][1, 0]), abs=1e-4)
    assert batch["dhtorch.state"].shape == (2, 64, 64)
    assert batch["dhtorch.scale_known"].all()
    assert batch["dhtorch.scale"][:, 0].tolist() == pytest.approx([1.0, 1.4], abs=0.02)
    assert batch["dhtorch.state_share"][0, State.CONSISTENT] > 0.5
    assert batch["dhtorch.state_share"][1, State.WRONG] > 0.5
    assert all(x.isfinite().all() for k, x in batch.items() if k.startswith("dhtorch.") and x.is_floating_point())


def test_a_loader_judges_the_sensor_by_another_view():
    first, second = frames()[0], frames()[6]
    both = {k: np.stack([first[k], second[k]]) for k in ("image", "depth")}
    alone = ValidateDepth(judging={"size": 64, "views": False}, **OPTIONS)({**first})
    assert not alone["dhtorch.scale_known"]
    assert (alone["dhtorch.state"] == State.CANNOT_KNOW).all()
    seen = ValidateDepth(judging={"size": 64}, other_at=-1, at=0, **OPTIONS)({**first, **both})
    assert seen["dhtorch.state"].shape == (64, 64)
    assert (seen["dhtorch.state"] != State.CANNOT_KNOW).any()
    several = {k: np.stack([v, v]) for k, v in {**first, **both}.items() if isinstance(v, np.ndarray)}
    several["image_is_pad"] = np.array([[False, False], [False, True]])
    judging = ValidateDepth(judging={"size": 64, "views": False}, other_at=-1, at=0, batched=True, **OPTIONS)
    state = judging(several)["dhtorch.state"]
    assert (state[0] != State.CANNOT_KNOW).any() and (state[1] == State.CANNOT_KNOW).all(), "one has another view"


def test_options_of_the_transform_that_cannot_be():
    with pytest.raises(ValueError, match="judging"):
        ValidateDepth(judging={"colour": 1}, **OPTIONS)
    with pytest.raises(ValueError, match="method"):
        ValidateDepth(method="none", **OPTIONS)
    with pytest.raises(ValueError, match="map_unit"):
        ValidateDepth(map="map", map_unit=0.0, **OPTIONS)
    with pytest.raises(ValueError, match="map_unit"):
        ValidateDepth(map="map", map_unit=-1.0, **OPTIONS)
    with pytest.raises(SampleError, match="no such key"):
        ValidateDepth(map="map", **OPTIONS)(dict(frames()[0]))
    assert frames()[0]["image"].shape[0] == SIDE


def test_a_study_counts_what_was_planted():
    rows = [
        {
            "scene": "a",
            "pair": None,
            "method": "validate",
            "role": None,
            "validate.scale_detected": 1.0,
            "validate.known": 0.5,
        },
        {
            "scene": "b",
            "pair": None,
            "method": "validate",
            "role": None,
            "validate.scale_detected": 0.5,
            "validate.known": None,
        },
        {"scene": "c", "pair": None, "method": "validate", "role": "rotation", "validate.scale_detected": 0.0},
    ]

    def window(fault, kind, named, moved):
        found = {"scene": "a", "pair": [0, 19], "method": "causes", "fault": fault, "planted_kind": kind}
        return {**found, "named_kind": named, "moved_px": moved}

    rows += [window("unit_mm", "unit", "unit", 50.0), window("unit_m", "unit", None, 50.0)]
    rows += [window("mirrored", "mirrored", "mirrored", 9.0), window("mirrored", "mirrored", None, 1.0)]
    rows += [window("none", None, None, 0.0), window("none", None, "rolled", 0.0)]
    found = validate_study.summarise_validation([*rows, {**rows[0], "validate.called_right_wrong": 0.02}])
    assert found["validate.called_right_wrong_worst"]["value"] == 0.02
    found = validate_study.summarise_validation(rows)
    assert found["validate.scale_detected"]["value"] == 0.75
    assert found["validate.known"]["value"] == 0.5
    assert found["validate.named.unit"]["value"] == 0.5
    assert found["validate.named.mirrored"]["value"] == 1.0, "what moves less than two pixels does not count"
    assert found["validate.named_worst"]["value"] == 0.5
    assert found["validate.misnamed"]["value"] == 0.5
    holds, why = validate_study.verdict(found)
    assert holds is False
    assert "validate.scale_detected 0.750" in why
    assert "not measured: " in why


def test_an_alarm_needs_an_interval_without_one_and_a_distance():
    assert validate_study.scale_alarm(torch.tensor([1.1, 1.05, 1.15])) is True
    assert validate_study.scale_alarm(torch.tensor([1.1, 0.99, 1.2])) is False
    assert validate_study.scale_alarm(torch.tensor([1.02, 1.01, 1.03])) is False
    assert validate_study.scale_alarm(torch.full((3,), math.nan)) is None


@pytest.mark.slow
def test_the_study_runs_on_a_room(room):

    options = {"reference_views": 1, "windows": 0, "rooms": [], "size": 96}
    found = validate_study.run([room], {"auto": AUTO.replace(n=512)}, None, Settings(cutoff=2.0), **options)
    told = {"called_right_wrong", "called_right_wrong_worst", "called_right_wrong_cut"}
    assert {f"{who}.{name}" for who in ("validate", "quick", "photometric") for name in told} <= set(found.summary)
    assert found.summary["validate.scale_detected_quick_far"]["n"] <= 1
    assert found.verdict in ("supported", "refuted", "undecided")
