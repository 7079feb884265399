"""Many views: the window against the pairs it is made of, and fusion; the same against loops: test_inverse_variance.py."""

from functools import partial

import pytest
import torch
from support import textured_box as walls

from dhtorch import PAPER, extend, pytree
from dhtorch.codes import Gate
from dhtorch.pipeline.view_selection import rank_views
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

extend_window = PAPER.replace(views=5)

FLOATS = ("depth", "sigma", "sigma_shared", "parallax_deg", "residual_px", "score")
PAIR = {"n": 200, "hypotheses": 64}


SURE = partial(inverse_variance, max_sigma_rel=None)


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


def test_of_many_views_the_widest_is_kept_and_copies_of_the_anchor_are_not(room):
    reference, others = room
    more = pytree.stack([reference, others[0], reference, others[2]])
    few, trace = extend_window(reference, others[[0, 2]], **PAIR), {}
    chosen = extend_window(reference, more, views=2, trace=trace, **PAIR)
    assert torch.equal(chosen.gate, few.gate) and len(trace["views"]) == 2
    assert torch.equal(chosen.depth.nan_to_num(), few.depth.nan_to_num())


def test_a_point_that_any_view_tracked_lacks_texture(room):
    trace = {}
    gate = extend_window(*room, min_trackability=1e9, trace=trace, **PAIR).gate
    tracked = torch.stack([view["tracks"].valid for view in trace["views"]]).any(0)
    assert (gate[tracked] == Gate.NO_TEXTURE).all() and (gate[~tracked] == Gate.NO_TRACK).all() and tracked.any()


def test_wrong_shapes_raise(room):
    reference, others = room
    for bad in (others[:, :1], others[0][:1], others[:0], []):
        with pytest.raises(ValueError, match=r"extend|method"):
            extend_window(reference, bad, **PAIR)


def test_gradients_reach_images_and_depth(room):
    reference, others = room
    image, depth = (x[:1].clone().requires_grad_() for x in (reference.image / 255, reference.depth))
    stage = partial(SURE, max_chi2=1e9)
    window = extend_window(reference[:1].replace(image=image, depth=depth), others[:, :1], fuse=stage, **PAIR)
    grads = torch.autograd.grad(window.depth[window.keep].sum(), (image, depth))
    assert all(g.isfinite().all() and g.abs().sum() > 0 for g in grads)
