"""Degenerate and adversarial pairs: nothing raises, every promise is kept, and a broken promise would be seen."""

import pytest
import torch
from support import degenerate
from support.degenerate_pairs import KINDS, make

from dhtorch.codes import PoseCode
from dhtorch.geometry import ransac

N = 2 * len(KINDS)


def alone(number, pair=None):
    """One pair as a batch of its own; ``pair`` in place of its own content."""
    kind, own = make(number)
    pair = pair or own
    return degenerate.join([(number, kind, pair)])


@pytest.fixture(scope="module")
def rows():
    return degenerate.run(N)


def test_nothing_raises_and_every_promise_is_kept(rows):
    assert {(r["name"], r["method"]) for r in rows} == {(k, m) for k in KINDS for m in ("map", "paper")}
    assert all(r["n_pairs"] == N // len(KINDS) for r in rows)
    faults = {(r["name"], r["method"]): (r["faults"], r["examples"]) for r in rows if r["faults"]}
    assert not faults


def test_the_hopeless_stay_silent_and_the_healthy_answer(rows):
    answered = {(r["name"], r["method"]): r["answered"] for r in rows}
    hopeless = ("no near points", "one near point", "three near points", "duplicated points", "all depth NaN")
    hopeless += ("constant images", "black view 1", "all pixels NaN", "stripes")
    assert all(answered[kind, method] == 0 for kind in hopeless for method in ("map", "paper"))
    still = ("identical frames", "pure rotation", "unrelated images", "upside down", "noise images", "random depth")
    assert all(answered[kind, "map"] <= 0.02 for kind in still)
    healthy = degenerate.join([(number, *make(number)) for number in range(0, 5 * len(KINDS), len(KINDS))])
    assert set(healthy.kinds) == {"nothing wrong"}
    share = {method: float(healthy.estimate(method)[0].keep.float().mean()) for method in ("map", "paper")}
    assert share["map"] > 0.2 and share["paper"] > 0.5


@pytest.mark.parametrize("sky", [1e10, 3e38])
def test_one_return_of_the_sky_does_not_make_a_line(sky):
    """Renderers write 1e10 where nothing is: a point so far away is a direction, the others are no line for it."""
    xyz = torch.rand(1, 3, 20, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 1.0])[:, None]
    xyz[..., 3] *= sky / xyz[..., 3].amax()
    used = torch.ones(1, 20, dtype=torch.bool)
    assert not ransac.is_collinear(xyz, used).item()
    line = xyz[..., :1] + torch.linspace(0, 1, 20) * torch.tensor([0.3, 0.1, 0.5])[:, None]
    line[..., 3] = xyz[..., 3]
    assert ransac.is_collinear(line, used).item()
    _, pair = make(2 * len(KINDS))
    at = pair.uv.round().long()[3]
    codes = []
    for value in (0.0, sky):
        pair.depth[at[1], at[0]] = value
        codes.append(int(alone(2 * len(KINDS), pair).estimate("map")[1]["fit"].code))
    assert codes[0] == codes[1] == PoseCode.OK
