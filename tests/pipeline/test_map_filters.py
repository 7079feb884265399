"""Filters of a swept map: each planted artefact is mended, every other pixel keeps its bits, gradients stay."""

import pytest
import torch

from dhtorch.codes import Gate, Source
from dhtorch.metrics import map_quality
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS
from dhtorch.pipeline.map_filters import SensorReturns, filter_map
from dhtorch.records import DepthMap

H, W = 60, 80
ALL = slice(None)


def to(a, b=None):
    return slice(a, b)


def box(*parts):
    """Pixels (H, W) of (rows, columns) parts."""
    mask = torch.zeros(H, W, dtype=torch.bool)
    for part in parts:
        mask[part] = True
    return mask


class Planted:
    """A map of a wall without returns; parts are planted by index, without a depth as silence."""

    def __init__(self, parts=(), wall=4.0, sigma_rel=0.05, answered=True):
        self.wall = torch.as_tensor(wall).expand(1, H, W)
        self.depth, self.sigma_rel = self.wall.clone(), torch.full((1, H, W), sigma_rel)
        self.answered, self.returned = torch.full((1, H, W), answered), torch.zeros(1, H, W, dtype=torch.bool)
        self.grey = torch.full((1, H, W), 0.5)
        for rows, columns, depth, returned, grey in parts:
            at = (0, rows, columns)
            self.depth[at] = self.depth[at] if depth is None else depth
            self.answered[at], self.returned[at], self.grey[at] = not returned and depth is not None, returned, grey

    def maps(self):
        keep, nan = self.answered, torch.full_like(self.depth, torch.nan)
        depth = torch.where(keep, self.depth, nan)
        gate = torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).int()
        score = torch.where(keep, 0.1 / (0.1 + self.sigma_rel), 0.0)
        swept = DepthMap(depth, self.sigma_rel * depth, score, keep.int() * Source.SWEPT, gate)
        near = torch.where(self.returned, self.depth, 0.0)
        return swept, SensorReturns(near, 0.01 * near, self.returned.float(), self.returned)


def swept(rows, columns, depth=None, grey=0.5):
    return rows, columns, depth, False, grey


def sensed(rows, columns, depth, grey=0.5):
    return rows, columns, depth, True, grey


PLANE = 1 / (0.2 + 0.001 * torch.arange(W) + 0.002 * torch.arange(H)[:, None])
SIDE = 2 * DEFAULT_DENSE_OPTIONS.hole_radius_px - 2  # only the four pixels in the middle have a rim on all sides
REACH = sensed(to(40), to(0, 10), 3.0, 0.1)  # a corner of returns at the end of the sensor's reach
HALO = [REACH, sensed(to(20, 40), to(30, 50), 1.5), swept(to(14, 20), to(30, 50), 1.55)]
HALO += [swept(to(16, 44), to(50), 1.5), swept(to(0, 16), to(50)), swept(to(44), to(50))]  # it goes on to the border
STRIP = [swept(to(20, 40), to(30, 50), 3.2, 0.9), swept(to(20, 40), to(50, 54), 3.2)]  # fattened, beyond the reach
BESIDE = (to(14, 20), to(30, 50))
LINE, SPECK, INSIDE = (20, to(30, 50)), (to(50, 55), to(60, 65)), (to(10, 14), to(10, 14))
SPECKS = [swept(to(5, 45), to(5, 30), 4.0), swept(to(20, 21), to(30, 50), 4.0), swept(*SPECK, 4.0)]
SPECKS += [swept(to(5, 10), to(50, 56), 4.0), swept(*INSIDE, 6.0)]  # 30 px are a patch, 25 a speck
PINHOLES = [(to(20, 24), to(30, 36)), (to(40, 49), to(40, 49))]  # nine wide: silenced around a single outlier
GAPS = [(to(2, 58), 20), (30, to(40, 70)), (to(50, 52), to(5, 15))]


@pytest.mark.parametrize(
    ("parts", "options", "silent", "filled", "where"),
    [
        ([sensed(to(30), to(0, 40), 1.5, 0.9)], {"wall": 1 / (0.2 + 0.002 * torch.arange(W))}, [], [], None),
        ([sensed(to(5, 8), to(5, 8), 1.0)], {"answered": False}, [], [], None),
        ([swept(to(20, 20 + SIDE), to(20, 20 + SIDE))], {}, [], [], None),
        (HALO, {}, [BESIDE], [], [BESIDE, (to(16, 44), to(60))]),
        (HALO, {"sparse": torch.tensor([True])}, [], [], [BESIDE]),
        ([REACH, sensed(to(20, 40), to(30, 50), 2.99, 0.9), swept(*BESIDE, 3.0, 0.9)], {}, [], [], [BESIDE]),
        (STRIP, {}, [(to(20, 40), to(50, 54))], [], None),
        (STRIP, {"sigma_rel": 0.2}, [], [], None),
        ([sensed(ALL, to(0, 40), 3.0)], {"wall": 3.9}, [(ALL, to(40, 42))], [], None),
        ([sensed(ALL, to(0, 40), 3.0, 0.9)], {"wall": 3.9}, [], [], None),
        ([sensed(ALL, to(0, 40), 3.0)], {"wall": 3.9, "sigma_rel": 0.15}, [], [], None),
        (SPECKS, {"answered": False}, [LINE, SPECK], [INSIDE], None),
        ([*(swept(*p) for p in PINHOLES), swept(to(20, 40), to(60, 75))], {"wall": PLANE}, [], PINHOLES, None),
        ([swept(ALL, to(40), 2.0, 0.9), swept(to(20, 24), to(38, 42))], {}, [], [], None),
        ([sensed(ALL, ALL, 2.0), *(swept(*p) for p in GAPS)], {"wall": 2.0}, [], GAPS, None),
    ],
    ids=[
        "slanted",
        "speck",
        "island",
        "halo",
        "sparse",
        "reach",
        "strip",
        "unsure",
        "seam",
        "edge",
        "consistent",
        "lines",
        "pinholes",
        "step",
        "gaps",
    ],
)
def test_artefacts_are_silent_or_filled_and_every_other_pixel_keeps_its_bits(parts, options, silent, filled, where):
    """Filled from the wall, with the sigma of the rim: .05, or .01 between returns."""
    sparse = (options := dict(options)).pop("sparse", None)
    planted = Planted(parts, **options)
    before, returns = planted.maps()
    found = filter_map(before, returns, planted.grey, sparse)
    columns = [(getattr(before, k), getattr(found, k)) for k in ("depth", "sigma", "score", "source", "gate")]
    changed = torch.stack([a.nan_to_num(-1) != b.nan_to_num(-1) for a, b in columns]).any(0)[0]
    where = box((ALL, ALL)) if where is None else box(*where)
    silent, filled = box(*silent), box(*filled)
    assert torch.equal(changed & where, (silent | filled) & where)
    silent &= (found.source[0] != Source.FILLED) | ~planted.returned[0, 0, 0]  # the ends of a seam are filled again
    assert (found.gate[0][silent] == Gate.UNCERTAIN).all() and found.depth[0][silent].isnan().all()
    assert (found.source[0][filled] == Source.FILLED).all() and (found.gate[0][filled] == Gate.ANSWER).all()
    assert ((found.depth / planted.wall)[0][filled] - 1).abs().lt(1e-4).all()
    sigma_rel = (found.sigma / found.depth)[0][filled] / (0.01 if planted.returned[0, 0, 0] else 0.05)
    assert ((sigma_rel > 0.9) & (sigma_rel < 1.2)).all()
    torch.testing.assert_close(found.score[0][filled], 0.1 / (0.1 + (found.sigma / found.depth)[0][filled]))
    assert parts is not SPECKS or map_quality.artefact_counts(found)[0] == 0


def test_a_bent_rim_widens_sigma():
    planted = Planted([swept(to(20, 24), to(30, 34))])
    planted.depth[0, ::2] *= 1.04  # rough by 4 %
    found = filter_map(*planted.maps(), planted.grey, None)
    ratio = (found.sigma / found.depth)[0, 20:24, 30:34]
    assert found.keep[0, 20:24, 30:34].all() and (ratio > 0.055).all() and (ratio < 0.08).all()


def test_a_wider_silence_amid_returns_is_no_pinhole():
    silences = [swept(to(row, row + width), to(30, 38)) for row, width in ((5, 5), (20, 6), (40, 8))]
    planted = Planted([sensed(ALL, ALL, 2.0), REACH, *silences], wall=2.0)
    found, sparse = (filter_map(*planted.maps(), planted.grey, x) for x in (None, torch.tensor([True])))
    filled = found.source[0] == Source.FILLED
    assert filled[5:10, 30:38].all() and not filled[22:24, 33:35].any() and not filled[43:45, 33:35].any()
    assert sparse.keep[0, 40:48, 30:38].all(), "no evidence if sparse"


def test_kept_depths_keep_their_gradient_and_filled_ones_have_none():
    planted = Planted([swept(*PINHOLES[0])])
    before, returns = planted.maps()
    depth = before.depth.requires_grad_()
    filter_map(before.replace(depth=depth), returns, planted.grey).depth.sum().backward()
    assert torch.equal(depth.grad[0], (~box(PINHOLES[0])).float())
