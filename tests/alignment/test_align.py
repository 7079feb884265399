"""A map of anybody's in metres: its faults taken out as far as references tell, alone where they do not, and honest."""

import pytest
import torch

from dhtorch import align_depth
from dhtorch.alignment.error_model import estimate_freedom
from dhtorch.alignment.references import collect_references
from dhtorch.codes import Gate, Source
from dhtorch.experiments.compare import align_study
from dhtorch.records import DepthMap, Estimate, Samples
from dhtorch.synthetic import depth_faults

HW = (48, 64)


def world(batch=1, n=400, dtype=torch.float64, noise=0.003, seed=0):
    """A true map, returns where it is nearer than two metres, and answers everywhere else."""
    g = torch.Generator().manual_seed(seed)
    v, u = torch.meshgrid(torch.linspace(0, 1, HW[0]), torch.linspace(0, 1, HW[1]), indexing="ij")
    truth = (1 + 3 * (1 - v) + 0.5 * (4 * u).sin()).to(dtype).expand(batch, -1, -1).contiguous()
    uv = (torch.rand(batch, n, 2, generator=g) * torch.tensor([HW[1] - 1.0, HW[0] - 1.0])).to(dtype)
    at = (uv[..., 1].round() * HW[1] + uv[..., 0].round()).long()
    z = truth.flatten(1).gather(1, at)
    z = z * (1 + noise * torch.randn(batch, n, generator=g).to(dtype))
    zero, near = torch.zeros_like(z), z < 2
    xyz = torch.where(near[..., None], torch.stack((z, z, z), -1), torch.nan)
    code = torch.zeros_like(z, dtype=torch.int32)
    samples = Samples(uv, torch.where(near, z, 0.0), 0.01 * z, xyz, zero + 1, code, zero, code)
    gate = torch.where(near, Gate.NO_TRACK, Gate.ANSWER).to(torch.int32)
    far = Estimate(uv, z, 0.02 * z, 0.01 * z, zero + 5, zero, code + 2, zero + 0.5, gate)
    return truth, samples, far


def error(found, truth):
    return float(((found.depth - truth).abs() / truth)[found.keep].median())


@pytest.mark.parametrize(
    "name",
    [
        "scale_short",
        pytest.param("shift", marks=pytest.mark.slow),
        "tilt",
        pytest.param("simulated", marks=pytest.mark.slow),
    ],
)
def test_faults_are_taken_out(name):
    truth, near, far = world()
    x, _ = depth_faults.apply_fault(name, truth)
    found = align_depth(x, [near, far])
    assert found.keep.all() and (found.source == Source.ALIGNED).all()
    assert error(found, truth) < 0.015 < ((x - truth).abs() / truth).median()
    if name in ("scale_short", "shift"):  # a slope that goes with depth is not told from a scale by few returns
        assert ((found.depth - truth).abs() <= 2 * found.sigma).double().mean() > 0.9


@pytest.mark.parametrize(("drawn", "expected"), [("normal", 30.0), ("cauchy", 1.0), ("half wrong", 1.0)])
def test_tails_of_returns_are_found(drawn, expected):
    truth, near, _ = world(batch=2, n=800)
    points = collect_references(truth, [near], HW)
    g = torch.Generator().manual_seed(1)
    r = 0.004 * torch.randn(points.x.shape, generator=g, dtype=torch.float64)
    if drawn == "cauchy":
        r = r / torch.randn(r.shape, generator=g, dtype=torch.float64)
    if drawn == "half wrong":
        r = torch.where(torch.rand(r.shape, generator=g) < 0.4, r + 0.5, r)
    assert estimate_freedom(r, points).tolist() == [expected, expected]


def test_a_map_that_is_right_is_left_alone():
    truth, near, far = world()
    trace = {}
    found = align_depth(truth, [near, far], trace=trace)
    assert trace["chosen"].names[int(trace["chosen"].model)] == "raw"
    assert torch.allclose(found.depth, truth)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize(
    ("expected", "scale", "shift"),
    [("scale", 0.8, 0.0), pytest.param("shift", 1.0, -0.15, marks=pytest.mark.slow), ("shift", 1.0, 0.4)],
)
def test_one_number_that_is_missing_is_told_from_two(expected, scale, shift, seed):
    """A shift is one number, and returns of some noise tell it as well as a scale: to the noise over the root of their
    number, where a line through them is off by several times that beyond them."""
    truth, near, far = world(noise=0.006, seed=seed)
    trace = {}
    found = align_depth(scale * truth + shift, [near, far], trace=trace)
    assert trace["chosen"].names[int(trace["chosen"].model)] == expected
    assert error(found, truth) < 0.001


def drawn(low, high, seed):
    return low + (high - low) * torch.rand(1, 400, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def as_it_is(record):
    return record


def times(factor, where=True):
    return lambda record: record.replace(depth=torch.where(torch.as_tensor(where), factor * record.depth, record.depth))


def silent(record):
    return record.replace(gate=torch.full_like(record.gate, Gate.NO_BASELINE))


def blurred(near):
    """Returns of which nearly half are off as at blurred edges, the others exact."""
    edge = near.depth + torch.where(drawn(0, 1, 1) < 0.45, 0.25 * (1.6 - near.depth), 0.0)
    return near.replace(depth=torch.where(near.usable, edge, near.depth))


def few(far):
    gate = torch.where(torch.arange(400) % 20 > 0, Gate.NO_TRACK, far.gate)
    return far.replace(gate=gate.to(torch.int32))


@pytest.mark.parametrize(
    ("values", "kind", "near_change", "far_change", "limit"),
    [
        (lambda z: 7 * z, "scale", as_it_is, as_it_is, 0.01),
        (lambda z: 3 * z - 5, "affine", as_it_is, as_it_is, 0.01),
        (lambda z: 40 / z + 3, "inverse", as_it_is, as_it_is, 0.01),
        (lambda z: z.square(), "ordinal", as_it_is, as_it_is, 0.05),
        # nearly half of the returns, or a fifth of the far answers, may be wrong; near returns alone are enough
        (lambda z: 0.8 * z, "metric", times(drawn(1, 3, 4), drawn(0, 1, 3) < 0.4), as_it_is, 0.01),
        (lambda z: 0.8 * z, "metric", as_it_is, times(1.6, torch.arange(400) % 5 == 0), 0.01),
        (lambda z: 0.8 * z, "metric", as_it_is, silent, 0.01),
        # far answers that are all wrong alike do not move a map that near returns confirm
        *((lambda z: z, "metric", as_it_is, times(factor), 0.005) for factor in (0.9, 1.03, 1.1)),
        # nor is a map bent until its edges look better to blurred returns
        (lambda z: z, "metric", blurred, few, 0.005),
    ],
)
def test_maps_of_every_kind_are_aligned_in_spite_of_wrong_references(values, kind, near_change, far_change, limit):
    truth, near, far = world(noise=0.0 if near_change is blurred else 0.003)
    found = align_depth(values(truth), [near_change(near), far_change(far)], kind=kind)
    assert error(found, truth) < limit and found.keep.double().mean() > 0.9


@pytest.mark.parametrize("kind", ["scale", "affine", "inverse"])
def test_a_map_without_a_metre_is_not_left_alone_nor_shifted(kind):
    truth, near, far = world()
    trace = {}
    align_depth(truth, [near, far], kind=kind, trace=trace)
    names = trace["chosen"].names
    assert not any(name.startswith(("raw", "shift")) for name in names)
    assert any(name.startswith("scale") for name in names) == (kind == "scale")


@pytest.mark.parametrize(
    ("depth_map", "references", "options", "message"),
    [
        (torch.ones(1, *HW), None, {"kind": "depth"}, "expected one of metric"),
        (torch.ones(1, *HW), [], {}, "no references"),
        (torch.ones(HW), None, {}, "B h w"),
        (torch.ones(1, *HW), None, {"max_sigma_rel": 0}, "max_sigma_rel"),
    ],
)
def test_bad_input_is_named(depth_map, references, options, message):
    with pytest.raises(ValueError, match=message):
        align_depth(depth_map, world()[1] if references is None else references, **options)


def test_a_map_of_answers_is_an_anchor_too_and_samples_may_be_of_a_larger_picture():
    truth, near, _ = world()
    one = torch.full_like(truth, 0, dtype=torch.int32)
    swept = DepthMap(truth, 0.02 * truth, truth * 0 + 1, one + Source.SWEPT, one)
    assert error(align_depth(1.2 * truth, [near, swept]), truth) < 0.01
    larger = near.replace(uv=4 * near.uv + 1.5)
    small = align_depth(1.2 * truth, near)
    assert torch.allclose(align_depth(1.2 * truth, larger, hw=(4 * HW[0], 4 * HW[1])).depth, small.depth)


def test_silence():
    truth, near, far = world()
    x = truth.clone()
    x[:, :4] = torch.nan
    found = align_depth(x, [near, far])
    assert (found.gate[:, :4] == Gate.NO_TRACK).all() and found.depth[:, :4].isnan().all()
    none = near.replace(xyz=torch.full_like(near.xyz, torch.nan))
    lost = align_depth(truth, none)
    assert (lost.gate == Gate.NO_POSE).all() and (lost.score == 0).all() and lost.depth.isnan().all()


@pytest.mark.slow
def test_alone_as_in_a_batch_and_in_both_floats():
    truth, near, far = world(batch=2)
    x = depth_faults.tilt_depth(truth, 0.1, 0.5) * torch.tensor([1.0, 1.3]).view(2, 1, 1).double()
    both = align_depth(x, [near, far])
    for k in range(2):
        one = align_depth(x[k : k + 1], [near[k : k + 1], far[k : k + 1]])
        assert torch.allclose(one.depth, both.depth[k : k + 1], rtol=1e-9)
        assert torch.allclose(one.sigma, both.sigma[k : k + 1], rtol=1e-6)
    short = align_depth(x.float(), [near.to(torch.float32), far.to(torch.float32)])
    assert short.depth.dtype == torch.float32
    assert torch.allclose(short.depth.double(), both.depth, rtol=1e-4)


def test_gradients_reach_map_and_anchors():
    truth, near, far = world(n=120)
    x = (depth_faults.tilt_depth(truth, 0.1, 0.5)).requires_grad_()
    z = far.depth.clone().requires_grad_()
    found = align_depth(x, [near, far.replace(depth=z)])
    of_map, of_anchor = torch.autograd.grad(found.depth.nan_to_num().sum(), (x, z))
    assert of_map.isfinite().all() and of_anchor.isfinite().all()
    assert (of_map != 0).all() and (of_anchor[far.keep] != 0).double().mean() > 0.9
    one = torch.zeros_like(z)
    one[0, int(far.keep[0].nonzero()[3])] = 1
    for step in (torch.ones_like(z), one):
        moved = [
            align_depth(x.detach(), [near, far.replace(depth=z.detach() + k * 1e-5 * step)]).depth for k in (-1, 1)
        ]
        assert float((moved[1] - moved[0]).sum() / 2e-5) == pytest.approx(float((of_anchor * step).sum()), rel=1e-4)
    pixel = torch.zeros_like(x)
    pixel[0, 30, 20] = 1e-6
    moved = [align_depth(x.detach() + k * pixel, [near, far]).depth.sum() for k in (-1, 1)]
    assert float((moved[1] - moved[0]) / 2e-6) == pytest.approx(float(of_map[0, 30, 20]), rel=1e-4)


def test_what_has_an_order_keeps_it():
    truth, near, far = world()
    x = (truth + 0.3 * truth.sin()).exp().sqrt()
    found = align_depth(x, [near, far], kind="ordinal")
    order = x.flatten().argsort()
    assert (found.depth.flatten()[order].diff() >= 0).all()
    assert error(found, truth) < 0.05


def test_usual_fits():
    x = torch.linspace(1, 3, 40, dtype=torch.float64)
    assert align_study.fit_scale_shift(x, 2 * x + 0.5) == pytest.approx((2, 0.5))
    assert align_study.fit_median_scale(x, 2 * x) == (2, 0)
    z = 2 * x + 0.5
    z[::4] = 9
    assert align_study.fit_scale_shift_ransac(x, z) == pytest.approx((2, 0.5))


def test_summary_and_verdict_of_the_study():
    rows = [
        {"scene": "a", "truth": "simulated", "method": by, "median_rel": e, "within_sigma": 0.7, "within_2sigma": 0.95}
        for by, e in {"align": 0.01, "raw": 0.05, "near least squares": 0.04}.items()
    ]
    found = align_study.summarise_alignment(rows, ["simulated"])
    assert found["align.ratio_to_near_affine"]["value"] == pytest.approx(0.25)
    assert found["align.worst_ratio_to_better"]["value"] == pytest.approx(0.2)
    assert align_study.verdict(found) == (True, "5 of 5 bars met")
    assert align_study.verdict({})[0] is None


@pytest.mark.parametrize("left", [2, 7])
def test_a_handful_of_anchors_is_no_answer(left):
    truth, near, _ = world()
    first = near.usable & (near.usable.cumsum(-1) <= left)
    some = near.replace(xyz=torch.where(first[..., None], near.xyz, torch.nan))
    assert (align_depth(truth, some).gate == Gate.NO_POSE).all()


def test_anchors_that_are_all_wrong_are_no_reason_to_be_sure():
    truth, near, far = world()
    g = torch.Generator().manual_seed(5)
    factor = (2 * torch.rand(near.depth.shape, generator=g) - 1).mul(0.7).exp()
    found = align_depth(truth, [near.replace(depth=near.depth * factor), far.replace(depth=far.depth * factor)])
    kept = found.keep
    assert not kept.any() or float((found.sigma / found.depth)[kept].median()) > 0.1


def test_a_power_that_near_returns_do_not_refute_is_part_of_sigma():
    """Near returns of some noise tell a bent map no better by a power than by a line; exact ones refute the power."""
    truth, near, _ = world(noise=0.005)
    bent = 2 * (truth / 2) ** 0.85
    found = align_depth(bent, near)
    assert ((found.depth - truth).abs() <= 2 * found.sigma).double().mean() > 0.95
    truth, near, _ = world(noise=0.0)
    found = align_depth(1.1 * truth + 0.2, near)
    assert float((found.sigma / found.depth).median()) < 0.01 and error(found, truth) < 0.01


def test_numbers_with_one_scene_left_out():
    rows = [
        {"scene": scene, "truth": "simulated", "method": by, "median_rel": e * k, "within_sigma": 0.7 + 0.01 * k}
        | {"within_2sigma": 0.95}
        for k, scene in enumerate("abc", 1)
        for by, e in {"align": 0.01, "raw": 0.05, "near least squares": 0.04}.items()
    ]
    found = align_study.leave_one_scene_out(rows, ["simulated"])["align.within_sigma_one_left_out"]
    assert [found[k] for k in ("value", "low", "high")] == pytest.approx([0.72, 0.715, 0.725])
    assert not align_study.leave_one_scene_out(rows[:3], ["simulated"])


def test_disparity_may_have_zeros_and_holes():
    truth, near, far = world()
    x = 40 / truth - 40 / truth.max()
    x[:, :, :3] = torch.nan
    found = align_depth(x, [near, far], kind="inverse")
    assert (found.gate[:, :, :3] == Gate.NO_TRACK).all() and (x == 0).any()
    assert found.keep[:, :, 3:].double().mean() > 0.99 and error(found, truth) < 0.01


@pytest.mark.parametrize("kind", ["metric", "scale"])
def test_what_is_not_positive_is_no_depth(kind):
    depth, samples, _ = world()
    given = depth.clone()
    given[0, :5, :7], given[0, 5, :7] = 0.0, -1.0
    found = align_depth(given, [samples], kind=kind, hw=tuple(depth.shape[-2:]))
    assert (found.gate[0, :6, :7] == Gate.NO_TRACK).all() and (found.gate[0, 6:] != Gate.NO_TRACK).all()


def test_a_pixel_that_is_not_sure_enough_is_silent():
    truth, near, far = world()
    x, _ = depth_faults.apply_fault("simulated", truth)
    plain = align_depth(x, [near, far])
    rel = plain.sigma / plain.depth
    limit = float(rel.quantile(0.5)) * (1 + 1e-6)
    found = align_depth(x, [near, far], max_sigma_rel=limit)
    assert torch.equal(found.gate == Gate.UNCERTAIN, rel > limit) and 0.3 < (rel > limit).double().mean() < 0.7
    assert ((found.gate == Gate.UNCERTAIN) | found.keep).all() and found.depth[~found.keep].isnan().all()


@pytest.mark.parametrize("kind", ["scale", "affine", "inverse"])
def test_the_unit_of_a_map_without_one_changes_nothing(kind):
    """References between unlike pixels are as uncertain as their surroundings differ, in any unit of the map."""
    truth, samples, far = world(noise=0.003)
    rough = truth * (1 + 0.1 * torch.rand(1, *HW, generator=torch.Generator().manual_seed(1), dtype=truth.dtype))
    values = 1 / rough if kind == "inverse" else rough
    plain, large = (align_depth(factor * values, [samples, far], kind=kind) for factor in (1.0, 1000.0))
    assert plain.keep.any()
    torch.testing.assert_close(large.depth, plain.depth, rtol=1e-6, atol=0, equal_nan=True)
    torch.testing.assert_close(large.sigma, plain.sigma, rtol=1e-6, atol=0, equal_nan=True)
