"""Every stress of the built-in room does what it says, and nothing else."""

import math
import pickle
from functools import cache, partial

import pytest
import torch
from torch.nn.functional import grid_sample, interpolate

from dhtorch import extend
from dhtorch.experiments import protocol
from dhtorch.geometry import camera, se3
from dhtorch.stages.backproject import backproject
from dhtorch.stages.sample import spiral
from dhtorch.stages.track import lucas_kanade
from dhtorch.synthetic import guests, stress
from dhtorch.synthetic.raycast import SURFACE_MOVING, SURFACE_ORDINARY, Material, Solid
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.room import furnished_room
from dhtorch.synthetic.stress import STRESSES, StressRoom, open_stress

SMALL = {"hw": (96, 128), "n_frames": 8, "supersample": 1, "depth_hw": (96, 128)}
NEAR, SLOW = 2.0, pytest.mark.slow
MOVING_ROOMS = [name for name, of in STRESSES.items() if of.moving]
TURNED_ROOMS = [name for name, of in STRESSES.items() if of.turn]
same = partial(torch.testing.assert_close, atol=0, rtol=0)


@pytest.fixture(scope="module")
def walk():
    return SyntheticRoom(**SMALL)


@cache
def room(name, **options):
    return StressRoom(name, **SMALL | options)


def near(frame):
    return (frame.depth > 0) & (frame.depth <= NEAR)


def relative(recording, i, j):
    return se3.relative(recording.true_poses[i : i + 1], recording.true_poses[j : j + 1])


def degrees(R):
    return se3.rotation_angle(R).rad2deg()


def test_one_recording_for_each_stress_with_its_role_and_cutoff():
    rooms = open_stress(hw=(48, 64), n_frames=7)
    assert [r.name for r in rooms] == [f"stress_{name}" for name in STRESSES]
    roles = {name: {r.recording.stress for r in rooms if r.role == name} for name in ("rotation", "moving")}
    assert roles == {"rotation": {"rotation", "rotation_exact", *TURNED_ROOMS}, "moving": {*MOVING_ROOMS}}
    cutoff = {r.recording.stress: r.near for r in rooms}
    assert cutoff["fast"] == cutoff["held_object"] == NEAR and cutoff["convoy"] == cutoff["turntable"] == 1.3
    assert open_stress(["convoy"], hw=(48, 64), n_frames=7, near=0.9)[0].near == 0.9
    with pytest.raises(ValueError, match="earthquake"):
        open_stress(["earthquake"])


@pytest.mark.parametrize("name", ["rotation", "rotation_exact", "lateral", "forward", "orbit"])
def test_paths_go_where_they_say(name):
    T = relative(room(name), 0, 6)
    way, is_rotation = T.t.norm(), name.startswith("rotation")
    assert way < 1e-12 if is_rotation else way > 0.08
    assert bool(T.t[0, 2].abs() > 0.9 * way) == (name == "forward") or is_rotation
    assert bool(degrees(T.R) > 2) == (is_rotation or name == "orbit")
    if name == "rotation_exact":
        same(room(name)[2].depth, room(name).truth(2)["depth"])


# -------------------------------------------------------------------------------------------------- sensor and tracks


def test_planar_points_are_planar(walk):
    exact = SyntheticRoom(**SMALL | {"lidar": None})  # same size, same camera
    for i in (0, 3):
        frame, kept, others = room("planar_near")[i], near(room("planar_near")[i]), ~near(walk[i])
        assert 100 < kept.sum() < 0.7 * near(walk[i]).sum()
        same(frame.depth[others], walk[i].depth[others])
        v, u = kept[0].nonzero().unbind(-1)
        true = exact.truth(i)["depth"][0, v, u].double()[None]
        xyz = camera.unproject(frame.depth_camera.to(torch.float64), torch.stack((u, v), -1)[None].double(), true)[0]
        spread = torch.linalg.svdvals(xyz - xyz.mean(0))
        assert spread[2] < 1e-5 * spread[0] and spread[1] > 0.05 * spread[0]
        assert ((frame.depth[0, v, u] / true[0] - 1).abs() < 0.05).all()


@pytest.mark.parametrize("places", [None, partial(spiral, foveation=1.0)])
def test_only_twenty_near_returns_remain(walk, places):
    few = room("few_near", places=places, n_places=512)
    kept, others = near(few[1]), ~near(walk[1])
    assert kept.sum() == stress._N_FEW_NEAR
    for mask in (kept, others):
        same(few[1].depth[mask], walk[1].depth[mask])
    if places is not None:  # each of them is read
        depth = backproject(few[1], spiral(few.hw, 512)).depth
        assert len(depth[(depth > 0) & (depth <= NEAR)].unique()) == stress._N_FEW_NEAR


def test_noise_of_depth_and_moved_squares(walk):
    depth, known = room("depth_noise")[0].depth, walk[0].depth > 0
    same(depth > 0, known)
    assert 0.02 < (depth[known] / walk[0].depth[known] - 1).std() < 0.03
    moved = room("moved")
    same((moved[5].image, moved[7].depth), (walk[5].image, walk[7].depth))
    assert 0.2 < (moved[7].image != walk[7].image).any(1).float().mean() < 0.35


def test_three_in_ten_tracks_end_elsewhere_and_no_other_field_shows_it(walk):
    spoiled = room("mistracks")
    same(spoiled[7].image, walk[7].image)
    assert room("rolling_shutter").spoil_track(lucas_kanade) is lucas_kanade
    uv = spiral(spoiled.hw, 512)[None].expand(2, -1, -1)
    images = [torch.cat((spoiled[i].image, spoiled[i + 1].image)) for i in (0, 6)]
    track = spoiled.spoil_track(lucas_kanade)
    a, b, alone = lucas_kanade(*images, uv), track(*images, uv), track(*(x[1:] for x in images), uv[1:])
    shift = (b.uv_1 - a.uv_1).norm(dim=-1)
    low, high = (px * 128 / 640 for px in stress._MOVED_RANGE_PX)
    assert 0.25 < (shift > 0).float().mean() < 0.35
    assert low - 1e-3 < shift[shift > 0].min() and shift.max() < high + 1e-3
    assert not torch.equal(shift[0] > 0, shift[1] > 0)
    same((a.error, a.photometric, a.valid, a.cov), (b.error, b.photometric, b.valid, b.cov))
    same(alone.uv_1[0], b.uv_1[1])


@pytest.mark.slow
def test_experiments_use_the_spoiled_tracker():
    ends = []

    def columns(answer):
        ends.append(answer.trace["tracks"].uv_1)
        return {}

    variant = protocol.Variant(extend.replace(n=256))
    study = protocol.Protocol({"any": variant}, columns=columns, min_candidates=0)
    protocol.run([SyntheticRoom(**SMALL), room("mistracks")], study, lambda _: [(0, 6)], protocol.Settings())
    assert 0.2 < ((ends[0] - ends[1]).norm(dim=-1) > 0).float().mean() < 0.4


# ------------------------------------------------------------------------------------------------------------- bodies


def seen(recording, i):
    """Of every pixel of frame i: its place in the world (H·W, 3) float64, its surface, its grey levels (H·W, 3)."""
    h, w = recording.hw
    uv = torch.cartesian_prod(torch.arange(h), torch.arange(w)).flip(-1)[None].double()
    truth = recording.truth(i)
    xyz = camera.unproject(recording.camera.to(torch.float64), uv, truth["depth"].double().reshape(1, -1))
    world = se3.apply(recording.true_poses[i : i + 1], xyz)
    return world, truth["surface"].flatten(), recording[i].image[0].reshape(3, -1).T.double()


def carried(recording, i, j, motion=None):
    """Pixels of frame i in sight of frame j after a motion of the world: (kept,) mask, relative differences of depth
    from frame j's truth, of grey from frame j's image, and the surface there."""
    world, surface, grey = seen(recording, i)
    there = world if motion is None else se3.apply(motion, world)
    xyz = se3.apply(se3.invert(recording.true_poses[j : j + 1]), there)
    uv = camera.project(recording.camera.to(torch.float64), xyz)
    place = (2 * (uv + 0.5) / torch.tensor(recording.hw[::-1]) - 1)[:, None]
    truth = recording.truth(j)
    look = partial(grid_sample, grid=place, align_corners=False)
    inverse, image = (look(x.double())[0, :, 0] for x in (1 / truth["depth"][None], recording[j].image))
    depth = (xyz[0, :, 2] * inverse[0] - 1).abs()
    inside = (place.abs() < 0.95).all(-1).flatten()
    return (
        inside,
        depth,
        (image.T - grey).abs().mean(-1),
        surface,
        look(truth["surface"][None].double(), mode="nearest")[0, 0, 0],
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in MOVING_ROOMS if name != "convoy_lanes"])
def test_background_stands_and_the_body_moves_as_stated(name):
    """Truth against render: what is carried to another frame by the right motion has its depth and its grey there."""
    there, (i, j) = room(name, image_noise=0.0, supersample=2), (1, 7)
    T = se3.compose(there.body_poses[j : j + 1], se3.invert(there.body_poses[i : i + 1]))
    inside, depth, grey, surface, found = carried(there, i, j)
    ground = inside & (surface == SURFACE_ORDINARY) & (found == SURFACE_ORDINARY) & (depth < 0.01)
    assert ground.sum() > 3000 and depth[ground].median() < 2e-5 and grey[ground].median() < 6
    assert not (depth[inside & (surface == SURFACE_MOVING)] < 1e-4).double().mean() > 0.2, "it does not stand"
    inside, depth, grey, surface, found = carried(there, i, j, T)
    body = inside & (surface == SURFACE_MOVING)
    good = body & (found == SURFACE_MOVING) & (depth < 0.01)
    assert good.sum() > 0.85 * body.sum() > 1000
    assert depth[good].median() < 2e-5 and grey[good].median() < 6
    assert grey[inside & (surface == SURFACE_ORDINARY)].median() > 1.5 * grey[good].median() or name == "turntable"


def test_a_body_hides_what_is_behind_it_and_changes_nothing_else(walk):
    there, plain = room("convoy_slow"), walk.truth(3)["depth"]
    truth, image = there.truth(3), there[3].image
    body, ordinary = truth["surface"] == SURFACE_MOVING, truth["surface"] == SURFACE_ORDINARY
    assert 0.2 < body.double().mean() < 0.35 and (truth["depth"][body] < plain[body]).all()
    beside = ordinary[:, None].expand_as(image)
    same((truth["depth"][~body], image[beside]), (plain[~body], walk[3].image[beside]))
    assert image[~beside].double().std() > 20
    scene, size = furnished_room(2), ((0.0, -1.0, 1.0), (0.1, 0.1, 0.1))
    for solid, message in (
        (Solid(*size, Material("print")), "casts a shadow"),
        (Solid(*size, Material("zebra"), shadow=False), "zebra"),
    ):
        with pytest.raises(ValueError, match=message):
            scene.joined_by([solid])


def test_bodies_move_with_the_viewer_half_as_far_in_a_hand_or_on_a_turntable():
    way = room("convoy").true_poses.t.diff(dim=0)
    for name, fraction in (("convoy", 1.0), ("convoy_slow", 0.5)):
        body = room(name).body_poses
        assert torch.allclose(body.t.diff(dim=0), fraction * way, atol=1e-12)
        same(body.R, torch.eye(3, dtype=torch.float64).expand_as(body.R))
    held, table = room("held_object"), room("turntable")
    by_viewer = se3.compose(se3.invert(held.true_poses), held.body_poses)
    centre = se3.apply(guests._VIEWER_POSE, torch.tensor([[guests._CARRIED_CENTRE]]).double()).expand(8, 1, 3)
    middle = se3.apply(by_viewer, centre)
    assert 0.005 < (middle[6, 0] - middle[0, 0]).norm() < 0.05
    turned = degrees(by_viewer.R[6:] @ by_viewer.R[:2].mT)
    assert ((turned > 1) & (turned < 10)).all()
    same(table.true_poses.t[0], table.true_poses.t[7])
    angle = degrees(table.body_poses.R[1:] @ table.body_poses.R[:-1].mT)
    assert torch.allclose(angle, torch.full_like(angle, guests._TURN_DEG_PER_FRAME), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("convoy", 0.99, 1), ("convoy_slow", 0.99, 1), ("turntable", 0.99, 1), ("held_object", 0.35, 0.65)],
)
def test_near_returns_lie_on_the_body(name, least, most):
    there = open_stress([name], hw=(96, 128), n_frames=8)[0]
    for i in (0, 7):
        frame, truth = there.recording[i], there.recording.truth(i)
        kind = interpolate(truth["surface"][None].float(), frame.depth.shape[1:])[0]
        close = (frame.depth > 0) & (frame.depth <= there.near)
        assert close.double().mean() > 0.2 and least <= (kind[close] == SURFACE_MOVING).double().mean() <= most
        assert ((truth["depth"] > there.near) & (truth["surface"] != SURFACE_MOVING)).double().mean() > 0.4


def test_bodies_in_lanes_and_in_convoys_have_speeds_of_their_own():
    there = room("convoy_lanes")
    moved = (there.true_poses.t - there.true_poses.t[:1]).norm(dim=-1)
    lanes = (there.body_poses.t.unflatten(0, (8, 3)) - there.body_poses.t[:3]).norm(dim=-1)
    assert (lanes[1:].amin(1) > 0.2 * moved[1:]).all() and (lanes[1:].amax(1) < 0.75 * moved[1:]).all()
    home, now = (
        torch.tensor([s.centre for s in world.solids.each if s.surface.kind == SURFACE_MOVING], dtype=torch.float64)
        for world in (guests.room_with_body(2, "parcels"), there.world(5))
    )
    assert torch.allclose(now - home, there.body_poses.t[[15, 16, 17, 15, 16]], atol=1e-6)
    for name in ("convoy_oncoming", "convoy_uneven"):
        way, body = (poses.t.diff(dim=0) for poses in (room(name).true_poses, room(name).body_poses))
        fraction = (way * body).sum(-1) / way.square().sum(-1)
        assert fraction.max() - fraction.min() > 0.5


# ------------------------------------------------------------------------------------------------------------- images


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other():
    rolling = room("rolling_shutter", image_noise=0.0)
    first, last = rolling.bands[3][:1], rolling.bands[3][-1:]
    assert 0.5 < se3.relative(first, last).t.norm() / relative(rolling, 3, 4).t.norm() < 0.7  # 20 ms of 33 ms
    assert rolling[3].camera.readout.item() == pytest.approx(stress._READOUT_S)

    def seen_from(pose):
        still = SyntheticRoom(**SMALL | {"image_noise": 0.0, "n_frames": 1})
        still.true_poses = pose
        return still[0].image.int(), still.truth(0)["depth"]

    image = rolling[3].image.int()
    for pose, rows in ((first, slice(0, 3)), (last, slice(94, 96))):
        other, truth = seen_from(pose)
        assert (image[..., rows, :] - other[..., rows, :]).abs().max() <= 1
        assert torch.allclose(rolling.truth(3)["depth"][:, rows], truth[:, rows], rtol=1e-4)
    assert (image - seen_from(rolling.true_poses[3:4])[0]).abs().float().mean() > 0.5


@pytest.mark.parametrize("name", TURNED_ROOMS)
def test_a_hand_turns_the_camera_on_the_spot(name):
    turned, turn = room(name), STRESSES[name].turn
    T = [relative(turned, i, 7) for i in range(7)]
    assert 5 <= turn.degrees <= 40 and 0.8 * turn.degrees < degrees(T[0].R).item() < 1.2 * turn.degrees
    assert 0.5 * turn.reach_m < max(x.t.norm().item() for x in T) < 1.2 * turn.reach_m <= 0.036
    gains = [turned.gain(i) for i in range(8)]
    assert max(gains) / min(gains) > 1.3


def test_a_turned_image_is_smeared_and_its_depth_is_not():
    turned = room("rotation_hand_30", hw=(48, 64))
    still = SyntheticRoom(**SMALL | {"hw": (48, 64)}, true_poses=turned.true_poses)
    sharp = still._photograph(4, turned.camera, turned.true_poses[4:5], (48, 64), exposure=turned.gain(4))
    smeared, edges = (x.diff(dim=-1).abs().mean() for x in (turned._picture(4), sharp))
    assert smeared < 0.9 * edges
    depth = guests.room_with_body(2, "parcels").solids.view(turned.camera, turned.true_poses[4:5], (48, 64))[0]
    same(turned.truth(4)["depth"].flatten(), depth)


def test_fast_is_sixty_to_a_hundred_and_fifty_pixels_from_frame_to_partner():
    fast = room("fast")
    for i in (0, 1):
        world, cam = seen(fast, i)[0], fast.camera.to(torch.float64)
        a, b = (camera.project(cam, se3.apply(se3.invert(fast.true_poses[k : k + 1]), world)) for k in (i, i + 6))
        inside = ((b >= 0) & (b < torch.tensor([128, 96]))).all(-1)
        px = (b - a).norm(dim=-1)[inside] * 640 / 128
        assert inside.double().mean() > 0.7 and px.quantile(0.01) > 60 and px.quantile(0.99) < 150


def test_exposure_jumps_up_and_down_and_clips():
    jumping, plain = room("exposure_jump", image_noise=0.0), room("mistracks", image_noise=0.0)
    ratio = [jumping.gain(i + 6) / jumping.gain(i) for i in range(2)]
    assert 2 <= max(ratio) <= 4 and 2 <= 1 / min(ratio) <= 4 and plain.gain(0) == 1
    for i, clips in ((0, True), (1, False)):
        sharp, found = plain[i].image.double(), jumping[i].image.double()
        error = (found - (sharp * jumping.gain(i)).clamp(max=255)).abs()
        assert error[sharp < 255].max() <= 0.5 + 0.5 * jumping.gain(i) + 1e-6  # brighter ones show in a darker image
        assert ((found == 255).double().mean() > 0.1) == clips


def test_a_smeared_image_is_the_mean_of_the_sharp_one_along_its_line():
    smeared, sharp = (room(name, hw=(120, 160), image_noise=0.0) for name in ("motion_blur", "mistracks"))
    px = [math.hypot(*smeared.smear(i)) * 640 / 160 for i in range(8)]
    assert min(px) >= 5 and max(px) <= 15 and max(px) - min(px) > 3 and sharp.smear(0) == (0, 0)
    i = px.index(max(px))
    same((smeared[i].depth, smeared.truth(i)["depth"]), (sharp[i].depth, sharp.truth(i)["depth"]))
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")

    def error(right, down):
        at = torch.linspace(-0.5, 0.5, 9)[:, None, None]
        place = torch.stack(((u - at * right + 0.5) / 80 - 1, (v - at * down + 0.5) / 60 - 1), -1)
        mean = grid_sample(sharp[i].image.float().expand(9, -1, -1, -1), place, align_corners=False).mean(0)
        return (mean - smeared[i].image)[..., 8:-8, 8:-8].abs().mean()

    right, down = smeared.smear(i)
    others = [error(k * right, k * down) for k in (0, 0.5, 1.6)] + [error(-down, right)]
    assert error(right, down) < 0.8 * min(others)


@pytest.mark.parametrize(
    "name",
    [
        *("few_near", "turntable", "fast"),
        *(pytest.param(x, marks=SLOW) for x in ("moved", "held_object", "exposure_jump", "motion_blur")),
    ],
)
def test_frames_are_the_same_in_any_order_and_another_process(name):
    one, two = (
        StressRoom(name, **SMALL | {"hw": (48, 64), "n_frames": n, "places": partial(spiral, foveation=1.0)})
        for n in (7, 9)
    )
    frames = {i: one[i] for i in (2, 5)}
    for other in (two, pickle.loads(pickle.dumps(two))):
        for i in (5, 2):
            same(other.truth(i), one.truth(i))
            same((other[i].image, other[i].depth), (frames[i].image, frames[i].depth))
