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


@pytest.mark.parametrize("name", faults.DEPTH_FAULTS)
def test_a_fault_is_the_same_alone_and_in_a_batch(depth, name):
    both, wrong = faults.apply_fault(name, depth, seed=3)
    alone, _ = faults.apply_fault(name, depth[:1], seed=3)
    assert both.shape == wrong.shape == depth.shape
    assert torch.equal(both[:1], alone)
    assert (both >= 0).all() and both.isfinite().all()
    assert wrong.any() or (name == "quantised" and (both != depth).any())


@pytest.mark.parametrize("name", list(faults.NETWORK_FAULTS))
def test_what_networks_do_leaves_holes_where_they_are(depth, name):
    assert torch.equal(faults.apply_fault(name, depth)[0] > 0, depth > 0)


def test_sizes_of_faults(depth):
    known = depth > 0
    log = (faults.apply_fault("warp_large", depth)[0] / depth)[known].log()
    assert 0.02 < log.std() < 0.08 and log.abs().mean() > 0.01
    found, wrong = faults.apply_fault("jumps", depth, seed=1)
    assert torch.allclose(found[wrong], 3 * depth[wrong]) and torch.equal(found[~wrong], depth[~wrong])
    assert torch.equal(faults.apply_fault("unit", depth)[0], 5 * depth)
    step = faults._DISPARITY_STEP_PX / faults._FOCAL_BASELINE_PX_M
    q = 1 / faults.apply_fault("quantised", depth)[0][known] / step
    assert torch.allclose(q, q.round(), atol=1e-6)
    assert torch.equal(faults.mirror_depth(faults.mirror_depth(depth)), depth)
    assert torch.equal(faults.roll_depth(depth, 0.25)[..., 16:], depth[..., :48])


def test_magnified_shows_what_lies_nearer_to_the_middle(depth):
    found = faults.rescale_field_of_view(depth, 2.0)
    assert found[0, 0, 0] == depth[0, 12, 16]
    assert (faults.rescale_field_of_view(depth, 0.5)[:, 0] == 0).all()


def test_bad_requests_say_what_was_expected(depth):
    with pytest.raises(ValueError, match="expected one of scale_short"):
        faults.apply_fault("drift", depth)
    with pytest.raises(ValueError, match="other="):
        faults.apply_fault("time", depth)
    with pytest.raises(ValueError, match="B h w"):
        faults.apply_fault("shift", depth[0])
    other, wrong = faults.apply_fault("time", depth, other=depth * 1.1)
    assert torch.equal(other, depth * 1.1) and torch.equal(wrong, depth > 0)
