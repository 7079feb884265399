"""The closed loop's parts that need no simulator: tasks, expert, source views, tokens, policies and intervals."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import closed_loop as loop


@pytest.fixture(scope="module")
def tasks():
    rng = np.random.default_rng(3)
    return [loop.draw_task(rng) for _ in range(200)]


def test_both_balls_are_beyond_the_sensor_and_in_view_and_one_is_nearer(tasks):
    for task in tasks:
        for side in (-0.5, 0.5):
            camera = task.start + np.array([0, side * loop.PEEK_M, 0])
            balls = (task.balls - camera) @ loop.WORLD_FROM_CAMERA
            away = np.linalg.norm(balls, axis=1)
            assert (away - task.radii > loop.CUTOFF_M).all() and away[1] > away[0] + 0.05
            assert (np.abs(balls[:, :2] / balls[:, 2:]) < np.tan(np.radians(loop.FOV_DEG / 2))).all()
            assert (balls[:, 2] < 2.0).all(), "before the wall"
    sizes = np.array([task.radii / np.linalg.norm(task.balls - task.start, axis=1) for task in tasks])
    assert 0.4 < (sizes[:, 0] < sizes[:, 1]).mean() < 0.6, "the larger picture is no more often the nearer ball"


def test_the_expert_reaches_the_nearer_ball_in_time(tasks):
    for task in tasks:
        position, at = task.start + np.array([0, task.side * loop.PEEK_M / 2, 0]), None
        for _ in range(loop.HORIZON):
            if at is None:
                action = loop.expert_action(task, position)
                assert np.linalg.norm(action) < loop.STEP_M + 1e-9
                position = position + loop.WORLD_FROM_CAMERA @ action
                at = loop.reached(task, position)
        assert at == 0


def test_the_source_view_is_the_one_aside_not_the_one_behind():
    positions = [np.array(p) for p in ((0.0, 0.0, 0.0), (0.0, 0.1, 0.0), (0.1, 0.1, 0.0), (0.2, 0.12, 0.0))]
    assert loop.choose_source(positions) == 0
    assert loop.choose_source(positions[1:]) == 1, "both as far aside, the second less far behind"


def views(shift, near):
    texture = np.random.default_rng(1).integers(0, 255, (3, 64, 80)).astype(np.uint8)
    image = np.stack([texture[:, :, shift : shift + 64]] * 2)
    depth = np.full((2, 64, 64), 1.0)
    depth[:, 40:] = near
    return loop.Views(image, depth, np.array([[0.0, -shift / loop.FOCAL, 0.3]] * 2))


def test_tokens_of_the_conditions_hold_what_their_names_say():
    tokens = loop.Tokens()
    alone = tokens.compute(views(6, 0.4), views(0, 0.4), ("rgb", "sensor", "true"))
    assert all(x.shape == (2, 64, 10) for x in alone.values()) and not alone["rgb"].any()
    inverse = {name: x[..., 0].view(2, 8, 8) for name, x in alone.items()}
    assert not inverse["sensor"][:, :5].any() and (inverse["sensor"][:, 5:] - 2.5).abs().max() < 0.1
    assert (inverse["true"][:, :4] - 1.0).abs().max() < 0.01
    recovered = tokens.compute(views(6, 1.0), views(0, 1.0), ("far",))["far"][..., 0]
    assert (recovered > 0).float().mean() > 0.2 and (recovered[recovered > 0] - 1.0).abs().median() < 0.05


def test_rates_and_paired_differences_are_over_episodes():
    outcomes = {"rgb": -1, "sensor": 0, "far": 1, "true": 1}
    runs = [{"condition": c, "outcome": [o] * 10 + [1] * 10} for c, o in outcomes.items() for _ in range(3)]
    summary = loop.summarise(runs)
    assert summary["rates"]["far"]["success"]["value"] == 1.0 and summary["rates"]["rgb"]["wrong_ball"] == 0.5
    assert summary["rates"]["sensor"]["neither"] == 0.5 and summary["rates"]["sensor"]["by_seed"] == [0.5] * 3
    gain = summary["differences"]["far - sensor"]
    assert gain["n"] == 20 and 0.2 < gain["low"] < gain["value"] == 0.5 < gain["high"] < 0.8
