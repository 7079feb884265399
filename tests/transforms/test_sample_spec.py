"""Views: the same numbers whatever the layout, the unit and the key, and a word about numbers that cannot be."""

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import BrownConradyModel, KannalaBrandtK3, PinholeModel
from torch.autograd import forward_ad
from torch.utils.data import default_collate

from dhtorch.geometry import se3
from dhtorch.transforms import SampleError, SampleSpec, sample_spec
from dhtorch.transforms.sample_access import SampleReader, to_tensor

H, W = 6, 8
K = [20.0, 22.0, 3.6, 2.4]  # fx fy cx cy


def rng(seed=0):
    return np.random.default_rng(seed)


def picture(seed=0, shape=(H, W, 3)):
    return rng(seed).integers(0, 256, shape, dtype=np.uint8)


def metres(seed=0, shape=(H, W)):
    return rng(seed).uniform(0.5, 3, shape).astype(np.float32)


def matrix(fx, fy, cx, cy):
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def sample(**changes):
    return {"image": picture(), "depth": metres(), "intrinsics": matrix(*K), **changes}


def read(given, **options):
    batched, dtype = options.pop("batched", False), options.pop("dtype", torch.float32)
    return SampleSpec(**{"depth_unit": "m", **options}).read(given, batched=batched, dtype=dtype)


def numbers(camera):
    return torch.cat((camera.f, camera.c), -1)


def refused(given, match, **options):
    with pytest.raises(SampleError, match=match):
        read(given, **options)


# ---------------------------------------------------------------------------------------------------- pictures


def test_pixels_are_those_of_the_picture_in_channels_first():
    image = picture()
    frame = read(sample(image=image)).reference
    assert frame.image.dtype == torch.uint8 and frame.image.shape == (1, 3, H, W)
    for v, u, c in [(0, 0, 0), (5, 7, 2), (2, 6, 1), (4, 1, 0)]:
        assert frame.image[0, c, v, u] == image[v, u, c]


@pytest.mark.parametrize("channels", [1, 3])
def test_both_layouts_and_a_time_axis_hold_the_same_picture(channels):
    image = picture(shape=(H, W, channels))
    wanted = torch.from_numpy(image).permute(2, 0, 1)[None]
    for given in (image, image.transpose(2, 0, 1), image[None], image.transpose(2, 0, 1)[None]):
        assert torch.equal(read(sample(image=given)).reference.image, wanted)
    stated = {"hwc": image, "chw": image.transpose(2, 0, 1)}
    for layout, given in stated.items():
        assert torch.equal(read(sample(image=given), layout=layout).reference.image, wanted)


def test_an_axis_that_could_be_either_must_be_stated():
    for shape in ((3, 5, 3), (1, 5, 3), (3, 5, 1)):
        image = picture(shape=shape)
        refused(sample(image=image), r"image: found shape \(\d, 5, \d\), expected one axis of 1 or 3.*state layout")
        given = sample(image=image, depth=np.ones((shape[0], 5), np.float32), intrinsics=[4, 4, 2, shape[0] / 2 - 0.5])
        assert torch.equal(read(given, layout="hwc").reference.image[0], torch.from_numpy(image).permute(2, 0, 1))
        given["depth"], given["intrinsics"] = np.ones((5, shape[2]), np.float32), [4, 4, shape[2] / 2 - 0.5, 2]
        assert torch.equal(read(given, layout="chw").reference.image[0], torch.from_numpy(image))


def test_a_stated_layout_is_not_guessed_at():
    refused(sample(), r"image: found shape \(6, 8, 3\), expected layout chw with 1 or 3 channels", layout="chw")
    refused(sample(image=picture(shape=(3, H, W))), r"found shape \(3, 6, 8\), expected layout hwc", layout="hwc")
    for channels in (2, 4):
        refused(sample(image=picture(shape=(H, W, channels))), "expected one axis of 1 or 3 channels")
    refused(sample(image=picture(shape=(H, W))), r"image: found shape \(6, 8\), expected \(C, H, W\) or \(H, W, C\)")
    refused(sample(image=picture(shape=(2, 1, H, W, 3))), r"found shape \(2, 1, 6, 8, 3\)")


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floating_pictures_take_the_type_that_is_asked_for(dtype):
    image = (picture() / 255).astype(dtype)
    for wanted in (torch.float32, torch.float64):
        frame = read(sample(image=image), dtype=wanted).reference
        assert frame.image.dtype == frame.depth.dtype == frame.camera.f.dtype == wanted
        assert torch.equal(frame.image[0], torch.from_numpy(image).permute(2, 0, 1).to(wanted))


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint16, np.int8, bool])
def test_whole_numbers_other_than_bytes_are_no_picture(dtype):
    name = np.dtype(dtype).name
    refused(
        sample(image=picture().astype(dtype)), rf"image: found {name}, expected uint8, or floating point in \[0, 1\]"
    )


def test_values_of_a_picture_may_miss_the_unit_range_by_a_thousandth():
    for value, bad in ((-0.0009, False), (-0.0011, True), (1.0009, False), (1.0011, True), (np.nan, True)):
        image = picture() / 255
        image[3, 4, 1] = value
        found = read(sample(image=image))
        assert bool(found.bad) == bad, value
        if bad:
            said = f"image: found the value {value:.4g}, expected [0, 1] (of [0, 255]: image / 255), pixels before any normalisation"
            assert found.complaint() == said
    both = np.full((H, W, 3), -1.0)
    both[0, 0] = 2.0
    assert "the value 2," in read(sample(image=both)).complaint(), "what is too high is said first"


# ---------------------------------------------------------------------------------------------------- depth


def test_a_sweep_says_that_it_is_sparse():
    assert read(sample()).reference.sparse is None
    assert read(sample(), sparse=True).reference.sparse.tolist() == [True]


def test_units_are_metres_millimetres_or_metres_per_unit():
    depth = metres()
    for unit, per_metre in (("m", 1), ("mm", 1000), (0.001, 1000), (0.25, 4), (2, 0.5)):
        found = read(sample(depth=depth * per_metre), depth_unit=unit).reference.depth
        assert found.dtype == torch.float32
        np.testing.assert_allclose(found[0].numpy(), depth, rtol=3e-7)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", ">u2", "int16", "uint32", "int32", "int64"])
def test_whole_numbers_of_any_width_are_read(dtype):
    units = rng().integers(1, 250, (H, W))
    found = read(sample(depth=units.astype(dtype)), depth_unit="mm").reference.depth
    assert np.allclose(found[0], units / 1000, rtol=3e-7) and found.dtype == torch.float32
    high = units + (0 if dtype == "uint8" else 32000)  # above 32767 a signed word would be negative
    if "u" in dtype:
        found = read(sample(depth=high.astype(dtype)), depth_unit=0.001).reference.depth
        assert np.allclose(found[0], high / 1000, rtol=3e-7)
    refused(sample(depth=units.astype(dtype)), r"depth: found u?int\d+, expected floating point, m; is the unit mm")


def test_unsigned_words_of_torch_are_read_too():
    units = torch.from_numpy(rng().integers(40000, 60000, (H, W)))
    for dtype in (torch.uint16, torch.uint32):
        found = read(sample(depth=units.to(dtype)), depth_unit="mm").reference.depth
        assert torch.allclose(found[0], units / 1000)


def test_what_is_no_return_is_zero():
    numbers_that_are_none = torch.tensor([torch.inf, -torch.inf, torch.nan, 1000.0])
    assert SampleSpec(depth_unit="mm")._scaled(numbers_that_are_none).tolist() == [0, 0, 0, 1]
    depth = metres()
    depth[0, :4] = np.nan, np.inf, -np.inf, -1
    wanted = depth.copy()
    wanted[0, :4] = 0
    for unit, scale in (("m", 1), ("mm", 1000), (0.01, 100)):
        given = depth * np.float32(scale)
        before = given.copy()
        found = read(sample(depth=given), depth_unit=unit).reference.depth[0].numpy()
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
        assert np.array_equal(given, before, equal_nan=True), "the sample is left as it was"
    for kind in (np.int32, np.int16):
        whole = np.full((H, W), -7, kind)
        whole[1, 1] = 500
        for unit in ("mm", 0.001):
            found = read(sample(depth=whole), depth_unit=unit).reference.depth
            assert found.sum() == found[0, 1, 1] == 0.5 and whole[0, 0] == -7 and whole[1, 1] == 500


@pytest.mark.parametrize("kind", [np.uint16, np.int16, np.int32])
def test_whole_depths_are_single_precision_whatever_type_tensors_have_by_default(kind):
    torch.set_default_dtype(torch.float64)
    try:
        found = SampleSpec(depth_unit="mm").metres([torch.from_numpy(np.full((H, W), 500, kind))])
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.dtype == torch.float32 and (found == 0.5).all()


def test_the_depth_range_is_open_below_and_closed_above():
    depth = np.full((H, W), 1.5, np.float32)
    depth[0] = [0.5, 0.5001, 1.0, 2.0, 2.0001, 0.0, 3.0, 0.1]
    wanted = [0, 0.5001, 1.0, 2.0, 0, 0, 0, 0]
    for unit, scale in (("m", 1), ("mm", 1000)):
        found = read(sample(depth=depth * scale), depth_unit=unit, depth_range=(0.5, 2.0)).reference.depth
        assert np.allclose(found[0, 0], wanted) and (found[0, 1:] == 1.5).all()
    below = read(sample(depth=depth), depth_range=(0.5, np.inf)).reference.depth[0, 0]
    above = read(sample(depth=depth), depth_range=(0.0, 2.0)).reference.depth[0, 0]
    assert np.allclose(below, [0, 0.5001, 1, 2, 2.0001, 0, 3, 0]) and np.allclose(
        above, [0.5, 0.5001, 1, 2, 0, 0, 0, 0.1]
    )


def test_gradient_of_the_depth_is_the_unit():
    for unit, factor in (("m", 1.0), ("mm", 1e-3), (0.5, 0.5)):
        depth = torch.from_numpy(metres()) / factor
        depth[0, 0], depth[0, 1] = torch.nan, -1.0
        depth.requires_grad_()
        read(sample(depth=depth), depth_unit=unit).reference.depth.sum().backward()
        wanted = torch.full((H, W), factor)
        wanted[0, :2] = 0
        assert torch.allclose(depth.grad, wanted)


def test_planes_come_with_or_without_channel_and_time():
    depth = metres()
    one = (depth, depth[None], depth[..., None], depth[None, None], depth[None, ..., None])
    assert all(np.array_equal(read(sample(depth=x)).reference.depth, depth[None]) for x in one)
    images, stack = np.stack([picture(k) for k in range(3)]), np.stack([metres(k) for k in range(3)])
    for x in (stack, stack[:, None], stack[..., None]):
        found = read(sample(image=images, depth=x), other_at=1)
        assert np.array_equal(found.reference.depth[0], stack[2]) and np.array_equal(found.other.depth[0], stack[1])
    shared = read(sample(image=images, depth=depth), other_at=1)
    assert np.array_equal(shared.reference.depth[0], depth) and (shared.other.depth == 0).all(), (
        "one depth map is the reference view's"
    )
    for shape in ((2, H, W), (H, W, 2), (H,), (1, 1, 1, H, W), (0, W)):
        refused(
            sample(image=images, depth=np.ones(shape, np.float32)), "depth: found shape .* with or without 3 in front"
        )


def test_maps_one_pixel_wide_along_time_are_no_channels():
    images, depths = picture(shape=(3, 5, 1, 3)), metres(shape=(3, 5, 1))
    found = read(sample(image=images, depth=depths, intrinsics=[4, 4, 0, 2]), layout="hwc", other_at=1)
    assert np.array_equal(found.reference.depth[0], depths[2]) and np.array_equal(found.other.depth[0], depths[1])


def test_a_median_return_beyond_the_limits_is_a_wrong_unit():
    for value, bad in ((100, False), (100.1, True), (0.01, False), (0.0099, True), (0.0, False)):
        depth = np.full((H, W), value, np.float32)
        depth[0] = 0  # no returns do not count
        found = read(sample(depth=depth))
        assert bool(found.bad) == bad, value
    said = read(sample(depth=metres() * 0 + 1500.0)).complaint()
    assert (
        said
        == "depth: the median return is 1500 m with the unit 'm', expected at most 100 m; are the numbers millimetres?"
    )
    said = read(sample(depth=metres() * 0 + 2), depth_unit="mm").complaint()
    assert (
        said
        == "depth: the median return is 0.002 m with the unit 'mm', expected at least 0.01 m; are the numbers metres?"
    )
    assert not read(sample(depth=metres() * 100), max_depth=400.0).bad and read(sample(), max_depth=0.4).bad
    assert read(sample(), min_depth=4.0).bad and not read(sample(depth=metres() / 1e3), min_depth=0.0).bad


def test_the_median_is_that_of_the_whole_map():
    depth = np.ones((64, 96), np.float32)
    given = sample(image=picture(shape=(64, 96, 3)), depth=depth, intrinsics=[50, 50, 47.5, 31.5])
    for rows, value, bad in ((30, 1e3, False), (34, 1e3, True), (30, 1e-3, False), (34, 1e-3, True)):
        for part in (slice(0, rows), slice(64 - rows, 64)):
            given["depth"] = depth.copy()
            given["depth"][part] = np.linspace(value, 1.01 * value, 96)  # one value alone would be a far constant
            assert bool(read(given).bad) == bad, (part, value)


def test_confidence_is_one_of_three_levels():
    level = rng().integers(0, 3, (H, W))
    for given in (level.astype(np.uint8), level.astype(np.float32), level[None], level[..., None].astype(np.int64)):
        found = read(sample(conf=given), confidence="conf")
        assert found.reference.conf.dtype == torch.uint8 and not found.bad
        assert np.array_equal(found.reference.conf[0], level)
    assert read(sample()).reference.conf is None
    for wrong, value in ((level + 1, 3), (np.where(level == 1, 0.5, level), 2)):
        found = read(sample(conf=wrong), confidence="conf")
        assert found.complaint() == f"conf: found the value {value}, expected 0 low, 1 medium, 2 high"
        assert found.reference.conf.max() <= 2
    one = np.zeros((H, W))
    one[4, 2] = 1.5
    assert read(sample(conf=one), confidence="conf").bad
    images, levels = np.stack([picture(k) for k in range(2)]), np.stack([level, 2 - level])
    along = read(sample(image=images, conf=levels), confidence="conf", at=0, other_at=1)
    assert np.array_equal(along.reference.conf[0], level)
    refused(sample(conf=level[:3]), "conf: found 3x8, expected 6x8 as depth", confidence="conf")


# ---------------------------------------------------------------------------------------------------- keys and arrays


def test_keys_are_flat_or_lead_into_nested_dicts():
    plain = sample()
    nested = {"a": {"b": {"image": plain["image"]}, "depth": plain["depth"]}, "a.K": plain["intrinsics"]}
    for image, depth in (("a.b.image", "a.depth"), ("a/b/image", "a/depth"), ("a/b.image", "a.depth")):
        found = read(nested, image=image, depth=depth, intrinsics="a.K")
        assert torch.equal(found.reference.image, read(plain).reference.image)
        assert torch.equal(found.reference.depth, read(plain).reference.depth)
    both = {**nested, "a.depth": plain["depth"] + 1}
    found = read(both, image="a.b.image", depth="a.depth", intrinsics="a.K")
    assert np.allclose(found.reference.depth[0], plain["depth"] + 1), "a key as it stands goes first"


def test_a_missing_key_is_named_with_those_there_are():
    nested = {"z": 1, "a": {"depth": metres(), "b": {"x": 1}}, "image": picture()}
    refused(nested, r"^depth: found no such key, expected one of a\.b\.x, a\.depth, image, z$")
    refused(nested, r"^a\.depth\.more: found no such key", depth="a.depth.more")
    refused(sample(), r"^right: found no such key", other_image="right")
    for option in ("intrinsics", "distortion", "depth_intrinsics", "confidence", "other_intrinsics"):
        key = {"other_image": "image", option: "nowhere"}
        refused(sample(), "^nowhere: found no such key", **key)


def test_arrays_of_any_make_hold_the_same_numbers():
    pil = pytest.importorskip("PIL.Image")
    image, depth = picture(), metres()
    wanted = read(sample()).reference
    frozen = image.copy()
    frozen.setflags(write=False)
    for same in (
        frozen,
        image[::-1].copy()[::-1],
        np.asfortranarray(image),
        pil.fromarray(image),
        torch.from_numpy(image),
    ):
        assert torch.equal(read(sample(image=same)).reference.image, wanted.image)
    for same in (depth.astype(">f4"), depth.astype(np.float64), depth.tolist(), torch.from_numpy(depth)):
        assert torch.equal(read(sample(depth=same)).reference.depth, wanted.depth)
    for text in ("depth.png", None, np.array(["a"]), np.array([1j]), object()):
        refused(sample(depth=text), "depth: found .*, expected an array of numbers")


def test_a_shared_array_is_not_written_to():
    frozen = np.full((H, W), 1000, np.uint16)
    frozen.setflags(write=False)
    assert (read(sample(depth=frozen), depth_unit="mm").reference.depth == 1).all() and (frozen == 1000).all()


def test_unsigned_words_become_signed_ones_that_hold_them():
    for dtype, wanted in ((np.uint16, torch.int32), (np.uint32, torch.int64), (np.uint8, torch.uint8)):
        top = np.array([0, np.iinfo(dtype).max], dtype)
        for given in (top, torch.from_numpy(top)):
            found = to_tensor(given, "x")
            assert found.dtype == wanted and found.tolist() == top.tolist()
        assert to_tensor(top, "x", signed=False).dtype == torch.from_numpy(top).dtype
    assert to_tensor(np.int16([-3]), "x").dtype == torch.int16 and to_tensor(True, "x").dtype == torch.bool


def test_subclasses_of_tensors_become_plain():
    class Wrapped(torch.Tensor):
        pass

    given = sample(image=torch.from_numpy(picture()).as_subclass(Wrapped))
    assert type(read(given).reference.image) is torch.Tensor


# ---------------------------------------------------------------------------------------------------- cameras


def test_intrinsics_are_a_matrix_or_four_numbers():
    wanted = torch.tensor([K])
    for given in (matrix(*K), matrix(*K).ravel(), K, np.array(K), torch.tensor(K), matrix(*K).tolist()):
        assert torch.equal(numbers(read(sample(intrinsics=given)).reference.camera), wanted)
        assert torch.equal(numbers(read(sample(intrinsics="unused"), intrinsics=given).reference.camera), wanted)
    for wrong, count in ((np.ones(6), 6), (np.ones(3), 3), (np.ones(16), 16)):
        refused(
            sample(intrinsics=wrong), f"intrinsics: found {count} numbers, expected 3x3, 4x4, fx fy cx cy or a camera"
        )
        refused(sample(), f"intrinsics: found {count} numbers, expected", intrinsics=wrong.tolist())
    refused(sample(intrinsics=np.ones((2, 2, 4))), r"intrinsics: found shape \(2, 2, 4\), expected one row of numbers")
    refused(sample(), r"numbers: found shape \(\), expected one row", intrinsics=5.0)
    refused(sample(depth=metres(shape=(3, H, W))[1], K=np.ones((2, 4))), r"K: found shape \(2, 4\)", intrinsics="K")


def test_numbers_along_time_are_those_of_the_frame():
    images = np.stack([picture(k) for k in range(3)])
    rows = [[20.0 + k, 21.0 + k, 3.5, 2.5] for k in range(3)]
    bends = [[0.01 * k, 0.0, 0.0, 0.0] for k in range(3)]
    for given in (rows, [matrix(*row) for row in rows]):
        found = read(
            sample(image=images, intrinsics=np.stack(given), bend=np.array(bends)),
            distortion="bend",
            depth_intrinsics="intrinsics",
            at=1,
            other_at=-1,
        )
        assert torch.equal(numbers(found.reference.camera), torch.tensor([rows[1]]))
        assert torch.equal(numbers(found.reference.depth_camera), torch.tensor([rows[1]]))
        assert torch.equal(numbers(found.other.camera), torch.tensor([rows[2]]))
        assert torch.allclose(found.reference.camera.distortion, torch.tensor([bends[1]]))
        assert torch.allclose(found.other.camera.distortion, torch.tensor([bends[2]]))
    once = read(sample(image=images, intrinsics=np.array([K])), at=2, other_at=1)
    assert torch.equal(numbers(once.reference.camera), torch.tensor([K])), "given once it holds for all"
    assert torch.equal(numbers(once.other.camera), torch.tensor([K]))


def test_the_same_numbers_are_read_once_and_others_never_taken_for_them():
    views = SampleSpec(depth_unit="m")
    given = [matrix(*K), matrix(*K), matrix(21, 22, 3.5, 2.5), matrix(*K).astype(np.float64), torch.tensor(matrix(*K))]
    given += [
        [*K],
        np.array(K, np.int64),
        torch.tensor(K, dtype=torch.bfloat16),
        matrix(*K)[::-1],
        matrix(*K)[::-1].copy(),
    ]
    for value in (*given, *given):
        found = views.read(sample(intrinsics=value))
        alone = read(sample(intrinsics=value))
        assert torch.equal(numbers(found.reference.camera), numbers(alone.reference.camera))
        assert torch.equal(found.bad, alone.bad)
    first, again = (views.read(sample()).reference.camera for _ in range(2))
    assert first is again
    for k in range(200):  # one for each frame: never more than some are kept
        views.read(sample(intrinsics=matrix(20 + k / 100, *K[1:])))
    assert len(views._cameras) <= 64 and SampleSpec(depth_unit="m") == views
    small = views.read(sample(image=picture(shape=(2 * H, 2 * W, 3)))).reference.camera
    assert torch.equal(small.c, first.c) and views.read(sample(image=picture(shape=(60 * H, 60 * W, 3)))).bad
    leaf = torch.tensor(matrix(*K), requires_grad=True)
    views.read(sample(intrinsics=leaf)).reference.camera.f.sum().backward()
    assert leaf.grad.sum() == 2
    views = SampleSpec(depth_unit="m")
    with torch.inference_mode():
        views.read(sample())
    assert not views.read(sample()).reference.camera.f.is_inference(), "a graph could not go through it"
    with forward_ad.dual_level():
        tangent = forward_ad.make_dual(torch.tensor(matrix(*K)), torch.ones(3, 3))
        assert forward_ad.unpack_dual(views.read(sample(intrinsics=tangent)).reference.camera.f).tangent is not None
    flat, views = np.array(K, np.float32), SampleSpec(depth_unit="m")
    views.read(sample(intrinsics=flat))
    with pytest.raises(SampleError, match="expected"):
        views.read(sample(intrinsics=flat.reshape(2, 1, 2)))
    leaves = SampleReader(sample(intrinsics=np.array(K, object)), batched=False, dtype=torch.float32)
    leaves.images("image", None)
    assert leaves.fingerprint("intrinsics") is None, "bytes of objects are addresses"
    assert leaves.fingerprint((20.0, 22.0, 3.6, 2.4)) is not None


@pytest.mark.parametrize("place", [(0, 1), (33, 47), (63, 95)])
def test_one_return_that_no_probe_meets_is_a_return(place):
    depth = np.zeros((64, 96), np.float32)
    given = sample(image=picture(shape=(64, 96, 3)), depth=depth, intrinsics=[50, 50, 47.5, 31.5])
    assert not read(given).has_returns
    depth[place] = 1.5
    assert read(given).has_returns


def test_intrinsics_of_another_size_are_scaled_about_the_corner():
    big = [2 * K[0], 3 * K[1], 2 * (K[2] + 0.5) - 0.5, 3 * (K[3] + 0.5) - 0.5]
    found = read(sample(intrinsics=big), intrinsics_hw=(3 * H, 2 * W), other_image="image")
    assert torch.allclose(numbers(found.reference.camera), torch.tensor([K])) and not found.bad
    assert torch.allclose(numbers(found.other.camera), torch.tensor([K]))
    small = picture(1, (H // 2, W // 2, 3))
    found = read(sample(small=small), intrinsics_hw=(H, W), other_image="small", layout="hwc")
    halved = [K[0] / 2, K[1] / 2, (K[2] + 0.5) / 2 - 0.5, (K[3] + 0.5) / 2 - 0.5]
    assert torch.allclose(numbers(found.reference.camera), torch.tensor([K])), "the size they belong to changes nothing"
    assert torch.allclose(numbers(found.other.camera), torch.tensor([halved])), "each picture by its own size"


def test_the_principal_point_may_lie_anywhere():
    """That of a crop lies outside its picture; a crop that K does not follow is found by near returns and tracks."""
    for c in ([-7.0, 2.0], [3.5, 40.0], [3.5, 2.5]):
        assert not read(sample(intrinsics=[20, 20, *c])).bad
    for c in ([np.nan, 2.5], [3.5, np.inf]):
        assert read(sample(intrinsics=[20, 20, *c])).bad
        assert "found a principal point of" in read(sample(intrinsics=[20, 20, *c])).complaint()


def test_intrinsics_of_another_unit_are_named():
    normalised = [0.9, 1.2, 0.5, 0.5]
    assert read(sample(intrinsics=normalised), min_focal=0.2).complaint() == (
        "intrinsics: focal length 0.9 px in an image of 6x8, expected at least 1.6 (min_focal=0.2 of its longer side); "
        "are they normalised, or of another size?"
    )
    wide = {"image": picture(shape=(6, 60, 3)), "depth": metres(shape=(6, 60))}
    assert read(sample(intrinsics=normalised, **wide)).bad
    assert not read(sample(intrinsics=normalised, **wide), min_focal=0.0).bad
    turned = matrix(*K).T.copy()
    assert read(sample(intrinsics=turned)).complaint() == (
        "intrinsics: the last row is off 0 0 1 by 3.6; is the matrix transposed?"
    )
    assert not read(sample(intrinsics=matrix(*K) + np.float32(1e-6))).bad


@pytest.mark.parametrize("T", [1, 4])
def test_matrices_of_four_rows(T):
    """4×4, alone and for each frame; four rows of four numbers are those of four frames unless they end in 0 0 0 1."""
    images = np.stack([picture(k) for k in range(T)])
    K4 = np.eye(4, dtype=np.float32)
    K4[:3, :3] = matrix(*K)
    for value in (K4, np.stack([K4] * T), torch.from_numpy(K4)):
        assert torch.equal(numbers(read(sample(image=images, intrinsics=value)).reference.camera), torch.tensor([K]))
    other_last_row = K4 + np.diag([0, 0, 0, 1]).astype(np.float32)
    if T == 1:
        assert torch.equal(numbers(read(sample(intrinsics=other_last_row)).reference.camera), torch.tensor([K]))
    if T == 4:
        rows = np.array([[20 + k, 22, 3.6, 2.4] for k in range(4)], np.float32)
        assert torch.equal(
            numbers(read(sample(image=images, intrinsics=rows), at=2).reference.camera),
            torch.tensor([rows[2].tolist()]),
        )
    with pytest.raises(SampleError, match="4x4, fx fy cx cy or a camera"):
        read(sample(intrinsics=np.arange(5)))


def kornia_camera(n=1, kind="pinhole"):
    K4 = torch.eye(4).repeat(n, 1, 1)
    K4[:, :3, :3] = torch.tensor(matrix(*K))
    K4[:, 0, 0] += torch.arange(n)
    if kind == "pinhole":
        return PinholeCamera(K4, torch.eye(4).repeat(n, 1, 1), *(torch.full((n,), float(side)) for side in (H, W)))
    rows = torch.cat((K4[:, [0, 1], [0, 1]], K4[:, [0, 1], [2, 2]]), -1)
    if kind == "model":
        return PinholeModel(ImageSize(H, W), rows[0] if n == 1 else rows)
    return BrownConradyModel(ImageSize(H, W), torch.cat((rows, torch.full((n, 8), 0.01)), -1))


@pytest.mark.parametrize("kind", ["pinhole", "model", "lens"])
def test_cameras_of_kornia_are_intrinsics(kind):
    value = kornia_camera(kind=kind)
    for given, options in ((sample(intrinsics=value), {}), (sample(), {"intrinsics": value})):
        camera = read(given, **options).reference.camera
        assert torch.equal(numbers(camera), torch.tensor([K]))
        assert (camera.distortion is None) == (kind != "lens")
    several = kornia_camera(3, kind)
    images, depths = np.stack([picture(k) for k in range(3)]), np.stack([metres()] * 3)
    frames = read(sample(image=images, depth=depths, intrinsics=several), at=2)
    batch = read(sample(image=images, depth=depths, intrinsics=several), batched=True)
    assert frames.reference.camera.f[0, 0] == 22 and batch.reference.camera.f[:, 0].tolist() == [20, 21, 22]
    assert (
        read(sample(image=images, depth=depths), batched=True, intrinsics=value).reference.camera.f[:, 0].tolist()
        == [20] * 3
    )
    refused(
        sample(image=images, depth=depths, intrinsics=kornia_camera(2, kind)), "found shape .2, 2., expected one row"
    )
    if kind == "lens":
        refused(sample(intrinsics=value), "beside the option distortion", distortion=[0.1, 0, 0, 0])


def test_other_objects_of_kornia_are_refused_by_name():
    fisheye = KannalaBrandtK3(ImageSize(H, W), torch.rand(8))
    refused(
        sample(intrinsics=fisheye), "intrinsics: Camera.from_kornia: found KannalaBrandtK3, expected a PinholeCamera"
    )


def test_the_pose_of_a_pinhole_camera():
    """``pose`` may name a camera of kornia, whose extrinsics map the world into the camera."""
    T = [se3.to_matrix(se3.exp(torch.rand(1, 6, generator=torch.Generator().manual_seed(k)))) for k in (0, 1)]
    K4 = kornia_camera().intrinsics
    sizes = torch.tensor([float(H)]), torch.tensor([float(W)])
    cameras = {name: PinholeCamera(K4, E, *sizes) for name, E in zip(("camera", "camera_before"), T, strict=True)}
    given = sample(before=picture(1), **cameras)
    found = read(given, intrinsics="camera", other_image="before", pose="camera", other_pose="camera_before")
    motion = se3.to_matrix(found.pose_prior.T_1_from_0)
    torch.testing.assert_close(motion, T[1] @ torch.linalg.inv(T[0]), rtol=1e-4, atol=1e-5)


def test_numbers_that_are_looked_at_are_judged_as_by_operations(monkeypatch):
    def judged(given):
        with monkeypatch.context() as patched:
            patched.setattr(sample_spec, "_is_cheap_to_read", lambda _: False)
            return read(given).bad

    near = [limit * (1 + step * 2**-23) for limit in (0.01, 100.0) for step in (-100, -2, -1, 0, 1, 2, 100)]
    for value in (*near, 0.0, np.nan, 1.0, 1e3):
        given = sample(depth=np.full((H, W), value, np.float32))
        assert torch.equal(read(given).bad, judged(given)), value
    for step in (-100, -2, -1, 0, 1, 2, 100):
        given = sample(intrinsics=[20, 0.05 * W * (1 + step * 2**-23), 3.5, 2.5])
        assert torch.equal(read(given).bad, judged(given)), step
    batch = default_collate([sample(), sample(depth=metres() * 1e3), sample(intrinsics=matrix(20, -1, 3.5, 2.5))])
    assert read(batch, batched=True).bad.tolist() == [False, True, True]


def test_focal_lengths_are_positive():
    for f, said in (([0.0, 20.0], "0"), ([20.0, -3.0], "-3"), ([-1.0, -2.0], "-2"), ([np.nan, 20.0], "nan")):
        found = read(sample(intrinsics=[*f, 3.5, 2.5]))
        assert found.complaint() == f"intrinsics: found focal length {said}, expected a positive number of px"
    assert not read(sample(intrinsics=[1e-3, 1e-3, 3.5, 2.5]), min_focal=0.0).bad


def test_a_depth_map_has_the_shape_of_the_picture_or_a_camera_of_its_own():
    given = sample(image=picture(shape=(100, 100, 3)), intrinsics=[90, 90, 49.5, 49.5])
    for h, w, fits in (
        (50, 50, True),
        (109, 100, True),
        (111, 100, False),
        (91, 100, True),
        (89, 100, False),
        (10, 30, False),
    ):
        given["depth"] = np.ones((h, w), np.float32)
        if fits:
            assert read(given).reference.depth_camera is None
        else:
            refused(
                given, f"depth: found {h}x{w} .height x width., which is no scaled image of 100x100; .*depth_intrinsics"
            )
        own = read(given, depth_intrinsics=[5, 6, 7, 8]).reference
        assert (
            torch.equal(numbers(own.depth_camera), torch.tensor([[5.0, 6, 7, 8]]))
            and own.depth_camera.distortion is None
        )
    wide = sample(image=picture(shape=(10, 40, 3)), intrinsics=[9, 9, 19.5, 4.5], depth=np.ones((5, 20), np.float32))
    assert read(wide).reference.depth_camera is None
    refused(
        {**wide, "depth": np.ones((20, 5), np.float32)},
        r"orientation differs: depth 5x20 \(portrait\) beside pictures 40x10 \(landscape\)",
    )


# ---------------------------------------------------------------------------------------------------- the other view


def test_frames_along_time_are_picked_by_place():
    images = np.stack([picture(k) for k in range(4)])
    for at, other_at, reference, other in ((-1, 0, 3, 0), (2, 1, 2, 1), (0, -1, 0, 3), (-4, 3, 0, 3), (1, -3, 1, None)):
        found = read(sample(image=images), at=at, other_at=other_at)
        assert np.array_equal(found.reference.image[0].permute(1, 2, 0), images[reference])
        if other is None:
            assert found.other is None and found.paired.tolist() == [False], "the same place twice is one view"
        else:
            assert np.array_equal(found.other.image[0].permute(1, 2, 0), images[other]) and found.paired.tolist() == [
                True
            ]
    for at, key in ((4, "at"), (-5, "at"), (4, "other_at"), (-5, "other_at")):
        refused(sample(image=images), f"image: found 4 frames along time, expected one at {at}", **{key: at})
    alone = read(sample())
    assert alone.other is None and alone.paired.tolist() == [False]


def test_only_frames_that_are_asked_for_are_judged():
    for place, bad in ((0, False), (1, True), (2, True)):
        images = np.stack([picture(k) for k in range(3)]) / 255
        images[place, 0, 0, 0] = 7
        found = read(sample(image=images), at=2, other_at=1)
        assert found.bad.tolist() == [bad], place


def test_several_other_views_are_stacked_in_their_order():
    images, depths = np.stack([picture(k) for k in range(4)]), np.stack([metres(k) for k in range(4)])
    found = read(sample(image=images, depth=depths), other_at=(2, 0))
    assert found.other.image.shape == (2, 1, 3, H, W) and found.paired.tolist() == [True]
    for k, place in enumerate((2, 0)):
        assert np.array_equal(found.other.image[k, 0].permute(1, 2, 0), images[place])
        assert np.array_equal(found.other.depth[k, 0], depths[place])
    one = read(sample(image=images), other_at=[1])
    assert one.other.image.shape == (1, 1, 3, H, W), "a list of one keeps its dimension"
    assert read(sample(image=images), other_at=[3, 3]).other is None
    some = read(sample(image=images, image_is_pad=[True, True, False, False]), other_at=(0, 2))
    none = read(sample(image=images, image_is_pad=[True, False, True, False]), other_at=(0, 2))
    mixed = read(sample(image=images, image_is_pad=[True] * 4), other_at=(0, 3))
    assert (some.paired.tolist(), none.paired.tolist(), mixed.paired.tolist()) == ([True], [False], [False])
    same = read(sample(image=images, image_is_pad=[True, False, False, False]), other_at=(0, 3))
    assert same.paired.tolist() == [False], "the reference view is no view beside itself"
    both = read(sample(image=images), other_at=(0, 3))
    assert both.paired.tolist() == [True] and both.other.image.shape[0] == 2, "but one of several"


def test_another_key_names_the_other_view():
    other = picture(9)
    found = read(sample(right=other))
    assert found.other is None
    found = read(sample(right=other), other_image="right")
    assert np.array_equal(found.other.image[0].permute(1, 2, 0), other) and found.paired.tolist() == [True]
    assert np.array_equal(found.reference.image[0].permute(1, 2, 0), picture())
    assert (found.other.depth == 0).all() and found.other.depth.shape == found.reference.depth.shape
    window = np.stack([picture(k) for k in range(3)])
    found = read(sample(right=window), other_image="right", other_at=1)
    assert np.array_equal(found.other.image[0].permute(1, 2, 0), window[1])
    depths = read(sample(image=window, depth=np.stack([metres(k) for k in range(3)]), right=other), other_image="right")
    assert (depths.other.depth == 0).all(), "depth along time is the reference view's camera's"
    refused(
        sample(right=window), "right: found 3 frames along time, expected one at 3", other_image="right", other_at=3
    )
    bright = read(sample(right=other / 100), other_image="right")
    assert bright.bad and bright.complaint().startswith("right: found the value")
    refused(sample(right=other[..., :2]), "right: found shape", other_image="right")


def test_the_other_view_has_intrinsics_of_its_own():
    theirs = [30.0, 31.0, 3.2, 2.8]
    given = sample(right=picture(1), K_right=matrix(*theirs))
    for option in ("K_right", theirs, np.array(theirs), matrix(*theirs).tolist()):
        found = read(given, other_image="right", other_intrinsics=option)
        assert torch.equal(numbers(found.other.camera), torch.tensor([theirs]))
        assert torch.equal(numbers(found.reference.camera), torch.tensor([K]))
    shared = read(given, other_image="right")
    assert torch.equal(numbers(shared.other.camera), torch.tensor([K]))
    wrong = read({**given, "K_right": matrix(30, 0.1, 3, 2)}, other_image="right", other_intrinsics="K_right")
    assert wrong.complaint().startswith("K_right: focal length 0.1 px in an image of 6x8, expected at least 0.4")
    along = read(sample(image=np.stack([picture(k) for k in range(2)]), K_right=theirs), other_intrinsics="K_right")
    assert torch.equal(numbers(along.other.camera), torch.tensor([theirs])), "also of a frame along time"


def test_numbers_along_time_belong_to_the_picture_that_they_are_given_for():
    """The reference view's own frames have rows of numbers; another picture shares the reference view's, or has rows itself."""
    images = np.stack([picture(k) for k in range(3)])
    rows = np.array([[20.0 + k, 21.0, 3.5, 2.5] for k in range(3)], np.float32)
    given = sample(image=images, intrinsics=rows, right=np.stack([picture(k) for k in (7, 8)]))
    shared = read(given, other_image="right", at=1, other_at=0)
    assert torch.equal(numbers(shared.other.camera), torch.from_numpy(rows[1:2]))
    theirs = rows[:2] + np.float32([5, 5, 0, 0])
    own = read({**given, "K_right": theirs}, other_image="right", other_intrinsics="K_right", at=2, other_at=1)
    assert torch.equal(numbers(own.reference.camera), torch.from_numpy(rows[2:]))
    assert torch.equal(numbers(own.other.camera), torch.from_numpy(theirs[1:]))


def test_a_frame_that_pads_is_no_view_of_its_own():
    images = np.stack([picture(k) for k in range(3)])
    for pad, paired in (([True, False, False], False), ([False, True, True], True)):
        for given in (np.array(pad), torch.tensor(pad), [int(p) for p in pad]):
            found = read(sample(image=images, image_is_pad=given))
            assert found.paired.tolist() == [paired] and found.other is not None
    for n in (2, 4):
        refused(sample(image=images, image_is_pad=[False] * n), f"image_is_pad: found {n} values, expected 3")
    for pad in (True, False):
        found = read(
            sample(right=picture(1), right_is_pad=np.array([pad]), image_is_pad=[not pad]), other_image="right"
        )
        assert found.paired.tolist() == [not pad], "that of the other picture counts"


def test_the_other_picture_may_be_the_same_place_of_another_key():
    found = read(sample(right=picture(1), right_is_pad=[False]), other_image="right", at=0, other_at=0)
    assert found.other is not None and found.paired.tolist() == [True]


# ---------------------------------------------------------------------------------------------------- batches


def test_a_batch_is_read_as_its_samples():
    given = [
        sample(image=picture(k), depth=metres(k), right=picture(k + 5), intrinsics=matrix(20 + k, 21, 3.5, 2.5))
        | {"right_is_pad": np.array([k == 1]), "conf": rng(k).integers(0, 3, (H, W))}
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


def test_the_first_bad_sample_of_a_batch_speaks():
    given = [sample() for _ in range(3)]
    given[1]["intrinsics"] = matrix(20, 0.2, 4, 2)
    given[2]["depth"] = metres() * 1e3
    found = read(default_collate(given), batched=True)
    assert found.bad.tolist() == [False, True, True]
    assert found.complaint().startswith("sample 1 of the batch: intrinsics: focal length 0.2 px")
    given[1]["depth"] = metres() * 1e3
    assert read(default_collate(given), batched=True).complaint().startswith("sample 1 of the batch: depth: the median")


def test_every_part_of_a_batch_holds_the_same_samples():
    batch = default_collate([sample(), sample()])
    for key, value in (
        ("depth", batch["depth"][:1]),
        ("depth", batch["depth"].repeat(2, 1, 1)),
        ("intrinsics", torch.tensor(5.0)),
    ):
        refused({**batch, key: value}, f"{key}: found shape .*, expected 2 samples in front", batched=True)


# ---------------------------------------------------------------------------------------------------- options


def test_the_size_of_the_picture_is_height_and_width():
    views = SampleSpec(depth_unit="m", image="a.b")
    assert views.image_hw({"a": {"b": picture()}}) == (H, W)
    assert views.image_hw({"a": {"b": np.stack([picture()] * 4)}}) == (H, W)
    assert views.image_hw({"image": picture()}) is None and views.image_hw({"a.b": picture(shape=(H, W))}) is None
    stated = SampleSpec(depth_unit="m", layout="hwc")
    assert stated.image_hw({"image": picture(shape=(3, 5, 3))}) == (3, 5)


@pytest.mark.parametrize("unit", ["cm", "", 0, -0.001, None])
def test_a_unit_is_a_name_or_a_positive_number(unit):
    with pytest.raises(ValueError, match=r"depth_unit is .*, expected one of"):
        SampleSpec(depth_unit=unit)


def test_options_that_cannot_be_are_refused():
    with pytest.raises(
        ValueError, match=r"depth_unit is 'cm', expected one of \['m', 'mm'\], metres per unit, or auto"
    ):
        SampleSpec(depth_unit="cm")
    with pytest.raises(ValueError, match="layout is 'bgr', expected hwc, chw or None"):
        SampleSpec(depth_unit="m", layout="bgr")
    with pytest.raises(ValueError, match="other_at is a list, expected one number where other_image"):
        SampleSpec(depth_unit="m", other_image="right", other_at=[0])
    assert SampleSpec(depth_unit="m", other_at=[0, 1]).other_at == [0, 1]
    with pytest.raises(ValueError, match="depth_unit is '', expected one of"):
        SampleSpec()
