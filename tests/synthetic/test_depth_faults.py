"""Faults of depth maps do what their names say, and nothing to what they do not touch."""

import pytest
import torch

from dhtorch.synthetic import depth_faults as faults


@pytest.fixture(scope="module")
def depth():
    """Two maps: a slanted wall with a box before it, and a strip without returns."""
    z = torch.linspace(2, 4, 64, dtype=torch.float64).expand(2, 48, 64).clone()
    z[:, 16:32, 20:40] = 1.0
    z[:, :, 60:] = 0
    return z


@pytest.mark.parametrize("name", faults.FAULTS)
def test_a_fault_is_the_same_alone_and_in_a_batch(depth, name):
    both, wrong = faults.spoil(name, depth, seed=3)
    alone, _ = faults.spoil(name, depth[:1], seed=3)
    assert both.shape == wrong.shape == depth.shape
    assert torch.equal(both[:1], alone)
    assert (both >= 0).all() and both.isfinite().all()
    assert wrong.any() or (name == "quantised" and (both != depth).any())


@pytest.mark.parametrize("name", list(faults.OF_NETWORKS))
def test_what_networks_do_leaves_holes_where_they_are(depth, name):
    assert torch.equal(faults.spoil(name, depth)[0] > 0, depth > 0)


def test_sizes_of_faults(depth):
    known = depth > 0
    log = (faults.spoil("warp_large", depth)[0] / depth)[known].log()
    assert 0.02 < log.std() < 0.08 and log.abs().mean() > 0.01
    found, wrong = faults.spoil("jumps", depth, seed=1)
    assert torch.allclose(found[wrong], 3 * depth[wrong]) and torch.equal(found[~wrong], depth[~wrong])
    assert torch.equal(faults.spoil("unit", depth)[0], 5 * depth)
    step = faults.DISPARITY_STEP / faults.FOCAL_BASELINE
    q = 1 / faults.spoil("quantised", depth)[0][known] / step
    assert torch.allclose(q, q.round(), atol=1e-6)
    assert torch.equal(faults.mirrored(faults.mirrored(depth)), depth)
    assert torch.equal(faults.rolled(depth, 0.25)[..., 16:], depth[..., :48])


def test_magnified_shows_what_lies_nearer_to_the_middle(depth):
    found = faults.magnified(depth, 2.0)
    assert found[0, 0, 0] == depth[0, 12, 16]
    assert (faults.magnified(depth, 0.5)[:, 0] == 0).all()


def test_bad_requests_say_what_was_expected(depth):
    with pytest.raises(ValueError, match="expected one of scale_short"):
        faults.spoil("drift", depth)
    with pytest.raises(ValueError, match="other="):
        faults.spoil("time", depth)
    with pytest.raises(ValueError, match="B h w"):
        faults.spoil("shift", depth[0])
    other, wrong = faults.spoil("time", depth, other=depth * 1.1)
    assert torch.equal(other, depth * 1.1) and torch.equal(wrong, depth > 0)
