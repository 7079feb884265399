"""What is known in metres on the pixels of a map: where it stands, how unsure it is alone and together, how much it counts."""

import math

import pytest
import torch

from dhtorch.alignment import references
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.codes import Gate, Source
from dhtorch.records import DepthMap, Estimate, Samples

HW = (40, 80)


def near(uv, depth, sigma=0.01):
    """Near returns at pixels (N, 2)."""
    zero = torch.zeros(1, len(uv))
    depth = torch.as_tensor(depth).expand(1, len(uv)).clone()
    xyz = torch.cat((torch.zeros(1, len(uv), 2), depth[..., None]), -1)
    return Samples(
        torch.as_tensor(uv)[None].float(), depth, zero + sigma, xyz, zero + 1, zero.int(), zero + 1, zero.int()
    )


def far(uv, depth, sigma, shared, keep=True):
    """Far answers at pixels (N, 2)."""
    silent = Estimate.unanswered(near(uv, depth), Gate.NO_TRACK, n_views=2)
    full = torch.full_like(silent.score, depth)
    gate = torch.full_like(silent.gate, Gate.ANSWER if keep else Gate.RESIDUAL)
    return silent.replace(depth=full, sigma=full * 0 + sigma, sigma_shared=full * 0 + shared, gate=gate)


def test_samples_and_answers_stand_on_the_pixels_of_the_map():
    x = torch.arange(20 * 40).double().view(1, 20, 40)  # half as large as the picture
    found = references.collect_references(
        x, [near([[0, 0], [79, 39], [41, 20]], 2.0), far([[3, 2]], 4.0, 0.2, 0.1)], HW
    )
    torch.testing.assert_close(found.share[0, 1], torch.tensor([79.5 / 80, 39.5 / 40], dtype=torch.float64))
    assert found.x[0].tolist() == [0, 19 * 40 + 39, 10 * 40 + 20, 1 * 40 + 1]
    assert found.near[0].tolist() == [True, True, True, False] and found.used.all()
    own, beside = DEFAULT_ALIGNMENT_OPTIONS.min_return_error**2, DEFAULT_ALIGNMENT_OPTIONS.far_own_error**2
    variance = [0.005**2 + own] * 3 + [0.05**2 - 0.025**2 + own + beside]
    torch.testing.assert_close(found.var[0], torch.tensor(variance, dtype=torch.float64), rtol=1e-5, atol=0)
    together = [0.0] * 3 + [math.hypot(0.025, DEFAULT_ALIGNMENT_OPTIONS.far_shared_error)]
    torch.testing.assert_close(found.shared[0], torch.tensor(together, dtype=torch.float64), rtol=1e-5, atol=0)


def test_what_is_silent_or_stands_on_no_value_is_no_anchor():
    x = torch.ones(1, *HW).double()
    x[0, 5, 5] = torch.nan
    found = references.collect_references(
        x, [near([[5, 5], [6, 5], [200, 5]], 2.0), far([[3, 2]], 4.0, 0.2, 0.1, keep=False)], HW
    )
    assert found.used[0].tolist() == [False, True, False, False]


def test_a_map_s_pixels_are_anchors_and_half_of_what_its_far_ones_do_not_know_is_common():
    one = torch.full((1, 2, 4), 4.0)
    source = torch.tensor([[[Source.SENSOR] * 4, [Source.SWEPT] * 4]]).int()
    told = DepthMap(one, 0.4 * one / 4, one, source, torch.zeros_like(source))
    found = references.collect_references(torch.arange(8.0).double().view(1, 2, 4), [told], (2, 4))
    assert found.x[0].tolist() == list(range(8)) and found.near[0].tolist() == [True] * 4 + [False] * 4
    assert found.share[0, 5].tolist() == [1.5 / 4, 1.5 / 2]
    assert float(found.shared[0, 7]) == pytest.approx(
        math.hypot(0.1 * DEFAULT_ALIGNMENT_OPTIONS.map_shared_ratio**0.5, DEFAULT_ALIGNMENT_OPTIONS.far_shared_error)
    )


def test_of_many_some_are_used_from_all_over():
    uv = torch.stack(torch.meshgrid(torch.arange(80), torch.arange(40), indexing="xy"), -1).flatten(0, 1)
    found = references.collect_references(torch.ones(1, *HW).double(), [near(uv, 2.0)], HW)
    assert found.x.shape == (1, DEFAULT_ALIGNMENT_OPTIONS.max_references_per_source)
    assert float(found.share[0, 0, 1]) < 0.05 and float(found.share[0, -1, 1]) > 0.95


def test_anchors_of_one_block_count_as_fewer_and_near_and_far_ones_are_two():
    points = [near([[0, 0], [1, 1], [60, 30]], 2.0), far([[2, 2]], 4.0, 0.2, 0.1)]
    found = references.collect_references(torch.ones(1, *HW).double(), points, HW)
    assert found.block[0].tolist() == [1, 1, 2 * (4 * 8 + 6) + 1, 0]
    together = 1 / (1 + DEFAULT_ALIGNMENT_OPTIONS.block_correlation)
    torch.testing.assert_close(found.weight(found.used)[0], torch.tensor([together, together, 1, 1]).double())
    alone = found.used & torch.tensor([[True, False, True, False]])
    assert found.weight(alone)[0].tolist() == [1, 0, 1, 0]


def test_how_a_map_differs_about_a_pixel():
    """Evenly up to the next pixel on either side: a slope of s per pixel has standard deviation s / √3."""
    ramp = torch.arange(6.0).double().expand(1, 4, 6) * 0.3
    torch.testing.assert_close(references.local_spread(ramp)[0, :, 1:-1], torch.full((4, 4), 0.3 / 3**0.5).double())
    holed = ramp.clone()
    holed[0, :, 3] = torch.nan
    found = references.local_spread(holed)
    assert found.isfinite().all() and float(found[0, 0, 2]) == pytest.approx(0.3 / 6**0.5), "a step to no value is none"
