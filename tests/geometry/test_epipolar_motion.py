"""Motion up to scale from rays: rotation and direction of a motion that is known."""

import pytest
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.epipolar_motion import fit_epipolar_motion
from dhtorch.geometry.se3 import Pose


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
