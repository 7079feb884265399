"""Estimates (V, B, N) of the same samples from several source views: drawn about a true depth, or given one by one."""

import torch

from dhtorch.records import Estimate


def rand(*shape, seed, low=0.0, high=1.0):
    """Uniform float64 numbers between ``low`` and ``high``."""
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_estimates(V=4, B=2, N=30, seed=0, unanswered=0.3, spread=1.0):
    """Estimates (V, B, N) within a few sigmas of a true depth; a share ``unanswered`` has no answer."""
    z = rand(B, N, seed=seed, low=2, high=8)
    relative = rand(V, B, N, seed=seed + 1, low=0.01, high=0.08)
    noise = spread * 4 * (rand(V, B, N, seed=seed + 2) - 0.5)
    depth = 1 / (1 / z * (1 + relative * noise))
    gate = torch.where(
        rand(V, B, N, seed=seed + 3) < unanswered, 5 + (7 * rand(V, B, N, seed=seed + 4)).int() % 4, 0
    ).int()
    keep = gate == 0
    sigma = relative * depth
    shared = sigma * rand(V, B, N, seed=seed + 5, low=0.0, high=1.0)
    mute = lambda x: torch.where(keep, x, torch.nan)  # noqa: E731
    return Estimate(
        uv=rand(V, B, N, 2, seed=seed + 6),
        depth=mute(depth),
        sigma=mute(sigma),
        sigma_shared=mute(shared),
        parallax_deg=rand(V, B, N, seed=seed + 7, high=9),
        residual_px=rand(V, B, N, seed=seed + 8, low=0.1, high=2),
        n_views=torch.full((V, B, N), 2, dtype=torch.int32),
        score=keep.double(),
        gate=gate,
    )


def make_estimates(depth, sigma, shared=0.0, gate=0):
    """Estimates (V, 1, 1) of one sample with these depths, sigmas and gates."""
    V = len(depth)
    column = lambda x: torch.as_tensor(x, dtype=torch.float64).expand(V)[:, None, None].clone()  # noqa: E731
    views = random_estimates(V=V, B=1, N=1)
    gate = torch.as_tensor(gate).expand(V)[:, None, None].int()
    return views.replace(depth=column(depth), sigma=column(sigma), sigma_shared=column(shared), gate=gate)
