"""Folders of depth maps as other tools write them: clips in one file, masks, units, sentinels, numbering."""

import io
import shutil
import struct
import warnings
import zipfile

import numpy as np
import pytest
import torch

from dhtorch.data.codecs.pfm import read_pfm
from dhtorch.data.depth_maps import open_depth_maps
from dhtorch.data.io.decode import FormatError
from dhtorch.export.frames import encode_png
from dhtorch.synthetic.recording import SyntheticRoom

N = 4


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=N, hw=(72, 96))


@pytest.fixture(scope="module")
def truth(room):
    return np.stack([room.truth(k)["depth"][0].numpy() for k in range(N)])


def store(folder, maps, name="{k}.npy"):
    """A file for every map, of the format of its name."""
    for k, array in enumerate(maps):
        path = folder / name.format(k=k)
        path.write_bytes(encode_png(array)) if name.endswith("png") else np.save(path, array)


def millimetres(depth):
    return (1000 * depth).round().astype(np.uint16)


def read_all(maps):
    return np.stack([maps[i][0].numpy() for i in range(N)])


@pytest.mark.parametrize("shape", ["nhw", "nhw1", "n1hw"])
@pytest.mark.parametrize("name", ["clip.npy", "depths", "depth", "anything"])
def test_one_file_of_a_clip_holds_a_map_for_every_frame(tmp_path, room, truth, shape, name):
    clip = {"nhw": truth, "nhw1": truth[..., None], "n1hw": truth[:, None]}[shape]
    if name.endswith(".npy"):
        np.save(tmp_path / name, clip)
    else:
        np.savez(tmp_path / "clip.npz", **{name: clip}, **({} if name == "anything" else {"fps": np.float32(30)}))
    maps = open_depth_maps(tmp_path, room)
    assert maps.frames == [0, 1, 2, 3] and maps.by == "clip" and not maps.warnings
    assert np.array_equal(read_all(maps), truth)


def test_a_clip_of_another_length_is_refused_with_its_number_of_maps(tmp_path, room, truth):
    for clip, message in (
        (truth[:3], "a file that holds 3 maps, expected one for each of 4 frames"),
        *(
            (truth[:n, :h, :w], r"clip\.npz: depth: found shape .*, expected \(height, width\)")
            for n, h, w in ((N, 0, 96), (0, 72, 96), (N, 72, 0))
        ),
    ):
        np.savez(tmp_path / "clip.npz", depths=clip)
        with pytest.raises(FormatError, match=message):
            open_depth_maps(tmp_path, room)
    np.savez(tmp_path / "clip.npz", depths=np.concatenate([truth, truth[:2]]))
    assert np.array_equal(read_all(open_depth_maps(tmp_path, room)), truth), "all frames are numbered below six"


def test_masks_are_left_out_and_the_number_that_differs_counts(tmp_path, room, truth):
    store(tmp_path, truth[..., None], "{k:05d}_indoors_000_depth.npy")
    store(tmp_path, np.ones_like(truth), "{k:05d}_indoors_000_depth_mask.npy")
    maps = open_depth_maps(tmp_path, room)
    assert np.array_equal(read_all(maps), truth) and maps.by == "number"
    assert any("4 masks left out" in note for note in maps.notes)


def test_an_archive_with_other_numbers_beside_the_depth(tmp_path, room, truth):
    for k in range(N):
        np.savez(tmp_path / f"{k:05d}.npz", depth=truth[k], focallength_px=np.float32(525))
    assert np.array_equal(read_all(open_depth_maps(tmp_path, room)), truth)


def test_depth_packed_in_colours_is_refused(tmp_path, room, truth):
    store(tmp_path, np.zeros((N, 72, 96, 3), np.uint8), "{k}.png")
    with pytest.raises(FormatError, match="png with 3 channels of 8 bits"):
        open_depth_maps(tmp_path, room)[0]


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_saturated_values_and_far_planes_are_no_depth(tmp_path, room, truth, suffix):
    codes = np.where(np.arange(72)[:, None] < 18, np.uint16(65535), millimetres(truth))
    store(tmp_path, codes if suffix == "png" else codes / np.float32(1000), f"{{k}}.{suffix}")
    depth = read_all(open_depth_maps(tmp_path, room))
    assert not depth[:, :18].any() and np.allclose(depth[:, 18:], truth[:, 18:], atol=1e-3)
    np.save(tmp_path / "clip.npy", np.where(np.arange(72)[:, None] < 18, 1000.0, truth))
    for file in tmp_path.glob(f"[0-9].{suffix}"):
        file.unlink()
    assert np.array_equal(
        read_all(open_depth_maps(tmp_path, room)) == 0, np.broadcast_to(np.arange(72)[:, None] < 18, depth.shape)
    )


def test_maps_numbered_from_one_are_warned_of_with_their_numbers(tmp_path, room, truth):
    store(tmp_path, truth[[0, 0, 1, 2]], "{k:05d}.npy")
    (tmp_path / "00000.npy").unlink()
    maps = open_depth_maps(tmp_path, room)
    assert maps[0] is None and np.array_equal(maps[1][0].numpy(), truth[0])
    (warning,) = maps.warnings
    assert warning.startswith("3 maps numbered 1 to 3 for 4 frames numbered 0 to 3: matched by number")
    assert maps.notes[0] == f"warning: {warning}" and maps.report["warnings"] == [warning]
    np.save(tmp_path / "00000.npy", truth[0])
    assert not open_depth_maps(tmp_path, room).warnings


def test_the_unit_is_stated_or_named_as_an_assumption(tmp_path, room, truth):
    store(tmp_path, millimetres(truth), "{k}.png")
    assumed = open_depth_maps(tmp_path, room)
    assert assumed.unit.is_assumed and assumed.notes == ["maps: depth unit assumed: 1/1000 m"]
    assert assumed.report["depth_unit"] == "depth unit assumed: 1/1000 m" and not assumed.doubts
    stated = open_depth_maps(tmp_path, room, "1/10000")
    assert stated.unit.metres == 1e-4 and stated.notes == ["maps: depth unit: 1/10000 m (option depth_unit)"]
    assert torch.allclose(10 * stated[1], assumed[1])
    (tmp_path / "complete.json").write_text('{"unit_m": 0.002}')
    assert open_depth_maps(tmp_path, room).unit.source == "complete.json: unit_m"
    for unit in ("furlong", "1/0", 0, True):
        with pytest.raises(ValueError, match="depth_unit"):
            open_depth_maps(tmp_path, room, unit)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda z: 10 * z, "depth unit 1/10000 m"),
        (lambda z: 1 - 0.01 / z, "z-buffer"),
        (lambda z: 1000 * z, "depth unit 1/1000 m"),
    ],
)
def test_values_that_are_no_depth_in_the_unit_are_doubted(tmp_path, room, truth, change, words):
    changed = change(truth.astype(np.float64))
    is_png = "10000" in words
    store(tmp_path, millimetres(changed) if is_png else changed.astype(np.float32), "{k}.png" if is_png else "{k}.npy")
    (doubt,) = open_depth_maps(tmp_path, room).doubts
    assert doubt.startswith("warning: maps: ") and words in doubt and "data." not in doubt


def npy_claiming(shape, data=b""):
    """An NPY file whose header claims another shape than its values have."""
    header = str({"descr": "<f4", "fortran_order": False, "shape": shape}).encode()
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def pfm_of(scale, values):
    return f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode() + values.astype("<f4").tobytes()


def test_the_last_row_of_a_pfm_comes_first(tmp_path):
    (tmp_path / "a.pfm").write_bytes(pfm_of("-1", np.array([[3.0, 4], [1, 2]])))
    assert read_pfm(tmp_path / "a.pfm").tolist() == [[1, 2], [3, 4]]


def npz_with(*members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two members of one name
        for values in members:
            archive.writestr("depth.npy", npy_claiming(values.shape, values.astype("<f4").tobytes()))
    return stream.getvalue()


HOSTILE = {
    "npy: found 0 bytes, expected (1000000000, 1000000000)": lambda z: npy_claiming((10**9, 10**9)),
    "npy: found 100 bytes, expected (100000, 100000)": lambda z: npy_claiming((10**5, 10**5), bytes(100)),
    "npy shape: found (-72, 96)": lambda z: npy_claiming((-72, 96), z.tobytes()),
    "npy: found ValueError": lambda z: b"\x93NUMPY\x01\x00\xff\xff{{{{",
    "npy: found 2e+05 m, expected at most 10000 m": lambda z: npy_claiming(z.shape, (0 * z + 2e5).tobytes()),
    "npz: found 2 members depth.npy, expected one": lambda z: npz_with(z, 2 * z),
    "pfm: found 0.0, expected a number below 0": lambda z: pfm_of("0", z),
    "pfm: found nan, expected a number below 0": lambda z: pfm_of("nan", z),
    "pfm: found inf, expected a number below 0": lambda z: pfm_of("inf", z),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_hostile_maps_are_refused_in_one_line_before_memory_is_taken(tmp_path, room, truth, message):
    suffix = message[:3]
    for k in range(N):
        (tmp_path / f"{k}.{suffix}").write_bytes(HOSTILE[message](truth[k]))
    maps = open_depth_maps(tmp_path, room)
    with pytest.raises(FormatError) as refused:
        maps[1]
    text = str(refused.value)
    assert f"1.{suffix}" in text and message.partition("found ")[2] in text and "\n" not in text


def test_the_unit_of_a_folder_above_is_not_taken(tmp_path, room, truth):
    (tmp_path / "complete.json").write_text('{"unit_m": 0.5}')
    for name in ("maps", "depth"):
        (tmp_path / name).mkdir()
        store(tmp_path / name, truth)
    assert np.array_equal(read_all(open_depth_maps(tmp_path / "maps", room)), truth)
    with pytest.raises(
        FormatError, match=f"a part of a folder of dhtorch complete, expected {tmp_path}, or depth_unit"
    ):
        open_depth_maps(tmp_path / "depth", room)
    assert np.allclose(read_all(open_depth_maps(tmp_path / "depth", room, "m")), truth)


@pytest.mark.parametrize("linked", ["2.npy", "depth", "complete.json", "clip.npy", "gone.npy"])
def test_links_that_leave_the_folder_are_refused(tmp_path, room, truth, linked):
    outside, root = tmp_path / "outside", tmp_path / "maps"
    for folder in (outside, root / "depth"):
        folder.mkdir(parents=True)
        store(folder, truth)
    (outside / "complete.json").write_text('{"unit_m": 0.5}')
    np.save(outside / "clip.npy", truth)
    link, target = root / "depth" / linked, outside / linked
    if linked in ("depth", "complete.json"):
        link, target = root / linked, outside if linked == "depth" else outside / linked
    if linked in ("depth", "clip.npy"):
        shutil.rmtree(root / "depth")
        link.parent.mkdir(exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(target)
    with pytest.raises(FormatError, match=r": (link: found one to outside|file: found no such file)") as refused:
        open_depth_maps(root, room)
    assert "\n" not in str(refused.value)
    if linked == "2.npy":
        link.unlink()
        np.save(root / "depth" / "real.bin.npy", truth[2])
        (root / "depth" / "real.bin.npy").rename(root / "real.bin")
        link.symlink_to("../real.bin")
        assert np.array_equal(read_all(open_depth_maps(root, room)), truth), "links inside the folder are read"
