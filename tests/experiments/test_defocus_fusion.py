"""Filling in between returns: planes are exact, guides follow edges, defocus corrects where it must and only there."""

import pytest
import torch

from dhtorch.experiments.focal import defocus_fusion as experiment
from dhtorch.experiments.focal.blur import BlurMap
from dhtorch.experiments.focal.filling import fill_bilinear, fill_defocus_guided, fill_guided, fill_joint_bilateral


def plane(h=70, w=84):
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return (1.5 + 0.01 * x + 0.005 * y)[None]


def step(h=70, w=84):
    return torch.where(torch.arange(w) < 40, 1.0, 2.0).expand(1, h, w).clone()


def test_bilinear_gives_a_plane_back_and_leaves_holes():
    coarse, whole = experiment.thin_returns(plane(), 7)
    found = fill_bilinear(coarse, (70, 84))
    torch.testing.assert_close(found[:, 4:-4, 4:-4], whole[:, 4:-4, 4:-4], atol=1e-4, rtol=0)
    coarse[:, 3:6, 3:6] = 0
    found = fill_bilinear(coarse, (70, 84))
    assert float(found[0, 31, 31]) == 0 and float(found[0, 60, 60]) > 0
    filled = found[found > 0]
    assert float(filled.min()) >= 1.5 - 1e-4, "a hole pulls nothing towards zero"


# The guided filter averages its linear functions over windows: part of the ramp stays.
@pytest.mark.parametrize(("guided", "left"), [(fill_joint_bilateral, 0.5), (fill_guided, 0.9)])
def test_guides_sharpen_an_edge_that_the_picture_shows(guided, left):
    whole = step()
    coarse, _ = experiment.thin_returns(whole, 7)
    picture = (whole[:, None] - 1) * 0.8 + 0.1
    plain = fill_bilinear(coarse, (70, 84))
    found = guided(coarse, picture)
    error, before = ((z - whole)[:, 8:-8, 30:52].abs().mean() for z in (found, plain))
    assert float(error) < left * float(before)
    blind = torch.full_like(picture, 0.5)
    found = guided(coarse, blind)
    assert float((found - whole)[:, 8:-8, 30:52].abs().mean()) > 0.8 * float(before), "no edge, no help"


def test_exact_defocus_corrects_an_edge_and_useless_defocus_changes_little():
    whole = step()
    coarse, _ = experiment.thin_returns(whole, 7)
    plain = fill_bilinear(coarse, (70, 84))
    everywhere = torch.ones_like(whole, dtype=torch.bool)
    exact = BlurMap(0.3 + 4 * (1 / whole - 1).abs(), torch.ones_like(whole), everywhere)  # in focus at 1 m
    error, before = ((z - whole).abs().mean() for z in (fill_defocus_guided(plain, coarse, exact, reach_px=0.5), plain))
    assert float(error) < 0.9 * float(before)
    noise = torch.rand(whole.shape, generator=torch.Generator().manual_seed(0))
    useless = fill_defocus_guided(plain, coarse, exact.replace(sigma=noise))
    assert float((useless - whole).abs().mean()) < 1.05 * float(before)
    nothing = fill_defocus_guided(plain, coarse, exact.replace(valid=~everywhere))
    assert torch.equal(nothing, plain)
