"""Experiments of the paper on small rooms: cohorts, variants, hidden returns, and verdicts both ways."""

import pytest
import torch
from support.paper_protocol_runs import configured_method, outcome_of_rows, small_room
from support.rooms import room_scene

from dhtorch.cli.run import config_dir, main
from dhtorch.experiments.cohorts import HeldOut
from dhtorch.experiments.paper import (
    range_split,
)
from dhtorch.experiments.protocol import Batch, Settings
from dhtorch.metrics import holdout
from dhtorch.runtime import results as result_files


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


def test_a_candidate_with_a_return_of_the_sensor_raises_with_the_scene():
    def rows(kept):
        return outcome_of_rows(
            ("attic", "sensor_only", "full", {"n_kept": kept}), ("attic", "gated", "full", {"n_kept": 7})
        )

    range_split.require_no_returns(rows(0).rows, "full")
    with pytest.raises(ValueError, match=r"attic 3.*expected none"):
        range_split.require_no_returns(rows(3).rows, "full")


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
