"""Files for other programs, read back by other programs: plyfile, trimesh, Open3D, COLMAP."""

import json
import math
import struct

import numpy as np
import pytest
import torch

from dhtorch.codes import Hole, Source
from dhtorch.export import ColmapImage, Shape, nerfstudio, write_colmap, write_glb, write_ply
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera
from dhtorch.viz.plots import colours as palette

XYZ = torch.tensor([[0.5, -1.0, 2.0], [math.nan, 0.0, 1.0], [3.0, 4.0, 5.0], [0.25, 0.5, 1.0]])
RGB = torch.tensor([[0.0, 0.5, 1.0], [1.0, 1.0, 1.0], [2.0, 0.2, -1.0], [0.1, math.nan, 0.3]])
ABOUT = {
    "sigma": torch.tensor([0.1, 0.2, 0.25, 0.5]),
    "score": torch.tensor([1.0, 0.0, 0.5, 0.75]),
    "hole": torch.tensor([Hole.NONE, Hole.NONE, Hole.TRACKABLE_NO_LIDAR, Hole.HIGHLIGHT], dtype=torch.int32),
    "source": torch.tensor([Source.SENSOR, Source.SENSOR, Source.RECOVERED, Source.RECOVERED], dtype=torch.int32),
}
FACE = torch.tensor([[0, 2, 3], [0, 1, 3]])
KEPT = [0, 2, 3]


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "points.ply"
    assert write_ply(path, XYZ, RGB, normal=torch.nn.functional.normalize(XYZ, dim=-1), face=FACE, **ABOUT) == 3
    return path


def test_plyfile_reads_every_property(ply):
    plyfile = pytest.importorskip("plyfile")
    data = plyfile.PlyData.read(ply)
    assert data.byte_order == "<" and not data.text and data.comments == ["metres; x right, y down, z forward"]
    vertex = data["vertex"]
    names = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "sigma", "score", "class", "source"]
    names.append("quality")
    assert [p.name for p in vertex.properties] == names
    assert [p.val_dtype for p in vertex.properties] == ["f4"] * 6 + ["u1"] * 3 + ["f4"] * 2 + ["u1"] * 2 + ["f4"]
    np.testing.assert_array_equal(vertex["quality"], vertex["sigma"])
    np.testing.assert_array_equal(np.stack([vertex[k] for k in "xyz"], 1), XYZ[KEPT])
    assert vertex["red"].tolist() == [0, 255, 26] and vertex["green"].tolist() == [128, 51, 0]
    for name in ("sigma", "score", "source"):
        np.testing.assert_array_equal(vertex[name], ABOUT[name][KEPT])
    assert vertex["class"].tolist() == [0, 1, 5]
    assert [f.tolist() for f in data["face"]["vertex_indices"]] == [[0, 1, 2]], "the triangle of a lost point goes too"


def test_trimesh_reads_points_and_mesh(ply, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(ply, process=False)
    np.testing.assert_array_equal(mesh.vertices, XYZ[KEPT])
    assert mesh.faces.tolist() == [[0, 1, 2]] and mesh.visual.vertex_colors[0].tolist() == [0, 128, 255, 255]
    write_ply(tmp_path / "cloud.ply", XYZ, RGB)
    cloud = trimesh.load(tmp_path / "cloud.ply")
    assert isinstance(cloud, trimesh.PointCloud) and len(cloud.vertices) == 3


def test_open3d_reads_it(ply):
    o3d = pytest.importorskip("open3d")
    mesh = o3d.io.read_triangle_mesh(str(ply))
    np.testing.assert_array_equal(np.asarray(mesh.vertices), XYZ[KEPT])
    assert len(mesh.triangles) == 1 and mesh.has_vertex_normals() and mesh.has_vertex_colors()
    cloud = o3d.t.io.read_point_cloud(str(ply))
    np.testing.assert_allclose(cloud.point["sigma"].numpy().ravel(), ABOUT["sigma"][KEPT])
    assert cloud.point["source"].numpy().ravel().tolist() == [1, 2, 2]


def test_an_empty_ply_and_one_of_arrays(tmp_path):
    path = tmp_path / "empty.ply"
    assert write_ply(path, np.zeros((0, 3)), np.zeros((0, 3)), face=np.zeros((0, 3), int), sigma=np.zeros(0)) == 0
    assert b"element vertex 0\n" in path.read_bytes() and path.read_bytes().endswith(b"end_header\n")
    assert write_ply(path, XYZ.numpy(), (255 * RGB.nan_to_num().clamp(0, 1)).byte().numpy(), sigma=None) == 3
    assert b"sigma" not in path.read_bytes()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"rgb": RGB[:2]}, r"write_ply: rgb has shape \(2, 3\), expected \(4, 3\)"),
        ({"sigma": torch.zeros(3)}, r"write_ply: sigma has shape \(3,\), expected \(4\)"),
        ({"face": FACE[:, :2]}, r"face has shape \(2, 2\), expected \(P, 3\)"),
        ({"face": FACE + 2}, "face names points 2 to 5, expected 0 to 3"),
        ({"face": FACE - 1}, "face names points -1 to 2, expected 0 to 3"),
    ],
)
def test_wrong_arrays_raise_and_write_nothing(tmp_path, wrong, words):
    with pytest.raises(ValueError, match=words):
        write_ply(tmp_path / "a.ply", XYZ, **wrong)
    assert list(tmp_path.iterdir()) == []


def test_points_of_a_pair_are_coloured_by_their_source():
    colours = palette.colour_by_source(ABOUT["source"])
    assert (
        colours.dtype == np.uint8 and len({tuple(c) for c in colours[:2]}) == len({tuple(c) for c in colours[2:]}) == 1
    )
    assert tuple(colours[0]) != tuple(colours[2])


def test_an_interrupted_write_leaves_the_old_file(ply, monkeypatch):
    before = ply.read_bytes()
    monkeypatch.setattr("dhtorch.runtime.storage.os.fsync", lambda _handle: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_ply(ply, XYZ)
    assert ply.read_bytes() == before and [p.name for p in ply.parent.iterdir()] == ["points.ply"]


# ---------------------------------------------------------------------------------------------------------------- GLB


def shapes():
    mesh = Shape("mesh", XYZ, RGB, normal=XYZ, face=FACE)
    return [mesh, Shape("cloud", XYZ[2:] * 2, RGB[2:], values={"sigma": ABOUT["sigma"][2:]})]


def test_trimesh_reads_glb_upright_and_in_its_colours(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_glb(tmp_path / "map.glb", shapes())
    scene = trimesh.load(tmp_path / "map.glb")
    assert sorted(scene.geometry) == ["cloud", "mesh"]
    mesh, cloud = scene.geometry["mesh"], scene.geometry["cloud"]
    assert isinstance(mesh, trimesh.Trimesh) and isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(mesh.vertices, XYZ[KEPT])
    assert mesh.faces.tolist() == [[0, 1, 2]]
    for name, points in (("mesh", XYZ[KEPT]), ("cloud", 2 * XYZ[2:])):
        T, _ = scene.graph[next(n for n in scene.graph.nodes_geometry if scene.graph[n][1] == name)]
        placed = points.numpy() @ T[:3, :3].T
        np.testing.assert_allclose(placed, points.numpy() * [1, -1, -1], atol=1e-6, err_msg="y up, right-handed")
    for linear in (mesh.visual.vertex_attributes["color"][1:], cloud.colors / 255.0):
        display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_allclose(display[:, :3], [[1, 0.2, 0], [0.1, 0, 0.3]], atol=0.02)


def glb_parts(path):
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    body = data[20 + size :]
    if body:
        n, kind = struct.unpack_from("<I4s", body)
        assert kind == b"BIN\0" and n == len(body) - 8 and n % 4 == 0
    return json.loads(data[20 : 20 + size]), body[8:]


def test_glb_keeps_the_rules_of_gltf(tmp_path):
    """Rules that loaders rely on: aligned views inside the buffer, counts that fit, bounds of positions, unit normals."""
    write_glb(tmp_path / "map.glb", shapes())
    document, body = glb_parts(tmp_path / "map.glb")
    assert document["asset"]["version"] == "2.0" and document["buffers"] == [{"byteLength": len(body)}]
    sizes = {5126: 4, 5123: 2, 5125: 4}
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        size = sizes[accessor["componentType"]] * widths[accessor["type"]]
        assert view["byteOffset"] % 4 == 0 and size % 4 == 0 and view["byteLength"] == size * accessor["count"] > 0
        assert view["byteOffset"] + view["byteLength"] <= len(body)
    for mesh in document["meshes"]:
        (primitive,) = mesh["primitives"]
        names = primitive["attributes"]
        counts = {document["accessors"][k]["count"] for k in names.values()}
        assert len(counts) == 1, "every attribute has as many entries"
        position = document["accessors"][names["POSITION"]]
        at = document["bufferViews"][position["bufferView"]]["byteOffset"]
        xyz = np.frombuffer(body, "<f4", 3 * position["count"], at).reshape(-1, 3)
        assert position["min"] == xyz.min(0).tolist() and position["max"] == xyz.max(0).tolist()
        if "indices" in primitive:
            index = document["accessors"][primitive["indices"]]
            offset = document["bufferViews"][index["bufferView"]]["byteOffset"]
            assert np.frombuffer(body, "<u4", index["count"], offset).max() < position["count"]
    cloud = document["meshes"][1]["primitives"][0]
    assert cloud["mode"] == 0 and {"_SIGMA", "COLOR_0", "POSITION"} == set(cloud["attributes"])
    normal = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
    at = document["bufferViews"][normal["bufferView"]]["byteOffset"]
    lengths = np.linalg.norm(np.frombuffer(body, "<f4", 3 * normal["count"], at).reshape(-1, 3), axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (0.3, -0.8, 0.2), (1, 0, 0), (1e-9, -1, 0)])
def test_any_direction_can_point_upwards(tmp_path, up):
    write_glb(tmp_path / "map.glb", shapes(), up=up)
    x, y, z, w = glb_parts(tmp_path / "map.glb")[0]["nodes"][0]["rotation"]
    v, q = np.array(up) / np.linalg.norm(up), np.array([x, y, z])
    turned = v + 2 * np.cross(q, np.cross(q, v) + w * v)
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-6)
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-9


def test_a_glb_without_anything_is_a_valid_one(tmp_path):
    write_glb(tmp_path / "map.glb", [Shape("none", torch.full((2, 3), math.nan))])
    document, body = glb_parts(tmp_path / "map.glb")
    assert document == {"asset": {"version": "2.0", "generator": "dhtorch"}, "scene": 0, "scenes": [{}]} and not body
    with pytest.raises(ValueError, match="expected a direction"):
        write_glb(tmp_path / "map.glb", [], up=(0, 0, 0))


def test_points_become_squares_that_every_mesh_reader_keeps(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    normal = torch.tensor([[0.0, 0, 1], [1, 0, 0], [math.nan, 0, 0], [0, 3, 4]])
    cloud = Shape("cloud", XYZ, RGB, normal=normal, values={"sigma": ABOUT["sigma"]}, square=0.1)
    write_glb(tmp_path / "map.glb", [cloud], up=(0, 1, 0))
    (mesh,) = trimesh.load(tmp_path / "map.glb", process=False).geometry.values()
    assert len(mesh.vertices) == 12 and len(mesh.faces) == 6, "four corners and two triangles a point"
    corners = mesh.vertices.reshape(3, 4, 3)
    np.testing.assert_allclose(corners.mean(1), XYZ[KEPT], atol=1e-6)
    np.testing.assert_allclose(mesh.area_faces, 0.005, rtol=1e-4)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    np.testing.assert_allclose(across, [[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]], atol=1e-5)
    sigma = mesh.vertex_attributes["_SIGMA"] if "_SIGMA" in mesh.vertex_attributes else mesh.vertex_attributes["_sigma"]
    np.testing.assert_allclose(sigma.ravel(), np.repeat(ABOUT["sigma"][KEPT], 4))


def test_open3d_keeps_the_squares(tmp_path):
    open3d = pytest.importorskip("open3d")
    write_glb(tmp_path / "map.glb", [Shape("cloud", XYZ, RGB, square=0.1)], up=(0, 1, 0))
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "map.glb"))
    assert len(mesh.triangles) == 6
    centre = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].reshape(3, 6, 3)[:, [0, 1, 2, 5]].mean(1)
    np.testing.assert_allclose(centre, XYZ[KEPT], atol=1e-6)


# ------------------------------------------------------------------------------------------------------------- COLMAP

LENSES = {
    "PINHOLE": None,
    "OPENCV": [0.1, -0.05, 0.002, -0.001],
    "FULL_OPENCV": [0.1, -0.05, 0.002, -0.001, 0.01, 0.02, -0.01, 0.003],
}


def model(lens, n=40, seed=0):
    """Two shots of some points, observed exactly."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    k = None if lens is None else torch.tensor([lens], dtype=torch.float64)
    camera = Camera(torch.tensor([[520.0, 510.0]]).double(), torch.tensor([[319.5, 231.25]]).double(), k)
    poses = [se3.exp((0.4 * draw(1, 6) - 0.2) * scale) for scale in (1.0, 1.5)]
    shots = [ColmapImage(f"{i}.png", camera, (480, 640), T) for i, T in enumerate(poses)]
    xyz = torch.cat((3 * draw(n, 2) - 1.5, 2 + 2 * draw(n, 1)), -1)
    uv = torch.stack(
        [cameras.project(camera, se3.apply(se3.invert(s.T_world_from_cam), xyz[None]))[0] for s in shots], 1
    )
    seen = torch.tensor([[0, 1]]).expand(n, 2).clone()
    return shots, xyz, draw(n, 3), 0.1 * draw(n), seen, uv


@pytest.mark.parametrize("name", LENSES)
def test_colmap_sees_every_point_where_we_do(tmp_path, name):
    pycolmap = pytest.importorskip("pycolmap")
    shots, xyz, rgb, error, seen, uv = model(LENSES[name])
    seen[3, 1], xyz[5, 0] = -1, math.nan
    write_colmap(tmp_path, shots, xyz, rgb=rgb, error=error, seen_by=seen, uv=uv)
    found = pycolmap.Reconstruction(str(tmp_path))
    assert len(found.cameras) == 1 and len(found.images) == 2 and len(found.points3D) == 39
    (camera,) = found.cameras.values()
    assert camera.model_name == name and (camera.width, camera.height) == (640, 480)
    assert camera.principal_point_x == pytest.approx(320.0) and camera.principal_point_y == pytest.approx(231.75)
    worst = 0.0
    for image in found.images.values():
        for point in image.points2D:
            if point.has_point3D():
                at = camera.img_from_cam(image.cam_from_world() * found.points3D[point.point3D_id].xyz)
                worst = max(worst, float(np.abs(at - point.xy).max()))
    assert worst < 1e-4, "half a pixel, the lens and the pose are as COLMAP has them"
    first = found.points3D[1]
    np.testing.assert_allclose(first.xyz, xyz[0], atol=1e-8)
    assert first.error == pytest.approx(float(error[0])) and first.track.length() == 2
    assert found.points3D[4].track.length() == 1 and np.abs(first.color - 255 * rgb[0].numpy()).max() <= 0.5


def test_colmap_files_have_two_lines_a_picture_and_few_cameras(tmp_path):
    shots, xyz, *columns = model(None)
    points = dict(zip(("rgb", "error", "seen_by", "uv"), columns, strict=True))
    other = shots[1].camera.replace(f=shots[1].camera.f * 2)
    write_colmap(tmp_path, [*shots, ColmapImage("2.png", other, (480, 640), shots[0].T_world_from_cam)], xyz, **points)
    lines = lambda name: [x for x in (tmp_path / name).read_text().split("\n")[:-1] if not x.startswith("#")]  # noqa: E731
    assert len(lines("cameras.txt")) == 2 and len(lines("images.txt")) == 6 and len(lines("points3D.txt")) == 40
    assert lines("images.txt")[5] == "", "a picture that sees nothing still has its line"
    with pytest.raises(ValueError, match="seen_by names shot 7, expected at most 1"):
        write_colmap(tmp_path, shots, xyz, **points | {"seen_by": points["seen_by"] * 0 + 7})
    with pytest.raises(ValueError, match=r"uv has shape \(40, 2, 1\)"):
        write_colmap(tmp_path, shots, xyz, **points | {"uv": points["uv"][..., :1]})


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, -0.3, 0.8), (0, 0, 0)])
@pytest.mark.parametrize("angle", [1e-9, 0.5, math.pi - 1e-9, math.pi, -3.0])
def test_quaternions_of_all_turns(tmp_path, axis, angle):
    way = torch.tensor([*axis], dtype=torch.float64)
    way = way / way.norm().clamp_min(1e-12) * angle
    T = se3.exp(torch.cat((way, torch.zeros(3).double()))[None])  # of the world in the camera, as COLMAP writes it
    (shot, _), *points = model(None, n=1)
    (row,) = written(tmp_path, ColmapImage("1.png", shot.camera, shot.hw, se3.invert(T)), *points)
    w, *v = map(float, row.split()[1:5])
    q = torch.tensor(v, dtype=torch.float64)
    K = se3.hat(q)
    again = torch.eye(3).double() + 2 * w * K + 2 * K @ K
    torch.testing.assert_close(again, T.R[0], atol=1e-9, rtol=0)
    assert w >= 0


def written(folder, shot, xyz, rgb, error, seen, uv):
    """The line of every picture of a model with one picture."""
    write_colmap(folder, [shot], xyz, rgb=rgb, error=error, seen_by=seen[:, :1], uv=uv[:, :1])
    lines = [x for x in (folder / "images.txt").read_text().splitlines() if not x.startswith("#")]
    return lines[::2]


def test_a_track_names_the_observation_of_its_point(tmp_path):
    """POINT2D_IDX counts from 0 among the observations of its image, IMAGE_ID and POINT3D_ID from 1."""
    shots, xyz, rgb, error, seen, uv = model(None, n=12)
    seen[0, 0], seen[3, 1], xyz[5, 0] = -1, -1, math.nan
    write_colmap(tmp_path, shots, xyz, rgb=rgb, error=error, seen_by=seen, uv=uv)
    lines = {
        name: [x for x in (tmp_path / name).read_text().split("\n")[:-1] if not x.startswith("#")]
        for name in ("images.txt", "points3D.txt")
    }
    observed = {
        int(head.split()[0]): [tuple(row.split()[k : k + 3]) for k in range(0, len(row.split()), 3)]
        for head, row in zip(lines["images.txt"][::2], lines["images.txt"][1::2], strict=True)
    }
    assert sorted(observed) == [1, 2] and [len(observed[k]) for k in (1, 2)] == [10, 10]
    for image, rows in observed.items():
        kept = [p for p in range(12) if p != 5 and seen[p, image - 1] >= 0]
        written_uv = np.array([[float(u), float(v)] for u, v, _ in rows])
        assert np.allclose(written_uv, uv[kept, image - 1].numpy() + 0.5, atol=1e-6)
    (camera,) = [x for x in (tmp_path / "cameras.txt").read_text().split("\n")[:-1] if not x.startswith("#")]
    assert camera.split() == ["1", "PINHOLE", "640", "480", "520", "510", "320", "231.75"]
    assert [line.split()[8] for line in lines["images.txt"][::2]] == ["1", "1"]
    named = set()
    for line in lines["points3D.txt"]:
        number, track = line.split()[0], line.split()[8:]
        for image, place in zip(map(int, track[::2]), map(int, track[1::2]), strict=True):
            assert observed[image][place][2] == number
            named.add((image, place))
    assert named == {(image, place) for image in observed for place in range(10)}


def test_a_frame_of_nerfstudio_has_its_lens_pose_and_centre():
    K, T = np.array([[50.0, 0, 20], [0, 60, 10], [0, 0, 1]]), np.eye(4)
    T[:3, 3] = 1, 2, 3
    shot = nerfstudio.make_nerfstudio_frame("a", (30, 40), K, T, (0.1, -0.2, 0.01, 0.02, 0.3), 4.5)
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "timestamp", "k1", "k2", "p1", "p2", "k3")
    assert [shot[name] for name in names] == [50, 60, 20.5, 10.5, 40, 30, 4.5, 0.1, -0.2, 0.01, 0.02, 0.3]
    assert shot["transform_matrix"] == [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]]
    assert not {"k1", "timestamp"} & set(nerfstudio.make_nerfstudio_frame("a", (30, 40), K, T))
    with pytest.raises(ValueError, match="found 6 distortion coefficients"):
        nerfstudio.make_nerfstudio_frame("a", (30, 40), K, T, (0, 0, 0, 0, 0, 0.1))


def test_depth_and_confidence_of_nerfstudio_are_steps_of_a_millimetre_and_a_share():
    depth = np.array([[0.0, 0.0004, 0.0006, 1.2344, 65.534, 65.535, 65.536]])
    assert nerfstudio.quantise_nerfstudio_depth(depth).tolist() == [[0, 0, 1, 1234, 65534, 0, 0]]
    sigma = np.array([[1.0, 0.1, 0.2, 0.0, 1000.0]])
    confidence = nerfstudio.encode_confidence(np.array([[0.0, 1.0, 2.0, 1.0, 1.0]]), sigma)
    assert confidence.tolist() == [[0, 128, 128, 255, 1]]
