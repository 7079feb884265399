"""Calibrations of scores and sigmas: applied, and stored as JSON; fitted numbers: test_stored_answers.py."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from dhtorch.metrics import calibration, errors, monotone, reliability
from dhtorch.metrics.calibration import fitting


def scene_of(n, seed=0, spread=1.0, boast=1.0, floor=0.0):
    """Answers whose error is normal with a known relative sigma, and a score that falls with it; a fifth are silent."""
    g = torch.Generator().manual_seed(seed)
    rel = 0.02 + 0.3 * torch.rand(n, generator=g, dtype=torch.float64) ** 2
    true = 2 + 4 * torch.rand(n, generator=g, dtype=torch.float64)
    noise = ((spread * rel) ** 2 + floor**2).sqrt() * torch.randn(n, generator=g, dtype=torch.float64)
    depth = (true * (1 + noise)).clamp_min(0.01)
    keep = torch.rand(n, generator=g, dtype=torch.float64) >= 0.2
    return errors.make_points(depth, true, (0.1 / (0.1 + rel)) ** boast, sigma=rel * true, keep=keep)


def fitted(**provenance):
    note = {"method": "test", "scenes": ["a", "b"]} | provenance
    return fitting.fit_calibration([scene_of(800, s) for s in range(3)], provenance=note)


SILENT = errors.make_points(torch.full((4,), math.nan), torch.ones(4))


def test_a_calibration_is_applied_to_score_and_sigma():
    learnt, scene = fitted(), scene_of(50, 8)
    found = learnt.apply(scene)
    probability = np.interp(scene.score, learnt.probability.x, learnt.probability.y)
    sigma = torch.hypot(learnt.sigma.scale * scene.sigma, learnt.sigma.floor * scene.depth)
    assert found.score.tolist() == pytest.approx(np.where(scene.keep, probability, 0).tolist())
    assert found.sigma.tolist() == pytest.approx(sigma.tolist(), nan_ok=True)
    torch.testing.assert_close(found.depth, scene.depth, rtol=0, atol=0, equal_nan=True)
    assert dataclasses.replace(learnt, sigma=None).apply(scene).sigma is scene.sigma
    low = float(learnt.thresholds[10])
    assert learnt.min_score(10) == pytest.approx(float(np.interp(low, learnt.probability.x, learnt.probability.y)))
    silent = dataclasses.replace(learnt, thresholds={10: None})
    assert silent.min_score(10) is None
    with pytest.raises(KeyError):
        silent.min_score(5)


def test_an_overconfident_score_becomes_calibrated_in_scenes_that_were_not_fitted():
    learnt = fitting.fit_calibration([scene_of(4000, seed, boast=0.3) for seed in range(6)])
    fresh = [scene_of(4000, seed, boast=0.3) for seed in range(10, 16)]
    before, after = (reliability.measure_reliability(s)["ece"] for s in (fresh, [learnt.apply(s) for s in fresh]))
    assert before > 0.1 and after < 0.02


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"sigma": None, "thresholds": {10: None}},
        {"thresholds": {1: 0.5, 99: None}},
        {"probability": monotone.MonotoneTable(torch.tensor([0.25, 0.5, 3.0]).double(), torch.full((3,), 0.5).double())},
    ],
)  # fmt: skip
def test_a_stored_calibration_is_read_as_it_was_written(change, tmp_path):
    learnt = dataclasses.replace(fitted(truth="full"), **change)
    back = calibration.load_calibration(calibration.save_calibration(learnt, tmp_path / "sub" / "mine.json"))
    at = torch.linspace(-0.1, 1.1, 200, dtype=torch.float64)
    for name in ("probability", "expected_error", "sigmoid"):
        assert torch.equal(getattr(back, name)(at), getattr(learnt, name)(at)), name
    fields = lambda c: (c.sigma, c.thresholds, c.provenance, c.to_json())  # noqa: E731
    assert fields(back) == fields(learnt)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), 2, r"schema: found 2, expected 1"),
        (("good_error",), 0.2, r"good_error: found 0\.2, expected 0\.1"),
        (("probability",), None, r"probability: found nothing"),
        (("more",), 1, r"more: found an unknown field"),
        (("probability", "score"), [0.5, 0.2], r"probability\.value: found .* expected 2, one for each"),
        (("probability", "value", 0), 2.0, r"probability\.value: found .*expected rising numbers from 0"),
        (("expected_error", "value", 0), 0, r"expected_error\.value: found .*expected falling numbers"),
        (("expected_error", "value", 0), 1.5, r"expected_error\.value: found .*falling numbers from 0 to 1"),
        (("probability", "score", 1), -1.0, r"probability\.score: found .*expected rising"),
        (("probability", "score", 1), 0.0, r"probability\.score: found \[0\.0, 0\.0, .*expected rising"),
        (("probability", "score", 1), "0.1", r"probability\.score\.1: found 0\.1, expected a finite"),
        (("expected_error", "score"), [], r"expected_error\.score: found \[\], expected a list"),
        (("sigmoid", "slope"), True, r"sigmoid\.slope: found true"),
        (("sigma", "floor"), -1, r"sigma\.floor: found -1, expected a number of at least 0"),
        (("sigma", "scale"), 10**400, r"sigma\.scale: found 1000"),
        (("sigma",), {"scale": 1}, r"sigma\.floor: found nothing"),
        (("thresholds", "100"), 0.5, r"thresholds\.100: found 100, expected a whole number"),
        (("thresholds", "0"), 0.5, r"thresholds\.0: found 0, expected a whole number"),
        (("thresholds", "ten"), 0.5, r"thresholds\.ten: found ten, expected a whole number"),
        (("provenance",), [], r"provenance: found \[\], expected an object"),
        ((), b"", "file size: found 0 bytes"),
        ((), b"{", "found no strict JSON"),
        ((), b"[1]", r"found \[1\], expected an object"),
        ((), b"null", "found null, expected an object"),
        ((), b'{"schema": NaN}', "found no strict JSON"),
        ((), b'{"schema": 1, "x": "\xff"}', "found invalid start byte at byte 20, expected text in UTF-8"),
    ],
)
def test_a_damaged_calibration_is_refused_by_file_and_field(path, value, message, tmp_path):
    content = place = json.loads(fitted().to_json())
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    elif path:
        place[path[-1]] = value
    (tmp_path / "mine.json").write_bytes(json.dumps(content).encode() if path else value)
    with pytest.raises(ValueError, match=rf"mine\.json(\.|: ){message}"):
        calibration.load_calibration(tmp_path / "mine.json")


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (ValueError, "fit_calibration: found no answer", lambda: fitting.fit_calibration([])),
        (ValueError, "fit_calibration: found no answer", lambda: fitting.fit_calibration([SILENT])),
        (ValueError, r"provenance\.scenes, expected", lambda: calibration.save_calibration(fitted(scenes=[]), "mine.json")),
        (FileNotFoundError, "nobody: found no calibration, expected .*'map'", lambda: calibration.load_calibration("nobody")),
    ],
)  # fmt: skip
def test_calibrations_without_answers_origin_or_file(error, message, call):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize("name", calibration.list_calibrations())
def test_the_shipped_calibrations_are_valid(name):
    found = calibration.load_calibration(name)
    assert found.provenance["method"] and found.provenance["scenes"] and found.to_json()
    at = torch.linspace(0, 1, 50)
    assert torch.equal(calibration.load_probability(name)(at), found.probability(at))
