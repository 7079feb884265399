"""Experiments of the paper on small rooms: cohorts, variants, hidden returns, and verdicts both ways."""

from dataclasses import replace

import pytest
import torch
from support.paper_protocol_runs import configured_method, outcome_of_rows, small_room
from support.rooms import Changed, room_scene, untold

from dhtorch.cli.run import config_dir, main
from dhtorch.data.pairs import by_gap
from dhtorch.experiments import pair
from dhtorch.experiments.cohorts import HeldOut, far_real_holes, trajectory_pose, trajectory_pose_fit
from dhtorch.experiments.paper import (
    ablation,
    calibration,
    device_pose,
    gate_ablation,
    heldout,
    hole_census,
    motion,
    range_split,
    real_holes,
)
from dhtorch.experiments.protocol import Batch, Settings, far_truth, held_back_truth
from dhtorch.geometry import se3
from dhtorch.metrics import holdout
from dhtorch.metrics.correlation import _ranks
from dhtorch.records import Pose
from dhtorch.runtime import results as result_files


def asked(experiment, *rooms, **options):
    scenes = [room_scene(each, gap=3) for each in rooms or [small_room()]]
    return experiment.run(scenes, {"paper": configured_method()}, by_gap, Settings(), **options)


def scene(outcome, variant, cohort="full"):
    (row,) = outcome.scenes(variant, cohort).values()
    return row


def batch_of(recording, i=0, j=3):
    nothing = torch.full((1,), torch.nan)
    return Batch(
        room_scene(recording),
        [(i, j)],
        2.0,
        recording[i],
        (recording[j],),
        recording[i],
        nothing.view(1, 1, 1),
        nothing,
    )


def test_set_b_is_hidden_from_the_method_and_measured_by_its_returns():
    recording, seen = small_room(), {}

    def pose(samples, tracks, *rest, **options):
        seen.setdefault("xyz", samples.xyz)
        return base.pose(samples, tracks, *rest, **options)

    base = configured_method()
    split = HeldOut(base, Settings(seed=3))
    trace = {}
    variant = split.variant().method.replace(pose=pose)
    variant(recording[0], recording[3], trace=trace)
    whole = split.whole(batch_of(recording), trace["samples"].uv)
    first, second = holdout.split_half(whole, 3)
    assert bool(torch.equal(seen["xyz"].isfinite().all(-1) & (whole.trackability >= 1e-5), first))
    assert not bool((first & second).any()) and 0.4 < float(first.sum() / (first | second).sum()) < 0.6
    assert not bool(trace["samples"].depth[second].any()), "no stage can read a hidden return"
    assert not bool((trace["fit"].inlier & second).any())
    truth = split.heldout(batch_of(recording), trace)
    assert bool((~truth.ok | second).all()) and int(truth.ok.sum()) > 100
    naive = split.cyclic(batch_of(recording), trace)
    assert bool((~naive.ok | trace["fit"].inlier).all()) and not bool((naive.ok & truth.ok).any())


@pytest.mark.slow
def test_heldout_rows_and_strict_line():
    outcome = asked(heldout, small_room(lidar="exact"))
    row = scene(outcome, "paper", "heldout")
    assert (
        row["passes"] is True
        and row["corr"] > 0.93
        and row["median_rel"] < 0.07
        and outcome.summary["paper.n_passes"]["value"] == 1
    )
    assert outcome.summary["paper.n_scenes"]["value"] == 1
    assert {"paper.cyclic.median_rel", "paper.median_rel"} <= set(outcome.summary)
    good = {"n_kept": 10, "corr": 0.81, "median_rel": 0.09, "residual_px": 2.9}
    assert heldout.passes_strict_line(good)
    for worse in ({"n_kept": 9}, {"corr": 0.8}, {"median_rel": 0.1}, {"residual_px": 3.0}, {"corr": None}):
        assert not heldout.passes_strict_line(good | worse)


@pytest.mark.slow
def test_recovered_holes_reach_beyond_the_sensor():
    row = scene(asked(heldout, small_room(range_limit=2.0)), "paper", "heldout")
    assert row["n_recovered"] > 300 and row["reach_p95_m"] > 1.3 * row["returns_max_m"] > 1.3 * 1.5


@pytest.mark.slow
def test_range_split_has_one_cohort_for_all_variants():
    recording = small_room(trajectory_axes="gl", trajectory_offset_deg=5.0)
    outcome = asked(range_split, recording, cutoffs=(1.5,), cutoff_factors=(1.25,))
    five = ("sensor_only", "device_raw", "device_gl_to_cv", "no_gates", "gated")
    found = {v: scene(outcome, v) for v in five}
    assert len({r["n_candidates"] for r in found.values()}) == 1
    assert found["sensor_only"]["n_kept"] == 0 and found["gated"]["coverage"] > 0.8
    assert found["device_raw"]["coverage"] < 0.02 and found["device_gl_to_cv"]["coverage"] > 0.8
    assert found["gated"]["n_kept"] <= found["no_gates"]["n_kept"]
    assert found["gated"]["gate_share"]["answer"] < found["no_gates"]["gate_share"]["answer"]
    assert scene(outcome, "gated, cutoff 1.5 m")["cutoff_m"] == 1.5
    assert scene(outcome, "gated, cutoff x1.25")["cutoff_m"] == 2.5
    assert {f"{v}.coverage" for v in five} | {"gated, cutoff 1.5 m.pnp_success"} <= set(outcome.summary)


@pytest.mark.slow
def test_real_holes_beyond_the_cutoff_are_counted_apart():
    """Independent truth knows depth where the sensor has none: those samples are in a cohort of their own."""
    recording = small_room()
    outcome = asked(range_split, recording, cutoff_factors=())
    for variant in ("sensor_only", "gated"):
        masked, holes = scene(outcome, variant), scene(outcome, variant, "real_holes")
        assert masked["n_candidates"] > 100 and holes["n_candidates"] > 30
        assert masked["n_real_holes"] > holes["n_candidates"], "counted before the truth test and the texture limit"
    batch, samples = batch_of(recording), configured_method().sample_depth(holdout.range_split(recording[0], 2.0))
    batch = replace(batch, exact=recording[0].replace(depth=recording.truth(0)["depth"], depth_camera=None))
    held, far = (of(batch, {"samples": samples}) for of in (held_back_truth, far_truth))
    sensor = holdout.sample_truth(recording[0], samples.uv, truth="raw").depth
    assert bool((sensor[held.ok] > 2).all()) and not bool(samples.usable[held.ok].any())
    apart = far_real_holes(batch, {"samples": samples})
    assert bool((sensor[apart.ok] == 0).all()) and bool((apart.depth[apart.ok] > 2).all())
    assert not bool((held.ok & apart.ok).any())
    remaining = far.ok & ~held.ok & ~apart.ok
    assert bool((sensor[remaining] > 0).all()) and bool((sensor[remaining] <= 2).all()), "a near return over far truth"


def test_a_recording_without_independent_truth_has_no_cohort_of_real_holes():
    outcome = asked(range_split, untold(small_room()), cutoff_factors=())
    assert {row["truth"] for row in outcome.rows} == {"full"}
    assert scene(outcome, "gated")["n_real_holes"] == 0 < scene(outcome, "gated")["n_candidates"]


def test_a_candidate_with_a_return_of_the_sensor_raises_with_the_scene():
    def rows(kept):
        return outcome_of_rows(
            ("attic", "sensor_only", "full", {"n_kept": kept}), ("attic", "gated", "full", {"n_kept": 7})
        )

    range_split.require_no_returns(rows(0).rows, "full")
    with pytest.raises(ValueError, match=r"attic 3.*expected none"):
        range_split.require_no_returns(rows(3).rows, "full")


@pytest.mark.slow
@pytest.mark.parametrize(
    "experiment",
    [
        range_split,
        *(
            pytest.param(each, marks=pytest.mark.slow)
            for each in (real_holes, device_pose, heldout, gate_ablation, calibration)
        ),
    ],
)
def test_the_protocols_take_the_truth_test_and_state_what_it_keeps(experiment):
    """Without a test every return is kept: more candidates, and a share of one."""
    options = {range_split: {"cutoff_factors": ()}, gate_ablation: {"factors": ()}}.get(experiment, {})
    scenes = [room_scene(small_room(), gap=3)]
    found = {}
    for test in ("raw", "full"):
        outcome = experiment.run(scenes, {"paper": configured_method()}, by_gap, Settings(truth=(test,)), **options)
        rows = [r for r in outcome.rows if r["pair"] is None and r["method"] != "sensor_only"]
        assert not ({"raw", "full"} - {test}) & {r["truth"] for r in rows}, "a cohort bears the name of its test"
        found[test] = {(r["method"], r["truth"].replace(test, "far")): r for r in rows if r["n_pairs"]}
    assert found["raw"].keys() == found["full"].keys() != set()
    for key, raw in found["raw"].items():
        full = found["full"][key]
        assert raw["truth_kept"] == 1 > full["truth_kept"], key
        assert raw["n_candidates"] > full["n_candidates"] > 0, key


@pytest.mark.slow
def test_a_method_that_states_no_sigma_has_no_number_of_it():
    methods = {name: configured_method(name) for name in ("paper", "opencv", "map")}
    outcome = pair.run([room_scene(small_room(), gap=3)], methods, by_gap, Settings())
    for name in ("paper", "opencv"):
        row = scene(outcome, name)
        assert [row[k] for k in ("within_sigma", "within_2sigma", "ece", "ece_equal_mass")] == [None] * 4, name
        assert row["aurc"] is not None and outcome.summary[f"{name}.within_sigma"]["value"] is None
    row = scene(outcome, "map")
    assert 0 < row["within_sigma"] <= row["within_2sigma"] and row["ece"] is not None
    assert bool(outcome.points["synthetic_room", "map", "full"].answered().sigma.isfinite().all())


def test_a_scene_without_a_trajectory_or_truth_says_so():
    blind = Changed(small_room(), lambda f: f.replace(T_world_from_cam=None), poses=None)
    outcome = asked(range_split, blind, cutoff_factors=())
    assert scene(outcome, "device_raw")["note"] == "no device trajectory"
    assert scene(outcome, "gated")["n_candidates"] > 0
    outcome = asked(real_holes, untold(small_room()))
    assert (
        outcome.verdict == "undecided"
        and scene(outcome, "gated", "real_holes")["note"] == "no independent ground truth"
    )


def test_real_holes_are_drop_outs_with_known_depth():
    recording = small_room()
    outcome = asked(real_holes, recording)
    row, hidden = scene(outcome, "gated", "real_holes"), scene(outcome, "gated", "full")
    assert 0 < row["n_candidates"] < hidden["n_candidates"]
    assert row["n_dropped"]["excluded"] > 0 and "drop-outs on 1 of 1 scenes" in outcome.why


def test_raw_trajectory_forgets_the_conversion_and_nothing_else():
    recording = small_room(trajectory_axes="gl")
    T, raw = trajectory_pose(batch_of(recording)), trajectory_pose(batch_of(recording), raw=True)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    assert torch.allclose(raw.R, flip @ T.R @ flip, atol=1e-6) and torch.allclose(raw.t, T.t @ flip, atol=1e-6)
    as_written = Pose(recording[0].T_world_from_cam.R @ flip, recording[0].T_world_from_cam.t)
    other = Pose(recording[3].T_world_from_cam.R @ flip, recording[3].T_world_from_cam.t)
    assert torch.allclose(se3.relative(as_written, other).R, raw.R, atol=1e-5)
    same = batch_of(small_room())
    assert torch.equal(trajectory_pose(same, raw=True).R, trajectory_pose(same).R)
    none = batch_of(recording)
    none = Batch(**{**vars(none), "reference": none.reference.replace(T_world_from_cam=None)})
    assert not bool(trajectory_pose_fit(none, 5).ok.any())


@pytest.mark.slow
def test_device_pose_measures_the_disagreement():
    outcome = asked(device_pose, small_room(trajectory_offset_deg=15.0, lidar="exact"))
    anchored, given = (scene(outcome, v, "heldout") for v in ("anchored", "device_gl_to_cv"))
    assert given["rotation_deg"] == pytest.approx(0, abs=0.05) and given["translation_m"] == pytest.approx(0, abs=1e-5)
    assert 3.0 < anchored["direction_deg"] < 15.0, "axes turned by 15 degrees turn the baseline by up to as much"
    assert anchored["median_rel"] < given["median_rel"]


@pytest.mark.slow
def test_gates_and_gaps():
    outcome = asked(gate_ablation, small_room(n_frames=7), gaps=(16,), factors=(2.0,))
    both, free = (scene(outcome, v, "heldout") for v in ("both gates", "parallax gate off"))
    assert both["n_candidates"] == free["n_candidates"] and both["n_kept"] <= free["n_kept"]
    assert both["gate_share"]["parallax"] > 0 == free["gate_share"]["parallax"]
    assert both["gate_share"]["answer"] < free["gate_share"]["answer"]
    assert scene(outcome, "gap 16", "heldout")["note"] == "too short"
    assert scene(outcome, "gap x2", "heldout")["n_pairs"] == 1


@pytest.mark.slow
def test_recovery_rises_with_the_baseline():
    rooms = [
        room_scene(Changed(small_room(n_frames=6, hw=(144, 192), path=path), name=f"synthetic_{path}"), gap=2)
        for path in ("walk", "static")
    ]
    outcome = asked(motion, *rooms, factors=(0.5, 1.0, 2.0))
    walking = [r for r in outcome.rows if r["scene"] == "synthetic_walk" and r["pair"] is None]
    still = [r for r in outcome.rows if r["scene"] == "synthetic_static" and r["pair"] is None]
    baselines = [r["baseline_m"] for r in walking]
    assert (
        baselines == sorted(baselines)
        and walking[0]["rank_corr_recovered"] > 0.6
        and walking[0]["rank_corr_error"] < -0.4
    )
    assert walking[0]["recovered_share"] < walking[1]["recovered_share"]
    assert len(still) == 3 and all(r["coverage"] < 0.02 for r in still), (
        "a static camera has no parallax to answer from"
    )
    assert outcome.verdict == "supported" and not any(k.startswith("synthetic_static") for k in outcome.summary)


def test_ranks_share_ties():
    assert _ranks(torch.tensor([3.0, 1.0, 3.0, 2.0])).tolist() == [2.5, 0.0, 2.5, 1.0]


def test_census_counts_every_class_once():
    outcome = hole_census.run([small_room()], {"paper": configured_method()}, by_gap, Settings(), stride=2)
    row = next(r for r in outcome.rows if r["pair"] is None)
    frames = [r for r in outcome.rows if r["pair"] is not None]
    assert len(frames) == 3 and row["n_samples"] == 3 * 1024
    for group in ("hole_share", "route_share"):
        assert sum(row[group].values()) == pytest.approx(1)
    assert row["hole_rate"] == pytest.approx(sum(r["n_holes"] for r in frames) / row["n_samples"])
    assert outcome.summary["hole_share.trackable_no_lidar"]["value"] == row["hole_share"]["trackable_no_lidar"]
    full = hole_census.run(
        [small_room(lidar="exact", hw=(96, 128))], {"paper": configured_method()}, by_gap, Settings(), stride=5
    )
    assert full.verdict == "undecided", "no hole, no census"


@pytest.mark.slow
def test_calibration_reads_thresholds_off_the_same_answers():
    thresholds = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.5)
    outcome = asked(calibration, small_room(lidar="exact"), thresholds=thresholds)
    row = scene(outcome, "paper")
    points = outcome.points["synthetic_room", "paper", "full"]
    counts = [int((points.answered().score >= t).sum()) for t in thresholds]
    assert [row[f"at_{t}"]["n_kept"] for t in thresholds] == counts and len({*counts}) > 2
    shares = [row[f"at_{t}"]["coverage"] for t in thresholds]
    assert shares == pytest.approx([n / len(points.error) for n in counts])
    assert {"ece", "heldout.ece", "at_0.1.median_rel", "paper.ece_pooled"} <= {
        k.removeprefix("paper.") if "ece_pooled" not in k else k for k in outcome.summary
    }
    assert outcome.summary["paper.ece_pooled"]["value"] == pytest.approx(row["ece"])


@pytest.mark.slow
def test_ablation_changes_one_thing_at_a_time():
    outcome = asked(
        ablation,
        small_room(lidar="exact"),
        n=(256,),
        windows=(15,),
        others={"opencv": configured_method("opencv")},
        wholes={"map": configured_method("map")},
    )
    variants = {r["method"] for r in outcome.rows}
    parts = {f"{sign} {stage} of map" for sign in "+-" for stage in ("track", "pose", "triangulate", "score")}
    singles = {"paper", "sampler grid", "sampler vogel", "n 256", "window 15", "opencv", "map", "cutoff x0.5"}
    assert variants == singles | parts and "of map" not in outcome.why
    assert outcome.summary["- pose of map.median_rel_ratio"]["value"] > 0
    assert scene(outcome, "n 256")["n_candidates"] < scene(outcome, "paper")["n_candidates"]
    ratio = outcome.summary["window 15.median_rel_ratio"]["value"]
    ours, base = (scene(outcome, v)["median_rel"] for v in ("window 15", "paper"))
    assert ratio == pytest.approx(ours / base)


#: Where the built-in rooms are not what an experiment asks for, or its own sizes are those of a measurement.
SMALLER = {
    "ablation": ["experiment.n=[128]", "experiment.windows=[15]"],
    "defocus": ["data=synthetic_views"],
    "defocus_fusion": ["data=synthetic_views"],
    "focus_stack": ["data=synthetic_views", "experiment.slices=5"],
    "align_study": ["experiment.reference_views=1", "experiment.size=64", "experiment.faults=[simulated]"],
    "dense_comparison": [
        *(
            "experiment.reference_views=1",
            "experiment.sweep.planes=16",
            "experiment.sweep.size=128",
            "experiment.rooms=[]",
        ),
        *("experiment.rotations.hw=[96,128]", "experiment.rotations.n_frames=4", "experiment.rotations.gap=2"),
    ],
    "icp": ["experiment.n=256", "experiment.links=2"],
    "latency": [
        *("experiment.sizes=[[96,128]]", "experiment.n=128", "experiment.rounds=1", "experiment.peak=false"),
        *("experiment.front_end_repeats=1", "experiment.pair_repeats=1", "experiment.dinov2_repeats=1"),
        *(
            "experiment.warm_up=0",
            "experiment.dinov2.hidden=24",
            "experiment.dinov2.layers=1",
            "experiment.dinov2.heads=2",
        ),
    ],
    "method_comparison": ["experiment.seeds=1"],
    "rh20t_probe": [
        *("data=rh20t_synthetic", "data.hw=[72,128]", "data.tasks=3", "data.scenes=1"),
        *("experiment.dinov2=null", "experiment.n_folds=3"),
    ],
    "vo_probe": [
        *("data=synthetic", "data.n_frames=12", "data.gap=3", "data.supersample=1"),
        *("experiment.dinov2=null", "experiment.min_pairs=2", "experiment.blocks=3"),
    ],
}
#: ``downstream_probe`` reads sets that ``dhtorch enrich`` wrote: tests/experiments/test_probes.py.
NAMES = sorted({path.stem for path in (config_dir() / "experiment").glob("*.yaml")} - {"downstream_probe"})
QUICK = ("heldout", "hole_census")


@pytest.mark.slow
@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in NAMES])
def test_every_experiment_of_the_settings_runs_from_the_command(name, tmp_path, capsys):
    small = ["data.hw=[96,128]", "figures=false", "method.n=256", f"output={tmp_path}", *SMALLER.get(name, ())]
    if not any(option.startswith("data=") for option in small):
        small += ["data.n_frames=4", "data.gap=2", "data.supersample=1"]
    assert main([f"experiment={name}", *small]) == 0, capsys.readouterr().err
    assert "wrote" in capsys.readouterr().out
    result = result_files.read_result(tmp_path / "result.json")
    assert result["experiment"] == name and result["rows"]
    assert name in ("pair",) or result["verdict"] in ("supported", "refuted", "undecided")
