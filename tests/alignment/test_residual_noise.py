"""How far an aligned map is off from pixel to pixel: only as far as near returns show it, and where they do."""

import math

import pytest
import torch

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.alignment.references import MetricReferences, local_spread, sample_at_references
from dhtorch.alignment.residual_noise import (
    _edge_gain,
    _local_deviation,
    _local_variance,
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


def test_smooth_errors_have_the_length_of_the_shorter_field():
    assert OPTIONS.map_correlation_length == 0.13
    assert AlignmentOptions(field_lengths=(0.4, 0.2)).map_correlation_length == 0.2


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


@pytest.mark.parametrize(("goes_with", "kept"), [(1.0, 0.5), (-1.0, 0.5), (0.0, 0.0)])
def test_less_than_returns_state_is_the_maps_where_it_goes_with_its_edges(goes_with, kept):
    """Along with how the map stands out of its surroundings, or against it; what goes with neither is the returns', in
    most draws. Exact returns have nothing by themselves."""
    found = []
    for seed in range(12):
        g = torch.Generator().manual_seed(seed)
        stands, noise = 0.01 * torch.randn(2, 1, 300, generator=g, dtype=torch.float64)
        one = torch.ones_like(stands)
        points, *_ = seen(wall(), wall(), n=300, seed=seed)
        r = goes_with * stands + (1 - abs(goes_with)) * noise
        of_map, levels = (stands, 0.01 * one, points.of_block), (0.001 * one[:, :1], 0.5 * one[:, :1])
        found.append(float(_edge_gain(r, of_map, levels, one > 0, 0.01**2 * one[:, :1], OPTIONS)))
        assert float(_edge_gain(r, of_map, levels, one > 0, 0 * one[:, :1], OPTIONS)) == pytest.approx(0.5)
    assert sorted(found)[6] == pytest.approx(kept, abs=0.02)


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


def test_alone_as_in_a_batch():
    truth, box = room()
    log = torch.cat((torch.where(box, truth + 0.4, truth), 2 * truth + 1))
    both = sigma(log, log + 0.01 * truth)
    points, r, told = seen(log, log + 0.01 * truth)
    for k in range(2):
        one = MetricReferences(*(part[k : k + 1] for part in points))
        told_one = (told[0][k : k + 1], told[1][k : k + 1])
        alone = residual_variance(
            one, r[k : k + 1], told_one, log[k : k + 1], torch.ones_like(log[:1], dtype=torch.bool)
        )
        assert torch.allclose(alone.sqrt(), both[k : k + 1], rtol=1e-9)


def test_a_flat_map_stands_out_nowhere_not_even_beside_its_holes_and_borders():
    flat = torch.full((1, *HW), 2.0, dtype=torch.float64)
    known = torch.ones_like(flat, dtype=torch.bool)
    known[:, 20:30, :40], known[:, ::7, ::5] = False, False
    out = _local_deviation(torch.where(known, flat, torch.nan), known, OPTIONS)
    assert out[known].abs().max() < 1e-12


def test_what_is_off_in_one_place_is_no_doubt_in_another():
    log, _ = room()
    flat = torch.zeros_like(log)
    share = 0.1 * torch.rand(1, 50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    one = torch.ones(1, 50, dtype=torch.float64)
    found = _local_variance(share, 0 * one, (one, one > 0), flat, torch.ones_like(flat, dtype=torch.bool), OPTIONS)[0]
    assert found[2, 3] > 0.9 and found[:3, 22:].max() < 0.01 and found[-10:].max() < 0.01


def test_local_variance_is_that_of_kernels_at_nodes_between_which_a_pixel_is_interpolated():
    """By plain loops, for some pixels: nodes from border to border and from the least depth to the largest."""
    g = torch.Generator().manual_seed(0)
    h, w, n = 24, 40, 200
    log = torch.rand(1, h, w, generator=g, dtype=torch.float64)
    share, log_at, excess = (torch.rand(1, n, *k, generator=g, dtype=torch.float64) for k in ((2,), (), ()))
    used = torch.rand(1, n, generator=g) < 0.7
    found = _local_variance(share, log_at, (excess, used), log, torch.ones_like(log, dtype=torch.bool), OPTIONS)[0]
    low, high = float(log.min()), float(log.max())
    width, height = w / max(h, w), h / max(h, w)
    depth_step = max((high - low) / (OPTIONS.n_depth_bins - 1), OPTIONS.depth_kernel_width)

    def nodes(side):
        count = max(3, round(2 * side / OPTIONS.place_kernel_width))
        return [side * k / (count - 1) for k in range(count)]

    def between(at, places):
        k = min(max(sum(p <= at for p in places) - 1, 0), len(places) - 2)
        part = (at - places[k]) / (places[k + 1] - places[k])
        return [(places[k], 1 - part), (places[k + 1], part)]

    def bell(distance, length):
        return math.exp(-0.5 * (distance / length) ** 2)

    depths = [low + (high - low) * k / (OPTIONS.n_depth_bins - 1) for k in range(OPTIONS.n_depth_bins)]
    for row, column in ((3, 5), (12, 30), (20, 11)):
        mass = total = 0.0
        for x, of_x in between((column + 0.5) / w * width, nodes(width)):
            for y, of_y in between((row + 0.5) / h * height, nodes(height)):
                for z, of_z in between(float(log[0, row, column]), depths):
                    for i in range(n):
                        kernel = of_x * of_y * of_z * bell(float(log_at[0, i]) - z, depth_step) * bool(used[0, i])
                        kernel *= bell(float(share[0, i, 0]) * width - x, OPTIONS.place_kernel_width)
                        kernel *= bell(float(share[0, i, 1]) * height - y, OPTIONS.place_kernel_width)
                        mass, total = mass + kernel, total + kernel * float(excess[0, i])
        assert float(found[row, column]) == pytest.approx(total / (mass + OPTIONS.empty_kernel_weight), rel=1e-4)
