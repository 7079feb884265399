"""Numbers that commands compute and choices that they make, each from values made by hand."""

import copy
import json
import math
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pytest import approx
from support.stub_recordings import recording

from dhtorch.cli import (
    align,
    complete,
    enrich,
    inspect,
    option_checks,
    pin,
    process_capture,
    run,
    scale,
    stream,
    validate,
    view,
)
from dhtorch.codes import Gate, PinVerdict, Source, State, WrongCause
from dhtorch.export.lerobot import LogHistogram
from dhtorch.extract import plan
from dhtorch.extract.enriched import map_columns
from dhtorch.pipeline.picture_matching import spread_evenly
from dhtorch.records import Camera, Frame, Pose
from dhtorch.viz.plots import colours, format_capture_name
from dhtorch.viz.plots.maps import Scale

MOVED, STILL, UNKNOWN = PinVerdict.MOVED, PinVerdict.NOT_MOVED, PinVerdict.CANNOT_KNOW

# -------------------------------------------------------------------------------------------------------- values made


def codes_of(numbers, pixels):
    """Numbers of pixels by code, as a list over all codes."""
    counts = np.zeros(max(numbers) + 1, int)
    for code, n in pixels.items():
        counts[code] = n
    return counts.tolist()


def camera(pixels, no_answer, sigma_rel=()):
    sources = (Source.NONE, Source.SENSOR, Source.RECOVERED, Source.SWEPT, Source.FILLED)
    bins = LogHistogram.of(np.array(sigma_rel)).pack()
    reasons = codes_of(enrich.NO_ANSWER_REASONS, no_answer)
    return {"pixels": codes_of(sources, pixels), "no_answer": reasons, "recovered_sigma_rel_bins": bins}


LEFT = camera({Source.SENSOR: 10, Source.SWEPT: 5, Source.NONE: 5}, {Gate.NO_TRACK: 4, Gate.PARALLAX: 1}, [0.02] * 5)
RIGHT = camera(
    {Source.SENSOR: 30, Source.RECOVERED: 2, Source.FILLED: 3, Source.NONE: 45}, {Gate.NO_TRACK: 45}, [0.1] * 2
)
CAMERAS = enrich._summarise_cameras([{"cameras": {"left": LEFT, "right": RIGHT}}, {"cameras": {"left": RIGHT}}])
OVER_TIME = [{"cameras": {"a": {"x": [[0.0, 1.0], [1.0, 0.0]]}}}, {"cameras": {"a": {"x": [[1.0, 1.0]] * 3}}}]


def refuted(**readings):
    made = {"refuted": {name.replace("_", " "): n for name, n in readings.items()}, "frames": 9}
    return enrich.describe_refuted_poses([{"cameras": {"a": made}}])


X = torch.tensor([[[2.0, 4.0, 5.0, 4.0]]])
KEEP = torch.tensor([[[True, True, False, True]]])


def aligned(model, keep=KEEP):
    """Row of a frame whose map is scaled by 1, 1.1 and 2, without an answer at the third pixel."""
    depth = torch.tensor([[[2.0, 4.4, 0.0, 8.0]]])
    fields = {"names": ("raw", "scale"), "weight": torch.tensor([[0.7, 0.3]]), "family": None}
    made = SimpleNamespace(depth=depth, sigma=0.1 * depth, keep=keep)
    return align._summarise_frame(X, made, SimpleNamespace(model=torch.tensor([model]), **fields))


ALIGNED = [
    *(
        {"model": "scale", "scale": s, "change": abs(s - 1), "sigma": 0.1, "no_answer": n, "near": k, "far": 2 * k}
        for k, (s, n) in enumerate([(0.8, 0.0), (0.9, 0.5), (1.3, 0.1)])
    ),
    dict.fromkeys(("model", "scale", "change", "sigma")) | {"no_answer": 1.0, "near": 9, "far": 0},
]


def validated():
    """Row of a frame of four pixels with depth, two of them wrong, and one without."""
    state = torch.tensor([[[State.WRONG, State.CONSISTENT, State.WRONG, State.CANNOT_KNOW, State.WRONG]]])
    cause = torch.zeros_like(state)
    cause[0, 0, 2::2] = WrongCause.GHOST
    interval = torch.tensor([[1.0, 0.9, 1.1]])
    fields = dict.fromkeys(validate._INTERVAL_FIELDS, interval) | {"scale": interval * torch.nan}
    evidence = torch.tensor([[[5.0, -4.0, 0.5, torch.nan, 9.0]]])
    fields |= dict.fromkeys(("sparse_evidence", "photometric_evidence", "consistency_evidence"), evidence)
    depth, clip = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 0.0]]]), torch.tensor([torch.nan])
    return validate._summarise_frame(
        7, SimpleNamespace(depth=depth, state=state, cause=cause, clip_depth=clip, **fields)
    )


VALIDATED = validated()


def interval(low, high):
    return {"value": (low + high) / 2, "low": low, "high": high}


def limited(name, *rows, windows=()):
    """A limited quantity of a recording with these rows; a pair is the interval of its scale."""
    made = validate._RecordingValidation(None, None)
    for given in rows:
        row = {"scale": given and interval(*given)} if given is None or isinstance(given, tuple) else given
        blank = dict.fromkeys(("scale", "scale_vs_trajectory", "shift", "tilt", "wrong", "clip_depth"))
        shares = {f"share_{state}": 0.0 for state in ("wrong", "consistent", "cannot_know")}
        made.rows.append(
            {**blank, **shares, "pixels": 0, "wrong_causes": dict.fromkeys(validate._NAMED_CAUSES, 0), **row}
        )
    made.windows += [{"pairs": 100, "cause": cause} for cause in windows]
    return validate._summarise_recording(made)["limited"][name]


SOUND, FAR = (0.97, 1.02), (1.1, 1.2)
FEW = {"wrong": interval(0.1, 0.9), "pixels": 100, "share_cannot_know": 0.9}
MANY = {"wrong": interval(0.4, 0.6), "pixels": 100, "share_cannot_know": 0.7}
NOTHING = {"wrong": None, "pixels": 100, "share_cannot_know": 1.0}


def clipped(*depths):
    return validate._find_shared_clip_depth([{"clip_depth": depth} for depth in depths])


SUMMARY = {
    "frames": 2, "wrong": 0.25, "causes": {"millimetres": 3}, "windows": 4, "clip_depth": 2.55, "has_maps": True,
    "wrong_causes": {"ghost": None, "flying_pixel": 0.012, "edge_bleed": 0.0004}, "limited": {"unknown": 0.5, "drift": 0.0},
    "median": {"scale": None},
}  # fmt: skip


def printed(scale=None, sensor=None, **changes):
    """Printed lines of a validated recording."""
    medians = {"scale": scale, "scale_vs_trajectory": sensor}
    bounds = {"unknown": 0.5, "drift": 0.0, "scale": scale and abs(scale - 1), **changes.pop("limited", {})}
    return validate._format_summary("room", SUMMARY | {"median": medians, "limited": bounds} | changes, ["a note"])


def exceeded(limits, **values):
    return validate.list_exceeded_limits({"limited": values}, validate.parse_limits(limits))


IMAGE = torch.tensor([[0.0, 1.0, 0.5, 0.5], [1.0, 0.0, 0.5, 0.5]]).expand(1, 3, 2, 4)
FRAME = Frame(IMAGE, torch.ones(1, 2, 4), Camera(torch.ones(1, 2), torch.ones(1, 2)))
TUM = complete.FRAME_LAYOUTS["tum"]
PNG = complete.Layout("png", 1e-3, confidence=True, budget=True)
CLIP = recording(3, numbers=[4, 7, 9], times=torch.tensor([0.5, 1.25, 2.0]).double()).recording
REGULAR = recording(3, times=torch.tensor([0.0, 0.1, 0.2]).double(), rate_hz=10.0).recording
POSED = Pose(torch.eye(3).double().expand(2, 3, 3), torch.zeros(2, 3).double())
LOST = Pose(POSED.R, torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]]))


def chosen(format, wanted="auto", unit=None, same=True, sparse=False):
    """Name and step of the layout for a recording with poses and times."""
    made = recording(2, poses=POSED, times=torch.arange(2).double(), sparse=sparse).recording
    object.__setattr__(made, "format", format)
    layout = complete.select_layout(made, wanted, unit, same=same)
    return layout.name, layout.unit


SHARED = {"fractions": {"recovered": 0.1, "filled": 0.3, "sensor": 0.4, "no_answer": 0.2}}
COUNTED = {"pixels": {kind: 10_000 * x for kind, x in SHARED["fractions"].items()}, "reasons": ()}


def recovered(**measured):
    """The sentence on what was recovered, and the numbers of the page."""
    none = {} if measured else {"recovered": 0.0}
    parts = {name: value | none if none and value else value for name, value in {**SHARED, **COUNTED}.items()}
    stats = complete.RecoveryStats(3, **parts, **measured)
    scene = recording(3)
    task = SimpleNamespace(scene=scene, recording=scene.recording)
    sentence = process_capture.describe_recovery(task, stats, (4, 6), SimpleNamespace(findings=(), poses=None))[1]
    return sentence, list(process_capture.build_opening([], stats, b"", "").numbers.items())


LOG = np.log(2.0) + np.array([0.1, 0.2, 0.3, -0.1, -0.1])
LOCAL = SimpleNamespace(region=np.array([scale.REGIONS[1] + 1] * 3 + [0] * 2), log=LOG)
Fault = namedtuple("Fault", "kind n")


def verdict(*verdicts, changes=()):
    result = SimpleNamespace(verdict=torch.tensor(verdicts))
    return pin.Episode("e", list(range(len(verdicts))), result, torch.zeros(3, 4, 4), list(changes)).verdict


def rule(name, *values):
    return [option_checks._OPTION_RULES[name][0](value) for value in values]


SCENES = [recording(5, name="a", episode=4), recording(3, name="b", episode=4), recording(4, name="c", episode=9)]
WHOLE = plan.make_plan(SCENES, 1, 1, rigs=True)
SHARDS = enrich._group_shards(WHOLE.shards(2, apart=True), WHOLE, [0, 1])
ITEMS = ["left", "right", "1"]
GREY = torch.full((1, 4, 5), 51, dtype=torch.uint8)
SPARSE = torch.zeros(6, 6).index_put((torch.tensor([0, 1]), torch.tensor([1, 0])), torch.tensor([3.0, 2.0]))
SCALE = Scale("", "turbo", 2.0, 4.0, log=False)
BLANK = (np.array(colours.parse_rgb(colours.PICTURE)) / 255).tolist()

# ----------------------------------------------------------------------------------------------------------- the table

#: What is computed → what it is.
VALUES = [
    # enrich: pixels of each camera by source, the most frequent reason first
    (lambda: [c.name for c in CAMERAS], ["left", "right"]),
    (lambda: CAMERAS[0].kinds, approx({"recovered": 0.07, "filled": 0.03, "sensor": 0.4, "no_answer": 0.5})),
    (lambda: CAMERAS[1].kinds, approx({"recovered": 1 / 40, "filled": 3 / 80, "sensor": 3 / 8, "no_answer": 9 / 16})),
    (lambda: list(CAMERAS[0].reasons.values()), approx([0.49, 0.01])),
    (lambda: [c.sigma_rel for c in CAMERAS], approx([0.02, 0.1], rel=0.03)),
    (lambda: next(iter(CAMERAS[1].format_kinds().values()))[:20], "2.5% (median sigma 1"),
    (lambda: enrich._pixel_shares([{"pixels": [], "no_answer": []}])[0]["no_answer"], 1.0),
    (lambda: [CAMERAS[0]._replace(kinds={"recovered": x}, sigma_rel=y).format_kinds()["recovered"] for x, y in ((0.1, math.nan), (0.0, 0.02))],
     ["10.0%", "0.0%"]),
    (lambda: [*enrich._average_over_episodes(OVER_TIME, "x")[0][1].T.tolist()], [[0.5, 1.0], [0.75, 0.75], [1.0, 0.5]]),
    (lambda: refuted(the_inverse=3), ["a: the input poses contradict the near returns in 3 of 9 frames; they fit as the inverse"]),
    (lambda: refuted(the_inverse=3, unknown=1)[0][-33:], "4 of 9 frames; they fit as the inverse (3)"[-33:]),
    (lambda: refuted(unknown=1)[0][-27:], "s; no known convention fits"[-27:]),
    (refuted, []),
    (lambda: enrich._group_by_episode(WHOLE), [[0, 1], [2]]),
    (lambda: [(p.rows.start, p.rows.stop) for p in SHARDS[0]], [(0, 2), (2, 4), (4, 5)]),
    (lambda: [(p.rows.start, p.rows.stop) for p in SHARDS[1]], [(5, 7), (7, 8)]),
    (lambda: enrich._pose_options({"pose": "near"}), {}),
    (lambda: enrich._pose_options({"pose": "device", "pose_sigma": [0.1, 0.2]}), {"pose": "pose", "pose_cov": [0.1, 0.2], "refine": False}),
    (lambda: enrich._pose_options({"pose": "start", "pose_sigma": None})["refine"], True),
    # align
    (lambda: [aligned(1)[k] for k in ("model", "likeliest", "no_answer")], ["scale", "raw", 0.25]),
    (lambda: [aligned(1)[k] for k in ("probability", "likeliest_probability")], approx([0.3, 0.7])),
    (lambda: [aligned(1)[k] for k in ("scale", "change", "sigma")], approx([1.1, 0.1, 0.1])),
    (lambda: [aligned(-1, X < 0)[k] for k in ("model", "scale", "no_answer")], [None, None, 1.0]),
    (lambda: align._summarise_recording([{"aligned": row} for row in ALIGNED])["median"]["scale"], 0.9),
    (lambda: align._summarise_recording([{"aligned": row} for row in ALIGNED])["models"], {"scale": 3}),
    (lambda: align._summarise_recording([{"aligned": row} for row in ALIGNED])["references"], {"near": 1.5, "far": 1.0}),
    (lambda: align._summarise_recording([{"aligned": row} for row in ALIGNED])["limited"], approx(
        {"scale": 0.1, "change": 0.2, "sigma": 0.1, "no_answer": 0.4, "unaligned": 0.25})),
    (lambda: [align._severity(row) for row in ALIGNED], approx([0.1, 0.6, 0.2, 2.0])),
    # validate
    (lambda: [VALIDATED[k] for k in ("frame", "pixels", "share_wrong", "share_cannot_know")], [7, 4, 0.5, 0.25]),
    (lambda: VALIDATED["wrong_causes"], {"other": 0, "ghost": 1, "flying_pixel": 0, "edge_bleed": 0}),
    (lambda: [VALIDATED[k] for k in ("clip_depth", "scale")], [None, None]),
    (lambda: VALIDATED["sparse_evidence"], {"coverage": 0.75, "against": 2}),
    (lambda: VALIDATED["wrong"], approx({"value": 1.0, "low": 0.9, "high": 1.1})),
    (lambda: [validate._severity({"share_wrong": share}) for share in (None, 0.0, 0.5)], [-1.0, 0.0, 0.5]),
    (lambda: limited("scale", (0.98, 1.03)), 0),
    (lambda: limited("scale", (1.02, 1.08), (1.03, 1.2), (0.5, 0.6)), approx(0.02)),
    (lambda: limited("scale", (0.8, 0.9)), approx(0.1)),
    (lambda: limited("scale", None), None),
    (lambda: limited("tilt", {"tilt": interval(-0.3, -0.2)}), approx(0.2)),
    (lambda: limited("drift", SOUND, FAR), approx(1.1 - 1.02)),
    (lambda: limited("drift", SOUND, (0.99, 1.05), None), 0),
    (lambda: limited("drift", *[SOUND] * 10, FAR), 0),
    (lambda: limited("drift", *[SOUND] * 9, *[FAR] * 3), approx(1.1 - 1.02)),
    (lambda: limited("drift", FAR, None), None),
    (lambda: limited("causes"), None),
    (lambda: limited("causes", windows="a") < 0.3 < limited("causes", windows="a" * 20), True),
    (lambda: limited("wrong", FEW, MANY, NOTHING), approx((10 * 0.1 + 30 * 0.4) / 40)),
    (lambda: limited("wrong", NOTHING), None),
    (lambda: limited("unknown", FEW, MANY), approx(0.8)),
    (lambda: [clipped(2.55, 2.56, None), clipped(3.0, 2.0, 2.0, 2.01)], approx([2.555, 2.005])),
    (lambda: [clipped(2.55, None), clipped(), clipped(2.55, 3.0), clipped(2.0, 2.03, 2.06)], [None] * 4),
    (lambda: [validate._format_factor(x) for x in (1.0004, 999.19, 0.00099945, 9.99e29)], ["1.000", "999.190", "0.0009995", "9.99e+29"]),
    (lambda: validate.parse_limits("wrong>0.05, scale > 0.1"), {"wrong": 0.05, "scale": 0.1}),
    (lambda: validate.parse_limits(None), {}),
    (lambda: exceeded("wrong>0.06,scale>0", wrong=0.06, scale=None), []),
    (lambda: exceeded("wrong>0.05,scale>0.1", wrong=0.2, scale=None), [f"wrong is 0.2, limit 0.05 ({validate._VALIDATION_LIMITS['wrong']})"]),
    (printed, [
        "room: 2 frames: 25.0% of the checked pixels are wrong (1.2% flying pixel), 50.0% cannot be checked; scale unknown",
        "  likely cause in 3 of 4 windows: millimetres", "  cut at 2.55 m: larger depths are set to this value", "  a note"]),
    (lambda: printed(wrong=None, limited={"unknown": None, "drift": 0.1}, causes={}, clip_depth=None), [
        "room: 2 frames: no pixel can be checked, no depth; scale unknown",
        "  the scale differs by at least 0.100 between frames", "  a note"]),
    (lambda: printed(causes={"cut at 2.55 m": 4, "rolled": 5})[1:-1], ["  likely cause in 5 of 4 windows: rolled", "  likely cause in 4 of 4 windows: cut at 2.55 m"]),
    (lambda: printed(1.5, None)[-2], "  maps are 1.500 times the sensor's depth; without usable poses which of the two is wrong cannot be determined"),
    (lambda: printed(1.5, 1.0)[-2], "  maps are 1.500 times the sensor's depth, which agrees with the poses: the maps' scale is wrong"),
    (lambda: printed(1.5, 1 / 1.5)[-2], "  maps are 1.500 times the sensor's depth, and agree with the poses: the sensor's scale is wrong (data.depth_unit=)"),
    (lambda: printed(1.5, 1.3)[-2], "  maps are 1.500 times the sensor's depth; the poses agree with neither, so which is wrong cannot be determined"),
    (lambda: [len(printed(*x)) for x in ((1.02, 1.0), (1.5, 1.0))], [4, 5]),
    # complete
    (lambda: complete.count_pixels({"pixels": {"sensor": 1, "swept": 2, "none": 1, "recovered": 4, "filled": 3}}),
     {"recovered": 6, "filled": 3, "sensor": 1, "no_answer": 1}),
    (lambda: complete.resize_picture(FRAME, (1, 2)).tolist(), [[[128] * 3] * 2]),
    (lambda: [*complete.resize_picture(FRAME, (2, 4))[..., 1].tolist()], [[0, 255, 128, 128], [255, 0, 128, 128]]),
    (lambda: [TUM.stem(CLIP, 1), PNG.stem(CLIP, 1)], ["1.250000", "000007"]),
    (lambda: TUM.folders, ["depth", "sigma", "source", "rgb", "meta"]),
    (lambda: PNG.folders, ["depth", "sigma", "source", "confidence", "budget", "meta"]),
    (lambda: [PNG.sigma_unit, PNG.reach, TUM.reach], approx([2e-4, 65.535, 13.107], rel=1e-4)),
    (lambda: [chosen(f) for f in ("tum", "stray", "replica")], [("tum", 2e-4), ("stray", 1e-3), ("frames", 1e-3)]),
    (lambda: [chosen("driving", sparse=True), chosen("driving", sparse=True, unit=0.002)], [("frames", 0.005), ("frames", 0.002)]),
    (lambda: chosen("tum", same=False), ("frames", 1e-3)),
    (lambda: [complete._find_lack("tum", REGULAR, same) for same in (True, False)], [None, "has images larger than its maps (see size=)"]),
    (lambda: complete._find_lack("tum", recording(2).recording, True), "has no time stamps"),
    (lambda: [complete._find_lack("frames", r, True) for r in (REGULAR, recording(2, poses=LOST).recording)], ["has no pose for every frame"] * 2),
    (lambda: complete._find_lack("frames", recording(2, poses=POSED).recording, True), None),
    (lambda: complete._find_lack("stray", REGULAR, True), "is a made recording, not a Stray Scanner capture"),
    # dhtorch PATH
    (lambda: process_capture._pick_evenly(list(range(10)), 2), [2, 7]),
    (lambda: process_capture._pick_evenly([3, 4], 5), [3, 4]),
    (lambda: [spread_evenly(list("abcdefg"), 3), spread_evenly([], 3)], [["a", "d", "g"], []]),
    (lambda: recovered(near=2.04, far=5.0, error=0.037)[0], "Recovered 1,000 pixels per frame from other views, at 2.0 m to "
     "5.0 m, median sigma 3.7% of the depth; filled 3,000 by interpolation (3 frames)."),
    (lambda: recovered(near=2.04, far=5.0, error=0.037)[1][:2], [("Recovered pixels per frame", "1,000"), ("Recovered, median sigma / depth", "3.7%")]),
    (lambda: recovered()[0].partition(": ")[::2], ("Nothing was recovered", "the sensor has depth almost everywhere; cutoff=2.0 "
     "hides far returns to show what other views recover. Filled 3,000 pixels per frame by interpolation.")),
    (lambda: recovered()[1][2], ("Filled, fraction of the pixels", "30.0%")),
    (lambda: [format_capture_name(n) for n in ("kitchen_scan", "living-room", "2024-01-31", "küche")], ["Kitchen scan", "Living room", "2024-01-31", "Küche"]),
    # scale, pin, inspect, view
    (lambda: [r[:2] for r in scale._regions(SimpleNamespace(local=LOCAL, scale=2.0))], [(0, 0), (1, 1)]),
    (lambda: [r[2] for r in scale._regions(SimpleNamespace(local=LOCAL, scale=2.0))], approx([math.expm1(-0.1), math.expm1(0.2)])),
    (lambda: [r[3] for r in scale._regions(SimpleNamespace(local=LOCAL, scale=2.0))], approx([0, 1.4826 * 0.1 / math.sqrt(3)], abs=1e-9)),
    (lambda: [f.n for f in scale._distinct([Fault(kind, n) for n, kind in enumerate("aabcade")])], [0, 2, 3, 5]),
    (lambda: [pin._spread(10, 4), pin._spread(3, None), pin._spread(3, 5), pin._spread(9, 1)], [[0, 2, 5, 7], [0, 1, 2], [0, 1, 2], [0]]),
    (lambda: verdict(MOVED, MOVED, STILL, STILL, STILL), STILL),
    (lambda: verdict(MOVED, MOVED, STILL, UNKNOWN, UNKNOWN), MOVED),
    (lambda: [verdict(*[STILL] * 3, *[UNKNOWN] * 3), verdict(*[STILL] * 2, *[UNKNOWN] * 3)], [STILL, UNKNOWN]),
    (lambda: [verdict(MOVED, STILL), verdict(*[STILL] * 5, changes=[3])], [STILL, MOVED]),
    (lambda: [pin._to_rgb(x.expand(n, -1, -1)).tolist() for x in (GREY, GREY / 255) for n in (1, 3)], [[[[51] * 3] * 5] * 4] * 4),
    (lambda: inspect._paint_tile(SPARSE, SCALE, 1.0).tolist(), [[SCALE.paint(np.array([[2.0]]), np.ones((1, 1), bool))[0, 0].tolist(), BLANK], [BLANK] * 2]),
    (lambda: [inspect._paint_tile(SPARSE, SCALE, x).shape for x in (2.0, 0.5)], [(4, 2, 3), (2, 4, 3)]),
    (lambda: [inspect._paint_tile(x, None, 1.0)[2, 2].tolist() for x in (GREY, GREY.expand(3, -1, -1))], [approx([0.2] * 3)] * 2),
    (lambda: [view._select_item(ITEMS, wanted, str) for wanted in (None, "right", 0, 1)], ["left", "right", "left", "1"]),
    # options and errors
    (lambda: rule("planes", 1, 2, 2.5, True), [False, True, False, False]),
    (lambda: rule("max_sigma_rel", 0, 0.1, math.inf, -1, True), [False, True, True, False, False]),
    (lambda: rule("min_weight", 0, -0.1), [True, False]),
    (lambda: rule("figures", True, "all", 1, "some"), [True, True, False, False]),
    (lambda: rule("threads", None, 1, 0), [True, True, False]),
    (lambda: rule("gap", "auto", 0, -1, "x"), [True, True, False, False]),
    (lambda: rule("fps", None, 1e-4, 1e4, 0, 1e5), [True, True, True, False, False]),
    (lambda: rule("step", 0, 1, 1.1, None), [True, True, False, False]),
    (lambda: [option_checks._matches_hint(*x) for x in ((1, int), ("a", int), ([1, 2], list[int]), (["a"], list[int]), ([1, 2], tuple[int, int, int]))],
     [True, False, True, False, False]),
    (lambda: run.format_error(ValueError("two\n lines")), "two lines"),
    (lambda: run.format_error(KeyError("name")), "name"),
    (lambda: run.format_error(ZeroDivisionError("x")), "ZeroDivisionError: x"),
    (lambda: run.format_error(FileNotFoundError(2, "No such file", "a")), "a: No such file"),
    (lambda: run.format_error(ValueError("Caught\nOriginal Traceback\n  File x\nValueError: the end")), "ValueError: the end"),
]  # fmt: skip


@pytest.mark.parametrize(("compute", "expected"), VALUES, ids=range(len(VALUES)))
def test_a_value_is_the_one_made_by_hand(compute, expected):
    assert compute() == expected


# ---------------------------------------------------------------------------------------------------------------- keys

#: Options of ``dhtorch enrich`` → another value.
KEYED = {
    "data": ({"path": "one"}, {"path": "one", "rate_hz": 5}), "method": ({"n": 6}, {"n": 7}), "seed": (0, 1),
    "choices": ({"data": "auto", "method": "map"}, {"data": "lerobot", "method": "map"}), "format": ("lerobot", "v2.1"),
    "dense": (True, False), "causal": (True, False), "gap": ("auto", 3), "cameras": (False, True), "maps": ("numbers", "images"),
    "pose": ("device", "start"), "pose_sigma": (None, [0.01, 0.02]), "sensor": (None, "kinect_v2"), "task": (None, "fold"),
    "columns": (["depth", "sigma"], ["depth"]), "max_frames": (None, 5), "every": (1, 2), "step": (2**-10, 0.0), "fps": (None, 12.0),
    "on_error": ("raise", "flag"),
}  # fmt: skip


@pytest.mark.parametrize("option", [*KEYED, None])
def test_a_set_of_other_options_has_another_key(option, monkeypatch):
    """Keys are their settings here: what else enters them, the code among it, has tests of its own and takes seconds."""
    texts = lambda config, digest, roots: json.dumps(config, sort_keys=True)  # noqa: E731
    monkeypatch.setattr(enrich.result_files, "compute_result_key", texts)
    settings = {name: copy.deepcopy(value) for name, (value, _) in KEYED.items()} | {"workers": 0, "report": True}
    other = settings | ({"workers": 3, "report": False} if option is None else {option: KEYED[option][1]})
    whole = plan.make_plan([recording(2)], 1, 1)
    one, two = (enrich._build_metadata(each, whole, map_columns(True))["key"] for each in (settings, other))
    assert (one == two) == (option is None), "how a set is computed is no part of its key"


# ------------------------------------------------------------------------------------------------------------- windows


class Numbered(list):
    """Frames with numbers."""

    @property
    def number(self):
        return torch.tensor(list(self))


class Maps(list):
    """Maps of a few frames."""

    doubts = notes = ()

    @property
    def frames(self):
        return list(range(len(self)))


ONE, TWO, OTHER = torch.ones(1, 2, 3), torch.full((1, 2, 3), 2.0), torch.ones(1, 4, 6)
CUT = {20: 2.5, 21: 2.5, 22: 2.51, 24: 2.5}


@pytest.mark.parametrize(
    ("n", "maps", "settings", "cause", "clips", "windows"),
    [
        (10, None, {}, "mm", {}, [(20, 23, "mm"), (24, 27, "mm")]),
        (10, None, {"max_frames": 6}, "mm", {}, [(20, 23, "mm")]),
        (10, None, {"every": 3}, "mm", {}, [(20, 23, "mm"), (24, 27, "mm")]),
        (3, None, {}, "mm", {}, [(20, 22, "mm")]),
        (1, None, {}, "mm", {}, []),
        (10, None, {"window": 0}, "mm", {}, []),
        (8, None, {}, None, CUT, [(20, 23, "cut at 2.5 m"), (24, 27, None)]),
        (8, None, {}, "mm", CUT, [(20, 23, "mm"), (24, 27, "mm")]),
        (4, Maps([ONE, None, TWO, None]), {}, "mm", {}, [(20, 23, "mm")]),
        (4, Maps([ONE, OTHER, None, None]), {}, "mm", {}, [(20, 23, None)]),
        (4, Maps([None] * 4), {}, "mm", {}, [(20, 23, None)]),
    ],
)
def test_windows_cover_the_validated_frames_and_are_of_one_size(monkeypatch, n, maps, settings, cause, clips, windows):
    diagnosed, texts = [], []
    frame = SimpleNamespace(camera=SimpleNamespace(f=torch.ones(1, 2)), hw=(2, 3), image=[torch.zeros(3, 2, 3)])

    def diagnose(frames, maps=None, seed=None):
        diagnosed.append((frames, maps, seed))
        return validate.faults.Diagnosis(cause, cause and "unit", {"unit": 0.5}, 3, "tracks")

    made = {"load_frame": lambda scene, _, i: frame if len(texts) < 2 else f"frame {i}", "stack": lambda _: None}
    made |= {"validate_depth": lambda *_, **__: None, "candidate_frames": lambda *_: []}
    made["_summarise_frame"] = lambda number, _: {"frame": number, "clip_depth": clips.get(number), "share_wrong": 0.0}
    for name, function in made.items():
        monkeypatch.setattr(validate, name, function)
    monkeypatch.setattr(validate.faults, "diagnose", diagnose)
    scene = SimpleNamespace(name="hall", recording=Numbered(range(20, 20 + n)), hint=None)
    options = {"every": 1, "max_frames": None, "window": 4, "seed": 5, "pictures": 0, "steps": [1], "views": True}
    options |= {"source_views": 2, "size": 96, "tolerance": 0.025, **settings}
    progress = lambda items, text, count: texts.append((text, count)) or items  # noqa: E731
    validation = validate._validate_recording(validate._RecordingValidation(scene, maps), None, options, progress)
    assert [(*row["frames"], row["cause"]) for row in validation.windows] == windows
    numbers = range(20, 20 + n)[:: options["every"]][: options["max_frames"]]
    assert [row["frame"] for row in validation.rows] == [*numbers]
    assert texts[0] == ("hall: frames", len(numbers)) and texts[1:] in ([], [("hall: windows", len(windows))])
    kinds = {"mm": ("unit", 3, "tracks"), None: (None, 3, "tracks"), "cut at 2.5 m": ("cut", 3, "tracks")}
    for row in validation.windows if diagnosed else ():
        assert (row["kind"], row["pairs"], row["by"]) == kinds[row["cause"]] and row["loss"] == {"unit": 0.5}
    if maps and diagnosed:
        assert [float(each.mean()) for each in diagnosed[0][1]] == [1, 0, 2, 0]
    assert bool(diagnosed) == bool(windows and (maps is None or maps[2] is not None))
    assert not diagnosed or (diagnosed[-1][0][0] == f"frame {4 * len(diagnosed) - 4}" and diagnosed[0][2] == 5)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 40, 64, 100, 777])
def test_any_first_part_of_an_order_is_spread_evenly(n):
    order = process_capture._order_evenly(n)
    assert sorted(order) == list(range(n)) and order[:3] == list(dict.fromkeys([n // 2, 0, n - 1][: 3 * n]))[:n]
    for k in range(4, n):
        done = np.array(sorted(order[:k]))
        assert np.diff(done).max() <= max(2.6 * n / k, 2), (k, "no part is left out")
        assert abs((done < n / 2).sum() - k / 2) <= 2 + 0.02 * k, (k, "no half waits for the other")


def test_recovery_is_averaged_over_frames_of_their_own_size(monkeypatch):
    rows = {
        "0": {"pixels": {"sensor": 50, "swept": 25, "none": 25}, "no_answer": {"parallax": 0.2, "no_track": 0.05}},
        "1": {"pixels": {"sensor": 10, "swept": 10, "filled": 10, "none": 10}, "no_answer": {"no_track": 0.25}},
    }
    depth = np.linspace(1, 2, 101)
    maps = {"depth": np.append(depth, [9.0, 0.0]), "sigma": 0.1 * np.append(depth**2, [1.0, 1.0])}
    source = np.array([Source.SWEPT] * 101 + [Source.SENSOR, Source.SWEPT])
    monkeypatch.setattr(complete, "read_completed_maps", lambda *_: (maps, source))
    stats = complete.measure_recovery(SimpleNamespace(name=str, done=rows), [0, 1])
    assert [stats.frames, stats.near, stats.far, stats.error] == approx([2, 1.02, 1.98, 0.15])
    assert stats.fractions == approx({"recovered": 0.25, "filled": 0.125, "sensor": 0.375, "no_answer": 0.25})
    assert stats.pixels == {"recovered": 17.5, "filled": 5, "sensor": 30, "no_answer": 17.5}
    assert dict(stats.reasons) == approx({"no_track": 0.15, "parallax": 0.1}) and stats.reasons[0][0] == "no_track"


def test_a_stream_reports_frames_back_holes_and_speed(monkeypatch):
    pushed = []

    class Stream:
        cuts, nbytes = [], 3 * 2**20

        def __init__(self, method, *, steps, seed, hint):
            assert (steps, seed) == ((1, 2), 5)

        def push(self, frame, *, trace):
            pushed.append(frame)
            self.cuts += [1] if len(pushed) == 2 else []
            trace["back"] = torch.tensor([[2], [1]])
            trace["samples"] = SimpleNamespace(usable=torch.tensor([[True, False, False, True]]))
            sigma = torch.tensor([[0.5, 0.06, torch.nan, torch.nan]])
            return SimpleNamespace(keep=torch.tensor([[True, True, False, False]]), sigma=sigma, depth=2 + 0 * sigma)

    ticks = iter([0.0, 0.25, 1.0, 1.25, 2.0, 2.5])
    monkeypatch.setattr(stream, "Stream", Stream)
    monkeypatch.setattr(stream.time, "perf_counter", lambda: next(ticks))
    options = {"steps": (1, 2), "seed": 5, "dtype": "float32", "device": "cpu", "cutoff": None}
    row = stream.stream_scene(recording(3, numbers=[3, 5, 9]), None, options, progress=lambda items, *_: items)
    found = [[each[k] for k in ("frame", "back", "cut", "n_holes", "n_recovered")] for each in row["frames"]]
    assert found == [[3, [1, 2], False, 2, 1], [5, [1, 2], True, 2, 1], [9, [1, 2], False, 2, 1]]
    assert row["recovered_sigma_rel"] == approx(0.03), "of the sample without a return"
    assert [row[k] for k in ("ms_median", "frames_per_second", "recovered", "mib")] == [250.0, 3.0, 0.5, 3.0]
    half = "50.0% of the samples without a return recovered from other views (median sigma 3.0% of the depth)"
    assert stream._format_summary(row) == f"one: 3 frames, 3.00 frames/s, {half}, 3 MiB of memory; cuts at 1"
