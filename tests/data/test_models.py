"""Models up to scale: every format is read as it was made, and written in metres with all else unchanged."""

import dataclasses
import os

import numpy as np
import pytest
import torch
from support.byte_damage import STRANGE_FILES

from dhtorch.data import FormatError
from dhtorch.data.models import Similarity, network, read_model, scene_model, write_model
from tests.support import room_models as made
from tests.support.byte_damage import change_middle

WRITERS = {
    "colmap txt": (made.write_colmap_text, "points"),
    "colmap bin": (made.write_colmap_binary, "points"),
    "nerfstudio": (made.write_nerfstudio, "points"),
    "splat": (made.write_splat, "points"),
    "npz": (made.write_arrays, "maps"),
    "npz views": (lambda folder, model: made.write_arrays(folder, model, one=False), "maps"),
}


def write(tmp_path, kind):
    writer, content = WRITERS[kind]
    model, _ = made.room_model(content)
    writer(tmp_path / "model", model)
    return model, tmp_path / "model"


@pytest.mark.parametrize("kind", WRITERS)
def test_a_model_is_read_as_it_was_made(tmp_path, kind):
    model, folder = write(tmp_path, kind)
    found = read_model(folder)
    assert found.format == kind.removesuffix(" views") and len(found.views) == len(model.views)
    for here, view in zip(found.views, model.views, strict=True):
        assert here.name.split("/")[-1].split(".")[0] == view.name
        np.testing.assert_allclose(here.c2w, view.c2w, atol=1e-5)
        if view.depth is None:  # a splat's cameras.json has no principal point: the middle
            np.testing.assert_allclose(here.K, view.K, atol=0.6 if kind == "splat" else 1e-6)
        else:
            np.testing.assert_allclose(here.depth, view.depth, rtol=1e-6)
        if kind.startswith("colmap"):
            np.testing.assert_allclose(here.uv, view.uv, atol=1e-9)
            np.testing.assert_array_equal(here.point, view.point)
    if len(model.xyz):  # transparent splats are left out
        np.testing.assert_allclose(found.xyz, model.xyz, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("turned", [False, True])
def test_a_model_is_written_after_a_similarity(tmp_path, kind, turned):
    model, folder = write(tmp_path, kind)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) if turned else np.eye(3)
    similarity = Similarity(2.5, R, np.array([1.0, 2.0, 3.0]) if turned else np.zeros(3))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    found, out = read_model(folder), tmp_path / "out"
    if kind == "splat" and turned:
        with pytest.raises(ValueError, match="frame=model"):
            write_model(found, out, similarity)
        return
    write_model(found, out, similarity)
    again = read_model(out / "point_cloud.ply" if kind == "splat" else out)
    for here, view in zip(again.views, model.views, strict=True):
        np.testing.assert_allclose(here.c2w, similarity.move(view.c2w), atol=2e-5)
        if view.depth is not None:
            np.testing.assert_allclose(here.depth, 2.5 * view.depth, rtol=1e-6)
    if len(model.xyz):
        np.testing.assert_allclose(again.xyz, similarity.apply(model.xyz), rtol=1e-5, atol=2e-5)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("kind", ["colmap txt", "colmap bin", "nerfstudio"])
def test_a_folder_of_another_model_gets_all_files_of_this_one(tmp_path, kind):
    """Cameras and pictures of equal size but with other bytes are written anew."""
    _, folder = write(tmp_path, kind)
    copied = [p for p in folder.rglob("*") if p.stem.startswith(("cameras", "0000"))]
    assert copied
    for _ in range(2):
        write_model(read_model(folder), tmp_path / "out", Similarity(2.0, np.eye(3), np.zeros(3)))
        for file in copied:
            assert (tmp_path / "out" / file.relative_to(folder)).read_bytes() == file.read_bytes()
            change_middle(file)


def test_a_similarity_turns_scales_and_shifts() -> None:
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    similarity = Similarity(2.0, R, np.array([10.0, 20.0, 30.0]))
    assert similarity.apply(np.array([[1.0, 2.0, 3.0]])).tolist() == [[6, 22, 36]]
    c2w = np.eye(4)
    c2w[:3, 3] = 1, 2, 3
    moved = similarity.move(c2w)
    assert moved[:3, :3].tolist() == R.tolist() and moved[:, 3].tolist() == [6, 22, 36, 1]


def test_all_but_lengths_stays(tmp_path):
    _, folder = write(tmp_path, "colmap bin")
    write_model(read_model(folder), tmp_path / "out", Similarity(2.0, np.eye(3), np.zeros(3)))
    a, b = ((f / "points3D.bin").read_bytes() for f in (folder, tmp_path / "out"))
    size = 8 + 24 + 3 + 8 + 8 + 8
    rows = [np.frombuffer(x[8:], np.dtype(("u1", size))) for x in (a, b)]
    assert len(a) == len(b) and (rows[0][:, 32:] == rows[1][:, 32:]).all() and (rows[0][:, :8] == rows[1][:, :8]).all()
    assert (folder / "cameras.bin").read_bytes() == (tmp_path / "out" / "cameras.bin").read_bytes()


def test_sizes_of_splats_grow_with_the_scale(tmp_path):
    from dhtorch.runtime.ply import read_ply_vertices  # noqa: PLC0415

    _, folder = write(tmp_path, "splat")
    write_model(read_model(folder), tmp_path / "out", Similarity(2.0, np.eye(3), np.zeros(3)))
    vertex = read_ply_vertices(tmp_path / "out" / "point_cloud.ply").vertex
    np.testing.assert_allclose(vertex["scale_0"], -4 + np.log(2), rtol=1e-6)
    np.testing.assert_allclose(vertex["opacity"][:3], 2.0)


@pytest.mark.parametrize(
    ("kind", "file", "damage"),
    [
        ("colmap bin", "images.bin", lambda data: data[: len(data) // 2]),
        ("colmap bin", "points3D.bin", lambda data: b"\xff" * 8 + data[8:]),
        ("colmap bin", "cameras.bin", lambda data: data[:12] + b"\x05" + data[13:]),
        ("colmap txt", "images.txt", lambda data: data.replace(b".png", b"", 1).replace(b" 000000", b"", 1)),
        ("nerfstudio", "sparse_pc.ply", lambda data: data[: len(data) // 2]),
        ("nerfstudio", "transforms.json", lambda data: data.replace(b"sparse_pc.ply", b"../../etc/x.ply")),
        ("splat", "cameras.json", lambda data: data.replace(b'"fx"', b'"fq"')),
        ("npz", "predictions.npz", lambda data: data[: len(data) // 2]),
        ("npz", "predictions.npz", lambda data: data.replace(b"intrinsic", b"xntrinsic")),
    ],
)
def test_a_damaged_model_is_one_line(tmp_path, kind, file, damage):
    _, folder = write(tmp_path, kind)
    (folder / file).write_bytes(damage((folder / file).read_bytes()))
    with pytest.raises(FormatError) as error:
        read_model(folder)
    assert "\n" not in str(error.value) and ": found " in str(error.value)


def with_arrays(folder, **changes):
    """The archive of a network's maps with other arrays."""
    with np.load(folder / "predictions.npz") as stored:
        arrays = {name: stored[name] for name in stored.files}
    np.savez(
        folder / "predictions.npz", **{k: v(arrays[k]) if callable(v) else v for k, v in (arrays | changes).items()}
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"extrinsic": lambda x: 0 * x},
        {"extrinsic": lambda x: x.reshape(-1)},
        {"extrinsic": lambda x: x[:0]},
        {"extrinsic": lambda x: np.nan * x},
        {"extrinsic": np.zeros((0, 5000), np.uint8)},
        {"intrinsic": lambda x: 0 * x},
        {"intrinsic": np.float32(3)},
        {"intrinsic": lambda x: -x},
        {"depth": np.float32(3)},
        {"depth": lambda x: x[:, :0]},
        {"names": np.array([])},
        {"names": np.array(["a"] * 3)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_arrays_of_other_shapes_and_numbers_are_one_line(tmp_path, changes):
    _, folder = write(tmp_path, "npz")
    with_arrays(folder, **{k: v if callable(v) else (lambda _, v=v: v) for k, v in changes.items()})
    with pytest.raises(FormatError) as error:
        read_model(folder)
    assert "\n" not in str(error.value) and ": found " in str(error.value) and str(folder) in str(error.value)


def test_points_have_three_coordinates(tmp_path):
    values = {"c2w": np.eye(4)[None], "K": np.eye(3)[None], "points": np.ones((1, 5, 6, 2))}
    with pytest.raises(FormatError, match=r"depth or points: found shape \(1, 5, 6, 2\)"):
        list(network._views_of_arrays(tmp_path / "a.npz", values, None))


def test_points_that_are_no_places_are_left_out(tmp_path):
    model, folder = write(tmp_path, "splat")
    (file,) = folder.rglob("point_cloud.ply")
    from dhtorch.viz.viewer.points import read_ply_vertices  # noqa: PLC0415

    vertices = read_ply_vertices(file)
    vertex = vertices.vertex.copy()
    vertex["x"][:2], vertex["z"][3] = np.nan, np.inf
    file.write_bytes(vertices.encode(vertex))
    assert len(read_model(folder).xyz) == len(model.xyz) - 3


@pytest.mark.parametrize("kind", ["a folder", "a pipe"])
def test_points_that_are_no_file_are_named(tmp_path, kind):
    _, folder = write(tmp_path, "splat")
    (file,) = folder.rglob("point_cloud.ply")
    file.unlink()
    file.mkdir() if kind == "a folder" else os.mkfifo(file)
    with pytest.raises(FormatError, match=f"point_cloud.ply: file: found {kind}, expected a regular file"):
        read_model(folder)


LINKED = [
    *(("nerfstudio", name) for name in ("transforms.json", "sparse_pc.ply", "images", "masks/0.png")),
    *(("splat", name) for name in ("point_cloud/iteration_30000/point_cloud.ply", "cameras.json", "images/000000.png")),
    *(("colmap txt", name) for name in ("cameras.txt", "points3D.txt", "images", "images/000000.png")),
    *(("npz", "predictions.npz"), ("npz views", "000000.npz"), ("npz", "images/000000.png")),
]


def write_with_link(tmp_path, kind, name, elsewhere):
    """A model with a link in the place of one of its files, or of a folder."""
    _, folder = write(tmp_path, kind)
    made.write_pictures(folder / "images")
    if name.startswith("masks"):
        (folder / "masks").mkdir()
        (folder / name).write_bytes(b"not to be copied")
        text = (folder / "transforms.json").read_text()
        (folder / "transforms.json").write_text(
            text.replace('{"file_path"', f'{{"mask_path": "{name}", "file_path"', 1)
        )
    (folder / name).rename(elsewhere)
    (folder / name).symlink_to(elsewhere)
    return folder


@pytest.mark.parametrize(("kind", "name"), LINKED)
def test_a_link_out_of_a_model_is_not_followed(tmp_path, kind, name):
    folder = write_with_link(tmp_path, kind, name, tmp_path / "elsewhere")
    with pytest.raises(FormatError, match=r"link: found one to outside the model, expected a file inside$"):
        read_model(folder)


@pytest.mark.parametrize(("kind", "name"), [LINKED[k] for k in (2, 3, 4)])
def test_a_link_within_a_model_is_followed(tmp_path, kind, name):
    folder = write_with_link(tmp_path, kind, name, tmp_path / "model" / "elsewhere")
    write_model(read_model(folder), tmp_path / "out", Similarity(2.0, np.eye(3), np.zeros(3)))
    assert not name.startswith("masks") or (tmp_path / "out" / name).read_bytes() == b"not to be copied"


def test_a_mask_of_3_gib_is_not_copied(tmp_path):
    _, folder = write(tmp_path, "nerfstudio")
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace('{"file_path"', '{"mask_path": "mask.png", "file_path"', 1))
    STRANGE_FILES["3 GiB"](folder / "mask.png")
    with pytest.raises(FormatError, match=r"mask\.png: file size: found 3221225472 bytes, expected at most"):
        read_model(folder)


def test_no_model_names_the_formats(tmp_path):
    with pytest.raises(FormatError, match="COLMAP"):
        read_model(tmp_path)


# ------------------------------------------------------------------------------------------------- points and maps


def hidden_by_loops(uv, z, hw, cells=48, nearer=0.05):
    """Which points are inside and not behind another one in their cell, point by point."""
    side = max(hw) / cells
    inside = [
        d > 0 and 0 <= u <= hw[1] - 1 and 0 <= v <= hw[0] - 1 for (u, v), d in zip(uv.tolist(), z.tolist(), strict=True)
    ]
    nearest = {}
    for (u, v), d, use in zip(uv.tolist(), z.tolist(), inside, strict=True):
        if use:
            cell = (int(u / side), int(v / side))
            nearest[cell] = min(d, nearest.get(cell, d))
    return [
        use and d <= (1 + nearer) * nearest[int(u / side), int(v / side)]
        for (u, v), d, use in zip(uv.tolist(), z.tolist(), inside, strict=True)
    ]


@pytest.mark.parametrize("hw", [(96, 192), (192, 96)])
def test_a_point_is_seen_where_none_is_nearer_in_its_cell(hw):
    draw = np.random.default_rng(3)
    uv = torch.from_numpy(draw.uniform(-10, 200, (3000, 2)))
    z = torch.from_numpy(np.where(draw.random(3000) < 0.1, -1.0, draw.uniform(1, 1.3, 3000)))
    uv[:4] = torch.tensor([[0.0, 0.0], [hw[1] - 1, hw[0] - 1], [hw[1] - 0.9, 3], [3, hw[0] - 0.9]])
    z[:4] = 0.5
    seen = scene_model._unoccluded(uv, z, hw)
    assert seen.tolist() == hidden_by_loops(uv, z, hw) and 20 < int(seen.sum()) < 1500
    assert seen[:4].tolist() == [True, True, False, False], "pixels of the picture, and beyond"
    assert scene_model._unoccluded(uv[:0], z[:0], hw).tolist() == []


def test_points_of_a_view_without_observations_are_projected_through_its_lens():
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # looks along the world's x
    T[:3, 3] = 1, 2, 3
    local = np.array([[0.2, -0.1, 2.0], [0.24, -0.12, 2.4], [0.0, 0.0, -1.0], [-0.5, 0.3, 4.0], [9.0, 0.0, 1.0]])
    K = np.array([[50.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    lens = (0.1, 0.01, 0.0, 0.0, 0.0)
    view = scene_model.ModelView("a", K, (48, 64), T, distortion=lens)
    uv, z = scene_model.SceneModel([view], view.to_world(local)).seen_points(view)
    shown = local[[0, 3]]  # one is hidden, one behind the camera, one beside the picture
    np.testing.assert_allclose(z, shown[:, 2], rtol=1e-12)
    x = shown[:, :2] / shown[:, 2:]
    r2 = (x**2).sum(1, keepdims=True)
    np.testing.assert_allclose(uv, x * (1 + lens[0] * r2 + lens[1] * r2**2) * [50, 60] + [32, 24], atol=1e-9)
    observed = dataclasses.replace(view, point=np.array([3, 2, 0]), uv=np.array([[1.0, 2], [3, 4], [5, 6]]))
    uv, z = scene_model.SceneModel([observed], view.to_world(local)).seen_points(observed)
    assert uv.tolist() == [[1, 2], [5, 6]] and z.tolist() == pytest.approx([4, 2]), "as stored, in front of the camera"


def arrays_of(n=3, hw=(4, 5), **changes):
    """Arrays of a network with n views, every number its own, and the depth of its maps."""
    draw = np.random.default_rng(0)
    depth = draw.uniform(1, 3, (n, *hw))
    depth[:, 0, 0] = 0, np.nan, -1
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    c2w[:, :3, 3] = draw.random((n, 3))
    K = np.tile(np.diag([7.0, 8.0, 1.0]), (n, 1, 1))
    K[:, 0, 0] += np.arange(n)
    return {"depth": depth, "c2w": c2w, "K": K} | changes, np.where(depth > 0, depth, 0)


@pytest.mark.parametrize("poses", ["c2w", "w2c", "w2c of three rows"])
@pytest.mark.parametrize("maps", ["depth", "depth of one channel", "points"])
def test_maps_of_a_network_are_read_for_every_view(tmp_path, poses, maps):
    values, depth = arrays_of()
    c2w = values["c2w"]
    if poses != "c2w":
        w2c = np.linalg.inv(values.pop("c2w"))
        values["w2c"] = w2c[:, :3] if "three" in poses else w2c
    if maps == "points":
        v, u = np.mgrid[:4, :5]
        f = np.stack((values["K"][:, 0, 0], values["K"][:, 1, 1]), -1)[:, None, None]
        stored = values.pop("depth")[..., None]
        local = np.concatenate((np.stack((u, v), -1) / f * stored, stored), -1)
        values["points"] = np.einsum("nij,nhwj->nhwi", c2w[:, :3, :3], local) + c2w[:, None, None, :3, 3]
    elif "channel" in maps:
        values["depth"] = values["depth"][..., None]
    views = list(network._views_of_arrays(tmp_path / "a.npz", values, ["x/one.png", "two", "three"]))
    assert [view.name for view in views] == ["one.png", "two", "three"] and all(v.hw == (4, 5) for v in views)
    for k, view in enumerate(views):
        np.testing.assert_allclose(view.depth, depth[k], atol=1e-12)
        np.testing.assert_allclose(view.c2w, c2w[k], atol=1e-12)
        np.testing.assert_allclose(view.K, values["K"][k])


def test_the_least_confident_quarter_is_left_out_and_one_camera_serves_all_views(tmp_path):
    values, depth = arrays_of(conf=np.tile(np.arange(20.0).reshape(4, 5), (3, 1, 1)))
    values["K"] = values["K"][1]
    views = list(network._views_of_arrays(tmp_path / "a.npz", values, None))
    assert [view.name for view in views] == ["000000", "000001", "000002"]
    for k, view in enumerate(views):
        np.testing.assert_array_equal(view.depth, np.where(np.arange(20).reshape(4, 5) < 5, 0, depth[k]))
        np.testing.assert_array_equal(view.K, values["K"])


def test_arrays_without_an_axis_of_views_are_one_view(tmp_path):
    values, depth = arrays_of()
    (view,) = network._views_of_arrays(tmp_path / "a.npz", {name: each[2] for name, each in values.items()}, None)
    np.testing.assert_array_equal(view.depth, depth[2])
    np.testing.assert_array_equal(view.c2w, values["c2w"][2])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"c2w": np.eye(4)[0]}, r"pose: found shape \(4,\)"),
        ({"K": np.zeros((0, 3, 3))}, r"K: found shape \(0, 3, 3\)"),
        ({"conf": np.ones((2, 4, 5))}, "shapes: found .* expected the same number of views in all arrays, here 3"),
        ({"depth": np.ones((3, 4, 5, 2))}, "shapes: found "),
        ({"c2w": None, "w2c": np.zeros((3, 4, 4))}, "poses: found a singular matrix"),
    ],
)
def test_arrays_of_another_shape_are_named(tmp_path, changes, words):
    values, _ = arrays_of(**changes)
    with pytest.raises(FormatError, match=words):
        list(network._views_of_arrays(tmp_path / "a.npz", {k: v for k, v in values.items() if v is not None}, None))


def test_names_are_stored_or_those_of_the_archive_or_of_the_pictures(tmp_path):
    root, archive = tmp_path / "model", tmp_path / "model" / "a.npz"
    (root / "images").mkdir(parents=True)
    np.savez(archive, image_paths=np.array([["p/1.png", "p/2.png"]]))
    find = network._names_of_arrays
    assert find(root, archive, {"K", "image_paths"}, 1, None) == ["p/1.png", "p/2.png"]
    assert find(root, archive, {"K"}, 2, None) == ["a"] and find(root, archive, {"K"}, 1, None) is None
    for name in ("10.png", "9.png", "notes.txt"):
        (root / "images" / name).touch()
    pictures = [root / "images" / name for name in ("9.png", "10.png")]
    assert find(root, archive, {"K"}, 1, None) == find(archive, archive, {"K"}, 1, None) == pictures
    assert find(root, archive, {"K"}, 1, root) is None, "another folder, which has none"
