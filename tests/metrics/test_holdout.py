"""The range split and the truth test: on maps whose answer is known by hand, and against plain loops."""

import math
import os
import statistics
from pathlib import Path

import pytest
import torch

from dhtorch import data
from dhtorch.codes import Flag
from dhtorch.metrics import holdout
from dhtorch.metrics.holdout import TruthCode
from dhtorch.records import Camera, Frame, Samples

ROOT = os.environ.get("DHTORCH_DATA")


def frame_of(depth, hw=None, depth_camera=None, sparse=False):
    """A view with the depth map (h, w) or (B, h, w) and a grey image of size hw."""
    depth = depth if depth.dim() == 3 else depth[None]
    B, (h, w) = depth.shape[0], hw or depth.shape[-2:]
    camera = Camera(torch.full((B, 2), 50.0), torch.tensor([(w - 1) / 2, (h - 1) / 2]).expand(B, 2))
    about = torch.ones(B, dtype=torch.bool) if sparse else None
    return Frame(torch.full((B, 1, h, w), 0.5), depth, camera, depth_camera, sparse=about)


def at(*uv):
    return torch.tensor(uv, dtype=torch.float32)[None]


def samples_of(trackability):
    zero = torch.zeros_like(trackability)
    code = zero.int()
    return Samples(torch.zeros(*zero.shape, 2), zero, zero, torch.zeros(*zero.shape, 3), zero, code, trackability, code)


# ---------------------------------------------------------------------------------------------------- range split


def test_range_split_removes_what_lies_beyond_and_nothing_else():
    depth = torch.tensor([[[0.0, 1.0], [2.0, 2.5]]])
    near = holdout.range_split(frame_of(depth), 2.0)
    assert near.depth.tolist() == [[[0.0, 1.0], [2.0, 0.0]]]
    assert depth[0, 1, 1] == 2.5, "the full map is the truth and stays as it is"
    for nothing in (None, math.inf):
        assert torch.equal(holdout.range_split(frame_of(depth), nothing).depth, depth)


@pytest.mark.parametrize("cutoff", [-1.0, 0.0, math.nan, -math.inf])
def test_a_cutoff_that_is_no_distance_raises(cutoff):
    with pytest.raises(ValueError, match=r"holdout\.cutoff: found .*expected a positive number"):
        holdout.range_split(frame_of(torch.ones(4, 4)), cutoff)


# ---------------------------------------------------------------------------------------------------- truth test


def test_truth_rules_on_a_dense_map():
    depth = torch.full((60, 80), 4.0)
    depth[30, 20] = 0  # a missing pixel
    depth[:, 60:] = 5.0  # a step of 25 %
    depth[10, 40] = math.nan
    uv = at((10, 10), (20, 30), (22, 30), (23, 30), (57, 30), (58, 30), (47, 30), (48, 30), (-9, 5), (40, 10))
    truth = holdout.sample_truth(frame_of(depth), uv)
    ok, none, close, wide = TruthCode.CANDIDATE, TruthCode.NO_RETURN, TruthCode.CLOSE, TruthCode.WIDE
    # columns: smooth but (10,10) reaches over the map's edge only with its wide window, which asks valid pixels alone
    assert truth.code[0].tolist() == [ok, none, close, ok, wide, close, ok, wide, none, none]
    assert truth.depth[0].tolist() == [4, 0, 4, 4, 4, 4, 4, 4, 0, 0]
    only = holdout.sample_truth(frame_of(depth), uv, truth="5x5").code[0].tolist()
    assert only == [ok, none, close, ok, ok, close, ok, ok, none, none]
    raw = holdout.sample_truth(frame_of(depth), uv, truth="raw").code[0].tolist()
    assert raw == [ok, none, ok, ok, ok, ok, ok, ok, none, none]
    with pytest.raises(ValueError, match=r"holdout\.truth: found 'best'"):
        holdout.sample_truth(frame_of(depth), uv, truth="best")


def test_the_spread_limits_are_where_they_are_said_to_be():
    u = torch.arange(100.0)
    for slope, close_fails, wide_fails in ((0.004, False, False), (0.008, False, True), (0.014, True, True)):
        depth = (10 * (1 + slope) ** u).expand(60, 100)  # 5 px spread (1 + s)^4 − 1, 25 px (1 + s)^24 − 1
        assert ((1 + slope) ** 4 - 1 >= 0.05) == close_fails
        assert ((1 + slope) ** 24 - 1 >= 0.15) == wide_fails
        code = int(holdout.sample_truth(frame_of(depth), at((50, 30))).code)
        assert code == (TruthCode.CLOSE if close_fails else TruthCode.WIDE if wide_fails else TruthCode.CANDIDATE)


def test_a_wider_patch_asks_for_a_wider_window():
    depth = torch.full((60, 80), 4.0)
    depth[:, 60:] = 5.0
    uv = at((44, 30))
    assert holdout.sample_truth(frame_of(depth), uv, window=25).ok.all()
    assert not holdout.sample_truth(frame_of(depth), uv, window=35).ok.any()


def test_sparse_truth_takes_the_nearest_return():
    depth = torch.zeros(60, 80)
    depth[30, 30], depth[33, 33] = 8.0, 8.2  # both in reach of (31, 31); (30, 30) is nearer
    depth[10, 10], depth[10, 13] = 8.0, 9.0  # 12.5 % apart: close fails
    depth[50, 10], depth[50, 17] = 8.0, 9.5  # 7 px apart: only the wide window sees both
    uv = at((31, 31), (32.6, 32.6), (10, 11), (10, 50), (60, 30), (34, 33))
    truth = holdout.sample_truth(frame_of(depth, sparse=True), uv)
    assert truth.code[0].tolist() == [0, 0, TruthCode.CLOSE, TruthCode.WIDE, TruthCode.NO_RETURN, 0]
    torch.testing.assert_close(truth.depth[0], torch.tensor([8.0, 8.2, 8.0, 8.0, 0.0, 8.2]))
    raw = holdout.sample_truth(frame_of(depth, sparse=True), uv, truth="raw")
    assert raw.ok[0].tolist() == [True, True, True, True, False, True]
    close = holdout.sample_truth(frame_of(depth, sparse=True), uv, truth="5x5")
    assert close.ok[0].tolist() == [True, True, False, True, False, True]


def test_a_coarse_map_is_read_by_the_exact_scaling_rule():
    depth = (torch.arange(12.0) + 100).expand(8, 12)  # spread under 5 % within 3 px
    frame = frame_of(depth, hw=(32, 48))
    u = torch.arange(4, 44, dtype=torch.float32)
    uv = torch.stack((u, torch.full_like(u, 15.0)), -1)[None]
    truth = holdout.sample_truth(frame, uv)
    assert truth.ok.all()  # 5 and 25 px of the image are 3 and 7 px of the map
    torch.testing.assert_close(truth.depth[0], 100 + torch.floor((u + 0.5) / 4 - 0.5 + 0.5))


def test_a_map_with_its_own_camera_is_reached_along_the_ray():
    depth = (100 + torch.arange(40.0)).expand(30, 40)
    own = Camera(torch.tensor([[25.0, 25.0]]), torch.tensor([[10.0, 14.0]]))
    frame = frame_of(depth, hw=(60, 80), depth_camera=own)
    truth = holdout.sample_truth(frame, at((39.5, 29.5), (49.5, 29.5)), truth="raw")
    assert truth.depth[0].tolist() == [110.0, 115.0]


def test_truth_of_a_pair_does_not_depend_on_its_batch():
    depth = 3 + torch.rand(5, 40, 50, generator=torch.Generator().manual_seed(0)) * 0.3
    depth[depth < 3.02] = 0
    uv = torch.rand(5, 203, 2, generator=torch.Generator().manual_seed(1)) * 45
    frames = [frame_of(depth, sparse=sparse) for sparse in (False, True)]
    frames.append(frames[0].replace(sparse=torch.tensor([True, False, True, True, False])))
    for frame in frames:
        together = holdout.sample_truth(frame, uv)
        for b in range(5):
            alone = holdout.sample_truth(frame[b : b + 1], uv[b : b + 1])
            assert torch.equal(alone.depth, together.depth[b : b + 1])
            assert torch.equal(alone.code, together.code[b : b + 1])
    dense, sparse, both = (holdout.sample_truth(frame, uv) for frame in frames)
    assert not torch.equal(dense.code[1], sparse.code[1]) and not torch.equal(dense.depth[1], sparse.depth[1])
    for b, map_is_sparse in enumerate(frames[2].sparse.tolist()):
        expected = sparse if map_is_sparse else dense
        assert torch.equal(both.depth[b], expected.depth[b]) and torch.equal(both.code[b], expected.code[b])


def test_candidates_are_held_back_smooth_and_textured_and_counted_by_rule():
    truth = holdout.Truth(
        depth=torch.tensor([[0.0, 1.0, 3.0, 3.0, 3.0, 3.0, 3.0, 2.0]]),
        code=torch.tensor([[1, 0, 0, 3, 4, 0, 0, 3]], dtype=torch.int32),
    )
    trackability = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 0.19, 1.0, 1.0]])
    excluded = torch.tensor([[True] + [False] * 5 + [True, False]])
    found = holdout.select_candidates(samples_of(trackability), truth, 2.0, excluded=excluded)
    expected = [
        TruthCode.NO_RETURN,
        TruthCode.NEAR,
        0,
        TruthCode.CLOSE,
        TruthCode.WIDE,
        TruthCode.TEXTURE,
        TruthCode.EXCLUDED,
        TruthCode.NEAR,
    ]
    assert found.code[0].tolist() == expected
    assert found.dropped() == {"close": 1, "wide": 1, "excluded": 1, "texture": 1}
    assert not holdout.select_candidates(samples_of(trackability), truth, None).ok.any()


def test_the_texture_limit_is_a_share_of_the_median():
    trackability = torch.tensor([[1.0, 2.0, 3.0, 4.0, 0.49, 100.0]])  # median 2.5
    truth = holdout.Truth(torch.full((1, 6), 5.0), torch.zeros(1, 6, dtype=torch.int32))
    assert holdout.select_candidates(samples_of(trackability), truth, 2.0).ok[0].tolist() == [True] * 4 + [False, True]


def test_no_samples():
    truth = holdout.sample_truth(frame_of(torch.ones(30, 30)), torch.zeros(1, 0, 2))
    assert holdout.select_candidates(samples_of(torch.zeros(1, 0)), truth, 0.5).code.shape == (1, 0)


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize(("name", "cutoff"), [("holo_a", 2.5), ("7s_redkitchen_600", 2.0), ("dgp_drive6cam", 20.0)])
def test_every_held_back_return_of_a_real_frame_is_accounted_for(name, cutoff):
    recording = data.open_all(Path(ROOT) / name)[0]
    frame = recording[0]
    v, u = torch.meshgrid(torch.arange(4, frame.hw[0], 11.0), torch.arange(4, frame.hw[1], 11.0), indexing="ij")
    uv = torch.stack((u, v), -1).flatten(0, 1)[None]
    textured = samples_of(torch.rand(1, uv.shape[1], generator=torch.Generator().manual_seed(0)))
    kept = []
    for rule in holdout._TRUTH_TESTS:
        truth = holdout.sample_truth(frame, uv, truth=rule)
        found = holdout.select_candidates(textured, truth, cutoff)
        assert int(found.ok.sum()) + sum(found.dropped().values()) == int((truth.depth > cutoff).sum())
        kept.append(found.ok)
    assert (kept[0] >= kept[1]).all() and (kept[1] >= kept[2]).all()
    assert kept[0].sum() > kept[2].sum() > 0.2 * kept[0].sum()
    near = holdout.range_split(frame, cutoff)
    assert near.depth.max() <= cutoff and torch.equal(near.depth > 0, (frame.depth > 0) & (frame.depth <= cutoff))


# ---------------------------------------------------------------------------------------------------- plain loops


def loop_truth(depth, uv, truth, sparse, scale=1.0, window=25):
    """The truth test of one map (h, w), one sample and one pixel at a time."""
    (h, w), depth = depth.shape, depth.tolist()

    def around(u, v, size):
        """Returns of the window, with the squared distance of each; how many pixels have none."""
        side = max(3, int(size * scale / 2) * 2 + 1)
        found, empty = [], 0
        for y in range(v - side // 2, v + side // 2 + 1):
            for x in range(u - side // 2, u + side // 2 + 1):
                z = depth[y][x] if 0 <= x < w and 0 <= y < h else 0.0
                if math.isfinite(z) and z > 0:
                    found.append(((x - place[0]) ** 2 + (y - place[1]) ** 2, z))
                else:
                    empty += 1
        return found, empty

    def spread(found):
        return max(z for _, z in found) / min(z for _, z in found) - 1 if found else 0.0

    rows = []
    for u, v in uv.tolist():
        place = (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5
        at = [math.floor(x + 0.5) for x in place]
        close, empty = around(*at, 7 if sparse else 5)
        wide, _ = around(*at, 15 if sparse else window)
        z = min(close)[1] if sparse and close else 0.0
        if not sparse and 0 <= at[0] < w and 0 <= at[1] < h:
            z = depth[at[1]][at[0]]
            z = z if math.isfinite(z) and z > 0 else 0.0
        code = TruthCode.CANDIDATE
        if z == 0:
            code = TruthCode.NO_RETURN
        elif truth != "raw" and (spread(close) >= 0.05 or (empty and not sparse)):
            code = TruthCode.CLOSE
        elif truth == "full" and spread(wide) >= 0.15:
            code = TruthCode.WIDE
        rows.append((z, code))
    return rows


@pytest.mark.parametrize("truth", holdout._TRUTH_TESTS)
@pytest.mark.parametrize(("sparse", "scale"), [(False, 1.0), (False, 0.5), (True, 1.0), (True, 2.0)])
def test_the_truth_test_equals_plain_loops(truth, sparse, scale):
    g = torch.Generator().manual_seed(7)
    h, w = (round(n * scale) for n in (40, 60))
    ramp = 4 + torch.linspace(0, 2.4, w) ** 2 / 2
    depth = (ramp * (1 + 0.02 * torch.rand(h, w, generator=g))).double()
    empty = torch.rand(h, w, generator=g)
    depth[empty < (0.93 if sparse else 0.01)] = 0
    depth[empty > 0.994], depth[empty > 0.997] = math.nan, math.inf
    depth[:, w // 3 :] *= 1.08  # a step that the wide window alone takes for smooth
    uv = torch.rand(150, 2, generator=g, dtype=torch.float64) * torch.tensor([66.0, 46.0]) - 3
    found = holdout.sample_truth(frame_of(depth, hw=(40, 60), sparse=sparse), uv[None], truth=truth, window=13)
    expected = loop_truth(depth, uv, truth, sparse, scale, window=13)
    assert found.depth[0].tolist() == [z for z, _ in expected]
    assert found.code[0].tolist() == [code for _, code in expected]
    asked = {"raw": 2, "5x5": 3, "full": 4}[truth]
    assert len(set(found.code[0].tolist())) == asked, "every rule that is asked turns some away"


@pytest.mark.parametrize(("apart", "limit", "rule"), [(1, 0.05, TruthCode.CLOSE), (7, 0.15, TruthCode.WIDE)])
@pytest.mark.parametrize("sparse", [False, True])
def test_a_spread_of_exactly_the_limit_fails_and_one_just_below_does_not(apart, limit, rule, sparse):
    high = 2 * (1 + limit)
    for z, code in ((high, rule), (math.nextafter(high, 0), TruthCode.CANDIDATE)):
        depth = torch.full((40, 40), 0.0 if sparse else 2.0, dtype=torch.float64)
        depth[20, 20], depth[20, 20 + apart] = 2.0, z
        assert int(holdout.sample_truth(frame_of(depth, sparse=sparse), at((20, 20)).double()).code) == code


def test_the_default_windows_are_5_and_25_pixels_wide_and_7_and_15_where_returns_are_sparse():
    def reach(sparse, rule, step):
        """How far from a sample a return can be that still turns it away."""
        far = 0
        for d in range(1, 20):
            depth = torch.full((60, 60), 0.0 if sparse else 2.0)
            depth[30, 30], depth[30 + d, 30] = 2.0, 2 * step
            far = d if int(holdout.sample_truth(frame_of(depth, sparse=sparse), at((30, 30))).code) == rule else far
        return far

    assert [reach(False, TruthCode.CLOSE, 1.06), reach(False, TruthCode.WIDE, 1.2)] == [2, 12]
    assert [reach(True, TruthCode.CLOSE, 1.06), reach(True, TruthCode.WIDE, 1.2)] == [3, 7]


def test_what_is_no_depth_is_no_return():
    depth = torch.full((30, 30), 0.25)
    depth[15, 5], depth[15, 10], depth[15, 15], depth[15, 20] = math.nan, math.inf, -1.0, 0.0
    uv = at((5, 15), (10, 15), (15, 15), (20, 15), (25, 15), (math.nan, 15))
    for options in ({"truth": "raw"}, {}):
        truth = holdout.sample_truth(frame_of(depth), uv, **options)
        assert truth.depth[0].tolist() == [0, 0, 0, 0, 0.25, 0]
        assert truth.code[0].tolist() == [TruthCode.NO_RETURN] * 4 + [TruthCode.CANDIDATE, TruthCode.NO_RETURN]


@pytest.mark.parametrize("sparse", [False, True])
def test_the_gradient_of_the_truth_is_one_at_the_pixel_it_was_read_from(sparse):
    depth = torch.full((20, 30), 2.0)
    depth.requires_grad_()
    holdout.sample_truth(frame_of(depth, sparse=sparse), at((12.2, 7.4))).depth.sum().backward()
    assert depth.grad.nonzero().tolist() == [[7, 12]] and depth.grad[7, 12] == 1


def test_what_stays_of_a_split_frame_keeps_its_gradient():
    depth = torch.tensor([[[1.0, 3.0]]], requires_grad=True)
    holdout.range_split(frame_of(depth), 2.0).depth.sum().backward()
    assert depth.grad.tolist() == [[[1.0, 0.0]]]


# ---------------------------------------------------------------------------------------------------- masked returns


def test_a_candidate_needs_a_masked_return_of_the_sensor():
    """Truth of another instrument is 4 m everywhere; the sensor has a far return, none, a near one, and none (left out)."""
    sensor = torch.zeros(1, 40)
    sensor[0, 5], sensor[0, 25] = 4.1, 1.5
    uv = at((5, 0), (15, 0), (25, 0), (35, 0))
    depth, code = torch.full((1, 4), 4.0), torch.zeros(1, 4, dtype=torch.int32)
    code[0, 3] = TruthCode.EXCLUDED
    truth = holdout.require_masked(holdout.Truth(depth, code), frame_of(sensor), uv, 2.0)
    expected = [TruthCode.CANDIDATE, TruthCode.REAL_HOLE, TruthCode.NEAR, TruthCode.EXCLUDED]
    assert truth.code[0].tolist() == expected and truth.n_real_holes == 1
    assert "real_hole" not in truth.dropped() and truth.dropped()["excluded"] == 1
    assert truth.code.dtype == torch.int32 and torch.equal(truth.depth, depth)
    for rejected in (TruthCode.CLOSE, TruthCode.TEXTURE):  # counted only where a return was masked
        before = holdout.Truth(depth, torch.full_like(code, rejected))
        after = holdout.require_masked(before, frame_of(sensor), uv, 2.0).code[0].tolist()
        assert after == [rejected, TruthCode.REAL_HOLE, TruthCode.NEAR, TruthCode.REAL_HOLE]


@pytest.mark.parametrize("sparse", [False, True])
def test_a_near_return_within_reach_of_a_sparse_sample_is_no_masked_return(sparse):
    sensor = torch.zeros(20, 40)
    sensor[10, 10], sensor[10, 12] = 2.05, 1.98  # the nearest lies beyond the cutoff, the next before it
    frame, uv = frame_of(sensor, sparse=sparse), at((10, 10))
    truth = holdout.select_candidates(samples_of(torch.ones(1, 1)), holdout.sample_truth(frame, uv, truth="raw"), 2.0)
    assert bool(truth.ok.all())
    code = int(holdout.require_masked(truth, frame, uv, 2.0).code)
    assert code == (TruthCode.NEAR if sparse else TruthCode.CANDIDATE)


def test_the_share_that_the_truth_test_keeps():
    dropped = {"close": 1, "wide": 3, "excluded": 2, "texture": 4}
    assert holdout.truth_kept_ratio(10, dropped) == pytest.approx(1 - 4 / 20)
    assert holdout.truth_kept_ratio(0, dict.fromkeys(dropped, 0)) is None


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


@pytest.mark.parametrize("share", [0.5, 0.2, 0.9])
def test_half_deals_every_usable_trackable_sample_to_one_of_two_sets(share):
    samples = whole_samples(4000)
    a, b = holdout.split_half(samples, 3, share=share)
    usable = samples.xyz.isfinite().all(-1) & (samples.trackability >= 1e-5)
    assert torch.equal(a | b, usable) and not (a & b).any() and 0.5 < float(usable.double().mean()) < 0.7
    assert float(a.sum() / usable.sum()) == pytest.approx(share, abs=3 * math.sqrt(share * (1 - share) / 2560))
    if share == 0.5:
        assert torch.equal(holdout.split_half(samples, 3)[0], a)


def test_half_depends_on_the_seed_and_the_place_alone():
    one, two = whole_samples(300), whole_samples(300, batch=2, seed=5)
    both = two.replace(xyz=torch.cat((one.xyz, two.xyz[1:])), trackability=torch.cat((one.trackability,) * 2))
    assert torch.equal(holdout.split_half(both, 3)[0][:1], holdout.split_half(one, 3)[0])
    clean = two.replace(xyz=torch.ones_like(two.xyz), trackability=torch.ones_like(two.trackability))
    assert torch.equal(*holdout.split_half(clean, 3)[0]), "batch mates are split alike"
    assert not torch.equal(holdout.split_half(one, 3)[0], holdout.split_half(one, 4)[0])


def test_a_sample_at_the_least_trackability_is_in_a_half():
    samples = samples_of(torch.tensor([[0.3, 0.29999]], dtype=torch.float64))
    a, b = holdout.split_half(samples, 0, min_trackability=0.3)
    assert (a | b).tolist() == [[True, False]]
    a, b = holdout.split_half(samples_of(torch.tensor([[1e-5, 0.99e-5]], dtype=torch.float64)), 0)
    assert (a | b).tolist() == [[True, False]]


@pytest.mark.parametrize("share", [0.0, 1.0, -0.5, math.nan])
def test_a_share_that_leaves_one_half_empty_raises(share):
    with pytest.raises(ValueError, match=r"holdout\.share: found .*between 0 and 1"):
        holdout.split_half(samples_of(torch.ones(1, 3)), 0, share=share)


def test_hidden_returns_are_those_of_a_silent_sensor_and_the_others_stay():
    samples = whole_samples(40)
    hidden = torch.arange(40)[None] % 3 == 0
    found = holdout.hide_returns(samples, hidden)
    for name in ("depth", "sigma", "confidence"):
        assert torch.equal(getattr(found, name), torch.where(hidden, 0.0, getattr(samples, name))), name
    assert found.xyz[hidden].isnan().all() and not found.usable[hidden].any()
    torch.testing.assert_close(found.xyz[~hidden], samples.xyz[~hidden], equal_nan=True, rtol=0, atol=0)
    assert torch.equal(found.flag, torch.where(hidden, samples.flag | Flag.NO_DEPTH, samples.flag))
    assert (found.flag[hidden] & Flag.SPECULAR).any(), "what else is wrong with a sample is kept"
    for name in ("uv", "trackability", "hole"):
        assert torch.equal(getattr(found, name), getattr(samples, name)), name


def test_the_gradient_reaches_the_returns_that_stay():
    samples = samples_of(torch.ones(1, 2)).replace(depth=torch.ones(1, 2, requires_grad=True))
    holdout.hide_returns(samples, torch.tensor([[True, False]])).depth.sum().backward()
    assert samples.depth.grad.tolist() == [[0.0, 1.0]]


# ---------------------------------------------------------------------------------------------------- candidates


def test_a_return_at_the_cutoff_was_not_held_back_and_texture_at_the_limit_is_enough():
    truth = holdout.Truth(torch.tensor([[2.0, 2.5, 2.5, 2.5]]).double(), torch.zeros(1, 4, dtype=torch.int32))
    trackability = torch.tensor([[1.0, 0.25, 0.2499, 1.0]]).double()  # median 0.625
    found = holdout.select_candidates(samples_of(trackability), truth, 2.0, min_texture=0.4)
    assert found.code[0].tolist() == [TruthCode.NEAR, TruthCode.CANDIDATE, TruthCode.TEXTURE, TruthCode.CANDIDATE]
    default = samples_of(torch.tensor([[1.0, 0.2, 0.1999, 1.0, 1.0]]).double())  # median 1: the limit is 0.2
    depth = torch.full((1, 5), 3.0)
    found = holdout.select_candidates(default, holdout.Truth(depth, torch.zeros(1, 5, dtype=torch.int32)), 2.0)
    assert found.ok[0].tolist() == [True, True, False, True, True] and torch.equal(found.depth, depth)


def test_the_median_is_that_of_the_frame_itself():
    trackability = torch.tensor([[1.0, 1.0, 0.1], [10.0, 10.0, 1.0]])
    truth = holdout.Truth(torch.full((2, 3), 3.0), torch.zeros(2, 3, dtype=torch.int32))
    assert holdout.select_candidates(samples_of(trackability), truth, 2.0).ok.tolist() == [[True, True, False]] * 2


def test_the_first_rule_that_turns_a_sample_away_names_it():
    """Samples fail several rules at once."""
    excluded = torch.tensor([[True] * 5 + [False]])
    code = torch.tensor([[1, 3, 3, 4, 0, 0]], dtype=torch.int32)
    depth = torch.tensor([[0.0, 1.0, 3.0, 3.0, 3.0, 3.0]])
    samples = samples_of(torch.tensor([[0.1, 0.1, 1.0, 1.0, 1.0, 0.1]]))
    found = holdout.select_candidates(samples, holdout.Truth(depth, code), 2.0, excluded=excluded)
    order = [
        TruthCode.NO_RETURN,
        TruthCode.NEAR,
        TruthCode.CLOSE,
        TruthCode.WIDE,
        TruthCode.EXCLUDED,
        TruthCode.TEXTURE,
    ]
    assert found.code[0].tolist() == order
    assert found.dropped() == {"close": 1, "wide": 1, "excluded": 1, "texture": 1}


# ---------------------------------------------------------------------------------------------------- drop-outs


def loop_drop_outs(depth, samples, truth, window=7, min_returns=3, agreement=0.1, min_texture=0.2):
    """The cohort of real holes in one map as wide as the image, one sample at a time."""
    (h, w), depth = depth.shape, depth.tolist()
    codes, texture = [], min_texture * statistics.median(samples.trackability[0].tolist())
    for k, (u, v) in enumerate(samples.uv[0].tolist()):
        x, y = math.floor(u + 0.5), math.floor(v + 0.5)
        near = [
            depth[j][i]
            for j in range(y - window // 2, y + window // 2 + 1)
            for i in range(x - window // 2, x + window // 2 + 1)
            if 0 <= i < w and 0 <= j < h and depth[j][i] > 0
        ]
        true, code = float(truth.depth[0, k]), int(truth.code[0, k])
        if code == TruthCode.NO_RETURN:
            codes.append(code)
        elif 0 <= x < w and 0 <= y < h and depth[y][x] > 0:
            codes.append(TruthCode.NEAR)
        elif code in (TruthCode.CLOSE, TruthCode.WIDE):
            codes.append(code)
        elif len(near) < min_returns or abs(statistics.median_low(near) - true) > agreement * true:
            codes.append(TruthCode.EXCLUDED)
        else:
            codes.append(TruthCode.TEXTURE if samples.trackability[0, k] < texture else TruthCode.CANDIDATE)
    return codes


@pytest.mark.parametrize(
    "options", [{}, {"window": 5}, {"min_returns": 9}, {"agreement": 0.02}, {"min_texture": 0.9}, {"min_returns": 1}]
)
def test_drop_outs_equal_plain_loops(options):
    g = torch.Generator().manual_seed(1)
    draw = lambda *size: torch.rand(*size, generator=g, dtype=torch.float64)  # noqa: E731
    depth = 2 + draw(30, 40)
    depth[draw(30, 40) < 0.85] = 0
    n = 300
    samples = samples_of(draw(1, n)).replace(uv=draw(1, n, 2) * torch.tensor([42.0, 32.0]) - 1)
    code = torch.tensor([0, 0, 0, 0, 0, 0, 1, 3, 4], dtype=torch.int32)[torch.randint(0, 9, (1, n), generator=g)]
    truth = holdout.Truth(2 + draw(1, n), code)
    found = holdout.select_real_holes(frame_of(depth), samples, truth, **options)
    assert found.code[0].tolist() == loop_drop_outs(depth, samples, truth, **options)
    assert torch.equal(found.depth, truth.depth) and len(set(found.code[0].tolist())) >= 2
    assert int(found.ok.sum()) > 5


def test_a_hole_counts_from_the_third_return_beside_it_and_up_to_a_tenth_of_a_difference():
    depth = torch.zeros(20, 20, dtype=torch.float64)
    depth[10, 11], depth[11, 10], depth[13, 13] = 9.0, 9.0, 11.0
    samples = samples_of(torch.ones(1, 1)).replace(uv=at((10, 10)).double())
    code = torch.zeros(1, 1, dtype=torch.int32)

    def counts(true, of=depth, **options):
        truth = holdout.Truth(torch.tensor([[true]], dtype=torch.float64), code)
        return bool(holdout.select_real_holes(frame_of(of), samples, truth, **options).ok)

    assert counts(10.0) and not counts(10.001), "the median of three is 9"
    few = depth.clone()
    few[13, 13] = 0
    assert not counts(9.0, few) and counts(9.0, few, min_returns=2) and not counts(9.0, window=5)
