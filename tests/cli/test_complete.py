"""``dhtorch complete``: files that say what was found, that are a recording again, and that a kill cannot spoil."""

import contextlib
import inspect
import io
import json
import shutil
from functools import cache

import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from support import writers

from dhtorch import MAP, data, export
from dhtorch.cli import complete, run
from dhtorch.codes import Gate, Source, names
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.geometry.camera import resize
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import completion, dense
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.pytree import stack
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz.plots import draw_completed

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


@pytest.mark.parametrize(
    ("option", "said_of_it"),
    [
        ({"format": "zip"}, "format: found 'zip', expected one of auto, frames, tum, stray, png"),
        ({"format": "tum"}, "format=tum: numbered has no time stamps"),
        ({"format": "stray"}, "numbered is a frames_dir recording, not a Stray"),
        ({"unit": 0}, "unit: found 0"),
        ({"unit": 1}, "unit: found 1"),
        ({"steps": []}, "steps: found none"),
        ({"source_views": 0}, "source_views is 0"),
        ({"size": 3}, "size is 3"),
        ({"sensor": "kinect"}, "sensor: found 'kinect', expected one of"),
    ],
)
def test_bad_options_are_named_and_leave_nothing(captures, tmp_path, option, said_of_it):
    with pytest.raises(ValueError, match=said_of_it):
        said(captures / "numbered", tmp_path / "maps", **option)
    assert not (tmp_path / "maps").exists()


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
    defaults = {k: p.default for k, p in inspect.signature(completion.complete_depth).parameters.items()}
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
