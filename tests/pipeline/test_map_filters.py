"""Filters of a swept map: each planted artefact is mended, every other pixel keeps its bits, gradients stay."""

import pytest
import torch

from dhtorch.codes import Gate, Source
from dhtorch.metrics import map_quality
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS
from dhtorch.pipeline.map_filters import SensorReturns, filter_map
from dhtorch.records import DepthMap

H, W = 60, 80
REACH = 3.0


class Planted:
    """A map of a wall at 4 m without returns; parts are planted by index."""

    def __init__(self, depth=4.0):
        self.depth = torch.full((1, H, W), depth)
        self.sigma_rel = torch.full((1, H, W), 0.05)
        self.answered = torch.ones(1, H, W, dtype=torch.bool)
        self.returned = torch.zeros(1, H, W, dtype=torch.bool)
        self.grey = torch.full((1, H, W), 0.5)

    def plant(self, rows, columns, depth=None, *, returned=False, grey=None):
        part = (0, rows, columns)
        if depth is not None:
            self.depth[part] = depth
        self.answered[part], self.returned[part] = not returned and depth is not None, returned
        if grey is not None:
            self.grey[part] = grey

    def reach_out(self):
        """A corner of returns at the end of the sensor's reach."""
        self.plant(slice(40, None), slice(0, 10), REACH, returned=True, grey=0.1)

    def maps(self):
        keep, nan = self.answered, torch.full_like(self.depth, torch.nan)
        depth = torch.where(keep, self.depth, nan)
        gate = torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).int()
        score = torch.where(keep, 0.1 / (0.1 + self.sigma_rel), 0.0)
        swept = DepthMap(depth, self.sigma_rel * depth, score, keep.int() * Source.SWEPT, gate)
        near = torch.where(self.returned, self.depth, 0.0)
        return swept, SensorReturns(near, 0.01 * near, self.returned.float(), self.returned)

    def filtered(self, sparse=None):
        swept, returns = self.maps()
        return filter_map(swept, returns, self.grey, sparse)


def changed(planted, found):
    """Pixels whose depth, sigma, score, source or gate are others than those of the input."""
    swept, _ = planted.maps()
    columns = [
        (getattr(swept, name).nan_to_num(-1), getattr(found, name).nan_to_num(-1)) for name in ("depth", "sigma")
    ]
    columns += [(getattr(swept, name), getattr(found, name)) for name in ("score", "source", "gate")]
    return torch.stack([a != b for a, b in columns]).any(0)[0]


def box(rows, columns):
    mask = torch.zeros(H, W, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


def test_a_clean_map_keeps_its_bits():
    planted = Planted()
    planted.depth = 1 / (0.2 + 0.002 * torch.arange(W).expand(1, H, W))  # a slanted wall
    planted.plant(slice(30, None), slice(0, 40), 1.5, returned=True, grey=0.9)  # and a box with a sharp edge
    assert not changed(planted, planted.filtered()).any()


def test_a_halo_beside_returns_is_silent_and_a_surface_that_goes_on_is_not():
    planted = Planted()
    planted.reach_out()
    planted.plant(slice(20, 40), slice(30, 50), 1.5, returned=True)
    planted.plant(slice(14, 20), slice(30, 50), 1.55)
    planted.depth[0, 20:40, 50:] = 1.5  # the box goes on to the border, where the sensor is silent
    planted.plant(slice(16, 44), slice(50, None), 1.5)
    planted.answered[0, :16, 50:] = planted.answered[0, 44:, 50:] = False  # and nothing farther is seen beside it
    found = planted.filtered()
    assert (found.gate[0, 14:20, 30:50] == Gate.UNCERTAIN).all() and found.depth[0, 14:20, 30:50].isnan().all()
    assert not changed(planted, found)[16:44, 60:].any()
    assert changed(planted, planted.filtered(torch.tensor([True])))[14:20, 30:50].sum() == 0, "no evidence if sparse"


def test_a_speck_of_returns_is_kept():
    planted = Planted()
    planted.answered[:] = False
    planted.plant(slice(5, 8), slice(5, 8), 1.0, returned=True)
    assert not changed(planted, planted.filtered()).any()


def test_a_hole_too_wide_to_be_filled_gets_no_island():
    side = 2 * DEFAULT_DENSE_OPTIONS.hole_radius_px - 2  # only the four pixels in the middle have a rim on all sides
    planted = Planted()
    planted.answered[0, 20 : 20 + side, 20 : 20 + side] = False
    assert not changed(planted, planted.filtered()).any()


def test_a_halo_stays_where_the_sensor_does_not_reach():
    planted = Planted()
    planted.reach_out()
    planted.plant(slice(20, 40), slice(30, 50), 2.99, returned=True, grey=0.9)  # at the end of its reach
    planted.plant(slice(14, 20), slice(30, 50), 3.0, grey=0.9)
    assert not changed(planted, planted.filtered())[14:20, 30:50].any()


def test_a_strip_that_looks_like_the_background_is_silent():
    planted = Planted()
    planted.plant(slice(20, 40), slice(30, 50), 3.2, grey=0.9)  # beyond the reach
    planted.plant(slice(20, 40), slice(50, 54), 3.2, grey=0.5)  # fattened
    found = planted.filtered()
    assert (found.gate[0, 20:40, 50:54] == Gate.UNCERTAIN).all()
    assert int(changed(planted, found).sum()) == 80
    planted.sigma_rel[:] = 0.2
    assert not changed(planted, planted.filtered()).any(), "the step is none where depth is that uncertain"


@pytest.mark.parametrize("grey", [0.5, 0.9])
def test_a_seam_is_silent_unless_the_picture_has_an_edge_there(grey):
    planted = Planted(3.9)
    planted.sigma_rel[:] = 0.05
    planted.plant(slice(0, H), slice(0, 40), 3.0, returned=True, grey=grey)  # 30 % deeper beside it
    silent = changed(planted, planted.filtered())
    assert torch.equal(silent, box(slice(None), slice(40, 42)) if grey == 0.5 else torch.zeros_like(silent))
    planted.sigma_rel[:] = 0.15
    assert not changed(planted, planted.filtered()).any(), "consistent within sigma"


def test_lines_and_specks_are_silent_and_patches_are_not():
    planted = Planted()
    planted.answered[:] = False
    planted.plant(slice(5, 45), slice(5, 30), 4.0)
    planted.plant(slice(20, 21), slice(30, 50), 4.0)  # a line from the patch
    planted.plant(slice(50, 55), slice(60, 65), 4.0)  # 25 px
    planted.plant(slice(5, 10), slice(50, 56), 4.0)  # 30 px
    planted.plant(slice(10, 14), slice(10, 14), 6.0)  # 16 px of another surface in the patch
    found = planted.filtered()
    expected = box(20, slice(30, 50)) | box(slice(50, 55), slice(60, 65)) | box(slice(10, 14), slice(10, 14))
    assert torch.equal(changed(planted, found), expected)
    inside = box(slice(10, 14), slice(10, 14))
    assert (found.source[0][inside] == Source.FILLED).all() and (found.depth[0][inside] - 4).abs().max() < 1e-4
    assert (found.gate[0][expected & ~inside] == Gate.UNCERTAIN).all()
    assert map_quality.artefact_counts(found)[0] == 0


def test_pinholes_are_filled_from_the_plane_of_their_rim():
    planted = Planted()
    plane = 0.2 + 0.001 * torch.arange(W) + 0.002 * torch.arange(H)[:, None]
    planted.depth = (1 / plane)[None]
    planted.plant(slice(20, 24), slice(30, 36))
    planted.plant(slice(40, 49), slice(40, 49))  # nine wide: silenced around a single outlier
    planted.plant(slice(20, 40), slice(60, 75))  # a region, no pinhole
    found = planted.filtered()
    holes = box(slice(20, 24), slice(30, 36)) | box(slice(40, 49), slice(40, 49))
    assert torch.equal(changed(planted, found), holes)
    assert (found.source[0][holes] == Source.FILLED).all() and (found.gate[0][holes] == Gate.ANSWER).all()
    assert ((found.depth[0] * plane)[holes] - 1).abs().max() < 1e-4
    sigma_rel = (found.sigma / found.depth)[0][holes]
    assert ((sigma_rel > 0.045) & (sigma_rel < 0.06)).all(), "the rim's, none for the fit"
    assert torch.allclose(found.score[0][holes], 0.1 / (0.1 + sigma_rel))


def test_a_pinhole_between_two_surfaces_stays_and_a_bent_rim_widens_sigma():
    planted = Planted()
    planted.depth[..., 40:] = 2.0
    planted.grey[..., 40:] = 0.9
    planted.plant(slice(20, 24), slice(38, 42))
    found = planted.filtered()
    assert not found.keep[0, 20:24, 38:42].any() and not changed(planted, found).any()
    planted = Planted()
    planted.depth[0, ::2] *= 1.04  # rough by 4 %
    planted.plant(slice(20, 24), slice(30, 34))
    found = planted.filtered()
    ratio = (found.sigma / found.depth)[0, 20:24, 30:34]
    assert found.keep[0, 20:24, 30:34].all() and (ratio > 0.055).all() and (ratio < 0.08).all()


def test_gaps_amid_returns_are_filled_however_long():
    planted = Planted(2.0)
    planted.plant(slice(None), slice(None), 2.0, returned=True)
    gaps = box(slice(2, 58), 20) | box(30, slice(40, 70)) | box(slice(50, 52), slice(5, 15))
    planted.returned[0][gaps] = False
    found = planted.filtered()
    filled = found.source[0] == Source.FILLED
    assert torch.equal(filled, gaps)
    assert torch.allclose(found.depth[0][gaps], torch.tensor(2.0)) and torch.allclose(
        found.sigma[0][gaps], torch.tensor(0.02), rtol=1e-3
    )


def test_a_wider_silence_amid_returns_is_no_pinhole():
    planted = Planted(2.0)
    planted.plant(slice(None), slice(None), 2.0, returned=True)
    planted.reach_out()
    for row, width in ((5, 5), (20, 6), (40, 8)):
        planted.returned[0, row : row + width, 30:38] = planted.answered[0, row : row + width, 30:38] = False
    filled = planted.filtered().source[0] == Source.FILLED
    assert filled[5:10, 30:38].all() and not filled[22:24, 33:35].any() and not filled[43:45, 33:35].any()
    assert planted.filtered(torch.tensor([True])).keep[0, 40:48, 30:38].all(), "no evidence if sparse"


def test_kept_depths_keep_their_gradient_and_filled_ones_have_none():
    planted = Planted()
    planted.plant(slice(20, 24), slice(30, 36))
    swept, returns = planted.maps()
    depth = swept.depth.requires_grad_()
    found = filter_map(swept.replace(depth=depth), returns, planted.grey)
    found.depth.sum().backward()
    hole = box(slice(20, 24), slice(30, 36))
    assert (depth.grad[0][~hole] == 1).all() and (depth.grad[0][hole] == 0).all()
