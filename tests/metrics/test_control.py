"""Risk controls: against plain loops, at their limits, and whether the promise is kept over many synthetic worlds."""

import math
import statistics

import pytest
import torch

from dhtorch.metrics import control, errors, risk


def world_of(n, points=40, seed=0, hard=0.2):
    """Exchangeable scenes: each draws how good its answers are and how well its score knows; some are hostile."""
    g = torch.Generator().manual_seed(seed)
    shape = (n, points)
    level = 0.02 + 0.1 * torch.rand(n, 1, generator=g, dtype=torch.float64)
    hostile = torch.rand(n, 1, generator=g, dtype=torch.float64) < hard
    own = torch.rand(shape, generator=g, dtype=torch.float64)
    error = level * own * 6 + hostile * 0.3 * torch.rand(shape, generator=g, dtype=torch.float64)
    score = 1 / (1 + own + 0.3 * torch.rand(shape, generator=g, dtype=torch.float64))
    silent = torch.rand(shape, generator=g, dtype=torch.float64) < 0.2
    depth = torch.where(silent, torch.nan, 2 * (1 + error))
    flat = errors.make_points(depth, torch.full_like(depth, 2.0), score)
    return flat.map(lambda x: x.reshape(shape))


def split(world):
    """The scenes of a world, one by one."""
    return [world[k] for k in range(world.keep.shape[0])]


def scenes_of(n, **options):
    return split(world_of(n, **options))


def mean_loss(world, threshold):
    """Mean over scenes of the capped error of what is answered, over all candidates."""
    taken = world.keep & (world.score >= (math.inf if threshold is None else threshold))
    return float(torch.where(taken, risk.cap_error(world.error), 0.0).mean())


def table(scene, threshold):
    """Losses of what is answered, one by one."""
    rows = zip(scene.error.tolist(), scene.score.tolist(), scene.keep.tolist(), strict=True)
    return [min(e, 1.0) for e, s, k in rows if k and s >= threshold]


def every_threshold(scenes):
    return sorted({s for p in scenes for s, k in zip(p.score.tolist(), p.keep.tolist(), strict=True) if k})


def brute_plug_in(scenes, target):
    for threshold in every_threshold(scenes):
        risks = [statistics.mean(table(p, threshold) or [0.0]) for p in scenes]
        if statistics.mean(risks) + statistics.stdev(risks) / math.sqrt(len(risks)) <= target:
            return threshold
    return None


def student(share, freedom):
    """Quantile of Student's t by its expansion, term by term; held against tables below."""
    z = statistics.NormalDist().inv_cdf(share)
    return z + (z**3 + z) / 4 / freedom + (5 * z**5 + 16 * z**3 + 3 * z) / 96 / freedom**2


def test_one_scene_more_stays_below_by_students_t_from_a_table():
    risks = torch.tensor([[0.02], [0.05], [0.03], [0.06], [0.04]], dtype=torch.float64)
    speaks = torch.ones_like(risks, dtype=torch.bool)
    spread = statistics.stdev(risks[:, 0].tolist()) * math.sqrt(1 + 1 / 5)
    for share, t in ((0.9, 1.533), (0.95, 2.132)):
        assert float(control._next_scene_bound(risks, speaks, share)) == pytest.approx(0.04 + t * spread, rel=0.01)
    assert float(control._next_scene_bound(risks, speaks & (risks < 0.025), 0.9)) == math.inf


def brute_most(scenes, target, share, few):
    for threshold in every_threshold(scenes):
        losses = [table(p, threshold) for p in scenes]
        kept = [statistics.mean(x or [0.0]) <= target or len(x) < few for x in losses]
        needed = math.ceil(share * (len(kept) + 1) - 1e-9)
        spoke = [statistics.mean(x) for x in losses if len(x) >= max(few, 1)]
        if sum(kept) < min(len(kept), needed):
            continue
        if share < 1 and needed > len(kept) >= 5:
            if len(spoke) < 2:
                continue
            spread = statistics.stdev(spoke) * math.sqrt(1 + 1 / len(spoke))
            if statistics.mean(spoke) + student(share, len(spoke) - 1) * spread > target:
                continue
        return threshold
    return None


def brute_conformal(scenes, target):
    n, best = len(scenes), None
    for threshold in reversed(every_threshold(scenes)):
        losses = [sum(table(p, threshold)) / p.keep.numel() for p in scenes]
        if n / (n + 1) * statistics.mean(losses) + 1 / (n + 1) > target:
            return best
        best = threshold
    return best


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("target", [0.02, 0.05, 0.1, 0.2, 0.5])
def test_both_controls_equal_plain_loops(seed, target):
    scenes = scenes_of(12, points=25, seed=seed)
    assert control.plug_in_threshold(scenes, target).threshold == brute_plug_in(scenes, target)
    assert control.conformal_threshold(scenes, target).threshold == brute_conformal(scenes, target)


def test_what_is_reported_is_what_happens_at_the_threshold():
    scenes = scenes_of(30)
    found = control.plug_in_threshold(scenes, 0.15)
    realised = [risk.realised_risk(p, found.threshold) or 0.0 for p in scenes]
    assert found.risk == pytest.approx(statistics.mean(realised)) and found.n == 30
    assert found.bound == pytest.approx(found.risk + statistics.stdev(realised) / math.sqrt(30)) and found.bound <= 0.15
    answered = [len(table(p, found.threshold)) / p.keep.numel() for p in scenes]
    assert found.coverage == pytest.approx(statistics.mean(answered)) and f"{found.coverage:.1%}" in found.why
    promised = control.conformal_threshold(scenes, 0.15)
    losses = [sum(table(p, promised.threshold)) / p.keep.numel() for p in scenes]
    assert promised.risk == pytest.approx(statistics.mean(losses))
    assert promised.bound == pytest.approx((sum(losses) + 1) / 31) and promised.bound <= 0.15


@pytest.mark.parametrize(
    ("target", "confidence", "needed"),
    [
        (0.1, None, 9),
        (0.05, None, 19),
        (0.2, None, 4),
        (0.1, 0.9, 22),
        (0.05, 0.9, 45),
        (0.05, 0.95, 59),
        (0.1, 0.5, 7),
    ],
)
def test_few_scenes_are_told_how_many_it_takes(target, confidence, needed):
    assert control.scenes_needed(target, confidence=confidence) == needed
    perfect = [errors.make_points(torch.ones(20), torch.ones(20)) for _ in range(needed)]
    assert control.conformal_threshold(perfect, target, confidence=confidence).threshold == 1.0
    found = control.conformal_threshold(perfect[1:], target, confidence=confidence)
    assert found.threshold is None and found.needed == needed and f"at least {needed}" in found.why
    assert found.n == needed - 1 and found.coverage == 0


def test_nine_scenes_cannot_promise_five_per_cent():
    scenes = scenes_of(9, hard=0.0)
    assert control.conformal_threshold(scenes, 0.05).threshold is None
    assert control.conformal_threshold(scenes, 0.1, confidence=0.9).threshold is None
    assert control.plug_in_threshold(scenes, 0.05).threshold is not None


def loop_confident(scenes, target, confidence):
    """The lowest threshold at and above which scipy's p-value is small enough."""
    stats = pytest.importorskip("scipy.stats")
    n, best = len(scenes), None
    for threshold in reversed(every_threshold(scenes)):
        mean = sum(sum(table(p, threshold)) / p.keep.numel() for p in scenes) / n
        divergence = stats.entropy([mean, 1 - mean], [target, 1 - target])
        hoeffding = math.exp(-n * divergence) if mean < target else 1.0
        bentkus = math.e * stats.binom.cdf(math.ceil(n * mean - 1e-9), n, target)
        if min(hoeffding, bentkus) > 1 - confidence:
            return best
        best = threshold
    return best


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("target", "confidence"), [(0.1, 0.5), (0.15, 0.8), (0.3, 0.95), (0.4, 0.2)])
def test_the_control_with_confidence_equals_plain_loops(target, confidence, seed):
    scenes = scenes_of(14, points=10, seed=seed)
    found = control.conformal_threshold(scenes, target, confidence=confidence)
    assert found.threshold == loop_confident(scenes, target, confidence)
    assert (found.target, found.confidence, found.n) == (target, confidence, 14)
    assert found.bound == (None if found.threshold is None else pytest.approx(1 - confidence))
    assert found.needed == control.scenes_needed(target, confidence=confidence)


def equal_errors(error, n, scenes=2):
    """Scenes of n answers of the same error and of as many silent candidates."""
    depth = torch.cat((torch.full((n,), 4 * (1 + error)), torch.full((n,), math.nan))).double()
    return [errors.make_points(depth, torch.full_like(depth, 4.0)) for _ in range(scenes)]


def test_a_bound_of_exactly_the_target_is_accepted():
    assert control.plug_in_threshold(equal_errors(0.25, 8), 0.25).threshold == 1
    assert control.plug_in_threshold(equal_errors(0.25, 8), 0.2499).threshold is None
    scenes = equal_errors(0.5, 8, scenes=3)  # loss ½ of ½ the candidates: (3/4 + 1) / 4
    assert (
        control.conformal_threshold(scenes, 0.4375).threshold == 1
        and control.conformal_threshold(scenes, 0.4374).threshold is None
    )
    found = control.conformal_threshold(scenes, 0.4375)
    assert (found.bound, found.risk, found.coverage, found.needed) == (0.4375, 0.25, 0.5, 2)
    found = control.plug_in_threshold(scenes, 0.5)
    assert (found.bound, found.risk, found.coverage) == (0.5, 0.5, 0.5)
    assert (found.needed, found.confidence, found.target, found.n) == (None, None, 0.5, 3)


def test_one_error_is_never_worse_than_one():
    assert control.plug_in_threshold(equal_errors(7.0, 4), 0.99).threshold is None
    assert control.conformal_threshold(equal_errors(7.0, 4, scenes=9), 0.55).bound == pytest.approx((9 * 0.5 + 1) / 10)


def test_silent_scenes_count_with_risk_0_and_scenes_without_candidates_not_at_all():
    silent, empty = (
        errors.make_points(torch.full((5,), math.nan), torch.ones(5)),
        errors.make_points(*[torch.zeros(0)] * 2),
    )
    found = control.plug_in_threshold([*equal_errors(0.25, 8), silent, empty], 0.3)
    risks = [0.25, 0.25, 0.0]
    assert found.n == 3 and found.risk == pytest.approx(0.5 / 3) and found.coverage == pytest.approx(1 / 3)
    assert found.bound == pytest.approx(0.5 / 3 + statistics.stdev(risks) / math.sqrt(3))


def test_thinned_thresholds_are_spread_evenly_from_the_lowest_score_to_the_highest(monkeypatch):
    monkeypatch.setattr(control, "_MAX_THRESHOLDS", 5)
    n = 17
    for first_good, expected in ((0, 0), (1, 4), (4, 4), (5, 8), (13, 16), (16, 16)):
        wrong = torch.arange(n) < first_good
        scene = errors.make_points(torch.where(wrong, 9.0, 1.0), torch.ones(n), torch.arange(float(n)))
        assert control.plug_in_threshold([scene, scene], 0.01).threshold == expected
    monkeypatch.setattr(control, "_MAX_THRESHOLDS", 17)
    wrong = torch.arange(n) < 5
    scene = errors.make_points(torch.where(wrong, 9.0, 1.0), torch.ones(n), torch.arange(float(n)))
    assert control.plug_in_threshold([scene, scene], 0.01).threshold == 5, "as many as there are: none is left out"


def test_the_reason_is_said_in_words():
    assert control.plug_in_threshold(equal_errors(0.0, 8), 0.1).why == "score ≥ 1 answers 50.0% of the candidates"
    few = control.conformal_threshold(equal_errors(0.0, 8), 0.1).why
    assert few == "2 scenes are too few: a target of 0.1 takes at least 9"
    bad = control.conformal_threshold(equal_errors(9.0, 8, scenes=9), 0.1)
    assert bad.why == "no threshold meets 0.1 on these 9 scenes" and bad.needed == 9 and bad.bound is None


def test_no_scene_is_no_evidence():
    assert (
        control._hoeffding_bentkus_p_value(0.0, 0, 0.1) == 1 and control._hoeffding_bentkus_p_value(0.0, 1, 0.5) == 0.5
    )


@pytest.mark.parametrize(("target", "n", "worlds"), [(0.1, 100, 30), (0.1, 25, 60), (0.05, 19, 60)])
def test_conformal_keeps_its_promise_for_the_next_scene(target, n, worlds):
    losses, none = [], 0
    for world in range(worlds):
        scenes = world_of(n + 20, points=20, seed=1000 + world)
        found = control.conformal_threshold(split(scenes[:n]), target)
        none += found.threshold is None
        losses.append(mean_loss(scenes[n:], found.threshold))
    error = statistics.stdev(losses) / math.sqrt(len(losses))
    assert statistics.mean(losses) <= target + 2 * error
    if n == 100:
        assert none == 0 and statistics.mean(losses) > 0.5 * target, "a control that is silent keeps any promise"


def test_with_confidence_few_worlds_exceed_the_target():
    judge, worlds, target, confidence = world_of(1500, points=20, seed=5), 40, 0.15, 0.8
    found = [
        control.conformal_threshold(scenes_of(60, points=20, seed=2000 + w), target, confidence=confidence)
        for w in range(worlds)
    ]
    exceeded = sum(mean_loss(judge, f.threshold) > target for f in found)
    allowed = 1 - confidence
    assert exceeded / worlds <= allowed + 2 * math.sqrt(allowed * (1 - allowed) / worlds)
    assert statistics.mean(f.coverage for f in found) > 0.05


def test_with_confidence_the_lowest_threshold_of_small_p_value_is_taken():
    world = world_of(60, seed=7)
    scenes = split(world)
    found = control.conformal_threshold(scenes, 0.15, confidence=0.8)
    below = max(t for t in every_threshold(scenes) if t < found.threshold)
    p = [control._hoeffding_bentkus_p_value(mean_loss(world, t), 60, 0.15) for t in (found.threshold, below)]
    assert p[0] <= 0.2 < p[1]


def test_plug_in_holds_in_the_mean_and_promises_no_scene():
    realised, over = [], 0
    for world in range(40):
        scenes = scenes_of(40, points=20, seed=3000 + world)
        threshold = control.plug_in_threshold(scenes[:20], 0.1).threshold
        risks = [risk.realised_risk(p, threshold) or 0.0 for p in scenes[20:]]
        realised.append(statistics.mean(risks))
        over += sum(r > 0.1 for r in risks)
    assert statistics.mean(realised) <= 0.1
    assert over > 0.1 * 40 * 20, "hostile scenes exceed the target: the control is about the mean over scenes"


def binomial_cdf(k, n, p):
    return sum(math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k + 1))


@pytest.mark.parametrize("n", [1, 10, 60, 400])
@pytest.mark.parametrize("target", [0.05, 0.3])
def test_the_p_value_equals_its_formula_and_is_valid(n, target):
    for mean in (0.0, 0.2 * target, 0.7 * target, 0.99 * target):
        divergence = (1 - mean) * math.log((1 - mean) / (1 - target))
        divergence += mean * math.log(mean / target) if mean else 0
        bentkus = math.e * binomial_cdf(math.ceil(n * mean - 1e-9), n, target)
        assert control._hoeffding_bentkus_p_value(mean, n, target) == pytest.approx(
            min(1, math.exp(-n * divergence), bentkus), rel=1e-9
        )
    assert (
        control._hoeffding_bentkus_p_value(target, n, target) == 1 == control._hoeffding_bentkus_p_value(0.9, n, target)
    )
    # losses of 0 and 1 with mean equal to the target: small p-values are as rare as they say
    for level in (0.05, 0.2):
        seen = [k for k in range(n + 1) if control._hoeffding_bentkus_p_value(k / n, n, target) <= level]
        rare = sum(math.comb(n, k) * target**k * (1 - target) ** (n - k) for k in seen)
        assert rare <= level + 1e-12


def test_any_depth_source_will_do():
    g = torch.Generator().manual_seed(0)
    truth = 1 + 3 * torch.rand(40, 30, generator=g)
    confidence = 1 + 9 * torch.rand(40, 30, generator=g)  # as learned models state it: from 1 upwards
    prediction = truth * (1 + torch.randn(40, 30, generator=g) / confidence / 2)
    scenes = [errors.make_points(*row) for row in zip(prediction, truth, confidence, strict=True)]
    for found in (control.plug_in_threshold(scenes, 0.05), control.conformal_threshold(scenes, 0.05)):
        assert 1 < found.threshold < 10 and 0.1 < found.coverage < 1


def test_nothing_to_choose_from():
    silent = errors.make_points(torch.full((5,), math.nan), torch.ones(5))
    empty = errors.make_points(torch.zeros(0), torch.zeros(0))
    for scenes in ([], [empty], [silent] * 30, [empty, silent]):
        for found in (control.plug_in_threshold(scenes, 0.1), control.conformal_threshold(scenes, 0.1)):
            assert found.threshold is None and found.coverage == 0 and found.why
            assert found.n == sum(s is silent for s in scenes)
    bad = [errors.make_points(torch.full((5,), 9.0), torch.ones(5)) for _ in range(30)]
    assert "no threshold meets 0.1" in control.plug_in_threshold(bad, 0.1).why
    assert control.plug_in_threshold(scenes_of(1), 0.5).threshold is None, "one scene has no standard error"


def test_many_scores_are_thinned_without_losing_the_promise(monkeypatch):
    scenes = scenes_of(30, points=300)
    exact = control.conformal_threshold(scenes, 0.08)
    monkeypatch.setattr(control, "_MAX_THRESHOLDS", 50)
    coarse = control.conformal_threshold(scenes, 0.08)
    assert coarse.bound <= 0.08 and exact.threshold < coarse.threshold < exact.threshold + 0.05
    assert control.plug_in_threshold(scenes, 0.1).bound <= 0.1


@pytest.mark.parametrize("wrong", [0.0, 1.0, -0.1, math.nan])
def test_bad_targets_raise(wrong):
    for call in (control.plug_in_threshold, control.conformal_threshold):
        with pytest.raises(ValueError, match=r"control\.target: found"):
            call([], wrong)
    with pytest.raises(ValueError, match=r"control\.confidence: found"):
        control.conformal_threshold([], 0.1, confidence=wrong)


@pytest.mark.parametrize(("share", "few"), [(0.9, 0), (1.0, 0), (0.6, 0), (0.9, 12), (1.0, 20), (0.95, 0), (0.95, 12)])
@pytest.mark.parametrize(
    "target", [pytest.param(0.03, marks=pytest.mark.slow), 0.08, pytest.param(0.2, marks=pytest.mark.slow)]
)
def test_most_scenes_is_the_lowest_threshold_that_so_many_keep(target, share, few):
    scenes = scenes_of(12, seed=4)
    found = control.scene_quantile_threshold(scenes, target, share=share, few=few)
    expected = brute_most(scenes, target, share, few)
    assert found.threshold == expected
    if expected is not None:
        losses = [table(p, expected) for p in scenes]
        assert found.risk == pytest.approx(statistics.mean(statistics.mean(x or [0.0]) for x in losses))
        assert found.bound >= share - 1e-9 and found.n == 12


@pytest.mark.parametrize(("freedom", "table"), [(4, 1.533), (6, 1.440), (9, 1.383), (30, 1.310)])
def test_the_quantile_of_few_scenes_is_that_of_the_tables(freedom, table):
    assert student(0.9, freedom) == pytest.approx(table, rel=0.005)


def test_of_few_scenes_the_worst_to_come_is_read_from_their_spread():
    """Seven scenes just below the target: close together they are believed, far apart they are not."""

    def scene(error, score):
        return errors.make_points(torch.tensor([1.0 + error, 1.0]), torch.ones(2), torch.tensor([score, 0.9]))

    close = [scene(e, 0.3) for e in (0.090, 0.091, 0.092, 0.093, 0.090, 0.091, 0.092)]
    apart = [scene(e, 0.3) for e in (0.001, 0.098, 0.001, 0.098, 0.001, 0.098, 0.05)]
    assert control.scene_quantile_threshold(close, 0.05).threshold == pytest.approx(0.3)
    assert control.scene_quantile_threshold(apart, 0.05).threshold == pytest.approx(0.9)
    assert control.scene_quantile_threshold(apart[:4], 0.05).threshold == pytest.approx(0.3), (
        "of four no spread is known"
    )


def test_a_mean_may_keep_what_scenes_do_not():
    """One bad scene among many good ones: the mean is met, and nine in ten are; all are at a higher threshold alone."""
    good, bad = (
        errors.make_points(torch.tensor([1.0 + e, 1.0]), torch.ones(2), torch.tensor([0.3, 0.9])) for e in (0.01, 0.4)
    )
    scenes = [good] * 19 + [bad]
    assert control.plug_in_threshold(scenes, 0.05).threshold == pytest.approx(0.3)
    assert control.scene_quantile_threshold(scenes, 0.05).threshold == pytest.approx(0.3)
    assert control.scene_quantile_threshold(scenes, 0.05, share=1.0).threshold == pytest.approx(0.9)
    assert control.scene_quantile_threshold([good] * 3 + [bad], 0.05).threshold == pytest.approx(0.9)
    with pytest.raises(ValueError, match=r"control\.share"):
        control.scene_quantile_threshold(scenes, 0.05, share=0.0)
