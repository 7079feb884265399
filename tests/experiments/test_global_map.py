"""Global maps: the counts of the experiment, and verdicts both ways."""

import pytest
from support.paper_protocol_runs import configured_method
from support.rooms import Changed, room_scene

from dhtorch.data.pairs import by_gap
from dhtorch.experiments.paper import global_map as experiment
from dhtorch.experiments.protocol import Settings
from dhtorch.synthetic.recording import SyntheticRoom

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def room(**options):
    return SyntheticRoom(**{"hw": (240, 320), "n_frames": 4, "step_m": 0.04, "supersample": 1, **options})


def asked(recording):
    return experiment.run(
        [room_scene(recording, gap=2)], {"paper": configured_method()}, by_gap, Settings(), n=700, voxel=0.03
    )


@pytest.fixture(scope="module")
def outcome():
    return asked(room())


def test_four_maps_of_one_room(outcome):
    found = {v: outcome.scenes(v, experiment.MAP_TRUTH)["synthetic_room"] for v in experiment.VARIANTS}
    device, fused = found["sensor device"], found["fused device"]
    assert device["n_voxels"] > 300 and fused["n_voxels"] > device["n_voxels"] and fused["n_recovered"] > 50
    assert fused["voxels_vs_sensor"] == fused["n_voxels"] / device["n_voxels"]
    assert device["right_share"] > 0.99, "what the sensor says with a cutoff it also says without"
    assert 0.3 < fused["right_share"] < device["right_share"]
    assert fused["n_fragments"] == 1 and found["fused anchored"]["n_fragments"] >= 1
    assert [r["pair"] for r in outcome.rows if r["pair"] and r["method"] == "fused device"] == [[0, 2], [1, 3]]
    links = [r["pair"] for r in outcome.rows if r["pair"] and r["method"] == "fused anchored"]
    assert links == [[0, 2], [1, 3], [0, 1], [1, 2], [2, 3]]


def test_the_weight_of_the_maps_can_be_the_confidence(outcome):
    other = experiment.run(
        [room_scene(room(), gap=2)], {"paper": configured_method()}, by_gap, Settings(), n=700, voxel=0.03,
        weight="confidence",
    )  # fmt: skip
    for variant in ("sensor device", "fused device"):
        ours, theirs = (o.scenes(variant, experiment.MAP_TRUTH)["synthetic_room"]["n_voxels"] for o in (other, outcome))
        assert ours == pytest.approx(theirs, rel=0.2), "the same frames"
    fused = [o.scenes("fused device", experiment.MAP_TRUTH)["synthetic_room"] for o in (other, outcome)]
    assert fused[0] != fused[1], "another weight is another surface"


def test_without_a_trajectory_there_are_maps_of_estimated_poses_alone():
    blind = Changed(room(n_frames=3), poses=None)
    found = asked(blind)
    assert found.verdict == "undecided" and found.why == "no scene with a trajectory"
    assert found.scenes("fused device", experiment.MAP_TRUTH)["synthetic_room"]["note"] == "nothing to estimate"
    assert found.scenes("fused anchored", experiment.MAP_TRUTH)["synthetic_room"]["n_voxels"] > 0
