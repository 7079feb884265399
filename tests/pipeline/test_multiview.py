"""Many views: the window against the pairs it is made of, and fusion; the same against loops: test_inverse_variance.py."""

from functools import partial

import pytest
import torch
from support import textured_box as walls

from dhtorch import PAPER, extend, pytree
from dhtorch.codes import Gate
from dhtorch.experiments.baselines import opencv
from dhtorch.pipeline.view_selection import rank_views
from dhtorch.records import Estimate
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

extend_window = PAPER.replace(views=5)

FLOATS = ("depth", "sigma", "sigma_shared", "parallax_deg", "residual_px", "score")
PAIR = {"n": 200, "hypotheses": 64}


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def answers(depth, sigma, shared=None, gate=None):
    """Estimate (V, 1, N) of given depths."""
    depth, sigma = torch.as_tensor(depth)[:, None], torch.as_tensor(sigma)[:, None]
    gate = (
        torch.zeros_like(depth, dtype=torch.int32)
        if gate is None
        else torch.as_tensor(gate, dtype=torch.int32)[:, None]
    )
    keep = gate == Gate.ANSWER
    silent = lambda x: torch.where(keep, x, torch.full_like(x, torch.nan))  # noqa: E731
    shared = torch.zeros_like(sigma) if shared is None else torch.as_tensor(shared)[:, None]
    return Estimate(
        uv=torch.zeros(*depth.shape, 2, dtype=depth.dtype),
        depth=silent(depth),
        sigma=silent(sigma),
        sigma_shared=silent(shared),
        parallax_deg=torch.ones_like(depth),
        residual_px=torch.ones_like(depth),
        n_views=torch.full_like(gate, 2),
        score=keep.to(depth.dtype),
        gate=gate,
    )


SURE = partial(inverse_variance, max_sigma_rel=None)


def noisy(V=4, N=20000, share=0.0, seed=0):
    """Views whose inverse depths err independently, but for a part common to all; and the truth (N,)."""
    draw = torch.Generator().manual_seed(seed)
    z = 2 + 6 * torch.rand(N, generator=draw, dtype=torch.float64)
    own = 0.002 * (1 + 2 * torch.rand(V, N, generator=draw, dtype=torch.float64))
    common = share * torch.randn(N, generator=draw, dtype=torch.float64)
    depth = 1 / (1 / z + own * torch.randn(V, N, generator=draw, dtype=torch.float64) + common)
    return answers(depth, depth**2 * (own**2 + share**2).sqrt(), depth**2 * share), z


# --- fusion ----------------------------------------------------------------------------------------------------------


def test_independent_errors_average_out_and_sigma_says_so():
    views, z = noisy()
    fused = SURE(views, correlation=0.0)
    inverse, sigma = 1 / fused.depth[0], fused.sigma[0] / fused.depth[0] ** 2
    w = views.depth[:, 0] ** 4 / views.sigma[:, 0] ** 2
    expected = (w / views.depth[:, 0]).sum(0) / w.sum(0)
    keep = fused.keep[0]
    assert keep.float().mean() > 0.99
    assert torch.allclose(inverse[keep], expected[keep])
    # chi² wider than expected by chance widens sigma, hence slightly below one
    assert 0.85 < ((inverse - 1 / z) / sigma)[keep].square().mean().sqrt() < 1.02
    single = (views.depth[0, 0] - z).abs() / z
    assert ((fused.depth[0] - z).abs() / z)[keep].median() < 0.7 * single.median()


def test_what_the_views_share_does_not_average_out():
    views, z = noisy(share=0.006)
    fused = SURE(views, correlation=0.0, max_chi2=1e9)
    error = (1 / fused.depth[0] - 1 / z) / (fused.sigma[0] / fused.depth[0] ** 2)
    assert 0.85 < error.square().mean().sqrt() < 1.05
    shared = fused.sigma_shared[0] / fused.depth[0] ** 2
    assert shared.min() > 0.999 * 0.006 and shared.median() < 1.1 * 0.006
    whole = SURE(views, correlation=1.0, max_chi2=1e9)
    assert (whole.sigma >= fused.sigma).all()


def test_views_that_contradict_each_other_are_silent():
    """Two of three say 4 m, one says 5 m: silent when it is sure of that, an answer when it is not."""
    depth = torch.tensor([[4.0, 4.0], [4.0, 4.0], [5.0, 5.0]], dtype=torch.float64)
    sigma = torch.tensor([[0.05, 0.05], [0.05, 0.05], [0.05, 1.0]], dtype=torch.float64)
    fused = SURE(answers(depth, sigma))
    assert fused.gate[0].tolist() == [Gate.INCONSISTENT, Gate.ANSWER]
    assert fused.depth[0, 0].isnan() and abs(fused.depth[0, 1] - 4) < 0.01
    assert SURE(answers(depth, sigma), max_chi2=1e6).keep.all()


def test_one_view_is_that_views_answer():
    views, _ = noisy(V=1, N=50, share=0.003)
    fused = inverse_variance(views)
    for field in FLOATS:
        assert torch.equal(getattr(fused, field), getattr(views[0], field)), field
    assert torch.equal(fused.gate, views[0].gate)
    with pytest.raises(ValueError, match="view"):
        inverse_variance(views[:0])


def test_order_of_views_and_silence_change_nothing():
    views, _ = noisy(N=50, share=0.002)
    silent = answers(*(torch.full((1, 50), x, dtype=torch.float64) for x in (1.0, 1.0)), gate=[[Gate.NO_TRACK] * 50])
    straight, turned = SURE(views), SURE(pytree.collate([silent, views[[2, 0, 3, 1]]]))
    for field in FLOATS:
        assert torch.allclose(getattr(straight, field), getattr(turned, field), equal_nan=True), field


def test_gradients_are_finite_and_right():
    views, _ = noisy(V=3, N=4)
    gate = views.gate.clone()
    gate[0, 0, 1], gate[:, 0, 2] = Gate.NO_TRACK, Gate.NO_TRACK
    views = views.replace(gate=gate)
    depth = views.depth.clone().requires_grad_()
    sigma = views.sigma.clone().requires_grad_()

    def fused(depth, sigma):
        out = SURE(views.replace(depth=depth, sigma=sigma), max_chi2=1e9)
        return torch.stack([x.nan_to_num() for x in (out.depth, out.sigma, out.residual_px)])

    assert torch.autograd.gradcheck(fused, (depth, sigma))


def test_key_views_are_those_that_leave_the_smallest_sigma():
    """View 0 sees all points badly, 1 and 2 half of them each, well; 3 repeats 2 a little worse; 4 sees nothing."""
    sigma = torch.full((5, 10), 0.4)
    sigma[1, :5], sigma[2, 5:], sigma[3, 5:] = 0.02, 0.02, 0.03
    gate = torch.zeros(5, 10, dtype=torch.int32)
    gate[1, 5:], gate[2, :5], gate[3, :5], gate[4] = (Gate.NO_TRACK,) * 4
    views = answers(torch.full((5, 10), 4.0), sigma, gate=gate.tolist())
    assert rank_views(views, 2).index[:, 0].tolist() == [1, 2]
    assert rank_views(views, 3).index[:, 0].tolist() == [1, 2, 3]
    assert rank_views(views, 5).index[:, 0].tolist() == [0, 1, 2, 3, 4]
    both = pytree.stack([views[:, 0], views[[4, 3, 2, 1, 0], 0]], 1)  # a batch of two, each with its own choice
    assert rank_views(both, 2).index.T.tolist() == [[1, 2], [2, 3]]
    same = answers(torch.full((3, 10), 4.0), torch.full((3, 10), 0.1))
    assert rank_views(same, 1).index[:, 0].tolist() == [2]
    with pytest.raises(ValueError, match="rank_views"):
        rank_views(views, 6)


def test_it_captures():
    views, _ = noisy(V=3, N=8)
    compiled = torch.compile(inverse_variance, fullgraph=True, backend="eager")
    for a, b in zip(*(pytree.pytree.tree_leaves(f(views)) for f in (inverse_variance, compiled)), strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())


# --- the window ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room():
    """Two reference views with three further views each: (2,), (3, 2); near returns only."""
    at = lambda k: walls.near(walls.view(walls.at(k)))  # noqa: E731
    references = pytree.collate([at(0), at(1)])
    return references, pytree.stack([pytree.collate([at(i), at(i + 1)]) for i in (2, 4, 6)])


def test_without_chain_it_is_the_pairs_fused(room):
    reference, others = room
    trace = {}
    window = extend_window(reference, others, chain=False, trace=trace, **PAIR)
    single = [extend(reference, others[k], score=lambda e, *_: e, **PAIR) for k in range(3)]
    fused = inverse_variance(pytree.stack(single))
    for field in ("depth", "sigma", "gate", "n_views"):
        assert torch.equal(getattr(window, field).nan_to_num(), getattr(fused, field).nan_to_num()), field
    assert len(trace["views"]) == 3 and torch.equal(trace["fit"].code, trace["views"][-1]["fit"].code)
    assert {"track", "pose", "triangulate", "fuse"} <= set(trace["ms"])
    assert window.score[window.keep].min() > 0 and (window.score[~window.keep] == 0).all()
    assert (window.n_views[window.keep] >= 3).all()


def test_it_answers_what_its_widest_pair_answers(room):
    reference, others = room
    window, pair = extend_window(reference, others, **PAIR), extend(reference, others[-1], **PAIR)
    both = window.keep & pair.keep
    assert both.sum() > 0.95 * pair.keep.sum()
    assert (window.depth / pair.depth - 1).abs()[both].median() < 0.03


@pytest.mark.parametrize("track", [lucas_kanade, lucas_kanade_affine])
def test_answers_do_not_depend_on_batch_mates(room, track):
    reference, others = room
    together = extend_window(reference, others, track=track, **PAIR)
    for b in range(2):
        alone = extend_window(reference[b : b + 1], others[:, b : b + 1], track=track, **PAIR)
        for field in (*FLOATS, "gate"):
            x, y = getattr(together, field)[b], getattr(alone, field)[0]
            assert torch.equal(x.nan_to_num(), y.nan_to_num()), field


def test_one_view_is_a_pair(room):
    reference, others = room
    window, pair = extend_window(reference, others[-1:], **PAIR), extend(reference, others[-1], **PAIR)
    assert torch.equal(window.gate, pair.gate)
    for field in FLOATS:
        assert torch.equal(getattr(window, field).nan_to_num(), getattr(pair, field).nan_to_num()), field
    pairs = pytree.stack([extend(reference, others[k], **PAIR) for k in range(3)])
    best = pairs[rank_views(pairs, 1).index[0], torch.arange(2)]
    chosen = extend_window(reference, others, views=1, chain=False, **PAIR)
    assert torch.equal(chosen.gate, best.gate) and torch.equal(chosen.depth.nan_to_num(), best.depth.nan_to_num())


def test_any_tracker_and_given_poses(room):
    reference, others = room
    trace = {}
    extend_window(reference, others, trace=trace, **PAIR)
    fit = pytree.stack([t["fit"] for t in trace["views"]])
    given, found = extend_window(reference, others, fit=fit, **PAIR), trace["estimate"]
    assert torch.equal(given.gate, found.gate)
    plain = extend_window(
        reference, others, track=opencv.opencv_lucas_kanade, **PAIR
    )  # takes neither start nor pyramid
    assert (plain.gate > 0).all()  # it states no covariance: nothing to weigh its answers by


def test_of_many_views_the_widest_is_kept_and_copies_of_the_anchor_are_not(room):
    reference, others = room
    more = pytree.stack([reference, others[0], reference, others[2]])
    few, trace = extend_window(reference, others[[0, 2]], **PAIR), {}
    chosen = extend_window(reference, more, views=2, trace=trace, **PAIR)
    assert torch.equal(chosen.gate, few.gate) and len(trace["views"]) == 2
    assert torch.equal(chosen.depth.nan_to_num(), few.depth.nan_to_num())


def test_wrong_shapes_raise(room):
    reference, others = room
    for bad in (others[:, :1], others[0][:1], others[:0], []):
        with pytest.raises(ValueError, match=r"extend|method"):
            extend_window(reference, bad, **PAIR)


def test_several_views_come_as_one_record_or_as_a_sequence(room):
    reference, others = room
    one, many = (
        extend_window(reference, others, **PAIR),
        extend_window(reference, [others[k] for k in range(3)], **PAIR),
    )
    assert torch.equal(one.gate, many.gate) and torch.equal(one.depth.nan_to_num(), many.depth.nan_to_num())


def test_gradients_reach_images_and_depth(room):
    reference, others = room
    image, depth = (x[:1].clone().requires_grad_() for x in (reference.image / 255, reference.depth))
    stage = partial(SURE, max_chi2=1e9)
    window = extend_window(reference[:1].replace(image=image, depth=depth), others[:, :1], fuse=stage, **PAIR)
    grads = torch.autograd.grad(window.depth[window.keep].sum(), (image, depth))
    assert all(g.isfinite().all() and g.abs().sum() > 0 for g in grads)
