"""Every stress of the built-in room does what it says, and nothing else."""

import pickle
from functools import partial

import pytest
import torch

from dhtorch import extend
from dhtorch.geometry import camera, se3
from dhtorch.stages.backproject import backproject
from dhtorch.stages.sample import spiral
from dhtorch.stages.track import lucas_kanade
from dhtorch.studies import protocol
from dhtorch.synthetic import stress
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.stress import STRESSES, StressRoom, open_stress

SMALL = {"hw": (96, 128), "n_frames": 8, "supersample": 1, "depth_hw": (96, 128)}
NEAR = 2.0


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
    assert {r.recording.stress for r in rooms if r.role == "rotation"} == {"rotation", "rotation_exact"}
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
    assert near(frame).sum() == stress.FEW
    assert torch.equal(frame.depth[near(frame)], walk[1].depth[near(frame)])
    assert torch.equal(frame.depth[~near(walk[1])], walk[1].depth[~near(walk[1])])
    if places is not None:  # each of them is read
        samples = backproject(frame, spiral(few.hw, 512))
        assert len(samples.depth[(samples.depth > 0) & (samples.depth <= NEAR)].unique()) == stress.FEW


def test_depth_noise_is_two_to_three_percent(walk):
    frame, said = room("depth_noise")[0], walk[0].depth > 0
    assert torch.equal(frame.depth > 0, said)
    assert 0.02 < (frame.depth[said] / walk[0].depth[said] - 1).std() < 0.03


def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other():
    rolling = room("rolling_shutter", image_noise=0.0)
    first, last = rolling.bands[3][:1], rolling.bands[3][-1:]
    whole = se3.relative(*(rolling.true_poses[i : i + 1] for i in (3, 4))).t.norm()
    assert 0.5 < se3.relative(first, last).t.norm() / whole < 0.7  # 20 ms of 33 ms
    assert rolling[3].camera.readout.item() == pytest.approx(stress.READOUT_S)

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
    low, high = (px * 128 / 640 for px in stress.MOVED_PX)
    assert 0.25 < (shift > 0).float().mean() < 0.35
    assert low - 1e-3 < shift[shift > 0].min() and shift.max() < high + 1e-3
    assert not torch.equal(shift[0] > 0, shift[1] > 0)
    for said in ("error", "photometric", "valid", "cov"):
        assert torch.equal(getattr(spoiled, said), getattr(plain, said))
    alone = wrong.spoil_track(lucas_kanade)(image_0[1:], image_1[1:], uv[1:])
    assert torch.equal(alone.uv_1[0], spoiled.uv_1[1])


def test_experiments_ask_the_spoiled_tracker():
    method = extend.replace(n=256)
    found = []

    def columns(answer):
        found.append(answer.trace["tracks"].uv_1)
        return {}

    asked = protocol.Protocol({"any": protocol.Variant(method)}, columns=columns, min_candidates=0)
    protocol.run([SyntheticRoom(**SMALL), room("mistracks")], asked, lambda _: [(0, 6)], protocol.Settings())
    assert 0.2 < ((found[0] - found[1]).norm(dim=-1) > 0).float().mean() < 0.4


def test_frames_are_the_same_in_another_process():
    for name in ("few_near", "moved"):
        one = room(name, n_frames=7, places=partial(spiral, foveation=1.0))
        two = pickle.loads(pickle.dumps(one))
        a, b = one[6], two[6]
        assert torch.equal(a.image, b.image) and torch.equal(a.depth, b.depth)
