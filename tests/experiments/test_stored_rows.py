"""Rows, summary and verdict of every experiment on small inputs are those stored in ``stored_rows.json``.

Every column of a run is stored by digests of its numbers, in the order of its rows, and by its words. Whatever changes a
number of an experiment changes one here; the tables of verdicts and of wrong inputs hold the rest.
``DHTORCH_STORE=1 pytest tests/experiments/test_stored_rows.py`` stores them anew, after a change that is meant.
"""

import json
import math
import tempfile
from collections import Counter
from functools import cache, partial
from pathlib import Path

import pytest
import torch
from experiments.test_compare_methods import exact, small
from experiments.test_focus_stack import recorded_stack
from support import numbered_frames as numbered
from support.digests import alike, differences, summary
from support.paper_protocol_runs import configured_method, small_room
from support.rooms import Changed, room_scene, untold
from support.stored_values import stored_values
from support.writers.lerobot import write_lerobot

from dhtorch import data
from dhtorch.codes import Gate
from dhtorch.data.codecs.video import close_videos
from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments import pair
from dhtorch.experiments.baselines.dinov2 import load_dinov2
from dhtorch.experiments.compare import (
    dense_comparison,
    method_comparison,
    pin_study,
    scale_study,
    validate_study,
)
from dhtorch.experiments.focal import defocus, defocus_fusion, focus_stack
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks
from dhtorch.experiments.negative import helix_correlation, hole_attention, icp
from dhtorch.experiments.paper import (
    ablation,
    calibration,
    device_pose,
    gate_ablation,
    global_map,
    heldout,
    hole_census,
    motion,
    range_split,
    real_holes,
)
from dhtorch.experiments.probes import downstream_probe, learned_score, rh20t_probe, vo_probe
from dhtorch.experiments.protocol import Outcome, Settings
from dhtorch.pipeline.presets import AUTO
from dhtorch.records import Estimate
from dhtorch.synthetic import robot as synthetic_robot
from dhtorch.synthetic.viewpoints import open_viewpoints

FILE = Path(__file__).with_name("stored_rows.json")

#: Starts of the names of times, which differ from run to run.
UNSTABLE = ("ms", "time_ratio")


@cache
def method(name="paper", n=256):
    """A method of the settings with few samples."""
    return configured_method(name).replace(n=n)


def room(**options):
    """A small room of three frames."""
    return small_room(**{"hw": (96, 128), "n_frames": 3, **options})


def named(name, **options):
    """A room under another name."""
    return Changed(room(**options), name=name)


def punched(frame):
    """The frame without returns in its lower right corner."""
    depth = frame.depth.clone()
    depth[:, 48:, 64:] = 0
    return frame.replace(depth=depth)


def run(experiment, *rooms, methods=("paper",), pairs=by_gap, truth=("full",), settings=None, gap=2, **options):
    """An experiment on rooms by methods of the settings, in double precision."""
    chosen = {name: method(name) for name in methods}
    scenes = [room_scene(each, gap=gap) for each in rooms or [room()]]
    settings = Settings(**{"dtype": torch.float64, "truth": truth, **(settings or {})})
    return experiment.run(scenes, chosen, pairs, settings, **options)


def stated(ratio, step=2, **options):
    """Methods on planes, of which ``off`` answers one of ``step`` samples, off by a ratio."""

    def triangulate(samples, *_):
        unanswered = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2)
        answers = torch.arange(samples.uv.shape[1]).expand_as(samples.depth) % step == 0
        depth = torch.where(answers, (1 + ratio) * numbered.FAR, torch.nan)
        gate = torch.where(answers, Gate.ANSWER, unanswered.gate)
        return unanswered.replace(depth=depth, sigma=depth / 100, sigma_shared=0 * depth, gate=gate)

    methods = {"paper": numbered.MAP, "auto": numbered.choosing(1).replace(triangulate=triangulate)}
    methods |= {"window": numbered.MAP.replace(views=2), "two": numbered.choosing(2, 3)}
    dark = numbered.scene("dark", load=lambda i: numbered.frame(i).replace(depth=torch.zeros(1, 48, 64)))
    scenes = [*(numbered.scene(name) for name in ("hall", "attic", "exact")), dark]
    options = {"exact": ["exact"], "floors": {"h": 1.0, "hall": 0.02}, "disjoint": ["auto"]} | options
    options |= {"stand_ins": {"window": "paper"}, "baselines": ["window"], "indoor": ["hall"]}
    pairs = partial(by_gap, stride=2)
    return method_comparison.run(scenes, {}, pairs, Settings(), methods=methods, seeds=1, **options)


def compared(methods, rooms=None, **options):
    """The numbers of methods on drawn answers, and what has none."""
    found = compare.method_ratios(methods, rooms=rooms, draws=200, **options)
    multi, rows = compare.multiview_ratios(methods["map"], methods["paper"], "other", draws=50)
    more = {"left_out": found.left_out, "unanswered": found.unanswered, "multi": rows}
    return Outcome([*found.rows, more], found.summary | {k: v.entry() for k, v in multi.items()})


def recorded(*stacks, **options):
    """Focal stacks of two rooms."""
    stacks = [recorded_stack(*each) for each in stacks] or [FocalStack(recorded_stack(0.6, 0).images)]
    names = tuple(str(k) for k in range(len(stacks)))
    rooms = FocalStacks("sweeps", "made", stacks.__getitem__, names, scenes=("a", "a", *"bbb")[: len(stacks)])
    return focus_stack.run([rooms], {}, None, Settings(), stride_px=1, window_px=3.0, **options)


def probed_robot():
    """The probe of the hand's motion on made robot scenes, one network with random weights."""
    network = partial(load_dinov2, weights=None, hidden=24, layers=1, heads=2, side=56)
    options = {"horizon": 0.2, "history": 0.2, "dinov2": network, "penalties": (10.0, 1000.0)}
    with tempfile.TemporaryDirectory() as root:
        scenes = synthetic_robot.open_robot(root, tasks=3, n_frames=8, scenes=1, hw=(36, 64))
        found = rh20t_probe.run(scenes, {"map": method("map", 256)}, None, Settings(), **options)
        close_videos()
    return found


def probed_sets():
    """The probe of enriched sets, of which one is read as three."""
    depth = {"depth": "observation.images.front_depth"}
    readings = {"sensor": {**depth, "depth_range": [0, 1.0]}, "depth": depth, "true_depth": depth}
    rooms = [small_room(hw=(48, 64), depth_hw=(48, 64), n_frames=12, seed=k) for k in range(3)]
    with tempfile.TemporaryDirectory() as root:
        write_lerobot(Path(root), [[room[i] for i in range(12)] for room in rooms], image="image", depth="png")
        walks = [Scene(recording, gap=3) for recording in data.open_all(root, "lerobot")]
        options = {"readings": readings, "blocks": 3, "min_samples": 2, "penalties": (0.1, 10.0), "dinov2": None}
        return downstream_probe.run(walks, {}, None, Settings(batch=5), **options)


PAPER, OURS, LATER = small(1.0, silent=0.3), small(0.6, silent=0.5, boast=0.5), {"b": small(0.4)["b"]}
FOUR = {"paper": small(0.8, n=400, names="abcd"), "map": small(1.0, n=400, names="abcd")}
FOUR["map"]["c"] = [each[:15] for each in FOUR["map"]["c"]]
PERFECT = {name: {scene: [exact(130, error)] for scene in "abc"} for name, error in (("paper", 0.5), ("map", 0.0))}

WALK = room(lidar="exact", n_frames=4)
TURN = named("synthetic_turn", lidar="exact", path="rotation")
SWEPT = {"planes": 16, "source_views": 2, "size": 64}
PROBED = {"blocks": 3, "min_pairs": 3, "penalties": (0.01, 1.0), "dinov2": None}

RUNS = {
    "pair": partial(run, pair, WALK, TURN, methods=("paper", "map"), truth=("raw", "full")),
    "pair, opencv": partial(run, pair, methods=("opencv",), settings={"cutoff": math.inf}),
    "pair, far cutoff": partial(run, pair, settings={"cutoff": 50.0}),
    "pair, no pairs": partial(run, pair, pairs=lambda _: []),
    "heldout": partial(run, heldout, room(range_limit=2.0)),
    "range_split": partial(
        run, range_split, room(trajectory_axes="gl", trajectory_offset_deg=5.0), cutoffs=(1.5,), cutoff_factors=()
    ),
    "range_split, no truth": lambda: run(range_split, untold(Changed(room(), poses=None)), cutoff_factors=(1.25,)),
    "real_holes": lambda: run(real_holes, room(), untold(room())),
    "device_pose": partial(run, device_pose, room(trajectory_offset_deg=15.0, trajectory_axes="gl")),
    "gate_ablation": partial(run, gate_ablation, gaps=(16,), factors=(2.0,), gap=1),
    "motion": partial(run, motion, room(n_frames=5), factors=(1.0, 2.0)),
    "hole_census": lambda: run(hole_census, room(), Changed(room(lidar="exact"), punched, name="hole"), stride=2),
    "calibration": partial(run, calibration, WALK, thresholds=(0.02, 0.1, 0.25)),
    "ablation": lambda: run(
        ablation, n=(128,), windows=(15,), others={"opencv": method("opencv")}, wholes={"map": method("map")}
    ),
    "global_map": lambda: run(
        global_map,
        room(step_m=0.04),
        Changed(room(n_frames=2), poses=None, name="blind"),
        gap=1,
        settings={"dtype": torch.float32},
        n=200,
        voxel=0.05,
        weight="confidence",
    ),
    "icp": lambda: run(
        icp, WALK, Changed(room(), poses=None, name="blind"), poor_deg=4.0, n=200, links=2, min_inlier_share=0.2
    ),
    "hole_attention": lambda: run(hole_attention, Changed(room(lidar="exact"), punched), WALK, stride=3),
    "helix_correlation": partial(run, helix_correlation, room(path="forward", step_m=0.03), round_arms=True),
    "defocus": lambda: defocus.run(open_viewpoints(1, hw=(96, 128)), {}, None, Settings(), axial_colour_dpt=0.5),
    "defocus, natural": partial(run, defocus),
    "defocus_fusion": lambda: defocus_fusion.run(open_viewpoints(1, hw=(96, 128)), {}, None, Settings()),
    "focus_stack": lambda: focus_stack.run(
        open_viewpoints(1, hw=(60, 80)), {}, None, Settings(), measures=("gradient_energy", "variance"), slices=5
    ),
    "focus_stack, recorded": partial(
        recorded, (0.6, 0), (0.7, 1), (0.8, 2, True), (0.6, 3, True), measures=("modified_laplacian",)
    ),
    "focus_stack, no truth": recorded,
    "compare": partial(compared, {"map": OURS, "paper": PAPER, "auto": LATER}, fallback={"auto": "map"}, seed=4),
    "compare, rooms": partial(compared, FOUR, {"a": "hall", "b": "hall"}, exact="a", floors={"b": 0.02}),
    "compare, one room": partial(compared, {"paper": FOUR["paper"], "map": FOUR["map"]}, dict.fromkeys("abcd", "hall")),
    "compare, silent": partial(compared, PERFECT, reference="map"),
    "validate_study": partial(
        run,
        validate_study,
        room(n_frames=5),
        method=AUTO.replace(n=128),
        reference_views=1,
        windows=0,
        size=64,
        rooms=(),
    ),
    "scale_study": partial(run, scale_study, WALK, sizes=(0.1,), sound=1, repeats=1),
    "pin_study": partial(run, pin_study, rooms=(0,), robots=(), draws=1, hw=(48, 64), real=False),
    "dense_comparison": lambda: run(
        dense_comparison,
        named("hall", n_frames=6, lidar="exact"),
        methods=("map",),
        sweep=SWEPT,
        reference_views=1,
        indoor=["hall"],
        rotations=[room_scene(TURN, gap=2)],
        rooms=(),
    ),
    "method_comparison": lambda: method_comparison.run(
        [room_scene(each, gap=2) for each in (WALK, TURN)],
        {},
        by_gap,
        Settings(),
        methods={name: method(name) for name in ("paper", "map", "kornia")},
        seeds=2,
        moving=["synthetic_turn"],
    ),
    "method_comparison, stated": partial(stated, 0.015, gaps=(2, 5, 12), chained=["paper"], twins=["paper_chain"]),
    "method_comparison, few": partial(stated, -0.015, step=100, exact=(), disjoint=(), ratios={"two": "auto"}),
    "learned_score": lambda: run(
        learned_score, *(named(f"room{k}", seed=k) for k in range(2)), methods=("map",), steps=9
    ),
    "learned_score, one room": lambda: run(learned_score, methods=("map",), steps=2),
    "rh20t_probe": probed_robot,
    "downstream_probe": probed_sets,
    "vo_probe": lambda: vo_probe.run(
        [room_scene(room(n_frames=9, step_m=0.04)), room_scene(named("short"))],
        {"map": method("map")},
        None,
        Settings(),
        **PROBED,
    ),
    "vo_probe, rooms": lambda: vo_probe.run(
        [room_scene(named(f"room_{k}", n_frames=5, seed=k)) for k in range(3)],
        {"map": method("map")},
        None,
        Settings(batch=4),
        hold_out="rooms",
        **PROBED,
    ),
}


#: Runs of seconds.
SLOW = {"rh20t_probe", "validate_study", "scale_study", "pin_study", "learned_score", "vo_probe", "vo_probe, rooms"}


def leaves(value):
    """Every number and text of nested dicts and lists, in order."""
    if isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from leaves(item)
    else:
        yield value


def columns(outcome):
    """Digests of the numbers, and counts of the words, of every column of the rows and of every metric of the summary;
    verdict and metrics."""
    table = {}
    for row in outcome.rows:
        for name, value in row.items():
            table.setdefault(name, []).extend([] if name.startswith(UNSTABLE) else leaves(value))
    methods = sorted({str(row.get("method")) for row in outcome.rows}, key=len)
    for name, entry in outcome.summary.items():
        metric = next((name.removeprefix(f"{m}.") for m in methods if name.startswith(f"{m}.")), name).partition(".")[0]
        timed = metric.startswith(UNSTABLE) or entry.get("unit") == "ms"
        stable = [] if timed else [entry["value"], entry["low"], entry["n"]]
        table.setdefault(f"summary {metric}", []).extend(stable)
    found = {}
    for name, values in table.items():
        words = Counter(value for value in values if isinstance(value, str))
        numbers = [math.nan if v is None else float(v) for v in values if not isinstance(v, str)]
        if numbers:
            found[name] = [*summary(numbers)[:2], *(float(f"{x:.5g}") for x in summary(numbers)[2:])]
        found |= {f"{name}, words": ", ".join(f"{n} {word}" for word, n in words.items())} if words else {}
    more = {"verdict": str(outcome.verdict), "metrics": str([vars(metric) for metric in outcome.metrics])}
    return found | more | {"examples": str(len(outcome.examples)), "n_pairs": summary([outcome.n_pairs])}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in RUNS])
def test_rows_of_an_experiment_are_those_that_are_stored(name):
    outcome = RUNS[name]()
    found = json.dumps({"why": outcome.why or "", "columns": columns(outcome)}, ensure_ascii=False)
    stored, found = (json.loads(text) for text in (stored_values(FILE, {name: found}, RUNS)[name], found))
    assert differences(found["columns"], stored["columns"], 2e-3) == []
    assert alike(found["why"], stored["why"], 0.02, 0.02), (found["why"], stored["why"])
