"""What is done for speed changes no answer: pieces, trial steps, and peers that are asked the same question."""

import json
import sys
from pathlib import Path

import pytest
import torch

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.records import Camera

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import frontend
import harness


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


def test_the_front_end_and_its_peer_answer_the_same_question():
    frame = frontend.view((224, 224), 2)
    found, peer = frontend.front_end(frame, 512), frontend.OpenCVFrontEnd(frame, 512)()
    for b in range(2):
        answer = {k: torch.from_numpy(v) for k, v in peer[b].items()}
        assert torch.equal(found.flag[b], answer["flag"].int())
        torch.testing.assert_close(found.xyz[b], answer["xyz"], equal_nan=True)
        torch.testing.assert_close(found.confidence[b], answer["confidence"].float())
        assert (found.hole[b] == answer["hole"]).double().mean() > 0.98  # OpenCV rounds grey values to integers
    inside = ((found.uv[0] >= 4) & (found.uv[0] <= 219)).all(-1)  # nearer to the border the block is moved inside
    exact = frontend.exact_trackability(frame, 512)[inside]
    torch.testing.assert_close(found.trackability[0][inside], exact, rtol=1e-4, atol=1e-8)


def test_rows_of_benchmarks_are_strict_json(tmp_path, capsys):
    calls = [lambda: None, lambda: sum(range(1000))]
    times = harness.in_turn(calls, repeats=4, clock="cpu", least_ms=0.1)
    assert [len(t) for t in times] == [4, 4]
    more = {"n": 10, "ours_error": 0.1}
    row = harness.row("x", [1.0, 2.0, 3.0, 4.0], "peer", [4.0, 5.0, 6.0, 7.0], **more)
    harness.report([row], tmp_path / "x.json")
    read = json.loads((tmp_path / "x.json").read_text())[0]
    keys = [
        "name",
        "mode",
        "n",
        "batch",
        "threads",
        "processor",
        "git",
        "device",
        "ours_ms",
        "ours_iqr",
        "peer",
        "peer_ms",
        "ratio",
        "ours_error",
        "peer_error",
        "bar",
    ]
    assert set(read) == set(keys) and read["ratio"] == pytest.approx(2.5 / 5.5) and read["bar"] is False
    assert "ratio" in capsys.readouterr().out
