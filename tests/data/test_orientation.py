"""Orientation of depth and pictures: symmetries and their scores, what files state, and recordings made consistent."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from support.writers.parts import write_video
from torch import Tensor

from dhtorch import data
from dhtorch.data import FormatError, convert, orientation
from dhtorch.data.codecs import video
from dhtorch.data.io import decode as files
from dhtorch.data.stored_sizes import StoredSizes, describe_mismatch
from dhtorch.synthetic import SyntheticRoom

ROOT = os.environ.get("DHTORCH_DATA")
#: Capture → least number of its six frames in which the stored orientation wins alone.
CAPTURES = {
    "holo_a": 5,
    "holo_stream": 4,
    "7s_redkitchen_000": 6,
    "7s_redkitchen_200": 6,
    "7s_redkitchen_400": 6,
    "7s_redkitchen_600": 6,
    "tum_fr1_desk9": 6,
    "tum_fr1_rpy_a": 6,
    "r3d_door": 6,
    "slambook_rgbd": 5,
}


def some(recording: data.Recording, n: int = 6) -> list[tuple[Tensor, Tensor]]:
    places = np.unique(np.linspace(0, len(recording) - 1, n).round().astype(int)).tolist()
    return [(recording[i].image[0], recording[i].depth[0]) for i in places]


@pytest.mark.data
@pytest.mark.skipif(ROOT is None, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize(
    "capture", [pytest.param(name, marks=[pytest.mark.slow] * (k % 2)) for k, name in enumerate(CAPTURES)]
)
def test_the_stored_orientation_of_sound_captures_wins(capture: str) -> None:
    frames = some(data.open(Path(str(ROOT)) / capture))
    scores = torch.stack([orientation.orientation_scores(image, depth) for image, depth in frames])
    assert int((scores.argmax(1) == 0).sum()) >= CAPTURES[capture]
    assert int(scores.mean(0).argmax()) == 0
    assert orientation.select_symmetry(frames)[0] in (0, None)


def test_edges_correlate_whatever_their_mean_and_scale_are() -> None:
    a = 1 + torch.rand(3, 6, 8, generator=torch.manual_seed(0))
    assert orientation.edge_correlation(a, 2 * a + 3, torch.ones(6, 8, dtype=torch.bool)) == pytest.approx(1, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("k", range(8))
def test_the_symmetry_that_undoes_a_planted_one_is_selected(k: int) -> None:
    room = SyntheticRoom(n_frames=3, hw=(240, 320))
    planted = [(room[i].image[0], orientation.apply_symmetry(room[i].depth[0], k)) for i in range(3)]
    inverse = k if k >= 4 else -k % 4
    selected, scores = orientation.select_symmetry(planted)
    assert selected == inverse and scores.shape == (8,) and float(scores.abs().max()) <= 1


def test_symmetries_are_the_eight_of_a_rectangle() -> None:
    x = torch.arange(6.0).reshape(2, 3)
    images = {tuple(orientation.apply_symmetry(x, k).flatten().tolist()) for k in range(8)}
    assert len(images) == 8
    for k in range(8):
        assert torch.equal(orientation.apply_symmetry(orientation.apply_symmetry(x, k), orientation._inverse(k)), x)
    assert torch.equal(orientation.apply_symmetry(x, 6), x.flip(-2))
    assert torch.equal(orientation.apply_symmetry(x, 1)[0], torch.tensor([3.0, 0.0]))  # clockwise: left column on top


def test_a_map_without_edges_decides_nothing() -> None:
    image = torch.rand(1, 60, 80, generator=torch.Generator().manual_seed(0))
    selected, scores = orientation.select_symmetry([(image, torch.ones(60, 80)), (image, torch.zeros(60, 80))])
    assert selected is None
    assert torch.equal(scores, torch.zeros(8, dtype=torch.float64))


# ------------------------------------------------------------------------------------------------------- recordings

HW = (96, 128)


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    return SyntheticRoom(n_frames=5, hw=HW, lidar="exact", supersample=1)


def write_folder(
    root: Path, room: SyntheticRoom, *, picture: int = 0, depth: int = 0, K: int = 0, exif: int = 1, kind: str = "png"
) -> None:
    """The room in numbered folders with pictures, depth and K under a symmetry each, and an EXIF orientation."""
    for i, frame in enumerate(room):
        image = Image.fromarray(orientation.apply_symmetry(frame.image[0], picture).permute(1, 2, 0).numpy())
        tags = Image.Exif()
        if exif != 1:
            tags[0x0112] = exif
        (root / "rgb").mkdir(parents=True, exist_ok=True)
        image.save(root / "rgb" / f"{i}.{kind}", exif=tags, **({"quality": 95} if kind == "jpg" else {}))
        code = orientation.apply_symmetry((frame.depth[0] * 1000).round(), depth).numpy().astype(np.uint16)
        (root / "depth").mkdir(exist_ok=True)
        cv2.imwrite(str(root / "depth" / f"{i}.png"), code)
    camera = convert.rot90_camera(room[0].camera, HW, K)
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    (root / "K.txt").write_text(f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")


def same(recording: data.Recording, room: SyntheticRoom, k: int, grey: float = 0.0, k_of_camera: int = 0) -> None:
    """Picture and depth are those of the room under one symmetry, K under one."""
    for got, true in zip(recording, room, strict=True):
        picture = orientation.apply_symmetry(true.image[0], k)
        assert got.image.shape[1:] == picture.shape
        assert float((got.image[0].float() - picture.float()).abs().mean()) <= grey
        depth = orientation.apply_symmetry(true.depth[0], k)
        torch.testing.assert_close(got.depth[0], depth, atol=6e-4, rtol=0)
        torch.testing.assert_close(
            got.camera.c, convert.rot90_camera(true.camera, HW, k_of_camera).c, atol=1e-4, rtol=0
        )


#: How the folder is written, options, and under which symmetry of the room it is read, with a line of its report; or the
#: error.
FOLDERS = [
    *(
        ({"depth": k, "K": k, "exif": exif, "kind": kind}, {}, k, f"EXIF orientation {exif}: pictures are turned")
        for exif, k in ((6, 1), (8, 3))
        for kind in ("png", "jpg")
    ),
    *(({"exif": exif}, {}, 0, f"EXIF orientation {exif}: pictures are read as stored") for exif in (3, 6, 8)),
    *(({"depth": k, "exif": exif}, {}, k, "") for exif, k in ((2, 4), (3, 2), (4, 6))),  # edges decide, not sizes
    *(({"depth": k}, {}, 0, "orientation: depth 96x128 (portrait) beside pictures 128x96") for k in (1, 3, 5, 7)),
    *(({"picture": k}, {}, 0, "pictures are turned") for k in (1, 3)),  # K is that of depth
    *(
        ({"depth": k}, {"depth_turn": turn}, 0, "")
        for turn, k in (("90", 1), (180, 2), ("270", 3), ("left_right", 4), ("upside_down", 6))
    ),
    ({"depth": 3, "K": 3, "exif": 6}, {}, None, r"orientation: found EXIF orientation 6, but edges .*depth_turn"),
]


@pytest.mark.parametrize(("written", "options", "k", "words"), FOLDERS)
def test_pictures_and_depth_are_read_in_one_orientation(
    tmp_path: Path, room: SyntheticRoom, written: dict[str, Any], options: dict[str, Any], k: int | None, words: str
) -> None:
    write_folder(tmp_path, room, **written)
    if k is None:
        with pytest.raises(FormatError, match=words):
            data.open(tmp_path)
        return
    recording = data.open(tmp_path, **options)
    # A mirrored K is not written: the principal point stays where it was.
    same(recording, room, k, 6.0 if written.get("kind") == "jpg" else 0.0, k_of_camera=written.get("K", 0))
    assert any(words in line for line in recording.report) or not words
    assert recording.stored is None


def test_pictures_of_other_tags_than_the_first_are_refused(tmp_path: Path, room: SyntheticRoom) -> None:
    write_folder(tmp_path, room)
    Image.open(tmp_path / "rgb" / "1.png").save(tmp_path / "rgb" / "1.png", exif=_tag(6))
    recording = data.open(tmp_path)
    with pytest.raises(FormatError, match=r"1.png: EXIF orientation: found 6, expected 1, as the first picture has"):
        recording[1]


def _tag(value: int) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112] = value
    return tags


def test_portrait_depth_without_edges_is_refused_unless_an_option_decides(tmp_path: Path, room: SyntheticRoom) -> None:
    write_folder(tmp_path, room, depth=1)
    for file in (tmp_path / "depth").iterdir():
        cv2.imwrite(str(file), np.full((128, 96), 2000, np.uint16))
    with pytest.raises(FormatError, match=r"orientation: found depth 96x128 \(portrait\) .*depth_turn=90 or 270"):
        data.open(tmp_path)
    assert data.open(tmp_path, depth_turn=90)[0].depth.shape[1:] == HW


def test_an_option_turns_the_depth_of_a_recording_whose_sizes_are_not_stated(room: SyntheticRoom) -> None:
    turned = [f.replace(depth=orientation.apply_symmetry(f.depth, 1), depth_camera=None) for f in room]
    recording = data.Recording("turned", "none", turned.__getitem__, torch.arange(5))
    assert recording.stored is None
    same(orientation.orient_recording(recording, 3), room, 0)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("by_K", [True, False])
def test_without_depth_over_the_picture_K_decides_whether_pictures_are_turned(
    room: SyntheticRoom, k: int, by_K: bool
) -> None:
    camera = convert.rot90_camera(room[0].camera, HW, k) if by_K else room[0].camera
    frames = [f.replace(camera=camera, depth_camera=f.camera) for f in room]
    sizes = StoredSizes(HW, None, k, "EXIF orientation")
    oriented = orientation.orient_recording(
        data.Recording("own", "none", frames.__getitem__, torch.arange(5), stored=sizes)
    )
    picture = orientation.apply_symmetry(room[0].image[0], k) if by_K else room[0].image[0]
    assert torch.equal(oriented.load(0).image[0], picture) and torch.equal(oriented.load(0).depth, room[0].depth)
    done = f"pictures are {orientation.SYMMETRY_NAMES[k]}" if by_K else "pictures are read as stored"
    assert oriented.report == (f"orientation: EXIF orientation: {done}, as K lies",)


def test_a_frame_of_mixed_orientation_is_refused_by_every_recording(room: SyntheticRoom) -> None:
    frame = room[0].replace(depth=torch.ones(1, 128, 96), depth_camera=None)
    recording = data.Recording("mixed", "none", lambda _: frame, torch.arange(1))
    with pytest.raises(FormatError, match="mixed: orientation: found depth 96x128"):
        recording[0]


@pytest.mark.parametrize(
    ("depth_hw", "hw", "differs"),
    [
        ((192, 256), (1440, 1920), False),
        ((256, 192), (1440, 1920), True),
        ((480, 480), (480, 640), False),
        ((101, 100), (100, 101), False),  # rounding of a square
        ((0, 0), (480, 640), False),
    ],
)
def test_which_sizes_contradict(depth_hw: tuple[int, int], hw: tuple[int, int], differs: bool) -> None:
    assert (describe_mismatch(depth_hw, hw) is not None) == differs


# ------------------------------------------------------------------------------------------------------------ headers


@pytest.mark.parametrize("exif", range(1, 9))
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_headers_state_the_exif_orientation(tmp_path: Path, exif: int, kind: str) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / f"x.{kind}", exif=_tag(exif))
    assert files.read_image_header(tmp_path / f"x.{kind}").orientation == exif


@pytest.mark.parametrize("cut", range(4, 26, 3))
def test_damaged_exif_states_nothing(cut: int) -> None:
    whole = _tag(6).tobytes()[6:]
    assert files._parse_exif_orientation(whole) == 6
    assert files._parse_exif_orientation(whole[:cut]) in (1, 6)
    assert files._parse_exif_orientation(whole[:cut] + b"\xff" * 40) in (1, 6)
    assert files._parse_exif_orientation(b"\xff" * cut) == 1


@pytest.mark.parametrize("k", range(8))
def test_display_matrix_of_a_film_is_read_but_not_applied(tmp_path: Path, k: int) -> None:
    pytest.importorskip("av")
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:16, :24] = 255
    write_video(tmp_path / "film.mp4", [picture] * 3, [0, 1 / 30, 2 / 30], display=k)
    header = video.read_video_header(tmp_path / "film.mp4")
    assert (header.display, header.hw) == (k, (32, 48))
    assert int(video.read_video_frame(tmp_path / "film.mp4", 0)[8, 8, 0]) > 200


def test_an_edge_is_its_capped_strength_and_the_cosine_and_sine_of_twice_its_direction() -> None:
    x = torch.rand(7, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x[:, 4:] += 9  # a step that the cap cuts
    mask = torch.rand(7, 9, generator=torch.Generator().manual_seed(1)) < 0.8
    gy, gx = np.gradient(x.numpy())
    strength = np.hypot(gx, gy) * mask.numpy()
    capped = np.minimum(strength, orientation._MAX_EDGE_STRENGTH * strength[mask.numpy()].mean())
    assert (capped < strength).any()
    angle = 2 * np.arctan2(gy, gx)
    found = orientation._edge_vectors(x, mask)
    np.testing.assert_allclose(found, [capped, capped * np.cos(angle), capped * np.sin(angle)], atol=1e-9)
    assert not orientation._edge_vectors(x, mask & False).any()
