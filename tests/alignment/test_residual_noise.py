"""How far an aligned map is off from pixel to pixel: only as far as near returns show it, and where they do."""

import pytest
import torch

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.alignment.references import MetricReferences, local_spread, sample_at_references
from dhtorch.alignment.residual_noise import (
    residual_variance,
)

HW = (60, 80)
OPTIONS = DEFAULT_ALIGNMENT_OPTIONS


def seen(log, truth, n=500, seed=0, noise=0.0, stated=0.0):
    """Near returns of a map: residuals, and what the map differs by within a pixel; noise is a number, or that of each
    pixel (1, h, w)."""
    g = torch.Generator().manual_seed(seed)
    share = torch.rand(len(log), n, 2, generator=g, dtype=torch.float64)
    r = sample_at_references(truth, share)[0] - sample_at_references(log, share)[0]
    if isinstance(noise, torch.Tensor):
        noise = sample_at_references(noise, share)[0]
    r = r + noise * torch.randn(r.shape, generator=g, dtype=torch.float64)
    one = torch.ones_like(r)
    points = MetricReferences(
        share, one, 0 * one, one, (stated**2 + OPTIONS.min_return_error**2) * one, 0 * one, one > 0, one > 0
    )
    return points, r, (sample_at_references(local_spread(log), share)[0].square(), 0 * one)


def room():
    """Log depth (1, h, w) of a floor and a box before it; True on the box."""
    v, u = torch.meshgrid(*(torch.linspace(0, 1, k, dtype=torch.float64) for k in HW), indexing="ij")
    box = (u > 0.3) & (u < 0.6) & (v > 0.3) & (v < 0.7)
    return torch.where(box, 0.2, 1.2 - 0.5 * v)[None], box[None]


def wall():
    """Log depth (1, h, w) of a wall that is a little bent, so that it hardly matters where in its pixel a return is."""
    v, u = torch.meshgrid(*(torch.linspace(0, 1, k, dtype=torch.float64) for k in HW), indexing="ij")
    return 0.5 + 0.02 * (u + 0.5 * (3 * v).sin())[None]


def sigma(log, truth, **options):
    return residual_variance(*seen(log, truth, **options), log, torch.ones_like(log, dtype=torch.bool)).sqrt()


def test_a_map_that_returns_follow_is_not_in_doubt():
    truth, _ = room()
    assert sigma(truth, truth).max() < 1e-3


def test_noise_of_the_map_is_found():
    truth, _ = room()
    for level in (0.01, 0.05):
        noise = level * torch.randn(truth.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        found = sigma(truth + noise, truth)
        within = (noise.abs() <= found).double().mean()
        assert 0.6 < within < 0.85


@pytest.mark.parametrize(
    ("of_return", "of_map", "smooth", "stated", "expected"),
    [
        (0.005, 0.0, False, 0.01, 0.0),
        (0.005, 0.005, False, 0.01, 0.005),
        (0.005, 0.003, False, 0.01, 0.003),
        (0.0, 0.005, False, 0.01, 0.005),
        (0.005, 0.005, True, 0.01, 0.005),
        (0.005, 0.003, True, 0.01, 0.003),
        (0.005, 0.0, False, 0.002, (0.005**2 - 0.002**2) ** 0.5),
    ],
)
def test_noise_that_returns_have_by_themselves_is_told_from_the_maps(of_return, of_map, smooth, stated, expected):
    """Residuals of noisy returns and of a wrong map are alike: what is wrong with a map makes it uneven from pixel to
    pixel, or is the same a little way off. Returns are not believed to be worse than they say."""
    v, u = torch.meshgrid(*(torch.linspace(0, 1, k, dtype=torch.float64) for k in HW), indexing="ij")
    truth = wall()
    for seed in range(4):
        draw = torch.Generator().manual_seed(10 + seed)
        off = torch.randn(truth.shape, generator=draw, dtype=torch.float64)
        if smooth:
            off = 2 * torch.sin(6 * u + seed) * torch.sin(6 * v)[None]
        found = sigma(truth + of_map * off, truth, seed=seed, noise=of_return, stated=stated)
        assert abs(float(found.median()) - expected) < 0.0015


def test_few_returns_do_not_show_that_a_map_is_exact():
    truth = wall()
    few = sigma(truth, truth, n=12, noise=0.005, stated=0.01)
    many = sigma(truth, truth, n=500, noise=0.005, stated=0.01)
    assert few.median() > 3 * many.median()


def test_chance_is_no_error_of_a_map():
    """Products of independent residuals do not sum to zero; what chance makes of them is no error."""
    truth = wall()
    found = [float(sigma(truth, truth, n=250, seed=seed, noise=0.006, stated=0.01).median()) for seed in range(20)]
    assert sum(found) / len(found) < 0.0009 and sum(level < 0.00055 for level in found) >= 9


@pytest.mark.parametrize("seed", range(4))
def test_what_the_nearest_returns_are_off_by_alike_is_the_maps(seed):
    """An error that turns sign within an eighth of the picture is alike at neighbours alone."""
    truth = wall()
    u = torch.linspace(0, 1, HW[1], dtype=torch.float64)
    off = 0.005 * 2**0.5 * torch.sin(25 * u).expand_as(truth)
    found = sigma(truth + off, truth, seed=seed, stated=0.01)
    assert 0.0035 < float(found.median()) < 0.006


def test_returns_that_are_noisier_at_edges_are_not_the_maps():
    """A map that is right is right at its edges, whatever a sensor makes of them; one that is blurred there is not."""
    truth, box = room()
    edge = torch.nn.functional.max_pool2d(box[:, None].double(), 5, 1, 2)[:, 0]
    edge = (edge + torch.nn.functional.max_pool2d(-box[:, None].double(), 5, 1, 2)[:, 0]) > 0.5
    noise = torch.where(edge, 0.01, 0.003).double()
    right = [sigma(truth, truth, seed=seed, noise=noise, stated=0.01)[edge].median() for seed in range(6)]
    blurred = torch.nn.functional.avg_pool2d(truth[:, None], 9, 1, 4, count_include_pad=False)[:, 0]
    off = (blurred - truth).abs() > 0.1
    wrong = [sigma(blurred, truth, seed=seed, noise=noise, stated=0.01)[off].median() for seed in range(6)]
    assert sorted(right)[3] < 0.003 and min(wrong) > 0.05


def test_an_object_that_was_moved_is_in_doubt_and_not_what_is_around_it():
    truth, box = room()
    found = sigma(torch.where(box, truth + 0.4, truth), truth)
    assert found[box].median() > 0.2
    assert found[~box].median() < 0.02


def test_blurred_edges_are_in_doubt():
    truth, _ = room()
    blurred = torch.nn.functional.avg_pool2d(truth[:, None], 9, 1, 4, count_include_pad=False)[:, 0]
    off = (blurred - truth).abs()
    found = sigma(blurred, truth)
    assert found[off > 0.1].median() > 5 * found[off < 0.005].median()
    assert (off <= 2 * found).double().mean() > 0.9


def test_without_near_returns_a_usual_map_is_meant():
    truth, _ = room()
    points, r, told = seen(truth, truth)
    none = points._replace(near=points.near & False)
    found = residual_variance(none, r, told, truth, torch.ones_like(truth, dtype=torch.bool)).sqrt()
    assert torch.allclose(found.amin(), torch.tensor(OPTIONS.default_residual, dtype=torch.float64), rtol=0.2)
