"""The plane sweep against loops, against worlds whose depth is known, and its gradient."""

import itertools

import pytest
import torch

from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry import windows as neighbours
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.filters import gaussian_blur


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def texture(h, w, sigma=1.5, seed=0, dtype=torch.float32):
    """An image of blobs with grey values in [0, 1]."""
    image = gaussian_blur(torch.rand(1, 1, h, w, generator=generator(seed), dtype=torch.float64), sigma)
    return ((image - image.min()) / (image.max() - image.min())).to(dtype)


def wall(depth, t, *, angle=(0.0, 0.0, 0.0), hw=(96, 128), slope=0.0, dtype=torch.float32):
    """View 0, view 1 of a wall at that depth (of the ray straight ahead; it recedes by ``slope`` along x), and truth.

    The wall bears the image of view 0; view 1 is what that shows from elsewhere.
    """
    h, w = hw
    camera = Camera(
        torch.tensor([[110.0, 110.0]], dtype=dtype), torch.tensor([[w / 2 - 0.5, h / 2 - 0.5]], dtype=dtype)
    )
    picture = texture(h + 80, w + 80, dtype=dtype)
    base = plane_sweep.make_reference_view(picture[..., 40:-40, 40:-40].contiguous(), camera)
    T = se3.exp(torch.tensor([[*angle, *t]], dtype=dtype))
    q = (1 - slope * base.ray[..., 0]) / depth  # of the plane z = depth + slope x
    # every pixel of view 1 meets the wall where view 0 shows it
    ray = plane_sweep.pixel_rays(camera, hw)
    back = se3.invert(T)
    d, c = se3.rotate(back.R, ray), back.t[:, None]
    far = (depth + slope * c[..., 0] - c[..., 2]) / (d[..., 2] - slope * d[..., 0])
    x = c + far[..., None] * d
    plain = x[..., :2] / x[..., 2:] * camera.f[:, None] + camera.c[:, None]
    seen = plane_sweep.sample_bilinear(picture, plain + 40)[0].unflatten(-1, hw)
    return base, plane_sweep.SweptView(seen, camera, T), q.unflatten(-1, hw)


def test_a_census_compares_31_neighbours_with_the_middle():
    image = texture(12, 15)
    code = plane_sweep.census_transform(image)[0]
    assert len(set(plane_sweep.CENSUS_OFFSETS)) == 31 and (0, 0) not in plane_sweep.CENSUS_OFFSETS
    for i, j in itertools.product((0, 5, 11), (0, 7, 14)):
        for k, (di, dj) in enumerate(plane_sweep.CENSUS_OFFSETS):
            beside = image[0, 0, min(max(i + di, 0), 11), min(max(j + dj, 0), 14)]
            assert (int(code[i, j]) >> k) & 1 == int(beside < image[0, 0, i, j])
    assert torch.equal(plane_sweep.census_transform(0.25 * image + 0.5)[0], code), "gain and bias change no sign"


@pytest.mark.parametrize(
    ("t", "angle", "lens"),
    [
        ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), None),
        ((-0.15, 0.1, 0.0), (0.05, -0.1, 0.3), None),
        ((0.1, 0.05, 0.15), (0.0, 0.08, 0.0), None),
        ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), [[-0.2, 0.05, 0.001, -0.001, 0.0]]),
    ],
)
def test_the_plane_of_least_cost_is_the_walls(t, angle, lens):
    """Whatever the motion: sideways, turned by seventeen degrees, forwards; or where view 0 has a lens."""
    base, view, _ = wall(2.0, t, angle=angle)
    if lens is not None:
        straight, camera = base.camera, base.camera.replace(distortion=torch.tensor(lens))
        plain = plane_sweep.pixel_rays(camera, base.hw)[..., :2] * straight.f[:, None] + straight.c[:, None]
        seen = plane_sweep.sample_bilinear(base.image, plain)[0].unflatten(-1, base.hw)
        base = plane_sweep.make_reference_view(seen, camera)
    q = torch.linspace(0, 1, 33)[None]  # plane 16 is the wall's
    C = torch.zeros(1, 33, *base.hw, dtype=torch.uint8)
    plane_sweep.add_census_costs(C, base, view, q, torch.tensor([True]))
    inner = C[:, :, 24:-24, 32:-32]
    assert (inner.argmin(1) - 16).abs().float().mean() < 2
    best = plane_sweep.best_plane(plane_sweep.aggregate_costs(C.movedim(1, -1)))
    apart = (best.plane + best.shift - 16)[:, 24:-24, 32:-32].abs()
    assert (apart < 1.5).float().mean() > 0.99 and float(apart.median()) < 0.5
    again = torch.zeros_like(C)
    plane_sweep.add_census_costs(again, base, view, q, torch.tensor([False]))
    assert bool((again == plane_sweep.UNSEEN_COST).all()), "a view that is not wanted says nothing"
    before = C.clone()
    plane_sweep.add_census_costs(C, base, view, q, torch.tensor([False]))
    assert torch.equal(C, before + plane_sweep.UNSEEN_COST), "costs are added up"


def best_path_cost(C, i, j, d, step, jump):
    """Cost of the best path of one line of C (n, D) that ends in element i at plane d, started before it or after."""
    lines = [C[: i + 1], C[i:][::-1]]
    total = 0
    for line in lines:
        path = list(line[0])
        for row in line[1:]:
            low = min(path)
            near = [
                [path[e] + step * (abs(e - k) == 1) for e in (k - 1, k, k + 1) if 0 <= e < len(path)]
                for k in range(len(row))
            ]
            path = [c + min(*near[k], low + jump) - low for k, c in enumerate(row)]
        total += path[d]
    return total


@pytest.mark.parametrize(("views", "step", "jump"), [(1, 3, 18), (2, 3, 18), (1, 1, 4)])
def test_aggregated_costs_are_those_of_four_paths(views, step, jump):
    C = torch.randint(0, 31, (2, 7, 6, 5), generator=generator(3), dtype=torch.uint8)
    S = plane_sweep.aggregate_costs(C, torch.tensor([1, views]), step=step, jump=jump)
    for b, n in ((0, 1), (1, views)):
        for i, j, d in itertools.product((0, 3, 6), (0, 2, 5), (0, 2, 4)):
            down = best_path_cost(C[b, :, j].tolist(), i, j, d, n * step, n * jump)
            across = best_path_cost(C[b, i].tolist(), j, i, d, n * step, n * jump)
            assert int(S[b, i, j, d]) == down + across


def test_the_winner_its_shift_and_its_cost():
    S = torch.randint(0, 400, (1, 40, 5, 12), generator=generator(4), dtype=torch.int16)
    S[0, 0, 0] = torch.tensor([90, 60, 20, 4, 8, 40, 50, 60, 70, 80, 90, 99], dtype=torch.int16)
    found = plane_sweep.best_plane(S)
    for i, j in itertools.product(range(40), range(5)):
        cost = S[0, i, j].tolist()
        best = cost.index(min(cost))
        assert found.plane[0, i, j] == best
        assert found.cost[0, i, j] == cost[best]
        shift = 0.0
        if 0 < best < 11:
            low, mid, high = cost[best - 1 : best + 2]
            shift = min(max(0.5 * (low - high) / (low + high - 2 * mid), -0.5), 0.5)
        assert float(found.shift[0, i, j]) == pytest.approx(shift, abs=1e-6)
    assert 0.2 < float(found.shift[0, 0, 0]) < 0.5, "towards the cheaper neighbour"


@pytest.mark.parametrize("slope", [0.0, 0.8])
@pytest.mark.parametrize("light", [(1.0, 0.0), (0.7, 0.2)])
def test_windows_are_fitted_to_walls_that_recede_and_to_other_light(slope, light):
    base, view, truth = wall(2.0, (0.2, 0.02, 0.03), angle=(0.02, 0.05, 0.0), slope=slope)
    view = view.replace(image=light[0] * view.image + light[1])
    q = truth + 0.01 + 0.01 * torch.randn(truth.shape, generator=generator())  # a quarter of a pixel, and noise
    for _ in range(4):
        q = neighbours.smooth_within_tolerance(q, torch.tensor([0.05]))
        fit = plane_sweep.fit_windows(base, view, plane_sweep.stack_gradients(view.image), q)
        q = q + fit.step.clamp(-0.05, 0.05)
    inner = slice(None), slice(16, -16), slice(24, -24)
    assert float((q - truth)[inner].abs().median()) < 0.0015  # a thirtieth of a pixel
    assert float(fit.correlation[inner].median()) > 0.95 and bool(fit.seen[inner].all())
    assert torch.allclose(fit.motion[inner].norm(dim=-1), torch.tensor(22.0), rtol=0.3)  # f · |t|, about


def test_a_rolling_shutter_turns_points_by_the_rate_times_their_row():
    ray, q, rate = torch.tensor([[[0.5, 0.25, 1.0]]]), torch.zeros(1, 1), torch.tensor([[0.1, 0.2, 0.4]])
    camera = Camera(torch.ones(1, 2), torch.zeros(1, 2))
    still = se3.identity(1, ray)
    uv, in_front = plane_sweep.project_inverse_depth(plane_sweep.SweptView(ray[None], camera, still, rate), ray, q)
    by_hand = ray[0, 0] + torch.linalg.cross(0.25 * rate[0], ray[0, 0])
    torch.testing.assert_close(uv[0, 0], by_hand[:2] / by_hand[2])
    assert in_front.all()


def test_planes_and_edges_stay_when_a_map_is_smoothed():
    v, u = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    slope = (0.3 + 0.01 * u - 0.005 * v)[None].double()
    torch.testing.assert_close(neighbours.smooth_within_tolerance(slope, torch.tensor([0.1])), slope)
    step = torch.where(u < 15, 0.3, 0.8)[None]
    torch.testing.assert_close(neighbours.smooth_within_tolerance(step, torch.tensor([0.1])), step)
    noisy = 0.5 + 0.02 * torch.randn(1, 40, 50, generator=generator())
    assert float(neighbours.smooth_within_tolerance(noisy, torch.tensor([0.2])).std()) < 0.3 * float(noisy.std())


def test_what_a_nearer_surface_covers_is_hidden():
    base, view, _ = wall(2.0, (0.2, 0.0, 0.0))
    q = torch.full((1, *base.hw), 0.25)
    q[:, :, 40:70] = 0.75  # a post before the wall, 11 px further along in view 1
    found = plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, torch.tensor([0.1]))
    assert bool(found[:, :, 72:80].all()) and not bool(found[:, :, 40:70].any()) and not bool(found[:, :, :39].any())
    assert not bool(plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, torch.tensor([0.6])).any())


def test_rivals_are_the_best_places_further_away():
    S = torch.randint(0, 400, (2, 7, 5, 12), generator=generator(6), dtype=torch.int16)
    best, reach = plane_sweep.best_plane(S), torch.tensor([2.0, 4.0])
    some = S[:, ::2, ::2]
    found = plane_sweep.second_best_margin(some, best, reach)
    for b, i, j in itertools.product(range(2), range(7), range(5)):
        asked = S[b, i - i % 2, j - j % 2].tolist()
        at = asked.index(min(asked))
        others = [cost for k, cost in enumerate(asked) if abs(k - at) > reach[b]]
        assert int(found[b, i, j]) == min(others) - asked[at]
    assert bool((plane_sweep.second_best_margin(some, best, torch.tensor([20.0, 20.0])) > 30_000).all()), (
        "all in reach: there is none"
    )
