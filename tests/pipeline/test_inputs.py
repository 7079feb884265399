"""Frames that are asked together: what they must share is said, what can be made equal is."""

import pytest
import torch

from dhtorch import AUTO, MAP, PAPER
from dhtorch.pipeline.inputs import validate_views
from dhtorch.records import Frame
from dhtorch.synthetic import SyntheticRoom


@pytest.fixture(scope="module")
def views():
    room = SyntheticRoom(n_frames=5, hw=(96, 128), depth_hw=(48, 64))
    return room[0], room[2], room[4]


def double(frame):
    return frame.replace(image=frame.image.double() / 255)


@pytest.mark.parametrize("method", [PAPER, MAP, AUTO], ids=["paper", "map", "auto"])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda a, b: (a.replace(image=a.image[..., :0]), b), ValueError, r"reference.image has shape \(1, 3, 96, 0\), expected at least one pixel"),
        (lambda a, b: (a, b.replace(image=b.image[:, :, :0])), ValueError, r"other.image has shape \(1, 3, 0, 128\), expected at least one pixel"),
        (lambda a, b: (a.replace(depth=a.depth[..., :0]), b), ValueError, r"reference.depth has shape \(1, 48, 0\), expected at least one pixel"),
        (lambda a, b: (a[:0], b[:0]), ValueError, r"reference.image has shape \(0, 3, 96, 128\), expected at least one view"),
        (lambda a, b: (a, None), ValueError, "found no other view"),
        (lambda a, b: (a, []), ValueError, "found no other view"),
        (lambda a, b: (a.image, b), TypeError, r"reference is a Tensor, expected a dhtorch.Frame"),
        (lambda a, b: (a, [b, None]), TypeError, r"others\[1\] is a NoneType, expected a dhtorch.Frame"),
        (lambda a, b: (a, [b.replace(image=b.image.to("meta")), b]), ValueError, r"others\[0\].image is on meta, reference.image on cpu, expected one device"),
        (lambda a, b: (a.replace(camera=a.camera.to("meta")), b), ValueError, r"reference.camera.f is on meta"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_are_named(views, method, change, error, message):
    with pytest.raises(error, match=message):
        method(*change(*views[:2]))


def test_the_depth_of_other_views_may_be_missing(views):
    reference, other, _ = views
    blind = other.replace(depth=other.depth[:, :0, :0])
    assert torch.equal(PAPER(reference, blind, n=64).gate, PAPER(reference, other, n=64).gate)


def test_frames_of_several_precisions_give_one_answer(views):
    reference, *others = views
    expected = PAPER(reference, others[0], n=128)
    for frames in ((reference, double(others[0])), (double(reference), others[0])):
        found = PAPER(*frames, n=128)
        assert found.depth.dtype == expected.depth.dtype
        both = found.keep & expected.keep
        assert both.sum() > 0.9 * expected.keep.sum() > 0
        assert torch.allclose(found.depth[both], expected.depth[both], rtol=1e-2)
    wide = PAPER(reference, others[0].replace(camera=others[0].camera.to(torch.float64)), n=128)
    assert wide.depth.dtype == torch.float64
    mixed = AUTO(reference, [others[0], double(others[1])], n=128)
    assert mixed.depth.shape == (1, 128)


def test_equal_precisions_stay_byte_for_byte(views):
    reference, others = validate_views(views[0], views[1])
    assert reference.image is views[0].image and others.image is views[1].image
    reference, others = validate_views(views[0], list(views[1:]))
    assert others.image.dtype == torch.uint8 and others.image.shape == (2, 1, 3, 96, 128)
    assert isinstance(others, Frame)
