"""Models up to scale: every format is read as it was made, and written in metres with all else unchanged."""

import dataclasses
import os
from pathlib import Path

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


def change_arrays(file, **changes):
    """The archive of a network's maps with other arrays."""
    with np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    np.savez(file, **arrays | {name: change(arrays[name]) for name, change in changes.items()})


def with_mask(file, name="mask.png"):
    text = file.read_text().replace('{"file_path"', f'{{"mask_path": "{name}", "file_path"', 1)
    file.write_text(text)
    return file.parent / name


#: Kind of a model, one of its files, what is done to its bytes or to the file, and words of the error.
DAMAGED = [
    *(
        (kind, file, lambda path, damage=damage: path.write_bytes(damage(path.read_bytes())), "")
        for kind, file, damage in [
            ("colmap bin", "images.bin", lambda data: data[: len(data) // 2]),
            ("colmap bin", "points3D.bin", lambda data: b"\xff" * 8 + data[8:]),
            ("colmap bin", "cameras.bin", lambda data: data[:12] + b"\x05" + data[13:]),
            ("colmap txt", "images.txt", lambda data: data.replace(b".png", b"", 1).replace(b" 000000", b"", 1)),
            ("nerfstudio", "sparse_pc.ply", lambda data: data[: len(data) // 2]),
            ("nerfstudio", "transforms.json", lambda data: data.replace(b"sparse_pc.ply", b"../../etc/x.ply")),
            ("splat", "cameras.json", lambda data: data.replace(b'"fx"', b'"fq"')),
            ("npz", "predictions.npz", lambda data: data[: len(data) // 2]),
            ("npz", "predictions.npz", lambda data: data.replace(b"intrinsic", b"xntrinsic")),
        ]
    ),
    *(
        ("npz", "predictions.npz", lambda path, name=name, change=change: change_arrays(path, **{name: change}), "")
        for name, change in [
            ("extrinsic", lambda x: 0 * x),
            ("extrinsic", lambda x: x.reshape(-1)),
            ("extrinsic", lambda x: x[:0]),
            ("extrinsic", lambda x: np.nan * x),
            ("extrinsic", lambda x: np.zeros((0, 5000), np.uint8)),
            ("intrinsic", lambda x: 0 * x),
            ("intrinsic", lambda x: np.float32(3)),
            ("intrinsic", lambda x: -x),
            ("depth", lambda x: np.float32(3)),
            ("depth", lambda x: x[:, :0]),
            ("names", lambda x: np.array([])),
            ("names", lambda x: np.array(["a"] * 3)),
        ]
    ),
    *(
        ("splat", "point_cloud.ply", lambda path, make=make: (path.unlink(), make(path)), f"point_cloud.ply: file: found {what}, expected a regular file")
        for make, what in ((Path.mkdir, "a folder"), (os.mkfifo, "a pipe"))
    ),
    ("nerfstudio", "transforms.json", lambda path: STRANGE_FILES["3 GiB"](with_mask(path)), r"mask\.png: file size: found 3221225472 bytes, expected at most"),
    ("nerfstudio", "transforms.json", lambda path: [path.rename(path.with_name("other"))], "COLMAP"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "damage", "words"), DAMAGED)
def test_a_damaged_model_is_one_line(tmp_path, kind, name, damage, words):
    _, folder = write(tmp_path, kind)
    (file,) = folder.rglob(name)
    damage(file)
    with pytest.raises(FormatError, match=words) as error:
        read_model(folder)
    assert "\n" not in str(error.value) and ": found " in str(error.value) and str(folder) in str(error.value)


def test_points_that_are_no_places_are_left_out(tmp_path):
    model, folder = write(tmp_path, "splat")
    (file,) = folder.rglob("point_cloud.ply")
    from dhtorch.viz.viewer.points import read_ply_vertices  # noqa: PLC0415

    vertices = read_ply_vertices(file)
    vertex = vertices.vertex.copy()
    vertex["x"][:2], vertex["z"][3] = np.nan, np.inf
    file.write_bytes(vertices.encode(vertex))
    assert len(read_model(folder).xyz) == len(model.xyz) - 3


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
        with_mask(folder / "transforms.json", name).write_bytes(b"not to be copied")
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
    view, want = scene_model.ModelView("a", np.eye(3), hw, np.eye(4)), hidden_by_loops(uv, z, hw)
    xyz = np.column_stack([uv * z[:, None], z])
    found, depth = scene_model.SceneModel([view], xyz).seen_points(view)
    np.testing.assert_allclose(found, uv[want], atol=1e-9)
    np.testing.assert_array_equal(depth, z[want])
    assert want[:4] == [True, True, False, False] and 20 < sum(want) < 1500, "pixels of the picture, and beyond"
    assert not len(scene_model.SceneModel([view]).seen_points(view)[0])


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


def with_w2c(values, rows=4):
    return {"w2c": np.linalg.inv(values["c2w"])[:, :rows], "K": values["K"], "depth": values["depth"]}


def with_points(values):
    v, u = np.mgrid[:4, :5]
    f = np.stack((values["K"][:, 0, 0], values["K"][:, 1, 1]), -1)[:, None, None]
    stored, c2w = values["depth"][..., None], values["c2w"]
    local = np.concatenate((np.stack((u, v), -1) / f * stored, stored), -1)
    points = np.einsum("nij,nhwj->nhwi", c2w[:, :3, :3], local) + c2w[:, None, None, :3, 3]
    return {"c2w": c2w, "K": values["K"], "points": points}


RAMP = np.arange(20.0).reshape(4, 5)
NAMES = ["x/one.png", "two", "three"]
#: What a network stores of the arrays, the names of its views, and what is read: views, K and the mask of the maps.
STORED = {
    "c2w": (lambda a: a, NAMES, slice(None), lambda K: K, RAMP >= 0),
    "w2c": (with_w2c, NAMES, slice(None), lambda K: K, RAMP >= 0),
    "w2c of three rows": (lambda a: with_w2c(a, 3), NAMES, slice(None), lambda K: K, RAMP >= 0),
    "one channel": (lambda a: a | {"depth": a["depth"][..., None]}, NAMES, slice(None), lambda K: K, RAMP >= 0),
    "points": (with_points, NAMES, slice(None), lambda K: K, RAMP >= 0),
    "points and w2c": (lambda a: with_points(a) | with_w2c(a) | {"depth": a["depth"]}, NAMES, slice(None), lambda K: K, RAMP >= 0),
    # The least confident quarter is left out, and one camera serves all views.
    "confidence": (lambda a: a | {"conf": np.tile(RAMP, (3, 1, 1)), "K": a["K"][1]}, None, slice(None), lambda K: K[[1, 1, 1]], RAMP >= 5),
    "one view": (lambda a: {name: each[2] for name, each in a.items()}, None, slice(2, 3), lambda K: K[2:], RAMP >= 0),
}  # fmt: skip


@pytest.mark.parametrize("kind", STORED)
def test_maps_of_a_network_are_read_for_every_view(tmp_path, kind):
    store, names, chosen, K_of, kept = STORED[kind]
    values, depth = arrays_of()
    views = list(network._views_of_arrays(tmp_path / "a.npz", store(values), names))
    expected = ["one.png", "two", "three"] if names else [f"{k:06d}" for k in range(len(depth[chosen]))]
    assert [view.name for view in views] == expected and all(view.hw == (4, 5) for view in views)
    np.testing.assert_allclose([view.depth for view in views], np.where(kept, depth[chosen], 0), atol=1e-12)
    np.testing.assert_allclose([view.c2w for view in views], values["c2w"][chosen], atol=1e-12)
    np.testing.assert_allclose([view.K for view in views], K_of(values["K"]))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"c2w": np.eye(4)[0]}, r"pose: found shape \(4,\)"),
        ({"K": np.zeros((0, 3, 3))}, r"K: found shape \(0, 3, 3\)"),
        ({"conf": np.ones((2, 4, 5))}, "shapes: found .* expected the same number of views in all arrays, here 3"),
        ({"depth": np.ones((3, 4, 5, 2))}, "shapes: found "),
        ({"c2w": None, "w2c": np.zeros((3, 4, 4))}, "poses: found a singular matrix"),
        ({"depth": None, "points": np.ones((3, 5, 6, 2))}, r"depth or points: found shape \(3, 5, 6, 2\)"),
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
