"""The built-in room: exact geometry, a sensor that fails where sensors fail, the same bits every time."""

import math
import pickle
from functools import partial

import cv2
import pytest
import torch
from torch.nn.functional import grid_sample, max_pool2d, pad, unfold

from dhtorch.geometry import camera, se3
from dhtorch.pytree import collate
from dhtorch.synthetic import depth_faults as faults
from dhtorch.synthetic.paths import CAMERA_PATHS, hand_held_path, reported_poses
from dhtorch.synthetic.raycast import SURFACE_DARK, SURFACE_MIRROR, SURFACE_ORDINARY, SURFACE_WINDOW
from dhtorch.synthetic.recording import SURFACE_NAMES, SyntheticRoom, open_room, simulate_phone_lidar
from dhtorch.synthetic.room import _ROOM_HEIGHT_M, ROOM_BACK_M, ROOM_FRONT_M, ROOM_LEFT_M, ROOM_RIGHT_M, furnished_room
from dhtorch.synthetic.shading import Light, ShadedRoom

SMALL = {"hw": (120, 160), "depth_hw": (48, 64)}
close = partial(torch.testing.assert_close, rtol=0)


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
    value = grid_sample(image.double(), grid[:, None], align_corners=False)
    return value[0, :, 0], (grid.abs() < 0.97).all(-1)[0]


def test_frame_keeps_the_promises_of_the_record():
    room = SyntheticRoom(n_frames=3, **SMALL)
    frame = collate([room[0], room[1], room[2]])
    shapes = {name: (tuple(x.shape), x.dtype) for name, x in vars(frame).items() if isinstance(x, torch.Tensor)}
    assert shapes == {
        "image": ((3, 3, 120, 160), torch.uint8), "depth": ((3, 48, 64), torch.float32),
        "conf": ((3, 48, 64), torch.uint8), "time": ((3,), torch.float64),
    }  # fmt: skip
    assert torch.equal(frame.time, room.times)
    close(frame.T_world_from_cam.t, room.poses.t.float(), atol=1e-6)
    expected = camera.resize(room.camera, (120, 160), (48, 64))
    assert torch.equal(frame.depth_camera[0:1].c, expected.c) and torch.equal(frame.depth_camera[0:1].f, expected.f)


def test_true_depth_lies_on_the_walls_of_the_room(room):
    xyz = world_points(room, 0)[0]
    low, high = torch.tensor([[ROOM_LEFT_M, -_ROOM_HEIGHT_M, ROOM_FRONT_M], [ROOM_RIGHT_M, 0.0, ROOM_BACK_M]]).double()
    assert (xyz > low - 1e-3).all() and (xyz < high + 1e-3).all()
    on_wall = ((xyz - high).abs() < 1e-5).double().mean(0)
    assert on_wall[2] > 0.15 and on_wall[0] > 0.01, "the brick wall is a plane and fills part of the view"


@pytest.mark.parametrize("j", [6, 11])
def test_a_world_point_is_the_same_point_in_another_frame(room, j):
    """Depth and colour of frame 0, carried to frame j by camera and pose, agree with frame j where it sees the point."""
    in_j = se3.apply(se3.invert(room.poses[j : j + 1]), world_points(room, 0))
    uv, truth = camera.project(room.camera.to(torch.float64), in_j), room.truth(j)
    inverse, inside = sample(1 / truth["depth"][:, None], uv)
    disagree = (in_j[0, :, 2] * inverse[0] - 1).abs()
    seen = inside & (disagree < 0.01)
    assert seen.double().sum() > 0.8 * inside.double().sum(), "most points stay visible"
    assert disagree[seen].median() < 2e-5
    surface = room.truth(0)["surface"].reshape(-1) + sample(truth["surface"][:, None], uv)[0][0]
    plain = seen & (surface == 2 * SURFACE_ORDINARY)
    grey = room[0].image[0].reshape(3, -1)
    error, wrong = ((sample(room[j].image, uv + shift)[0] - grey).abs().mean(0)[plain].median() for shift in (0.0, 1.5))
    assert error < 4, "grey levels: the same surface has the same colour"
    assert wrong > 2 * error, "and a pixel beside it has not"


def test_low_resolution_depth_is_taken_at_its_own_pixel_centres():
    """Half size: a low-resolution centre lies amid four pixels, and inverse depth is linear on planes."""
    room = SyntheticRoom(hw=(240, 320), depth_hw=(120, 160), depth_noise=0.0, image_noise=0.0)
    full, low = 1 / room.truth(0)["depth"][0], room[0].depth[0]
    four = unfold(full[None, None], 2, stride=2).view(4, 120, 160)
    middle = 2 * full[1:-1, 1:-1]
    bend = (full[1:-1, 2:] + full[1:-1, :-2] - middle).abs() + (full[2:, 1:-1] + full[:-2, 1:-1] - middle).abs()
    bend = max_pool2d(pad(bend, (1, 1, 1, 1), value=1.0)[None], 4, 2, 1)[0]  # over the four pixels and their neighbours
    flat = (low > 0) & (bend < 1e-5)
    error, beside = ((low * inverse - 1).abs()[flat] for inverse in (four.mean(0), four[0]))
    assert flat.double().mean() > 0.2 and error.quantile(0.99) < 1e-5
    assert beside.median() > 10 * error.median(), "half a pixel off is seen"


def test_options_do_what_they_say():
    one = partial(SyntheticRoom, n_frames=1, **SMALL)
    exact, none = one(lidar="exact"), one(lidar=None, image_noise=0.0)
    assert torch.equal(exact[0].depth, exact.truth(0)["depth"]) and (exact[0].conf == 2).all()
    assert (none[0].depth == 0).all() and (none[0].conf == 0).all()
    clean, noisy = none[0].image.double(), one(image_noise=3.0)[0].image.double()
    assert 2.8 < (noisy - clean)[(clean > 20) & (clean < 235)].std() < 3.2
    other = one(seed=1, image_noise=0.0)
    assert (clean - other[0].image).abs().mean() > 5
    assert not torch.equal(none.truth(0)["depth"], other.truth(0)["depth"])
    assert not torch.equal(none.poses.t, other.poses.t)
    # Nine times the rays change an image little: what is sampled is band-limited already.
    fine, usual, coarse = (one(image_noise=0, supersample=n)[0].image.double() for n in (6, 2, 1))
    square = (usual - fine).square().mean()
    assert square.sqrt() < 6 and square < 0.5 * (coarse - fine).square().mean()


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
        (SyntheticRoom(n_frames=2, **SMALL).truth, {"index": 2}, "2"),
        (SyntheticRoom(n_frames=2, **SMALL).truth, {"index": -3}, "-3"),
    ],
)
def test_wrong_options_and_frames_that_are_not_there_are_named(make, wrong, message):
    with pytest.raises((ValueError, IndexError), match=message):
        make(**wrong)


def everything(room, i):
    frame = room[i]
    return [frame.image, frame.depth, frame.conf, room.truth(i)["depth"], room.poses.R[i], room.poses.t[i]]


@pytest.mark.slow
def test_same_seed_same_bits_in_any_order_and_process():
    first = SyntheticRoom(n_frames=4, **SMALL)
    frames = [everything(first, i) for i in range(4)]
    furnished_room.cache_clear()
    again = SyntheticRoom(n_frames=9, **SMALL)
    for i in (3, 0):
        close(everything(again, i), frames[i], atol=0)
    packed = pickle.dumps(first)
    assert len(packed) < frames[0][0].numel(), "a worker renders what it needs"
    assert torch.equal(pickle.loads(packed)[-1].image, frames[3][0])


def test_number_of_threads_changes_no_bit():
    """An image large enough to be split among threads, and the light of a small scene."""
    whole, seen = furnished_room(2).solids.each, []
    light = Light((0.0, -2.5, 2.0), (0.3, 0, 0), (0, 0, 0.3), (0, 1, 0), (1.0, 1.0, 1.0))
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            scene = ShadedRoom([whole[0], whole[1], next(s for s in whole if s.ball)], [light], ambient=0.4, seed=0)
            seen.append([scene.light.values, *everything(SyntheticRoom(n_frames=1, **SMALL), 0)])
        finally:
            torch.set_num_threads(1)
    split = 1 << 15  # elements from which torch splits an operation
    assert 9 * len(seen[0][0]) > split, "light: nine rays from every node at a time"
    assert 4 * seen[0][1][0, 0].numel() > split, "image: four rays in every pixel at a time"
    close(*seen, atol=0)


# ------------------------------------------------------------------------------------------------------------- sensor


def lidar(room, seed=0, **options):
    cam, generator = camera.resize(room.camera, room.hw, (96, 128)), torch.Generator().manual_seed(seed)
    return simulate_phone_lidar(
        furnished_room(room.seed), cam, room.poses[:1], (96, 128), generator=generator, **options
    )


@pytest.fixture(scope="module")
def low(room):
    """Depth and surface at the pixel centres of a 96×128 depth map, and the length of their rays."""
    small = SyntheticRoom(n_frames=1, hw=(96, 128))
    small.camera = camera.resize(room.camera, room.hw, (96, 128))
    length = camera.rays(small.camera.to(torch.float64), pixels((96, 128))).norm(dim=-1).reshape(96, 128)
    return small.truth(0)["depth"][0], small.truth(0)["surface"][0], length


def test_lidar_fails_on_mirror_window_dark_surfaces_and_edges(room, low):
    depth, surface, _ = low
    answered = torch.stack([lidar(room, s)[0][0] > 0 for s in range(4)]).double().mean(0)
    fraction = {name: answered[surface == kind].mean() for kind, name in SURFACE_NAMES.items()}
    assert fraction["ordinary"] > 0.7
    assert fraction["mirror"] < 0.3 and fraction["window"] < 0.3 and fraction["dark"] < 0.4
    patch = unfold(depth[None, None], 3, padding=1).reshape(9, 96, 128)[:, 1:-1, 1:-1]
    plain, inner = ((surface == SURFACE_ORDINARY) & (depth < 2))[1:-1, 1:-1], answered[1:-1, 1:-1]
    jump, calm = plain & (patch.amax(0) > 1.3 * patch.amin(0)), plain & (patch.amax(0) < 1.1 * patch.amin(0))
    assert jump.sum() > 100 and inner[jump].mean() < 0.75 < 0.95 < inner[calm].mean()
    reported, conf = (x[0] for x in lidar(room, range_limit=50.0, noise_factor=0.0))
    echo = (surface == SURFACE_MIRROR) & (reported > 0)
    assert echo.sum() > 5 and (reported[echo] > depth[echo] + 0.3).all() and (conf[echo] == 0).all()


def test_lidar_confidence_and_noise_follow_range(room, low):
    depth, surface, length = low
    reported, conf = (torch.cat(x) for x in zip(*(lidar(room, s) for s in range(12)), strict=True))
    assert conf.unique().tolist() == [0, 1, 2] and (conf[reported == 0] == 0).all()
    near, far = ((surface == SURFACE_ORDINARY) & mask for mask in (depth < 2, depth > 3.5))
    assert conf[:, near].double().mean() > 1.5 > conf[:, far].double().mean()
    noise = [
        ((reported - depth).abs() * used).sum() / used.sum() * 1.2533 for used in ((conf > 0) & m for m in (near, far))
    ]
    assert 0.003 < noise[0] < 0.02 and 0.02 < noise[1] < 0.15, "mean |x| of a normal is 0.798 sigma"
    error = (reported / depth - 1)[(conf > 0) & near]
    assert error.abs().median() < 0.01 and error.mean().abs() < 0.003, "no bias"
    (limited,), (level,) = lidar(room, range_limit=2.5, noise_factor=0.0)
    assert (limited * length).max() <= 2.5 + 1e-5 and (limited > 0).any(), "the range limit is along the ray"
    assert (limited[depth * length > 3.2] > 0).sum() == 0
    weak = (limited > 0) & (limited * length > 0.9 * 2.5)
    assert weak.any() and (level[weak] < 2).all()


# ------------------------------------------------------------------------------------------------- paths and the view


@pytest.mark.parametrize("path", CAMERA_PATHS)
def test_paths_stay_in_the_room_and_keep_their_word(path):
    scene = open_room(path=path, n_frames=300, seed=3)
    R, t = scene.recording.poses.R, scene.recording.poses.t
    close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(300, 3, 3), atol=1e-12)
    assert (torch.linalg.det(R) > 0).all()
    assert ((t[:, 0] > ROOM_LEFT_M + 0.5) & (t[:, 0] < ROOM_RIGHT_M - 0.5) & (t[:, 2] > 0) & (t[:, 2] < 1.2)).all()
    turn = se3.rotation_angle(R[:-6].mT @ R[6:]).rad2deg()
    way = (t[6:] - t[:-6]).norm(dim=-1)
    assert turn.max() < 15 and way.max() < 0.25
    if path in ("rotation", "static"):
        assert way.max() == 0 and scene.role == "rotation"
        assert turn.median() > 2 if path == "rotation" else turn.max() == 0
    else:
        assert way[:6].min() > 0.08 and way[:6].max() < 0.2 and scene.role is None
    if path in ("lateral", "forward"):
        along = ((t[6] - t[0]) / way[0]) @ R[0]  # direction of motion in the camera
        assert turn.max() < 1e-5 and (along[0].abs() > 0.95 if path == "lateral" else along[2] > 0.95)


def test_every_default_frame_has_a_near_and_a_far_part():
    scene = open_room(**SMALL)
    assert len(scene.recording) - scene.gap >= 6
    for i in range(len(scene.recording)):
        depth = scene.recording.truth(i)["depth"]
        assert 0.2 < (depth < scene.near).double().mean() < 0.5 and depth.max() < 6


def test_detail_to_track_is_near_and_far_and_absent_on_the_blank_wall(room):
    truth = room.truth(0)
    grey = cv2.cvtColor(room[0].image[0].permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, 2000, 0.01, 4)[:, 0].astype(int)
    depth = truth["depth"][0][corners[:, 1], corners[:, 0]]
    assert (depth < 2).sum() > 150 and (depth > 2).sum() > 300
    x = world_points(room, 0)[0, :, 0].reshape(240, 320)
    wall = max_pool2d((x < ROOM_RIGHT_M - 1e-4).float()[None], 9, 1, 4)[0] == 0  # and all around it
    slope = torch.from_numpy(cv2.cornerMinEigenVal(grey, 5)).double()
    assert wall.sum() > 100 and slope[wall].median() < 0.02 * slope.median()
    fraction = {kind: (truth["surface"] == kind).double().mean() for kind in SURFACE_NAMES}
    assert min(fraction.values()) > 0.01, "all kinds of surface are in view"
    dark, bright = (
        room[0].image.double().mean(1)[truth["surface"] == x].mean() for x in (SURFACE_DARK, SURFACE_WINDOW)
    )
    assert dark < 40 and bright > 180


def degrees(a, b):
    return se3.rotation_angle(a.R.mT @ b.R) * 180 / math.pi


def test_a_device_reports_its_trajectory_late_turned_drifting_and_noisy():
    poses, times = hand_held_path("walk", 40, step_m=0.02, rate_hz=30.0, seed=1), torch.arange(40).double() / 30
    report = partial(reported_poses, poses, times)
    same = report()
    assert torch.equal(same.R, poses.R) and torch.equal(same.t, poses.t)
    close(degrees(poses, report(offset_deg=5.0)), torch.full((40,), 5.0).double(), atol=1e-6)
    close(degrees(poses, report(drift_deg_per_s=3.0)), 3.0 * times, atol=1e-6)
    noisy, again = (report(rotation_noise_deg=1.0, seed=seed) for seed in (3, 4))
    assert 1.2 < degrees(poses, noisy).square().mean().sqrt() < 2.3, "three axes of one degree each"
    assert not torch.equal(again.R, noisy.R)
    late, half = report(lag_s=2 / 30), report(lag_s=0.5 / 30)
    close(late.t[2:], poses.t[:-2], atol=1e-9)
    close(late.R[2:], poses.R[:-2], atol=1e-6)
    assert torch.equal(late.t[0], poses.t[0]), "before the first frame it is the first"
    close(half.t[1:], (poses.t[1:] + poses.t[:-1]) / 2, atol=1e-9)
    close(degrees(poses[1:], half[1:]), degrees(half[1:], poses[:-1]), atol=1e-5)


def test_the_room_reports_a_devices_trajectory_and_keeps_the_truth():
    true = SyntheticRoom(hw=(24, 32), n_frames=6)
    room = SyntheticRoom(hw=(24, 32), n_frames=6, trajectory_lag_s=1 / 30, trajectory_drift_deg_per_s=2.0)
    assert torch.equal(room.true_poses.R, true.true_poses.R) and not torch.equal(room.poses.R, true.poses.R)
    assert torch.equal(room[3].image, true[3].image)
    close(room.poses.t[3], true.poses.t[2], atol=1e-9)


# ------------------------------------------------------------------------------------------------------ faults of maps

#: Two maps: a slanted wall with a box before it, and a strip without returns.
WALL = torch.linspace(2, 4, 64, dtype=torch.float64).expand(2, 48, 64).clone()
WALL[:, 16:32, 20:40] = 1.0
WALL[:, :, 60:] = 0
KNOWN = WALL > 0


@pytest.mark.parametrize("name", faults.DEPTH_FAULTS)
def test_a_fault_is_the_same_alone_and_in_a_batch(name):
    both, wrong = faults.apply_fault(name, WALL, seed=3)
    alone, _ = faults.apply_fault(name, WALL[:1], seed=3)
    assert both.shape == wrong.shape == WALL.shape and torch.equal(both[:1], alone)
    assert (both >= 0).all() and both.isfinite().all()
    assert wrong.any() or (name == "quantised" and (both != WALL).any())
    assert name not in faults.NETWORK_FAULTS or torch.equal(both > 0, KNOWN), "holes stay where they are"


def test_sizes_of_faults():
    log = (faults.apply_fault("warp_large", WALL)[0] / WALL)[KNOWN].log()
    assert 0.02 < log.std() < 0.08 and log.abs().mean() > 0.01
    jumped, wrong = faults.apply_fault("jumps", WALL, seed=1)
    close(jumped, torch.where(wrong, 3.0, 1.0) * WALL, atol=1e-6)
    q = 1 / faults.apply_fault("quantised", WALL)[0][KNOWN] * faults._FOCAL_BASELINE_PX_M / faults._DISPARITY_STEP_PX
    assert torch.allclose(q, q.round(), atol=1e-6)
    magnified, smaller = (faults.rescale_field_of_view(WALL, factor) for factor in (2.0, 0.5))
    assert magnified[0, 0, 0] == WALL[0, 12, 16] and (smaller[:, 0] == 0).all()
    for found, expected in (
        (faults.apply_fault("unit", WALL)[0], 5 * WALL),
        (faults.mirror_depth(faults.mirror_depth(WALL)), WALL),
        (faults.apply_fault("rolled", WALL)[0][..., 6:], WALL[..., :58]),
        (faults.apply_fault("time", WALL, other=WALL * 1.1), (WALL * 1.1, KNOWN)),
    ):
        close(found, expected, atol=0)


@pytest.mark.parametrize(
    ("name", "depth", "message"),
    [("drift", WALL, "expected one of scale_short"), ("time", WALL, "other="), ("shift", WALL[0], "B h w")],
)
def test_bad_requests_say_what_was_expected(name, depth, message):
    with pytest.raises(ValueError, match=message):
        faults.apply_fault(name, depth)
