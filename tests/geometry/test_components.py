"""Components of few pixels: the same as by OpenCV's labels, with cuts between neighbours, each map by itself."""

import cv2
import numpy as np
import pytest
import torch

from dhtorch.geometry.components import small_components


@pytest.mark.parametrize("share", [0.3, 0.59, 0.7])
def test_small_components_are_those_of_a_labelling(share):
    masks = torch.rand(2, 50, 70, generator=torch.Generator().manual_seed(0)) < share
    for n in (2, 7, 30):
        found = small_components(masks, n)
        for mask, one in zip(masks.numpy(), found.numpy(), strict=True):
            _, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
            assert np.array_equal(one, mask & (stats[:, cv2.CC_STAT_AREA][label] < n))
    assert not small_components(masks, 1).any()


def test_a_cut_divides_a_component():
    mask = torch.ones(1, 4, 10, dtype=torch.bool)
    right, down = torch.ones(1, 4, 9, dtype=torch.bool), torch.ones(1, 3, 10, dtype=torch.bool)
    right[..., 2] = False  # 12 px | 28 px
    assert small_components(mask, 13, same=(right, down))[0].int().sum(0).tolist() == [4] * 3 + [0] * 7
    down[:, 1] = False  # 6 | 6, 14 | 14
    assert int(small_components(mask, 13, same=(right, down)).sum()) == 12
    assert small_components(mask, 15, same=(right, down)).all()
