"""Focal stacks: every format written and read back, refocused light fields, damaged files, real stacks."""

from __future__ import annotations

import math
import os
import pickle
from pathlib import Path

import h5py
import numpy as np
import OpenEXR
import pytest
import tifffile
import torch
from support.focal_stacks import light_field, random_stack, texture
from support.writers import focal as stack_writers

from dhtorch import data
from dhtorch.cli import run
from dhtorch.data import FormatError
from dhtorch.data.codecs import hdf5, npy, tiff
from dhtorch.experiments.focal import ddff12, fod500, formats, image_folder
from dhtorch.experiments.focal.light_field import refocus
from dhtorch.experiments.focal.stacks import FocalStacks

ROOT = os.environ.get("DHTORCH_DATA")
real = pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")

FOCUS = (0.1, 0.15, 0.3, 0.7, 1.5)


def fails(message: str, root: Path, **options: object) -> None:
    with pytest.raises(FormatError, match=message):
        stacks = formats.open_stacks(root, **options)
        for i in range(len(stacks)):
            stacks[i]


# ------------------------------------------------------------------------------------------------ written, then read


def test_fod500_gives_back_pictures_depth_and_lens(tmp_path: Path) -> None:
    want = {0: random_stack(0), 7: random_stack(7), 400: random_stack(400)}
    stack_writers.write_fod500(tmp_path, want)
    stacks = formats.open_stacks(tmp_path)
    assert stacks.format == "fod500" and stacks.names == ("000000", "000007", "000400") and stacks.report == ()
    for got, made in zip(stacks, want.values(), strict=True):
        assert torch.equal(got.images, made.images) and torch.equal(got.depth, made.depth)  # half floats are exact
        assert got.focus_m.tolist() == [[pytest.approx(x) for x in FOCUS]] and got.camera is None
        assert float(got.focal_length_m) == pytest.approx(2.9e-3) and got.f_number.tolist() == [1.0]
    assert formats.open_stacks(tmp_path, split="val").names == ("000400",)
    assert formats.open_stacks(tmp_path, split="train").names == ("000000", "000007")


def test_fod500_clips_and_masks_depth(tmp_path: Path) -> None:
    made = random_stack(0)
    depth = made.depth.clone()
    depth[0, 0, :4] = torch.tensor([5.0, math.nan, -1.0, math.inf])
    stack_writers.write_fod500(tmp_path, {0: made.replace(depth=depth)})
    assert formats.open_stacks(tmp_path)[0].depth[0, 0, :4].tolist() == [3, 0, 0, 0]
    assert formats.open_stacks(tmp_path, max_depth=None)[0].depth[0, 0, 0] == 5


def test_fod500_sample_that_lacks_something_is_left_out_and_shifts_nothing(tmp_path: Path) -> None:
    want = {i: random_stack(i) for i in range(4)}
    stack_writers.write_fod500(tmp_path, want)
    (tmp_path / "000001_02All.tif").unlink()
    (tmp_path / "000002Dpt.exr").unlink()
    stacks = formats.open_stacks(tmp_path)
    assert stacks.names == ("000000", "000003")
    assert stacks.report == (
        "sample 000001: 4 pictures and 1 depth map: left out",
        "sample 000002: 5 pictures and 0 depth maps: left out",
    )
    assert torch.equal(stacks[1].images, want[3].images) and torch.equal(stacks[1].depth, want[3].depth)
    for file in tmp_path.glob("*.exr"):
        file.unlink()
    assert formats.open_stacks(tmp_path)[1].depth is None  # pictures alone are a stack, too


def test_fod500_reads_the_red_channel_of_pictures_of_any_kind(tmp_path: Path) -> None:
    stack_writers.write_fod500(tmp_path, {0: random_stack(0)})
    planes = {c: np.full((12, 16), v, np.float16) for c, v in (("R", 1.5), ("G", 2.5), ("B", 0.5))}
    OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(
        str(tmp_path / "000000Dpt.exr")
    )
    picture = random_stack(3).images[0, 0].permute(1, 2, 0).numpy()
    tifffile.imwrite(tmp_path / "000000_00All.tif", picture, compression="lzw", predictor=True, photometric="rgb")
    got = formats.open_stacks(tmp_path)[0]
    assert bool((got.depth == 1.5).all()) and torch.equal(got.images[0, 0], random_stack(3).images[0, 0])


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
@pytest.mark.parametrize("compression", [None, "gzip"])
def test_ddff12_gives_back_stacks_and_depth(dtype: str, compression: str | None, tmp_path: Path) -> None:
    train, val = [random_stack(i, 10) for i in range(3)], [random_stack(9, 10)]
    test = [random_stack(20, 10, depth=False)]
    file = tmp_path / "ddff.h5"
    stack_writers.write_ddff12(file, {"train": train, "val": val, "test": test}, dtype=dtype, compression=compression)
    stacks = formats.open_stacks(file)
    assert stacks.format == "ddff12" and sorted(stacks.names)[:2] == ["test/0000", "train/0000"] and len(stacks) == 5
    for split, want in (("train", train), ("val", val), ("test", test)):
        for got, made in zip(formats.open_stacks(tmp_path, split=split), want, strict=True):
            assert got.images.dtype == torch.uint8 and torch.equal(got.images, made.images) and got.camera is None
            if made.depth is None:
                assert got.depth is None
            else:
                torch.testing.assert_close(got.depth, made.depth, rtol=1e-6, atol=0)
                assert float(got.depth[0, 2, 3]) == 0  # disparity 0 is no depth, not infinity
    table = [0.500, 0.558, 0.630, 0.724, 0.851, 1.033, 1.313, 1.800, 2.864, 7.000]
    torch.testing.assert_close(stacks[0].focus_m[0], torch.tensor(table), atol=5e-4, rtol=0)


def test_ddff12_in_full_size_has_its_camera_and_opening_reads_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "big.h5"
    with h5py.File(file, "w") as group:
        group.create_dataset("stack_train", shape=(400, 10, 383, 552, 3), dtype="u1", chunks=(1, 1, 383, 552, 3))
        group.create_dataset("disp_train", shape=(400, 383, 552), dtype="f4", chunks=(1, 383, 552))
    read: list[object] = []
    take = h5py.Dataset.__getitem__
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda self, key: read.append(key) or take(self, key))
    stacks = formats.open_stacks(file)
    assert len(stacks) == 400 and read == []
    assert not bool(stacks[7].depth.any()) and len(read) > 0
    assert torch.equal(stacks[399].camera.f, torch.tensor([[521.4052, 521.4052]])) and stacks[0].hw == (383, 552)


def test_ddff12_values_and_keys_as_they_come(tmp_path: Path) -> None:
    made = random_stack(0, 10)
    pixels = made.images.permute(0, 1, 3, 4, 2).numpy()
    with h5py.File(tmp_path / "a.h5", "w") as group:
        group["stacks_train"] = pixels.astype("f8") / 255  # the name in the authors' notes
        group["stack_val"] = pixels + 0.25 * (pixels < 255)
        group["AiF_train"] = pixels[:, 0]
    train, val = formats.open_stacks(tmp_path / "a.h5", split="train")[0], formats.open_stacks(tmp_path, split="val")[0]
    assert train.images.dtype == val.images.dtype == torch.float32
    torch.testing.assert_close(train.images, made.images / 255)
    torch.testing.assert_close(val.images[0, 0], (made.images[0, 0] + 0.25 * (made.images[0, 0] < 255)) / 255)


def test_image_folder_counts_as_people_do(tmp_path: Path) -> None:
    made = random_stack(0, 12)
    stack_writers.write_image_folder(tmp_path, made)
    stacks = formats.open_stacks(tmp_path)
    assert stacks.format == "images" and len(stacks) == 1
    got = stacks[0]
    assert torch.equal(got.images, made.images)  # image2 before image10
    assert got.depth is None and got.focus_m is None and got.camera is None
    focus = [0.1 * k for k in range(1, 13)]
    assert formats.open_stacks(tmp_path, focus_m=focus)[0].focus_m.shape == (1, 12)
    fails(r"option focus_m: found \[0.1, 0.2\], expected 12 finite numbers", tmp_path, focus_m=[0.1, 0.2])


def test_image_folder_of_sixteen_bits_and_alpha(tmp_path: Path) -> None:
    deep = np.random.default_rng(0).integers(0, 65536, (9, 7, 4)).astype(np.uint16)
    for k in range(2):
        tifffile.imwrite(
            tmp_path / f"{k}.tif", deep, compression="zlib", photometric="rgb", extrasamples=["unassalpha"]
        )
    images = formats.open_stacks(tmp_path)[0].images
    torch.testing.assert_close(
        images[0, 1], torch.from_numpy(deep[..., :3].astype(np.float32) / 65535).permute(2, 0, 1)
    )


# ------------------------------------------------------------------------------------------------------- light fields


def test_refocus_restores_what_lies_at_its_disparity() -> None:
    hw = (40, 48)
    inner = (..., slice(8, -8), slice(8, -8))
    flat = light_field(torch.tensor(0.17, dtype=torch.float64), hw)
    out = refocus(flat, torch.tensor([0.17, 0.05, -0.17]))
    centre = flat[4, 4].permute(2, 0, 1).float()
    errors = [float((image.float() - centre)[inner].abs().max()) for image in out]
    assert out.dtype == torch.uint8 and out.shape == (3, 3, *hw)
    assert errors[0] <= 4 and errors[1] > 12 and errors[2] > 60, errors  # measured 3, 17, 94
    # Sharpness must not depend on the fraction of a pixel that a slice happens to shift by.
    for d in (0.0, 0.1, 0.25):
        lf = light_field(torch.tensor(d, dtype=torch.float64), hw)
        error = (refocus(lf, torch.tensor([d]))[0].float() - lf[4, 4].permute(2, 0, 1).float())[inner].abs().max()
        assert float(error) <= 4


def test_refocus_does_not_swap_rows_and_columns() -> None:
    hw = (40, 48)
    y, x = torch.meshgrid(torch.arange(hw[0]).double(), torch.arange(hw[1]).double(), indexing="ij")
    step = torch.arange(5).double() - 2
    lf = torch.stack([torch.stack([texture(y + 0.4 * u, x) for _ in step]) for u in step]).round().to(torch.uint8)
    one_row = refocus(lf[:, 2:3], torch.tensor([0.4]))[0].float()  # a column of pictures, one below the other
    assert float((one_row - lf[2, 2].permute(2, 0, 1).float())[:, 8:-8, 8:-8].abs().max()) <= 3


def test_ddff12_raw_light_fields_are_sharpest_at_their_depth(tmp_path: Path) -> None:
    hw, constant = (40, 96), 0.1412376
    depth = torch.full((1, *hw), 0.558)
    depth[:, :, 48:] = 1.8
    depth[:, :4, :4] = 0
    stack_writers.write_light_field(
        tmp_path, "train/kitchen", 3, light_field(constant / depth[0].clamp(min=0.5).double(), hw), depth
    )
    stack_writers.write_light_field(tmp_path, "test/cafeteria", 1, light_field(torch.tensor(0.1), hw))
    stacks = formats.open_stacks(tmp_path)
    assert stacks.format == "ddff12" and stacks.names == ("test/cafeteria/0001", "train/kitchen/0003")
    assert stacks[0].depth is None
    got = stacks[1]
    torch.testing.assert_close(got.depth, depth, atol=5e-4, rtol=0)
    assert got.images.shape == (1, 10, 3, *hw) and float(got.depth[0, 0, 0]) == 0
    sharpness = got.images[0].float().diff(dim=-1).abs()
    for columns, focus in ((slice(10, 38), 0.558), (slice(58, 86), 1.8)):
        best = int(sharpness[..., 8:-8, columns].mean((1, 2, 3)).argmax())
        assert float(got.focus_m[0, best]) == pytest.approx(focus, abs=1e-3)


def test_ddff12_stacks_of_one_room_are_one_scene(tmp_path: Path) -> None:
    lf = light_field(torch.tensor(0.1), (12, 16), 3)
    for scene, number in (("train/kitchen", 0), ("train/kitchen", 4), ("test/library", 4), ("train/studentlab", 0)):
        stack_writers.write_light_field(tmp_path / "raw", scene, number, lf)
    raw = formats.open_stacks(tmp_path / "raw")
    assert raw.by_scene() == {"test/library": [0], "train/kitchen": [1, 2], "train/studentlab": [3]}
    assert formats.open_stacks(tmp_path / "raw", split="test").by_scene() == {"test/library": [0]}

    file = tmp_path / "a.h5"
    stack_writers.write_ddff12(file, {"train": [random_stack(i, 10) for i in range(5)], "val": [random_stack(9, 10)]})
    assert formats.open_stacks(file).by_scene() == {"train": [0, 1, 2, 3, 4], "val": [5]}, "which rooms is not said"
    known = formats.open_stacks(file, per_scene=2, split="train").by_scene()
    assert known == {"train/scene_00": [0, 1], "train/scene_01": [2, 3], "train/scene_02": [4]}
    fails("option per_scene: found 0, expected at least 1", file, per_scene=0)
    stack_writers.write_fod500(tmp_path / "fod", {0: random_stack(0), 7: random_stack(7)})
    assert formats.open_stacks(tmp_path / "fod").by_scene() == {"000000": [0], "000007": [1]}, "each a scene of its own"
    with pytest.raises(ValueError, match="found 1 scene of 2 stacks, expected one for each"):
        FocalStacks("x", "images", raw.load, ("a", "b"), scenes=("room",))


def test_ddff12_raw_without_its_depth_is_left_out(tmp_path: Path) -> None:
    lf, depth = light_field(torch.tensor(0.1), (12, 16), 3), torch.ones(1, 12, 16)
    for number in range(3):
        stack_writers.write_light_field(tmp_path, "train/kitchen", number, lf, depth)
    (tmp_path / "DepthRegistered/train/kitchen/DEPTH_0001.png").unlink()
    stacks = formats.open_stacks(tmp_path)
    assert stacks.names == ("train/kitchen/0000", "train/kitchen/0002")
    assert stacks.report == ("train/kitchen/0001: no DEPTH_0001.png: left out",)


# ------------------------------------------------------------------------------------------------------------- errors


def test_opening_decodes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stack_writers.write_fod500(tmp_path / "a", {0: random_stack(0)})
    stack_writers.write_ddff12(tmp_path / "b.h5", {"train": [random_stack(0, 10)]})
    for module, name in ((tiff, "read_tiff"), (fod500.exr, "read_exr"), (hdf5.Hdf5Array, "row")):
        monkeypatch.setattr(module, name, lambda *a, **k: 1 / 0)
    assert len(formats.open_stacks(tmp_path / "a")) == len(formats.open_stacks(tmp_path / "b.h5")) == 1


WRITTEN = {
    "fod500": lambda root: stack_writers.write_fod500(root, {0: random_stack(0), 1: random_stack(1)}),
    "ddff12": lambda root: stack_writers.write_ddff12(root / "a.h5", {"val": [random_stack(0, 10)]}),
    "images": lambda root: stack_writers.write_image_folder(root, random_stack(0, 5)),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_job_of_pairs_says_why_not(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "focus_sweep"
    root.mkdir()
    WRITTEN[name](root)
    assert formats.recognise_stacks(root)[0] == name and formats.open_stacks(root).format == name
    with pytest.raises(FormatError, match=r"focus_sweep: format: found .*, expected from a phone: Record3D"):
        data.open(root)
    monkeypatch.chdir(tmp_path)
    assert run.main(["data=auto", f"data.root={root}", "pairs.gap=1", "holdout.cutoff=1.0"]) != 0
    said = " ".join(capsys.readouterr().err.split())
    expected = "expected a recording of a moving camera; for focal stacks use experiment=focus_stack data=stacks"
    assert f"focus_sweep holds focal stacks ({name}), images of one view, {expected}" in said
    assert run.main(["data=stacks", f"data.root={root}", "pairs.gap=1", "holdout.cutoff=1.0"]) != 0
    said += " ".join(capsys.readouterr().err.split())
    assert f"data: found Stacks('{formats.open_stacks(root).name}', {name}, " in said
    assert "Traceback" not in said and not list(tmp_path.rglob("result.json"))


def test_stacks_are_a_sequence_and_pickle(tmp_path: Path) -> None:
    stack_writers.write_fod500(tmp_path, {0: random_stack(0), 1: random_stack(1)})
    stacks = pickle.loads(pickle.dumps(formats.open_stacks(tmp_path)))
    assert torch.equal(stacks[-1].images, random_stack(1).images) and len(list(stacks)) == 2
    with pytest.raises(IndexError, match="stack 2 of 2"):
        stacks[2]
    with pytest.raises(ValueError, match="found none"):
        FocalStacks("x", "images", stacks.load, ())


def test_bad_stacks(tmp_path: Path) -> None:
    fails(r"nowhere: path: found no such file or folder", tmp_path / "nowhere")
    fails(r": format: found no focal stack, expected one of fod500, ddff12, images", tmp_path)
    fails(r": format: found tum, expected auto, fod500", tmp_path, format="tum")
    fails(r": pictures: found 0, expected at least two", tmp_path, format="images")
    with pytest.raises(ValueError, match="format images has no option 'split', expected one of focus_m"):
        formats.open_stacks(tmp_path, "images", split="train")
    stack_writers.write_image_folder(tmp_path, random_stack(0, 1))
    fails(r": pictures: found 1, expected at least two, at different focus", tmp_path, format="images")
    stack_writers.write_image_folder(tmp_path, random_stack(0, 3))
    stack_writers.write_image_folder(tmp_path / "b", random_stack(0, 2, hw=(12, 17)))
    (tmp_path / "b/image2.png").rename(tmp_path / "image2.png")
    fails(
        r"image2.png: picture: found 17x12, 3 channels, .*, expected 16x12.* as image1.png", tmp_path, format="images"
    )
    fails(r": format: found no focal stack", tmp_path)  # pictures of several sizes are not recognised as one
    fails(r"option focus_m: found .* expected positive distances", tmp_path, format="images", focus_m=[1, 2, 0])


def test_bad_fod500(tmp_path: Path) -> None:
    stack_writers.write_fod500(tmp_path, {0: random_stack(0)})
    fails(r"option split: found test, expected train or val", tmp_path, split="test")
    fails(r"samples: found none complete among 1, expected 4 \*All.tif and one \*Dpt.exr", tmp_path, focus_m=FOCUS[:4])
    fails(r"option f_number: found 0.0, expected a positive number", tmp_path, f_number=0)
    fails(r"option max_depth: found -1.0", tmp_path, max_depth=-1)
    good = (tmp_path / "000000Dpt.exr").read_bytes()
    (tmp_path / "000000Dpt.exr").write_bytes(good[:-20])
    fails(r"000000Dpt.exr: data: found scan lines missing", tmp_path)
    (tmp_path / "000000_03All.tif").write_bytes(stack_writers.rgb_tiff(np.zeros((12, 17, 3), np.uint8)))
    fails(r"000000_03All.tif: picture: found 17x12", tmp_path)


def test_bad_ddff12(tmp_path: Path) -> None:
    file = tmp_path / "a.h5"

    def written(**arrays: object) -> None:
        with h5py.File(file, "w") as group:
            for key, value in arrays.items():
                group[key] = value

    good = random_stack(0, 10).images.permute(0, 1, 3, 4, 2).numpy()
    written(stack_train=good, disp_train=np.ones((2, 12, 16)))
    fails(r"a.h5: disp_train: found shape \(2, 12, 16\), expected \(1, 12, 16\), as stack_train", file)
    written(stack_train=good[0])
    fails(r"a.h5: stack_train: found shape \(10, 12, 16, 3\), expected stacks, slices", file)
    written(stack_train=good[:, :7])
    fails(r"a.h5: slices: found 7, expected 10, one for each focus distance", file)
    assert formats.open_stacks(file, focus_m=[0.5, 0.6, 0.7, 0.8, 1, 2, 7])[0].images.shape[1] == 7
    written(stack_train=good * 1.5)
    fails(r"a.h5: stack_train: found 0 to 38.*, expected values from 0 to 255", file)
    written(stack_train=good, elsewhere=h5py.ExternalLink("/etc/hostname", "/x"))
    fails(r"a.h5: elsewhere: found a link, expected an entry of this file", file)
    written(stack_train=good)
    fails(r"stacks: found none of split val", file, split="val")
    file.write_bytes(file.read_bytes()[:300])
    fails(r"a.h5: data: found .*, expected a whole HDF5 file", file)
    with h5py.File(file, "w") as group:
        group.create_dataset("stack_train", shape=good.shape, dtype="u1", external=[("/etc/hostname", 0, good.size)])
    fails(r"a.h5: stack_train: found values in another file", file)
    with h5py.File(file, "w") as group:
        group.create_dataset("stack_train", shape=(1, 10, 9000, 9000, 3), dtype="u1", chunks=(1, 10, 9000, 9000, 3))
    fails(r"a.h5: stack_train size: found rows of \d+ and chunks of \d+ bytes", file)


def test_bad_light_field(tmp_path: Path) -> None:
    stack_writers.write_light_field(
        tmp_path, "train/a", 1, light_field(torch.tensor(0.1), (12, 16), 3), torch.ones(1, 12, 16)
    )
    file = tmp_path / "LightField/train/a/LF_0001.npy"
    good = file.read_bytes()
    file.write_bytes(good[:-1])
    fails(r"LF_0001.npy: data: found 5183 bytes, expected \(3, 3, 12, 16, 3\)", tmp_path)
    np.save(file, np.zeros((3, 3, 12, 16, 3), np.float32))
    fails(r"LF_0001.npy: light field: found float32 of", tmp_path)
    np.save(file, np.array([{"a": 1}]), allow_pickle=True)
    fails(r"LF_0001.npy: light field dtype: found object, expected real numbers", tmp_path)
    assert npy.parse_npy_header(file, "x", good).shape == (3, 3, 12, 16, 3)


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stack_writers.write_ddff12(tmp_path / "a.h5", {"train": [random_stack(0, 10)]})
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(ImportError, match=r"h5py, which is not installed: pip install h5py$"):
        formats.open_stacks(tmp_path / "a.h5")


# --------------------------------------------------------------------------------------------------------- real pieces


@pytest.mark.data
@real
def test_real_focus_sweeps() -> None:
    room = formats.open_stacks(Path(ROOT) / "focus_stack_room")
    assert room.format == "images" and room[0].images.shape == (1, 6, 3, 768, 1024)
    heatsink = formats.open_stacks(Path(ROOT) / "focus_stack_heatsink" / "assets" / "9")
    order = [int("".join(c for c in file.stem if c.isdigit())) for file in heatsink.load.pictures]
    assert order == list(range(1, 50))
    # A sweep moves the focus steadily: the next picture is sharp in nearly the same places. Measured 0.97 for the order
    # of the numbers, 0.91 for the order of the letters.
    images = heatsink[0].images[0, :, 1].float()
    sharp = torch.stack([torch.nn.functional.avg_pool2d(x.diff(dim=-1).abs()[None], 60)[0].flatten() for x in images])
    assert float(torch.corrcoef(sharp).diagonal(1).mean()) > 0.95


@pytest.mark.data
@real
def test_a_colour_and_depth_pair_is_no_focus_stack() -> None:
    folder = next(
        f
        for f in (Path(ROOT) / "arkit_single").rglob("*")
        if (f.is_dir() and any(f.glob("*.jpg"))) or any(f.glob("*.png"))
    )
    assert image_folder.recognise(folder) is None and ddff12.recognise(folder) is None
