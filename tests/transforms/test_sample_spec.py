"""Views of a sample: the same numbers whatever the layout, the unit and the key, and a sentence for what cannot be."""

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import BrownConradyModel, KannalaBrandtK3, PinholeModel
from torch.autograd import forward_ad
from torch.utils.data import default_collate

from dhtorch.geometry import se3
from dhtorch.transforms import SampleError, SampleSpec, poses, sample_spec
from dhtorch.transforms.sample_access import to_tensor

H, W = 6, 8
K = [20.0, 22.0, 3.6, 2.4]  # fx fy cx cy
RANDOM = np.random.default_rng
LEVEL = RANDOM(0).integers(0, 3, (H, W))
UNITS = RANDOM(0).integers(1, 250, (H, W))


def picture(seed=0, shape=(H, W, 3)):
    return RANDOM(seed).integers(0, 256, shape, dtype=np.uint8)


def pictures(n):
    return np.stack([picture(k) for k in range(n)])


def metres(seed=0, shape=(H, W)):
    return RANDOM(seed).uniform(0.5, 3, shape).astype(np.float32)


def matrix(fx, fy, cx, cy):
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def four(T=1):
    """A 4×4 matrix, of each of T frames."""
    out = np.tile(np.eye(4, dtype=np.float32), (T, 1, 1))
    out[:, :3, :3] = matrix(*K)
    return out


def sample(**changes):
    return {"image": picture(), "depth": metres(), "intrinsics": matrix(*K), **changes}


def read(given, **options):
    batched, dtype = options.pop("batched", False), options.pop("dtype", torch.float32)
    return SampleSpec(**{"depth_unit": "m", **options}).read(given, batched=batched, dtype=dtype)


def numbers(camera):
    return torch.cat((camera.f, camera.c), -1)


def spoiled(x, place, value):
    out = np.array(x)
    out[place] = value
    return out


def frozen(x):
    x.setflags(write=False)
    return x


class Wrapped(torch.Tensor):
    """A class of tensors, as those of torchvision."""


def kornia_camera(n=1, kind="pinhole"):
    K4 = torch.from_numpy(four(n))
    K4[:, 0, 0] += torch.arange(n)
    if kind == "pinhole":
        return PinholeCamera(K4, torch.eye(4).repeat(n, 1, 1), *(torch.full((n,), float(side)) for side in (H, W)))
    rows = torch.cat((K4[:, [0, 1], [0, 1]], K4[:, [0, 1], [2, 2]]), -1)
    if kind == "model":
        return PinholeModel(ImageSize(H, W), rows[0] if n == 1 else rows)
    return BrownConradyModel(ImageSize(H, W), torch.cat((rows, torch.full((n, 8), 0.01)), -1))


# ----------------------------------------------------------------------------------------------------- the same views

IMAGE, DEPTH = picture(), metres()
NESTED = {"a": {"b": {"image": IMAGE}, "depth": DEPTH}, "a.K": matrix(*K)}

#: Forms of one sample: (changed values, options).
SAME = [
    *(({"image": x}, {}) for x in (IMAGE.transpose(2, 0, 1), IMAGE[None], IMAGE.transpose(2, 0, 1)[None])),
    *(({"image": x}, {}) for x in (frozen(IMAGE.copy()), IMAGE[::-1].copy()[::-1], np.asfortranarray(IMAGE))),
    *(({"image": torch.from_numpy(IMAGE)}, {}), ({"image": torch.from_numpy(IMAGE).as_subclass(Wrapped)}, {})),
    *(({}, {"layout": "hwc"}), ({"image": IMAGE.transpose(2, 0, 1)}, {"layout": "chw"})),
    *(({"depth": x}, {}) for x in (DEPTH[None], DEPTH[..., None], DEPTH[None, None], DEPTH[None, ..., None])),
    *(({"depth": x}, {}) for x in (DEPTH.astype(">f4"), DEPTH.astype(float), DEPTH.tolist(), torch.tensor(DEPTH))),
    *(({"depth": DEPTH * n}, {"depth_unit": unit}) for unit, n in (("mm", 1000), (0.001, 1000), (0.25, 4), (2, 0.5))),
    *(({"intrinsics": x}, {}) for x in (matrix(*K).ravel(), K, np.array(K), torch.tensor(K), matrix(*K).tolist())),
    *(({"intrinsics": x}, {}) for x in (four()[0], four(), torch.from_numpy(four()[0]), np.array([K]))),
    ({"intrinsics": four()[0] + np.diag([0, 0, 0, 1]).astype(np.float32)}, {}),  # another last row of a 4×4
    *(({"intrinsics": "unused"}, {"intrinsics": x}) for x in (K, np.array(K), matrix(*K).tolist())),
    *(({"intrinsics": kornia_camera(kind=kind)}, {}) for kind in ("pinhole", "model", "lens")),
    *(({}, {"intrinsics": kornia_camera(kind=kind)}) for kind in ("pinhole", "model", "lens")),
    *((NESTED, {"image": i, "depth": "a.depth", "intrinsics": "a.K"}) for i in ("a.b.image", "a/b/image", "a/b.image")),
    ({"a": NESTED["a"], "a.image": IMAGE}, {"image": "a.image"}),
    (
        {"intrinsics": [2 * K[0], 3 * K[1], 2 * (K[2] + 0.5) - 0.5, 3 * (K[3] + 0.5) - 0.5]},
        {"intrinsics_hw": (3 * H, 2 * W)},
    ),
]


@pytest.mark.parametrize("row", range(len(SAME)))
def test_the_same_views_whatever_the_form(row):
    changes, options = SAME[row]
    found = read(sample(**changes), **options)
    frame = found.reference
    assert frame.image.dtype == torch.uint8 and type(frame.image) is torch.Tensor and not found.bad
    assert torch.equal(frame.image, torch.from_numpy(IMAGE).permute(2, 0, 1)[None])
    assert frame.depth.dtype == torch.float32 and frame.conf is None and frame.sparse is None
    np.testing.assert_allclose(frame.depth[0].numpy(), DEPTH, rtol=3e-7)
    torch.testing.assert_close(numbers(frame.camera), torch.tensor([K]), rtol=3e-7, atol=0)
    assert (frame.camera.distortion is None) != ("BrownConrady" in repr((changes.get("intrinsics"), options)))
    assert found.other is None and found.paired.tolist() == [False] and found.has_returns.tolist() == [True]


def test_grey_images_and_pil():
    pil = pytest.importorskip("PIL.Image")
    assert torch.equal(read(sample(image=pil.fromarray(IMAGE))).reference.image, read(sample()).reference.image)
    grey = picture(shape=(H, W, 1))
    for given in (grey, grey.transpose(2, 0, 1), grey[None]):
        assert torch.equal(read(sample(image=given)).reference.image[0, 0], torch.from_numpy(grey[..., 0]))
    for shape in ((3, 5, 3), (1, 5, 3), (3, 5, 1)):  # an axis that could be either is stated
        for layout, (h, w), order in (("hwc", shape[:2], (2, 0, 1)), ("chw", shape[1:], (0, 1, 2))):
            given = sample(image=picture(shape=shape), depth=np.ones((h, w), np.float32), intrinsics=[4, 4, w / 2, 1])
            found = read(given, layout=layout).reference.image[0]
            assert torch.equal(found, torch.from_numpy(given["image"]).permute(*order))


# ------------------------------------------------------------------------------------------------- what cannot be read


def batch(**changes):
    return {**default_collate([sample(), sample()]), **changes}


T3, POSED = {"image": pictures(3)}, {"pose": "T", "pose_kind": "1_from_0", "other_image": "image"}

#: (changed values, options, sentence).
REFUSED = [
    *(
        ({"image": picture(shape=shape)}, {}, r"image: found shape \(\d, 5, \d\), expected one axis.*state layout")
        for shape in ((3, 5, 3), (1, 5, 3), (3, 5, 1))
    ),
    ({}, {"layout": "chw"}, r"image: found shape \(6, 8, 3\), expected layout chw with 1 or 3 channels"),
    ({"image": picture(shape=(3, H, W))}, {"layout": "hwc"}, r"found shape \(3, 6, 8\), expected layout hwc"),
    *(({"image": picture(shape=(H, W, n))}, {}, "expected one axis of 1 or 3 channels") for n in (2, 4)),
    ({"image": picture(shape=(H, W))}, {}, r"image: found shape \(6, 8\), expected \(C, H, W\) or \(H, W, C\)"),
    ({"image": picture(shape=(2, 1, H, W, 3))}, {}, r"found shape \(2, 1, 6, 8, 3\)"),
    *(
        ({"image": IMAGE.astype(t)}, {}, rf"image: found {t}, expected uint8, or floating point in \[0, 1\]")
        for t in ("int32", "int64", "uint16", "int8", "bool")
    ),
    *(
        ({"depth": UNITS.astype(t)}, {}, r"depth: found u?int\d+, expected floating point, m; is the unit mm")
        for t in ("uint8", "uint16", ">u2", "int16", "uint32", "int32", "int64")
    ),
    *(
        ({"depth": x}, {}, "depth: found .*, expected an array of numbers")
        for x in ("depth.png", None, np.array(["a"]), np.array([1j]), object())
    ),
    *(
        ({**T3, "depth": np.ones(shape, np.float32)}, {}, "depth: found shape .* with or without 3 in front")
        for shape in ((2, H, W), (H, W, 2), (H,), (1, 1, 1, H, W), (0, W))
    ),
    ({"conf": LEVEL[:3]}, {"confidence": "conf"}, "conf: found 3x8, expected 6x8 as depth"),
    (
        {"z": 1, "a": {"depth": DEPTH, "b": {"x": 1}}},
        {"depth": "a.depth.more"},
        r"^a\.depth\.more: found no such key, expected one of a\.b\.x, a\.depth, depth, image, intrinsics, z$",
    ),
    *(
        ({}, {"other_image": "image", name: "nowhere"}, "^nowhere: found no such key")
        for name in ("intrinsics", "distortion", "depth_intrinsics", "confidence", "other_intrinsics", "other_image")
    ),
    *(
        (changes, options, f"intrinsics: found {n} numbers, expected 3x3, 4x4, fx fy cx cy or a camera")
        for n in (3, 5, 6, 16)
        for changes, options in (({"intrinsics": np.ones(n)}, {}), ({}, {"intrinsics": [1.0] * n}))
    ),
    ({"intrinsics": np.ones((2, 2, 4))}, {}, r"intrinsics: found shape \(2, 2, 4\), expected one row of numbers"),
    ({}, {"intrinsics": 5.0}, r"numbers: found shape \(\), expected one row"),
    ({"K": np.ones((2, 4))}, {"intrinsics": "K"}, r"K: found shape \(2, 4\)"),
    *(
        ({**T3, "depth": np.stack([DEPTH] * 3), "intrinsics": kornia_camera(2, kind)}, {}, "shape .2, 2., expected one")
        for kind in ("pinhole", "model", "lens")
    ),
    ({"intrinsics": kornia_camera(kind="lens")}, {"distortion": [0.1, 0, 0, 0]}, "beside the option distortion"),
    (
        {"intrinsics": KannalaBrandtK3(ImageSize(H, W), torch.rand(8))},
        {},
        "intrinsics: Camera.from_kornia: found KannalaBrandtK3, expected a PinholeCamera",
    ),
    *(
        ({"image": pictures(4)}, {key: at}, f"image: found 4 frames along time, expected one at {at}")
        for key in ("at", "other_at")
        for at in (4, -5)
    ),
    ({"right": pictures(3)}, {"other_image": "right", "other_at": 3}, "right: found 3 frames along time, expected"),
    ({"right": IMAGE[..., :2]}, {"other_image": "right"}, "right: found shape"),
    *(({**T3, "image_is_pad": [False] * n}, {}, f"image_is_pad: found {n} values, expected 3") for n in (2, 4)),
    *(
        (batch(**{key: x}), {"batched": True}, f"{key}: found shape .*, expected 2 samples in front")
        for key, x in (
            ("depth", torch.ones(1, H, W)),
            ("depth", torch.ones(4, H, W)),
            ("intrinsics", torch.tensor(5.0)),
        )
    ),
    *(
        (
            {"image": picture(shape=(100, 100, 3)), "depth": np.ones(hw, np.float32), "intrinsics": [90, 90, 49, 49]},
            {},
            s,
        )
        for hw, s in (
            ((111, 100), "depth: found 111x100 .height x width., which is no scaled image of 100x100; .*depth_intrin"),
            ((89, 100), "depth: found 89x100"),
            ((10, 30), "depth: found 10x30"),
        )
    ),
    (
        {"image": picture(shape=(10, 40, 3)), "depth": np.ones((20, 5), np.float32)},
        {"layout": "hwc"},
        r"orientation differs: depth 5x20 \(portrait\) beside pictures 40x10 \(landscape\)",
    ),
    *(
        ({"T": np.ones(shape)}, POSED, r"T: found shape .*, expected 3x4 or 4x4, with or without 1 in front")
        for shape in ((5, 4), (4, 3), (4,), (3, 4, 4), (2, 4))
    ),
    *(
        ({"T": np.eye(4), "cov": np.ones(shape)}, {**POSED, "pose_cov": "cov"}, "cov: found shape .*, expected 6x6")
        for shape in ((4, 4), (4, 6))
    ),
    ({"T": kornia_camera(kind="model")}, POSED, "T: found PinholeModel, expected a pose or a PinholeCamera"),
]


@pytest.mark.parametrize("row", range(len(REFUSED)))
def test_what_cannot_be_read_is_named(row):
    changes, options, words = REFUSED[row]
    with pytest.raises(SampleError, match=words):
        read(sample(**changes), **options)


FOCAL = "intrinsics: found focal length {}, expected a positive number of px"
UNIT = "depth: the median return is {} m with the unit '{}', expected at {}"
PARTS = "(min_focal=0.2 of its longer side); are they normalised, or of another size?"
SMALL = [0.9, 1.2, 0.5, 0.5]
RIGHT = {"other_image": "right", "other_intrinsics": "K_right"}


def constant(value):
    return spoiled(np.full((H, W), value, np.float32), 0, 0)  # no returns do not count


#: (changed values, options, complaint); "" = none.
COMPLAINTS = [
    *(
        (
            {"image": spoiled(IMAGE / 255, (3, 4, 1), x)},
            {},
            f"image: found the value {x:.4g}, expected [0, 1] (of [0, 255]: image / 255), pixels before any normalisation",
        )
        for x in (-0.0011, 1.0011, np.nan)
    ),
    *(({"image": spoiled(IMAGE / 255, (3, 4, 1), x)}, {}, "") for x in (-0.0009, 1.0009)),
    ({"image": spoiled(np.full((H, W, 3), -1.0), (0, 0), 2.0)}, {}, "image: found the value 2"),
    *(({"depth": constant(x)}, {}, "") for x in (100, 0.01, 0.0)),
    *(({"depth": constant(x)}, {}, UNIT.format(f"{x:g}", "m", "")[:45]) for x in (100.1, 0.0099)),
    (
        {"depth": DEPTH * 0 + 1500},
        {},
        UNIT.format(1500, "m", "most 100 m; are the numbers millimetres?"),
    ),
    (
        {"depth": DEPTH * 0 + 2},
        {"depth_unit": "mm"},
        UNIT.format(0.002, "mm", "least 0.01 m; are the numbers metres?"),
    ),
    ({"depth": DEPTH * 100}, {"max_depth": 400.0}, ""),
    ({}, {"max_depth": 0.4}, "depth: the median return"),
    ({}, {"min_depth": 4.0}, "depth: the median return"),
    ({"depth": DEPTH / 1e3}, {"min_depth": 0.0}, ""),
    *(
        ({"conf": x}, {"confidence": "conf"}, f"conf: found the value {n}, expected 0 low, 1 medium, 2 high")
        for x, n in ((LEVEL + 1, 3), (np.where(LEVEL == 1, 0.5, LEVEL), 2), (spoiled(LEVEL * 0.0, (4, 2), 1.5), 1.5))
    ),
    *(({"intrinsics": [20, 20, *c]}, {}, "") for c in ([-7.0, 2.0], [3.5, 40.0], [3.5, 2.5])),
    *(
        ({"intrinsics": [20, 20, *c]}, {}, "intrinsics: found a principal point of")
        for c in ([np.nan, 2.5], [3.5, np.inf])
    ),
    *(
        ({"intrinsics": [*f, 3.5, 2.5]}, {}, FOCAL.format(x))
        for f, x in (([0.0, 20.0], "0"), ([20.0, -3.0], "-3"), ([-1.0, -2.0], "-2"), ([np.nan, 20.0], "nan"))
    ),
    ({"intrinsics": [1e-3, 1e-3, 3.5, 2.5]}, {"min_focal": 0.0}, ""),
    (
        {"intrinsics": SMALL},
        {"min_focal": 0.2},
        f"intrinsics: focal length 0.9 px in an image of 6x8, expected at least 1.6 {PARTS}",
    ),
    ({"image": picture(shape=(6, 60, 3)), "depth": metres(shape=(6, 60)), "intrinsics": SMALL}, {}, "intrinsics: focal"),
    (
        {"image": picture(shape=(6, 60, 3)), "depth": metres(shape=(6, 60)), "intrinsics": SMALL},
        {"min_focal": 0.0},
        "",
    ),
    (
        {"intrinsics": matrix(*K).T.copy()},
        {},
        "intrinsics: the last row is off 0 0 1 by 3.6; is the matrix transposed?",
    ),
    ({"intrinsics": matrix(*K) + np.float32(1e-6)}, {}, ""),
    ({"right": picture(9) / 100}, {"other_image": "right"}, "right: found the value"),
    (
        {"right": picture(1), "K_right": matrix(30, 0.1, 3, 2)},
        RIGHT,
        "K_right: focal length 0.1 px in an image of 6x8, expected at least 0.4",
    ),
    # Only frames that are read are judged.
    *(
        ({"image": spoiled(pictures(3) / 255, (k, 0, 0, 0), 7)}, {"at": 2, "other_at": 1}, "image: found" if k else "")
        for k in range(3)
    ),
    *(({"T": x}, POSED, words) for x, words in (
        (np.diag([1.0, 1, -1, 1]), "T: the determinant is -1, a reflection: are the axes left-handed?"),
        (2 * np.eye(4), "T: found no rotation (determinant 8), expected one in 3x3"),
        (np.eye(4) + spoiled(np.zeros((4, 4)), (3, 0), 0.5), "T: the last row is off 0 0 0 1 by 0.5; is the matrix tra"),
        (np.full((4, 4), np.nan), ""),
        (np.eye(4)[:3], ""),
    )),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(COMPLAINTS)))
def test_values_that_contradict_the_options_are_named(row):
    changes, options, words = COMPLAINTS[row]
    found = read(sample(**changes), **options)
    assert bool(found.bad) == bool(words) and found.complaint().startswith(words)
    assert found.reference.conf is None or found.reference.conf.max() <= 2


REQUIRED = r"pose: found .*expected a key, or with pose_kind='1_from_0' 3x4 or 4x4 finite"
SIGMAS = "pose_cov is .*expected a key, or two standard deviations of at least 0"

#: Options that cannot be, and the sentence.
OPTIONS = [
    *(({"depth_unit": x}, r"depth_unit is .*, expected one of \['m', 'mm'\], metres per unit, or auto") for x in ("cm", "")),
    *(({"depth_unit": x}, "depth_unit is .*, expected one of") for x in (0, -0.001, None)),
    ({"layout": "bgr"}, "layout is 'bgr', expected hwc, chw or None"),
    ({"other_image": "right", "other_at": [0]}, "other_at is a list, expected one number where other_image"),
    *(({name: x}, f"found {name} without pose") for name, x in (("pose_cov", "c"), ("other_pose", "T"), ("refine", True))),
    ({"pose": "T", "pose_kind": "cam"}, "pose_kind is 'cam', expected world_from_cam or 1_from_0"),
    ({"pose": "T", "pose_axes": "xyz"}, "pose_axes is 'xyz', expected cv or gl"),
    *(({"pose": "T", "pose_unit": x}, "pose_unit is .*, expected one of") for x in ("cm", 0, -1.0, float("inf"))),
    ({"pose": "T", "other_image": "right"}, "found pose and other_image, expected other_pose"),
    *(({"pose": x, "pose_kind": "1_from_0"}, REQUIRED) for x in (np.eye(3).tolist(), [["a"]], [[1, 2], [3]])),
    ({"pose": np.full((4, 4), np.nan).tolist(), "pose_kind": "1_from_0"}, REQUIRED),
    ({"pose": np.eye(4).tolist()}, REQUIRED),
    *(
        ({"pose": "T", "pose_cov": x}, SIGMAS)
        for x in ([0.1], [0.1, 0.2, 0.3], [-0.1, 0.2], [0.1, float("inf")], [float("nan"), 0.1])
    ),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(OPTIONS)))
def test_options_that_cannot_be_are_refused(row):
    options, words = OPTIONS[row]
    with pytest.raises(ValueError, match=words):
        SampleSpec(**{"depth_unit": "m", **options})
    for accepted in ({}, {"other_at": [0, 1]}, {"pose": "T", "pose_cov": [0, 0.02], "pose_unit": 0.5}):
        SampleSpec(depth_unit="m", **accepted)
    assert poses.parse_pose_sigmas(None) is None and poses.parse_pose_sigmas([0, 0.02], "pose_sigma") == (0.0, 0.02)
    with pytest.raises(ValueError, match="pose_sigma is"):
        poses.parse_pose_sigmas([0.1], "pose_sigma")


# ---------------------------------------------------------------------------------------------------------------- depth


def test_a_sweep_is_marked_as_sparse():
    assert read(sample(), sparse=True).reference.sparse.tolist() == [True]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", ">u2", "int16", "uint32", "int32", "int64"])
def test_whole_numbers_of_any_width_are_read(dtype):
    high = UNITS + (0 if dtype == "uint8" else 32000)  # above 32767 a signed word would be negative
    for units, unit in ((UNITS, "mm"), (high if "u" in dtype else UNITS, 0.001)):
        given = frozen(units.astype(dtype))
        before = given.copy()
        found = read(sample(depth=given), depth_unit=unit).reference.depth
        np.testing.assert_allclose(found[0], units / 1000, rtol=3e-7)
        assert found.dtype == torch.float32 and np.array_equal(given, before), "a shared array is not written to"
    if dtype in ("uint16", "int16", "int32"):  # whatever type tensors have by default
        torch.set_default_dtype(torch.float64)
        try:
            found = SampleSpec(depth_unit="mm").metres([torch.from_numpy(np.full((H, W), 500, dtype))])
        finally:
            torch.set_default_dtype(torch.float32)
        assert found.dtype == torch.float32 and (found == 0.5).all()
    top = np.array([0, np.iinfo(dtype).max], dtype)
    signed = {"uint16": torch.int32, "uint32": torch.int64, "uint8": torch.uint8}
    for given in [top] if dtype == ">u2" else [top, torch.from_numpy(top)]:
        assert to_tensor(given, "x").tolist() == top.tolist()
        assert dtype == ">u2" or to_tensor(given, "x").dtype == signed.get(dtype, getattr(torch, top.dtype.name))
        assert to_tensor(given, "x", signed=False).dtype == getattr(torch, top.dtype.name)


def test_what_is_no_return_is_zero():
    found = SampleSpec(depth_unit="mm").metres([torch.tensor([[torch.inf, -torch.inf, torch.nan, 1000.0]])])
    assert found.tolist() == [[[0, 0, 0, 1]]]
    depth = spoiled(DEPTH, (0, slice(4)), [np.nan, np.inf, -np.inf, -1])
    for unit, scale in (("m", 1), ("mm", 1000), (0.01, 100)):
        given = depth * np.float32(scale)
        before = given.copy()
        found = read(sample(depth=given), depth_unit=unit).reference.depth[0].numpy()
        np.testing.assert_allclose(found, spoiled(DEPTH, (0, slice(4)), 0), rtol=1e-6)
        assert np.array_equal(given, before, equal_nan=True), "the sample is left as it was"
        leaf = torch.from_numpy(spoiled(DEPTH, (0, slice(2)), [np.nan, -1]) * scale).requires_grad_()
        read(sample(depth=leaf), depth_unit=unit).reference.depth.sum().backward()
        wanted = torch.from_numpy(spoiled(np.full((H, W), 1 / scale, np.float32), (0, slice(2)), 0))
        torch.testing.assert_close(leaf.grad, wanted)
    for kind in (np.int32, np.int16):
        for unit in ("mm", 0.001):
            whole = spoiled(np.full((H, W), -7, kind), (1, 1), 500)
            found = read(sample(depth=whole), depth_unit=unit).reference.depth
            assert found.sum() == found[0, 1, 1] == 0.5 and whole[0, 0] == -7 and whole[1, 1] == 500


@pytest.mark.parametrize(
    ("limits", "wanted"),
    [
        ((0.5, 2.0), [0, 0.5001, 1.0, 2.0, 0, 0, 0, 0]),
        ((0.5, np.inf), [0, 0.5001, 1, 2, 2.0001, 0, 3, 0]),
        ((0.0, 2.0), [0.5, 0.5001, 1, 2, 0, 0, 0, 0.1]),
    ],
)
def test_the_depth_range_is_open_below_and_closed_above(limits, wanted):
    depth = spoiled(np.full((H, W), 1.5, np.float32), 0, [0.5, 0.5001, 1.0, 2.0, 2.0001, 0.0, 3.0, 0.1])
    for unit, scale in (("m", 1), ("mm", 1000)):
        found = read(sample(depth=depth * scale), depth_unit=unit, depth_range=limits).reference.depth
        assert np.allclose(found[0, 0], wanted) and (found[0, 1:] == 1.5).all()


def test_depth_and_confidence_along_time():
    images, stack = pictures(3), np.stack([metres(k) for k in range(3)])
    for x in (stack, stack[:, None], stack[..., None]):
        found = read(sample(image=images, depth=x), other_at=1)
        assert np.array_equal(found.reference.depth[0], stack[2]) and np.array_equal(found.other.depth[0], stack[1])
    shared = read(sample(image=images), other_at=1)
    assert np.array_equal(shared.reference.depth[0], DEPTH) and not shared.other.depth.any(), "the reference view's"
    thin, depths = picture(shape=(3, 5, 1, 3)), metres(shape=(3, 5, 1))  # one pixel wide: no channels
    found = read(sample(image=thin, depth=depths, intrinsics=[4, 4, 0, 2]), layout="hwc", other_at=1)
    assert np.array_equal(found.reference.depth[0], depths[2]) and np.array_equal(found.other.depth[0], depths[1])
    for given in (LEVEL.astype(np.uint8), LEVEL.astype(np.float32), LEVEL[None], LEVEL[..., None].astype(np.int64)):
        conf = read(sample(conf=given), confidence="conf").reference.conf
        assert conf.dtype == torch.uint8 and np.array_equal(conf[0], LEVEL)
    levels = sample(image=images[:2], conf=np.stack([LEVEL, 2 - LEVEL]))
    assert np.array_equal(read(levels, confidence="conf", at=0, other_at=1).reference.conf[0], LEVEL)


def test_the_median_and_the_returns_are_those_of_the_whole_map():
    wide = sample(image=picture(shape=(64, 96, 3)), intrinsics=[50, 50, 47.5, 31.5])
    for rows, value, bad in ((30, 1e3, False), (34, 1e3, True), (30, 1e-3, False), (34, 1e-3, True)):
        for part in (slice(0, rows), slice(64 - rows, 64)):  # one value alone would be a far constant
            wide["depth"] = spoiled(np.ones((64, 96), np.float32), part, np.linspace(value, 1.01 * value, 96))
            assert bool(read(wide).bad) == bad, (part, value)
    for place, seen in ((None, False), ((0, 1), True), ((33, 47), True), ((63, 95), True)):  # where no probe is
        wide["depth"] = np.zeros((64, 96), np.float32)
        if seen:
            wide["depth"][place] = 1.5
        assert bool(read(wide).has_returns) == seen


def test_numbers_that_are_looked_at_are_judged_as_by_operations(monkeypatch):
    near = [limit * (1 + step * 2**-23) for limit in (0.01, 100.0) for step in (-100, -2, -1, 0, 1, 2, 100)]
    given = [sample(depth=np.full((H, W), x, np.float32)) for x in (*near, 0.0, np.nan, 1.0, 1e3)]
    given += [
        sample(intrinsics=[20, 0.05 * W * (1 + step * 2**-23), 3.5, 2.5]) for step in (-100, -2, -1, 0, 1, 2, 100)
    ]
    looked = [bool(read(x).bad) for x in given]
    monkeypatch.setattr(sample_spec, "_is_cheap_to_read", lambda _: False)
    assert [bool(read(x).bad) for x in given] == looked and 0 < sum(looked) < len(looked)


# -------------------------------------------------------------------------------------------------------------- cameras


def test_the_same_numbers_are_read_once_and_others_never_taken_for_them():
    views = SampleSpec(depth_unit="m")
    given = [matrix(*K), matrix(21, 22, 3.5, 2.5), matrix(*K).astype(np.float64), torch.tensor(matrix(*K)), [*K]]
    given += [torch.tensor(K, dtype=torch.bfloat16), matrix(*K)[::-1], np.array(K, np.int64)]
    for value in (*given, *given):
        found, alone = (spec.read(sample(intrinsics=value)) for spec in (views, SampleSpec(depth_unit="m")))
        assert torch.equal(numbers(found.reference.camera), numbers(alone.reference.camera))
        assert torch.equal(found.bad, alone.bad)
    assert views.read(sample()).reference.camera is views.read(sample()).reference.camera
    for k in range(200):  # one for each frame: never more than some are kept
        views.read(sample(intrinsics=matrix(20 + k / 100, *K[1:])))
    assert len(views._cameras) <= 64 and SampleSpec(depth_unit="m") == views
    views = SampleSpec(depth_unit="m")
    with torch.inference_mode():
        views.read(sample())
    assert not views.read(sample()).reference.camera.f.is_inference(), "a graph could not go through it"


@pytest.mark.parametrize("T", [3, 4])
def test_numbers_along_time_are_those_of_the_frame(T):
    """Also four rows of four numbers: of four frames, unless they end in 0 0 0 1."""
    rows = np.array([[20.0 + k, 21.0 + k, 3.5, 2.5] for k in range(T)], np.float32)
    bends = np.array([[0.01 * k, 0.0, 0.0, 0.0] for k in range(T)])
    options = {"distortion": "bend", "depth_intrinsics": "intrinsics", "at": 1, "other_at": -1}
    for form in (rows, np.stack([matrix(*row) for row in rows])):
        found = read(sample(image=pictures(T), intrinsics=form, bend=bends), **options)
        for camera, k in ((found.reference.camera, 1), (found.reference.depth_camera, 1), (found.other.camera, T - 1)):
            assert torch.equal(numbers(camera), torch.from_numpy(rows[[k]]))
        assert torch.allclose(found.reference.camera.distortion, torch.tensor(bends[[1]]).float())
        assert torch.allclose(found.other.camera.distortion, torch.tensor(bends[[T - 1]]).float())
    for once in (np.array([K]), four()[0], four(T)):
        found = read(sample(image=pictures(T), intrinsics=once), at=2, other_at=1)
        assert torch.equal(numbers(found.reference.camera), torch.tensor([K])), "given once it holds for all"
        assert torch.equal(numbers(found.other.camera), torch.tensor([K]))


def test_gradients_and_tangents_pass_through_the_intrinsics():
    leaf = torch.tensor(matrix(*K), requires_grad=True)
    read(sample(intrinsics=leaf)).reference.camera.f.sum().backward()
    assert leaf.grad.sum() == 2
    with forward_ad.dual_level():
        tangent = forward_ad.make_dual(torch.tensor(matrix(*K)), torch.ones(3, 3))
        assert forward_ad.unpack_dual(read(sample(intrinsics=tangent)).reference.camera.f).tangent is not None


@pytest.mark.parametrize("kind", ["pinhole", "model", "lens"])
def test_several_cameras_of_kornia_are_of_samples_or_of_frames(kind):
    several = sample(image=pictures(3), depth=np.stack([DEPTH] * 3), intrinsics=kornia_camera(3, kind))
    assert read(several, at=2).reference.camera.f[0, 0] == 22
    assert read(several, batched=True).reference.camera.f[:, 0].tolist() == [20, 21, 22]
    shared = read(several, batched=True, intrinsics=kornia_camera(kind=kind))
    assert shared.reference.camera.f[:, 0].tolist() == [20] * 3


def test_the_pose_of_a_pinhole_camera_is_that_of_its_extrinsics():
    T = [se3.to_matrix(se3.exp(torch.rand(1, 6, generator=torch.Generator().manual_seed(k)))) for k in (0, 1)]
    K4, sizes = kornia_camera().intrinsics, (torch.tensor([float(H)]), torch.tensor([float(W)]))
    cameras = {n: PinholeCamera(K4, E, *sizes) for n, E in zip(("camera", "camera_before"), T, strict=True)}
    options = {"intrinsics": "camera", "other_image": "before", "pose": "camera", "other_pose": "camera_before"}
    found = read(sample(before=picture(1), **cameras), **options)
    motion = se3.to_matrix(found.pose_prior.T_1_from_0)
    torch.testing.assert_close(motion, T[1] @ torch.linalg.inv(T[0]), rtol=1e-4, atol=1e-5)


def test_poses_and_covariances_are_of_the_sample_or_of_the_frame():
    turn = torch.Generator().manual_seed(0)
    T = se3.to_matrix(se3.exp(0.3 * torch.rand(5, 6, generator=turn, dtype=torch.float64)))
    cov = torch.rand(5, 6, 6, generator=turn, dtype=torch.float64)
    cov = cov @ cov.mT
    options = {"pose": "T", "pose_kind": "1_from_0", "pose_cov": "cov", "other_at": 3, "dtype": torch.float64}
    for pose, covariance in ((T, cov), (T[3:4], cov[3:4]), (T[3], cov[3]), (T[3, :3], cov[3])):
        found = read(sample(image=pictures(5), T=pose, cov=covariance), **options).pose_prior
        torch.testing.assert_close(se3.to_matrix(found.T_1_from_0)[0], T[3])
        torch.testing.assert_close(found.cov[0], cov[3])
    constant = read(sample(right=IMAGE), other_image="right", pose=T[2].tolist(), pose_kind="1_from_0", pose_unit="mm")
    torch.testing.assert_close(constant.pose_prior.T_1_from_0.t[0], T[2, :3, 3].float() / 1000)


def test_a_depth_map_has_the_field_of_the_image_or_a_camera_of_its_own():
    given = sample(image=picture(shape=(100, 100, 3)), intrinsics=[90, 90, 49.5, 49.5])
    for hw, fits in (((50, 50), True), ((109, 100), True), ((91, 100), True), ((89, 100), False), ((10, 30), False)):
        given["depth"] = np.ones(hw, np.float32)
        assert not fits or read(given).reference.depth_camera is None
        own = read(given, depth_intrinsics=[5, 6, 7, 8]).reference.depth_camera
        assert torch.equal(numbers(own), torch.tensor([[5.0, 6, 7, 8]])) and own.distortion is None
    wide = sample(image=picture(shape=(10, 40, 3)), intrinsics=[9, 9, 19.5, 4.5], depth=np.ones((5, 20), np.float32))
    assert read(wide).reference.depth_camera is None


# ------------------------------------------------------------------------------------------------------- the other view


@pytest.mark.parametrize(
    ("at", "other_at", "reference", "other"),
    [(-1, 0, 3, 0), (2, 1, 2, 1), (0, -1, 0, 3), (-4, 3, 0, 3), (1, -3, 1, None), (3, (2, 0), 3, (2, 0)), (3, [1], 3, (1,)),
     (3, [3, 3], 3, None), (3, (0, 3), 3, (0, 3))],
)  # fmt: skip
def test_frames_along_time_are_picked_by_place(at, other_at, reference, other):
    images, depths = pictures(4), np.stack([metres(k) for k in range(4)])
    found = read(sample(image=images, depth=depths), at=at, other_at=other_at)
    assert np.array_equal(found.reference.image[0].permute(1, 2, 0), images[reference])
    assert found.paired.tolist() == [other is not None], "the same place twice is one view"
    if other is None:
        assert found.other is None
        return
    places = [other] if isinstance(other, int) else other
    assert found.other.image.shape[:-3] == ((1,) if isinstance(other, int) else (len(other), 1))
    for image, depth, k in zip(
        found.other.image.view(-1, 3, H, W), found.other.depth.view(-1, H, W), places, strict=True
    ):
        assert np.array_equal(image.permute(1, 2, 0), images[k]) and np.array_equal(depth, depths[k])


#: (marks of padding, options, whether there is a view of its own).
PADDED = [
    ({"image_is_pad": [True, False, False]}, {}, False),
    ({"image_is_pad": [False, True, True]}, {}, True),
    ({"image_is_pad": [True, True, False]}, {"other_at": (0, 1)}, False),
    ({"image_is_pad": [True, False, True]}, {"other_at": (0, 1)}, True),
    ({"image_is_pad": [True, False, False]}, {"other_at": (0, 2)}, False),  # no view beside itself
    ({"right_is_pad": [True], "image_is_pad": [False] * 3}, {"other_image": "right"}, False),
    ({"right_is_pad": [False], "image_is_pad": [True] * 3}, {"other_image": "right"}, True),
    ({"right_is_pad": [False]}, {"other_image": "right", "at": 0, "other_at": 0}, True),
]


@pytest.mark.parametrize("row", range(len(PADDED)))
@pytest.mark.parametrize("form", [np.array, torch.tensor, list])
def test_a_frame_that_pads_is_no_view_of_its_own(row, form):
    marks, options, paired = PADDED[row]
    given = sample(image=pictures(3), right=picture(5), **{k: form(x) for k, x in marks.items()})
    found = read(given, **options)
    assert found.paired.tolist() == [paired] and found.other is not None


def test_another_key_names_the_other_view():
    other, window = picture(9), pictures(3)
    found = read(sample(right=other), other_image="right")
    assert np.array_equal(found.other.image[0].permute(1, 2, 0), other) and found.paired.tolist() == [True]
    assert np.array_equal(found.reference.image[0].permute(1, 2, 0), IMAGE)
    assert not found.other.depth.any() and found.other.depth.shape == found.reference.depth.shape
    found = read(sample(right=window), other_image="right", other_at=1)
    assert np.array_equal(found.other.image[0].permute(1, 2, 0), window[1])
    depths = np.stack([metres(k) for k in range(3)])
    assert not read(sample(image=window, depth=depths, right=other), other_image="right").other.depth.any()


def test_the_other_view_has_intrinsics_of_its_own():
    """Rows along time belong to the images that they are given for; another image shares the reference view's."""
    theirs = [30.0, 31.0, 3.2, 2.8]
    given = sample(right=picture(1), K_right=matrix(*theirs))
    for option, wanted in (("K_right", theirs), (theirs, theirs), (matrix(*theirs).tolist(), theirs), (None, K)):
        found = read(given, other_image="right", other_intrinsics=option)
        assert torch.equal(numbers(found.other.camera), torch.tensor([wanted]))
        assert torch.equal(numbers(found.reference.camera), torch.tensor([K]))
    along = read(sample(image=pictures(2), K_right=theirs), other_intrinsics="K_right")
    assert torch.equal(numbers(along.other.camera), torch.tensor([theirs])), "also of a frame along time"
    rows = np.array([[20.0 + k, 21.0, 3.5, 2.5] for k in range(3)], np.float32)
    given = sample(image=pictures(3), intrinsics=rows, right=pictures(2), K_right=rows[:2] + np.float32([5, 5, 0, 0]))
    shared = read(given, other_image="right", at=1, other_at=0)
    assert torch.equal(numbers(shared.other.camera), torch.from_numpy(rows[1:2]))
    own = read(given, **RIGHT, at=2, other_at=1)
    assert torch.equal(numbers(own.reference.camera), torch.from_numpy(rows[2:]))
    assert torch.equal(numbers(own.other.camera), torch.from_numpy(given["K_right"][1:]))
    small = picture(1, (H // 2, W // 2, 3))  # each image by its own size
    found = read(sample(small=small), intrinsics_hw=(H, W), other_image="small", layout="hwc")
    halved = [K[0] / 2, K[1] / 2, (K[2] + 0.5) / 2 - 0.5, (K[3] + 0.5) / 2 - 0.5]
    assert torch.allclose(numbers(found.other.camera), torch.tensor([halved]))
    assert torch.allclose(numbers(found.reference.camera), torch.tensor([K]))


# -------------------------------------------------------------------------------------------------------------- batches


def test_a_batch_is_read_as_its_samples():
    given = [
        sample(image=picture(k), depth=metres(k), right=picture(k + 5), intrinsics=matrix(20 + k, 21, 3.5, 2.5))
        | {"right_is_pad": np.array([k == 1]), "conf": RANDOM(k).integers(0, 3, (H, W))}
        for k in range(3)
    ]
    options = {"other_image": "right", "confidence": "conf", "distortion": [0.1, 0.0, 0.0, 0.0]}
    together = read(default_collate(given), batched=True, **options)
    assert together.paired.tolist() == [True, False, True] and together.bad.tolist() == [False] * 3
    for k, one in enumerate(given):
        alone = read(one, **options)
        for mine, theirs in ((together.reference, alone.reference), (together.other, alone.other)):
            assert torch.equal(mine.image[k], theirs.image[0]) and torch.equal(mine.depth[k], theirs.depth[0])
            assert torch.equal(numbers(mine.camera)[k], numbers(theirs.camera)[0])
            assert torch.equal(mine.camera.distortion[k], theirs.camera.distortion[0])
        assert torch.equal(together.reference.conf[k], alone.reference.conf[0])
    far, narrow = {"depth": DEPTH * 1e3}, {"intrinsics": matrix(20, 0.2, 4, 2)}
    for changes, words in (
        ((narrow, far), "intrinsics: focal length 0.2 px"),
        ((far | narrow, {}), "depth: the median"),
    ):
        found = read(default_collate([sample(), *(sample(**x) for x in changes)]), batched=True)
        assert found.bad.tolist() == [False, True, bool(changes[1])]
        assert found.complaint().startswith(f"sample 1 of the batch: {words}")


def test_the_size_of_the_image_is_height_and_width():
    views = SampleSpec(depth_unit="m", image="a.b")
    assert views.image_hw({"a": {"b": IMAGE}}) == views.image_hw({"a": {"b": np.stack([IMAGE] * 4)}}) == (H, W)
    assert views.image_hw({"image": IMAGE}) is None and views.image_hw({"a.b": picture(shape=(H, W))}) is None
    assert SampleSpec(depth_unit="m", layout="hwc").image_hw({"image": picture(shape=(3, 5, 3))}) == (3, 5)
