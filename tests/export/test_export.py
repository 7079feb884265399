"""Files for other programs, read back by other programs (plyfile, trimesh) and by plain parsers: every number, in its place."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support import known_episodes as known
from support.known_episodes import HW, LENS
from support.read_back import Array, linear, read_glb, same

from dhtorch.codes import Hole, Source
from dhtorch.export import ColmapImage, Shape, write_colmap, write_glb, write_ply
from dhtorch.extract import nerf_target as nerfstudio
from dhtorch.geometry import se3
from dhtorch.records import Camera

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


# ---------------------------------------------------------------------------------------------------------------- PLY


def test_plyfile_and_trimesh_read_every_property(tmp_path: Path) -> None:
    plyfile, trimesh = pytest.importorskip("plyfile"), pytest.importorskip("trimesh")
    path, normal = tmp_path / "points.ply", torch.nn.functional.normalize(XYZ, dim=-1)
    assert write_ply(path, XYZ, RGB, normal=normal, face=FACE, **ABOUT) == 3
    data = plyfile.PlyData.read(path)
    assert data.byte_order == "<" and not data.text and data.comments == ["metres; x right, y down, z forward"]
    colours = {"red": [0, 255, 26], "green": [128, 51, 0], "blue": [255, 0, 77]}
    want = {name: (column, "f4") for name, column in zip("xyz", XYZ[KEPT].T, strict=True)}
    want |= {f"n{name}": (column, "f4") for name, column in zip("xyz", normal[KEPT].T, strict=True)}
    want |= {name: (column, "u1") for name, column in colours.items()}
    want |= {name: (ABOUT[name][KEPT], "f4") for name in ("sigma", "score")}
    want |= {
        "class": ([0, 1, 5], "u1"),
        "source": (ABOUT["source"][KEPT], "u1"),
        "quality": (ABOUT["sigma"][KEPT], "f4"),
    }
    assert [(p.name, p.val_dtype) for p in data["vertex"].properties] == [(k, kind) for k, (_, kind) in want.items()]
    for name, (column, _) in want.items():
        np.testing.assert_array_equal(data["vertex"][name], column)
    assert [f.tolist() for f in data["face"]["vertex_indices"]] == [[0, 1, 2]], "the triangle of a lost point goes too"
    mesh = trimesh.load(path, process=False)
    assert mesh.faces.tolist() == [[0, 1, 2]] and mesh.visual.vertex_colors[0].tolist() == [0, 128, 255, 255]


def test_an_empty_ply_and_one_of_arrays(tmp_path: Path) -> None:
    path = tmp_path / "empty.ply"
    assert write_ply(path, np.zeros((0, 3)), np.zeros((0, 3)), face=np.zeros((0, 3), int), sigma=np.zeros(0)) == 0
    assert b"element vertex 0\n" in path.read_bytes() and path.read_bytes().endswith(b"end_header\n")
    assert write_ply(path, XYZ.numpy(), (255 * RGB.nan_to_num().clamp(0, 1)).byte().numpy(), sigma=None) == 3
    assert b"sigma" not in path.read_bytes()


def colmap_points(n: int = 20) -> tuple[dict[str, Any], Array]:
    """Points of a COLMAP model by argument, with distinct numbers, one without a place and one observation without."""
    draw = np.random.default_rng(1)
    xyz = draw.uniform(-2, 2, (n, 3)) + np.array([0, 0, 4])
    xyz[1, 2] = np.nan
    seen = draw.permuted(np.tile(np.arange(4), (n, 1)), axis=1)
    seen[draw.random((n, 4)) < 0.4] = -1
    uv = draw.uniform(0, 40, (n, 4, 2))
    uv[3, 2] = np.nan
    rgb = draw.integers(0, 256, (n, 3)).astype(np.uint8)
    return {"xyz": xyz, "rgb": rgb, "error": draw.random(n), "seen_by": seen, "uv": torch.from_numpy(uv)}, uv


@pytest.mark.parametrize(
    ("write", "words"),
    [
        *(
            (lambda path, wrong=wrong: write_ply(path / "a.ply", XYZ, **wrong), words)
            for wrong, words in [
                ({"rgb": RGB[:2]}, r"write_ply: rgb has shape \(2, 3\), expected \(4, 3\)"),
                ({"sigma": torch.zeros(3)}, r"write_ply: sigma has shape \(3,\), expected \(4\)"),
                ({"face": FACE[:, :2]}, r"face has shape \(2, 2\), expected \(P, 3\)"),
                ({"face": FACE + 2}, "face names points 2 to 5, expected 0 to 3"),
                ({"face": FACE - 1}, "face names points -1 to 2, expected 0 to 3"),
            ]
        ),
        (lambda path: write_glb(path / "a.glb", [], up=(0, 0, 0)), "expected a direction"),
        (lambda path: write_colmap(path, [], **colmap_points()[0]), "seen_by names shot 3, expected at most -1"),
        (
            lambda path: write_colmap(path, [], **colmap_points()[0] | {"uv": torch.zeros(20, 4, 1)}),
            r"uv has shape \(20, 4, 1\), expected \(20, 4, 2\)",
        ),
        (
            lambda _: nerfstudio.make_nerfstudio_frame("a", (30, 40), np.eye(3), np.eye(4), (0, 0, 0, 0, 0, 0.1)),
            "found 6 distortion coefficients",
        ),
    ],
)  # fmt: skip
def test_wrong_arrays_raise_and_write_nothing(tmp_path: Path, write: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------------------------------- GLB


def shapes() -> list[Shape]:
    mesh = Shape("mesh", XYZ, RGB, normal=XYZ, face=FACE)
    return [mesh, Shape("cloud", XYZ[2:] * 2, RGB[2:], values={"sigma": ABOUT["sigma"][2:]})]


def test_a_glb_holds_every_column_and_trimesh_reads_it_upright(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_glb(tmp_path / "map.glb", shapes())
    nodes, (mesh, cloud) = read_glb(tmp_path / "map.glb")
    assert [node["name"] for node in nodes] == ["mesh", "cloud"] and mesh.keys() ^ cloud.keys() == {
        "NORMAL",
        "indices",
        "_SIGMA",
    }
    same(mesh["POSITION"], XYZ[KEPT])
    same(mesh["NORMAL"], torch.nn.functional.normalize(XYZ[KEPT], dim=-1), 1e-6)
    same(mesh["COLOR_0"], linear(np.array([[0, 128, 255], [255, 51, 0], [26, 0, 77]])), 1e-6)
    assert mesh["indices"].tolist() == [0, 1, 2]
    same(cloud["POSITION"], 2 * XYZ[2:])
    same(cloud["_SIGMA"], ABOUT["sigma"][2:])
    scene = trimesh.load(tmp_path / "map.glb")
    assert isinstance(scene.geometry["mesh"], trimesh.Trimesh) and isinstance(
        scene.geometry["cloud"], trimesh.PointCloud
    )
    for name, points in (("mesh", XYZ[KEPT]), ("cloud", 2 * XYZ[2:])):
        T, _ = scene.graph[next(n for n in scene.graph.nodes_geometry if scene.graph[n][1] == name)]
        placed = points.numpy() @ T[:3, :3].T
        np.testing.assert_allclose(placed, points.numpy() * [1, -1, -1], atol=1e-6, err_msg="y up, right-handed")


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (0.3, -0.8, 0.2), (1, 0, 0), (1e-9, -1, 0)])
def test_any_direction_can_point_upwards(tmp_path: Path, up: tuple[float, float, float]) -> None:
    write_glb(tmp_path / "map.glb", shapes(), up=up)
    x, y, z, w = read_glb(tmp_path / "map.glb")[0][0]["rotation"]
    np.testing.assert_allclose(rotation((w, x, y, z)) @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-6)
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-9


def test_a_glb_without_anything_is_a_valid_one(tmp_path: Path) -> None:
    write_glb(tmp_path / "map.glb", [Shape("none", torch.full((2, 3), math.nan))])
    assert read_glb(tmp_path / "map.glb") == ([], [])
    assert (tmp_path / "map.glb").read_bytes()[20:].strip().endswith(b'"scene":0,"scenes":[{}]}')


def test_points_become_squares_that_every_mesh_reader_keeps(tmp_path: Path) -> None:
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
    (arrays,) = read_glb(tmp_path / "map.glb")[1]
    same(arrays["_SIGMA"], np.repeat(ABOUT["sigma"][KEPT], 4))


# ------------------------------------------------------------------------------------------------------------- COLMAP


def rotation(quaternion: Sequence[float]) -> Array:
    """w, x, y, z -> (3, 3)."""
    w, *v = quaternion
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


def lines_of(file: Path) -> list[str]:
    return [line for line in file.read_text().split("\n")[:-1] if not line.startswith("#")]


def test_a_colmap_model_holds_every_number(tmp_path: Path) -> None:
    """Both cameras in two frames, the first of them once more; points are seen by some of the frames, and tracks lead back
    to their observations."""
    where = [*((camera, 1, i) for camera in (0, 1) for i in (2, 5)), (0, 1, 2)]
    frames = [known.frame(*each) for each in where]
    shots = [
        ColmapImage(f"{k}.png", frame.camera, HW, frame.T_world_from_cam, known.time(*at))
        for k, (frame, at) in enumerate(zip(frames, where, strict=True))
    ]
    points, uv = colmap_points()
    write_colmap(tmp_path, shots, **points)

    cameras = {int(w[0]): w[1:] for w in map(str.split, lines_of(tmp_path / "cameras.txt"))}
    images = lines_of(tmp_path / "images.txt")
    observed: dict[int, list[list[float]]] = {}
    assert len(images) == 10 and images[9] == "" and len(cameras) == 4, "a picture that sees nothing still has its line"
    times = dict(map(str.split, lines_of(tmp_path / "times.txt")))
    for k, at in enumerate(where):
        words = images[2 * k].split()
        assert int(words[0]) == k + 1 and words[9] == f"{k}.png" and float(times[words[0]]) == known.time(*at)
        T = np.linalg.inv(known.pose(*at))
        same(rotation([float(x) for x in words[1:5]]), T[:3, :3], 1e-8)
        same([float(x) for x in words[5:8]], T[:3, 3], 1e-8)
        model, *numbers = cameras[int(words[8])]
        K = known.intrinsics(*at)
        lens = (*LENS, 0, 0, 0) if at[0] else ()
        assert model == ("FULL_OPENCV" if at[0] else "PINHOLE")
        same([float(x) for x in numbers], [HW[1], HW[0], *K[[0, 1], [0, 1]], *(K[:2, 2] + 0.5), *lens], 1e-7)
        values = [float(x) for x in images[2 * k + 1].split()]
        observed[k + 1] = np.reshape(values, (-1, 3)).tolist()
    rows = [line.split() for line in lines_of(tmp_path / "points3D.txt")]
    kept = np.flatnonzero(np.isfinite(points["xyz"]).all(1))
    assert [int(row[0]) for row in rows] == list(range(1, len(kept) + 1))
    for row, p in zip(rows, kept, strict=True):
        same([float(x) for x in row[1:4]], points["xyz"][p], 1e-8)
        assert [int(x) for x in row[4:7]] == points["rgb"][p].tolist()
        assert float(row[7]) == pytest.approx(points["error"][p])
        track = np.reshape([int(x) for x in row[8:]], (-1, 2)).tolist()
        seen = points["seen_by"][p]
        want = [(shot, uv[p, k]) for k, shot in enumerate(seen) if shot >= 0 and np.isfinite(uv[p, k]).all()]
        assert [image for image, _ in track] == [shot + 1 for shot, _ in want]
        for (image, place), (_, pixel) in zip(track, want, strict=True):
            same(observed[image][place], [*(pixel + 0.5), int(row[0])], 1e-7)
    assert sum(map(len, observed.values())) == sum(len(row[8:]) // 2 for row in rows) > 20


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, -0.3, 0.8), (0, 0, 0)])
@pytest.mark.parametrize("angle", [1e-9, 0.5, math.pi - 1e-9, math.pi, -3.0])
def test_quaternions_and_lenses_of_four_coefficients(tmp_path: Path, axis: Sequence[float], angle: float) -> None:
    way = torch.tensor([*axis], dtype=torch.float64)
    way = way / way.norm().clamp_min(1e-12) * angle
    T = se3.exp(torch.cat((way, torch.zeros(3).double()))[None])  # of the world in the camera, as COLMAP writes it
    camera = Camera(
        torch.tensor([[520.0, 510.0]]), torch.tensor([[319.5, 231.25]]), torch.tensor([[0.5, -0.25, 0.0, 1.0]])
    )
    none = {"rgb": np.zeros((0, 3)), "error": np.zeros(0), "seen_by": np.zeros((0, 1)), "uv": torch.zeros(0, 1, 2)}
    write_colmap(tmp_path, [ColmapImage("1.png", camera, (480, 640), se3.invert(T))], np.zeros((0, 3)), **none)
    assert lines_of(tmp_path / "cameras.txt") == ["1 OPENCV 640 480 520 510 320 231.75 0.5 -0.25 0 1"]
    w, *v = map(float, lines_of(tmp_path / "images.txt")[0].split()[1:5])
    same(rotation((w, *v)), T.R[0], 1e-9)
    assert w >= 0


def test_depth_and_confidence_of_nerfstudio_are_steps_of_a_millimetre_and_a_share() -> None:
    depth = np.array([[0.0, 0.0004, 0.0006, 1.2344, 65.534, 65.535, 65.536]])
    assert nerfstudio.quantise_nerfstudio_depth(depth).tolist() == [[0, 0, 1, 1234, 65534, 0, 0]]
    sigma = np.array([[1.0, 0.1, 0.2, 0.0, 1000.0]])
    confidence = nerfstudio.encode_confidence(np.array([[0.0, 1.0, 2.0, 1.0, 1.0]]), sigma)
    assert confidence.tolist() == [[0, 128, 128, 255, 1]]
