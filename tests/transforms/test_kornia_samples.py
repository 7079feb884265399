"""kornia's augmentations on samples: what a pixel shows, how far it is and where its ray goes move together."""

import warnings

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from kornia.enhance import Normalize
from kornia.feature.loftr.utils.supervision import warp_kpts
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import BrownConradyModel, PinholeModel
from support import sample_dicts

from dhtorch.codes import PoseCode
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.records import Camera
from dhtorch.transforms import ExtendDepth, SampleError, SampleSpec
from dhtorch.transforms.kornia import PAIR_KEYS, AugmentSample
from dhtorch.transforms.sample_access import get_value

H, W = 48, 64
INTRINSICS = (40.0, 44.0, 33.0, 21.5)
SQUARE = (40.0, 40.0, 33.0, 21.5)

#: Augmentations that move pixels, and whether each picture's pixel is one of the given picture's.
MOVES = {
    "flip": (K.RandomHorizontalFlip(p=1.0), True),
    "upside down": (K.RandomVerticalFlip(p=1.0), True),
    "crop": (K.RandomCrop((30, 37), p=1.0), True),
    "padded crop": (K.RandomCrop((60, 40), p=1.0, pad_if_needed=True), True),
    "centre crop": (K.CenterCrop((30, 37), p=1.0), True),
    "resize": (K.Resize((96, 128), p=1.0), False),
    "smaller": (K.Resize((24, 32), p=1.0, align_corners=False, antialias=True), False),
    "crop and resize": (K.RandomResizedCrop((40, 50), scale=(0.4, 0.8), p=1.0), False),
    "quarter turn": (K.RandomRotation90((1, 1), p=1.0), True),
    "half turn": (K.RandomRotation90((2, 2), p=1.0), True),
    "pad": (K.PadTo((56, 70)), True),
}


def coordinates(batch=2):
    """Pictures whose red and green are the pixel's coordinates, blue marks the inside."""
    v, u = torch.meshgrid(torch.arange(H) / H, torch.arange(W) / W, indexing="ij")
    return torch.stack((u, v, torch.ones_like(u))).expand(batch, 3, H, W).clone()


def depth_map(batch=2, holes=True):
    """Depths that say where they are: 1 m + the pixel's index in mm."""
    index = torch.arange(H * W).view(1, H, W).repeat(batch, 1, 1) / 1000 + 1
    return torch.where(torch.rand(batch, H, W, generator=torch.Generator().manual_seed(0)) < 0.2 * holes, 0.0, index)


def matrix(numbers):
    return cam.to_matrix(Camera(torch.tensor([numbers[:2]]), torch.tensor([numbers[2:]])))[0]


def sample(batch=2, numbers=INTRINSICS, **more):
    K3 = matrix(numbers).expand(batch, 3, 3).clone()
    return {"image": coordinates(batch), "depth": depth_map(batch), "intrinsics": K3, **more}


def augment(augmentation, given, seed=0, **options):
    torch.manual_seed(seed)
    transform = AugmentSample(augmentation, **{"batched": True, "depth_unit": "m", **options})
    return transform(given), transform.transform_matrix


def pixels(x):
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in x.shape[-2:]), indexing="ij")
    return torch.stack((u, v), -1)


def moved_pixels(A, uv):
    """Pixels (…, 2) moved by A (3, 3)."""
    return uv.double() @ A[:2, :2].mT + A[:2, 2]


@pytest.mark.parametrize("name", MOVES)
def test_picture_depth_and_rays_move_together(name):
    augmentation, whole = MOVES[name]
    given = sample()
    out, A = augment(augmentation, given)
    shown = out["image"]
    assert shown.shape[-2:] == out["depth"].shape[-2:]
    assert shown.shape[-2:] != (H, W) or not torch.equal(A, torch.eye(3).double().expand(2, 3, 3))
    for b in range(2):
        old = moved_pixels(torch.linalg.inv(A[b]), pixels(shown))
        inside = (old > 2).all(-1) & (old < torch.tensor([W - 3, H - 3])).all(-1) & (shown[b, 2] > 0.999)
        assert inside.sum() > 400
        where = shown[b, :2].permute(1, 2, 0).double() * torch.tensor([W, H])
        assert (where - old)[inside].abs().max() < 1e-2, "kornia's picture lies where its matrix says"
        nearest = (old + 0.51).floor().long().clamp(min=0)
        index = nearest[..., 1].clamp(max=H - 1), nearest[..., 0].clamp(max=W - 1)
        assert torch.equal(out["depth"][b][inside], given["depth"][b][index][inside]), "nearest, holes kept"
        camera, new = (cam.from_matrix(x["intrinsics"][b : b + 1].double()) for x in (given, out))
        Q = cam.warp(camera, A[b : b + 1])[1]
        z = 1 + torch.rand(1, inside.sum()).double()
        xyz, xyz_new = (cam.unproject(c, uv[inside][None], z) for c, uv in ((camera, old), (new, pixels(shown))))
        torch.testing.assert_close(xyz @ Q.mT, xyz_new, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(Q @ Q.mT, torch.eye(3).double()[None], rtol=0, atol=1e-6)
    outside = (old < -1).any(-1) | (old > torch.tensor([W, H])).any(-1)
    assert not out["depth"][1][outside].any(), "no return from outside the picture"
    if whole and name not in ("padded crop", "pad", "quarter turn"):
        kept = out["depth"][out["depth"] > 0]
        assert torch.isin(kept, given["depth"]).all() and len(kept) > 0.7 * out["depth"].numel() * 0.8


def test_colours_and_blur_leave_geometry_alone():
    given = sample()
    chain = K.AugmentationSequential(
        K.ColorJiggle(0.1, 0.1, 0.1, 0.1, p=1.0), K.RandomGaussianBlur((3, 3), (0.5, 0.5), p=1.0), data_keys=None
    )
    out, A = augment(chain, given)
    assert not torch.equal(out["image"], given["image"]) and torch.equal(A, torch.eye(3).double().expand(2, 3, 3))
    assert out["depth"] is given["depth"] and out["intrinsics"] is given["intrinsics"]
    other, _ = augment(K.ImageSequential(Normalize(torch.zeros(3), torch.full((3,), 2.0))), given)
    torch.testing.assert_close(other["image"], given["image"] / 2)


@pytest.mark.parametrize("name", ["flip", "upside down", "quarter turn", "crop and resize"])
def test_views_of_a_pair_move_alike_and_their_poses_with_them(name):
    g = torch.Generator().manual_seed(3)
    T_world = se3.exp(0.3 * torch.randn(4, 6, generator=g, dtype=torch.float64))
    poses = se3.to_matrix(T_world).view(2, 2, 4, 4)  # sample, view
    given = sample(before=coordinates(), P=poses[:, 0], P_before=poses[:, 1])
    given["P_gl"], given["P_gl_before"] = (
        x @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double()) for x in poses.unbind(1)
    )
    T = torch.linalg.inv(poses[:, 1]) @ poses[:, 0]
    given["T"], given["cov"] = T, torch.randn(2, 6, 6, generator=g).double()
    given["cov"] = given["cov"] @ given["cov"].mT
    options = {"other_image": "before"}
    out, A = augment(MOVES[name][0], given, pose="P", other_pose="P_before", **options)
    assert torch.equal(out["image"], out["before"]), "the same parameters"
    relative, _ = augment(MOVES[name][0], given, pose="T", pose_kind="1_from_0", pose_cov="cov", **options)
    gl, _ = augment(MOVES[name][0], given, pose="P_gl", other_pose="P_gl_before", pose_axes="gl", **options)
    between = torch.linalg.inv(out["P_before"]) @ out["P"]
    torch.testing.assert_close(between, relative["T"])
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
    torch.testing.assert_close(flip @ torch.linalg.inv(gl["P_gl_before"]) @ gl["P_gl"] @ flip, between)
    assert (torch.linalg.det(out["P"][:, :3, :3]) - 1).abs().max() < 1e-6, "rotations, also where pictures are mirrored"
    mirrored = torch.linalg.det(A) < 0
    world = torch.where(mirrored[:, None], torch.tensor([-1.0, 1, 1]).double(), 1.0)
    assert torch.equal(out["P"][:, :3, 3], poses[:, 0, :3, 3] * world), "cameras stay where they are in the world"
    xyz = torch.rand(2, 9, 3, generator=g).double() + torch.tensor([-0.5, -0.5, 3.0])
    camera, new = (cam.from_matrix(x["intrinsics"].double()) for x in (given, out))
    Q = cam.warp(camera, A)[1]
    seen = cam.project(camera, se3.apply(se3.from_matrix(T), xyz))
    seen_new = cam.project(new, se3.apply(se3.from_matrix(between), xyz @ Q.mT))
    expected = torch.stack([moved_pixels(a, uv) for a, uv in zip(A, seen, strict=True)])
    torch.testing.assert_close(seen_new, expected, rtol=1e-4, atol=1e-4)
    step = 1e-6 * torch.randn(2, 6, generator=g, dtype=torch.float64)
    turned = se3.to_matrix(se3.compose(se3.exp(step), se3.from_matrix(T)))
    stepped, _ = augment(MOVES[name][0], {**given, "T": turned}, pose="T", pose_kind="1_from_0", **options)
    delta = stepped["T"] @ torch.linalg.inv(relative["T"])
    new_step = torch.cat((torch.stack((delta[:, 2, 1], delta[:, 0, 2], delta[:, 1, 0]), -1), delta[:, :3, 3]), -1)
    square = lambda s, c: s[:, None] @ torch.linalg.solve(c, s[..., None])  # noqa: E731
    torch.testing.assert_close(
        square(new_step, relative["cov"].double()), square(step, given["cov"]), rtol=1e-3, atol=1e-20
    )


def forms(batch=2):
    """Intrinsics of the same numbers in every form."""
    K3 = matrix(SQUARE).expand(batch, 3, 3)
    K4 = torch.eye(4).repeat(batch, 1, 1)
    K4[:, :3, :3] = K3
    flat = torch.tensor([SQUARE]).expand(batch, 4)
    sizes = [torch.full((batch,), float(n)) for n in (H, W)]
    return {
        "3x3": K3,
        "4x4": K4,
        "fx fy cx cy": flat,
        "PinholeCamera": PinholeCamera(K4, se3.to_matrix(se3.exp(torch.rand(batch, 6))), *sizes),
        "PinholeModel": PinholeModel(ImageSize(H, W), flat.clone()),
        "numpy": K3.numpy().copy(),
    }


@pytest.mark.parametrize("form", forms())
def test_intrinsics_keep_their_form(form):
    given = sample(intrinsics=forms()[form])
    plain = sample(numbers=SQUARE)
    spec = SampleSpec(depth_unit="m")
    augmentation = K.AugmentationSequential(
        K.RandomCrop((30, 37), p=1.0), K.RandomHorizontalFlip(p=0.5), data_keys=None
    )
    (out, A), (expected, _) = augment(augmentation, given), augment(augmentation, plain)
    before, after = (spec.read(x, batched=True).reference.camera for x in (given, out))
    wanted = spec.read(expected, batched=True).reference.camera
    assert torch.equal(before.f, torch.tensor([SQUARE[:2]] * 2)) and not torch.equal(before.c, after.c)
    torch.testing.assert_close(after.c, wanted.c)
    torch.testing.assert_close(after.f, wanted.f)
    value = out["intrinsics"]
    assert type(value) is type(given["intrinsics"]) or form == "numpy"
    if form == "PinholeCamera":
        assert value.height.tolist() == [30, 30] and value.width.tolist() == [37, 37]
        world, mirrored = torch.tensor([[[0.2, 0.1, 4.0]]]).expand(2, 1, 3), torch.linalg.det(A[:, :2, :2]) < 0
        assert (torch.linalg.det(value.extrinsics[:, :3, :3]) - 1).abs().max() < 1e-5
        world_new = world * torch.where(mirrored, -1.0, 1.0)[:, None, None] ** torch.tensor([1.0, 0, 0])
        uv, uv_new = given["intrinsics"].project(world), value.project(world_new)
        moved = torch.stack([moved_pixels(a, x) for a, x in zip(A, uv, strict=True)]).float()
        torch.testing.assert_close(uv_new, moved, rtol=1e-4, atol=1e-3)


def test_a_lens_turns_with_its_picture():
    lens = [-0.05, 0.02, 0.02, -0.013]
    given = sample(numbers=SQUARE, lens=torch.tensor([lens, lens]))
    model = BrownConradyModel(ImageSize(H, W), torch.tensor([*SQUARE, *lens, 0, 0, 0, 0]).expand(2, 12))
    chain = K.ImageSequential(
        K.RandomRotation90((1, 1), p=1.0), K.RandomHorizontalFlip(p=1.0), K.RandomRotation((20, 20), p=1.0)
    )
    out, A = augment(chain, given, distortion="lens")
    own, _ = augment(chain, {**given, "intrinsics": model})
    spec = SampleSpec(depth_unit="m")
    cameras = [
        SampleSpec(depth_unit="m", distortion="lens").read(x, batched=True).reference.camera for x in (given, out)
    ]
    cameras.append(spec.read(own, batched=True).reference.camera)
    uv = 5 + torch.rand(2, 20, 2) * torch.tensor([W - 10.0, H - 10.0])
    new = torch.stack([moved_pixels(a, x) for a, x in zip(A, uv, strict=True)]).float()
    Q = cam.warp(cameras[0], A.float())[1]
    for camera in cameras[1:]:
        torch.testing.assert_close(cam.rays(camera, new), cam.rays(cameras[0], uv) @ Q.mT, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("key", [None, "K_depth"])
def test_a_depth_map_of_another_size_and_camera(key):
    """Every pixel of the moved map shows the depth along its own ray."""
    camera = Camera(torch.tensor([[100.0, 100.0]]), torch.tensor([[79.5, 59.5]]))
    own = (
        cam.resize(camera, (120, 160), (H, W))
        if key is None
        else Camera(torch.tensor([[37.0, 37.0]]), torch.tensor([[30.0, 22.0]]))
    )
    rays = cam.rays(own, pixels(torch.zeros(H, W)).flatten(0, 1)[None].float())
    plane = lambda rays: 2 + rays[..., 0] + 0.5 * rays[..., 1]  # noqa: E731
    given = {
        "image": torch.rand(1, 3, 120, 160),
        "depth": plane(rays).view(1, H, W),
        "intrinsics": cam.to_matrix(camera),
    }
    given["K_depth"] = torch.cat((own.f, own.c), -1)
    for augmentation in (K.RandomCrop((80, 100), p=1.0), K.RandomHorizontalFlip(p=1.0), K.Resize((90, 120), p=1.0)):
        out, A = augment(augmentation, given, depth_intrinsics=key)
        frame = SampleSpec(depth_unit="m", depth_intrinsics=key).read(out, batched=True).reference
        h, w = frame.depth.shape[-2:]
        uv = pixels(frame.depth[0]).flatten(0, 1)[None].float()
        seen = frame.depth_camera or cam.resize(frame.camera, frame.hw, (h, w))
        Q = cam.warp(camera, A.float())[1]
        wanted, found = plane(cam.rays(seen, uv) @ Q), frame.depth.flatten(1)
        valid = found > 0
        assert valid.float().mean() > 0.85 and h < 90
        assert (found - wanted)[valid].abs().max() < 0.75 * (1 / seen.f[0, 0] + 0.5 / seen.f[0, 1]), "half a pixel"


def pair():
    """A pair of the built-in room as one sample: uint8 HWC, depth in mm, K 3×3."""
    items = sample_dicts.frames()
    return {**items[6], "before": items[0]["image"], "index": 6}


def extend(method="map", n=256, **options):
    return ExtendDepth(method=method, n=n, **{"depth_unit": "mm", "other_image": "before", **options})


def test_inside_a_container_it_answers_as_behind_it():
    chain = [K.ColorJiggle(0.05, 0.05, 0.05, 0.05, p=1.0), K.RandomCrop((96, 100), p=1.0)]
    transform = extend()
    torch.manual_seed(1)
    augmented = AugmentSample(K.AugmentationSequential(*chain, data_keys=None), depth_unit="mm", other_image="before")(
        pair()
    )
    behind = transform(augmented)
    nested = K.ImageSequential(*chain)
    for container in (
        K.AugmentationSequential(*chain, transform, data_keys=None),
        K.ImageSequential(*chain, transform),
        K.AugmentationSequential(nested, transform, data_keys=None),
    ):
        torch.manual_seed(1)
        out = AugmentSample(container)(pair())
        assert out.keys() == behind.keys() and out["dhtorch.pose_ok"]
        for key, value in behind.items():
            assert np.array_equal(np.asarray(out[key]), np.asarray(value)), key
    assert behind["image"].shape == (96, 100, 3) and behind["depth"].dtype == torch.uint16
    with pytest.raises(SampleError, match="RandomCrop: moves pixels behind ExtendDepth"):
        AugmentSample(K.ImageSequential(transform, K.RandomCrop((96, 100), p=1.0)))(pair())
    blurred = AugmentSample(K.ImageSequential(transform, K.RandomGaussianBlur((3, 3), (1.0, 1.0), p=1.0)))(pair())
    assert torch.equal(blurred["dhtorch.depth"], transform(pair())["dhtorch.depth"])


def test_an_order_drawn_at_random_is_kept():
    chain = K.ImageSequential(K.RandomHorizontalFlip(p=1.0), K.RandomCrop((30, 37), p=1.0), random_apply=1)
    seen = {tuple(augment(chain, sample(), seed=seed)[0]["image"].shape[-2:]) for seed in range(6)}
    assert seen == {(H, W), (30, 37)}


def test_a_picture_that_moves_without_its_intrinsics_is_no_answer():
    """A flip of the pictures alone, which the bound on the principal point never saw."""
    flipped = AugmentSample(K.RandomHorizontalFlip(p=1.0), depth_unit="mm", other_image="before")(pair())
    alone = {**pair(), "image": flipped["image"], "before": flipped["before"]}
    assert extend(n=1024)(flipped)["dhtorch.pose_ok"]
    assert extend(n=1024)(alone)["dhtorch.pose_code"] == PoseCode.MISALIGNED


def test_masks_and_keypoints_of_a_sample_move_with_kornia():
    inside = (depth_map() > 0).float()[:, None]
    points = torch.tensor([[[3.0, 4.0], [20.0, 11.0]]]).expand(2, 2, 2)
    given = sample(mask=inside, keypoints=points, label=torch.arange(2), task=["a", "b"])
    out, A = augment(
        K.AugmentationSequential(K.RandomHorizontalFlip(p=1.0), K.RandomCrop((30, 37), p=1.0), data_keys=None), given
    )
    assert torch.equal(out["mask"][:, 0] > 0, out["depth"] > 0) and out["task"] == ["a", "b"]
    for b in range(2):
        torch.testing.assert_close(out["keypoints"][b].double(), moved_pixels(A[b], points[b]), rtol=0, atol=1e-3)
    alone = {key: value[0] for key, value in given.items() if key != "task"} | {"mask": inside[0].numpy()}
    chain = K.AugmentationSequential(K.RandomVerticalFlip(p=1.0), data_keys=None)
    out, A = augment(chain, alone, batched=False)
    assert torch.equal(out["mask"][0] > 0, out["depth"] > 0) and out["mask"].shape == (1, H, W)
    torch.testing.assert_close(out["keypoints"].double(), moved_pixels(A[0], points[0]), rtol=0, atol=1e-3)


def test_the_keys_of_a_pair_of_loftr():
    """The dict that kornia's own supervision reads, through both."""
    K3 = matrix(SQUARE)[None]
    T = se3.to_matrix(se3.exp(torch.tensor([[0.02, -0.01, 0.03, 0.1, 0.05, -0.02]])))
    depth = 2 + pixels(torch.zeros(H, W)).sum(-1)[None].float() / 100
    given = {
        "image0": coordinates(1),
        "image1": coordinates(1),
        "depth0": depth,
        "depth1": depth,
        "K0": K3,
        "K1": K3,
        "T_0to1": T,
    }
    uv = torch.tensor([[[20.0, 10.0], [31.0, 22.0], [40.0, 30.0]]])
    read = SampleSpec(depth_unit="m", **PAIR_KEYS).read(given, batched=True)
    z = torch.stack([depth[0, int(v), int(u)] for u, v in uv[0]])[None]
    ours = cam.project(
        read.other.camera, se3.apply(read.pose_prior.T_1_from_0, cam.unproject(read.reference.camera, uv, z))
    )
    theirs = warp_kpts(uv, depth, depth, T, K3, K3)[1]
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-3)
    moved, _ = augment(K.RandomHorizontalFlip(p=1.0), given, **PAIR_KEYS)
    flipped = torch.tensor([[W - 1.0, 0]]) + uv * torch.tensor([-1.0, 1.0])
    again = warp_kpts(flipped, moved["depth0"], moved["depth1"] * 0 + depth, moved["T_0to1"], moved["K0"], moved["K1"])[
        1
    ]
    torch.testing.assert_close(
        again, torch.tensor([[W - 1.0, 0]]) + theirs * torch.tensor([-1.0, 1.0]), rtol=1e-4, atol=1e-3
    )


@pytest.mark.parametrize(
    "child",
    [
        K.RandomElasticTransform(),
        K.RandomThinPlateSpline(),
        K.RandomMixUpV2(),
        torch.nn.Conv2d(3, 3, 1),
        K.RandomFisheye(*[torch.tensor([-0.1, 0.1])] * 3),
    ],
    ids=lambda m: type(m).__name__,
)
def test_a_child_whose_effect_on_geometry_is_unknown_is_named(child):
    with pytest.raises(ValueError, match=f"found {type(child).__name__}, expected an augmentation"):
        AugmentSample(K.ImageSequential(K.ImageSequential(child)), depth_unit="m")


def test_what_no_camera_sees_is_refused():
    for augmentation, said in (
        (K.RandomShear((10.0, 10.0), p=1.0), "found a shear"),
        (K.RandomPerspective(0.4, p=1.0), "RandomPerspective: found a perspective"),
        (K.RandomRotation((30.0, 30.0), p=1.0), "found a shear"),
    ):
        with pytest.raises(SampleError, match=said):
            augment(augmentation, sample())
    assert augment(K.RandomRotation((30.0, 30.0), p=1.0), sample(numbers=SQUARE))[0]["depth"].any()
    with pytest.raises(SampleError, match="several sizes"):
        augment(K.RandomHorizontalFlip(p=1.0), sample(other=coordinates()[..., :40]), other_image="other")
    for options in ({"intrinsics": INTRINSICS}, {"distortion": [0.1, 0, 0, 0]}, {"intrinsics_hw": (H, W)}):
        with pytest.raises(ValueError, match=next(iter(options))):
            AugmentSample(K.RandomHorizontalFlip(), depth_unit="m", **options)
    with pytest.raises(ValueError, match="found no views"):
        AugmentSample(K.RandomHorizontalFlip())
    with pytest.raises(SampleError, match=r"kornia\.AugmentSample\(container\)"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        K.AugmentationSequential(extend(), data_keys=None)({"image": torch.rand(1, 3, 32, 32)})


def test_nested_keys_and_confidence_move():
    given = {"obs": {"image": coordinates(), "depth": depth_map()[:, None], "K": matrix(INTRINSICS).expand(2, 3, 3)}}
    given["conf"] = (depth_map() > 0).to(torch.uint8)[..., None]
    keys = {"image": "obs.image", "depth": "obs.depth", "intrinsics": "obs.K", "confidence": "conf"}
    out, _ = augment(K.RandomCrop((30, 37), p=1.0), given, **keys)
    assert out["obs"]["depth"].shape == (2, 1, 30, 37) and out["conf"].shape == (2, 30, 37, 1)
    assert torch.equal(out["conf"][..., 0] > 0, out["obs"]["depth"][:, 0] > 0) and out["conf"].dtype == torch.uint8
    assert get_value(given, "obs.depth").shape == (2, 1, H, W), "the given sample stays as it is"
    assert not torch.equal(out["obs"]["K"], given["obs"]["K"])
    frames = {**sample(1), "image": coordinates(3), "depth": depth_map(3), "intrinsics": matrix(INTRINSICS)}
    out, _ = augment(K.RandomCrop((30, 37), p=1.0), frames, batched=False)
    assert out["image"].shape == (3, 3, 30, 37) and out["depth"].shape == (3, 30, 37), "frames along time alike"
    assert torch.equal(out["image"][0], out["image"][2])


def test_gradients_reach_picture_depth_and_intrinsics():
    leaves = {key: value.clone().requires_grad_() for key, value in sample(1).items()}
    out, _ = augment(K.RandomHorizontalFlip(p=1.0), leaves)
    sum(out[key].square().sum() for key in leaves).backward()
    torch.testing.assert_close(leaves["depth"].grad, 2 * leaves["depth"].detach())
    torch.testing.assert_close(leaves["image"].grad, 2 * leaves["image"].detach())
    numbers = leaves["intrinsics"].grad[0]
    assert numbers[0, 0] == 80 and numbers[0, 2] == pytest.approx(-2 * (W - 1 - 33), abs=1e-3)
