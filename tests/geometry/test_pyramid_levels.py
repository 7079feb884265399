"""A pyramid has as many levels as OpenCV makes."""

import cv2
import numpy as np
import pytest
import torch

from dhtorch.geometry.pyramid import build_pyramid


@pytest.mark.parametrize("hw", [(80, 200), (87, 88), (88, 175), (175, 176), (176, 177), (23, 400)])
def test_a_pyramid_has_as_many_levels_as_opencv_makes(hw):
    last, _ = cv2.buildOpticalFlowPyramid(np.zeros(hw, np.uint8), (21, 21), 5)
    assert len(build_pyramid(torch.zeros(1, 1, *hw), 6, window=21).levels) == last + 1
