"""Answers drawn at random, with what is true of them."""

import numpy as np
import torch

from dhtorch.metrics import errors


def random_points(n, seed=0, ties=False, silent=0.3):
    """n answers 30 % off, of which a share is silent; scores of six values where there are ``ties``."""
    g = np.random.default_rng(seed)
    true = g.uniform(2, 6, n)
    depth = true * np.exp(g.normal(0, 0.3, n))
    score = g.integers(0, 6, n) / 5 if ties else g.uniform(0, 1, n)
    keep = g.uniform(size=n) > silent
    t = torch.from_numpy
    return errors.make_points(
        t(depth), t(true), t(score), sigma=t(0.2 * true), residual_px=t(g.uniform(0, 3, n)), keep=t(keep)
    )
