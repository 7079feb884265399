"""Programs that the package writes for read its files: Open3D, COLMAP (pycolmap), and gradio builds the page of the space."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from dhtorch.codes import Source
from dhtorch.export import ColmapImage, Shape, write_colmap, write_glb, write_ply
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.integrate import DepthView, extract_mesh, fuse_views, make_volume
from dhtorch.records import Camera
from dhtorch.synthetic.recording import SyntheticRoom

XYZ = torch.tensor([[0.5, -1.0, 2.0], [float("nan"), 0.0, 1.0], [3.0, 4.0, 5.0], [0.25, 0.5, 1.0]])
KEPT = [0, 2, 3]
SIGMA, SOURCE = torch.tensor([0.1, 0.2, 0.25, 0.5]), torch.tensor([Source.SENSOR, 0, Source.RECOVERED, 2])

#: COLMAP's camera models -> distortion in OpenCV's order.
LENSES = {
    "PINHOLE": None,
    "OPENCV": [0.1, -0.05, 0.002, -0.001],
    "FULL_OPENCV": [0.1, -0.05, 0.002, -0.001, 0.01, 0.02, -0.01, 0.003],
}


def test_open3d_reads_points_mesh_and_squares(tmp_path):
    o3d = pytest.importorskip("open3d")
    rgb, face = torch.rand(4, 3), torch.tensor([[0, 2, 3], [0, 1, 3]])
    write_ply(tmp_path / "a.ply", XYZ, rgb, normal=XYZ, face=face, sigma=SIGMA, source=SOURCE)
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(np.asarray(mesh.vertices), XYZ[KEPT])
    assert len(mesh.triangles) == 1 and mesh.has_vertex_normals() and mesh.has_vertex_colors()
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_allclose(cloud.point["sigma"].numpy().ravel(), SIGMA[KEPT])
    assert cloud.point["source"].numpy().ravel().tolist() == SOURCE[KEPT].tolist()
    write_glb(tmp_path / "a.glb", [Shape("cloud", XYZ, rgb, square=0.1)], up=(0, 1, 0))
    squares = o3d.io.read_triangle_mesh(str(tmp_path / "a.glb"))
    corners = np.asarray(squares.vertices)[np.asarray(squares.triangles)].reshape(3, 6, 3)[:, [0, 1, 2, 5]]
    np.testing.assert_allclose(corners.mean(1), XYZ[KEPT], atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_colmap_sees_every_point_where_it_was_seen(tmp_path, name):
    pycolmap = pytest.importorskip("pycolmap")
    k = None if LENSES[name] is None else torch.tensor([LENSES[name]]).double()
    camera = Camera(torch.tensor([[520.0, 510.0]]).double(), torch.tensor([[319.5, 231.25]]).double(), k)
    poses = [se3.exp((0.4 * torch.rand(1, 6).double() - 0.2) * scale) for scale in (1.0, 1.5)]
    images = [ColmapImage(f"{i}.png", camera, (480, 640), T) for i, T in enumerate(poses)]
    xyz = torch.rand(40, 3).double() * 2 + torch.tensor([-1.0, -1.0, 2.0])
    uv = torch.stack([cameras.project(camera, se3.apply(se3.invert(T), xyz[None]))[0] for T in poses], 1)
    seen = torch.tensor([[0, 1]]).repeat(40, 1)
    rgb, error = torch.rand(40, 3), 0.1 * torch.rand(40)
    seen[3, 1], xyz[5, 0] = -1, torch.nan
    write_colmap(tmp_path, images, xyz, rgb=rgb, error=error, seen_by=seen, uv=uv)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert len(model.images) == 2 and len(model.points3D) == 39
    (theirs,) = model.cameras.values()
    assert (theirs.model_name, theirs.width, theirs.height) == (name, 640, 480)
    assert (theirs.principal_point_x, theirs.principal_point_y) == (320, pytest.approx(231.75)), "corner at 0"
    misses = [
        np.abs(theirs.img_from_cam(image.cam_from_world() * model.points3D[p.point3D_id].xyz) - p.xy).max()
        for image in model.images.values()
        for p in image.points2D
        if p.has_point3D()
    ]
    assert len(misses) == 77 and max(misses) < 1e-4
    first = model.points3D[1]
    assert first.error == pytest.approx(float(error[0])) and first.track.length() == 2
    assert model.points3D[4].track.length() == 1 and np.abs(first.color - 255 * rgb[0].numpy()).max() <= 0.5


def test_open3d_fuses_the_same_surface():
    o3d, spatial = pytest.importorskip("open3d"), pytest.importorskip("scipy.spatial")
    integration = o3d.pipelines.integration
    room, ours = SyntheticRoom(lidar="exact", hw=(240, 320), supersample=1), make_volume(0.02, channels=3)
    origin = np.array([-2.81, -2.81, -0.61])  # centres of its voxels on ours
    kind = integration.TSDFVolumeColorType.NoColor
    theirs = integration.UniformTSDFVolume(length=5.12, resolution=256, sdf_trunc=0.08, color_type=kind, origin=origin)
    for i in (0, 3, 6, 9):
        frame, T = room[i], room.true_poses[i : i + 1]
        colour = frame.image.permute(0, 2, 3, 1)
        camera = frame.depth_camera or frame.camera
        sigma = torch.full_like(frame.depth, 0.005)
        ours = fuse_views(ours, DepthView(frame.depth, sigma, colour.float() / 255, camera, T))
        images = (o3d.geometry.Image(x[0].contiguous().numpy()) for x in (colour, frame.depth))
        rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(*images, 1.0, 10.0, False)
        lens = o3d.camera.PinholeCameraIntrinsic(320, 240, *camera.f[0].tolist(), *camera.c[0].tolist())
        theirs.integrate(rgbd, lens, np.linalg.inv(se3.to_matrix(T)[0].numpy()))
    here, there = extract_mesh(ours).xyz.numpy(), np.asarray(theirs.extract_triangle_mesh().vertices)
    far, back = spatial.cKDTree(there).query(here)[0], spatial.cKDTree(here).query(there)[0]
    assert np.median(far) < 1e-4 and np.quantile(far, 0.9) < 0.002 and np.quantile(far, 0.99) < 0.01
    assert np.median(back) < 1e-4 and (back < 0.02).mean() > 0.9, "Open3D keeps rims that we leave out"


def test_gradio_builds_the_page_of_the_space():
    pytest.importorskip("gradio")
    app = Path(__file__).resolve().parents[2] / "integrations" / "space" / "app.py"
    spec = importlib.util.spec_from_file_location("space_page", app)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.build_page() is not None
