"""Artefacts of a map and wrong answers beside true steps: each planted one is counted, a clean map has none."""

import torch

from dhtorch.codes import Gate, Source
from dhtorch.metrics import map_quality
from dhtorch.records import DepthMap


def flat_map(source, depth=3.0):
    """Map of one depth by its sources (h, w)."""
    source = torch.as_tensor(source, dtype=torch.int32)[None]
    keep = source != Source.NONE
    z = torch.where(keep, torch.full(source.shape, depth), torch.nan)
    gate = torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).int()
    return DepthMap(z, 0.1 * z, keep.float(), source, gate)


def test_each_artefact_is_counted_and_returns_are_none():
    source = torch.zeros(60, 80, dtype=torch.int32)
    source[10:50, 20:60] = Source.SWEPT
    source[12:50, 60:70] = Source.SENSOR
    clean = flat_map(source.clone())
    assert map_quality.artefact_counts(clean) == (0, 1600)
    source[2:5, 2:6] = Source.FILLED  # a speck of 12 px
    source[30, 5:20] = Source.SWEPT  # a line of 15 px at the patch
    source[20:22, 30:34] = Source.NONE  # a pinhole of 8 px
    source[20, 65] = Source.NONE  # one of 1 px amid returns
    source[55:57, 70:72] = Source.SENSOR  # no answer of the sweep
    source[58, 5:45] = Source.SENSOR  # nor is a line of returns
    found = map_quality.find_artefacts(flat_map(source))
    assert [int(part.sum()) for part in found] == [12, 15, 9]
    assert found.speck[0, 2:5, 2:6].all() and found.line[0, 30, 5:20].all() and found.pinhole[0, 20, 65]
    assert map_quality.artefact_counts(flat_map(source)) == (36, 1600 + 12 + 15 - 8)


def test_silence_at_the_border_and_a_large_hole_are_no_pinholes():
    source = torch.full((60, 80), Source.SWEPT, dtype=torch.int32)
    source[:2, :3] = Source.NONE  # six pixels in a corner
    source[20:26, 20:25] = Source.NONE  # 30 px
    assert map_quality.artefact_counts(flat_map(source)) == (0, 4800 - 36)
    source[20, 20] = Source.SWEPT
    assert map_quality.artefact_counts(flat_map(source))[0] == 29


def test_a_speck_that_is_a_line_counts_once():
    source = torch.zeros(60, 80, dtype=torch.int32)
    source[10:50, 20:60] = Source.SWEPT
    source[5, 5:15] = Source.SWEPT
    assert map_quality.artefact_counts(flat_map(source)) == (10, 1610)


def test_wrong_answers_beside_a_step():
    depth = torch.full((1, 40, 60), 4.0)
    depth[..., 30:] = 3.0  # ratio 1.33
    depth[:, 0] = 0.0
    near = map_quality.near_depth_step(depth)
    assert near[0, 20].nonzero()[:, 0].tolist() == list(range(23, 37)), "six pixels around the two of the step"
    assert not map_quality.near_depth_step(torch.where(depth == 3, 3.6, depth)).any(), "ratio 1.11"
    answers = flat_map(torch.full((40, 60), Source.SWEPT), depth=3.1)
    left = torch.zeros_like(near)
    left[..., :30] = True
    # 39 rows with truth: seven columns of 4 m are 22 % off, seven of 3 m are right
    assert map_quality.step_counts(answers, depth) == (39 * 7, 39 * 14)
    assert map_quality.step_counts(answers, depth, left) == (39 * 7, 39 * 7)
    returns = flat_map(torch.full((40, 60), Source.SENSOR), depth=3.1)
    assert map_quality.step_counts(returns, depth) == (0, 0)
