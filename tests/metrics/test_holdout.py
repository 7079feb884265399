"""The range split and the truth test: on maps whose answer is known by hand; many numbers at once: test_stored_answers.py."""

import math

import pytest
import torch

from dhtorch.codes import Flag
from dhtorch.metrics import holdout
from dhtorch.metrics.holdout import TruthCode
from dhtorch.records import Camera, Frame, Samples

OK, NONE, NEAR, CLOSE, WIDE = (getattr(TruthCode, n) for n in ("CANDIDATE", "NO_RETURN", "NEAR", "CLOSE", "WIDE"))
EXCLUDED, TEXTURE, HOLE = TruthCode.EXCLUDED, TruthCode.TEXTURE, TruthCode.REAL_HOLE


def frame_of(depth, hw=None, depth_camera=None, sparse=False):
    """A view with the depth map (h, w) or (B, h, w) and a grey image of size hw."""
    depth = depth if depth.dim() == 3 else depth[None]
    B, (h, w) = depth.shape[0], hw or depth.shape[-2:]
    camera = Camera(torch.full((B, 2), 50.0), torch.tensor([(w - 1) / 2, (h - 1) / 2]).expand(B, 2))
    about = torch.ones(B, dtype=torch.bool) if sparse else None
    return Frame(torch.full((B, 1, h, w), 0.5), depth, camera, depth_camera, sparse=about)


def at(*uv):
    return torch.tensor(uv, dtype=torch.float32)[None]


def samples_of(trackability, **fields):
    trackability = torch.as_tensor(trackability, dtype=torch.float64)
    zero = torch.zeros_like(trackability)
    code = zero.int()
    samples = Samples(
        torch.zeros(*zero.shape, 2), zero, zero, torch.zeros(*zero.shape, 3), zero, code, trackability, code
    )
    return samples.replace(**fields)


# ---------------------------------------------------------------------------------------------------- range split


@pytest.mark.parametrize(
    ("cutoff", "expected"),
    [(2.0, [[0.0, 1.0], [2.0, 0.0]]), (None, [[0.0, 1.0], [2.0, 2.5]]), (math.inf, [[0.0, 1.0], [2.0, 2.5]])],
)
def test_range_split_removes_what_lies_beyond_and_nothing_else(cutoff, expected):
    depth = torch.tensor([[[0.0, 1.0], [2.0, 2.5]]])
    assert holdout.range_split(frame_of(depth), cutoff).depth.tolist() == [expected]
    assert depth[0, 1, 1] == 2.5, "the full map is the truth and stays as it is"


# ---------------------------------------------------------------------------------------------------- truth test


def test_each_map_of_a_batch_is_sparse_or_dense_for_itself():
    depth = 3 + torch.rand(5, 40, 50, generator=torch.Generator().manual_seed(0)) * 0.3
    depth[depth < 3.02] = 0
    uv = torch.rand(5, 203, 2, generator=torch.Generator().manual_seed(1)) * 45
    mixed = torch.tensor([True, False, True, True, False])
    dense, sparse = (holdout.sample_truth(frame_of(depth, sparse=s), uv) for s in (False, True))
    found = holdout.sample_truth(frame_of(depth).replace(sparse=mixed), uv)
    for name in ("depth", "code"):
        one, other = getattr(dense, name), getattr(sparse, name)
        assert torch.equal(getattr(found, name), torch.where(mixed[:, None], other, one)) and not torch.equal(
            one, other
        )


@pytest.mark.parametrize(("apart", "limit", "rule"), [(1, 0.05, CLOSE), (7, 0.15, WIDE)])
@pytest.mark.parametrize("sparse", [False, True])
def test_a_spread_of_exactly_the_limit_fails_and_one_just_below_does_not(apart, limit, rule, sparse):
    high = 2 * (1 + limit)
    for z, code in ((high, rule), (math.nextafter(high, 0), OK)):
        depth = torch.full((40, 40), 0.0 if sparse else 2.0, dtype=torch.float64)
        depth[20, 20], depth[20, 20 + apart] = 2.0, z
        assert int(holdout.sample_truth(frame_of(depth, sparse=sparse), at((20, 20)).double()).code) == code


@pytest.mark.parametrize(
    ("sparse", "rule", "step", "options", "reach"),
    [
        (False, CLOSE, 1.06, {}, 2),
        (False, WIDE, 1.2, {}, 12),
        (True, CLOSE, 1.06, {}, 3),
        (True, WIDE, 1.2, {}, 7),
        (False, WIDE, 1.2, {"window": 35}, 17),
    ],
)
def test_the_windows_are_5_and_25_pixels_wide_and_7_and_15_where_returns_are_sparse(sparse, rule, step, options, reach):
    """How far from a sample a return can be that still rejects it."""
    far = 0
    for d in range(1, 25):
        depth = torch.full((60, 60), 0.0 if sparse else 2.0)
        depth[30, 30], depth[30 + d, 30] = 2.0, 2 * step
        code = int(holdout.sample_truth(frame_of(depth, sparse=sparse), at((30, 30)), **options).code)
        far = d if code == rule else far
    assert far == reach


STEP = torch.full((60, 80), 4.0)
STEP[30, 20], STEP[:, 60:], STEP[10, 40] = 0, 5.0, math.nan
RAMP = (100 + torch.arange(40.0)).expand(30, 40)
OWN = Camera(torch.tensor([[25.0, 25.0]]), torch.tensor([[10.0, 14.0]]))


@pytest.mark.parametrize(
    ("frame", "uv", "options", "depth", "code"),
    [
        # a window over the edge of the map lacks returns there
        (frame_of(STEP), at((1, 10), (2, 10), (57, 30), (-9, 5)), {}, [4, 4, 4, 0], [CLOSE, OK, WIDE, NONE]),
        # a map of another size is read by the exact scaling rule, one with its own camera along the ray
        (frame_of(RAMP[:8, :12], hw=(32, 48)), at(*((u, 15) for u in range(8, 16))), {"truth": "raw"}, [102] * 4 + [103] * 4, [OK] * 8),
        (frame_of(RAMP, hw=(60, 80), depth_camera=OWN), at((39.5, 29.5), (49.5, 29.5)), {"truth": "raw"}, [110, 115], [OK, OK]),
        (frame_of(STEP[:30, :30]), at((math.nan, 15), (5, 15)), {"truth": "raw"}, [0, 4], [NONE, OK]),
    ],
)  # fmt: skip
def test_truth_at_edges_and_through_other_cameras(frame, uv, options, depth, code):
    found = holdout.sample_truth(frame, uv, **options)
    assert (found.depth[0].tolist(), found.code[0].tolist()) == (depth, code)


# ---------------------------------------------------------------------------------------------------- candidates


@pytest.mark.parametrize(
    ("code", "depth", "trackability", "excluded", "options", "expected"),
    [
        # the first rule that rejects a sample names it; samples fail several rules at once
        ([NONE, CLOSE, CLOSE, WIDE, OK, OK], [0, 1, 3, 3, 3, 3], [0.1, 0.1, 1, 1, 1, 0.1], [1, 1, 1, 1, 1, 0], {}, [NONE, NEAR, CLOSE, WIDE, EXCLUDED, TEXTURE]),
        ([NONE, OK, OK, CLOSE, WIDE, OK, OK, CLOSE], [0, 1, 3, 3, 3, 3, 3, 2], [1, 1, 1, 1, 1, 0.19, 1, 1], [1, 0, 0, 0, 0, 0, 1, 0], {}, [NONE, NEAR, OK, CLOSE, WIDE, TEXTURE, EXCLUDED, NEAR]),
        # a return at the cutoff was not held back; texture at a fraction of the median is enough
        ([OK] * 4, [2, 2.5, 2.5, 2.5], [1, 0.25, 0.2499, 1], None, {"min_texture": 0.4}, [NEAR, OK, TEXTURE, OK]),
        ([OK] * 5, [3] * 5, [1, 0.2, 0.1999, 1, 1], None, {}, [OK, OK, TEXTURE, OK, OK]),
        ([OK] * 6, [5] * 6, [1, 2, 3, 4, 0.49, 100], None, {}, [OK] * 4 + [TEXTURE, OK]),
        ([OK] * 3, [1, 3, 1e9], [1] * 3, None, {"cutoff": None}, [NEAR] * 3),
    ],
)  # fmt: skip
def test_candidates_are_held_back_smooth_and_textured(code, depth, trackability, excluded, options, expected):
    truth = holdout.Truth(torch.tensor([depth]).double(), torch.tensor([code], dtype=torch.int32))
    mask = None if excluded is None else torch.tensor([excluded], dtype=torch.bool)
    found = holdout.select_candidates(samples_of([trackability]), truth, **{"cutoff": 2.0, **options}, excluded=mask)
    assert found.code[0].tolist() == expected and torch.equal(found.depth, truth.depth)
    assert found.dropped() == {
        name: expected.count(rule)
        for name, rule in {"close": CLOSE, "wide": WIDE, "excluded": EXCLUDED, "texture": TEXTURE}.items()
    }


SENSOR = torch.zeros(1, 40)
SENSOR[0, 5], SENSOR[0, 25] = 4.1, 1.5


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ([OK, OK, OK, EXCLUDED], [OK, HOLE, NEAR, EXCLUDED]),
        ([CLOSE] * 4, [CLOSE, HOLE, NEAR, HOLE]),
        ([TEXTURE] * 4, [TEXTURE, HOLE, NEAR, HOLE]),
        ([NONE, NEAR, NEAR, NONE], [NONE, NEAR, NEAR, NONE]),
    ],
)
def test_a_candidate_needs_a_masked_return_of_the_sensor(code, expected):
    """Truth of another instrument is 4 m everywhere; the sensor has a far return, none, a near one, and none."""
    truth = holdout.Truth(torch.full((1, 4), 4.0), torch.tensor([code], dtype=torch.int32))
    found = holdout.require_masked(truth, frame_of(SENSOR), at((5, 0), (15, 0), (25, 0), (35, 0)), 2.0)
    assert found.code[0].tolist() == expected and found.n_real_holes == expected.count(HOLE)
    assert found.code.dtype == torch.int32 and torch.equal(found.depth, truth.depth)


@pytest.mark.parametrize("sparse", [False, True])
def test_a_near_return_within_reach_of_a_sparse_sample_is_no_masked_return(sparse):
    sensor = torch.zeros(20, 40)
    sensor[10, 10], sensor[10, 12] = 2.05, 1.98  # the nearest lies beyond the cutoff, the next before it
    frame, uv = frame_of(sensor, sparse=sparse), at((10, 10))
    truth = holdout.select_candidates(samples_of([[1.0]]), holdout.sample_truth(frame, uv, truth="raw"), 2.0)
    assert bool(truth.ok.all())
    assert int(holdout.require_masked(truth, frame, uv, 2.0).code) == (NEAR if sparse else OK)


@pytest.mark.parametrize(("n", "dropped", "expected"), [(10, (1, 3, 2, 4), 1 - 4 / 20), (0, (0, 0, 0, 0), None)])
def test_the_fraction_that_the_truth_test_keeps(n, dropped, expected):
    counts = dict(zip(("close", "wide", "excluded", "texture"), dropped, strict=True))
    assert holdout.truth_kept_ratio(n, counts) == (None if expected is None else pytest.approx(expected))


# ---------------------------------------------------------------------------------------------------- halves


def whole_samples(n, batch=1, seed=0):
    """Samples whose fields are all different, some without a return, some that cannot be tracked."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *size: torch.rand(*size, generator=g, dtype=torch.float64)  # noqa: E731
    xyz = draw(batch, n, 3) + 1
    xyz[draw(batch, n) < 0.2] = math.nan
    flag = torch.randint(0, 2, (batch, n), generator=g, dtype=torch.int32) * Flag.SPECULAR
    flag = torch.where(xyz.isnan().any(-1), flag | Flag.NO_DEPTH, flag)
    trackability = torch.where(draw(batch, n) < 0.2, 1e-6, 1.0).double()
    depth = torch.where(xyz[..., 2].isnan(), 0.0, xyz[..., 2])
    return Samples(draw(batch, n, 2), depth, 0.1 * depth, xyz, draw(batch, n), flag, trackability, flag * 0 + 2)


@pytest.mark.parametrize(("options", "share"), [({}, 0.5), ({"share": 0.2}, 0.2), ({"share": 0.9}, 0.9)])
def test_a_split_assigns_every_usable_trackable_sample_to_one_of_two_sets(options, share):
    samples = whole_samples(4000)
    a, b = holdout.split_half(samples, 3, **options)
    usable = samples.xyz.isfinite().all(-1) & (samples.trackability >= 1e-5)
    assert torch.equal(a | b, usable) and not (a & b).any() and 0.5 < float(usable.double().mean()) < 0.7
    assert float(a.sum() / usable.sum()) == pytest.approx(share, abs=3 * math.sqrt(share * (1 - share) / 2560))
    assert not torch.equal(a, holdout.split_half(samples, 4, **options)[0])
    clean = whole_samples(300, batch=2).replace(xyz=torch.ones(2, 300, 3), trackability=torch.ones(2, 300))
    assert torch.equal(*holdout.split_half(clean, 3, **options)[0]), "by the index alone"


# ---------------------------------------------------------------------------------------------------- real holes


@pytest.mark.parametrize(
    ("true", "third", "options", "counts"),
    [
        (10.0, 11.0, {}, True),  # the median of three is 9
        (10.001, 11.0, {}, False),
        (9.0, 0.0, {}, False),
        (9.0, 0.0, {"min_returns": 2}, True),
        (9.0, 11.0, {"window": 5}, False),
    ],
)
def test_a_hole_counts_from_the_third_return_beside_it_and_up_to_a_tenth_of_a_difference(true, third, options, counts):
    depth = torch.zeros(20, 20, dtype=torch.float64)
    depth[10, 11], depth[11, 10], depth[13, 13] = 9.0, 9.0, third
    truth = holdout.Truth(torch.tensor([[true]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.int32))
    samples = samples_of([[1.0]], uv=at((10, 10)).double())
    assert bool(holdout.select_real_holes(frame_of(depth), samples, truth, **options).ok) == counts


@pytest.mark.parametrize("wrong", [-1.0, 0.0, math.nan, -math.inf])
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: holdout.range_split(frame_of(torch.ones(4, 4)), x), r"holdout\.cutoff: found .*expected a positive"),
        (lambda x: holdout.split_half(samples_of([[1.0]]), 0, share=x), r"holdout\.share: found .*between 0 and 1"),
        (lambda x: holdout.split_half(samples_of([[1.0]]), 0, share=1 - x), r"holdout\.share: found .*between 0 and 1"),
        (lambda x: holdout.sample_truth(frame_of(torch.ones(9, 9)), at((1, 1)), truth=x), r"holdout\.truth: found"),
    ],
)
def test_wrong_options_raise(call, message, wrong):
    with pytest.raises(ValueError, match=message):
        call(wrong)
