"""The latency experiment: rows, ratios and verdict; memory of a process of its own; DINOv2's shapes."""

import sys
from functools import partial

import pytest
import torch
from support.rooms import room as rendered
from support.rooms import room_scene

from dhtorch import extend
from dhtorch.data import FormatError
from dhtorch.data.pairs import by_gap
from dhtorch.experiments import memory
from dhtorch.experiments.baselines import dinov2
from dhtorch.experiments.paper import latency
from dhtorch.experiments.protocol import Settings
from dhtorch.runtime import storage
from dhtorch.stages import score

TINY = {"hidden": 32, "layers": 2, "heads": 2, "side": 56}
SIZES = ((48, 64), (96, 128))
PAPER = extend


def measured(**options):
    room = rendered(hw=(60, 80), n_frames=3)
    fast = {"rounds": 2, "front_end_repeats": 10, "pair_repeats": 1, "dinov2_repeats": 1, "peak": False}
    chosen = {"paper": PAPER}
    options = {**fast, "sizes": SIZES, "n": 64, "dinov2": partial(dinov2.load_dinov2, **TINY), **options}
    return latency.run([room_scene(room)], chosen, partial(by_gap, gap=2), Settings(), **options)


@pytest.mark.slow
def test_every_stage_has_a_row_at_every_size():
    pytest.importorskip("transformers")
    outcome = measured()
    stages = {"front_end", "pair", "sample", "backproject", "classify", "track", "pose", "triangulate", "score"}
    for hw in SIZES:
        mine = {r["stage"]: r for r in outcome.rows if r["method"] == "paper" and r["hw"] == list(hw)}
        assert set(mine) == stages
        parts = [mine[s]["p50_ms"] for s in stages - {"front_end", "pair"}]
        assert 0 < mine["front_end"]["p50_ms"] < mine["pair"]["p50_ms"] and max(parts) < mine["pair"]["p50_ms"]
        assert mine["front_end"]["low_ms"] <= mine["front_end"]["p50_ms"] <= mine["front_end"]["high_ms"]
        assert mine["front_end"]["parameters"] == 0 and "parameters" not in mine["track"]
        assert mine["front_end"]["p95_ms"] >= mine["front_end"]["p50_ms"] and mine["front_end"]["p99_ms"] is None
        assert mine["pair"]["repeats"] == 2 and mine["pair"]["p95_ms"] is None, "two calls have no tail"
    (theirs,) = (r for r in outcome.rows if r["method"] == "dinov2_l")
    network = dinov2.load_dinov2(**TINY)
    assert theirs["parameters"] == sum(p.numel() for p in network.parameters()) and theirs["hw"] == [56, 56]
    assert theirs["weight_bytes"] == 4 * theirs["parameters"] and theirs["n"] is None
    assert outcome.verdict == "refuted" and "DINOv2-L / front end" in outcome.why, "a tiny network is no match"
    for name, value in outcome.summary.items():
        assert set(value) == {"value", "low", "high", "n", "unit"}, name
    storage.to_strict_json(outcome.rows)


def test_without_transformers_the_rest_is_measured(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    outcome = measured(sizes=SIZES[:1])
    (theirs,) = (r for r in outcome.rows if r["method"] == "dinov2_l")
    assert "pip install" in theirs["note"] and "pip install" in outcome.why
    assert outcome.verdict == "undecided" and outcome.summary["paper.front_end.48x64"]["value"] > 0
    assert not any(name.startswith("dinov2_l") for name in outcome.summary)
    with pytest.raises(ImportError, match="pip install"):
        dinov2.load_dinov2()


def test_ratios_are_taken_round_by_round():
    """A round in which the machine is twice as slow changes no ratio."""
    small, large, theirs = (
        latency.TimedBranch(m, s, (1, 1), None, 1, {"parameters": 0, "weight_bytes": 0, "peak_mib": None}, rounds)
        for m, s, rounds in (
            ("a", "front_end", [{"front_end": [1.0, 1.0]}, {"front_end": [2.0, 2.0]}]),
            ("a", "front_end", [{"front_end": [3.0]}, {"front_end": [6.0]}]),
            (latency.VISUAL_BRANCH, "forward", [{"forward": [50.0]}, {"forward": [100.0]}]),
        )
    )
    summary = latency.summarise_timings([small, large, theirs])
    assert [summary["a.growth"][k] for k in ("value", "low", "high")] == [3, 3, 3]
    assert [summary["a.speedup"][k] for k in ("value", "low", "high")] == [50, 50, 50]


def hungry(x, mib):
    return x.sum() + (x.new_ones(mib * 2**20 // x.element_size()) + 1).sum()


@pytest.mark.slow
def test_peak_memory_counts_what_the_call_needs_and_not_its_inputs():
    """100 MiB made and a second 100 MiB for the sum count; the input of 64 MiB does not."""
    found = memory.peak_mib(partial(hungry, torch.ones(2**24), 100))
    if found is None:
        pytest.skip("this system does not tell")
    assert 195 <= found < 250


def test_networks_in_a_method_are_counted_once():
    network = torch.nn.Linear(3, 4)
    method = partial(PAPER, score=partial(score.confidence, extra=network), other=network)
    assert memory.count_weights(method, network) == {"parameters": 16, "weight_bytes": 64}
    assert memory.count_weights(PAPER) == {"parameters": 0, "weight_bytes": 0}


def test_dinov2_shapes_seed_and_local_weights(tmp_path):
    pytest.importorskip("transformers")
    state = torch.get_rng_state()
    network, again = dinov2.load_dinov2(**TINY), dinov2.load_dinov2(**TINY)
    assert torch.equal(torch.get_rng_state(), state) and not network.training
    image = torch.randint(0, 256, (2, 3, 40, 60), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    with torch.no_grad():
        tokens = network(pixel_values=dinov2.preprocess_image(image, 56)).last_hidden_state
        assert tokens.shape == (2, 1 + 4 * 4, 32)
        assert torch.equal(tokens, again(pixel_values=dinov2.preprocess_image(image, 56)).last_hidden_state)
        network.save_pretrained(tmp_path / "weights")
        local = dinov2.load_dinov2(tmp_path / "weights")(
            pixel_values=dinov2.preprocess_image(image, 56)
        ).last_hidden_state
    assert torch.equal(tokens, local)
    with pytest.raises(FormatError, match="nowhere"):
        dinov2.load_dinov2(tmp_path / "nowhere")


@pytest.mark.parametrize(("value", "dtype"), [(0.5, torch.float32), (51, torch.uint8)])
def test_pixel_values_are_centred(value, dtype):
    found = dinov2.preprocess_image(torch.full((1, 1, 30, 30), value, dtype=dtype), 28)
    grey = value / 255 if dtype == torch.uint8 else value
    expected = (grey - torch.tensor(dinov2.COLOUR_MEAN)) / torch.tensor(dinov2.COLOUR_STD)
    assert found.shape == (1, 3, 28, 28) and torch.allclose(found[0].mean((-1, -2)), expected, atol=1e-6)
