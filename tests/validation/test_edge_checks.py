"""Edges of pictures and depth show by how many frames depth is late, and how it is turned; sound windows show nothing."""

import itertools
from types import SimpleNamespace

import pytest
import torch
from support.cluttered_walk import N, walk

from dhtorch.data.orientation import edge_correlations
from dhtorch.validation import edges as edge_lag
from dhtorch.validation.edges import (
    _SHIFTS_PX,
    EdgeLag,
    _shifted_scores,
    clear_lead,
    do_edges_refute,
    find_edge_fault,
    find_edge_lag,
)
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


@pytest.mark.parametrize(("n", "lag", "expected"), [(8, 2, 0.1), (7, 3, 0.1), (7, -3, 0.1), (6, 3, 0.0), (6, -3, 0.0)])
def test_the_lead_of_a_lag_is_its_correlation_less_that_without_over_four_frames_or_more(monkeypatch, n, lag, expected):
    scores = torch.linspace(0.2, 0.5, n)[:, None].expand(n, n).clone()  # of picture i and the depth of frame j
    for i in range(n):
        scores[i, i + lag : i + lag + 1 if i + lag >= 0 else 0] += 0.1
    monkeypatch.setattr(edge_lag, "picture_edges", lambda image, grid_px: image.expand(3, 2, 2))
    monkeypatch.setattr(edge_lag, "depth_over_picture", lambda frame, depth: frame.image[0])
    monkeypatch.setattr(edge_lag, "depth_edges", lambda depth, hw: (depth.expand(3, *hw), torch.ones(hw) > 0))
    monkeypatch.setattr(edge_lag, "edge_correlations", lambda pictures, edges, covered: scores)
    of_two = lambda picture, edges, covered: scores[int(picture[0, 0, 0]), int(edges[0, 0, 0])].expand(1)  # noqa: E731
    monkeypatch.setattr(edge_lag, "_shifted_scores", of_two)
    found = find_edge_lag([SimpleNamespace(image=torch.full((1, 1, 1, 1), float(k)), depth=None) for k in range(n)])
    assert found.lag == (lag if expected else 0) and found.lead == pytest.approx(expected)


def test_a_lead_is_above_the_least_and_above_its_standard_errors():
    assert (
        clear_lead(torch.full((4,), 0.1), 0.05) == pytest.approx(0.1) and clear_lead(torch.full((4,), 0.04), 0.05) == 0
    )
    apart = torch.tensor([0.0, 0.2, 0.0, 0.2])  # mean 0.1, standard error 0.1155 / 2
    assert clear_lead(apart, 0.05, errors=1.7) == pytest.approx(0.1) and clear_lead(apart, 0.05, errors=1.8) == 0


def test_correlations_under_shifts_are_those_of_shifted_depth():
    generator = torch.Generator().manual_seed(0)
    picture, edges = (torch.rand(3, 47, 60, generator=generator) for _ in range(2))
    covered = torch.rand(47, 60, generator=generator) > 0.3
    shifts = list(itertools.product(_SHIFTS_PX, repeat=2))
    moved, masks = (torch.stack([x.roll(by, (-2, -1)) for by in shifts]) for x in (edges, covered))
    expected = edge_correlations(picture[None], moved, masks)[0]
    torch.testing.assert_close(_shifted_scores(picture, edges, covered), expected, atol=1e-5, rtol=0)


def test_depth_without_returns_a_short_window_or_a_still_camera_shows_nothing(frames):
    empty = [frame.replace(depth=torch.zeros_like(frame.depth)) for frame in frames]
    turned = [frame.replace(depth=frame.depth.flip(-1)) for frame in frames]
    three = delayed(frames, 1)[:4]  # have a depth of another frame
    assert [find_edge_lag(each).lag for each in (empty, three, delayed([frames[3]] * N, 2))] == [0, 0, 0]
    few = ([], frames[:2], turned[:2], [turned[0]] * 8)
    assert all(find_edge_fault(each) is None for each in (empty, *few))


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
