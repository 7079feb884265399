"""What is done for speed changes no answer: pieces, trial steps, and peers that are asked the same question."""

import json
import sys
from pathlib import Path

import pytest
import torch

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, least_squares, se3
from dhtorch.records import Camera

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import frontend
import gpu
import harness
import scaling

from dhtorch.pipeline.presets import METHODS


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


def test_trial_steps_are_gauss_newton_steps_and_know_no_company():
    g = torch.Generator().manual_seed(0)
    A, v = torch.randn(40, 6, 9, generator=g), torch.randn(40, 6, generator=g)
    H, T = A @ A.mT + 0.1 * torch.eye(6), se3.exp(0.1 * torch.randn(40, 6, generator=g))
    H[3], v[4, 2] = 0, torch.nan
    step, ok = least_squares.trial_pose_step(T, H, v)
    wanted, fine = least_squares.gauss_newton_step(T, H, v)
    assert fine.sum() == 38 and ok[fine].all() and not ok[3]
    torch.testing.assert_close(step.R[fine], wanted.R[fine], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(step.t[fine], wanted.t[fine], rtol=1e-5, atol=1e-6)
    assert step.t[4].isnan().any()  # no cost of it is below another
    for b in fine.nonzero()[:, 0].tolist():
        one, _ = least_squares.trial_pose_step(T[b : b + 1], H[b : b + 1], v[b : b + 1])
        assert torch.equal(one.R[0], step.R[b]) and torch.equal(one.t[0], step.t[b])


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


def test_growth_is_the_slope_of_the_logarithms():
    assert scaling.exponent([1, 2, 4], [3.0, 6.0, 12.0]) == pytest.approx(1)
    assert scaling.exponent([1, 2, 4], [5.0, 5.0, 5.0]) == pytest.approx(0)
    assert scaling.exponent([1, 2, 4], [1.0, 4.0, 16.0]) == pytest.approx(2)


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


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_an_accelerator_its_benchmark_says_so(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    assert gpu.main() == 0
    assert "skipped" in capsys.readouterr().out


class Clock:
    """Events of a device that is not there: each knows when it was recorded."""

    now = 0.0

    def __init__(self, enable_timing):
        assert enable_timing

    def record(self):
        Clock.now += 1.0
        self.at = Clock.now

    def elapsed_time(self, end):
        return end.at - self.at


@pytest.mark.slow
def test_its_benchmark_runs_through_with_a_device_that_is_played(monkeypatch, capsys, tmp_path):
    """Everything but the device: records moved, events recorded, a series that ends where memory does, rows written."""
    moved, waited = [], []
    to, paper = torch.Tensor.to, METHODS["paper"]

    def played(x, *args, **options):
        if args and str(args[0]) == "cuda":
            moved.append(x.dtype)
            return to(x, *args[1:]).clone()
        return to(x, *args, **options)

    def until_full(near, other, **options):
        if len(near.image) == 3:
            raise torch.cuda.OutOfMemoryError
        return paper(near, other, **options)

    monkeypatch.setattr(torch.Tensor, "to", played)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waited.append(1))
    monkeypatch.setattr(torch.cuda, "Event", Clock)
    for name in ("reset_peak_memory_stats", "memory_allocated", "max_memory_allocated", "get_device_name"):
        monkeypatch.setattr(torch.cuda, name, lambda: 0)
    series, all_calls = ("frontend", "pnp_n500", "triangulate", "pair_paper"), gpu.calls
    played_options = {"CPU_BATCH": 2, "N": 64, "VIEWS": 1, "SIZES": (1, 3, 4), "OF_VIEWS": ()}
    played_options |= {"METHODS": {**METHODS, "paper": until_full}, "waits": lambda call: 0}
    played_options["graph_times"] = lambda *_: None
    played_options["calls"] = lambda *of: {k: v for k, v in all_calls(*of).items() if k in series}
    for name, value in played_options.items():
        monkeypatch.setattr(gpu, name, value)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--repeats", "2", "--json", str(tmp_path / "gpu.json")])
    precision = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    try:
        assert gpu.main() == 0
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = precision
    rows = {(r["name"], r["batch"]): r for r in json.loads((tmp_path / "gpu.json").read_text())}
    alive = [(f"gpu_{name}_b{b}", b) for b in (1, 3, 4) for name in ("frontend", "pnp_n500", "triangulate")]
    assert set(rows) == {*alive, ("gpu_pair_paper_b1", 1)}
    assert "3 do not fit" in capsys.readouterr().out
    for (_, batch), r in rows.items():
        assert r["device"] == "cuda" and r["peer"] == "cpu_b2" and r["ours_ms"] == pytest.approx(1 / batch)
    pair = rows["gpu_pair_paper_b1", 1]
    assert pair["ours_error"] == pair["peer_error"], "the same numbers here"
    assert torch.float32 in moved and len(waited) == 2 * (1 + 2) * len(rows)  # one to find the count
