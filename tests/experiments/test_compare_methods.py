"""Ratios of methods over seeds and scenes; the numbers of a comparison are among the stored rows."""

import pytest
import torch

from dhtorch.experiments import compare_methods as compare
from dhtorch.metrics import errors


def scene_of(n, seed=0, spread=1.0, silent=0.2, boast=1.0, floor=0.0):
    """Answers whose error is normal with a known relative sigma, and a score that falls with it."""
    g = torch.Generator().manual_seed(seed)
    rel = 0.02 + 0.3 * torch.rand(n, generator=g, dtype=torch.float64) ** 2
    true = 2 + 4 * torch.rand(n, generator=g, dtype=torch.float64)
    noise = ((spread * rel) ** 2 + floor**2).sqrt() * torch.randn(n, generator=g, dtype=torch.float64)
    depth = (true * (1 + noise)).clamp_min(0.01)
    keep = torch.rand(n, generator=g, dtype=torch.float64) >= silent
    return errors.make_points(depth, true, (0.1 / (0.1 + rel)) ** boast, sigma=rel * true, keep=keep)


def small(scale, n=60, names="abc", seeds=2, **options):
    """Two seeds of three scenes, the seeds of different size, so that nothing is exchangeable."""
    return {
        name: [scene_of(n + 9 * k + 7 * seed, 10 * k + seed, spread=scale, **options) for seed in range(seeds)]
        for k, name in enumerate(names)
    }


def exact(n, error=0.0):
    return errors.make_points(torch.full((n,), 1 + error), torch.ones(n))


def median_rel(points):
    return errors.measure_errors(points)["median_rel"]


def defined_above(points):
    return None if float(points.depth[0]) < 1.4 else median_rel(points)


ENOUGH, FEW = [exact(20, 0.5), exact(20, 0.5), exact(3, 0.5)], [exact(19, 0.25), exact(19, 0.25), exact(90, 0.25)]


@pytest.mark.parametrize(
    ("ours", "theirs", "measure", "options", "ratio"),
    [
        (ENOUGH, ENOUGH, median_rel, {}, 1),  # the twentieth answer of the median seed counts
        (ENOUGH, FEW, median_rel, {}, None),
        (FEW, ENOUGH, median_rel, {}, None),
        (ENOUGH, FEW, median_rel, {"min_answers": 19}, 2),
        ([exact(30)], [exact(30, 0.5)], median_rel, {}, 2e-6),  # errors below a millionth count as one
        ([exact(30, 0.5)], [exact(30)], median_rel, {}, 5e5),
        ([exact(30)], [exact(30)], median_rel, {}, 1),
        (
            [exact(30, 0.5), exact(30, 0.25)],
            [exact(30, 0.5)] * 2,
            defined_above,
            {},
            1,
        ),  # seeds without it do not count
        ([exact(30, 0.5)], [exact(30, 0.5)], lambda _: None, {}, None),
    ],
)
def test_a_ratio_needs_twenty_answers_of_the_median_seed(ours, theirs, measure, options, ratio):
    found = compare.ratio_over_seeds({"a": ours}, {"a": theirs}, measure, **options)
    assert found == (({}, ["a"]) if ratio is None else ({"a": pytest.approx(ratio)}, []))


PAPER = small(1.0)


@pytest.mark.parametrize(
    ("methods", "sentence"),
    [
        ({}, "found no method, expected paper among them"),
        ({"map": PAPER}, r"compare\.reference: found map, expected paper"),
        ({"paper": PAPER, "map": {"b": PAPER["b"]}}, r"compare\.map\.a: found nothing, expected 2 seeds as paper"),
        ({"paper": PAPER, "map": PAPER | {"b": PAPER["b"][:1]}}, r"compare\.map\.b: found 1 seeds"),
        ({"paper": PAPER, "map": PAPER | {"z": PAPER["b"]}}, r"compare\.map\.z: found a scene"),
    ],
)
def test_methods_that_do_not_match_raise(methods, sentence):
    with pytest.raises(ValueError, match=sentence):
        compare.method_ratios(methods)
