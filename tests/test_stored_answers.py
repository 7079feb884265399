"""Answers to fixed problems are those stored in ``stored_answers.json``, in double precision to six digits.

Whatever changes a number of the method changes one here, however small. Other tests say whether an answer is right.
Parts that compute in single precision (windows, cost volumes) depend on the processor's vectors: to a hundredth.
``DHTORCH_STORE=1 pytest tests/test_stored_answers.py`` stores them anew, after a change that is meant.
"""

from functools import cache
from pathlib import Path

import pytest
import test_contract
import torch
from support import digests, sample_dicts, stub_samples
from support.random_answers import random_points
from support.room_models import room_model, room_scene
from support.stored_values import stored_values
from torch.utils.data import default_collate

from dhtorch import CameraPin, align_depth, complete_depth, validate_depth
from dhtorch.alignment.references import collect_references
from dhtorch.codes import Source
from dhtorch.data.recording import Recording
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.integrate import DepthView, extract_mesh, extract_points, fuse_views, make_volume
from dhtorch.measure import metric_scale
from dhtorch.metrics import bootstrap, control, curves, errors, holdout, monotone, reliability, risk
from dhtorch.metrics.calibration.fitting import fit_calibration, fit_sigma_model
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.presets import AUTO, FUSED, KORNIA, MAP, PAPER
from dhtorch.pytree import collate, stack
from dhtorch.synthetic import SyntheticRoom, depth_faults
from dhtorch.transforms import ExtendDepth, ValidateDepth
from dhtorch.validation.capture_check import check_capture
from dhtorch.validation.faults import diagnose

FILE = Path(__file__).with_name("stored_answers.json")

#: Where returns end, m.
NEAR_M = 2.0


@cache
def room():
    return SyntheticRoom(n_frames=8, hw=(120, 160), depth_hw=(60, 80), supersample=1, step_m=0.05, seed=3)


@cache
def frame(k):
    """A frame in double precision whose returns end at two metres."""
    return range_split(room()[k], NEAR_M).to(torch.float64)


@cache
def answer(name):
    """A pair, or a reference with several source views, by each method."""
    methods = {
        "paper": PAPER,
        "kornia": KORNIA,
        "map": MAP,
        "window": MAP.replace(views=5),
        "auto": AUTO,
        "fused": FUSED,
    }
    method = methods[name].replace(n=256)
    trace = {}
    views = frame(4) if method.views == 1 else stack([frame(k) for k in (1, 2, 5, 7)])
    with torch.no_grad():
        estimate = method(frame(1) if method.views == 1 else frame(3), views, seed=2, trace=trace)
    return estimate, trace


def pair(name):
    estimate, trace = answer(name)
    kept = {key: trace[key] for key in ("samples", "tracks", "fit") if key in trace}
    if "dense" in trace:
        kept["dense"] = trace["dense"].replace(parts=None)
    return {"estimate": estimate, **kept}


def batch_of_pairs():
    with torch.no_grad():
        return MAP.replace(n=128)(collate([frame(1), frame(2)]), collate([frame(4), frame(5)]), seed=1)


def truth(k):
    return room().truth(k)["depth"].to(torch.float64)


def dense(**options):
    with torch.no_grad():
        return complete_depth(frame(3), stack([frame(1), frame(6)]), method=MAP.replace(n=256), seed=1, **options)


def validated(scale, **options):
    with torch.no_grad():
        return validate_depth(
            scale * truth(3), frame(3), stack([frame(1), frame(6)]), method=MAP.replace(n=256), size=120, **options
        )


def aligned(kind, fault):
    estimate, trace = answer("map")
    spoilt, _ = depth_faults.apply_fault(fault, truth(1))
    trace_of = {}
    with torch.no_grad():
        result = align_depth(
            1 / spoilt if kind == "inverse" else spoilt, [trace["samples"], estimate], kind=kind, trace=trace_of
        )
    return result, trace_of


def mapped():
    """A volume of three views, its points and its mesh."""
    volume = make_volume(0.08, truncation=0.25, channels=3)
    for k, source in ((0, Source.SENSOR), (2, Source.RECOVERED), (5, Source.SWEPT)):
        view = room()[k]
        z = truth(k)[:, ::2, ::2].float()
        sigma = 0.01 + 0.005 * z**2
        colour = (view.image / 255)[:, :, ::2, ::2].movedim(1, -1)
        camera = view.camera.map(lambda x: x / 2)
        volume = fuse_views(volume, DepthView(z, sigma, colour, camera, room().poses[k : k + 1]), source=source)
    return extract_points(volume), extract_mesh(volume)


def metrics_of_points():
    points = [random_points(300, seed) for seed in range(3)]
    pooled = collate(points)
    return {
        "errors": errors.measure_errors(pooled),
        "risk": risk.measure_risk(pooled),
        "curve": risk.risk_coverage(pooled),
        "ece": reliability.excess_ece(pooled, seed=0),
        "reliability": reliability.measure_reliability(points),
        "calibration": fit_calibration(points),
    }


def joined(rows):
    """The digests of many results as one list of numbers a row."""
    leaves = {name: digests.digest(row).values() for name, row in rows.items()}
    return {name: [x for leaf in of for x in leaf[1:] if not isinstance(leaf, str)] for name, of in leaves.items()}


def metrics_of_scenes():
    """Scenes of different sizes, half of them with tied scores, most with scores that mean something."""
    sizes = (30, 80, 12, 200, 45, 60, 90, 25, 70, 50)
    drawn = [random_points(n, seed, ties=seed % 2 == 1) for seed, n in enumerate(sizes)]
    scenes = [p.replace(score=(p.score - p.error.nan_to_num()).mul(6).round() / 6) for p in drawn[:8]] + drawn[8:]
    claimed, good, weight = reliability.pool_answers(scenes)
    quantiles = ({}, {"share": 0.6}, {"few": 12}, {"share": 0.95})
    controls = [(control.plug_in_threshold, {}), *((control.scene_quantile_threshold, x) for x in quantiles)]
    found = {
        "risk": [risk.measure_risk(p) for p in scenes],
        "sparsification": [risk.ause(p) for p in scenes],
        "curves": [curves.sample_curves(p) for p in scenes],
        "controls": [choose(scenes, at, **more) for choose, more in controls for at in (0.12, 0.25)],
        "intervals": [
            bootstrap.interval_over_scenes([0.3, 1.2, 2.9, 0.1, 1.7], statistic=name, level=0.8, draws=300, seed=4)
            for name in ("median", "mean", "geometric_mean")
        ],
        "ece": [reliability.ece_interval(scenes, draws=50), reliability.ece_interval(scenes, bins=3, draws=50, seed=9)],
        "diagrams": [
            reliability.reliability_diagram(1.4 * claimed - 0.2, good, w, bins=bins, equal_mass=equal)
            for w in (None, weight)
            for bins in (1, 7)
            for equal in (False, True)
        ],
        "isotonic": [
            monotone.fit_isotonic(claimed, good.double(), weight, rising=rising, **more)
            for rising in (True, False)
            for more in ({}, {"min_share": 0.15}, {"min_share": 0.3, "ends": (-2.0, 2.0)})
        ],
        "calibration": fit_calibration([p.replace(score=1.5 * p.score) for p in drawn], min_share=0.2, targets=(30,)),
        "sigma": [fit_sigma_model([p.replace(sigma=k * p.sigma) for p in scenes]) for k in (0.3, 3.0)],
    }
    return joined(found)


def held_out():
    """The truth test and the cohort of real holes on a map with steps and empty places, dense and sparse."""
    g = torch.Generator().manual_seed(7)
    empty, spread, place, chosen = torch.rand(4, 1, 60, 80, generator=g, dtype=torch.float64)
    depth = (0.7 + torch.linspace(0, 2.4, 80) ** 2 / 8) * (1 + 0.02 * spread)
    depth[..., 27:] *= 1.2  # a step that the wide window alone takes for smooth
    depth = torch.where(empty > 0.995, torch.inf, torch.where(empty < 0.01, 0.0, depth))
    uv = torch.stack((170 * place.flatten(1) - 5, 130 * chosen.flatten(1) - 5), -1)[:, :600]
    samples = PAPER.replace(n=600).sample_depth(frame(1)).replace(uv=uv)
    views = {"dense": (1.0, None), "sparse": (0.1, torch.tensor([True]))}
    views = {k: frame(1).replace(depth=depth.where(spread < n, 0.0), sparse=x) for k, (n, x) in views.items()}
    found = {
        f"{k} {rule}": holdout.sample_truth(v, uv, truth=rule, window=13)
        for k, v in views.items()
        for rule in ("raw", "5x5", "full")
    }
    changes = ({}, {"window": 5}, {"min_returns": 1}, {"agreement": 0.02}, {"min_texture": 0.9})
    truth = found["dense full"]
    return found | {"holes": [holdout.select_real_holes(views["sparse"], samples, truth, **more) for more in changes]}


#: Options of the transform -> the columns that they change; no name: all.
EXTENDED = {
    "pair": ({}, ()),
    "one view": ({"other_image": None}, ()),
    "lens": ({"distortion": [0.05, -0.02, 0.01, -0.01]}, ("xyz", "depth", "sigma")),
    "seed": ({"index_key": "index", "seed": 3}, ("pose_cov",)),
    "stretch": ({"patch": 8, "tokens_hw": (64, 32)}, ("tokens", "tokens_valid")),
    "pad": ({"patch": 5, "tokens_hw": (30, 20), "fit": "pad"}, ("tokens", "tokens_valid")),
    "crop": ({"patch": 8, "tokens_hw": (64, 32), "fit": "crop"}, ("tokens", "tokens_valid")),
    "depth camera": ({"depth_intrinsics": [40.0, 42.0, 50.0, 48.0], "confidence": "conf"}, ("depth", "flag", "source")),
    "dense": (
        {"dense": {"planes": 16, "size": 64}, "budget": True},
        ("depth_map", "sigma_map", "gate_map", "cause_map", "tokens"),
    ),
}


def extended():
    """What the transform adds to a sample, and a validation to a batch."""
    first, given = sample_dicts.frames()[0], sample_dicts.frames()[6]
    given = given | {"before": first["image"], "conf": (given["depth"] // 500).clip(0, 2).astype("uint8")}
    found, common = {}, {"depth_unit": "mm", "other_image": "before", "n": 128}
    for name, (options, columns) in EXTENDED.items():
        out = stub_samples.added(ExtendDepth(**common | options)(given))
        found[name] = {k: out[k] for k in columns or out}
    clipped = (1.05 * sample_dicts.room().truth(6)["depth"][0]).clamp(max=3.0)
    given = [
        given | {"before_is_pad": torch.tensor([pad]), "map": x}
        for pad in (False, True)
        for x in (clipped, 0 * clipped)
    ]
    validate = ValidateDepth(**common, map="map", judging={"size": 112}, batched=True)
    return found | {"validated": stub_samples.added(validate(default_collate(given)))}


def measured():
    """The metric size of a model of the room."""
    model, _ = room_model("maps", "bend", 0.02)
    names = [view.name for view in model.views]
    return metric_scale(model, room_scene().frames, names=names, cutoff=2.5)


def pinned():
    with torch.no_grad():
        return CameraPin(room()[2], seed=1).check(torch.cat([room()[k].image for k in (2, 3)]))


def checked():
    frames = [room()[k] for k in range(8)]
    recording = Recording("room", "synthetic", frames.__getitem__, torch.arange(8), poses=room().poses)
    return check_capture(recording)


def flow():
    images = [room()[k].image.double() / 255 for k in (1, 4)]
    return {f"{h}x{w}": coarse_flow(*(x[..., :h, :w] for x in images)) for h, w in ((120, 160), (75, 101))}


PROBLEMS = {
    **{f"pair {name}": lambda name=name: pair(name) for name in ("paper", "kornia", "map", "window", "auto", "fused")},
    "batch of pairs": batch_of_pairs,
    "complete": lambda: dense(size=160, planes=32),
    "complete, two refinements and a small map": lambda: dense(size=96, planes=24, refinements=1, source_views=1),
    "validate a sound map": lambda: validated(1.0),
    "validate a map that is too long": lambda: validated(1.06, views=False),
    "references": lambda: collect_references(truth(1), [answer("map")[1]["samples"], answer("map")[0]], (120, 160)),
    "align metric": lambda: aligned("metric", "tilt"),
    "align scale": lambda: aligned("scale", "scale_short"),
    "align affine": lambda: aligned("affine", "shift"),
    "align inverse": lambda: aligned("inverse", "scale_short"),
    "diagnose": lambda: diagnose([room()[k] for k in range(8)], [1000 * truth(k).float() for k in range(8)], seed=1),
    "check a capture": checked,
    "map": mapped,
    "metrics": metrics_of_points,
    "metrics of scenes": metrics_of_scenes,
    "held-out truth": held_out,
    "extend samples": extended,
    "coarse flow": flow,
    "scale of a model": measured,
    "pinned camera": pinned,
}


def calls():
    """A call of every public function that the contract has a row of, in double precision."""
    found = {}
    for row in test_contract.ROWS:
        name = f"{row.fn.__module__.rsplit('.', 1)[-1]}.{row.fn.__name__}"
        name = name if name not in found else f"{name}, {sum(k.startswith(name) for k in found) + 1}"
        found[name] = lambda row=row: row.fn(*row.make(2, 7, torch.float64))
    tracks = found[
        "features.match_features"
    ]  # its round trip is rounding of single precision: another on each processor
    return found | {"features.match_features": lambda: (x := tracks()).replace(error=x.error.round(decimals=4))}


PROBLEMS |= calls()


#: Differences allowed, by the beginnings of names, where a part computes in single precision.
TOLERANCES = {
    **dict.fromkeys(("pair window", "pair auto", "pair fused", "batch", "complete", "validate", "align affine"), 0.01),
    **dict.fromkeys(("diagnose", "check", "scale of a model", "extend samples"), 0.01),
    **{"pair": 1e-4, "references": 1e-4, "pinned camera": 1e-4, "align": 1e-3},
}


def found(name):
    torch.manual_seed(0)  # of functions that draw without a generator of their own
    with torch.no_grad():
        return digests.digest(PROBLEMS[name]())


@pytest.mark.parametrize("name", PROBLEMS)
def test_an_answer_is_the_one_that_is_stored(name):
    tolerance = next((limit for start, limit in TOLERANCES.items() if name.startswith(start)), digests.TOLERANCE)
    now = found(name)
    wrong = digests.differences(now, stored_values(FILE, {name: now}, PROBLEMS)[name], tolerance)
    assert not wrong, "\n".join(wrong)


def test_every_problem_is_stored():
    assert list(stored_values(FILE)) == list(PROBLEMS)


def test_a_changed_answer_is_noticed():
    x = torch.rand(40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    one = digests.digest({"depth": x, "name": "a"})
    assert not digests.differences(digests.digest({"depth": x * (1 + 1e-8), "name": "a"}), one)
    for other in (x * (1 + 1e-5), x.flip(0), x.where(x < 0.9, torch.nan), x[:, None]):
        assert len(digests.differences(digests.digest({"depth": other, "name": "a"}), one)) == 1
    assert len(digests.differences(digests.digest({"depth": x, "name": "b"}), one)) == 1
    assert len(digests.differences(digests.digest({"depth": x}), one)) == 1
