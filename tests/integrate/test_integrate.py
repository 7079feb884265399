"""Global integration: on scenes that are known exactly, against Open3D, and by what must never happen."""

import math
import sys
from dataclasses import replace

import pytest
import torch
from support.box_scene import BOX, HW, off_wall, walk

from dhtorch import extend
from dhtorch.codes import Gate, Source
from dhtorch.data.recording import Recording
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.integrate import (
    DepthView,
    drop_unconfirmed,
    extract_mesh,
    extract_points,
    fuse_views,
    make_volume,
    recording,
    splat_points,
    sweeps,
)
from dhtorch.records import Camera, DepthMap, Estimate, Pose, Samples, Tracks
from dhtorch.synthetic.recording import SyntheticRoom

VOXEL = 0.05


def view(frame, sigma=0.005, T=None):
    """A frame of exact depth as something to fuse; features are its colours."""
    colour = frame.image.permute(0, 2, 3, 1).float() / 255
    camera = frame.depth_camera or frame.camera
    T = frame.T_world_from_cam if T is None else T
    return DepthView(frame.depth, torch.full_like(frame.depth, sigma), colour, camera, T)


def wall(z=2.0, sigma=0.01, colour=0.5, hw=(60, 80)):
    """A wall across the view of a camera that looks along z."""
    camera = Camera(torch.tensor([[100.0, 100.0]]), torch.tensor([[39.5, 29.5]]))
    depth = torch.full((1, *hw), z)
    features = torch.full((1, *hw, 1), colour)
    return DepthView(depth, torch.full_like(depth, sigma), features, camera, se3.identity(1, depth))


@pytest.fixture(scope="module")
def box():
    volume = make_volume(VOXEL, channels=3)
    for frame in walk(4, hw=(96, 128), camera=Camera(torch.tensor([[123.0, 116.5]]), torch.tensor([[67.5, 44.0]]))):
        volume = fuse_views(volume, view(frame))
    return volume


# ------------------------------------------------------------------------------------------------------------ surfaces


def test_points_and_mesh_lie_on_the_walls_face_the_open_side_and_have_no_seams(box):
    pytest.importorskip("skimage")
    for surface in (extract_points(box), meshed := extract_mesh(box)):
        off = off_wall(surface.xyz) * BOX.min()
        assert len(surface.xyz) > 3000 and float(off.median()) < 0.001 and float(off.quantile(0.99)) < VOXEL / 4
        inward = (surface.normal.double() * -surface.xyz.double().sign()).amax(-1)
        assert float((inward > 0.98).double().mean()) > 0.95, "normals face the open side"
    a, b, c = meshed.xyz.double()[meshed.face].unbind(1)
    towards = (torch.linalg.cross(b - a, c - a) * -a).sum(-1)
    assert float((towards > 0).double().mean()) > 0.995
    edges = torch.cat([meshed.face[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))]).sort(1).values
    uses = edges.unique(dim=0, return_counts=True)[1]
    assert int(uses.max()) == 2, "no edge between more than two triangles"
    assert len((meshed.xyz / (VOXEL * 64)).floor().long().unique(dim=0)) > 1, "more than one brick"
    trimesh = pytest.importorskip("trimesh")
    parts = trimesh.Trimesh(meshed.xyz.numpy(), meshed.face.numpy(), process=False).split(only_watertight=False)
    assert max(len(part.faces) for part in parts) > 0.95 * len(meshed.face), "bricks are joined"


# ------------------------------------------------------------------------------------------------------------- blending


# -------------------------------------------------------------------------------------------------------------- carving


# -------------------------------------------------------------------------------------------------------------- splats


def no_points(camera, n=0, wrong=0):
    """Splats of ``n`` answers at depth 0, or a call whose depths are too many."""
    uv, zero = torch.zeros(1, n, 2), torch.zeros(1, n)
    return splat_points(
        camera, (60, 80), uv, torch.zeros(1, n + wrong), zero, zero[..., None], T_world_from_cam=se3.identity(1, zero)
    )


def test_no_answer_leaves_no_trace():
    nothing = wall(2.0)
    hopeless = [
        nothing.replace(depth=torch.zeros_like(nothing.depth)),
        nothing.replace(depth=torch.full_like(nothing.depth, math.nan)),
        nothing.replace(depth=torch.full_like(nothing.depth, math.inf)),
        nothing.replace(sigma=torch.full_like(nothing.depth, math.nan)),
        nothing.replace(sigma=torch.full_like(nothing.depth, 5.0)),
        nothing.replace(depth=torch.full_like(nothing.depth, 1e9)),
        nothing.replace(T_world_from_cam=Pose(torch.full((1, 3, 3), math.nan), torch.zeros(1, 3))),
        no_points(nothing.camera),
    ]
    for one in hopeless:
        volume = fuse_views(make_volume(0.02, channels=1), one)
        assert len(volume.key) == 0 and len(extract_points(volume).xyz) == 0
    before = fuse_views(make_volume(0.02, channels=1), nothing)
    for one in hopeless:
        after = fuse_views(before, one)
        assert all(torch.equal(getattr(before, k), getattr(after, k)) for k in ("key", "distance", "weight"))
    pytest.importorskip("skimage")
    assert extract_mesh(make_volume()).xyz.shape == extract_mesh(make_volume()).face.shape == (0, 3)


GOOD = wall()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda v: fuse_views(v, GOOD, source=Source.NONE), "source is 0"),
        (lambda v: fuse_views(v, GOOD, source=torch.ones_like(GOOD.depth[:, 1:])), "fuse_views"),
        (lambda v: fuse_views(v, GOOD, weight="score"), "weight: found 'score', expected variance or confidence"),
        *(
            (lambda _, o=o: make_volume(**o), "expected 0 < voxel <= truncation")
            for o in ({"voxel": 0.0}, {"voxel": -1.0}, {"voxel": 0.02, "truncation": 0.01})
        ),
        (lambda v: extract_points(v, min_weight=-1), "min_weight is -1"),
        (lambda v: extract_mesh(v, min_weight=-1), "min_weight is -1"),
        (lambda _: no_points(GOOD.camera, 3, wrong=1), "splat_points"),
        (lambda v: drop_unconfirmed(v, 0), "least is 0, expected at least 1"),
        (
            lambda _: recording.place_frames(Trajectory(None), []),
            "walk has no trajectory of its own, expected poses=anch",
        ),
        (
            lambda _: recording.place_frames(Trajectory(None), [], poses="gps"),
            "found 'gps', expected one of device, anchored",
        ),
    ],
)
def test_wrong_options_and_sources_raise(call, words, monkeypatch):
    with pytest.raises(ValueError, match=words):
        call(make_volume(0.02, channels=1))
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ImportError, match=r"pip install scikit-image"):
        extract_mesh(make_volume())


def test_distorted_lenses_and_far_worlds():
    """A lens with distortion, and a world whose origin is kilometres away, change nothing about the surface."""
    lens = Camera(
        torch.tensor([[61.5, 58.25]]), torch.tensor([[33.5, 21.75]]), torch.tensor([[-0.1, 0.02, 0.001, 0.0]])
    )
    for shift in (0.0, 5000.0):
        volume = make_volume(VOXEL, channels=3)
        for frame in walk(2, camera=lens):
            T = frame.T_world_from_cam
            volume = fuse_views(volume, view(frame, T=Pose(T.R, T.t + shift)))
        off = off_wall(extract_points(volume).xyz.double() - shift) * BOX.min()
        assert len(extract_points(volume).xyz) > 500 and float(off.median()) < 0.005, HW


# ----------------------------------------------------------------------------------------------------------- recordings


def answered(i, j, T, ok=True):
    """A pair of frames whose relative pose the method found, or not."""
    n, zero = 3, torch.zeros(1, 3)
    code = zero.to(torch.int32)
    xyz = torch.full((1, n, 3), math.nan)
    samples = Samples(torch.zeros(1, n, 2), zero, zero, xyz, zero, code, zero, code)
    estimate = Estimate(samples.uv, zero + 2, zero + 0.1, zero, zero, zero, code, zero, code)
    tracks = Tracks(samples.uv, samples.uv, zero, zero, torch.zeros(1, n, 2, 2), code == 0)
    fit = known_pose_fit(T if ok else T.map(lambda v: v * math.nan), n)
    return recording.PairEstimate((i, j), samples, estimate, tracks, fit, torch.zeros(1, n, 3), wall().camera, (60, 80))


class Trajectory:
    """What placing asks of a recording."""

    name = "walk"

    def __init__(self, poses):
        self.poses = poses


TRUE = se3.exp(0.3 * torch.rand(9, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))


def relative(i, j):
    return se3.relative(TRUE[i : i + 1], TRUE[j : j + 1])


@pytest.mark.parametrize("known", [True, False])
def test_anchored_poses_are_chained_and_the_largest_fragment_is_the_map(known):
    links = [(0, 3), (3, 6), (1, 4), (6, 8), (2, 5), (5, 8), (4, 7)]
    answers = [answered(i, j, relative(i, j), ok=(i, j) != (4, 7)) for i, j in links]
    places = recording.place_frames(Trajectory(TRUE if known else None), answers, poses="anchored")
    assert set(places.poses) == {0, 2, 3, 5, 6, 8} and places.n_fragments == 3 and places.n_unplaced == 3
    start = TRUE[:1] if known else se3.identity(1, TRUE.t)
    for k, T in places.poses.items():
        wanted = se3.compose(start, relative(k, 0))
        torch.testing.assert_close(T.R, wanted.R, atol=1e-9, rtol=0)
        torch.testing.assert_close(T.t, wanted.t, atol=1e-9, rtol=0)


def test_device_poses_are_the_recordings_own_where_finite():
    broken = Pose(TRUE.R.clone(), TRUE.t.clone())
    broken.t[3] = math.nan
    places = recording.place_frames(
        Trajectory(broken), [answered(0, 3, relative(0, 3)), answered(1, 4, relative(1, 4))]
    )
    assert set(places.poses) == {0, 1, 4} and (places.n_fragments, places.n_unplaced) == (1, 1)
    assert torch.equal(places.poses[4].t, TRUE.t[4:5])


WIDTHS = ([(i, i + 20) for i in range(0, 20, 2)], [(i, i + 4) for i in range(5)], [(0, 1), (1, 2)], [(0, 3), (6, 9)])


@pytest.mark.parametrize("pairs", WIDTHS)
def test_links_of_another_width_join_all_frames(pairs):
    links = recording.linking_pairs(pairs)
    assert not set(links) & set(pairs)
    answers = [answered(i, j, se3.identity(1, TRUE.t)) for i, j in [*pairs, *links]]
    places = recording.place_frames(Trajectory(None), answers, poses="anchored")
    assert places.n_fragments == 1 and places.n_unplaced == 0


@pytest.mark.parametrize("own", [None, Camera(torch.tensor([[40.0, 38.0]]), torch.tensor([[17.0, 12.0]]))])
def test_a_frames_depth_wears_the_pictures_colours(own):
    (frame,) = walk(1, hw=(96, 128), camera=Camera(torch.tensor([[123.0, 116.5]]), torch.tensor([[67.5, 44.0]])))
    small = walk(1, depth_camera=own)[0].replace(image=frame.image, camera=frame.camera, depth_camera=own)
    conf = torch.full_like(small.depth, 2).to(torch.uint8)
    conf[:, :5] = 0
    spoilt = small.depth.clone()
    spoilt[0, 20, 30] = 0.5
    one = recording.view_from_sensor(small.replace(conf=conf, depth=spoilt), small.T_world_from_cam)
    assert float(one.depth[:, :5].max()) == 0 and float(one.depth[0, 19:22, 29:32].max()) == 0, "and no depth edges"
    assert float((one.depth > 0).double().mean()) > 0.7 and float(one.features[..., 3].max()) == 1
    surface = extract_points(fuse_views(make_volume(VOXEL), one))
    tone = [torch.sin(3 * surface.xyz[:, 0] + 1), torch.sin(4 * surface.xyz[:, 1] - surface.xyz[:, 0])]
    error = (surface.features[:, :2] - (torch.stack(tone, -1) * 0.5 + 0.5)).abs()
    assert float(error.median()) < 0.04


def test_sparse_returns_become_discs_and_coverage_counts_cells_and_islands():
    frame = walk(1)[0]
    few = torch.zeros_like(frame.depth)
    few[0, ::8, ::8] = frame.depth[0, ::8, ::8]
    one = recording.view_from_sensor(frame.replace(depth=few), frame.T_world_from_cam, radius=0.15)
    assert 4 * int((few > 0).sum()) < int((one.depth > 0).sum()) < 0.9 * few.numel()
    xyz = torch.tensor([[0.05, 0.05, 0.05], [0.15, 0.15, 0.05], [0.95, 0.05, 0.05], [math.nan, 0, 0], [0.06] * 3])
    counts = {"n_voxels": 3, "n_islands": 2, "largest_island": pytest.approx(2 / 3)}
    assert recording.measure_coverage(xyz, 0.1) == counts
    assert recording.measure_coverage(xyz[3:4], 0.1) == {"n_voxels": 0, "n_islands": 0, "largest_island": None}


@pytest.fixture(scope="module")
def walked():
    """A small recording of the built-in room, its pairs and what the method says about them."""
    room = SyntheticRoom(hw=(240, 320), n_frames=5, supersample=1, step_m=0.03)
    method = extend.replace(n=1024)
    return room, list(recording.estimate_pairs(room, method, [(0, 4)], cutoff=2.0))


def test_of_two_grids_each_is_what_it_is_alone_and_frames_are_read_once(walked, monkeypatch):
    room, answers = walked
    places = recording.place_frames(room, answers)
    alone = [
        recording.fuse_recording(room, make_volume(voxel), answers, places, sources=sources, cutoff=2.0)
        for voxel, sources in ((0.05, [Source.SENSOR]), (0.1, [Source.SENSOR, Source.RECOVERED]))
    ]
    reads, read = [], type(room).__getitem__
    monkeypatch.setattr(type(room), "__getitem__", lambda self, k: reads.append(k) or read(self, k))
    both = recording.fuse_recording_grids(room, [make_volume(0.05), make_volume(0.1)], answers, places, cutoff=2.0)
    assert sorted(reads) == sorted(places.poses)
    for one, other in zip(alone, both, strict=True):
        for name in ("key", "distance", "weight", "features"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name


# --------------------------------------------------------------------------------------------------------- swept maps

WIDE = {"hw": (96, 128), "camera": Camera(torch.tensor([[123.0, 116.5]]), torch.tensor([[67.5, 44.0]]))}


def box_map(frame, sigma=0.02):
    """An exact map of every pixel of a frame in the box."""
    same = torch.ones_like(frame.depth)
    code = same.to(torch.int32)
    return DepthMap(frame.depth, sigma * same, 0.5 * same, code * Source.SWEPT, code * Gate.ANSWER)


def looked_around(frames, maps):
    """Frames as a recording, answers that hold their maps, and their places."""
    shelf = sweeps.SweepStore()
    answers = [replace(answered(k, k, relative(0, 0)), swept=shelf.put(found)) for k, found in enumerate(maps)]
    walked = Recording(name="box", format="made", load=frames.__getitem__, number=torch.arange(len(frames)))
    return walked, answers, recording.PlacedFrames({k: f.T_world_from_cam for k, f in enumerate(frames)}, 1, 0)


def test_swept_pixels_enter_with_their_source_and_weight_and_without_edges():
    (frame,) = walk(1, **WIDE)
    found = box_map(frame)
    depth, source, gate = found.depth.clone(), found.source.clone(), found.gate.clone()
    depth[0, 40, 60] *= 0.8
    source[0, :10], source[0, 60:], gate[..., :5] = Source.SENSOR, Source.FILLED, Gate.UNCERTAIN
    walked, (answer,), places = looked_around([frame], [found.replace(depth=depth, source=source, gate=gate)])
    one = recording.view_from_sweep(walked, answer, places)
    there = torch.ones_like(depth, dtype=torch.bool)
    there[0, 39:42, 59:62], there[0, :10], there[..., :5] = False, False, False
    assert torch.equal(one.depth > 0, there) and answer.swept.n == int(there.sum())
    assert answer.swept.n_filled == int(there[0, 60:].sum()) > 100
    torch.testing.assert_close(one.depth[there], frame.depth[there], rtol=1e-3, atol=0)
    torch.testing.assert_close(one.sigma[there], torch.full_like(one.sigma[there], 0.02), rtol=1e-3, atol=0)
    assert torch.equal(one.features[..., :3], frame.image.permute(0, 2, 3, 1) / 255)
    volume = recording.fuse_recording(walked, make_volume(VOXEL), [answer], places, sources=[Source.SWEPT])
    assert float(volume.weight[..., :2].max()) == 0 and float(volume.weight[..., 2].max()) == pytest.approx(2500, 1e-2)
    surface = extract_points(volume)
    assert set(surface.source.tolist()) == {Source.SWEPT, Source.FILLED} and len(surface.xyz) > 1000
    assert float((off_wall(surface.xyz) * BOX.min()).quantile(0.99)) < VOXEL / 2, "a map alone is believed"
    assert float((surface.features[:, 3] - 0.5).abs().max()) < 0.01


def test_a_map_of_half_the_size_is_of_the_same_walls():
    (frame,) = walk(1, **WIDE)
    (small,) = walk(1, hw=(48, 64), camera=cameras.resize(frame.camera, (96, 128), (48, 64)))
    walked, answers, places = looked_around([frame], [box_map(small)])
    surface = extract_points(
        recording.fuse_recording(walked, make_volume(VOXEL), answers, places, sources=[Source.SWEPT])
    )
    assert len(surface.xyz) > 1000 and float((off_wall(surface.xyz) * BOX.min()).quantile(0.95)) < VOXEL / 2


@pytest.mark.parametrize("bad", [0, 3])
def test_a_wrong_patch_that_others_see_through_is_gone(bad):
    """Whether it comes first or last; and, where it is too sure of itself to be outweighed, as no other map has it."""
    frames = walk(4, **WIDE)
    maps = [box_map(frame) for frame in frames]
    patch = torch.zeros_like(maps[bad].keep)
    patch[:, 30:60, 40:90] = True

    def off(sigma, least):
        wrong = maps[bad].replace(
            depth=torch.where(patch, 0.6 * maps[bad].depth, maps[bad].depth),
            sigma=torch.where(patch, sigma, maps[bad].sigma),
        )
        walked, answers, places = looked_around(frames, [*maps[:bad], wrong, *maps[bad + 1 :]])
        volume = recording.fuse_recording(
            walked, make_volume(VOXEL), answers, places, sources=[Source.SWEPT], min_maps=least
        )
        return int((off_wall(extract_points(volume).xyz) * BOX.min() > 0.2).sum())

    assert off(0.02, 1) == 0, "outweighed by those who see through"
    assert off(0.002, 1) > 100 and off(0.002, 2) == 0, "not found by a second one"


def test_a_surface_that_one_map_alone_has_is_kept_where_others_speak():
    (frame,) = walk(1, **WIDE)
    volume = fuse_views(make_volume(VOXEL, channels=3), view(frame), source=Source.SWEPT)
    assert (
        len(extract_points(drop_unconfirmed(volume)).xyz) == 0
        and len(extract_points(drop_unconfirmed(volume, 1)).xyz) > 1000
    )
    both = fuse_views(volume, view(frame, sigma=0.5 * VOXEL), source=Source.RECOVERED)
    assert len(extract_points(drop_unconfirmed(both)).xyz) == len(extract_points(both).xyz)
    assert int(fuse_views(volume, view(frame), source=Source.SWEPT).n_swept.max()) == 2


def test_a_shelf_holds_maps_of_all_sizes_and_leaves_nothing_behind(tmp_path):
    frames = walk(2, **WIDE)
    small = walk(1)[0]
    shelf = sweeps.SweepStore(tmp_path / "out")
    assert not (tmp_path / "out").exists(), "no folder for maps that nobody made"
    kept = [shelf.put(box_map(frame)) for frame in (frames[0], small, frames[1])]
    assert list((tmp_path / "out").iterdir()) == []
    for k, frame in ((2, frames[1]), (0, frames[0]), (1, small)):
        depth, sigma, score, source = kept[k].read()
        there = sweeps.depth_step_rel(frame.depth) <= 0.1
        assert kept[k].hw == frame.hw and kept[k].n == int(there.sum()) > 0.9 * there.numel()
        torch.testing.assert_close(depth, torch.where(there, frame.depth, 0.0), rtol=1e-3, atol=0)
        assert torch.equal(score, 0.5 * there) and torch.equal(source, Source.SWEPT * there.float())
        assert float((sigma - 0.02 * there).abs().max()) < 1e-4
