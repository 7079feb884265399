"""Models up to scale: every format is read as it was made, and written in metres with all else unchanged."""

import os

import numpy as np
import pytest

from dhtorch.data import FormatError
from dhtorch.data.models import Similarity, network, read_model, write_model
from tests.support import room_models as made

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


def test_no_model_names_the_formats(tmp_path):
    with pytest.raises(FormatError, match="COLMAP"):
        read_model(tmp_path)
