"""The study of stated uncertainty on scenes whose answers are given: its numbers, its halves and its verdict."""

import pytest
import torch
from support.numbered_frames import FAR, choosing, scene

from dhtorch.codes import Gate
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.compare import uncertainty_study
from dhtorch.experiments.protocol import Settings
from dhtorch.records import Estimate


def off_by(ratio, step=2):
    """A method that answers every ``step``-th sample ``ratio`` too far with a sigma of 1 %, whatever the view."""

    def triangulate(samples, *_):
        unanswered = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2)
        says = torch.arange(samples.uv.shape[1]).expand_as(samples.depth) % step == 0
        depth = torch.where(says, (1 + ratio) * FAR, torch.nan)
        gate = torch.where(says, Gate.ANSWER, unanswered.gate)
        return unanswered.replace(depth=depth, sigma=depth / 100, sigma_shared=0 * depth, gate=gate)

    return choosing(1).replace(triangulate=triangulate)


def study(ratio=0.0, **options):
    given = {"methods": {"auto": off_by(ratio)}, "rooms": [scene("exact")], "floors": {"h": 1.0, "hall": 0.02}}
    return uncertainty_study.run([scene("hall"), scene("attic")], {}, by_gap, Settings(), **given | options)


@pytest.fixture(scope="module")
def outcome():
    return study()


def test_scene_rows_have_the_numbers_and_the_halves_are_gone(outcome):
    rows = outcome.scenes("auto")
    assert {row["method"] for row in outcome.rows} == {"auto"} and list(rows) == ["hall", "attic", "exact"]
    for row in rows.values():
        assert row["interval_1"] == row["interval_2"] == 1.0 and row["worst_bias"] == pytest.approx(0, abs=1e-6)
        assert row["chi2"] == pytest.approx(0, abs=1e-6) and row["n_chi2"] > 20
        shares = [row[f"{name}_share"] for name in ("track", "pose", "reference", "lens", "model")]
        assert sum(shares) == pytest.approx(1)
        assert [b["n"] for b in row["bias_bins"]] == [row["n_kept"]]
    assert [row["floor"] for row in rows.values()] == [0.02, None, 0.01], "the longest start that fits; exact truth"
    assert not any("half" in name for name in outcome.summary)


@pytest.mark.slow
def test_the_verdict_counts_scenes_within_the_tolerance_and_the_largest_bias(outcome):
    assert outcome.summary["auto.scenes_within"]["value"] == 0, "all of the answers are more than 98 %"
    assert outcome.summary["auto.scenes_within"]["n"] == 3
    assert outcome.verdict == "refuted" and "2 of 3 bars met" in outcome.why
    far = study(0.015)
    assert far.summary["auto.room_bias"]["value"] == pytest.approx(0.015, abs=1e-6)
    assert far.summary["auto.bias_over_floor"]["value"] == pytest.approx(0.75, abs=1e-4), "hall alone has a floor"
    assert far.summary["auto.interval_1"]["value"] == 0 and far.summary["auto.interval_2"]["value"] == 1
    assert "1 of 3 bars met" in far.why
    assert study(floors={}).summary["auto.bias_over_floor"]["value"] is None


def test_halves_of_the_candidates_are_disjoint_and_together_all():
    recording = scene("long", n=40).recording
    halves = [uncertainty_study.half_of_candidates(recording, 20, half=k) for k in (0, 1)]
    assert not set(halves[0]) & set(halves[1])
    assert sorted([*halves[0], *halves[1]]) == uncertainty_study.candidate_frames(recording, 20)


def test_too_few_answers_count_in_no_number():
    outcome = study(methods={"auto": off_by(0.0, step=100)})
    assert outcome.summary["auto.scenes_within"]["n"] == 0
    assert outcome.verdict == "undecided" and "not measured" in outcome.why
