"""Samples of a few pixels, and a stub method with a fixed estimate: for tests of the code around a method."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from dhtorch.codes import Flag, Gate, Hole
from dhtorch.pipeline.method import Method
from dhtorch.records import Estimate, Pose, PoseFit, Samples
from dhtorch.transforms import ExtendDepth

H, W, N = 28, 42, 6
K = [40.0, 42.0, 20.0, 14.0]


def sample(seed=0, **changes):
    """A sample dict: a random uint8 picture, a depth map in whole millimetres, the picture before it, intrinsics."""
    rng = np.random.default_rng(seed)
    image, before = rng.integers(0, 256, (2, H, W, 3), dtype=np.uint8)
    depth = rng.integers(500, 2000, (H, W)).astype(np.uint16)
    return {"image": image, "before": before, "depth": depth, "intrinsics": np.float32(K), "index": seed, **changes}


def pose(batch, seed=0):
    """Poses with a rotation about y and a step, different for each member of the batch."""
    a = 0.1 * (1 + seed + torch.arange(batch))
    zero, one = torch.zeros(batch), torch.ones(batch)
    R = torch.stack((a.cos(), zero, a.sin(), zero, one, zero, -a.sin(), zero, a.cos()), -1).view(-1, 3, 3)
    return Pose(R, torch.stack((a, 2 * a, 3 * a), -1))


class FixedEstimate:
    """Estimate of six samples: two known to the sensor, two triangulated, one with both, one with neither.

    ``codes`` are the pose codes of the batch; ``arguments`` holds the arguments of the last call.
    """

    def __init__(self, codes=None):
        self.codes, self.arguments, self.calls = codes, {}, 0

    def __call__(self, reference, other, *, n=N, seed=0, trace=None):
        self.arguments, self.calls = {"reference": reference, "other": other, "n": n, "seed": seed}, self.calls + 1
        g = torch.Generator().manual_seed(7)
        B = reference.image.shape[0]
        uv = torch.rand(1, n, 2, generator=g).expand(B, n, 2) * torch.tensor([W - 1.0, H - 1.0])
        depth = 1 + torch.rand(1, n, generator=g).expand(B, n)
        place = torch.arange(n).expand(B, n) % N
        sensed, answered = (place < 2) | (place == 4), (place >= 2) & (place < 5)
        nan = torch.full_like(depth, torch.nan)
        known = torch.where(sensed[..., None], torch.cat((uv, depth[..., None]), -1), nan[..., None])
        flag = torch.where(sensed, Flag.SATURATED, Flag.NO_DEPTH).int()
        hole = torch.where(sensed, Hole.NONE, Hole.TOO_DARK + place % 2).int()
        returned = torch.where(sensed, depth, torch.where(place == 5, 9.0, 0.0))  # one return is not usable
        samples = Samples(uv, returned, 0.01 * depth, known, 0.5 + 0.1 * depth, flag, depth, hole)
        far = torch.where(answered, 10 * depth, nan)
        gate = torch.where(answered, Gate.ANSWER, Gate.PARALLAX).int()
        score = torch.where(answered, 0.25 * depth, 0.0)
        estimate = Estimate(uv, far, 0.5 * far, 0.1 * far, depth, depth, place.int(), score, gate)
        code = torch.zeros(B, dtype=torch.int32) if self.codes is None else torch.tensor(self.codes, dtype=torch.int32)
        lost = ((code != 0) & (code != 4))[:, None, None]
        fit = pose(B)
        cov = torch.arange(36.0).view(1, 6, 6) + torch.arange(B)[:, None, None]
        R, t = torch.where(lost, torch.nan, fit.R), torch.where(lost[..., 0], torch.nan, fit.t)
        count = torch.zeros(B)
        fit = PoseFit(Pose(R, t), torch.where(lost, torch.nan, cov), sensed, count.long(), count, count, count, code)
        trace.update(samples=samples, fit=fit)
        return estimate


@dataclass(frozen=True, eq=False, kw_only=True)
class Stub(Method):
    """A method whose estimate is that of the function ``answer``; its front end is the paper's."""

    answer: Callable[..., Estimate] = None

    def __call__(self, reference, other, *, seed=0, hint=None, trace=None):
        return self.answer(reference, other, n=self.n, seed=seed, trace=trace)


def tiny(method=None, **options):
    """The ``ExtendDepth`` transform of such samples with the stub method."""
    method = method if isinstance(method, Method) else Stub(answer=method or FixedEstimate(), n=N)
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "method": method, **options})


def added(out, prefix="dhtorch."):
    """{name: tensor} of the keys that a transform added, without their prefix."""
    return {k.removeprefix(prefix): v for k, v in out.items() if k.startswith(prefix)}
