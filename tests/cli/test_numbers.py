"""Numbers that commands write and choices that they make, each from values made by hand."""

import copy
import json
import math
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.stub_recordings import recording

from dhtorch.cli import (
    align,
    capture_checks,
    complete,
    completed_folder,
    enrich,
    enrich_page,
    errors,
    fetch,
    inspect,
    layouts,
    option_checks,
    pin,
    process_capture,
    recover_page,
    recover_pictures,
    scale,
    stream,
    sweep_state,
    validate,
    view,
)
from dhtorch.codes import Gate, Source, State, WrongCause
from dhtorch.export.lerobot import LogHistogram
from dhtorch.extract import plan
from dhtorch.extract.enriched import map_columns
from dhtorch.geometry import se3
from dhtorch.pipeline.picture_matching import spread_evenly
from dhtorch.records import Camera, Frame, Pose

# ------------------------------------------------------------------------------------------------------------- enrich


@pytest.fixture(scope="module")
def settings():
    """Options of ``dhtorch enrich`` that its data set depends on, and some that it does not."""
    return {
        "data": {"path": "one"},
        "method": {"n": 6},
        "choices": {"data": "auto", "method": "map"},
        "seed": 0,
        "format": "lerobot",
        "dense": True,
        "causal": True,
        "gap": "auto",
        "cameras": False,
        "pose": "device",
        "pose_sigma": None,
        "sensor": None,
        "columns": ["depth", "sigma"],
        "maps": "numbers",
        "max_frames": None,
        "every": 1,
        "step": 2**-10,
        "fps": None,
        "task": None,
        "on_error": "raise",
        "workers": 0,
        "report": True,
    }


@pytest.fixture(autouse=True)
def keys_of_settings_alone(monkeypatch):
    """Keys are their settings: what else enters them, the code among it, has tests of its own and takes seconds."""
    texts = lambda config, digest, roots: json.dumps(config, sort_keys=True)  # noqa: E731
    monkeypatch.setattr(enrich.result_files, "compute_result_key", texts)


def key_of(settings):
    whole = plan.make_plan([recording(2)], 1, 1)
    return enrich._build_metadata(settings, whole, map_columns(True))["key"]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("data", {"path": "one", "rate_hz": 5}),
        ("method", {"n": 7}),
        ("seed", 1),
        ("format", "v2.1"),
        ("dense", False),
        ("causal", False),
        ("gap", 3),
        ("cameras", True),
        ("pose", "start"),
        ("pose_sigma", [0.01, 0.02]),
        ("sensor", "kinect_v2"),
        ("columns", ["depth"]),
        ("maps", "images"),
        ("max_frames", 5),
        ("every", 2),
        ("step", 0.0),
        ("fps", 12.0),
        ("task", "fold"),
        ("on_error", "flag"),
        ("choices", {"data": "lerobot", "method": "map"}),
    ],
)
def test_a_set_of_other_options_has_another_key(option, value, settings):
    changed = copy.deepcopy(settings) | {option: value}
    assert key_of(changed) != key_of(settings)


def test_how_a_set_is_computed_is_no_part_of_its_key(settings):
    assert key_of(settings | {"workers": 3, "report": False}) == key_of(settings)


def test_pose_options_reach_the_transform(settings):
    assert enrich._pose_options(settings | {"pose": "near"}) == {}
    options = enrich._pose_options(settings | {"pose_sigma": [0.1, 0.2]})
    assert options == {"pose": "pose", "pose_cov": [0.1, 0.2], "refine": False}
    assert enrich._pose_options(settings | {"pose": "start"})["refine"] is True


def test_shards_go_to_the_recording_and_episode_of_their_rows():
    scenes = [recording(5, name="a", episode=4), recording(3, name="b", episode=4), recording(4, name="c", episode=9)]
    whole = plan.make_plan(scenes, 1, 1, rigs=True)
    assert enrich._group_by_episode(whole) == [[0, 1], [2]]
    pieces = whole.shards(2, apart=True)
    grouped = enrich._group_shards(pieces, whole, [0, 1])
    assert [[(p.rows.start, p.rows.stop) for p in grouped[n]] for n in (0, 1)] == [
        [(0, 2), (2, 4), (4, 5)],
        [(5, 7), (7, 8)],
    ]


def camera(pixels, no_answer, sigma_rel=()):
    counts = np.zeros(max(Source.NONE, Source.SENSOR, Source.RECOVERED, Source.SWEPT, Source.FILLED) + 1, int)
    for code, n in pixels.items():
        counts[code] = n
    reasons = np.zeros(max(enrich_page.NO_ANSWER_REASONS) + 1, int)
    for code, n in no_answer.items():
        reasons[code] = n
    bins = LogHistogram.of(np.array(sigma_rel)).pack()
    return {"pixels": counts.tolist(), "no_answer": reasons.tolist(), "recovered_sigma_rel_bins": bins}


def test_a_page_counts_pixels_of_each_camera_by_their_source():
    rows = [
        camera({Source.SENSOR: 10, Source.SWEPT: 5, Source.NONE: 5}, {Gate.NO_TRACK: 4, Gate.PARALLAX: 1}, [0.02] * 5),
        camera(
            {Source.SENSOR: 30, Source.RECOVERED: 2, Source.FILLED: 3, Source.NONE: 45}, {Gate.NO_TRACK: 45}, [0.1] * 2
        ),
    ]
    owns = [{"cameras": {"left": rows[0], "right": rows[1]}}, {"cameras": {"left": rows[1]}}]
    left, right = enrich_page.summarise_cameras(owns)
    assert (left.name, right.name) == ("left", "right")
    assert left.kinds == pytest.approx({"recovered": 0.07, "filled": 0.03, "sensor": 0.4, "no_answer": 0.5})
    assert list(left.reasons.values()) == pytest.approx([0.49, 0.01]), "the most frequent reason first"
    assert right.kinds == pytest.approx(
        {"recovered": 2 / 80, "filled": 3 / 80, "sensor": 30 / 80, "no_answer": 45 / 80}
    )
    assert (left.sigma_rel, right.sigma_rel) == pytest.approx((0.02, 0.1), rel=0.03), "of 5 and 2 pixels, to a bin"
    assert next(iter(right.format_kinds().values())).startswith("2.5% (median sigma 1"), "recovered leads"
    assert enrich_page._pixel_shares([{"pixels": [], "no_answer": []}])[0]["no_answer"] == 1.0


def test_shares_over_time_are_averaged_over_episodes_of_any_length():
    owns = [{"cameras": {"a": {"x": [[0.0, 1.0], [1.0, 0.0]]}}}, {"cameras": {"a": {"x": [[1.0, 1.0]] * 3}}}]
    ((name, mean),) = enrich_page._average_over_episodes(owns, "x")
    assert name == "a" and np.allclose(mean.T, [[0.5, 1.0], [0.75, 0.75], [1.0, 0.5]])
    assert enrich_page._describe_readings({"the inverse": 3}) == "; they fit as the inverse"
    assert "(3)" in enrich_page._describe_readings({"the inverse": 3, "unknown": 1})


# ----------------------------------------------------------------------------------------------- align and validate


def aligned(**fields):
    depth = torch.tensor([[[2.0, 4.4, 0.0, 8.0]]])
    keep = torch.tensor([[[True, True, False, True]]])
    return SimpleNamespace(depth=depth, sigma=0.1 * depth, keep=keep, **fields)


def selected(model):
    return SimpleNamespace(
        model=torch.tensor([model]), names=("raw", "scale"), weight=torch.tensor([[0.7, 0.3]]), family=None
    )


def test_a_frame_states_its_scale_its_change_and_its_gaps():
    x = torch.tensor([[[2.0, 4.0, 5.0, 4.0]]])
    row = align._summarise_frame(x, aligned(), selected(1))
    assert (row["model"], row["likeliest"]) == ("scale", "raw")
    assert (row["probability"], row["likeliest_probability"]) == (pytest.approx(0.3), pytest.approx(0.7))
    assert row["scale"] == pytest.approx(1.1) and row["change"] == pytest.approx(0.1) and row["no_answer"] == 0.25
    assert row["sigma"] == pytest.approx(0.1)
    nothing = align._summarise_frame(x, SimpleNamespace(keep=x < 0), selected(-1))
    assert nothing["model"] is nothing["scale"] is None and nothing["no_answer"] == 1.0


def test_a_recording_states_medians_of_what_was_aligned_and_its_gaps():
    frames = [
        {"model": "scale", "scale": s, "change": abs(s - 1), "sigma": 0.1, "no_answer": n, "near": k, "far": 2 * k}
        for k, (s, n) in enumerate([(0.8, 0.0), (0.9, 0.5), (1.3, 0.1)])
    ]
    frames.append(dict.fromkeys(("model", "scale", "change", "sigma")) | {"no_answer": 1.0, "near": 9, "far": 0})
    summary = align._summarise_recording([{"aligned": row} for row in frames])
    assert summary["median"]["scale"] == 0.9 and summary["models"] == {"scale": 3}
    limited = summary["limited"]
    assert limited["scale"] == pytest.approx(0.1) and limited["no_answer"] == pytest.approx(0.4)
    assert limited["unaligned"] == 0.25 and summary["references"] == {"near": 1.5, "far": 1.0}
    assert [align._severity(frame) for frame in frames] == pytest.approx([0.1, 0.6, 0.2, 2.0])


def test_a_validated_frame_counts_pixels_with_depth_alone():
    depth = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 0.0]]])
    state = torch.tensor([[[State.WRONG, State.CONSISTENT, State.WRONG, State.CANNOT_KNOW, State.WRONG]]])
    cause = torch.zeros_like(state)
    cause[0, 0, 2::2] = next(code for name, code in vars(WrongCause).items() if name.isupper() and code)
    interval = torch.tensor([[1.0, 0.9, 1.1]])
    fields = dict.fromkeys(validate._INTERVAL_FIELDS, interval) | {validate._INTERVAL_FIELDS[0]: interval * torch.nan}
    evidence = torch.tensor([[[5.0, -4.0, 0.5, torch.nan, 9.0]]])
    kinds = dict.fromkeys(("sparse_evidence", "photometric_evidence", "consistency_evidence"), evidence)
    row = validate._summarise_frame(
        7,
        SimpleNamespace(depth=depth, state=state, cause=cause, clip_depth=torch.tensor([torch.nan]), **fields, **kinds),
    )
    assert (row["frame"], row["pixels"], row["share_wrong"], row["share_cannot_know"]) == (7, 4, 0.5, 0.25)
    assert sum(row["wrong_causes"].values()) == 1 and row["clip_depth"] is None
    assert row["sparse_evidence"] == {"coverage": 0.75, "against": 2}
    assert row[validate._INTERVAL_FIELDS[0]] is None
    last = row[validate._INTERVAL_FIELDS[-1]]
    assert [last[k] for k in ("value", "low", "high")] == pytest.approx([1.0, 0.9, 1.1])
    assert validate._severity({"share_wrong": None}) < validate._severity({"share_wrong": 0.0})


def test_limits_are_exceeded_from_above_and_by_known_numbers_alone():
    known = {"wrong": "share", "scale": "difference"}
    limits = validate.parse_limits("wrong>0.05,scale>0.1", known)
    assert limits == {"wrong": 0.05, "scale": 0.1} and validate.parse_limits(None, known) == {}
    lines = validate.list_exceeded_limits({"limited": {"wrong": 0.2, "scale": None}}, limits, known)
    assert lines == ["wrong is 0.2, limit 0.05 (share)"]
    assert not validate.list_exceeded_limits({"limited": {"wrong": 0.05, "scale": 0.01}}, limits, known)
    with pytest.raises(ValueError, match="fail_on: found 'tilt>1'"):
        validate.parse_limits("tilt>1", known)


def test_every_so_many_frames_of_those_with_a_map():
    scene = recording(7)
    assert validate.RecordingValidation(scene, None).frame_positions(3) == [0, 3, 6]
    maps = SimpleNamespace(frames=[1, 2, 5, 6], doubts=["d"], notes=["n"])
    validated = validate.RecordingValidation(scene, maps, rows=[{"frame": 4, "x": 1}])
    assert validated.frame_positions(2) == [1, 5] and validated.notes == ["d", "n"]
    assert validated.by_number == {4: {"frame": 4, "x": 1}}


# ----------------------------------------------------------------------------------------------------------- complete


def test_pixels_are_counted_by_source_and_gaps_by_reason():
    source = np.array([[Source.SENSOR, Source.SWEPT, Source.SWEPT, Source.NONE]])
    gate = torch.tensor([[[Gate.ANSWER, Gate.ANSWER, Gate.PARALLAX, Gate.PARALLAX]]])
    steps = SimpleNamespace(source=source, unfit=np.array([[True, False, False, False]]))
    row = complete._count_pixels(steps, SimpleNamespace(gate=gate))
    assert row["pixels"] == {"sensor": 1, "swept": 2, "none": 1}
    assert row["no_answer"] == {"parallax": 0.5, "unfit": 0.25}
    kinds = completed_folder.count_pixels({"pixels": row["pixels"] | {"recovered": 4, "filled": 3}})
    assert list(kinds.items()) == [("recovered", 6), ("filled", 3), ("sensor", 1), ("no_answer", 1)]


def test_motions_are_those_of_the_views_that_were_solved():
    poses = [se3.exp(torch.tensor([[0.1 * k, 0.0, 0.0, k, 0.0, 0.0]])) for k in (1, 2, 3)]
    fits = [SimpleNamespace(ok=torch.tensor([k != 1]), T_1_from_0=T) for k, T in enumerate(poses)]
    rows = complete._solved_motions([10, 20, 30], {"views": [{"fit": fit} for fit in fits], "fit": fits[1]})
    assert list(rows) == ["10", "30"]
    for name, T in (("10", poses[0]), ("30", poses[2])):
        torch.testing.assert_close(rows[name], se3.to_matrix(T)[0])


def test_a_picture_is_resized_by_areas():
    image = torch.tensor([[0.0, 1.0, 0.5, 0.5], [1.0, 0.0, 0.5, 0.5]]).expand(1, 3, 2, 4)
    frame = Frame(image, torch.ones(1, 2, 4), Camera(torch.ones(1, 2), torch.ones(1, 2)))
    small = complete.resize_picture(frame, (1, 2))
    assert (
        small.shape == (1, 2, 3)
        and small[0, 0, 0] in (127, 128)
        and complete.resize_picture(frame, (2, 4))[0, 1, 2] == 255
    )


def test_a_layout_names_files_and_steps():
    stamped = layouts.Layout("tum", 1 / 5000, pictures="rgb", stamped=True)
    plain = layouts.Layout("png", 1e-3, confidence=True, budget=True)
    clip = recording(3, numbers=[4, 7, 9], times=torch.tensor([0.5, 1.25, 2.0]).double()).recording
    assert stamped.stem(clip, 1) == "1.250000" and plain.stem(clip, 1) == "000007"
    assert stamped.folders == ["depth", "sigma", "source", "rgb", "meta"]
    assert plain.folders == ["depth", "sigma", "source", "confidence", "budget", "meta"]
    assert plain.sigma_unit == pytest.approx(1e-3 / layouts.SIGMA_STEPS_PER_DEPTH_STEP)
    assert plain.reach == pytest.approx(65.535, abs=0.01) and stamped.reach == pytest.approx(13.107, abs=0.01)
    regular = recording(3, times=torch.tensor([0.0, 0.1, 0.2]).double(), rate_hz=10.0).recording
    assert layouts._frame_rate(regular) == 10.0 and layouts._frame_rate(clip) is None
    confidence = layouts.stray_confidence(np.array([Source.NONE, Source.SENSOR]))
    assert confidence.tolist() == [layouts._STRAY_CONFIDENCE[code] for code in (Source.NONE, Source.SENSOR)]
    assert confidence[0] == 0 and confidence[1] == 2
    rows = [{"K": 1, "distortion": None}, {"K": 1, "distortion": None}, {"K": 2, "distortion": None}]
    assert layouts.has_varying_camera(rows) and not layouts.has_varying_camera(rows[:2])
    assert layouts._find_lack("tum", regular, True) is None and "larger" in layouts._find_lack("tum", regular, False)
    assert "time stamps" in layouts._find_lack("tum", recording(2).recording, True)
    assert "pose" in layouts._find_lack("frames", regular, True)
    eye = Pose(torch.eye(3).expand(2, 3, 3), torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]]))
    assert "pose" in layouts._find_lack("frames", recording(2, poses=eye).recording, True)
    assert "made recording" in layouts._find_lack("stray", regular, True)


# ------------------------------------------------------------------------------------------------------------ recover


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 64, 100])
def test_any_first_part_of_an_order_is_spread_evenly(n):
    order = process_capture.order_evenly(n)
    assert sorted(order) == list(range(n))
    assert order[:3] == list(dict.fromkeys([n // 2, 0, n - 1]))[: min(n, 3)] if n else order == []
    for k in range(4, n):
        gaps = np.diff(sorted(order[:k]))
        assert gaps.max() <= 4 * n / k


def test_frames_are_picked_from_the_middle_of_their_parts():
    assert recover_pictures._pick_evenly(list(range(10)), 2) == [2, 7]
    assert recover_pictures._pick_evenly([3, 4], 5) == [3, 4]
    assert spread_evenly(list("abcdefg"), 3) == ["a", "d", "g"] and spread_evenly([], 3) == []
    assert pin._spread(10, 4) == [0, 2, 5, 7] and pin._spread(3, None) == pin._spread(3, 5) == [0, 1, 2]


def test_a_cutoff_is_the_median_return_rounded_up(monkeypatch):
    depths = {0: [1.0, 1.23, 9.0], 1: [2.0, 1.25, 0.0], 2: [0.0, 0.0, 0.0]}
    maps = lambda _task, i: ({"depth": np.array(depths[i])}, np.array([Source.SENSOR] * 3))  # noqa: E731
    monkeypatch.setattr(process_capture.completed, "read_completed_maps", maps)
    recovered = SimpleNamespace(task=None, frames=[0, 1, 2])
    assert process_capture._choose_cutoff(recovered) == pytest.approx(1.5), "of 1.23 and 1.625"
    assert process_capture._choose_cutoff(SimpleNamespace(task=None, frames=[2])) == process_capture._DEFAULT_CUTOFF_M


def test_recovery_is_averaged_over_frames_of_their_own_size(monkeypatch):
    rows = [
        {"pixels": {"sensor": 50, "swept": 25, "none": 25}, "no_answer": {"parallax": 0.2, "no_track": 0.05}},
        {"pixels": {"sensor": 10, "swept": 10, "filled": 10, "none": 10}, "no_answer": {"no_track": 0.25}},
    ]
    task = SimpleNamespace(name=str, done={"0": rows[0], "1": rows[1]})
    depth = np.linspace(1, 2, 101)
    monkeypatch.setattr(recover_page, "_read_recovered_pixels", lambda *_: (depth, 0.1 * depth))
    stats = recover_page.measure_recovery(task, [0, 1])
    numbers = [getattr(stats, name) for name in ("near", "far", "error")]
    assert numbers == pytest.approx([1.02, 1.98, 0.15])
    assert stats.frames == 2
    assert stats.fractions == pytest.approx({"recovered": 0.25, "filled": 0.125, "sensor": 0.375, "no_answer": 0.25})
    assert stats.pixels == {"recovered": 17.5, "filled": 5, "sensor": 30, "no_answer": 17.5}
    assert recover_page._average_no_answer_shares(rows) == pytest.approx({"parallax": 0.1, "no_track": 0.15})


def test_interpolated_pixels_are_never_called_recovered():
    scene = recording(3)
    task = SimpleNamespace(scene=scene, recording=scene.recording)
    fractions = {"recovered": 0.1, "filled": 0.3, "sensor": 0.4, "no_answer": 0.2}
    pixels = {kind: 10_000 * fraction for kind, fraction in fractions.items()}
    known = {"near": 2.04, "far": 5.0, "error": 0.037}
    told = {}
    for name, measured in (("some", known), ("none", {})):
        counts = {} if measured else {"recovered": 0.0}
        stats = recover_page.RecoveryStats(3, fractions | counts, pixels | counts, (), **measured)
        told[name] = recover_page.describe_recovery(task, stats, (4, 6), SimpleNamespace(findings=(), poses=None))[1]
        numbers = recover_page.build_opening([], stats, b"", "").numbers
        assert numbers["Recovered pixels per frame"] == ("1,000" if measured else "0")
        assert (numbers["Filled, fraction of the pixels"], next(iter(numbers))) == (
            "30.0%",
            "Recovered pixels per frame",
        )
    some = "Recovered 1,000 pixels per frame from other views, at 2.0 m to 5.0 m, median sigma 3.7% of the depth"
    assert told["some"] == f"{some}; filled 3,000 by interpolation (3 frames)."
    assert told["none"].startswith("Nothing was recovered: ")
    assert told["none"].endswith(" Filled 3,000 pixels per frame by interpolation.")


# ------------------------------------------------------------------------------------------------------------- others


def test_a_scale_is_stated_by_region():
    log = np.log(2.0) + np.array([0.1, 0.2, 0.3, -0.1, -0.1])
    local = SimpleNamespace(region=np.array([scale.REGIONS[1] + 1] * 3 + [0] * 2), log=log)
    first, second = scale._regions(SimpleNamespace(local=local, scale=2.0))
    assert first[:2] == (0, 0) and first[2] == pytest.approx(math.expm1(-0.1)) and first[3] == pytest.approx(0.0)
    assert second[:2] == (1, 1) and second[2] == pytest.approx(math.expm1(0.2))
    assert second[3] == pytest.approx(1.4826 * 0.1 / math.sqrt(3))
    Fault = namedtuple("Fault", "kind n")
    faults = [Fault(kind, n) for n, kind in enumerate("aabcade")]
    assert [fault.n for fault in scale._distinct(faults)] == [0, 2, 3, 5]


def test_progress_of_a_job_is_the_share_of_its_loops(tmp_path):
    (tmp_path / sweep_state._NOTES_FOLDER).mkdir(parents=True)
    wrap = sweep_state.record_progress(tmp_path, "job", 2)
    shares = []
    for loop in ("one", "two"):
        list(wrap(range(4), loop, 4))
        shares.append(sweep_state._read_progress(tmp_path / sweep_state._NOTES_FOLDER)[:2])
    assert shares == [(pytest.approx(0.5), 0), (pytest.approx(1.0), 1)]


def test_a_stream_reports_frames_back_holes_and_speed(monkeypatch):
    image, depth = torch.zeros(1, 3, 4, 6), torch.ones(1, 4, 6)
    pushed = []

    class Stream:
        cuts, nbytes = [], 3 * 2**20

        def __init__(self, method, *, steps, seed, hint):
            assert (steps, seed) == ((1, 2), 5)

        def push(self, frame, *, trace):
            pushed.append(frame)
            if len(pushed) == 2:
                self.cuts.append(1)
            trace["back"] = torch.tensor([[2], [1]])
            trace["samples"] = SimpleNamespace(usable=torch.tensor([[True, False, False, True]]))
            sigma = torch.tensor([[0.5, 0.06, torch.nan, torch.nan]])
            return SimpleNamespace(keep=torch.tensor([[True, True, False, False]]), sigma=sigma, depth=2 + 0 * sigma)

    ticks = iter([0.0, 0.25, 1.0, 1.25, 2.0, 2.5])
    monkeypatch.setattr(stream, "Stream", Stream)
    monkeypatch.setattr(stream.time, "perf_counter", lambda: next(ticks))
    frame = Frame(image, depth, Camera(torch.ones(1, 2), torch.ones(1, 2)))
    clip = SimpleNamespace(number=torch.tensor([3, 5, 9]), __len__=None)
    clip = type("Clip", (), {"number": clip.number, "__len__": lambda _: 3, "__getitem__": lambda _, k: frame})()
    options = {"steps": (1, 2), "seed": 5, "dtype": "float32", "device": "cpu", "cutoff": None}
    row = stream.stream_scene(
        SimpleNamespace(recording=clip, hint=None, name="a"), None, options, progress=lambda items, *_: items
    )
    assert [each["frame"] for each in row["frames"]] == [3, 5, 9] and [each["back"] for each in row["frames"]] == [
        [1, 2]
    ] * 3
    assert [each["cut"] for each in row["frames"]] == [False, True, False]
    assert all((each["n_holes"], each["n_recovered"]) == (2, 1) for each in row["frames"])
    assert row["recovered_sigma_rel"] == pytest.approx(0.03), "of the sample without a return"
    assert (
        "50.0% of the samples without a return recovered from other views (median sigma 3.0%"
        in stream._format_summary(row)
    )
    assert (
        row["ms_median"] == 250.0 and row["frames_per_second"] == 3.0 and row["recovered"] == 0.5 and row["mib"] == 3.0
    )


def test_captures_without_depth_are_those_of_which_no_frame_has_any():
    class Clip:
        def __init__(self, depths):
            self.depths = depths

        def __len__(self):
            return len(self.depths)

        def __getitem__(self, k):
            return SimpleNamespace(depth=torch.tensor([[[self.depths[k], 0.0]]]))

    assert capture_checks._count_without_depth(Clip([0.0] * 3)) == 3
    assert capture_checks._count_without_depth(Clip([0.0, 0.0, 1.0])) is None


def test_part_of_a_text_is_cut_by_rows_or_times():
    text = b"# head\n1.0 a\n2.0 b\n3.0 c\n"
    assert fetch._cut(text, {"rows": [1, 2]}) == b"1.0 a\n2.0 b\n"
    assert fetch._cut(text, {"times": [2.0, 3.0]}) == b"# head\n2.0 b\n3.0 c\n"


def test_a_thumbnail_keeps_its_shape_in_the_middle_of_its_cell():
    left, right, bottom, top = inspect._extent(2, (10, 20), 0.75)
    assert (right - left) / (top - bottom) == pytest.approx(2.0) and (left + right) / 2 == 2.5
    assert (bottom + top) / 2 == 0.375 and 0.9 < right - left < 1
    assert inspect._depth_limits(torch.tensor([2.0, 2.0])) == (2.0, pytest.approx(2.001))
    depth = torch.tensor([[[0.0, 3.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]]])
    assert inspect._nearest_per_block(depth, 2).tolist() == [[[2.0, 0.0]]]


def test_an_item_is_chosen_by_name_or_number():
    items = ["left", "right", "1"]
    chosen = [view._select_item(items, wanted, str) for wanted in (None, "right", 0, 1)]
    assert chosen == ["left", "right", "left", "1"], "a name before a number"
    with pytest.raises(ValueError, match="scene: found 7"):
        view._select_item(items, 7, str)


def test_rules_of_options_have_their_limits():
    whole, positive = option_checks._whole_number(2)[0], option_checks._above_zero()[0]
    least = option_checks._at_least_zero()[0]
    assert [whole(v) for v in (1, 2, 2.5, True)] == [False, True, False, False]
    assert [positive(v) for v in (0, 0.1, math.inf, -1)] == [False, True, True, False]
    assert [least(v) for v in (0, -0.1)] == [True, False]
    one_of = option_checks._one_of(1, "a", True)[0]
    assert [one_of(v) for v in (1, "a", 2)] == [True, True, False]
    null = option_checks._or_null(option_checks._whole_number(1))[0]
    assert null(None) and null(1) and not null(0)
    for value, hint, fits in [(1, int, True), ("a", int, False), ([1, 2], list[int], True), (["a"], list[int], False)]:
        assert option_checks._matches_hint(value, hint) == fits


def test_an_error_is_one_line_that_names_its_kind_unless_it_is_the_users():
    assert errors.format_error(ValueError("two\n lines")) == "two lines"
    assert errors.format_error(KeyError("name")) == "name"
    assert errors.format_error(ZeroDivisionError("x")).startswith("ZeroDivisionError: ")
    assert errors.format_error(FileNotFoundError(2, "No such file", "a")) == "a: No such file"


def episode(verdicts, shifts, changes=()):
    result = SimpleNamespace(verdict=torch.tensor(verdicts), shift_px=torch.tensor(shifts))
    made = object.__new__(pin.Episode)
    for name, value in (("result", result), ("changes", list(changes))):
        object.__setattr__(made, name, value)
    return made


def test_the_verdict_of_an_episode_is_that_of_most_known_pictures():
    moved, still, unknown = (getattr(pin.PinVerdict, k) for k in ("MOVED", "NOT_MOVED", "CANNOT_KNOW"))
    zero = [0.0] * 5
    assert episode([moved, moved, still, still, still], zero).verdict == still
    assert episode([moved, moved, moved, still, unknown], zero).verdict == moved
    assert episode([moved, moved, still, unknown, unknown], zero).verdict == moved, "two fifths unknown are no half"
    assert episode([moved, moved, unknown, unknown, unknown], zero).verdict == unknown
    assert episode([still] * 5, zero, changes=[3]).verdict == moved


@pytest.mark.parametrize("value", [0, 2.5])
def test_a_view_of_no_frames_is_refused(value):
    options = {"scene": None, "dtype": "float32", "max_frames": value}
    with pytest.raises(ValueError, match=f"max_frames: found {value}"):
        view._compute_exhibit({"data": recording(2)}, options, lambda _: None, lambda items, *_: items)
