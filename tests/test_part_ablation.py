"""The whole taken apart: every variant differs from its neighbour in what its name says, costs are told, both verdicts."""

from dataclasses import fields
from functools import partial

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from rooms import noted, room

from dhtorch.commands.run import config_dir
from dhtorch.data.pairs import by_gap
from dhtorch.method import Method
from dhtorch.studies.compare import part_ablation
from dhtorch.studies.protocol import Settings


@pytest.fixture(scope="module")
def methods():
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        settings = {m: compose("run", [f"method={m}", "method.n=768"]) for m in ("paper", "map", "window")}
    return {m: instantiate(s.method, _convert_="all") for m, s in settings.items()}


def flat(seat):
    """A partial of a partial as one."""
    while isinstance(seat, partial) and isinstance(seat.func, partial):
        seat = partial(seat.func.func, **seat.func.keywords | seat.keywords)
    return seat


def differences(a, b, path=""):
    """Dotted names of what two methods, or two seats, do differently."""
    if isinstance(a, Method):
        return [d for f in fields(a) for d in differences(getattr(a, f.name), getattr(b, f.name), f.name)]
    a, b = flat(a), flat(b)
    if isinstance(a, partial) and isinstance(b, partial) and a.func is b.func:
        names = dict.fromkeys([*a.keywords, *b.keywords])
        return [d for k in names for d in differences(a.keywords.get(k), b.keywords.get(k), f"{path}.{k}")]
    return [] if a == b else [path.lstrip(".")]


@pytest.mark.parametrize(
    ("name", "base", "changed"),
    [
        ("+ affine tracks", "paper", {"track"}),
        ("+ weighted near pose", "paper", {"pose"}),
        ("+ near and far pose", "paper", {"pose"}),
        ("+ score by error", "paper", {"score"}),
        ("+ views", "paper", {"views"}),
        ("- affine tracks", "map", {"track"}),
        ("- far tracks", "map", {"pose.far_weight"}),
        ("- turn", "map", {"pose.turn_sigma"}),
        ("- pose", "map", {"pose"}),
        ("- score by error", "map", {"score"}),
    ],
)
def test_a_variant_differs_in_what_it_is_named_after(methods, name, base, changed):
    variants = part_ablation.taken_apart(*methods.values())
    assert set(differences(methods[base], variants[name])) == changed


def test_gates_and_sigma_are_told_apart(methods):
    variants = part_ablation.taken_apart(*methods.values())
    gates, sigma = (set(differences(methods["map"], variants[f"- {part}"])) for part in ("gates", "sigma"))
    assert not gates & sigma and {d.rpartition(".")[2] for d in gates} <= set(part_ablation.PAPER_GATES)
    seats = [methods[m].triangulate for m in ("map", "paper")]
    assert gates | sigma == {f"triangulate.{d}" for d in differences(*seats)}
    assert flat(variants["- gates"].triangulate).keywords["min_parallax_deg"] == 0.3
    assert flat(variants["- sigma"].triangulate).keywords["sigma_scale"] == 1.0
    paper = methods["paper"].triangulate.keywords
    for said in (part_ablation.PAPER_GATES, part_ablation.PAPER_SIGMA):
        assert said == {k: paper[k] for k in said}
    assert part_ablation.PAPER_GATES.keys() | part_ablation.PAPER_SIGMA.keys() == paper.keys() - {"solver"}


def test_every_variant_runs_and_tells_its_cost(methods):
    outcome = part_ablation.run(
        [noted(room(n_frames=4, hw=(192, 256), lidar="exact"), gap=3)], methods, by_gap, Settings(), seeds=1
    )
    variants = part_ablation.taken_apart(*methods.values())
    assert {r["method"] for r in outcome.rows} == set(variants)
    assert all(outcome.summary[f"{name}.pair_ms"]["value"] > 0 for name in variants)
    assert outcome.summary["paper.extra_ms"]["value"] == 0
    numbers = ("median_rel_ratio_at_equal_coverage", "aurc_ratio", "coverage_at_5", "within_sigma")
    assert all(f"{name}.{k}" in outcome.summary for name in variants if name != "paper" for k in numbers)


def judged(**changes):
    equal = {"+ tracks": 0.9, "+ pose": 0.7, "map": 0.5, "- tracks": 0.6} | changes
    found = {f"{k}.median_rel_ratio_at_equal_coverage": {"value": v} for k, v in equal.items()}
    return found | {f"{k}.aurc_ratio": {"value": v} for k, v in equal.items()}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"+ pose": 0.4}, False),
        ({"- tracks": 0.45}, False),
        ({"- tracks": 0.49}, True),
        ({"map": None}, None),
    ],
)
def test_verdict_goes_either_way(changes, expected):
    assert part_ablation.verdict(judged(**changes))[0] is expected


def test_all_three_methods_are_needed(methods):
    with pytest.raises(ValueError, match=r"experiment\.methods: found paper, expected map, window too"):
        part_ablation.run([], {"paper": methods["paper"]}, by_gap, Settings())
