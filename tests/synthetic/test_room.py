"""The built-in room: exact geometry, a sensor that fails where sensors fail, the same bits every time."""

import pickle

import cv2
import pytest
import torch

from dhtorch.geometry import camera, se3
from dhtorch.pytree import collate
from dhtorch.synthetic.paths import CAMERA_PATHS
from dhtorch.synthetic.raycast import SURFACE_DARK, SURFACE_MIRROR, SURFACE_ORDINARY, SURFACE_WINDOW
from dhtorch.synthetic.recording import SURFACE_NAMES, SyntheticRoom, open_room, simulate_phone_lidar
from dhtorch.synthetic.room import _ROOM_HEIGHT_M, ROOM_BACK_M, ROOM_FRONT_M, ROOM_LEFT_M, ROOM_RIGHT_M, furnished_room
from dhtorch.synthetic.shading import Light, ShadedRoom

SMALL = {"hw": (120, 160), "depth_hw": (48, 64)}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Many small operations: on a busy machine threads that wait for one another cost more than they save."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(hw=(240, 320), supersample=2, image_noise=0.0)


def pixels(hw):
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in hw), indexing="ij")
    return torch.stack((u, v), -1).reshape(1, -1, 2)


def world_points(room, i):
    """What every pixel of frame i sees, in world axes, by the project's own camera and pose functions."""
    cam, depth = room.camera.to(torch.float64), room.truth(i)["depth"].double()
    return se3.apply(room.poses[i : i + 1], camera.unproject(cam, pixels(room.hw), depth.reshape(1, -1)))


def sample(image, uv):
    """Bilinear values (C, N) of (1, C, H, W) at (1, N, 2) px, and which places are inside."""
    h, w = image.shape[-2:]
    grid = torch.stack(((uv[..., 0] + 0.5) / w * 2 - 1, (uv[..., 1] + 0.5) / h * 2 - 1), -1)
    value = torch.nn.functional.grid_sample(image.double(), grid[:, None], align_corners=False)
    return value[0, :, 0], (grid.abs() < 0.97).all(-1)[0]


def test_frame_keeps_the_promises_of_the_record():
    room = SyntheticRoom(n_frames=3, **SMALL)
    frame = collate([room[0], room[1], room[2]])
    assert frame.image.shape == (3, 3, 120, 160) and frame.image.dtype == torch.uint8
    assert frame.depth.shape == (3, 48, 64) and frame.depth.dtype == torch.float32
    assert frame.conf.shape == (3, 48, 64) and frame.conf.dtype == torch.uint8
    assert frame.time.dtype == torch.float64 and torch.equal(frame.time, room.times)
    torch.testing.assert_close(frame.T_world_from_cam.t, room.poses.t.float())
    expected = camera.resize(room.camera, (120, 160), (48, 64))
    assert torch.equal(frame.depth_camera[0:1].c, expected.c) and torch.equal(frame.depth_camera[0:1].f, expected.f)


def test_true_depth_lies_on_the_walls_of_the_room(room):
    x, y, z = world_points(room, 0)[0].unbind(-1)
    assert x.min() > ROOM_LEFT_M - 1e-3 and x.max() < ROOM_RIGHT_M + 1e-3
    assert y.min() > -_ROOM_HEIGHT_M - 1e-3 and y.max() < 1e-3
    assert z.min() > ROOM_FRONT_M - 1e-3 and z.max() < ROOM_BACK_M + 1e-3
    assert ((z - ROOM_BACK_M).abs() < 1e-5).double().mean() > 0.15, (
        "the brick wall is a plane and fills part of the view"
    )
    assert ((x - ROOM_RIGHT_M).abs() < 1e-5).double().mean() > 0.01


@pytest.mark.parametrize("j", [6, 11])
def test_a_world_point_is_the_same_point_in_another_frame(room, j):
    """Depth and colour of frame 0, carried to frame j by camera and pose, agree with frame j where it sees the point."""
    in_j = se3.apply(se3.invert(room.poses[j : j + 1]), world_points(room, 0))
    uv = camera.project(room.camera.to(torch.float64), in_j)
    truth = room.truth(j)
    inverse, inside = sample(1 / truth["depth"][:, None], uv)
    disagree = (in_j[0, :, 2] * inverse[0] - 1).abs()
    seen = inside & (disagree < 0.01)
    assert seen.double().sum() > 0.8 * inside.double().sum(), "most points stay visible"
    assert disagree[seen].median() < 2e-5

    plain = (room.truth(0)["surface"].reshape(-1) == SURFACE_ORDINARY) & (
        sample(truth["surface"][:, None], uv)[0][0] == SURFACE_ORDINARY
    )
    colour, _ = sample(room[j].image, uv)
    error = (colour - room[0].image[0].reshape(3, -1)).abs().mean(0)
    assert error[seen & plain].median() < 4, "grey levels: the same surface has the same colour"
    shifted, _ = sample(room[j].image, uv + 1.5)
    wrong = (shifted - room[0].image[0].reshape(3, -1)).abs().mean(0)
    assert wrong[seen & plain].median() > 2 * error[seen & plain].median(), "and a pixel beside it has not"


def test_low_resolution_depth_is_taken_at_its_own_pixel_centres():
    """Half size: a low-resolution centre lies amid four pixels, and inverse depth is linear on planes."""
    room = SyntheticRoom(hw=(240, 320), depth_hw=(120, 160), depth_noise=0.0, image_noise=0.0)
    full = 1 / room.truth(0)["depth"][0]
    four = torch.stack((full[::2, ::2], full[1::2, ::2], full[::2, 1::2], full[1::2, 1::2]))
    low = room[0].depth[0]
    bend = (full[1:-1, 2:] + full[1:-1, :-2] - 2 * full[1:-1, 1:-1]).abs()
    bend = bend + (full[2:, 1:-1] + full[:-2, 1:-1] - 2 * full[1:-1, 1:-1]).abs()
    bend = torch.nn.functional.pad(bend, (1, 1, 1, 1), value=1.0)
    bend = torch.nn.functional.max_pool2d(bend[None], 4, 2, 1)[0]  # over the four pixels and their neighbours
    flat = (low > 0) & (bend < 1e-5)
    error = (low * four.mean(0) - 1).abs()
    assert flat.double().mean() > 0.2
    assert error[flat].quantile(0.99) < 1e-5
    beside = (low * four[0] - 1).abs()
    assert beside[flat].median() > 10 * error[flat].median(), "half a pixel off is seen"


def test_options_do_what_they_say():
    exact = SyntheticRoom(n_frames=1, lidar="exact", **SMALL)
    assert torch.equal(exact[0].depth, exact.truth(0)["depth"])
    assert (exact[0].conf == 2).all() and exact[0].depth.shape == (1, 120, 160)
    none = SyntheticRoom(n_frames=1, lidar=None, image_noise=0.0, **SMALL)
    assert (none[0].depth == 0).all() and (none[0].conf == 0).all()
    clean, noisy = none[0].image.double(), SyntheticRoom(n_frames=1, image_noise=3.0, **SMALL)[0].image.double()
    assert 2.8 < (noisy - clean)[(clean > 20) & (clean < 235)].std() < 3.2
    other = SyntheticRoom(seed=1, n_frames=1, image_noise=0.0, **SMALL)
    assert (clean - other[0].image).abs().mean() > 5
    assert not torch.equal(none.truth(0)["depth"], other.truth(0)["depth"])
    assert not torch.equal(none.poses.t, other.poses.t)


@pytest.mark.parametrize(
    ("make", "wrong", "message"),
    [
        (open_room, {"near": 0}, "near is 0"),
        (open_room, {"gap": 0}, "gap is 0, expected a positive"),
        (open_room, {"seeed": 2}, "found option 'seeed'"),
        (SyntheticRoom, {"path": "jump"}, "path"),
        (SyntheticRoom, {"lidar": "radar"}, "lidar"),
        (SyntheticRoom, {"n_frames": 0}, "n_frames"),
        (SyntheticRoom, {"hw": (0, 4)}, "hw"),
        (SyntheticRoom, {"range_limit": -1.0}, "range_limit"),
        (lambda **frame: SyntheticRoom(n_frames=2, **SMALL).truth(frame["i"]), {"i": 2}, "2"),
        (lambda **frame: SyntheticRoom(n_frames=2, **SMALL).truth(frame["i"]), {"i": -3}, "-3"),
    ],
)
def test_wrong_options_and_frames_that_are_not_there_are_named(make, wrong, message):
    with pytest.raises((ValueError, IndexError), match=message):
        make(**wrong)


@pytest.mark.slow
def test_same_seed_same_bits_in_any_order_and_process():
    first = SyntheticRoom(n_frames=4, **SMALL)
    frames = [first[i] for i in range(4)]
    furnished_room.cache_clear()
    again = SyntheticRoom(n_frames=9, **SMALL)
    for i in (3, 0):
        frame = again[i]
        assert torch.equal(frame.image, frames[i].image)
        assert torch.equal(frame.depth, frames[i].depth) and torch.equal(frame.conf, frames[i].conf)
        assert torch.equal(again.truth(i)["depth"], first.truth(i)["depth"])
        assert torch.equal(again.poses.R[i], first.poses.R[i]) and torch.equal(again.poses.t[i], first.poses.t[i])
    carried = pickle.loads(pickle.dumps(first))
    assert len(pickle.dumps(first)) < frames[0].image.numel(), "a worker renders what it needs"
    assert torch.equal(carried[-1].image, frames[3].image)


def test_number_of_threads_changes_no_bit():
    """A picture large enough to be shared out, and the light of a small scene."""
    whole = furnished_room(2).solids.each
    light = Light((0.0, -2.5, 2.0), (0.3, 0, 0), (0, 0, 0.3), (0, 1, 0), (1.0, 1.0, 1.0))
    seen = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            scene = ShadedRoom([whole[0], whole[1], next(s for s in whole if s.ball)], [light], ambient=0.4, seed=0)
            room = SyntheticRoom(n_frames=1, **SMALL)
            seen.append([scene.light.values, room[0].image, room[0].depth, room[0].conf, room.truth(0)["depth"]])
        finally:
            torch.set_num_threads(1)
    shared_out = 1 << 15  # elements from which torch shares an operation out
    assert 9 * len(seen[0][0]) > shared_out, "light: nine rays from every node at a time"
    assert 4 * seen[0][1][0, 0].numel() > shared_out, "picture: four rays in every pixel at a time"
    for one, two in zip(*seen, strict=True):
        assert torch.equal(one, two)


def lidar(room, seed=0, **options):
    pose, cam = room.poses[:1], camera.resize(room.camera, room.hw, (96, 128))
    generator = torch.Generator().manual_seed(seed)
    return simulate_phone_lidar(furnished_room(room.seed), cam, pose, (96, 128), generator=generator, **options)


def low_truth(room):
    """Depth and surface at the pixel centres of a 96×128 depth map."""
    low = SyntheticRoom(n_frames=1, hw=(96, 128))
    low.camera = camera.resize(room.camera, room.hw, (96, 128))
    truth = low.truth(0)
    return truth["depth"][0], truth["surface"][0]


def test_lidar_fails_on_mirror_window_dark_surfaces_and_edges(room):
    depth, surface = low_truth(room)
    answered = torch.stack([lidar(room, s)[0][0] > 0 for s in range(4)]).double().mean(0)
    share = {name: answered[surface == kind].mean() for kind, name in SURFACE_NAMES.items()}
    assert share["ordinary"] > 0.7
    assert share["mirror"] < 0.3 and share["window"] < 0.3 and share["dark"] < 0.4
    patch = torch.nn.functional.unfold(depth[None, None], 3, padding=1).reshape(9, 96, 128)[:, 1:-1, 1:-1]
    jump = (patch.amax(0) > 1.3 * patch.amin(0)) & (surface[1:-1, 1:-1] == SURFACE_ORDINARY) & (depth[1:-1, 1:-1] < 2)
    calm = (patch.amax(0) < 1.1 * patch.amin(0)) & (surface[1:-1, 1:-1] == SURFACE_ORDINARY) & (depth[1:-1, 1:-1] < 2)
    inner = answered[1:-1, 1:-1]
    assert jump.sum() > 100
    assert inner[jump].mean() < 0.75 < 0.95 < inner[calm].mean()


def test_lidar_sees_the_room_behind_the_mirror(room):
    depth, surface = low_truth(room)
    reported, conf = lidar(room, range_limit=50.0, noise_factor=0.0)
    echo = (surface == SURFACE_MIRROR) & (reported[0] > 0)
    assert echo.sum() > 5
    assert (reported[0][echo] > depth[echo] + 0.3).all() and (conf[0][echo] == 0).all()


def test_lidar_confidence_and_noise_follow_range(room):
    depth, surface = low_truth(room)
    draws = [lidar(room, s) for s in range(12)]
    conf = torch.stack([c[0] for _, c in draws])
    reported = torch.stack([d[0] for d, _ in draws])
    assert conf.unique().tolist() == [0, 1, 2]
    assert (conf[reported == 0] == 0).all()
    plain = surface == SURFACE_ORDINARY
    near, far = plain & (depth < 2), plain & (depth > 3.5)
    assert conf[:, near].double().mean() > 1.5 > conf[:, far].double().mean()

    def noise(mask):
        use = (conf > 0) & mask
        return ((reported - depth).abs() * use).sum() / use.sum() * 1.2533  # mean |x| of a normal is 0.798 sigma

    assert 0.003 < noise(near) < 0.02 and 0.02 < noise(far) < 0.15
    sure = conf > 0
    assert ((reported / depth - 1)[sure & near]).abs().median() < 0.01
    assert ((reported / depth - 1)[sure & near]).mean().abs() < 0.003, "no bias"


def test_lidar_range_limit_is_along_the_ray(room):
    depth, _ = low_truth(room)
    reported, conf = lidar(room, range_limit=2.5, noise_factor=0.0)
    cam = camera.resize(room.camera, room.hw, (96, 128)).to(torch.float64)
    length = camera.rays(cam, pixels((96, 128))).norm(dim=-1).reshape(96, 128)
    assert (reported[0] * length).max() <= 2.5 + 1e-5 and (reported > 0).any()
    assert (reported[0][depth * length > 3.2] > 0).sum() == 0
    weak = (reported[0] > 0) & (reported[0] * length > 0.9 * 2.5)
    assert weak.any() and (conf[0][weak] < 2).all()


@pytest.mark.parametrize("path", CAMERA_PATHS)
def test_paths_stay_in_the_room_and_keep_their_word(path):
    scene = open_room(path=path, n_frames=300, seed=3)
    room = scene.recording
    R, t = room.poses.R, room.poses.t
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(300, 3, 3), atol=1e-12, rtol=0)
    assert (torch.linalg.det(R) > 0).all()
    assert (
        t[:, 0].min() > ROOM_LEFT_M + 0.5
        and t[:, 0].max() < ROOM_RIGHT_M - 0.5
        and t[:, 2].min() > 0
        and t[:, 2].max() < 1.2
    )
    turn = se3.rotation_angle(R[:-6].mT @ R[6:]).rad2deg()
    way = (t[6:] - t[:-6]).norm(dim=-1)
    assert turn.max() < 15 and way.max() < 0.25
    if path in ("rotation", "static"):
        assert way.max() == 0 and scene.role == "rotation"
        assert turn.median() > 2 if path == "rotation" else turn.max() == 0
    else:
        assert way[:6].min() > 0.08 and way[:6].max() < 0.2 and scene.role is None
    if path in ("lateral", "forward"):
        assert turn.max() < 1e-5
        along = ((t[6] - t[0]) / way[0]) @ R[0]  # direction of motion in the camera
        assert along[0].abs() > 0.95 if path == "lateral" else along[2] > 0.95


def test_every_default_frame_has_a_near_and_a_far_part():
    scene = open_room(**SMALL)
    room = scene.recording
    assert len(room) - scene.gap >= 6
    for i in range(len(room)):
        depth = room.truth(i)["depth"]
        assert 0.2 < (depth < scene.near).double().mean() < 0.5
        assert depth.max() < 6


def test_detail_to_track_is_near_and_far_and_absent_on_the_blank_wall(room):
    grey = cv2.cvtColor(room[0].image[0].permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, 2000, 0.01, 4)[:, 0].astype(int)
    depth = room.truth(0)["depth"][0][corners[:, 1], corners[:, 0]]
    assert (depth < 2).sum() > 150 and (depth > 2).sum() > 300
    x = world_points(room, 0)[0, :, 0].reshape(240, 320)
    wall = torch.nn.functional.max_pool2d((x < ROOM_RIGHT_M - 1e-4).float()[None], 9, 1, 4)[0] == 0  # and all around it
    slope = torch.from_numpy(cv2.cornerMinEigenVal(grey, 5)).double()
    assert wall.sum() > 100
    assert slope[wall].median() < 0.02 * slope.median()


def test_picture_is_antialiased():
    """Nine times the rays change the picture little: what is sampled is band-limited already."""
    fine, usual, coarse = (
        SyntheticRoom(n_frames=1, image_noise=0, supersample=s, **SMALL)[0].image.double() for s in (6, 2, 1)
    )
    assert (usual - fine).square().mean().sqrt() < 6
    assert (usual - fine).square().mean() < 0.5 * (coarse - fine).square().mean()


def test_all_kinds_of_surface_are_in_view(room):
    surface = room.truth(0)["surface"]
    for kind in (SURFACE_MIRROR, SURFACE_WINDOW, SURFACE_DARK):
        assert (surface == kind).double().mean() > 0.01
    image = room[0].image.double().mean(1)
    assert image[surface == SURFACE_DARK].mean() < 40 and image[surface == SURFACE_WINDOW].mean() > 180
