"""A map of two grids: what is recovered less surely than the sensor sees is there, and stands where it should."""

import pytest
import torch

from dhtorch.codes import Source
from dhtorch.integrate import Surface
from dhtorch.integrate.from_maps import FrameMap, fuse_frame_maps
from dhtorch.integrate.scales import choose_coarse_voxel, merge_surfaces
from dhtorch.synthetic.recording import SyntheticRoom

NEAR = 2.2


def test_unsure_depth_gets_voxels_of_its_own_and_sure_depth_the_sensors():
    assert choose_coarse_voxel(0.01, torch.tensor([0.12, 0.16, 0.2, torch.nan, 0.0])) == pytest.approx(0.04)
    assert choose_coarse_voxel(0.01, torch.full((9,), 0.064)) == pytest.approx(0.016)
    assert choose_coarse_voxel(0.01, torch.full((9,), 0.056)) is None, "1.4 voxels"
    assert choose_coarse_voxel(0.01, torch.zeros(0)) is None


def surface(xyz, source, face=None):
    xyz = torch.tensor(xyz, dtype=torch.float32)
    n = len(xyz)
    return Surface(xyz, xyz, xyz, torch.ones(n), torch.tensor(source, dtype=torch.int32), face=face)


def test_of_the_coarse_surface_stays_what_the_sensor_has_not_made():
    triangles = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    fine = surface([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [Source.SENSOR] * 3, torch.tensor([[0, 1, 2]]))
    S, W = Source.SENSOR, Source.SWEPT
    wide = surface([[float(k), 5, 5] for k in range(6)], [S, W, W, W, S, W], triangles)
    both = merge_surfaces(fine, wide)
    assert both.xyz[:, 0].tolist() == [0, 1, 0, 1, 2, 3] and both.source.tolist() == [S] * 3 + [W] * 3
    assert both.face.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert both.xyz[both.face[1]][:, 0].tolist() == [1, 2, 3]
    cloud = merge_surfaces(fine.replace(face=None), wide.replace(face=None))
    assert cloud.xyz[:, 0].tolist() == [0, 1, 0, 1, 2, 3, 5] and cloud.face is None


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(hw=(96, 128), depth_hw=(96, 128), n_frames=4, supersample=1, lidar="exact", step_m=0.1)


def seen(room, sigma_rel):
    """Maps of the frames: the sensor's depth up to a range, and beyond it depth that errs by a share of itself."""

    def read(k):
        depth = room[k].depth[0].nan_to_num()
        draw = torch.Generator().manual_seed(k)
        far = depth > NEAR
        noise = sigma_rel * torch.nn.functional.interpolate(
            torch.randn(1, 1, 6, 8, generator=draw), depth.shape, mode="bilinear"
        )
        sigma = torch.where(far, sigma_rel, 0.01) * depth
        source = torch.where(far, Source.SWEPT, Source.SENSOR).to(torch.int32)
        return FrameMap(torch.where(far, depth * (1 + noise[0, 0]), depth), sigma, source.where(depth > 0, Source.NONE))

    return read


def test_swept_depth_is_in_the_map_however_unsure_it_is(room):
    truth, found = (fuse_frame_maps(room, range(4), seen(room, s), voxel=0.02, meshed=False)[0] for s in (0.0001, 0.06))
    swept = found.source == Source.SWEPT
    reach = torch.cdist(truth.xyz[truth.source == Source.SWEPT][::7], found.xyz[swept]).amin(1)
    assert float((reach < 0.25).double().mean()) > 0.6  # most of what was swept is covered
    assert float(torch.cdist(found.xyz[swept][::3], truth.xyz).amin(1).median()) < 1.5 * 0.06 * 3 + 0.02
