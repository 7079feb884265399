"""Volumes and their surfaces against plain loops: what every voxel learns, where every grid edge is crossed."""

import itertools
import math

import numpy as np
import pytest
import torch

from dhtorch.geometry import se3, sparse_grid
from dhtorch.integrate import DepthView, extract_points, fuse_views, make_volume, recording, splat_points
from dhtorch.integrate.volume import VOLUME_SOURCES, Volume, reserve_blocks
from dhtorch.pytree import collate
from dhtorch.records import Camera, Frame

CAMERA = Camera(torch.tensor([[22.0, 18.0]]), torch.tensor([[10.5, 6.25]]))
HW = (14, 20)


def looked(seed, sigma=0.02, far=2.0):
    """A slanted, bumpy wall with holes, seen from somewhere; every pixel with a sigma and a colour of its own."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *size: torch.rand(*size, generator=g)  # noqa: E731
    depth = far + 0.02 * torch.arange(HW[1]) + 0.03 * draw(1, *HW)
    depth[draw(1, *HW) < 0.1] = 0
    T = se3.exp(0.1 * torch.randn(1, 6, generator=g, dtype=torch.float64))
    return DepthView(depth, sigma * (0.5 + draw(1, *HW)), draw(1, *HW, 2), CAMERA, T)


def voxels(volume):
    """Whole numbers (K, 512, 3) of every voxel."""
    local = torch.tensor(list(itertools.product(range(8), repeat=3)))
    return sparse_grid.unpack_cells(volume.key)[:, None] * 8 + local


def loop_fuse(volume, looks, max_reach, carve, weighting):
    """What ``looks`` (view, index of the source of each pixel) leave at every voxel: distance, weights, swept surfaces,
    share with colour, colour, whether it is sure which pixel it reads: not on a border of two, nor beyond the middle of the outermost."""
    place = voxels(volume).reshape(-1, 3).double().numpy() * volume.voxel
    n, tau = len(place), volume.truncation
    distance, weight, swept = np.zeros(n), np.zeros((n, len(VOLUME_SOURCES))), np.zeros(n, int)
    colour, coloured, sure = np.zeros((n, 2)), np.zeros(n), np.ones(n, bool)
    for view, sources in looks:
        R, t = view.T_world_from_cam.R[0].numpy(), view.T_world_from_cam.t[0].numpy()
        (fx, fy), (cx, cy) = view.camera.f[0].tolist(), view.camera.c[0].tolist()
        for k in range(n):
            x, y, z = R.T @ (place[k] - t)
            if z <= 0.01:
                continue
            at = fx * x / z + cx, fy * y / z + cy
            u, v = (math.floor(c + 0.5) for c in at)
            if not (0 <= u < HW[1] and 0 <= v < HW[0]):
                continue
            inner = 0 <= at[0] <= HW[1] - 1 and 0 <= at[1] <= HW[0] - 1
            sure[k] &= inner and min(abs(c + 0.5 - round(c + 0.5)) for c in at) > 1e-4
            depth, sigma = float(view.depth[0, v, u]), float(view.sigma[0, v, u])
            reach = max(2 * sigma, tau)
            if depth == 0 or reach > max_reach * tau:
                continue
            ahead = (depth - z) * math.sqrt(x * x + y * y + z * z) / z
            if ahead <= -reach or (not carve and ahead > reach):
                continue
            source = sources[v, u]
            precision = 1 / sigma**2 if weighting == "variance" else float(view.features[0, v, u, -1]) / volume.voxel**2
            w = min(1.0, max(0.0, 2 + 2 * ahead / reach)) * precision
            total = weight[k].sum() + w
            share = w / total if total else 0.0
            distance[k] += share * (min(max(ahead, -tau), tau) - distance[k])
            if abs(ahead) <= tau:
                colour[k] += share * (view.features[0, v, u].numpy() - colour[k])
                coloured[k] += share * (1 - coloured[k])
            weight[k, source] += w
            swept[k] += source >= 2 and -0.75 * reach <= ahead <= reach
    return distance, weight, swept, coloured, colour, sure


@pytest.mark.parametrize(
    ("carve", "max_reach", "sigma", "weighting"),
    [
        pytest.param(True, 3.0, 0.02, "variance", marks=pytest.mark.slow),
        (False, 3.0, 0.15, "variance"),
        (True, 1.2, 0.15, "confidence"),
    ],
)
def test_every_voxel_learns_what_its_pixel_says(carve, max_reach, sigma, weighting):
    """A batch of views is fused as one after the other."""
    volume = make_volume(0.1, truncation=0.25, channels=2)
    index = [*(np.full(HW, k) for k in range(3)), 2 + np.indices(HW).sum(0) % 2]
    views = [looked(0), looked(1, sigma, far=1.7), looked(2, sigma), looked(3)]
    codes = torch.tensor(VOLUME_SOURCES)[torch.from_numpy(np.stack(index))]
    options = {"carve": carve, "max_reach": max_reach, "weight": weighting}
    # what was said before a block was there is not known to it: the second time all blocks are
    for _ in range(2):
        volume = volume.replace(
            **{k: torch.zeros_like(getattr(volume, k)) for k in ("distance", "weight", "n_swept", "features")}
        )
        volume = fuse_views(volume, views[0], source=VOLUME_SOURCES[0], **options)
        volume = fuse_views(volume, collate(views[1:3]), source=codes[1:3], **options)
        volume = fuse_views(volume, views[3], source=codes[3:], **options)
    looks = zip(views, index, strict=True)
    distance, weight, swept, coloured, colour, sure = loop_fuse(volume, looks, max_reach, carve, weighting)
    assert sure.mean() > 0.8 and (weight[sure] > 0).any(0).all() and (weight[sure].sum(-1) == 0).any()
    features = volume.features.flatten(0, 1).numpy()[sure]
    assert (volume.n_swept.flatten().numpy()[sure] == swept[sure]).mean() > 0.999 and set(swept[sure]) == {0, 1, 2}
    np.testing.assert_allclose(volume.weight.flatten(0, 1).numpy()[sure], weight[sure], rtol=2e-3, atol=0.05)
    np.testing.assert_allclose(volume.distance.flatten().numpy()[sure], distance[sure], atol=1e-4)
    np.testing.assert_allclose(features[:, 0], coloured[sure], atol=4e-3)
    np.testing.assert_allclose(features[:, 1:], colour[sure], atol=4e-3)


def test_a_volume_changes_only_where_that_is_wanted():
    view = looked(0)
    once = fuse_views(make_volume(0.1, truncation=0.25, channels=2), view)
    before = once.replace(**{name: getattr(once, name).clone() for name in ("distance", "weight", "features")})
    twice = fuse_views(once, view)
    assert torch.equal(once.weight, before.weight) and torch.equal(once.features, before.features)
    torch.testing.assert_close(twice.weight, 2 * once.weight)
    same = fuse_views(once, view, in_place=True)
    assert same is once and torch.equal(once.weight, twice.weight) and torch.equal(once.distance, twice.distance)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda v: v.replace(depth=v.depth[0]),
        lambda v: v.replace(sigma=v.sigma[:, 1:]),
        lambda v: v.replace(features=v.features[..., :1]),
        lambda v: v.replace(features=v.features[:, 1:]),
        lambda v: v.replace(camera=v.camera.replace(f=v.camera.f[0])),
        lambda v: v.replace(camera=v.camera.map(lambda x: torch.cat((x, x)))),
        lambda v: v.replace(T_world_from_cam=v.T_world_from_cam.replace(R=v.T_world_from_cam.R[:, :2])),
        lambda v: v.replace(T_world_from_cam=v.T_world_from_cam.replace(t=v.T_world_from_cam.t[:, :2])),
        lambda v: v.replace(T_world_from_cam=v.T_world_from_cam.map(lambda x: torch.cat((x, x)))),
    ],
)
def test_views_of_other_shapes_are_refused(wrong):
    volume = make_volume(0.1, channels=2)
    for call in (fuse_views, reserve_blocks):
        call(volume, looked(0))
        with pytest.raises(ValueError, match=r"fuse_views: .* expected"):
            call(volume, wrong(looked(0)))


def test_blocks_are_where_the_surface_and_what_is_kept_around_it_are():
    view = looked(0)
    volume = fuse_views(make_volume(0.1, truncation=0.25, channels=2), view)
    v, u = torch.meshgrid(*(torch.arange(float(n)) for n in HW), indexing="ij")
    ray = torch.stack(((u - 10.5) / 22, (v - 6.25) / 18, torch.ones_like(u)), -1).double()
    T, there = view.T_world_from_cam, view.depth[0] > 0
    for along in (-0.25, 0.0, 0.25):
        xyz = (ray * (view.depth[0] + along / ray.norm(dim=-1))[..., None])[there] @ T.R[0].T + T.t[0]
        key = sparse_grid.pack_cells((xyz / 0.8).floor().long())
        assert torch.isin(key, volume.key).all(), along
    assert volume.bytes == len(volume.key) * (8 + 512 * (4 + 4 * 4 + 1 + (1 + 2) * 2))
    assert len(volume.key) < 80 and torch.equal(volume.key, volume.key.sort().values)
    assert make_volume(0.1).truncation == pytest.approx(0.4), "four voxels"


def scattered(seed=0):
    """A volume of three blocks, two of them neighbours, with random distances and unknown voxels."""
    g = torch.Generator().manual_seed(seed)
    key = sparse_grid.pack_cells(torch.tensor([[0, 0, 0], [1, 0, 0], [3, -2, 1]])).sort().values
    distance = 0.3 * (torch.rand(3, 512, generator=g) - 0.5)
    weight = torch.rand(3, 512, 3, generator=g) * 100
    weight[torch.rand(3, 512, generator=g) < 0.3] = 0
    features = torch.rand(3, 512, 3, generator=g).half()
    n_swept = torch.zeros(3, 512, dtype=torch.uint8)
    return Volume(key, distance, weight, n_swept, features, 0.1, 0.15)


@pytest.mark.parametrize("min_weight", [0.0, 60.0])
def test_points_are_the_crossings_of_all_grid_edges(min_weight):
    volume = scattered()
    known, every = {}, {}
    rows = zip(
        voxels(volume).flatten(0, 1).tolist(),
        volume.distance.flatten().tolist(),
        volume.weight.flatten(0, 1).tolist(),
        volume.features.flatten(0, 1).float().tolist(),
        strict=True,
    )
    for place, d, w, f in rows:
        if sum(w) > 0:
            every[tuple(place)] = d, np.array(w), np.array(f)
            if sum(w) >= min_weight:
                known[tuple(place)] = d

    def step(place, axis, sign):
        return tuple(p + sign * (k == axis) for k, p in enumerate(place))

    def slope(place):
        found = []
        for axis in range(3):
            a, b = (every[q][0] if (q := step(place, axis, s)) in every else None for s in (1, -1))
            here = every[place][0]
            both = (a - b) / 2 if a is not None and b is not None else None
            one = (a - here if a is not None else 0) + (here - b if b is not None else 0)
            found.append(one if both is None else both)
        return np.array(found)

    expected = {}
    for place, axis in itertools.product(known, range(3)):
        other = step(place, axis, 1)
        if (
            other not in known
            or (known[place] > 0) == (known[other] > 0)
            or abs(known[place] - known[other]) > 1.5 * 0.15
        ):
            continue
        t = known[place] / (known[place] - known[other])
        mix = lambda a, b, t=t: (1 - t) * a + t * b  # noqa: E731
        weight, feature = (mix(every[place][k], every[other][k]) for k in (1, 2))
        normal = mix(slope(place), slope(other))
        xyz = tuple(round(0.1 * (p + t * (k == axis)), 4) for k, p in enumerate(place))
        expected[xyz] = (
            weight.sum() ** -0.5,
            VOLUME_SOURCES[int(weight.argmax())],
            feature[1:] / feature[0],
            normal / np.linalg.norm(normal),
        )
    surface = extract_points(volume, min_weight=min_weight)
    found = {tuple(round(v, 4) for v in xyz): k for k, xyz in enumerate(surface.xyz.tolist())}
    assert len(surface.xyz) == len(found) == len(expected) > 100
    close = [min(expected, key=lambda q, p=p: math.dist(p, q)) for p in found]
    assert max(math.dist(p, q) for p, q in zip(found, close, strict=True)) < 2e-4 and len(set(close)) == len(found)
    for k, q in zip(found.values(), close, strict=True):
        sigma, source, feature, normal = expected[q]
        assert float(surface.sigma[k]) == pytest.approx(sigma, rel=1e-4) and int(surface.source[k]) == source
        assert surface.features[k].tolist() == pytest.approx(feature.tolist(), rel=2e-3, abs=1e-3)
        assert surface.normal[k].tolist() == pytest.approx(normal.tolist(), abs=2e-3)


@pytest.mark.parametrize("radius", [0.0, 0.1, 5.0])
def test_splats_are_discs_of_which_the_nearest_is_seen(radius):
    g = torch.Generator().manual_seed(3)
    n = 12
    uv = torch.rand(2, n, 2, generator=g) * torch.tensor([24.0, 18.0]) - 2
    depth = 1 + torch.rand(2, n, generator=g).mul(4).round() / 4  # some of equal depth
    sigma, features = torch.rand(2, n, generator=g) + 0.1, torch.rand(2, n, 3, generator=g)
    depth[0, 3], sigma[0, 4], depth[1, 5] = 0.0, math.nan, -1.0
    both = CAMERA.map(lambda x: x.expand(2, 2))
    T = se3.identity(2, uv)
    view = splat_points(both, HW, uv, depth, sigma, features, T_world_from_cam=T, radius=radius, max_radius_px=4)
    for b, v, u in itertools.product(range(2), range(HW[0]), range(HW[1])):
        best = (math.inf, -1)
        for k in range(n):
            z = float(depth[b, k])
            if not (z > 0 and float(sigma[b, k]) > 0):
                continue
            centre = uv[b, k].tolist()
            nearest = tuple(math.floor(c + 0.5) for c in centre)
            size = min(max(22.0 * radius / z, 0.5), 4)
            if (u, v) == nearest or math.dist((u, v), centre) <= size:
                best = min(best, (z, k))
        k = best[1]
        if k < 0:
            assert not view.depth[b, v, u] and not view.sigma[b, v, u] and not view.features[b, v, u].any()
        else:
            assert view.depth[b, v, u] == depth[b, k] and view.sigma[b, v, u] == sigma[b, k]
            assert torch.equal(view.features[b, v, u], features[b, k])
    assert view.T_world_from_cam is T


def test_what_the_sensor_says_keeps_its_noise_its_confidence_and_no_edges():
    depth = torch.full((1, *HW), 2.0)
    depth[:, :, 12:], depth[0, 2, 3], depth[0, 9, 4], depth[0, 10, 8] = 2.19, 0.0, math.nan, -1.0
    depth[:, :, 16:] = 2.5  # more than a tenth beyond 2.19
    conf = torch.full((1, *HW), 2, dtype=torch.uint8)
    conf[0, 5, 5], conf[0, 5, 6] = 1, 0
    image = torch.randint(0, 256, (1, 3, *HW), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    frame = Frame(image, depth, CAMERA, conf=conf)
    T = se3.identity(1, depth)
    view = recording.view_from_sensor(frame, T, sigma_m=0.03, sigma_rel=0.02)
    wanted = depth.nan_to_num().clamp_min(0)
    wanted[:, :, 15:17] = 0
    wanted[0, 5, 6] = 0
    assert torch.equal(view.depth, wanted)
    torch.testing.assert_close(view.sigma, (0.03**2 + (0.02 * wanted) ** 2).sqrt())
    torch.testing.assert_close(view.features[..., :3], image.permute(0, 2, 3, 1) / 255)
    assert torch.equal(view.features[..., 3], conf / 2) and view.camera is CAMERA and view.T_world_from_cam is T
    plain = recording.view_from_sensor(frame.replace(conf=None), T)
    assert plain.depth[0, 5, 6] == 2 and (plain.features[..., 3] == 1).all()
    torch.testing.assert_close(plain.sigma, 0.01 * plain.depth)
    strict = recording.view_from_sensor(frame, T, min_conf=2, edge_rel=0.09)
    assert (
        strict.depth[0, 5, 5] == 0 and not strict.depth[:, :, 11:13].any() and (strict.depth[:, :, :5] > 0).sum() == 68
    )
    lax = recording.view_from_sensor(frame, T, min_conf=0, edge_rel=1.0)
    assert torch.equal(lax.depth, depth.nan_to_num().clamp_min(0))
