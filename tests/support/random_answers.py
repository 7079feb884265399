"""Random evaluated points: depths with errors, truth, sigma and scores."""

import numpy as np
import torch

from dhtorch.metrics import errors


def random_points(n, seed=0, ties=False, unanswered=0.3):
    """``n`` points with depth errors of 30 %, a share of them without an answer; ``ties``: only six different scores."""
    g = np.random.default_rng(seed)
    true = g.uniform(2, 6, n)
    depth = true * np.exp(g.normal(0, 0.3, n))
    score = g.integers(0, 6, n) / 5 if ties else g.uniform(0, 1, n)
    keep = g.uniform(size=n) > unanswered
    t = torch.from_numpy
    return errors.make_points(
        t(depth), t(true), t(score), sigma=t(0.2 * true), residual_px=t(g.uniform(0, 3, n)), keep=t(keep)
    )
