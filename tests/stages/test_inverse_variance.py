"""Fusion by inverse variance and choice of key views, against loops over points; the window with stub stages."""

import itertools
import math

import numpy as np
import pytest
import torch
from support.view_estimates import make_estimates, rand, random_estimates

from dhtorch import PAPER
from dhtorch.codes import Gate
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import se3
from dhtorch.geometry.pyramid import build_pyramid
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.pipeline.view_selection import rank_views
from dhtorch.pytree import collate, stack
from dhtorch.records import Camera, Frame, Samples, TrackHint, Tracks
from dhtorch.stages.fuse import inverse_variance

extend_window = PAPER.replace(views=5)

HW = (64, 80)
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


# ---------------------------------------------------------------------------------------------------- the window


def frame(batch=2, seed=0):
    camera = Camera(torch.tensor([[70.0, 72.0]]), torch.tensor([[40.0, 30.0]])).map(lambda x: x.expand(batch, -1))
    return Frame(rand(batch, 1, *HW, seed=seed).float(), 1 + rand(batch, *HW, seed=seed).float(), camera)


class RecordingStages:
    """Stages that record their arguments; view k of the window is identified by its image."""

    def __init__(self, V=3, n=8):
        self.reference, self.others = frame(), stack([frame(seed=10 + k) for k in range(V)])
        self.n, self.calls, self.asked = n, [], {"track": [], "pose": [], "triangulate": []}
        self.uv = 10 + rand(2, n, 2, seed=30, high=40).float()
        self.answers = random_estimates(V=V, N=n, unanswered=0.2, spread=0.2).to(torch.float32)
        self.fits = [known_pose_fit(se3.exp(rand(2, 6, seed=50 + k).float()), n) for k in range(V)]

    def number(self, image):
        return next(k for k in range(len(self.others.image)) if torch.equal(self.others.image[k], image))

    def tracks(self, k, uv):
        zero = uv[..., 0] * 0
        moved = uv + rand(*uv.shape, seed=60 + k, low=-3, high=3).float()
        cov = torch.eye(2).expand(*uv.shape, 2)
        return Tracks(uv, moved, zero, zero, cov, rand(*uv.shape[:2], seed=70 + k) < 0.7)

    def samples(self):
        one = torch.ones(2, self.n)
        return Samples(self.uv, one, one, one[..., None].expand(2, self.n, 3), one, one.int(), one, one.int())

    def stages(self):
        """Stages and options of a method."""

        def track(image_0, image_1, uv, *, hint):
            k = self.number(image_1)
            self.asked["track"].append((k, image_0, uv, hint))
            return self.tracks(k, uv)

        def pose(samples, tracks, camera_0, camera_1, draws):
            self.asked["pose"].append((samples, tracks, draws))
            return collate(self.fits)

        def triangulate(samples, tracks, fit, camera_0, camera_1):
            self.asked["triangulate"].append((samples, fit))
            step = self.n // samples.uv.shape[1]
            return self.answers.map(lambda x: x.flatten(0, 1)[:, ::step])

        def score(estimate, samples, tracks, fit):
            self.calls.append(("score", estimate, samples, tracks, fit))
            return estimate.replace(score=0.5 * estimate.score)

        def sample(hw, n, **options):
            self.calls.append(("sample", hw, n, options))
            return self.uv

        def backproject(frame, uv):
            self.calls.append(("backproject", frame, uv))
            return self.samples()

        def classify(frame, samples):
            self.calls.append(("classify", frame, samples))
            return samples.replace(hole=samples.hole + 2)

        names = {"sample": sample, "backproject": backproject, "classify": classify, "track": track, "pose": pose}
        return names | {"triangulate": triangulate, "score": score, "n": self.n, "hypotheses": 5}


def test_the_reference_is_sampled_once_and_every_view_is_a_pair_with_it():
    stages, trace = RecordingStages(), {}
    found = extend_window(stages.reference, stages.others, **stages.stages(), seed=4, trace=trace)
    names = [call[0] for call in stages.calls]
    assert names == ["sample", "backproject", "classify", "score"]
    assert stages.calls[0][1:] == (HW, 8, {"device": torch.device("cpu"), "dtype": torch.float32})
    assert stages.calls[1][1].image is stages.reference.image and stages.calls[2][1].image is stages.reference.image
    assert [k for k, *_ in stages.asked["track"]] == [0, 1, 2]
    ((samples, tracks, draws),) = stages.asked["pose"]
    assert (samples.hole == 3).all(), "what classify made of the samples"
    assert torch.equal(tracks.uv_1, torch.cat([stages.tracks(k, stages.uv).uv_1 for k in range(3)]))
    assert torch.equal(draws, uniform_draws(4, 2, 5).float().repeat(3, 1, 1)), "the same draws for all views"
    ((samples, fit),) = stages.asked["triangulate"]
    assert torch.equal(fit.T_1_from_0.t, collate(stages.fits).T_1_from_0.t)
    fused = inverse_variance(stages.answers)
    _, estimate, samples, tracks, fit = stages.calls[3]
    for name in (*FIELDS, "gate"):
        assert torch.equal(getattr(estimate, name).nan_to_num(), getattr(fused, name).nan_to_num()), name
    assert (samples.hole == 3).all() and torch.equal(fit.T_1_from_0.t, stages.fits[2].T_1_from_0.t)
    assert torch.equal(tracks.uv_1, stages.tracks(2, stages.uv).uv_1)
    assert torch.equal(found.score, 0.5 * fused.score)
    assert trace["estimate"] is found and trace["fit"] is fit and len(trace["views"]) == 3
    for t, expected in zip(trace["views"], stages.fits, strict=True):
        assert torch.equal(t["fit"].T_1_from_0.t, expected.T_1_from_0.t)


def test_a_search_begins_where_the_last_view_was_found_further_on_at_the_same_pace():
    stages = RecordingStages(V=4)
    extend_window(stages.reference, stages.others, **stages.stages())
    starts = [hint.start for *_, hint in stages.asked["track"]]
    assert starts[0] is None
    for k in (1, 2, 3):
        last = stages.tracks(k - 1, stages.uv)
        for b, i in itertools.product(range(2), range(8)):
            ahead = last.uv_0[b, i] + (last.uv_1[b, i] - last.uv_0[b, i]) * (k + 1) / k
            expected = ahead if last.valid[b, i] else last.uv_0[b, i]
            torch.testing.assert_close(starts[k][b, i], expected)
    assert not last.valid.all() and last.valid.any()
    alone = RecordingStages(V=4)
    extend_window(alone.reference, alone.others, **alone.stages(), chain=False)
    assert all(hint.start is None for *_, hint in alone.asked["track"])


def test_the_pyramid_of_the_reference_is_built_once_for_all_views():
    stages = RecordingStages()
    extend_window(stages.reference, stages.others, **stages.stages(), hint=TrackHint(levels=3))
    first, *others = (hint for *_, hint in stages.asked["track"])
    assert all(hint.pyramid is first.pyramid and hint.levels == 3 for hint in others)
    made, expected = first.pyramid(2, 7), build_pyramid(stages.reference.image, 2, 7)
    assert first.pyramid(2, 7) is made and first.pyramid(1, 7) is not made
    leaves = [torch.utils._pytree.tree_leaves(x) for x in (made, expected)]
    assert len(leaves[0]) == len(leaves[1]) > 2
    assert all(torch.equal(x, y) for x, y in zip(*leaves, strict=True) if isinstance(x, torch.Tensor))
    part = first.pyramid[1:2]
    assert part is first.pyramid[1:2] and torch.equal(part(1, 7).levels[0], expected.levels[0][1:2])


def test_of_more_views_the_key_views_are_estimated_again_with_their_own_poses():
    """They are chosen by few of the samples: each reference view has its own choice."""
    n = 512
    stages = RecordingStages(V=5, n=n)
    fits = stack(stages.fits)
    known = rank_views(stages.answers[:, :, ::2], 2).index
    assert not torch.equal(known[:, 0], known[:, 1]), "the two reference views choose otherwise"
    options = stages.stages() | {"track": lambda image_0, image_1, uv, hint: stages.tracks(0, uv)}
    asked = []

    def triangulate(samples, tracks, fit, camera_0, camera_1):
        asked.append((samples.uv, fit))
        probes = samples.uv.shape[1] == n // 2
        return (stages.answers[:, :, ::2] if probes else stages.answers[:2]).map(lambda x: x.flatten(0, 1))

    trace = {}
    options |= {"triangulate": triangulate, "views": 2, "fit": fits, "trace": trace}
    extend_window(stages.reference, stages.others, **options)
    (probes, first), (uv, second) = asked
    assert probes.shape == (10, n // 2, 2) and uv.shape == (4, n, 2), "256 samples, every second"
    assert torch.equal(probes[:2], stages.uv[:, ::2]) and len(trace["views"]) == 2
    assert torch.equal(first.T_1_from_0.t, fits.T_1_from_0.t.flatten(0, 1))
    for k in range(2):
        for b in range(2):
            assert torch.equal(second.T_1_from_0.t[2 * k + b], fits[int(known[k, b])].T_1_from_0.t[b])
    assert "pose" not in [c[0] for c in stages.calls] and not stages.asked["pose"]


def test_the_texture_of_a_sample_is_measured_in_every_view():
    stages = RecordingStages()
    gate = torch.full_like(stages.answers.gate, Gate.NO_TRACK)
    stages.answers = stages.answers.replace(gate=gate)
    for limit, reason in ((1.0, Gate.NO_TRACK), (1.01, Gate.NO_TEXTURE)):
        stages.asked["track"].clear()
        found = extend_window(stages.reference, stages.others, **stages.stages(), min_trackability=limit)
        tracked = torch.stack([stages.tracks(k, stages.uv).valid for k in range(3)]).any(0)
        assert (found.gate[tracked] == reason).all() and (found.gate[~tracked] == Gate.NO_TRACK).all()
