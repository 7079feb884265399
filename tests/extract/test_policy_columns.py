"""Geometry images and point clouds of an enriched LeRobot set: the functions of its own maps, byte for byte."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from support import writers
from support.dataset_folders import decode_map, read_rows

from dhtorch import data, functional
from dhtorch.cli.run import main
from dhtorch.codes import Cause, Source, names
from dhtorch.data.codecs.video import read_video_frame, read_video_header, read_video_times
from dhtorch.export.video import open_lossless_video
from dhtorch.extract.policy_columns import N_POINTS, PolicyColumnWriter, make_modality
from dhtorch.synthetic.recording import SyntheticRoom

HW, LENGTHS, FPS = (48, 64), (3, 2), 30
CAMERA = "observation.images.front"
PICTURE, CLOUD = f"{CAMERA}_geometry_image", "observation.front.point_cloud"
COLUMNS = "columns=[depth,sigma,source,cause,geometry_image,point_cloud]"
QUICK = ["method=paper", "method.n=64", "method.hypotheses=8", "gap=1", "dense={size: 32, planes: 8}", "report=false"]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A robot's set whose depth has holes, with a GR00T file."""
    room = SyntheticRoom(hw=HW, n_frames=sum(LENGTHS), lidar="exact", supersample=1)
    shots = [room[i].replace(depth=torch.where(room[i].depth <= 2.5, room[i].depth, 0.0)) for i in range(len(room))]
    root = tmp_path_factory.mktemp("source") / "set"
    writers.write_lerobot(root, [shots[:3], shots[3:]], version=3, depth="tiff", fps=FPS)
    modality = {"state": {"arm": {"start": 0, "end": 7}}, "video": {"ego": {"original_key": CAMERA}}, "own": 1}
    (root / "meta" / "modality.json").write_text(json.dumps(modality))
    return root


@pytest.fixture(scope="module", params=["lerobot", "v2.1"])
def enriched(request, tmp_path_factory, source):
    """The set with columns for policies, in each version of the format."""
    if request.param == "v2.1":  # its videos hold several episodes, which this version has not
        recording = tmp_path_factory.mktemp("room")
        out, words = recording / "set", ["data=synthetic", f"data.hw=[{HW[0]},{HW[1]}]", "data.n_frames=3"]
        assert main(["enrich", *words, *QUICK, COLUMNS, "format=v2.1", f"out={out}"]) == 0
        return out
    out = tmp_path_factory.mktemp("enriched") / "set"
    assert main(["enrich", str(source), str(out), *QUICK, COLUMNS]) == 0
    return out


def read_info(root):
    return json.loads((root / "meta" / "info.json").read_text())


def columns_of(root):
    """Keys of picture, geometry image, depth and point cloud."""
    features = read_info(root)["features"]
    (picture,) = (key for key in features if key.endswith("_geometry_image"))
    camera = picture.removesuffix("_geometry_image")
    depth = f"{camera}_depth_enriched" if f"{camera}_depth_enriched" in features else f"{camera}_depth"
    return camera, picture, depth, f"observation.{camera.removeprefix('observation.images.')}.point_cloud"


def read_videos(root):
    """Geometry images (h, w, 3) of all rows, in order, and their files."""
    files = sorted(file for file in (root / "videos").rglob("*.mp4") if "geometry_image" in str(file))
    pictures = [read_video_frame(file, i) for file in files for i in range(read_video_header(file).n)]
    return np.stack(pictures), files


def test_every_byte_of_the_video_is_that_of_the_maps(enriched):
    camera, _, depth, _ = columns_of(enriched)
    rows = read_rows(enriched)
    pictures, files = read_videos(enriched)
    assert pictures.shape == (len(rows), *HW, 3)
    assert pictures.any(), "no pixel has a depth"
    for row, actual in zip(rows, pictures, strict=True):
        keys = {"depth": depth, "sigma": f"{depth}_sigma", "source": f"{camera}_dhtorch_source"}
        maps = [torch.from_numpy(decode_map(row, key).reshape(24, 32)) for key in keys.values()]
        image = functional.geometry_image(*maps).permute(1, 2, 0).numpy()
        assert np.array_equal(actual, image.repeat(2, 0).repeat(2, 1))
    for file in files:
        assert np.allclose(read_video_times(file), np.arange(read_video_header(file).n) / read_info(enriched)["fps"])


def test_the_largest_cause_of_sigma_is_a_map_beside_the_source(enriched):
    camera, *_ = columns_of(enriched)
    codes = read_info(enriched)["features"][f"{camera}_dhtorch_cause"]["info"]["codes"]
    assert codes == {str(code): name.lower() for code, name in names(Cause).items()}
    for row in read_rows(enriched):
        cause, origin = (decode_map(row, f"{camera}_dhtorch_{name}").reshape(24, 32) for name in ("cause", "source"))
        assert ((cause > 0) == (origin > 0)).all() and (cause[origin == Source.SENSOR] == Cause.REFERENCE).all()


def test_its_feature_states_the_decoding_and_statistics_are_there(enriched):
    _, picture, _, cloud = columns_of(enriched)
    feature = read_info(enriched)["features"][picture]
    assert (feature["dtype"], feature["shape"]) == ("video", [*HW, 3])
    info, pictures = feature["info"], read_videos(enriched)[0]
    header = read_video_header(read_videos(enriched)[1][0])
    assert (header.codec, header.pixels) == (info["video.codec"], info["video.pix_fmt"]) == ("h264", "gbrp")
    decoded = functional.decode_geometry_image(torch.from_numpy(pictures).movedim(-1, 1))
    valid = decoded.source.numpy() > 0
    channels = {f"channel_{k}": pictures[..., k].astype(np.float64)[valid] for k in range(3)}
    stated = info["geometry_image"]
    depth = eval(stated["depth_m"], channels)
    sigma = eval(stated["sigma_m"].split(";")[0], channels | {"depth_m": depth})
    source = eval(stated["source"].split(";")[0].replace("round", "np.round"), channels | {"np": np})
    assert np.allclose(depth, decoded.depth.numpy()[valid]) and np.array_equal(source, decoded.source.numpy()[valid])
    assert np.allclose(sigma, decoded.sigma.numpy()[valid], rtol=1e-5)
    stats = json.loads((enriched / "meta" / "stats.json").read_text())
    assert np.allclose(np.ravel(stats[picture]["mean"]), (pictures / 255).mean((0, 1, 2)))
    points = np.stack([np.stack([np.asarray(p) for p in row[cloud]]) for row in read_rows(enriched)])
    with_depth = points[points.any((1, 2))]
    assert np.allclose(stats[cloud]["mean"], with_depth.mean((0, 1)), atol=1e-5)
    assert np.shape(stats[picture]["mean"]) == (3, 1, 1) and np.shape(stats[cloud]["std"]) == (3,)


def test_points_are_those_of_the_depth_map_and_its_camera(enriched):
    camera, _, depth, cloud = columns_of(enriched)
    assert read_info(enriched)["features"][cloud]["shape"] == [N_POINTS, 3]
    for row in read_rows(enriched):
        points = np.stack([np.asarray(point, np.float32) for point in row[cloud]])
        z = decode_map(row, depth).reshape(24, 32)
        K = np.reshape(row[f"observation.{camera.removeprefix('observation.images.')}.intrinsics"], (3, 3))
        uv = points @ K.T
        u, v = np.rint(((uv[:, :2] / uv[:, 2:]) + 0.5) / 2 - 0.5).astype(int).T
        assert np.allclose(z[v, u], points[:, 2], rtol=1e-6) and (points[:, 2] > 0).all()
        assert len({*zip(u, v, strict=True)}) == min(N_POINTS, int((z > 0).sum()))


def test_videos_card_and_groot_description_are_there_and_it_reads_back_without_a_further_camera(enriched, source):
    camera, picture, _, _ = columns_of(enriched)
    modality = json.loads((enriched / "meta" / "modality.json").read_text())
    name = f"{camera.removeprefix('observation.images.')}_geometry_image"
    assert modality["video"][name] == {"original_key": picture}
    if camera == CAMERA:
        before = json.loads((source / "meta" / "modality.json").read_text())
        assert modality == {**before, "video": {**before["video"], name: {"original_key": picture}}}
    assert read_info(enriched)["video_path"] and all(file.is_file() for file in read_videos(enriched)[1])
    assert {each.camera_name for each in data.open_all(enriched)} == {camera}
    card = (enriched / "README.md").read_text()
    assert "63.75 / channel_0" in card and "decode_geometry_image" in card and f"{N_POINTS} points" in card


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["columns=[depth,pictures]"], "geometry_image, point_cloud"),
        ([COLUMNS, "format=nerfstudio"], "geometry_image, point_cloud, cause with format=nerfstudio"),
    ],
)
def test_other_columns_and_formats_are_refused_in_a_line(words, text, source, tmp_path, capsys):
    assert main(["enrich", str(source), str(tmp_path / "set"), *QUICK, *words]) == 2
    assert text in capsys.readouterr().err


def test_pictures_are_written_at_the_times_of_their_rows():
    written = []
    view = SimpleNamespace(hw=(2, 3), map_hw=(1, 1), lens=())
    writer = PolicyColumnWriter({"geometry_image": PICTURE}, view, lambda *call: written.append(call))
    assert writer.add([None, None], [0.5, 0.75]) == {}
    assert [time for _, time in written] == [0.5, 0.75] and all(p.shape == (2, 3, 3) for p, _ in written)


def test_a_set_without_a_groot_file_gets_one_of_its_features(tmp_path):
    numbers, fewer = ({"dtype": "float32", "shape": [n]} for n in (8, 7))
    features = {"observation.state": numbers, "action": fewer, CAMERA: {"dtype": "video", "shape": [*HW, 3]}}
    modality = make_modality(None, features, {"front_geometry_image": PICTURE})
    assert modality["state"] == {"state": {"start": 0, "end": 8}} and modality["action"]["action"]["end"] == 7
    assert modality["video"] == {"front": {"original_key": CAMERA}, "front_geometry_image": {"original_key": PICTURE}}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "modality.json").write_text('{"video": [1]}')
    with pytest.raises(ValueError, match=r"modality.json: video: found no object"):
        make_modality(tmp_path, {}, {"front": PICTURE})


def test_frames_lie_at_their_times_whatever_the_size_and_a_failed_episode_leaves_no_video(tmp_path):
    pictures = np.random.default_rng(0).integers(0, 256, (3, 31, 45, 3), dtype=np.uint8)  # odd sizes, noise
    with open_lossless_video(tmp_path / "a.mp4", (31, 45), 20.0) as append:
        for picture, time in zip(pictures, (0.05, 0.1, 0.25), strict=True):
            append(picture, time)
    assert np.array_equal(np.stack([read_video_frame(tmp_path / "a.mp4", i) for i in range(3)]), pictures)
    assert np.allclose(read_video_times(tmp_path / "a.mp4"), (0.05, 0.1, 0.25))
    with pytest.raises(RuntimeError, match="stop"), open_lossless_video(tmp_path / "b.mp4", (16, 16), 20.0) as append:
        append(np.zeros((16, 16, 3), np.uint8), 0.0)
        raise RuntimeError("stop")
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
