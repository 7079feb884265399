"""What scores and sigmas turned out to be worth, learnt, kept as text, and used in the scoring stage."""

import dataclasses
import functools
import json
import math
import statistics

import numpy as np
import pytest
import torch

from dhtorch import calibration
from dhtorch.calibration import monotone, score_calibration
from dhtorch.codes import Gate
from dhtorch.metrics import control, errors, reliability, risk
from dhtorch.records import Estimate, PoseFit, Samples, Tracks
from dhtorch.stages import score


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def scene_of(n, seed=0, spread=1.0, silent=0.2, boast=1.0, floor=0.0):
    """Answers whose error is normal with a known relative sigma, and a score that falls with it."""
    g = generator(seed)
    rel = 0.02 + 0.3 * torch.rand(n, generator=g, dtype=torch.float64) ** 2
    true = 2 + 4 * torch.rand(n, generator=g, dtype=torch.float64)
    noise = ((spread * rel) ** 2 + floor**2).sqrt() * torch.randn(n, generator=g, dtype=torch.float64)
    depth = (true * (1 + noise)).clamp_min(0.01)
    keep = torch.rand(n, generator=g, dtype=torch.float64) >= silent
    return errors.make_points(depth, true, (0.1 / (0.1 + rel)) ** boast, sigma=rel * true, keep=keep)


def fitted(**provenance):
    note = {"method": "test", "scenes": ["a", "b"]} | provenance
    return score_calibration.fit_calibration([scene_of(800, s) for s in range(3)], provenance=note)


# ---------------------------------------------------------------------------------------------------- plain loops


def loop_quantile(x, weight, share):
    """The smallest value below or at which that share of the weight lies."""
    below, total = 0.0, sum(weight)
    for value, w in sorted(zip(x, weight, strict=True)):
        below += w
        if below >= share * total - 1e-12:
            return value
    return max(x)


def loop_sigma(scenes):
    """Scale and floor: the likeliest under Student's t of those that hold 68 %, widened until 91 % lie within two."""
    t = pytest.importorskip("scipy.stats").t(3)
    error, sigma, weight = [], [], []
    for p in scenes:
        rows = zip(p.depth.tolist(), p.true_depth.tolist(), p.sigma.tolist(), p.keep.tolist(), strict=True)
        rows = [(abs(z - true) / z, s / z) for z, true, s, k in rows if k and math.isfinite(s) and s > 0]
        error, sigma = error + [e for e, _ in rows], sigma + [s for _, s in rows]
        weight += [1 / len(rows)] * len(rows)
    best = None
    for floor in (0.0, *(10 ** (-4 + k / 10) for k in range(31))):
        ratio = [(e * e - floor * floor) / (s * s) for e, s in zip(error, sigma, strict=True)]
        scale = math.sqrt(max(0.0, loop_quantile(ratio, weight, 0.6826894921370859)))
        spread = np.maximum([math.hypot(scale * s, floor) for s in sigma], 1e-300)
        likely = float((np.array(weight) * (t.logpdf(np.array(error) / spread) - np.log(spread))).sum())
        best = (likely, scale, floor, spread) if best is None or likely > best[0] else best
    _, scale, floor, spread = best
    wider = max(1.0, loop_quantile((np.array(error) / spread).tolist(), weight, 0.91) / 2)
    return scale * wider, floor * wider, wider


@pytest.mark.parametrize(("spread", "floor", "gross"), [(0.5, 0.0, 0), (2.0, 0.05, 0), (1.0, 0.02, 7), (0.3, 0.2, 9)])
def test_the_correction_of_sigma_equals_plain_loops(spread, floor, gross):
    scenes = [scene_of(n, seed, spread=spread, floor=floor) for seed, n in enumerate((30, 80, 45))]
    scenes[0].sigma[:5], scenes[1].sigma[3] = 0.0, math.inf
    for scene in scenes:
        scene.depth[5 : 5 + gross] *= 3  # gross errors, more than one in ten
    found = score_calibration.fit_sigma_model(scenes)
    scale, floor, wider = loop_sigma(scenes)
    assert (found.scale, found.floor) == pytest.approx((scale, floor), rel=1e-6) and (wider > 1) is (gross > 0)


def test_a_calibration_is_made_of_what_the_functions_say():
    scenes = [scene_of(n, s) for s, n in enumerate((90, 40, 60))]
    silent = errors.make_points(torch.full((4,), math.nan), torch.ones(4))
    score, good, weight = reliability.pool_answers(scenes)
    loss = torch.cat([s.answered().error.clamp(max=1) for s in scenes])
    for options, share in (({}, 0.02), ({"min_share": 0.2}, 0.2)):
        learnt = score_calibration.fit_calibration([*scenes, silent], **options)
        steps = {"min_share": share, "ends": (0.0, 1.0)}
        for found, wanted in (
            (learnt.probability, monotone.fit_isotonic(score, good.double(), weight, **steps)),
            (learnt.expected_error, monotone.fit_isotonic(score, loss, weight, rising=False, **steps)),
        ):
            assert torch.equal(found.x, wanted.x) and torch.equal(found.y, wanted.y)
    assert torch.equal(learnt.sigmoid.slope, monotone.fit_platt(score, good, weight).slope)
    assert learnt.sigma == score_calibration.fit_sigma_model(scenes)
    everyone = [*scenes, silent]
    assert learnt.thresholds == {k: control.plug_in_threshold(everyone, k / 100).threshold for k in (5, 10, 20)}
    assert learnt.provenance == {"n_scenes": 3, "n_answers": score.numel()}
    other = score_calibration.fit_calibration(scenes, targets=(30,), provenance={"method": "x"})
    assert (
        other.thresholds == {30: control.plug_in_threshold(scenes, 0.3).threshold} and other.provenance["method"] == "x"
    )


def test_scores_beyond_0_and_1_end_the_tables_where_they_end():
    scene = scene_of(60, 1)
    wide = scene.replace(score=torch.where(scene.keep, 3 * scene.score - 1, 0.0))
    learnt = score_calibration.fit_calibration([wide])
    answered = wide.answered().score
    for table in (learnt.probability, learnt.expected_error):
        assert (float(table.x[0]), float(table.x[-1])) == (float(answered.min()), float(answered.max()))
    edge = scene.replace(score=torch.where(scene.keep, scene.score.clamp(0.3, 0.6), 0.0))
    assert [float(score_calibration.fit_calibration([edge]).probability.x[k]) for k in (0, -1)] == [0, 1]


def test_a_calibration_is_applied_to_score_and_sigma():
    learnt, scene = fitted(), scene_of(50, 8)
    found = learnt.apply(scene)
    for k in range(50):
        if scene.keep[k]:
            assert float(found.score[k]) == pytest.approx(
                float(np.interp(scene.score[k], learnt.probability.x, learnt.probability.y))
            )
            wanted = math.hypot(learnt.sigma.scale * float(scene.sigma[k]), learnt.sigma.floor * float(scene.depth[k]))
            assert float(found.sigma[k]) == pytest.approx(wanted)
        else:
            assert found.score[k] == 0 and found.sigma[k].isnan()
    assert torch.equal(found.depth[scene.keep], scene.depth[scene.keep])
    bare = scene.replace(sigma=scene.sigma * math.nan)
    assert (
        score_calibration.fit_calibration([bare]).sigma is None
        and score_calibration.fit_calibration([bare]).apply(scene).sigma is scene.sigma
    )


def test_the_least_score_is_the_threshold_after_calibration():
    learnt = fitted()
    low = float(learnt.thresholds[10])
    assert learnt.min_score(10) == pytest.approx(float(np.interp(low, learnt.probability.x, learnt.probability.y)))
    silent = dataclasses.replace(learnt, thresholds={10: None})
    assert silent.min_score(10) is None and '"10": null' in silent.to_json()
    with pytest.raises(KeyError):
        silent.min_score(5)
    with_none = score_calibration.parse_calibration(dataclasses.replace(silent, sigma=None).to_json())
    assert with_none.sigma is None and with_none.thresholds == {10: None}


def test_floors_are_tried_from_a_ten_thousandth_to_a_tenth():
    assert score_calibration._SIGMA_FLOORS_REL[:2] == (0.0, 1e-4) and score_calibration._SIGMA_FLOORS_REL[
        -1
    ] == pytest.approx(0.1)
    assert np.diff(np.log10(score_calibration._SIGMA_FLOORS_REL[1:])) == pytest.approx([0.1] * 30)


# ---------------------------------------------------------------------------------------------------- calibration


def test_a_boastful_score_becomes_calibrated_in_scenes_not_fitted():
    fitting = [scene_of(4000, seed, boast=0.3) for seed in range(6)]
    fresh = [scene_of(4000, seed, boast=0.3) for seed in range(10, 16)]
    learnt = score_calibration.fit_calibration(fitting)
    before, after = (
        reliability.measure_reliability(fresh)["ece"],
        reliability.measure_reliability([learnt.apply(s) for s in fresh])["ece"],
    )
    assert before > 0.1 and after < 0.02
    expected = torch.cat([learnt.expected_error(s.answered().score) for s in fresh])
    actual = torch.cat([risk.cap_error(s.answered().error) for s in fresh])
    assert float(expected.mean()) == pytest.approx(float(actual.mean()), rel=0.05)
    assert float(expected[expected < 0.05].mean()) == pytest.approx(float(actual[expected < 0.05].mean()), rel=0.1)


def test_every_scene_teaches_equally():
    few, many = scene_of(50, 1), scene_of(5000, 2, spread=3.0)
    once, copied = (
        score_calibration.fit_calibration([few, many]),
        score_calibration.fit_calibration([few, many[torch.arange(5000).repeat(3)]]),
    )
    at = torch.linspace(0, 1, 30, dtype=torch.float64)
    torch.testing.assert_close(once.probability(at), copied.probability(at))
    torch.testing.assert_close(once.expected_error(at), copied.expected_error(at))


@pytest.mark.parametrize(("spread", "floor"), [(0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (1.5, 0.03), (0.7, 0.1)])
def test_the_correction_of_sigma_is_found(spread, floor):
    scenes = [scene_of(n, seed, spread=spread, floor=floor) for seed, n in enumerate((1500, 4000, 2500))]
    found = score_calibration.fit_sigma_model(scenes)
    stated, one = torch.linspace(0.02, 0.32, 30, dtype=torch.float64), torch.ones(30, dtype=torch.float64)
    torch.testing.assert_close(
        found(stated, one), score_calibration.SigmaModel(spread, floor)(stated, one), rtol=0.08, atol=0
    )
    learnt = [errors.measure_errors(score_calibration.fit_calibration(scenes).apply(s)) for s in scenes]
    assert statistics.mean(m["within_sigma"] for m in learnt) == pytest.approx(0.683, abs=0.002)
    assert statistics.mean(m["within_2sigma"] for m in learnt) == pytest.approx(0.954, abs=0.01)
    assert found(torch.tensor(3.0), torch.tensor(2.0)) == pytest.approx(math.hypot(3 * found.scale, 2 * found.floor))
    assert score_calibration.fit_sigma_model([errors.make_points(torch.ones(3), torch.ones(3))]) is None


def test_the_correction_of_sigma_weighs_scenes_and_survives_exact_ones():
    few, many = scene_of(300, 1), scene_of(3000, 2, spread=3.0)
    once, copied = (
        score_calibration.fit_sigma_model([few, many]),
        score_calibration.fit_sigma_model([few, many[torch.arange(3000).repeat(3)]]),
    )
    assert (once.scale, once.floor) == pytest.approx((copied.scale, copied.floor), rel=1e-9)
    exact = score_calibration.fit_sigma_model(
        [errors.make_points(torch.ones(30), torch.ones(30), sigma=torch.ones(30))]
    )
    assert math.isfinite(exact.scale) and math.isfinite(exact.floor)


def test_calibration_changes_no_order_and_keeps_silence():
    scene = scene_of(1000, 3)
    there = score_calibration.fit_calibration([scene_of(2000, s) for s in range(3)]).apply(scene)
    assert torch.equal(there.keep, scene.keep) and (there.score[~scene.keep] == 0).all()
    assert risk.measure_risk(there)["aurc"] == pytest.approx(risk.measure_risk(scene)["aurc"], abs=1e-12)


def test_a_calibration_of_nothing_raises():
    silent = errors.make_points(torch.full((4,), math.nan), torch.ones(4))
    for scenes in ([], [silent]):
        with pytest.raises(ValueError, match="fit_calibration: found no answer"):
            score_calibration.fit_calibration(scenes)


def test_json_there_and_back(tmp_path):
    learnt = fitted(truth="full")
    back = calibration.load_calibration(calibration.save_calibration(learnt, tmp_path / "sub" / "mine.json"))
    at = torch.linspace(-0.1, 1.1, 200, dtype=torch.float64)
    for name in ("probability", "expected_error", "sigmoid"):
        assert torch.equal(getattr(back, name)(at), getattr(learnt, name)(at)), name
    assert (back.sigma, back.thresholds) == (learnt.sigma, learnt.thresholds)
    assert back.provenance == learnt.provenance
    assert back.provenance["n_scenes"] == 3 and back.to_json() == learnt.to_json()


def broken(path, value):
    content = json.loads(fitted().to_json())
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return json.dumps(content)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), 2, r"mine\.json\.schema: found 2, expected 1"),
        (("probability",), None, r"mine\.json\.probability: found nothing"),
        (("more",), 1, r"mine\.json\.more: found an unknown field"),
        (("probability", "score"), [0.5, 0.2], r"mine\.json\.probability\.value: found .* expected 2, one for each"),
        (("probability", "value", 0), 2.0, r"mine\.json\.probability\.value: found .*expected rising numbers from 0"),
        (("expected_error", "value", 0), 0, r"mine\.json\.expected_error\.value: found .*expected falling numbers"),
        (("probability", "score", 1), -1.0, r"mine\.json\.probability\.score: found .*expected rising"),
        (("probability", "score", 1), "0.1", r"mine\.json\.probability\.score\.1: found 0\.1, expected a finite"),
        (("expected_error", "score"), [], r"mine\.json\.expected_error\.score: found \[\], expected a list"),
        (("sigmoid", "slope"), True, r"mine\.json\.sigmoid\.slope: found true"),
        (("sigma", "floor"), -1, r"mine\.json\.sigma\.floor: found -1, expected a number of at least 0"),
        (("sigma", "scale"), 10**400, r"mine\.json\.sigma\.scale: found 1000"),
        (("probability", "score", 1), 0.0, r"mine\.json\.probability\.score: found \[0\.0, 0\.0, .*expected rising"),
        (("thresholds", "100"), 0.5, r"mine\.json\.thresholds\.100: found 100, expected a whole number"),
        (("thresholds", "0"), 0.5, r"mine\.json\.thresholds\.0: found 0, expected a whole number"),
        (
            ("expected_error", "value", 0),
            1.5,
            r"mine\.json\.expected_error\.value: found .*falling numbers from 0 to 1",
        ),
        (("sigma",), {"scale": 1}, r"mine\.json\.sigma\.floor: found nothing"),
        (("thresholds", "ten"), 0.5, r"mine\.json\.thresholds\.ten: found ten, expected a whole number"),
        (("provenance",), [], r"mine\.json\.provenance: found \[\], expected an object"),
    ],
)
def test_a_damaged_calibration_is_refused_by_file_and_field(path, value, message, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(broken(path, value))
    with pytest.raises(ValueError, match=message):
        calibration.load_calibration(file)


def test_level_tables_and_narrow_ones_are_read():
    content = json.loads(fitted().to_json())
    for name in ("probability", "expected_error"):
        content[name] = {"score": [0.25, 0.5, 3.0], "value": [0.5, 0.5, 0.5]}
    content["thresholds"] = {"1": 0.5, "99": None}
    found = score_calibration.parse_calibration(json.dumps(content))
    assert found.probability(torch.tensor([0.0, 9.0])).tolist() == [0.5, 0.5] and found.thresholds == {1: 0.5, 99: None}


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"schema": NaN}', "null"])
def test_text_that_is_no_calibration_is_refused(text, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"mine\.json"):
        calibration.load_calibration(file)


def test_origin_is_not_optional(tmp_path):
    with pytest.raises(ValueError, match=r"provenance\.scenes, expected"):
        calibration.save_calibration(fitted(scenes=[]), tmp_path / "mine.json")
    with pytest.raises(FileNotFoundError, match="nobody: found no calibration"):
        calibration.load_calibration("nobody")


@pytest.mark.parametrize("name", calibration.list_calibrations() or [None])
def test_what_travels_with_the_package_is_valid(name):
    if name is None:
        pytest.skip("no calibration travels with the package yet")
    found = calibration.load_calibration(name)
    assert found.provenance["method"] and found.provenance["scenes"] and found.to_json()


# ---------------------------------------------------------------------------------------------------- the stage


def answers(sigma, shared=0.0, depth=2.0, residual=0.0, gate=None, error=0.0, photometric=0.0):
    """An estimate (1, N) and what else the stage takes."""
    sigma = torch.as_tensor(sigma, dtype=torch.float64)[None]
    like = torch.ones_like(sigma)
    gate = torch.zeros_like(sigma).int() if gate is None else torch.tensor([gate], dtype=torch.int32)
    silent = gate != 0
    blank = lambda x: torch.where(silent, torch.nan, x * like)  # noqa: E731
    uv = torch.zeros(*sigma.shape, 2, dtype=torch.float64)
    estimate = Estimate(
        uv, blank(depth), blank(sigma), blank(shared), 0 * like, residual * like, gate, 1.0 - silent.double(), gate
    )
    samples = Samples(uv, like, like, torch.zeros(*sigma.shape, 3), like, gate, like, gate)
    cov = torch.eye(2, dtype=torch.float64).expand(*sigma.shape, 2, 2)
    tracks = Tracks(uv, uv, error * like, photometric * like, cov, ~silent)
    none = torch.zeros(1)
    return estimate, samples, tracks, PoseFit(None, none, none, none, none, none, none, none)


def scores(*args, **options):
    return score.confidence_from_error(*answers(*args), **options).score[0]


def test_the_score_is_the_stated_function_of_the_expected_error():
    sigma, shared = torch.tensor([0.1, 0.5, 2.0]), 0.06
    found = score.confidence_from_error(
        *answers(sigma, shared, residual=0.8), residual_scale_px=0.5, half_error=0.2
    ).score[0]
    expected = [math.sqrt(s * s - shared * shared) / 2 * math.sqrt(1 + (0.8 / 0.5) ** 2) for s in sigma.tolist()]
    assert found.tolist() == pytest.approx([0.2 / (0.2 + e) for e in expected], rel=1e-6)


def test_the_score_falls_with_every_reason_to_doubt():
    rising = torch.linspace(1e-3, 3, 50, dtype=torch.float64)
    own = scores(rising)
    assert (own.diff() < 0).all() and 0 < own[-1] < own[0] < 1
    for name, option in (
        ("residual", "residual_scale_px"),
        ("photometric", "photometric_scale"),
        ("error", "round_trip_scale_px"),
    ):
        worse = [
            score.confidence_from_error(*answers([0.1], **{name: x}), **{option: 0.5}).score.item()
            for x in (0, 0.1, 1, 9)
        ]
        assert worse == sorted(worse, reverse=True) and len(set(worse)) == 4, name
    ignored = score.confidence_from_error(*answers([0.1], photometric=3.0, error=2.0), round_trip_scale_px=None).score
    assert ignored == score.confidence_from_error(*answers([0.1])).score


def test_what_a_pair_shares_moves_no_rank_and_never_flatters():
    shared = torch.tensor([0.0, 0.3, 3.0])
    whole = (0.1**2 + shared**2).sqrt()
    estimate, *rest = answers(whole.double())
    estimate = estimate.replace(sigma_shared=shared.double()[None])
    assert score.confidence_from_error(estimate, *rest).score[0].tolist() == pytest.approx(
        [0.1 / (0.1 + 0.05)] * 3, rel=1e-4
    )
    swamped = score.confidence_from_error(*answers([10.0], 10.0)).score.item()
    assert swamped <= 0.1 / (0.1 + 10.0 / 2 * math.sqrt(score.MIN_SCORED_OWN_RATIO)) + 1e-9


def test_answers_without_a_stated_error_score_zero_and_silence_stays():
    estimate, *rest = answers([0.1, math.nan, math.inf, 0.1, 0.1], gate=[0, 0, 0, Gate.PARALLAX, 0])
    out = score.confidence_from_error(estimate, *rest)
    assert out.score[0].tolist() == pytest.approx([2 / 3, 0, 0, 0, 2 / 3])
    assert out.gate[0].tolist() == [0, 0, 0, Gate.PARALLAX, 0] and out.depth[0, 3].isnan()
    cut = score.confidence_from_error(estimate, *rest, min_score=0.5)
    assert cut.gate[0].tolist() == [0, Gate.LOW_SCORE, Gate.LOW_SCORE, Gate.PARALLAX, 0]
    assert cut.depth[0].isnan().tolist() == [False, True, True, True, False] == cut.sigma[0].isnan().tolist()


def test_a_recalibrated_score_is_the_tables_probability():
    table = fitted().probability
    sigma = torch.linspace(0.01, 2, 40, dtype=torch.float64)
    raw, out = scores(sigma), scores(sigma, recalibration=table)
    assert torch.equal(out, table(raw)) and (out.diff() < 0).all()
    limit = fitted().min_score(10)
    kept = score.confidence_from_error(*answers(sigma), recalibration=table, min_score=limit).keep[0]
    assert torch.equal(kept, raw >= fitted().thresholds[10]) and 0 < kept.sum() < 40


@pytest.mark.parametrize("kind", ["table", pytest.param("sigmoid", marks=pytest.mark.slow)])
def test_a_recalibrated_stage_captures_maps_differentiates_and_keeps_to_itself(kind):
    learnt = fitted()
    stage = functools.partial(
        score.confidence_from_error, recalibration=learnt.probability if kind == "table" else learnt.sigmoid
    )
    _, *rest = answers([0.1] * 37)
    sigma = 0.01 + uniform(5, 37)
    estimate = answers([0.1] * 37)[0].map(lambda x: x.expand(5, *x.shape[1:])).replace(sigma=sigma)

    def out(s, estimate=estimate):
        records = [r.map(lambda x: x[:1].expand(s.shape[0], *x.shape[1:])) for r in (estimate, *rest[:2])]
        return stage(records[0].replace(sigma=s), *records[1:], rest[2]).score

    together = out(sigma.float())
    for b in range(5):
        assert torch.equal(together[b : b + 1], out(sigma[b : b + 1].float()))
    torch._dynamo.reset()
    assert torch.equal(torch.compile(out, fullgraph=True, backend="eager")(sigma), out(sigma))
    assert torch.allclose(torch.func.vmap(lambda s: out(s[None])[0])(sigma), out(sigma))
    assert torch.autograd.gradcheck(
        lambda s: out(torch.cat((s, sigma[:1, 4:]), 1)), (sigma[:1, :4].clone().requires_grad_(),)
    )


def test_bytes_that_are_no_text_are_named(tmp_path):
    file = tmp_path / "mine.json"
    file.write_bytes(b'{"schema": 1, "x": "\xff"}')
    with pytest.raises(ValueError, match=r"mine\.json: found invalid start byte at byte 20, expected text in UTF-8"):
        calibration.load_calibration(file)
