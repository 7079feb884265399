"""Robust fit of a small motion: exact for exact tracks, blind to outliers, honest where neighbours err together."""

import pytest
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.motion_fit import (
    Sightings,
    fit_epipolar_motion,
    fit_motion,
    mean_flow_form,
    rotation_from_flow,
    scene_flow,
)
from dhtorch.geometry.se3 import Pose
from dhtorch.pytree import collate

T = se3.exp(torch.tensor([[0.004, -0.006, 0.003, 0.01, -0.02, 0.015]], dtype=torch.float64))
GROUP = torch.arange(400) // 10


def sightings(seed=0, common_px=0.0, own_px=0.0, outliers=0):
    draw = torch.Generator().manual_seed(seed)
    ray = torch.cat((torch.rand(1, 2, 400, generator=draw) - 0.5, torch.ones(1, 1, 400)), 1).double()
    xyz = ray * (1 + 2 * torch.rand(1, 1, 400, generator=draw).double())
    f, c = torch.full((1, 2), 500.0, dtype=torch.float64), torch.full((1, 2), 320.0, dtype=torch.float64)
    Y = se3.apply(T, xyz.mT).mT
    uv = Y[:, :2] / Y[:, 2:] * f[..., None] + c[..., None]
    uv = uv + common_px * torch.randn(1, 2, 40, generator=draw).double()[..., GROUP]
    uv = uv + own_px * torch.randn(1, 2, 400, generator=draw).double()
    uv[..., :outliers] += 20
    return ray, Sightings(xyz, uv, torch.ones(1, 400, dtype=torch.bool), f, c)


def fit(ray, seen, **options):
    starts = collate([se3.identity(1, seen.f), rotation_from_flow(seen, ray)])
    return fit_motion(seen, starts, GROUP, **{"overlap": 1.0, "rotation_only": False, **options})


@pytest.mark.parametrize("zoom", [1.0, 1.02])
@pytest.mark.parametrize("rotation_only", [False, True])
def test_an_exact_motion_is_found_among_outliers_beside_a_focal_length(zoom, rotation_only):
    ray, seen = sightings(outliers=150)
    seen = seen._replace(uv=zoom * (seen.uv - seen.c[..., None]) + seen.c[..., None])
    result = fit(ray, seen, zoom=zoom != 1, rotation_only=rotation_only)
    variance = result.cov[0].diagonal()
    assert (variance > 0).tolist() == [True] * 3 + [not rotation_only] * 3 + [zoom != 1]
    if rotation_only:
        assert not result.T.t.any()
        return
    assert float(se3.log(se3.compose(result.T, se3.invert(T))).abs().max()) < 1e-6
    assert abs(float(result.log_zoom.exp()) - zoom) < 1e-6
    assert result.inlier[0].tolist() == [False] * 150 + [True] * 250


def test_flow_of_a_motion_agrees_with_its_form_to_first_order():
    _, seen = sightings()
    small = se3.exp(torch.tensor([[1e-5, 2e-5, 0.0, 1e-5, 0.0, 0.0]], dtype=torch.float64))
    shift, sigma = scene_flow(small, torch.zeros(1, 6, 6).double(), seen.xyz, seen.used, (seen.f, seen.c))
    xi = se3.log(small)[0]
    mean_square = float(xi @ mean_flow_form(seen.xyz, seen.used, seen.f, seen.c)[0, :6, :6] @ xi)
    assert 0.5 < float(shift) / mean_square**0.5 < 1.5 and float(sigma) == 0


def test_of_several_starts_the_one_that_fits_best_is_kept():
    _, seen = sightings()
    back = se3.exp(torch.tensor([[0.0, 3.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    for starts in ((back, se3.identity(1, seen.f)), (se3.identity(1, seen.f), back)):
        result = fit_motion(seen, collate(starts), GROUP, overlap=1.0, rotation_only=False)
        assert float(se3.log(se3.compose(result.T, se3.invert(T))).abs().max()) < 1e-6


@pytest.mark.parametrize("sign", [1, -1])
def test_epipolar_motion_finds_direction_and_rotation(sign):
    draw = torch.Generator().manual_seed(0)
    T = se3.exp(torch.tensor([[0.02, -0.01, 0.03, *(sign * x for x in (0.08, -0.05, 0.06))]], dtype=torch.float64))
    ray = torch.cat((torch.rand(1, 2, 200, generator=draw) - 0.5, torch.ones(1, 1, 200)), 1).double()
    Y = se3.apply(T, (ray * (1 + 2 * torch.rand(1, 1, 200, generator=draw).double())).mT).mT
    f, c = torch.full((1, 2), 500.0, dtype=torch.float64), torch.full((1, 2), 320.0, dtype=torch.float64)
    uv = Y[:, :2] / Y[:, 2:] * f[..., None] + c[..., None]
    start = Pose(se3.exp(torch.tensor([[0.0, 0.06, 0.03, 0, 0, 0]], dtype=torch.float64)).R, torch.zeros(1, 3).double())
    live = torch.cat(((uv - c[..., None]) / f[..., None], torch.ones_like(uv[:, :1])), 1)
    bend = torch.full((1,), 3.0, dtype=torch.float64)
    used = torch.ones(1, 200, dtype=torch.bool)
    motion, noise, agreeing = fit_epipolar_motion(ray, live, used, start.R, f.mean(-1), bend)
    direction = T.t / T.t.norm()
    assert float((motion.t * direction).sum()) > 0.999 and float(noise) < 0.01
    assert float(agreeing.double().mean()) > 0.95
    assert float(se3.rotation_angle(motion.R @ T.R.mT)) < 1e-3
