"""The whole taken apart: every variant differs from its neighbour in what its name says, costs are told, both verdicts."""

from dataclasses import fields
from functools import partial

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from support import numbered_frames as stepping
from support.rooms import room, room_scene

from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.compare import part_ablation
from dhtorch.experiments.protocol import Settings
from dhtorch.pipeline.method import Method


@pytest.fixture(scope="module")
def every():
    files = {"paper": "paper", "map": "map_1", "window": "window_1", "auto": "auto"}
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        settings = {m: compose("run", [f"method={file}", "method.n=768"]) for m, file in files.items()}
    return {m: instantiate(s.method, _convert_="all") for m, s in settings.items()}


@pytest.fixture(scope="module")
def methods(every):
    return {m: every[m] for m in ("paper", "map", "window")}


def flat(stage):
    """A partial of a partial as one."""
    while isinstance(stage, partial) and isinstance(stage.func, partial):
        stage = partial(stage.func.func, **stage.func.keywords | stage.keywords)
    return stage


def differences(a, b, path=""):
    """Dotted names of what two methods, or two stages, do differently."""
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
        ("- turn", "map", {"pose.shutter_sigma"}),
        ("- pose", "map", {"pose"}),
        ("- score by error", "map", {"score"}),
    ],
)
def test_a_variant_differs_in_what_it_is_named_after(methods, name, base, changed):
    variants = part_ablation.build_map_ablations(*methods.values())
    assert set(differences(methods[base], variants[name])) == changed


def test_gates_and_sigma_are_told_apart(methods):
    variants = part_ablation.build_map_ablations(*methods.values())
    gates, sigma = (set(differences(methods["map"], variants[f"- {part}"])) for part in ("gates", "sigma"))
    assert not gates & sigma and {d.rpartition(".")[2] for d in gates} <= set(part_ablation.PAPER_GATE_OPTIONS)
    stages = [methods[m].triangulate for m in ("map", "paper")]
    assert gates | sigma == {f"triangulate.{d}" for d in differences(*stages)}
    assert flat(variants["- gates"].triangulate).keywords["min_parallax_deg"] == 0.3
    assert flat(variants["- sigma"].triangulate).keywords["sigma_scale"] == 1.0
    paper = methods["paper"].triangulate.keywords
    for said in (part_ablation.PAPER_GATE_OPTIONS, part_ablation.PAPER_SIGMA_OPTIONS):
        assert said == {k: paper[k] for k in said}
    assert part_ablation.PAPER_GATE_OPTIONS.keys() | part_ablation.PAPER_SIGMA_OPTIONS.keys() == paper.keys() - {
        "solver"
    }


PARTS_OF_AUTO = {
    "start": {"track.start", "chain"},
    "exposure": {"track.track.normalise"},
    "chosen views": {"select_views", "chain"},
    "agreement": {"fuse"},
    "score by sigma": {"score"},
    "unsure views": {"triangulate.max_sigma_rel"},
    "contradiction": {"triangulate.max_far_noise", "triangulate.max_in_reach"},
}


@pytest.mark.parametrize("part", PARTS_OF_AUTO)
def test_a_part_of_auto_is_put_in_alone_and_left_out(every, part):
    window, auto = every["window"], every["auto"]
    variants = part_ablation.build_auto_ablations(window, auto)
    alone, left_out = variants[f"+ {part}"], variants[f"- {part}"]
    assert set(differences(window, alone)) == PARTS_OF_AUTO[part]
    assert set(differences(auto, left_out)) == PARTS_OF_AUTO[part] - {"chain"}, "where it is chosen nothing is chained"
    stages = {name.partition(".")[0] for name in PARTS_OF_AUTO[part]} - {"track"}
    assert not [d for d in differences(auto, alone) if d in stages], "what is put in is the whole's"
    assert not [d for d in differences(window, left_out) if d in stages - {"chain"}], "what is left out is as before"


def test_every_difference_of_auto_belongs_to_one_part(every):
    window = every["window"]
    other = every["auto"].replace(hypotheses=99)
    variants = part_ablation.build_auto_ablations(window, other)
    parts = [set(differences(window, v)) - {"chain"} for name, v in variants.items() if name.startswith("+")]
    assert set().union(*parts) == set(differences(window, other)) - {"chain"}
    assert sum(map(len, parts)) == len(set().union(*parts))
    assert variants["- hypotheses of auto"].hypotheses == window.hypotheses
    names = part_ablation.build_auto_ablations(window, every["auto"])
    new = ("verify", "verify_views", "guide", "pose_samples")
    assert [name for name in names if "of auto" in name] == [f"{sign} {part} of auto" for sign in "+-" for part in new]
    known = other.replace(triangulate={"residual_px": 0.3})
    assert "+ triangulate of auto" in part_ablation.build_auto_ablations(window, known)


def test_a_tracker_that_knows_no_start_is_left_alone(every):
    window, auto = (every[name].replace(track=print) for name in ("window", "auto"))
    assert all(v.track is print for v in part_ablation.build_auto_ablations(window, auto).values())


@pytest.mark.slow
def test_one_group_alone_also_where_there_is_one_other_frame():
    """A variant of several views is asked as a pair there, so that the start and the score are counted."""
    asked = []

    def joining(name):
        def fuse(estimates):
            asked.append((name, len(estimates.gate)))
            return estimates[0]

        return fuse

    methods = {"paper": stepping.MAP, "map": stepping.MAP}
    methods["window"] = stepping.MAP.replace(views=2, fuse=joining("window"))
    methods["auto"] = stepping.choosing(2, 3).replace(views=2, fuse=joining("auto"), hypotheses=9)
    scenes = [stepping.scene(room="house"), stepping.scene("two", n=2, room="house")]
    outcome = part_ablation.run(scenes, methods, partial(by_gap, stride=4), Settings(), groups=["auto"], seeds=1)
    variants = part_ablation.build_auto_ablations(methods["window"], methods["auto"])
    assert {r["method"] for r in outcome.rows} == {"paper", "map", "window", *variants} and "- start" in variants
    assert outcome.scenes("+ start")["two"]["n_pairs"] == outcome.scenes("auto")["two"]["n_pairs"] == 1
    assert outcome.scenes("window")["two"]["note"] == "fewer than 3 views"
    assert all(outcome.summary[f"{name}.aurc_full_ratio_to_window"]["n"] == 2 for name in variants)
    assert outcome.summary["- chosen views.aurc_full_ratio_to_window"]["value"] == 1
    assert outcome.summary["+ chosen views.aurc_full_ratio_to_window"]["value"] < 0.9
    assert all(outcome.summary[f"{name}.pair_ms"]["value"] > 0 for name in variants)
    assert set(asked) == {("auto", 2), ("window", 2)}
    assert (
        "ratio to window of areas with unanswered as risk 1" in outcome.why and "at equal coverage" not in outcome.why
    )


@pytest.mark.slow
def test_every_variant_runs_and_tells_its_cost(methods):
    outcome = part_ablation.run(
        [room_scene(room(n_frames=4, hw=(192, 256), lidar="exact"), gap=3)],
        methods,
        by_gap,
        Settings(),
        groups=["map"],
        seeds=1,
    )
    variants = part_ablation.build_map_ablations(*methods.values())
    assert {r["method"] for r in outcome.rows} == set(variants)
    assert all(outcome.summary[f"{name}.pair_ms"]["value"] > 0 for name in variants)
    assert outcome.summary["paper.extra_ms"]["value"] == 0
    numbers = ("median_rel_ratio_at_equal_coverage", "aurc_ratio", "coverage_at_5", "within_sigma")
    assert all(f"{name}.{k}" in outcome.summary for name in variants if name != "paper" for k in numbers)


NAMES = ("+ tracks", "+ pose", "whole", "- tracks")


def judged(group, **changes):
    whole, equal, area = part_ablation.ABLATION_GROUPS[group]
    values = {"+ tracks": 0.9, "+ pose": 0.7, "whole": 0.5, "- tracks": 0.6} | changes
    values[whole] = values.pop("whole")
    return {f"{k}.{number}": {"value": v} for k, v in values.items() for number in (equal, area)}


@pytest.mark.parametrize("group", part_ablation.ABLATION_GROUPS)
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"+ pose": 0.4}, False),
        ({"- tracks": 0.45}, False),
        ({"- tracks": 0.49}, True),
        ({"whole": None}, None),
    ],
)
def test_verdict_goes_either_way(group, changes, expected):
    assert part_ablation.verdict(judged(group, **changes), group, NAMES)[0] is expected


def test_a_group_is_judged_by_its_own_parts():
    told = judged("map", **{"+ pose": 0.4})
    assert part_ablation.verdict(told, "map", ["+ tracks", "map", "- tracks"])[0] is True


def test_all_three_methods_are_needed(methods):
    with pytest.raises(ValueError, match=r"experiment\.methods: found paper, expected map, window too"):
        part_ablation.run([], {"paper": methods["paper"]}, by_gap, Settings(), groups=["map"])
    with pytest.raises(ValueError, match=r"experiment\.methods: found paper, map, window, expected auto too"):
        part_ablation.run([], methods, by_gap, Settings())


@pytest.mark.parametrize("groups", [["paper"], []])
def test_a_group_that_does_not_exist_is_an_error(every, groups):
    with pytest.raises(ValueError, match=r"experiment\.groups: found .*, expected some of map, auto"):
        part_ablation.run([], every, by_gap, Settings(), groups=groups)
