"""Parts of an alignment: references on a map's pixels, models of its error and the choice among them, and its noise."""

import math
from functools import partial
from statistics import mean

import pytest
import torch
from torch.nn.functional import avg_pool2d, max_pool2d

from dhtorch.alignment import error_model, references
from dhtorch.alignment.align import _HeldOut, _one_standard_error_choice
from dhtorch.alignment.error_model import ERROR_MODELS, MODEL_HEADS, AlignmentProblem, ErrorModelFit
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS as OPTIONS
from dhtorch.alignment.references import ERROR_BLOCKS, MetricReferences, local_spread, sample_at_references
from dhtorch.alignment.residual_noise import residual_variance
from dhtorch.codes import Gate, Source
from dhtorch.records import DepthMap, Estimate, Samples

double = partial(torch.tensor, dtype=torch.float64)
close = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-12)


def metric_references(place, x, near, *, within=0.0, var=1e-4):
    """References (1, N) without error whose depth is the value of the map."""
    one = torch.ones_like(x)
    return MetricReferences(place, x, within * one, x, var * one, 0 * one, near, one > 0)


# ------------------------------------------------------------------------------------------------ references on a map

HW = (40, 80)


def near(uv, depth=2.0, sigma=0.01):
    """Near returns at pixels (N, 2)."""
    uv, zero = torch.as_tensor(uv)[None].float(), torch.zeros(1, len(uv))
    xyz = torch.cat((torch.zeros(1, uv.shape[1], 2), zero[..., None] + depth), -1)
    return Samples(uv, zero + depth, zero + sigma, xyz, zero + 1, zero.int(), zero + 1, zero.int())


def far(uv, gate=Gate.ANSWER):
    """Far answers at pixels (N, 2): 4 m, with a sigma of 0.2 m, of which 0.1 m is shared."""
    silent = Estimate.unanswered(near(uv, 4.0), gate, n_views=2)
    full = torch.full_like(silent.score, 4.0)
    return silent.replace(depth=full, sigma=0.05 * full, sigma_shared=0.025 * full)


def test_references_have_the_values_of_a_maps_pixels_and_errors_of_their_own_and_shared():
    x = torch.arange(20 * 40).double().view(1, 20, 40)  # half as large as the image
    found = references.collect_references(x, [near([[0, 0], [79, 39], [41, 20]]), far([[3, 2]])], HW)
    close(found.share[0, 1], double([79.5 / 80, 39.5 / 40]))
    assert found.x[0].tolist() == [0, 19 * 40 + 39, 10 * 40 + 20, 1 * 40 + 1]
    assert found.near[0].tolist() == [True, True, True, False] and found.used.all()
    own, beside = OPTIONS.min_return_error**2, OPTIONS.far_own_error**2
    close(found.var[0], double([0.005**2 + own] * 3 + [0.05**2 - 0.025**2 + own + beside]))
    close(found.shared[0], double([0.0] * 3 + [math.hypot(0.025, OPTIONS.far_shared_error)]))


def test_silent_and_misplaced_references_are_unused_and_those_of_a_block_count_less():
    x = torch.ones(1, *HW).double().index_put_((*torch.tensor([[0], [5], [5]]),), double(torch.nan))
    points = [near([[5, 5], [6, 5], [200, 5]]), far([[3, 2]], Gate.RESIDUAL)]
    assert references.collect_references(x, points, HW).used[0].tolist() == [False, True, False, False]
    found = references.collect_references(x, [near([[0, 0], [1, 1], [60, 30]]), far([[2, 2]])], HW)
    assert found.block[0].tolist() == [1, 1, 2 * (4 * 8 + 6) + 1, 0]
    together = 1 / (1 + OPTIONS.block_correlation)
    close(found.weight(found.used)[0], double([together, together, 1, 1]))
    assert found.weight(found.used & torch.tensor([[True, False, True, False]]))[0].tolist() == [1, 0, 1, 0]


def test_pixels_of_a_map_are_references_whose_far_half_of_the_error_is_shared():
    one = torch.full((1, 2, 4), 4.0)
    source = torch.tensor([[[Source.SENSOR] * 4, [Source.SWEPT] * 4]]).int()
    other = DepthMap(one, 0.4 * one / 4, one, source, torch.zeros_like(source))
    found = references.collect_references(torch.arange(8.0).double().view(1, 2, 4), [other], (2, 4))
    assert found.x[0].tolist() == list(range(8)) and found.near[0].tolist() == [True] * 4 + [False] * 4
    assert found.share[0, 5].tolist() == [1.5 / 4, 1.5 / 2]
    shared = math.hypot(0.1 * OPTIONS.map_shared_ratio**0.5, OPTIONS.far_shared_error)
    assert float(found.shared[0, 7]) == pytest.approx(shared)


def test_of_many_references_some_from_all_over_are_used():
    uv = torch.stack(torch.meshgrid(torch.arange(80), torch.arange(40), indexing="xy"), -1).flatten(0, 1)
    found = references.collect_references(torch.ones(1, *HW).double(), [near(uv)], HW)
    assert found.x.shape == (1, OPTIONS.max_references_per_source)
    assert float(found.share[0, 0, 1]) < 0.05 and float(found.share[0, -1, 1]) > 0.95


def test_spread_of_a_map_around_a_pixel():
    """Evenly up to the next pixel on either side: a slope of s per pixel has standard deviation s / √3."""
    ramp = torch.arange(6.0).double().expand(1, 4, 6) * 0.3
    close(local_spread(ramp)[0, :, 1:-1], torch.full((4, 4), 0.3 / 3**0.5).double())
    found = local_spread(torch.where(torch.arange(6) == 3, torch.nan, ramp))
    assert found.isfinite().all() and float(found[0, 0, 2]) == pytest.approx(0.3 / 6**0.5), "a step to no value is none"


# ---------------------------------------------------------------------------------------------------- models of error


@pytest.fixture
def points():
    g = torch.Generator().manual_seed(0)
    place = torch.rand(1, 40, 2, generator=g, dtype=torch.float64)
    x = 1 + 3 * torch.rand(1, 40, generator=g, dtype=torch.float64)
    return metric_references(place, x, x > 0, within=0.1)


def basis(of_depth=True):
    x = torch.linspace(1, 4, 48, dtype=torch.float64).view(1, 6, 8)
    return error_model.make_basis(x, x > 0, of_depth=of_depth)


def problem(points, head=(1.0, 0.0)):
    heads = double([[head]]).expand(1, len(MODEL_HEADS), 2)
    return AlignmentProblem(points, basis(), heads, points.x[:, :1])


def models(*names):
    return torch.tensor([[list(ERROR_MODELS).index(name) for name in names]])


@pytest.mark.parametrize("of_depth", [True, False])
def test_a_head_gives_depth_or_its_inverse(of_depth):
    x, head = double([0.5, 2.0, -9.0]), double([2.0, 1.0])
    log, slope = error_model.predict_log_depth(head, x, basis(of_depth))
    close(log, double([2.0, 5.0, OPTIONS.min_head]).log() * (1 if of_depth else -1))
    exact = torch.func.jacrev(lambda h: error_model.predict_log_depth(h, x, basis(of_depth))[0])(head)
    close(slope[:2], exact[:2])


def test_a_map_of_one_value_has_a_correction_too():
    flat = torch.full((1, 6, 8), 2.0, dtype=torch.float64)
    found = error_model.make_basis(flat, flat > 0)
    assert found.width.tolist() == [[1.0]]
    assert error_model.evaluate_curves(found, torch.full((1, 3), 2.0).double()).isfinite().all()


def test_short_fields_are_those_of_near_neighbours():
    where = double([[[0.5, 0.5], [0.6, 0.5], [0.9, 0.9]]])
    found = error_model.evaluate_fields(basis(), where, torch.tensor([[False, True]]))
    assert found.shape[:3] == (1, 2, 3)
    close(found[0, :, :, :2], (2 * where - 1).expand(2, -1, -1))
    kernel = found[0, :, :, error_model.N_TILT_SLOPES :] @ found[0, :, :, error_model.N_TILT_SLOPES :].mT
    torch.testing.assert_close(kernel.diagonal(dim1=-2, dim2=-1), torch.ones(2, 3).double(), atol=0.1, rtol=0)
    assert kernel[0, 0, 1] > kernel[1, 0, 1] > kernel[1, 0, 2] and kernel[0, 0, 2] > kernel[1, 0, 2]


def test_the_uncertainty_of_a_fit_is_carried_to_the_references(points):
    size = error_model.N_TILT_SLOPES + len(basis().node) + error_model.N_CURVE_KNOTS
    head, one = double([[[1.5, 0.2]]]), torch.ones(1, 1, 2, dtype=torch.float64)
    spread = torch.diag_embed(torch.cat((double([0.03, 0.05]), torch.zeros(size).double())))[None, None]
    fit = ErrorModelFit(models("affine"), head, torch.zeros(1, 1, size).double(), spread, one, 0 * one[..., 0])
    mean, var = error_model.predict_references(fit, problem(points, (1.5, 0.2)))
    y = 1.5 * points.x + 0.2
    close(mean[0], y.log())
    close(var[0], ((0.03 * points.x) ** 2 + 0.05**2) / y**2)
    close(error_model.placement_variance(head, points)[0], (0.1 * 1.5 / y) ** 2)


def test_the_variance_between_nodes_is_part_of_that_of_a_field():
    """Nodes and what they do not hold make up the variance that a model states, at nodes and between them."""
    names, of = ["raw", "raw_tilt", "scale_long_4", "raw_short_4"], basis()
    between = torch.rand(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    where = torch.cat((of.node / of.aspect, between))[None]
    field = error_model.evaluate_fields(of, where, torch.tensor([[ERROR_MODELS[name].short for name in names]]))
    found = error_model.interpolation_variance(models(*names), field)[0]
    assert (found[:2] == 0).all() and found[2].sqrt().max() < 2e-4
    assert found[3, : len(of.node)].sqrt().max() < 2e-4 and found[3, len(of.node) :].sqrt().mean() > 2e-3
    held = 0.04**2 * field[0, 3, :, error_model.N_TILT_SLOPES :].square().sum(-1)
    torch.testing.assert_close(held + found[3], torch.full_like(held, 0.04**2), rtol=1e-4, atol=0)


@pytest.mark.parametrize("is_near", [True, False])
def test_noise_of_absent_references_is_the_stated_one_and_freedom_is_that_of_near_ones(points, is_near):
    kept = torch.full_like(points.near, is_near)
    alone = points._replace(near=kept)
    noise = error_model.fit_models(problem(alone), models("raw"), alone.used).noise[0, 0]
    assert noise[int(is_near)] == 1, "near answers, far ones"
    off = alone._replace(depth=torch.where(torch.arange(40) < 4, 1.1, 1.0) * points.depth)
    fit = partial(error_model.fit_models, problem(off), models("scale"), off.used)
    few, many = (fit(freedom=double([freedom])).head for freedom in (2.0, 200.0))
    assert torch.equal(few, many) is not is_near


def test_far_answers_lean_together_and_near_returns_do_not(points):
    is_far = torch.arange(40)[None] % 2 == 0
    lean = error_model.motion_error_basis(points._replace(near=~is_far, shared=torch.where(is_far, 0.05, 0.0).double()))
    assert lean.shape == (1, 40, error_model.N_MOTION_ERRORS) and (lean[~is_far] == 0).all()
    close(lean[is_far][:, 0], torch.full((20,), 0.05).double())
    assert (lean[is_far].abs().amax(0) > 0.02).all() and lean.abs().max() <= 3 * 0.05


# ------------------------------------------------------------------------------------------------ choice among models

RAW, SCALE, SHIFT, AFFINE, DRIFT = range(5)


@pytest.fixture(scope="module")
def choice():
    """Index of the model that is selected under residuals (5 models, N) of near and of far references, four of each in
    every block of the image."""
    rows, columns = ERROR_BLOCKS
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    cell = torch.stack(((u + 0.5) / columns, (v + 0.5) / rows), -1).flatten(0, 1).double()
    place = cell.repeat(8, 1)[None]
    near = (torch.arange(place.shape[1]) < place.shape[1] // 2)[None]
    points = metric_references(place, torch.ones_like(place[..., 0]), near)

    def select(draw, of_near, of_far, each_near=1, each_far=1):
        """Residuals are a draw of each reference times a size of each model; None = it could not be fitted."""
        noise = torch.randn(max(each_near, each_far), near.shape[1], generator=draw, dtype=torch.float64)
        sizes = ([double([x or torch.nan]) for x in of] for of in (of_near, of_far))
        a, b = (torch.stack(x) * noise[:n] for x, n in zip(sizes, (each_near, each_far), strict=True))
        r = torch.where(near, a, b)[None, :, None]
        held_out = _HeldOut(r, torch.full_like(r, 1e-4))
        return int(_one_standard_error_choice(points, held_out, list(MODEL_HEADS), torch.tensor([AFFINE]), OPTIONS))

    return select


SOUND, BAD = (0.02, 0.03, 0.1, 0.1, 0.1), (0.1, 0.1, 0.01, 0.1, 0.1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("near", "far", "expected"),
    [
        ((0.01, 0.01, 0.01, 0.01, 0.01), (0.02, 0.02, 0.02, 0.02, 0.02), [RAW]),
        ((0.1, 0.01, 0.01, 0.01, 0.01), (0.1, 0.02, 0.02, 0.02, 0.02), [SCALE]),
        ((0.1, 0.1, 0.01, 0.01, 0.01), (0.1, 0.1, 0.02, 0.02, 0.02), [SHIFT]),
        ((0.1, 0.1, 0.1, 0.01, 0.01), (0.1, 0.1, 0.1, 0.02, 0.02), [AFFINE]),
        ((0.1, 0.1, 0.1, 0.1, 0.01), (0.2, 0.2, 0.2, 0.2, 0.02), [DRIFT]),
        # An affine head and a drift that near returns alone ask for would be wrong farther away.
        ((0.03, 0.03, 0.03, 0.01, 0.008), (0.02, 0.02, 0.02, 0.1, 0.1), [RAW]),
        ((0.03, 0.03, 0.03, 0.01, 0.008), (0.1, 0.1, 0.1, 0.02, 0.1), [AFFINE]),
        # The metre is the near returns'. A shift tells the far part otherwise than the near one, alone or with a scale.
        (BAD, SOUND, [RAW, SCALE, AFFINE, DRIFT]),
        (BAD, (0.1, 0.1, 0.02, 0.1, 0.1), [SHIFT]),
        ((0.1, 0.01, 0.01, 0.1, 0.1), SOUND, [SCALE]),
        ((None, 0.01, 0.01, 0.01, 0.01), (None, 0.02, 0.02, 0.02, 0.02), [SCALE]),
        ((0.1, 0.1, 0.1, 0.1, None), (0.1, 0.1, 0.1, 0.1, None), [RAW]),
    ],
)
def test_the_simplest_model_that_near_and_far_references_bear_out_is_selected(choice, near, far, expected, seed):
    assert choice(torch.Generator().manual_seed(seed), near, far) in expected


def test_a_shift_that_near_returns_meet_exactly_is_not_refuted_by_one_standard_error(choice):
    """Far answers that happen to tell it a little worse outweigh returns which a line merely tells better."""
    draw, sizes = torch.Generator().manual_seed(0), (0.020, 0.020, 0.1, 0.023, 0.1)
    exact, noisy = (
        sum(choice(draw, (0.1, 0.1, 0.1, met, 0.1), sizes, 1, 5) == AFFINE for _ in range(40)) for met in (0.0005, 0.01)
    )
    assert exact > noisy + 5


# ------------------------------------------------------------------------------------------- noise from pixel to pixel

V, U = torch.meshgrid(*(torch.linspace(0, 1, k, dtype=torch.float64) for k in (60, 80)), indexing="ij")

#: Log depth (1, h, w) of a floor and a box before it; of a wall that is a little bent, so that it hardly matters where
#: in its pixel a return is.
BOX = ((U > 0.3) & (U < 0.6) & (V > 0.3) & (V < 0.7))[None]
ROOM, WALL = torch.where(BOX, 0.2, 1.2 - 0.5 * V), 0.5 + 0.02 * (U + 0.5 * (3 * V).sin())[None]
BLURRED = avg_pool2d(ROOM[:, None], 9, 1, 4, count_include_pad=False)[:, 0]
EDGE = (max_pool2d(BOX[:, None].double(), 5, 1, 2) + max_pool2d(-BOX[:, None].double(), 5, 1, 2))[:, 0] > 0.5
EDGE_NOISE = torch.where(EDGE, 0.01, 0.003).double()


def sigma(log, truth, n=500, seed=0, noise=0.0, stated=0.0, returns=True):
    """Sigma of a map by its near returns; noise is a number, or that of each pixel (1, h, w)."""
    g = torch.Generator().manual_seed(seed)
    place = torch.rand(len(log), n, 2, generator=g, dtype=torch.float64)
    r = sample_at_references(truth, place)[0] - sample_at_references(log, place)[0]
    noise = sample_at_references(torch.as_tensor(noise).double().expand_as(log), place)[0]
    r = r + noise * torch.randn(r.shape, generator=g, dtype=torch.float64)
    one = torch.ones_like(r)
    points = metric_references(place, one, one > (0 if returns else 1), var=stated**2 + OPTIONS.min_return_error**2)
    within = sample_at_references(local_spread(log), place)[0].square()
    return residual_variance(points, r, (within, 0 * one), log, torch.ones_like(log, dtype=torch.bool)).sqrt()


def white(seed):
    return torch.randn(ROOM.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def wave(seed):
    return 2 * torch.sin(6 * U + seed) * torch.sin(6 * V)[None]


def middle(log, truth, mask=None, **options):
    found = sigma(log, truth, **options)
    return float((found if mask is None else found[mask]).median())


@pytest.mark.parametrize(
    ("of_return", "of_map", "shape", "stated", "expected"),
    [
        (0.005, 0.0, white, 0.01, 0.0),
        (0.005, 0.005, white, 0.01, 0.005),
        (0.005, 0.003, white, 0.01, 0.003),
        (0.0, 0.005, white, 0.01, 0.005),
        (0.005, 0.005, wave, 0.01, 0.005),
        (0.005, 0.003, wave, 0.01, 0.003),
        (0.005, 0.0, white, 0.002, (0.005**2 - 0.002**2) ** 0.5),
    ],
)
def test_noise_of_returns_is_separated_from_that_of_the_map(of_return, of_map, shape, stated, expected):
    """Residuals of noisy returns and of a wrong map are alike: what is wrong with a map makes it uneven from pixel to
    pixel, or is the same a little way off. Returns are not believed to be worse than they say."""
    for seed in range(4):
        off = of_map * (white(10 + seed) if shape is white else wave(seed))
        assert abs(middle(WALL + off, WALL, seed=seed, noise=of_return, stated=stated) - expected) < 0.0015


@pytest.mark.parametrize("level", [0.01, 0.05])
def test_noise_of_the_map_is_found(level):
    noise = level * white(2)
    assert 0.6 < (noise.abs() <= sigma(ROOM + noise, ROOM)).double().mean() < 0.85


@pytest.mark.parametrize("seed", range(4))
def test_an_error_that_nearest_returns_share_is_the_maps(seed):
    """An error that turns sign within an eighth of the image is alike at neighbours alone."""
    off = 0.005 * 2**0.5 * torch.sin(25 * U)
    assert 0.0035 < middle(WALL + off, WALL, seed=seed, stated=0.01) < 0.006


def test_sigma_is_where_the_map_is_wrong():
    assert sigma(ROOM, ROOM).max() < 1e-3
    moved = sigma(torch.where(BOX, ROOM + 0.4, ROOM), ROOM)
    assert moved[BOX].median() > 0.2 and moved[~BOX].median() < 0.02
    found, off = sigma(BLURRED, ROOM), (BLURRED - ROOM).abs()
    assert found[off > 0.1].median() > 5 * found[off < 0.005].median()
    assert (off <= 2 * found).double().mean() > 0.9
    none = sigma(ROOM, ROOM, returns=False)
    close(none.amin(), double(OPTIONS.default_residual), rtol=0.2)


def test_few_returns_do_not_show_that_a_map_is_exact_and_chance_is_no_error_of_it():
    """Products of independent residuals do not sum to zero; what chance makes of them is no error."""
    few, many = (middle(WALL, WALL, n=n, noise=0.005, stated=0.01) for n in (12, 500))
    assert few > 3 * many
    found = [middle(WALL, WALL, n=250, seed=seed, noise=0.006, stated=0.01) for seed in range(20)]
    assert mean(found) < 0.0009 and sum(level < 0.00055 for level in found) >= 9


def test_returns_that_are_noisier_at_edges_are_not_the_maps():
    """A map that is right is right at its edges, whatever a sensor makes of them; one that is blurred there is not."""
    right = [middle(ROOM, ROOM, EDGE, seed=seed, noise=EDGE_NOISE, stated=0.01) for seed in range(6)]
    off = (BLURRED - ROOM).abs() > 0.1
    wrong = [middle(BLURRED, ROOM, off, seed=seed, noise=EDGE_NOISE, stated=0.01) for seed in range(6)]
    assert sorted(right)[3] < 0.003 and min(wrong) > 0.05
