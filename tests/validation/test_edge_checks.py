"""Edges of pictures and depth show by how many frames depth is late, and how it is turned; sound windows show nothing."""

import itertools

import pytest
import torch
from support.cluttered_walk import N, walk

from dhtorch.data.orientation import edge_correlations
from dhtorch.validation.edge_fault import do_edges_refute, find_edge_fault
from dhtorch.validation.edge_lag import _SHIFTS_PX, EdgeLag, _shifted_scores, find_edge_lag
from dhtorch.validation.faults import KNOWN_FAULTS, rot90_map


@pytest.fixture(scope="module")
def frames():
    return walk()


def delayed(frames, lag):
    """Frames whose depth comes ``lag`` frames late."""
    return [frame.replace(depth=frames[k - lag].depth) for k, frame in enumerate(frames) if 0 <= k - lag < len(frames)]


def test_sound_windows_show_nothing(frames):
    assert find_edge_lag(frames) == EdgeLag(0, 0.0)
    assert find_edge_fault(frames) is None


@pytest.mark.parametrize("lag", [1, 2, 5, -1, -3])
def test_a_lag_is_found(lag, frames):
    shown = find_edge_lag(delayed(frames, lag))
    assert shown.lag == lag and shown.lead > 0.04


def test_correlations_under_shifts_are_those_of_shifted_depth():
    generator = torch.Generator().manual_seed(0)
    picture, edges = (torch.rand(3, 47, 60, generator=generator) for _ in range(2))
    covered = torch.rand(47, 60, generator=generator) > 0.3
    shifts = list(itertools.product(_SHIFTS_PX, repeat=2))
    moved, masks = (torch.stack([x.roll(by, (-2, -1)) for by in shifts]) for x in (edges, covered))
    expected = edge_correlations(picture[None], moved, masks)[0]
    torch.testing.assert_close(_shifted_scores(picture, edges, covered), expected, atol=1e-5, rtol=0)


def test_a_still_camera_shows_no_lag(frames):
    still = [frames[3]] * N
    assert find_edge_lag(delayed(still, 2)).lag == 0


def test_depth_without_returns_or_a_short_window_shows_no_lag(frames):
    empty = [frame.replace(depth=torch.zeros_like(frame.depth)) for frame in frames]
    assert find_edge_lag(empty).lag == 0 and find_edge_fault(empty) is None
    assert find_edge_lag(delayed(frames, 1)[:4]).lag == 0, "three frames have a depth of another frame"
    assert find_edge_fault([]) is None and find_edge_fault(delayed(frames, 0)[:2]) is None


@pytest.mark.parametrize(
    ("name", "plant"),
    [
        ("mirrored left to right", lambda d: d.flip(-1)),
        ("mirrored upside down", lambda d: d.flip(-2)),
        ("rolled by 180 degrees", lambda d: rot90_map(d, 2)),
        ("rolled by 90 degrees", lambda d: rot90_map(d, 1)),
    ],
)
def test_a_turn_is_found(name, plant, frames):
    turned = [frame.replace(depth=plant(frame.depth)) for frame in frames]
    fault = find_edge_fault(turned)
    assert fault is not None and fault.name == name
    assert torch.equal(fault.undo(turned[0].depth), frames[0].depth) or "90" in name


def test_edges_refute_a_fault_that_is_none(frames):
    by_kind = {fault.kind: fault for fault in KNOWN_FAULTS}
    turned = [frame.replace(depth=frame.depth.flip(-2)) for frame in frames]  # the last of its kind
    for kind in ("mirrored", "rolled", "registration"):
        assert do_edges_refute(frames, by_kind[kind])
    assert not do_edges_refute(turned, by_kind["mirrored"]) and not do_edges_refute(frames[:2], by_kind["mirrored"])
    assert not do_edges_refute(frames, by_kind["time offset"]), "edges of one frame show no lag"


def test_a_turn_of_two_frames_is_not_decided(frames):
    turned = [frame.replace(depth=frame.depth.flip(-1)) for frame in frames]
    assert find_edge_fault(turned[:2]) is None and find_edge_fault([turned[0]] * 8) is None
