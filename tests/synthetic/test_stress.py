"""Every stress of the built-in room does what it says, and nothing else."""

import math
import pickle
from functools import partial

import pytest
import torch

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
NEAR = 2.0
MOVING_ROOMS = [name for name, of in STRESSES.items() if of.moving]
TURNED_ROOMS = [name for name, of in STRESSES.items() if of.turn]


@pytest.fixture(scope="module")
def walk():
    return SyntheticRoom(**SMALL)


def room(name, **options):
    return StressRoom(name, **SMALL | options)


def near(frame):
    return (frame.depth > 0) & (frame.depth <= NEAR)


def test_one_recording_for_each_stress():
    rooms = open_stress(hw=(48, 64), n_frames=7)
    assert [r.name for r in rooms] == [f"stress_{name}" for name in STRESSES]
    assert {r.recording.stress for r in rooms if r.role == "rotation"} == {"rotation", "rotation_exact", *TURNED_ROOMS}
    with pytest.raises(ValueError, match="earthquake"):
        open_stress(["earthquake"])


@pytest.mark.parametrize("name", ["rotation", "rotation_exact"])
def test_rotation_has_no_baseline(name):
    T = se3.relative(room(name).true_poses[:1], room(name).true_poses[6:7])
    assert T.t.norm() < 1e-12 and se3.rotation_angle(T.R).rad2deg() > 2


@pytest.mark.parametrize("name", ["lateral", "forward", "orbit"])
def test_paths_go_where_they_say(name):
    T = se3.relative(*(room(name).true_poses[i : i + 1] for i in (0, 6)))
    assert T.t.norm() > 0.08
    assert (T.t[0, 2].abs() > 0.9 * T.t.norm()) == (name == "forward")
    assert (se3.rotation_angle(T.R).rad2deg() > 2) == (name == "orbit")


def test_the_exact_rotation_is_exact():
    frame, truth = room("rotation_exact")[2], room("rotation_exact").truth(2)["depth"]
    assert torch.equal(frame.depth, truth)


def test_planar_points_are_planar(walk):
    flat = room("planar_near")
    for i in (0, 3):
        frame, kept = flat[i], near(flat[i])
        assert 100 < kept.sum() < 0.7 * near(walk[i]).sum()
        assert torch.equal(frame.depth[~near(walk[i])], walk[i].depth[~near(walk[i])])
        v, u = kept[0].nonzero().unbind(-1)
        uv, at = torch.stack((u, v), -1)[None].double(), frame.depth_camera.to(torch.float64)
        true = (
            SyntheticRoom(**SMALL | {"lidar": None}).truth(i)["depth"][0, v, u].double()[None]
        )  # same size, same camera
        xyz = camera.unproject(at, uv, true)[0]
        spread = torch.linalg.svdvals(xyz - xyz.mean(0))
        assert spread[2] < 1e-5 * spread[0] and spread[1] > 0.05 * spread[0]
        assert ((frame.depth[0, v, u] / true[0] - 1).abs() < 0.05).all()


@pytest.mark.parametrize("places", [None, partial(spiral, foveation=1.0)])
def test_only_twenty_near_returns_remain(walk, places):
    few = room("few_near", places=places, n_places=512)
    frame = few[1]
    assert near(frame).sum() == stress._N_FEW_NEAR
    assert torch.equal(frame.depth[near(frame)], walk[1].depth[near(frame)])
    assert torch.equal(frame.depth[~near(walk[1])], walk[1].depth[~near(walk[1])])
    if places is not None:  # each of them is read
        samples = backproject(frame, spiral(few.hw, 512))
        assert len(samples.depth[(samples.depth > 0) & (samples.depth <= NEAR)].unique()) == stress._N_FEW_NEAR


def test_depth_noise_is_two_to_three_percent(walk):
    frame, said = room("depth_noise")[0], walk[0].depth > 0
    assert torch.equal(frame.depth > 0, said)
    assert 0.02 < (frame.depth[said] / walk[0].depth[said] - 1).std() < 0.03


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other():
    rolling = room("rolling_shutter", image_noise=0.0)
    first, last = rolling.bands[3][:1], rolling.bands[3][-1:]
    whole = se3.relative(*(rolling.true_poses[i : i + 1] for i in (3, 4))).t.norm()
    assert 0.5 < se3.relative(first, last).t.norm() / whole < 0.7  # 20 ms of 33 ms
    assert rolling[3].camera.readout.item() == pytest.approx(stress._READOUT_S)

    def seen_from(pose):
        still = SyntheticRoom(**SMALL | {"image_noise": 0.0, "n_frames": 1})
        still.true_poses = pose
        return still[0].image, still.truth(0)["depth"]

    for pose, rows in ((first, slice(0, 3)), (last, slice(94, 96))):
        image, truth = seen_from(pose)
        assert (rolling[3].image[..., rows, :].int() - image[..., rows, :].int()).abs().max() <= 1
        assert torch.allclose(rolling.truth(3)["depth"][:, rows], truth[:, rows], rtol=1e-4)
    middle, _ = seen_from(rolling.true_poses[3:4])
    assert (rolling[3].image.int() - middle.int()).abs().float().mean() > 0.5


def test_moved_squares_leave_anchors_alone(walk):
    moved = room("moved")
    assert torch.equal(moved[5].image, walk[5].image) and torch.equal(moved[7].depth, walk[7].depth)
    share = (moved[7].image != walk[7].image).any(1).float().mean()
    assert 0.2 < share < 0.35


def test_three_in_ten_tracks_end_elsewhere_and_say_nothing_of_it(walk):
    rolling, wrong = room("rolling_shutter"), room("mistracks")
    assert torch.equal(wrong[7].image, walk[7].image) and rolling.spoil_track(lucas_kanade) is lucas_kanade
    uv = spiral(wrong.hw, 512)[None].expand(2, -1, -1)
    image_0, image_1 = torch.cat((wrong[0].image, wrong[1].image)), torch.cat((wrong[6].image, wrong[7].image))
    plain, spoiled = (track(image_0, image_1, uv) for track in (lucas_kanade, wrong.spoil_track(lucas_kanade)))
    shift = (spoiled.uv_1 - plain.uv_1).norm(dim=-1)
    low, high = (px * 128 / 640 for px in stress._MOVED_RANGE_PX)
    assert 0.25 < (shift > 0).float().mean() < 0.35
    assert low - 1e-3 < shift[shift > 0].min() and shift.max() < high + 1e-3
    assert not torch.equal(shift[0] > 0, shift[1] > 0)
    for said in ("error", "photometric", "valid", "cov"):
        assert torch.equal(getattr(spoiled, said), getattr(plain, said))
    alone = wrong.spoil_track(lucas_kanade)(image_0[1:], image_1[1:], uv[1:])
    assert torch.equal(alone.uv_1[0], spoiled.uv_1[1])


@pytest.mark.slow
def test_experiments_ask_the_spoiled_tracker():
    method = extend.replace(n=256)
    found = []

    def columns(answer):
        found.append(answer.trace["tracks"].uv_1)
        return {}

    asked = protocol.Protocol({"any": protocol.Variant(method)}, columns=columns, min_candidates=0)
    protocol.run([SyntheticRoom(**SMALL), room("mistracks")], asked, lambda _: [(0, 6)], protocol.Settings())
    assert 0.2 < ((found[0] - found[1]).norm(dim=-1) > 0).float().mean() < 0.4


def test_scenes_in_which_a_body_moves_have_a_role_and_a_cutoff_of_their_own():
    scenes = {s.recording.stress: s for s in open_stress([*MOVING_ROOMS, "fast"], hw=(48, 64), n_frames=7)}
    assert {name for name, s in scenes.items() if s.role == "moving"} == set(MOVING_ROOMS) != set(scenes)
    assert scenes["fast"].role is None and scenes["fast"].near == scenes["held_object"].near == NEAR
    assert scenes["convoy"].near == scenes["turntable"].near == 1.3
    assert open_stress(["convoy"], hw=(48, 64), n_frames=7, near=0.9)[0].near == 0.9


def seen(recording, i):
    """Of every pixel of frame i: its place in the world (H·W, 3) float64, its surface, its grey levels (H·W, 3)."""
    h, w = recording.hw
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    truth, uv = recording.truth(i), torch.stack((u, v), -1).reshape(1, -1, 2).double()
    xyz = camera.unproject(recording.camera.to(torch.float64), uv, truth["depth"].double().reshape(1, -1))
    world = se3.apply(recording.true_poses[i : i + 1], xyz)
    return world, truth["surface"].flatten(), recording[i].image[0].reshape(3, -1).T.double()


def carried(recording, i, j, motion=None):
    """Pixels of frame i in sight of frame j after a motion of the world: (kept,) mask, relative differences of depth
    from frame j's truth, of grey from frame j's picture, and the surface found there."""
    world, surface, grey = seen(recording, i)
    there = world if motion is None else se3.apply(motion, world)
    xyz = se3.apply(se3.invert(recording.true_poses[j : j + 1]), there)
    uv = camera.project(recording.camera.to(torch.float64), xyz)
    h, w = recording.hw
    place = (2 * (uv + 0.5) / torch.tensor([w, h]) - 1)[:, None]
    truth = recording.truth(j)
    maps = (1 / truth["depth"][None], recording[j].image)
    inverse, image = (torch.nn.functional.grid_sample(m.double(), place, align_corners=False)[0, :, 0] for m in maps)
    found = truth["surface"][None].double()
    found = torch.nn.functional.grid_sample(found, place, mode="nearest", align_corners=False)[0, 0, 0]
    inside = (place.abs() < 0.95).all(-1).flatten()
    depth = (xyz[0, :, 2] * inverse[0] - 1).abs()
    return inside, depth, (image.T - grey).abs().mean(-1), surface, found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in MOVING_ROOMS if name != "convoy_lanes"])
def test_background_stands_and_the_body_goes_as_said(name):
    """Truth against render: what is carried to another frame by the right motion has its depth and its grey there."""
    there = room(name, image_noise=0.0, supersample=2)
    i, j = 1, 7
    T = se3.compose(there.body_poses[j : j + 1], se3.invert(there.body_poses[i : i + 1]))
    inside, depth, grey, surface, found = carried(there, i, j)
    ground = inside & (surface == SURFACE_ORDINARY) & (found == SURFACE_ORDINARY) & (depth < 0.01)
    assert ground.sum() > 3000 and depth[ground].median() < 2e-5 and grey[ground].median() < 6
    left_behind = inside & (surface == SURFACE_MOVING)
    assert not (depth[left_behind] < 1e-4).double().mean() > 0.2, "it does not stand"
    inside, depth, grey, surface, found = carried(there, i, j, T)
    body = inside & (surface == SURFACE_MOVING)
    good = body & (found == SURFACE_MOVING) & (depth < 0.01)
    assert good.sum() > 0.85 * body.sum() > 1000
    assert depth[good].median() < 2e-5 and grey[good].median() < 6
    assert grey[inside & (surface == SURFACE_ORDINARY)].median() > 1.5 * grey[good].median() or name == "turntable"


def test_a_body_hides_what_is_behind_it_and_changes_nothing_else(walk):
    there, plain = room("convoy_slow"), walk.truth(3)
    truth, image = there.truth(3), there[3].image
    body = truth["surface"] == SURFACE_MOVING
    assert 0.2 < body.double().mean() < 0.35
    assert (truth["depth"][body] < plain["depth"][body]).all()
    assert torch.equal(truth["depth"][~body], plain["depth"][~body])
    beside = (~body & (truth["surface"] == SURFACE_ORDINARY))[:, None].expand_as(image)
    assert torch.equal(image[beside], walk[3].image[beside]) and image[~beside].double().std() > 20


def test_bodies_go_with_the_viewer_half_as_far_in_his_hand_or_round():
    way = room("convoy").true_poses.t.diff(dim=0)
    for name, share in (("convoy", 1.0), ("convoy_slow", 0.5)):
        body = room(name).body_poses
        assert torch.allclose(body.t.diff(dim=0), share * way, atol=1e-12)
        assert torch.equal(body.R, torch.eye(3, dtype=torch.float64).expand_as(body.R))
    held = room("held_object")
    seen_by_him = se3.compose(se3.invert(held.true_poses), held.body_poses)
    middle = se3.apply(
        seen_by_him, se3.apply(guests._VIEWER_POSE, torch.tensor([[guests._CARRIED_CENTRE]]).double()).expand(8, 1, 3)
    )
    assert 0.005 < (middle[6, 0] - middle[0, 0]).norm() < 0.05
    turned = se3.rotation_angle(seen_by_him.R[6:] @ seen_by_him.R[:2].mT).rad2deg()
    assert ((turned > 1) & (turned < 10)).all()
    table = room("turntable")
    assert torch.equal(table.true_poses.t[0], table.true_poses.t[7])
    angle = se3.rotation_angle(table.body_poses.R[1:] @ table.body_poses.R[:-1].mT).rad2deg()
    assert torch.allclose(angle, torch.full_like(angle, guests._TURN_DEG_PER_FRAME), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("convoy", 0.99, 1), ("convoy_slow", 0.99, 1), ("turntable", 0.99, 1), ("held_object", 0.35, 0.65)],
)
def test_near_returns_lie_on_the_body(name, least, most):
    there = open_stress([name], hw=(96, 128), n_frames=8)[0]
    for i in (0, 7):
        frame = there.recording[i]
        kind = torch.nn.functional.interpolate(there.recording.truth(i)["surface"][None].float(), frame.depth.shape[1:])
        close = (frame.depth > 0) & (frame.depth <= there.near)
        share = (kind[0][close] == SURFACE_MOVING).double().mean()
        assert close.double().mean() > 0.2 and least <= share <= most
        candidates = (there.recording.truth(i)["depth"] > there.near) & (
            there.recording.truth(i)["surface"] != SURFACE_MOVING
        )
        assert candidates.double().mean() > 0.4


def test_bodies_in_lanes_follow_the_viewer_with_speeds_of_their_own():
    there = room("convoy_lanes")
    moved = (there.true_poses.t - there.true_poses.t[:1]).norm(dim=-1)
    lanes = (there.body_poses.t.unflatten(0, (8, 3)) - there.body_poses.t[:3]).norm(dim=-1)
    assert (lanes[1:].amin(1) > 0.2 * moved[1:]).all() and (lanes[1:].amax(1) < 0.75 * moved[1:]).all()
    home = [s.centre for s in guests.room_with_body(2, "parcels").solids.each if s.surface.kind == SURFACE_MOVING]
    now = [s.centre for s in there.world(5).solids.each if s.surface.kind == SURFACE_MOVING]
    shift = torch.tensor(now, dtype=torch.float64) - torch.tensor(home, dtype=torch.float64)
    assert torch.allclose(shift, there.body_poses.t[[15, 16, 17, 15, 16]], atol=1e-6)


@pytest.mark.parametrize("name", ["convoy_oncoming", "convoy_uneven"])
def test_the_share_of_a_convoy_varies_over_time(name):
    there = room(name)
    way, body = there.true_poses.t.diff(dim=0), there.body_poses.t.diff(dim=0)
    share = (way * body).sum(-1) / way.square().sum(-1)
    assert share.max() - share.min() > 0.5


@pytest.mark.parametrize("name", TURNED_ROOMS)
def test_a_hand_turns_the_camera_on_the_spot(name):
    turned, turn = room(name), STRESSES[name].turn
    T = [se3.relative(turned.true_poses[i : i + 1], turned.true_poses[7:8]) for i in range(7)]
    angle = se3.rotation_angle(T[0].R).rad2deg().item()
    assert 5 <= turn.degrees <= 40 and 0.8 * turn.degrees < angle < 1.2 * turn.degrees
    assert 0.5 * turn.reach_m < max(x.t.norm().item() for x in T) < 1.2 * turn.reach_m <= 0.036
    gains = [turned.gain(i) for i in range(8)]
    assert max(gains) / min(gains) > 1.3


def test_a_turned_picture_is_smeared_and_its_depth_is_not():
    turned = room("rotation_hand_30", hw=(48, 64))
    still = SyntheticRoom(**SMALL | {"hw": (48, 64)}, true_poses=turned.true_poses)
    sharp = still._photograph(4, turned.camera, turned.true_poses[4:5], (48, 64), exposure=turned.gain(4))
    edges = [(x.diff(dim=-1).abs().mean()) for x in (turned._picture(4), sharp)]
    assert edges[0] < 0.9 * edges[1]
    depth = guests.room_with_body(2, "parcels").solids.view(turned.camera, turned.true_poses[4:5], (48, 64))[0]
    assert torch.equal(turned.truth(4)["depth"].flatten(), depth)


def test_guests_are_painted_like_the_room_and_cast_no_shadow():
    scene, size = furnished_room(2), ((0.0, -1.0, 1.0), (0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="casts a shadow"):
        scene.joined_by([Solid(*size, Material("print"))])
    with pytest.raises(ValueError, match="zebra"):
        scene.joined_by([Solid(*size, Material("zebra"), shadow=False)])


def test_fast_is_sixty_to_a_hundred_and_fifty_pixels_from_frame_to_partner():
    fast = room("fast")
    for i in (0, 1):
        world, _, _ = seen(fast, i)
        cam = fast.camera.to(torch.float64)
        uv = [camera.project(cam, se3.apply(se3.invert(fast.true_poses[k : k + 1]), world)) for k in (i, i + 6)]
        inside = ((uv[1] >= 0) & (uv[1] < torch.tensor([128, 96]))).all(-1)
        px = (uv[1] - uv[0]).norm(dim=-1)[inside] * 640 / 128
        assert inside.double().mean() > 0.7 and px.quantile(0.01) > 60 and px.quantile(0.99) < 150


def test_exposure_jumps_up_and_down_and_clips():
    jumping, plain = room("exposure_jump", image_noise=0.0), room("mistracks", image_noise=0.0)
    ratio = [jumping.gain(i + 6) / jumping.gain(i) for i in range(2)]
    assert 2 <= max(ratio) <= 4 and 2 <= 1 / min(ratio) <= 4 and plain.gain(0) == 1
    for i in (0, 1):
        sharp, found = plain[i].image.double(), jumping[i].image.double()
        known = sharp < 255  # what is brighter still shows in a darker picture
        expected = (sharp * jumping.gain(i)).clamp(max=255)
        assert (found - expected)[known].abs().max() <= 0.5 + 0.5 * jumping.gain(i) + 1e-6
    share = [(jumping[i].image == 255).double().mean() for i in (0, 1)]
    assert share[0] > 0.1 > share[1], "the brighter one is clipped"


def test_a_smeared_picture_is_the_mean_of_the_sharp_one_along_its_line():
    size = {"hw": (120, 160), "image_noise": 0.0}
    smeared, sharp = room("motion_blur", **size), room("mistracks", **size)
    px = [math.hypot(*smeared.smear(i)) * 640 / 160 for i in range(8)]
    assert min(px) >= 5 and max(px) <= 15 and max(px) - min(px) > 3 and sharp.smear(0) == (0, 0)
    i = px.index(max(px))
    assert torch.equal(smeared[i].depth, sharp[i].depth)
    assert torch.equal(smeared.truth(i)["depth"], sharp.truth(i)["depth"])

    def error(right, down):
        v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
        total = torch.zeros(1, 3, 120, 160)
        for at in torch.linspace(-0.5, 0.5, 9).tolist():
            place = torch.stack(((u - at * right + 0.5) / 80 - 1, (v - at * down + 0.5) / 60 - 1), -1)[None]
            total = total + torch.nn.functional.grid_sample(sharp[i].image.float(), place, align_corners=False) / 9
        return (total - smeared[i].image)[..., 8:-8, 8:-8].abs().mean()

    right, down = smeared.smear(i)
    others = [error(k * right, k * down) for k in (0, 0.5, 1.6)] + [error(-down, right)]
    assert error(right, down) < 0.8 * min(others)


@pytest.mark.parametrize(
    "name",
    [
        "few_near",
        "turntable",
        "fast",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("moved", "held_object", "exposure_jump", "motion_blur")),
    ],
)
def test_frames_are_the_same_in_any_order_and_another_process(name):
    one, two = (room(name, hw=(48, 64), n_frames=n, places=partial(spiral, foveation=1.0)) for n in (7, 9))
    frames = {i: one[i] for i in (2, 5)}
    carried = pickle.loads(pickle.dumps(two))
    for i in (5, 2):
        found = two.truth(i), carried.truth(i), two[i], carried[i]
        for key, value in one.truth(i).items():
            assert torch.equal(value, found[0][key]) and torch.equal(value, found[1][key])
        for frame in found[2:]:
            assert torch.equal(frame.image, frames[i].image) and torch.equal(frame.depth, frames[i].depth)
