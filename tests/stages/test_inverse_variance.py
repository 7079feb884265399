"""Fusion by inverse variance and choice of key views, against loops over points."""

import itertools
import math

import numpy as np
import pytest
import torch
from support.view_estimates import make_estimates, random_estimates

from dhtorch.codes import Gate
from dhtorch.pipeline.view_selection import rank_views
from dhtorch.stages.fuse import inverse_variance

FIELDS = ("depth", "sigma", "sigma_shared", "parallax_deg", "residual_px", "score")


def plain_fusion(views, *, min_views=2, max_chi2=9.0, correlation=1.0, max_sigma_rel=0.1, max_static_ratio=0.5):
    """{field: array (B, N)} by a loop over the points."""
    V, B, N = views.gate.shape
    get = {name: getattr(views, name).numpy() for name in (*FIELDS, "gate")}
    out = {name: np.full((B, N), np.nan) for name in FIELDS} | {"gate": np.zeros((B, N)), "n_views": np.zeros((B, N))}
    for b, k in itertools.product(range(B), range(N)):
        at = {name: x[:, b, k] for name, x in get.items()}
        said = [v for v in range(V) if at["gate"][v] == 0]
        q = [1 / at["depth"][v] for v in said]
        whole = [(at["sigma"][v] / at["depth"][v] ** 2) ** 2 for v in said]
        shared = [(at["sigma_shared"][v] / at["depth"][v] ** 2) ** 2 for v in said]
        own = [max(w - s, 1e-3 * w) for w, s in zip(whole, shared, strict=True)]
        variance = [o + s for o, s in zip(own, shared, strict=True)]
        weight = np.array([1 / x for x in variance]) / sum(1 / x for x in variance) if said else np.zeros(0)
        out["n_views"][b, k] = 1 + len(said)
        out["parallax_deg"][b, k] = max(at["parallax_deg"])
        out["residual_px"][b, k] = (
            math.sqrt(sum(w * at["residual_px"][v] ** 2 for w, v in zip(weight, said, strict=True)))
            if said
            else at["residual_px"][-1]
        )
        silent = [int(g) for g in at["gate"] if g]
        if sum((get["gate"][v, b] == Gate.NO_BASELINE).any() for v in range(V)) > max_static_ratio * V:
            gate = Gate.NO_BASELINE
        elif len(said) < min(max(min_views, 1), V):
            no_pose = all((get["gate"][v, b] == Gate.NO_POSE).any() for v in range(V))
            gate = max(silent, default=Gate.INCONSISTENT)
            gate = Gate.NO_POSE if no_pose and gate in (Gate.NO_TRACK, Gate.NO_TEXTURE) else gate
        else:
            mean = sum(w * x for w, x in zip(weight, q, strict=True))
            chi2 = sum((x - mean) ** 2 / s for x, s in zip(q, variance, strict=True)) / max(len(said) - 1, 1)
            widening = max(chi2, 1.0)
            alike = sum(w * math.sqrt(o) for w, o in zip(weight, own, strict=True)) ** 2
            apart = sum(w**2 * o for w, o in zip(weight, own, strict=True))
            common = sum(w * math.sqrt(s) for w, s in zip(weight, shared, strict=True)) ** 2
            depth = 1 / mean
            sigma = depth**2 * math.sqrt((correlation * alike + (1 - correlation) * apart + common) * widening)
            gate = Gate.ANSWER
            if max_sigma_rel is not None and sigma / depth > max_sigma_rel:
                gate = Gate.UNCERTAIN
            if chi2 > max_chi2:
                gate = Gate.INCONSISTENT
            if gate == Gate.ANSWER:
                out["depth"][b, k], out["sigma"][b, k] = depth, sigma
                out["sigma_shared"][b, k] = depth**2 * math.sqrt(common * widening)
        out["gate"][b, k], out["score"][b, k] = gate, float(gate == Gate.ANSWER)
    return out


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"correlation": 0.0},
        {"correlation": 0.4, "max_sigma_rel": None},
        {"max_chi2": 1.5},
        {"max_chi2": 1e9, "max_sigma_rel": None},
        {"max_sigma_rel": 0.04},
        {"min_views": 1},
        {"min_views": 0},
        {"min_views": 3},
        {"min_views": 9},
    ],
)
def test_views_are_joined_as_a_loop_over_points_joins_them(options):
    views = random_estimates()
    views.gate[:, 0, :2] = torch.tensor([[Gate.NO_TRACK, Gate.PARALLAX]] * 3 + [[Gate.RESIDUAL, Gate.NO_TRACK]])
    found, expected = inverse_variance(views, **options), plain_fusion(views, **options)
    assert torch.equal(found.gate, torch.tensor(expected["gate"]).int()) and found.gate.dtype == torch.int32
    assert torch.equal(found.n_views, torch.tensor(expected["n_views"]).int()) and found.n_views.dtype == torch.int32
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name).numpy(), expected[name], rtol=1e-9, err_msg=name)
    assert torch.equal(found.uv, views.uv[-1])
    assert len(found.gate.unique()) >= 3 and 5 < int(found.keep.sum()) < 60


@pytest.mark.parametrize(
    ("depth", "sigma", "gate", "options", "expected"),
    [
        # inverse depths 1/4 and 1/2 with a deviation of 1/8 each: each differs from the mean by as much
        ([4.0, 2.0], [2.0, 0.5], 0, {"max_chi2": 2.0, "max_sigma_rel": None}, Gate.ANSWER),
        ([4.0, 2.0], [2.0, 0.5], 0, {"max_chi2": 1.9999, "max_sigma_rel": None}, Gate.INCONSISTENT),
        ([4.0, 4.0], [0.5, 0.5], 0, {"max_sigma_rel": 0.125}, Gate.ANSWER),
        ([4.0, 4.0], [0.5, 0.5], 0, {"max_sigma_rel": 0.1249}, Gate.UNCERTAIN),
        ([4.0, 4 / 3], [1e-9, 1e-9], 0, {"max_sigma_rel": 1e-12}, Gate.INCONSISTENT),
        ([4.0] * 3, [0.1] * 3, [0, 0, 7], {}, Gate.ANSWER),
        ([4.0] * 3, [0.1] * 3, [6, 0, 7], {}, Gate.RESIDUAL),
        ([4.0] * 3, [0.1] * 3, [6, 0, 0], {}, Gate.ANSWER),
        # a view without a positive depth and a finite sigma does not count
        *(
            ([4.0, z], [0.5, s], 0, {"max_sigma_rel": None}, Gate.INCONSISTENT)
            for z, s in ((-4.0, 0.1), (0.0, 0.1), (4.0, 0.0), (4.0, math.inf), (4.0, math.nan), (math.nan, 0.1))
        ),
    ],
)
def test_limits_hold_at_the_limit_itself(depth, sigma, gate, options, expected):
    assert int(inverse_variance(make_estimates(depth, sigma, gate=gate), **options).gate) == expected
    if gate == 0 and expected == Gate.INCONSISTENT and "max_chi2" not in options and options["max_sigma_rel"] is None:
        good = inverse_variance(make_estimates([4.0, 5.0], [0.5, 0.5]), max_sigma_rel=None)
        more = inverse_variance(make_estimates([*depth, 5.0], [*sigma, 0.5]), max_sigma_rel=None)
        assert float(more.depth) == float(good.depth) and int(more.n_views) == 3


def test_one_view_is_its_own_answer_and_none_is_refused():
    views = random_estimates(V=1, N=5)
    found = inverse_variance(views)
    for name in (*FIELDS, "gate", "n_views"):
        assert torch.equal(getattr(found, name).nan_to_num(), getattr(views, name)[0].nan_to_num()), name
    with pytest.raises(ValueError, match="at least one view"):
        inverse_variance(views[:0])


def test_a_standstill_is_what_more_than_the_share_of_views_say():
    """Even of one point of the reference view; and of each reference view for itself."""
    views = random_estimates(V=4, B=2, N=5, unanswered=0.0, spread=0.1)
    for n, share, still in ((2, 0.5, False), (3, 0.5, True), (1, 0.25, False), (2, 0.25, True), (4, 1.0, False)):
        gate = views.gate.clone()
        gate[:n, 1, 3] = Gate.NO_BASELINE
        found = inverse_variance(views.replace(gate=gate), max_static_ratio=share, max_sigma_rel=None, min_views=1)
        assert (found.gate[0] == 0).all() and bool((found.gate[1] == Gate.NO_BASELINE).all()) == still, (n, share)
        assert torch.equal(found.depth.isnan(), found.gate != 0) and torch.equal(found.score, found.keep.double())


# ---------------------------------------------------------------------------------------------------- key views


def plain_key_views(views, count, good, motion):
    """Greedy by loops: {view: gain} of the views that add most to the sum of log(1 + Σ (good · depth / sigma)²); of equals
    that of more motion, then the later one."""
    picked = []
    for b in range(views.gate.shape[1]):
        worth = (good * views.depth[:, b] / views.sigma[:, b]).square().where(views.gate[:, b] == 0, 0.0)
        known, added = torch.zeros_like(worth[0]), {}
        for _ in range(count):
            left = [v for v in range(len(worth)) if v not in added]
            gains = {v: float(((1 + known + worth[v]).log() - (1 + known).log()).sum()) for v in left}
            best = max(left, key=lambda v, b=b, gains=gains: (round(gains[v], 9), float(motion[v, b]), v))
            added[best], known = gains[best], known + worth[best]
        picked.append({v: added[v] for v in sorted(added)})
    return picked


@pytest.mark.parametrize("good", [0.1, 0.002])
@pytest.mark.parametrize("count", range(1, 7))
def test_key_views_are_added_one_by_one_each_the_one_that_adds_most(good, count):
    views = random_estimates(V=6, B=4, N=6, unanswered=0.5, seed=3)
    lone = views.gate.clone()
    lone[:, 0, 1:] = Gate.NO_TRACK
    lone[:, 0, 0] = 0  # all depends on one point, where further views add little
    lone[:, 1] = Gate.NO_TRACK  # and of one reference view no candidate has an answer
    views = views.replace(gate=lone, depth=views.depth.nan_to_num(4.0), sigma=views.sigma.nan_to_num(0.3))
    for motion in (torch.zeros(6, 4), torch.arange(24.0).view(6, 4) % 7):
        expected = plain_key_views(views, count, good, motion)
        options = {} if good == 0.1 else {"good_sigma_rel": good}
        found = rank_views(views, count, motion=None if not motion.any() else motion, reserve=1, **options)
        assert found.index.T.tolist() == [list(row) for row in expected]
        gains = [gain for row in expected for gain in row.values()]
        assert found.gain.T.flatten().tolist() == pytest.approx(gains, abs=1e-9)
        if count < 6:
            further = plain_key_views(views, count + 1, good, motion)
            added = [next(iter(set(more) - set(few))) for more, few in zip(further, expected, strict=True)]
            assert found.reserve.tolist() == [added]


@pytest.mark.parametrize("bad", [0, 7])
def test_wrong_numbers_of_views_raise(bad):
    with pytest.raises(ValueError, match="expected 1 to 6"):
        rank_views(random_estimates(V=6), bad)


def test_answers_without_a_sigma_add_nothing():
    views = random_estimates(V=3, B=1, N=4, unanswered=0.0)
    sigma = views.sigma.clone()
    sigma[2], sigma[1, 0, :2], sigma[1, 0, 2:] = torch.nan, 0.0, torch.inf
    assert rank_views(views.replace(sigma=sigma), 1).index.tolist() == [[0]]
    mute = views.replace(gate=torch.full_like(views.gate, Gate.NO_TRACK))
    assert rank_views(mute, 2).index.T.tolist() == [[1, 2]], "the wider of equals"
