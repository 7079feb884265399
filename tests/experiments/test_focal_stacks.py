"""Focal stacks: every format written and read back, refocused light fields, damaged files, real stacks."""

import math
import os
import pickle
import sys
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
from dhtorch.data.codecs import tiff
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.ddff12 import refocus
from dhtorch.experiments.focal.stacks import FocalStacks

ROOT = os.environ.get("DHTORCH_DATA")
real = pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")

FOCUS = (0.1, 0.15, 0.3, 0.7, 1.5)


# ------------------------------------------------------------------------------------------------ written, then read


def test_fod500_gives_back_pictures_depth_and_lens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    want = {0: random_stack(0), 7: random_stack(7), 400: random_stack(400)}
    stack_writers.write_fod500(tmp_path, want)
    stacks = formats.open_stacks(tmp_path)
    assert stacks.format == "fod500" and stacks.names == ("000000", "000007", "000400") and stacks.report == ()
    for got, made in zip(stacks, want.values(), strict=True):
        assert torch.equal(got.images, made.images) and torch.equal(got.depth, made.depth)  # half floats are exact
        assert got.focus_m.tolist() == [[pytest.approx(x) for x in FOCUS]] and got.camera is None
        assert float(got.focal_length_m) == pytest.approx(2.9e-3) and got.f_number.tolist() == [1.0]
    assert torch.equal(pickle.loads(pickle.dumps(stacks))[-1].images, want[400].images) and len(list(stacks)) == 3
    assert formats.open_stacks(tmp_path, split="val").names == ("000400",)
    assert formats.open_stacks(tmp_path, split="train").names == ("000000", "000007")
    depth = want[0].depth.clone()
    depth[0, 0, :4] = torch.tensor([5.0, math.nan, -1.0, math.inf])
    stack_writers.write_fod500(tmp_path / "b", {0: want[0].replace(depth=depth)})
    assert formats.open_stacks(tmp_path / "b")[0].depth[0, 0, :4].tolist() == [3, 0, 0, 0]
    assert formats.open_stacks(tmp_path / "b", max_depth=None)[0].depth[0, 0, 0] == 5
    planes = {c: np.full((12, 16), v, np.float16) for c, v in (("R", 1.5), ("G", 2.5), ("B", 0.5))}
    file = OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, planes)
    file.write(str(tmp_path / "b/000000Dpt.exr"))
    image = random_stack(3).images[0, 0].permute(1, 2, 0).numpy()
    tifffile.imwrite(tmp_path / "b/000000_00All.tif", image, compression="lzw", predictor=True, photometric="rgb")
    got = formats.open_stacks(tmp_path / "b")[0]
    assert bool((got.depth == 1.5).all()) and torch.equal(got.images[0, 0], random_stack(3).images[0, 0])
    for module, name in ((tiff, "read_tiff"), (formats.exr, "read_exr")):
        monkeypatch.setattr(module, name, lambda *a, **k: 1 / 0)
    assert len(formats.open_stacks(tmp_path)) == 3, "opening decodes nothing"


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
    deep = np.random.default_rng(0).integers(0, 65536, (9, 7, 4)).astype(np.uint16)
    options = {"compression": "zlib", "photometric": "rgb", "extrasamples": ["unassalpha"]}
    (tmp_path / "deep").mkdir()
    for k in range(2):
        tifffile.imwrite(tmp_path / f"deep/{k}.tif", deep, **options)
    want = torch.from_numpy(deep[..., :3].astype(np.float32) / 65535).permute(2, 0, 1)
    torch.testing.assert_close(formats.open_stacks(tmp_path / "deep")[0].images[0, 1], want)


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
    stack_writers.write_light_field(tmp_path / "some", "train/kitchen", 0, lf, torch.ones(1, 12, 16))
    stack_writers.write_light_field(tmp_path / "some", "train/kitchen", 1, lf)
    assert formats.open_stacks(tmp_path / "some").report == ("train/kitchen/0001: no DEPTH_0001.png: left out",)
    assert formats.open_stacks(tmp_path / "raw", split="test").by_scene() == {"test/library": [0]}

    file = tmp_path / "a.h5"
    stack_writers.write_ddff12(file, {"train": [random_stack(i, 10) for i in range(5)], "val": [random_stack(9, 10)]})
    assert formats.open_stacks(file).by_scene() == {"train": [0, 1, 2, 3, 4], "val": [5]}, "which rooms is not said"
    known = formats.open_stacks(file, per_scene=2, split="train").by_scene()
    assert known == {"train/scene_00": [0, 1], "train/scene_01": [2, 3], "train/scene_02": [4]}
    stack_writers.write_fod500(tmp_path / "fod", {0: random_stack(0), 7: random_stack(7)})
    assert formats.open_stacks(tmp_path / "fod").by_scene() == {"000000": [0], "000007": [1]}, "each a scene of its own"


# ------------------------------------------------------------------------------------------------------------- errors


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


STACK, PIXELS = random_stack(0), random_stack(0, 10).images.permute(0, 1, 3, 4, 2).numpy()


def cut(file, n):
    file.write_bytes(file.read_bytes()[:n])


def hdf5_file(root, **arrays):
    with h5py.File(root / "a.h5", "w") as group:
        for key, value in arrays.items():
            group[key] = value
    return root / "a.h5"


def hdf5_elsewhere(root, **options):
    with h5py.File(root / "a.h5", "w") as group:
        group.create_dataset("stack_train", dtype="u1", **options)


def folder_of_two_sizes(root):
    stack_writers.write_image_folder(root, random_stack(0, 3))
    stack_writers.write_image_folder(root / "b", random_stack(0, 2, hw=(12, 17)))
    (root / "b/image2.png").rename(root / "image2.png")


def light_field_file(root, values=None, **options):
    depth = torch.ones(1, 12, 16)
    stack_writers.write_light_field(root, "train/a", 1, light_field(torch.tensor(0.1), (12, 16), 3), depth)
    file = root / "LightField/train/a/LF_0001.npy"
    if values is not None:
        np.save(file, values, **options)
    return file


def fod(root):
    stack_writers.write_fod500(root, {0: STACK})


def fod_of_other_size(root):
    fod(root)
    (root / "000000_03All.tif").write_bytes(stack_writers.rgb_tiff(np.zeros((12, 17, 3), np.uint8)))


IMAGES = {"format": "images"}


@pytest.mark.parametrize(
    ("write", "options", "message"),
    [
        (lambda root: root.rmdir(), {}, r"path: found no such file or folder"),
        (lambda root: None, {}, r": format: found no focal stack, expected one of fod500, ddff12, images"),
        (lambda root: None, {"format": "tum"}, r": format: found tum, expected auto, fod500"),
        (lambda root: None, IMAGES, r": pictures: found 0, expected at least two"),
        (
            lambda root: stack_writers.write_image_folder(root, random_stack(0, 1)),
            IMAGES,
            r"found 1, expected at least",
        ),
        (folder_of_two_sizes, IMAGES, r"image2.png: picture: found 17x12, 3 channels, .*, expected 16x12.* as image1"),
        (folder_of_two_sizes, {}, r": format: found no focal stack"),  # pictures of several sizes are none
        (
            lambda root: stack_writers.write_image_folder(root, random_stack(0, 3)),
            IMAGES | {"focus_m": [1, 2, 0]},
            "pos",
        ),
        (
            lambda root: stack_writers.write_image_folder(root, random_stack(0, 3)),
            {"focus_m": [1]},
            "expected 3 finite",
        ),
        (fod, {"split": "test"}, r"option split: found test, expected train or val"),
        (fod, {"focus_m": FOCUS[:4]}, r"samples: found none complete among 1, expected 4 \*All.tif and one \*Dpt.exr"),
        (fod, {"f_number": 0}, r"option f_number: found 0.0, expected a positive number"),
        (fod, {"max_depth": -1}, r"option max_depth: found -1.0"),
        (
            lambda root: (fod(root), cut(root / "000000Dpt.exr", -20)),
            {},
            r"000000Dpt.exr: data: found scan lines missing",
        ),
        (fod_of_other_size, {}, r"000000_03All.tif: picture: found 17x12"),
        (
            lambda root: hdf5_file(root, stack_train=PIXELS, disp_train=np.ones((2, 12, 16))),
            {},
            r"a.h5: disp_train: found shape \(2, 12, 16\), expected \(1, 12, 16\), as stack_train",
        ),
        (lambda root: hdf5_file(root, stack_train=PIXELS[0]), {}, r"stack_train: found shape \(10, 12, 16, 3\), exp"),
        (lambda root: hdf5_file(root, stack_train=PIXELS[:, :7]), {}, r"slices: found 7, expected 10, one for each"),
        (lambda root: hdf5_file(root, stack_train=PIXELS * 1.5), {}, r"found 0 to 38.*, expected values from 0 to 255"),
        (
            lambda root: hdf5_file(root, stack_train=PIXELS, elsewhere=h5py.ExternalLink("/etc/hostname", "/x")),
            {},
            r"a.h5: elsewhere: found a link, expected an entry of this file",
        ),
        (lambda root: hdf5_file(root, stack_train=PIXELS), {"split": "val"}, r"stacks: found none of split val"),
        (lambda root: hdf5_file(root, stack_train=PIXELS), {"per_scene": 0}, "per_scene: found 0, expected at least 1"),
        (lambda root: cut(hdf5_file(root, stack_train=PIXELS), 300), {}, r"found .*, expected a whole HDF5 file"),
        (
            lambda root: hdf5_elsewhere(root, shape=PIXELS.shape, external=[("/etc/hostname", 0, PIXELS.size)]),
            {},
            r"a.h5: stack_train: found values in another file",
        ),
        (
            lambda root: hdf5_elsewhere(root, shape=(1, 10, 9000, 9000, 3), chunks=(1, 10, 9000, 9000, 3)),
            {},
            r"a.h5: stack_train size: found rows of \d+ and chunks of \d+ bytes",
        ),
        (lambda root: cut(light_field_file(root), -1), {}, r"LF_0001.npy: data: found 5183 bytes, expected \(3, 3, 12"),
        (
            lambda root: light_field_file(root, np.zeros((3, 3, 12, 16, 3), np.float32)),
            {},
            r"LF_0001.npy: light field: found float32 of",
        ),
        (
            lambda root: light_field_file(root, np.array([{"a": 1}]), allow_pickle=True),
            {},
            r"LF_0001.npy: light field dtype: found object, expected real numbers",
        ),
    ],
)
def test_a_damaged_stack_is_named_with_what_was_expected(write, options, message, tmp_path: Path) -> None:
    root = tmp_path / "stack"
    root.mkdir()
    write(root)
    with pytest.raises(FormatError, match=message):
        list(formats.open_stacks(root, **options))


def test_hdf5_values_keys_and_slices_as_they_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = random_stack(0, 10).images
    values = {
        "stacks_train": PIXELS.astype("f8") / 255,
        "stack_val": PIXELS + 0.25 * (PIXELS < 255),
        "AiF": PIXELS[:, 0],
    }
    file = hdf5_file(tmp_path, **values)
    train, val = (formats.open_stacks(file, split=split)[0].images for split in ("train", "val"))
    torch.testing.assert_close(train, images / 255)
    torch.testing.assert_close(val[0, 0], (images[0, 0] + 0.25 * (images[0, 0] < 255)) / 255)
    hdf5_file(tmp_path, stack_train=PIXELS[:, :7])
    assert formats.open_stacks(file, focus_m=[0.5, 0.6, 0.7, 0.8, 1, 2, 7])[0].images.shape[1] == 7
    for call, sentence in (
        (lambda: formats.open_stacks(tmp_path, "images", split="train"), "format images has no option 'split'"),
        (lambda: FocalStacks("x", "images", lambda i: i, ()), "found none"),
        (lambda: FocalStacks("x", "images", lambda i: i, ("a", "b"), scenes=("c",)), "found 1 scene of 2 stacks"),
    ):
        with pytest.raises(ValueError, match=sentence):
            call()
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"h5py, which is not installed: pip install h5py$"):
        formats.open_stacks(file)


# --------------------------------------------------------------------------------------------------------- real pieces


@pytest.mark.data
@real
def test_real_focus_sweeps() -> None:
    room = formats.open_stacks(Path(ROOT) / "focus_stack_room")
    assert room.format == "images" and room[0].images.shape == (1, 6, 3, 768, 1024)
    heatsink = formats.open_stacks(Path(ROOT) / "focus_stack_heatsink" / "assets" / "9")
    order = [int("".join(c for c in file.stem if c.isdigit())) for file in heatsink.load.args[0]]
    assert order == list(range(1, 50))
    # A sweep moves the focus steadily: the next picture is sharp in nearly the same places. Measured 0.97 for the order
    # of the numbers, 0.91 for the order of the letters.
    images = heatsink[0].images[0, :, 1].float()
    sharp = torch.stack([torch.nn.functional.avg_pool2d(x.diff(dim=-1).abs()[None], 60)[0].flatten() for x in images])
    assert float(torch.corrcoef(sharp).diagonal(1).mean()) > 0.95
