"""What is done for speed changes no answer."""

import pytest
import torch

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.records import Camera


def two_views(n):
    g = torch.Generator().manual_seed(0)
    uv_0 = torch.rand(2, n, 2, generator=g) * torch.tensor([640.0, 480.0])
    depth = 1 + 4 * torch.rand(2, n, generator=g)
    camera = Camera(torch.full((2, 2), 500.0), torch.tensor([[320.0, 240.0], [300.0, 250.0]]))
    T = se3.exp(torch.tensor([[0.01, 0.02, -0.01, 0.2, 0.02, 0.01], [0.0, 0.1, 0.0, -0.2, 0.0, 0.05]]))
    other = Camera(torch.full((2, 2), 450.0), torch.tensor([[310.0, 235.0], [330.0, 245.0]]))
    uv_1 = cam.project(other, se3.apply(T, cam.unproject(camera, uv_0, depth)))
    return (uv_0, uv_1, camera, other, T), depth


@pytest.mark.parametrize("points", [64, 10_000])
def test_depths_are_those_of_triangulate_in_any_pieces(monkeypatch, points):
    monkeypatch.setattr(epipolar, "MAX_CHUNK_TRIANGULATED", points)
    args, truth = two_views(333)
    found = epipolar.triangulate_depth(*args)
    assert torch.equal(found, epipolar.triangulate(*args).depth)
    torch.testing.assert_close(found, truth, rtol=2e-3, atol=0)
    assert epipolar.triangulate_depth(*(x[:, :0] if k < 2 else x for k, x in enumerate(args))).shape == (2, 0)
