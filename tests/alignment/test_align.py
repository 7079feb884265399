"""Any depth map in metres: its faults are removed as far as references show them, and the rest is in its sigma."""

from types import SimpleNamespace

import pytest
import torch

from dhtorch import align_depth
from dhtorch.alignment.error_model import estimate_freedom
from dhtorch.alignment.map_family import MAP_FAMILIES, find_map_family, least_absolute_line
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.alignment.references import MetricReferences, collect_references
from dhtorch.codes import Gate, Source
from dhtorch.experiments.compare import align_study
from dhtorch.records import DepthMap, Estimate, Samples
from dhtorch.synthetic import depth_faults
from dhtorch.synthetic.recording import SyntheticRoom

HW = (48, 64)
DEPTH, DISPARITY, Z_BUFFER = range(3)


def world(batch=1, n=400, dtype=torch.float64, noise=0.003, seed=0):
    """A true map, returns where it is nearer than two metres, and answers everywhere else."""
    g = torch.Generator().manual_seed(seed)
    v, u = torch.meshgrid(torch.linspace(0, 1, HW[0]), torch.linspace(0, 1, HW[1]), indexing="ij")
    truth = (1 + 3 * (1 - v) + 0.5 * (4 * u).sin()).to(dtype).expand(batch, -1, -1).contiguous()
    uv = (torch.rand(batch, n, 2, generator=g) * torch.tensor([HW[1] - 1.0, HW[0] - 1.0])).to(dtype)
    at = (uv[..., 1].round() * HW[1] + uv[..., 0].round()).long()
    z = truth.flatten(1).gather(1, at)
    z = z * (1 + noise * torch.randn(batch, n, generator=g).to(dtype))
    near, zero, code = z < 2, torch.zeros_like(z), torch.zeros_like(z, dtype=torch.int32)
    xyz = torch.where(near[..., None], torch.stack((z, z, z), -1), torch.nan)
    samples = Samples(uv, torch.where(near, z, 0.0), 0.01 * z, xyz, zero + 1, code, zero, code)
    gate = torch.where(near, Gate.NO_TRACK, Gate.ANSWER).to(torch.int32)
    return truth, samples, Estimate(uv, z, 0.02 * z, 0.01 * z, zero + 5, zero, code + 2, zero + 0.5, gate)


@pytest.fixture(scope="module")
def room():
    """Depth of the built-in room, and near returns at random pixels with the noise of a sensor."""
    truth = SyntheticRoom(n_frames=2, hw=(96, 128), depth_hw=(96, 128), supersample=1).truth(0)["depth"].double()
    g = torch.Generator().manual_seed(0)
    uv = torch.rand(1, 500, 2, generator=g) * torch.tensor([127.0, 95.0])
    z = truth[0][uv[0, :, 1].round().long(), uv[0, :, 0].round().long()][None].float()
    z = z * (1 + 0.003 * torch.randn(z.shape, generator=g))
    zero, code = torch.zeros_like(z), torch.zeros_like(z, dtype=torch.int32)
    return truth, Samples(uv, z, 0.01 * z, torch.stack((z, z, z), -1), zero + 1, code, zero, code), None


def aligned(scene, values, references=lambda near, far: [near, far], **options):
    """Answer for a map of the true one, with all that is judged of it."""
    (truth, near, far), trace = scene, {}
    x = values(truth)
    found = align_depth(x, references(near, far), trace=trace, **options)
    off, chosen = (found.depth - truth).abs(), trace.get("chosen")
    return SimpleNamespace(
        found=found,
        truth=truth,
        x=x,
        chosen=chosen,
        names=[] if chosen is None else chosen.names,
        name=None if chosen is None else chosen.names[int(chosen.model)] if int(chosen.model) >= 0 else "none",
        error=float((off / truth)[found.keep].median()) if found.keep.any() else torch.nan,
        before=float(((x - truth).abs() / truth).median()),
        rel=found.sigma / found.depth,
        within_2sigma=float((off <= 2 * found.sigma).double().mean()),
    )


def fault(name):
    return lambda z: depth_faults.apply_fault(name, z)[0]


def z_buffer(near, far):
    return lambda z: far / (far - near) * (1 - near / z)


def filled(*places):
    """Change of a map: values in rows and columns."""

    def change(z):
        z = z.clone()
        for value, rows, columns in places:
            z[:, rows, columns] = value
        return z

    return change


def drawn(low, high, seed):
    return low + (high - low) * torch.rand(1, 400, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def times(factor, where=True):
    return lambda record: record.replace(depth=torch.where(torch.as_tensor(where), factor * record.depth, record.depth))


def blurred(near, far):
    """Returns of which nearly half are off as at blurred edges, the others exact; few answers."""
    edge = near.depth + torch.where(drawn(0, 1, 1) < 0.45, 0.25 * (1.6 - near.depth), 0.0)
    gate = torch.where(torch.arange(400) % 20 > 0, Gate.NO_TRACK, far.gate).to(torch.int32)
    return [near.replace(depth=torch.where(near.usable, edge, near.depth)), far.replace(gate=gate)]


def first(n):
    """The first returns alone."""
    used = lambda near: near.usable & (near.usable.cumsum(-1) <= n)  # noqa: E731
    return lambda near, far: near.replace(xyz=torch.where(used(near)[..., None], near.xyz, torch.nan))


def swept(near, far):
    depth, one = world()[0], torch.zeros(1, *HW, dtype=torch.int32)
    return [near, DepthMap(depth, 0.02 * depth, depth * 0 + 1, one + Source.SWEPT, one)]


def gross(near, far):
    g = torch.Generator().manual_seed(5)
    factor = times((2 * torch.rand(near.depth.shape, generator=g) - 1).mul(0.7).exp())
    return [factor(near), factor(far)]


def both(near, far):
    return [near, far]


def alone(near, far):
    return near


def below(limit):
    return lambda a: (a.error < limit, a.found.keep.double().mean() > 0.9)


def removed(a):
    return a.found.keep.all(), (a.found.source == Source.ALIGNED).all(), a.error < 0.015 < a.before


def selected(name):
    return lambda a: (a.name == name, a.error < 0.001)


def unscaled(kind):
    return lambda a: (
        not any(name.startswith(("raw", "shift")) for name in a.names),
        any(name.startswith("scale") for name in a.names) == (kind == "scale"),
    )


def silent(gate, rows, columns):
    """What holds: nothing is answered there, all is elsewhere."""

    def check(a):
        there = torch.zeros_like(a.found.gate, dtype=torch.bool)
        there[:, rows, columns] = True
        elsewhere = a.found.gate[~there] != gate
        return (a.found.gate[there] == gate).all(), a.found.depth[there].isnan().all(), elsewhere.all()

    return check


def refused(a):
    return (a.found.gate == Gate.NO_POSE).all(), (a.found.score == 0).all(), a.found.depth.isnan().all()


def family_named(name):
    return lambda a: (*refused(a), MAP_FAMILIES[int(a.chosen.family)] == name, a.chosen.model.tolist() == [-1])


EVERY, SOME, FEW_ROWS = slice(None), slice(3), slice(4)

#: Case -> (values of the map, references, options of the world and of the alignment, what holds); S: a slow test.
S = pytest.mark.slow
CASES = {
    # A slope that goes with depth is not told from a scale by few returns: sigma is not judged there.
    "scale_short": (fault("scale_short"), both, {}, lambda a: (*removed(a), a.within_2sigma > 0.9)),
    "shift": (fault("shift"), both, {}, lambda a: (*removed(a), a.within_2sigma > 0.9), S),
    "tilt": (fault("tilt"), both, {}, removed),
    "simulated": (fault("simulated"), both, {}, removed, S),
    "right": (lambda z: z, both, {}, lambda a: (a.name == "raw", torch.allclose(a.found.depth, a.truth))),
    # A shift is one number, and returns of some noise tell it as well as a scale.
    **{
        f"{name} {scale} {shift} {seed}": (
            lambda z, a=scale, b=shift: a * z + b, both, {"noise": 0.006, "seed": seed}, selected(name),
            *[S] * (seed > 0 or shift < 0),
        )
        for name, scale, shift in (("scale", 0.8, 0.0), ("shift", 1.0, -0.15), ("shift", 1.0, 0.4))
        for seed in range(3)
    },
    "of scale": (lambda z: 7 * z, both, {"kind": "scale"}, below(0.01)),
    "affine": (lambda z: 3 * z - 5, both, {"kind": "affine"}, below(0.01)),
    "inverse": (lambda z: 40 / z + 3, both, {"kind": "inverse"}, below(0.01)),
    "ordinal": (lambda z: z.square(), both, {"kind": "ordinal"}, below(0.05)),
    # Nearly half of the returns, or a fifth of the far answers, may be wrong; near returns alone are enough.
    "wrong near": (
        lambda z: 0.8 * z, lambda near, far: [times(drawn(1, 3, 4), drawn(0, 1, 3) < 0.4)(near), far], {}, below(0.01)),
    "wrong far": (
        lambda z: 0.8 * z, lambda near, far: [near, times(1.6, torch.arange(400) % 5 == 0)(far)], {}, below(0.01)),
    "silent far": (
        lambda z: 0.8 * z, lambda near, far: [near, far.replace(gate=far.gate * 0 + Gate.NO_BASELINE)], {}, below(0.01)),
    # Far answers that are all wrong alike do not move a map that near returns confirm.
    **{
        f"far times {x}": (lambda z: z, lambda near, far, x=x: [near, times(x)(far)], {}, below(0.005))
        for x in (0.9, 1.03, 1.1)
    },
    "bent to edges": (lambda z: z, blurred, {"noise": 0.0}, below(0.005)),
    **{f"no metre {k}": (lambda z: z, both, {"kind": k}, unscaled(k)) for k in ("scale", "affine", "inverse")},
    "swept": (lambda z: 1.2 * z, swept, {}, below(0.01)),
    "larger image": (
        lambda z: 1.2 * z, lambda near, far: near.replace(uv=4 * near.uv + 1.5), {"hw": (4 * HW[0], 4 * HW[1])},
        lambda a: (torch.allclose(a.found.depth, align_depth(a.x, world()[1]).depth),)),
    "holes": (filled((torch.nan, FEW_ROWS, EVERY)), both, {}, silent(Gate.NO_TRACK, FEW_ROWS, EVERY)),
    **{
        f"not positive {kind}": (
            filled((0.0, slice(5), slice(7)), (-1.0, 5, slice(7))), alone, {"kind": kind, "hw": HW},
            silent(Gate.NO_TRACK, slice(6), slice(7)))
        for kind in ("metric", "scale")
    },
    "disparity with zeros": (
        lambda z: filled((torch.nan, EVERY, SOME))(40 / z - 40 / z.max()), both, {"kind": "inverse"},
        lambda a: (
            (a.found.gate[:, :, SOME] == Gate.NO_TRACK).all(), (a.x == 0).any(),
            a.found.keep[:, :, 3:].double().mean() > 0.99, a.error < 0.01)),
    **{f"{n} returns": (lambda z: z, first(n), {}, refused) for n in (0, 2, 7)},
    "order": (
        lambda z: (z + 0.3 * z.sin()).exp().sqrt(), both, {"kind": "ordinal"},
        lambda a: (a.error < 0.05, (a.found.depth.flatten()[a.x.flatten().argsort()].diff() >= 0).all())),
    "all wrong": (
        lambda z: z, gross, {}, lambda a: (not a.found.keep.any() or float(a.rel[a.found.keep].median()) > 0.1,)),
    # Near returns of some noise tell a bent map no better by a power than by a line; exact ones refute the power.
    "power": (lambda z: 2 * (z / 2) ** 0.85, alone, {"noise": 0.005}, lambda a: (a.within_2sigma > 0.95,)),
    "no power": (
        lambda z: 1.1 * z + 0.2, alone, {"noise": 0.0}, lambda a: (float(a.rel.median()) < 0.01, a.error < 0.01)),
}  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(case[:4], id=name, marks=case[4:]) for name, case in CASES.items()])
def test_maps_are_aligned_as_far_as_references_tell(case):
    values, references, options, check = case
    options = dict(options)
    scene = world(**{name: options.pop(name) for name in ("noise", "seed") if name in options})
    conditions = check(aligned(scene, values, references, **options))
    assert all(conditions), conditions


#: The same in the built-in room. Every third planted fault runs; the others with the slow tests.
ROOM_CASES = {
    **{
        f"{name} {kind}": (change, kind, family_named(name), S)
        for name, change in (("z-buffer", z_buffer(0.01, 50.0)), ("disparity", lambda z: 1 / z))
        for kind in ("metric", "scale", "affine")
    },
    "stated disparity": (
        lambda z: 40 / z + 3, "inverse", lambda a: (a.found.keep.all(), a.error < 0.005, a.chosen.family is None)),
    **{
        name: (fault(name) if k else lambda z: z, "metric", lambda a: (a.chosen.family.tolist() == [DEPTH],),
               *[S] * (k % 3 > 0))
        for k, name in enumerate(["none", *depth_faults.DEPTH_FAULTS])
    },
}  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(case[:3], id=name, marks=case[3:]) for name, case in ROOM_CASES.items()])
def test_maps_that_are_no_depth_are_named_and_no_fault_of_depth_is(room, case):
    values, kind, check = case
    conditions = check(aligned(room, values, alone, kind=kind))
    assert all(conditions), conditions


RISING = [
    lambda z: z,
    lambda z: 0.2 * z,
    lambda z: 1.4 * z - 0.3,
    lambda z: z**1.5,
    lambda z: z**0.6,
    lambda z: z.log(),
]
LINES = [lambda z, a=a, b=b: a / z + b for a, b in ((1.0, 0.0), (300.0, 20.0), (0.2, 0.5))]
BUFFERS = [z_buffer(*planes) for planes in ((0.01, 50.0), (0.1, 100.0), (0.5, 5.0))]


@pytest.mark.parametrize(
    ("changes", "families", "noise", "narrow", "n_near"),
    [
        *(([x], [Z_BUFFER], noise, 1, 400) for x in BUFFERS for noise in (0.0, 0.005, 0.01)),
        *(([x], [DISPARITY], noise, 1, 400) for x in LINES for noise in (0.0, 0.005, 0.01)),
        *(([x], [DEPTH], noise, 1, 400) for x in RISING for noise in (0.0, 0.01, 0.05)),
        (LINES[:1], [DEPTH], 0.005, 0.01, 400),  # a line describes it to the noise of the returns
        (LINES[:1], [DEPTH], 0.0, 0.01, 400),  # and to 1e-5, far below the least error
        (LINES[:1], [DEPTH], 0.0, 1, 40),
        ([RISING[0], LINES[0], BUFFERS[0]], [DEPTH, DISPARITY, Z_BUFFER], 0.0, 1, 400),
    ],
)
def test_family_of_a_map(changes, families, noise, narrow, n_near):
    depth = 1 + 1.5 * torch.rand(1, 400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth = depth if narrow == 1 else 1.5 + narrow * depth
    x, depth = torch.cat([change(depth) for change in changes]), depth.expand(len(changes), -1)
    g = torch.Generator().manual_seed(0)
    place, one = torch.rand(*x.shape, 2, generator=g, dtype=torch.float64), torch.ones_like(x)
    measured = depth * (1 + noise * torch.randn(x.shape, generator=g, dtype=torch.float64))
    near = (torch.arange(400) < n_near).expand(x.shape)
    points = MetricReferences(place, x, 0 * one, measured, 1e-4 * one, 0 * one, near, one > 0)
    assert find_map_family(points).tolist() == families


def test_a_line_of_least_absolute_error_passes_by_gross_outliers():
    x = torch.linspace(0, 1, 41, dtype=torch.float64)[None]
    y = torch.where(torch.arange(41) % 6 == 5, 0.5, 1.0) * (2 * x + 1)  # 6 of 41
    line, ok = least_absolute_line(x, y, torch.ones_like(x), DEFAULT_ALIGNMENT_OPTIONS)
    assert ok.all() and torch.allclose(line, torch.tensor([[2.0, 1.0]], dtype=torch.float64), atol=0.05)


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


@pytest.mark.slow
def test_alone_as_in_a_batch_and_in_both_floats():
    truth, near, far = world(batch=2)
    x = depth_faults.tilt_depth(truth, 0.1, 0.5) * torch.tensor([1.0, 1.3]).view(2, 1, 1).double()
    batch = align_depth(x, [near, far])
    for k in (slice(0, 1), slice(1, 2)):
        one = align_depth(x[k], [near[k], far[k]])
        torch.testing.assert_close((one.depth, one.sigma), (batch.depth[k], batch.sigma[k]), rtol=1e-6, atol=0)
    short = align_depth(x.float(), [near.to(torch.float32), far.to(torch.float32)])
    assert short.depth.dtype == torch.float32
    assert torch.allclose(short.depth.double(), batch.depth, rtol=1e-4)


def test_gradients_reach_map_and_references():
    truth, near, far = world(n=120)
    x, z = depth_faults.tilt_depth(truth, 0.1, 0.5).requires_grad_(), far.depth.clone().requires_grad_()

    def total(x, z):
        return align_depth(x, [near, far.replace(depth=z)]).depth.nan_to_num().sum()

    of_map, of_far = torch.autograd.grad(total(x, z), (x, z))
    assert of_map.isfinite().all() and of_far.isfinite().all()
    assert (of_map != 0).all() and (of_far[far.keep] != 0).double().mean() > 0.9
    one, pixel = torch.zeros_like(z), torch.zeros_like(x)
    one[0, int(far.keep[0].nonzero()[3])] = pixel[0, 30, 20] = 1
    for dx, dz in ((0 * pixel, torch.ones_like(z)), (0 * pixel, one), (pixel, 0 * one)):
        h = 1e-5 if dx.sum() == 0 else 1e-6
        numeric = (total(x + h * dx, z + h * dz) - total(x - h * dx, z - h * dz)).detach() / (2 * h)
        assert float(numeric) == pytest.approx(float((of_map * dx).sum() + (of_far * dz).sum()), rel=1e-4)


def test_a_pixel_that_is_not_sure_enough_is_silent():
    a = aligned(world(), fault("simulated"))
    limit = float(a.rel.quantile(0.5)) * (1 + 1e-6)
    found = aligned(world(), fault("simulated"), max_sigma_rel=limit).found
    assert torch.equal(found.gate == Gate.UNCERTAIN, a.rel > limit) and 0.3 < (a.rel > limit).double().mean() < 0.7
    assert ((found.gate == Gate.UNCERTAIN) | found.keep).all() and found.depth[~found.keep].isnan().all()


@pytest.mark.parametrize("kind", ["scale", "affine", "inverse"])
def test_the_unit_of_a_map_without_one_changes_nothing(kind):
    """References between unlike pixels are as uncertain as their surroundings differ, in any unit of the map."""
    rough = 1 + 0.1 * torch.rand(1, *HW, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    power = -1 if kind == "inverse" else 1
    plain, large = (aligned(world(), lambda z, x=x: x * (z * rough) ** power, kind=kind).found for x in (1.0, 1000.0))
    assert plain.keep.any()
    torch.testing.assert_close(
        (large.depth, large.sigma), (plain.depth, plain.sigma), rtol=1e-6, atol=0, equal_nan=True
    )


def test_fits_and_numbers_of_the_study():
    x = torch.linspace(1, 3, 40, dtype=torch.float64)
    wrong = torch.where(torch.arange(40) % 4 == 0, 9.0, 2 * x + 0.5)
    assert align_study.fit_scale_shift(x, 2 * x + 0.5) == pytest.approx((2, 0.5))
    assert align_study.fit_median_scale(x, 2 * x) == (2, 0)
    assert align_study.fit_scale_shift_ransac(x, wrong) == pytest.approx((2, 0.5))
    rows = [
        {"scene": scene, "truth": "simulated", "method": by, "median_rel": e * k, "within_sigma": 0.7 + 0.01 * (k - 1)}
        | {"within_2sigma": 0.95}
        for k, scene in enumerate("abc", 1)
        for by, e in {"align": 0.01, "raw": 0.05, "near least squares": 0.04}.items()
    ]
    found = align_study.summarise_alignment(rows[:3], ["simulated"])
    assert found["align.ratio_to_near_affine"]["value"] == pytest.approx(0.25)
    assert found["align.worst_ratio_to_better"]["value"] == pytest.approx(0.2)
    assert align_study.verdict(found) == (True, "5 of 5 bars met") and align_study.verdict({})[0] is None
    left_out = align_study.leave_one_scene_out(rows, ["simulated"])["align.within_sigma_one_left_out"]
    assert [left_out[k] for k in ("value", "low", "high")] == pytest.approx([0.71, 0.705, 0.715])
    assert not align_study.leave_one_scene_out(rows[:3], ["simulated"])
