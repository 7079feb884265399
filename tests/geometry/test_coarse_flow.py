"""Where to look first: coarse motion of whole images, against motions that are known."""

import math
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from support.contract_rows import equal
from torch import Tensor

from dhtorch.geometry import coarse_flow as start
from dhtorch.records import TrackHint
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

H, W = 240, 320


def _texture(seed: int) -> Tensor:
    """(1, 1, 3 H, 3 W) grey values with detail of every size."""
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 1, 3 * H, 3 * W)
    for size in (4, 12, 36, 108, 324):
        noise = torch.rand(1, 1, 3 * H // size + 2, 3 * W // size + 2, generator=g)
        total = total + size**0.5 * F.interpolate(noise, (3 * H, 3 * W), mode="bicubic", align_corners=False)
    total = total - total.amin()
    return total / total.amax()


def _pair(
    seed: int, shift: tuple[float, float], turn_deg: float = 0.0, zoom: float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Two images of one texture, and where (H, W, 2) each pixel of the first lies in the second."""
    world = _texture(seed)
    a = math.radians(turn_deg)
    A = zoom * torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    middle = torch.tensor([(W - 1) / 2, (H - 1) / 2])
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")
    uv = torch.stack([u, v], -1)
    there = (uv - middle) @ A.T + middle + torch.tensor(shift)
    back = (uv - middle - torch.tensor(shift)) @ torch.linalg.inv(A).T + middle

    def seen(at: Tensor) -> Tensor:
        place = (at + torch.tensor([float(W), float(H)]) + 0.5) / torch.tensor([1.5 * W, 1.5 * H]) - 1
        return F.grid_sample(world, place[None], mode="bilinear", align_corners=False)

    return seen(uv), seen(back), there


def _share_near(flow: start.CoarseFlow, there: Tensor, limit_px: float) -> float:
    """Share of the pixels still in sight whose start is closer than that to where they went."""
    v, u = torch.meshgrid(torch.arange(8, H - 8, 8), torch.arange(8, W - 8, 8), indexing="ij")
    uv = torch.stack([u, v], -1).reshape(1, -1, 2)
    true = there[v, u].reshape(-1, 2)
    inside = ((true > 8) & (true < torch.tensor([W - 8.0, H - 8.0]))).all(-1)
    miss = (flow.at(uv.float())[0] - true).norm(dim=-1)
    return float((miss[inside] < limit_px).float().mean())


@pytest.mark.parametrize(
    ("seed", "shift", "turn_deg", "zoom", "gain", "bias"),
    [
        *(
            (seed, shift, 0.0, 1.0, 1.0, 0.0)
            for seed in (0, 1)
            for shift in ((0.0, 0.0), (80.0, 0.0), (-75.0, 40.0), (10.0, -70.0))
        ),
        *(
            (seed, (20.0, -12.0), *turned, 1.0, 0.0)
            for seed in (2, 3)
            for turned in ((30.0, 1.0), (-15.0, 1.0), (0.0, 1.4), (0.0, 1 / 1.4), (20.0, 1.3), (-25.0, 0.75))
        ),
        *((4, (40.0, 20.0), 0.0, 1.0, *light) for light in ((0.25, 0.0), (0.5, 0.3), (4.0, -1.2))),
    ],
)
def test_a_motion_is_found_in_any_light_and_at_any_size(seed, shift, turn_deg, zoom, gain, bias):
    """Shifts of a quarter of the width, turns, zooms; also where image 1 has twice the size. Image 0 once more moves a
    batch mate, which changes no bit."""
    a, b, there = _pair(seed, shift, turn_deg, zoom)
    flow = start.coarse_flow(a, gain * b + bias)
    limit = 8.0 if (turn_deg, zoom) == (0.0, 1.0) else 10.0 * max(1.0, zoom)
    assert _share_near(flow, there, limit) > 0.9
    assert turn_deg or zoom != 1 or torch.equal(flow.linear[0], torch.eye(2))
    large = F.interpolate(b, scale_factor=2, mode="bilinear", align_corners=False)
    assert _share_near(start.coarse_flow(a, large), (there + 0.5) * 2 - 0.5, 2 * limit) > 0.8
    both = start.coarse_flow(torch.cat((a, a)), torch.cat((gain * b + bias, a)))
    equal(flow, both[:1])
    known = start.coarse_flow(a, gain * b + bias, linear=flow.linear)
    assert torch.equal(known.uv_1, flow.uv_1)


@pytest.mark.parametrize("long", [16, 60, 64, 400])
def test_a_small_image_says_where_its_pixels_lie(long):
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")
    for axis, ramp in enumerate((u, v)):
        small = start.downscale((ramp / W)[None, None], long)
        h, w = small.grey.shape[-2:]
        assert max(h, w) <= long or small.scale == 1
        at = torch.stack(torch.meshgrid(torch.arange(float(w)), torch.arange(float(h)), indexing="xy"), -1)
        torch.testing.assert_close(small.grey[0, 0] * W, small.to_image(at)[..., axis], atol=1e-3, rtol=1e-5)


def test_pictures_of_different_things_have_no_start() -> None:
    flow = start.coarse_flow(
        _pair(5, (0.0, 0.0))[0], torch.rand(1, 1, H, W, generator=torch.Generator().manual_seed(1))
    )
    assert flow.uv_1.isnan().all() and torch.equal(flow.linear[0], torch.eye(2))
    flat = torch.full((1, 1, H, W), 0.5)
    assert start.coarse_flow(flat, flat).at(torch.zeros(1, 3, 2)).isnan().all()


def test_neighbours_tell_what_a_repeated_pattern_cannot() -> None:
    a, b, there = _pair(8, (40.0, 0.0))
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")

    def papered(image: Tensor, shift: float) -> Tensor:
        stripes = 0.5 + 0.3 * torch.sin((u - shift) * (2 * math.pi / 40)) * torch.cos(v * (2 * math.pi / 48))
        inside = ((u - shift - W / 2).abs() < 80) & ((v - H / 2).abs() < 60)
        return torch.where(inside, stripes, image)

    flow = start.coarse_flow(papered(a, 0.0), papered(b, 40.0))
    assert _share_near(flow, there, 10.0) > 0.9


def test_what_is_upright_was_read_where_its_pixels_lie() -> None:
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")
    a = math.radians(20.0)
    linear = 0.7 * torch.tensor([[[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]])
    at = start.apply_similarity(linear, torch.stack([u, v], -1).reshape(1, -1, 2), (H, W)).reshape(H, W, 2)
    inside = ((at >= 0) & (at <= torch.tensor([W - 1.0, H - 1.0]))).all(-1)
    for axis, ramp in enumerate((u, v)):
        seen = start.undo_similarity((ramp / W)[None, None], linear, torch.tensor([0.5]))
        torch.testing.assert_close(seen[0, 0][inside] * W * 0.5, at[..., axis][inside], atol=2e-3, rtol=0)
    same = start.undo_similarity(u[None, None] / W, torch.eye(2)[None], torch.ones(1))
    assert torch.equal(same[0, 0], u / W)
    places = 300 * torch.rand(1, 500, 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(start.apply_similarity(torch.eye(2)[None], places, (H, W)), places)


MOTIONS = [
    ((80.0, 10.0), 0.0, 1.0),
    ((20.0, -12.0), 30.0, 1.0),
    ((20.0, -12.0), -22.0, 1.0),
    ((10.0, 5.0), 0.0, 1.5),
    ((10.0, 5.0), 0.0, 0.7),
]


@pytest.mark.parametrize("shift, turn_deg, zoom", MOTIONS)
def test_a_tracker_with_a_start_follows_what_one_without_loses(
    shift: tuple[float, float], turn_deg: float, zoom: float
) -> None:
    a, b, there = _pair(3, shift, turn_deg, zoom)
    b = 0.3 * b + 0.1
    v, u = torch.meshgrid(torch.arange(20, H - 20, 20), torch.arange(20, W - 20, 20), indexing="ij")
    uv = torch.stack([u, v], -1).reshape(1, -1, 2)
    true = there[uv[0, :, 1], uv[0, :, 0]]
    inside = ((true > 10) & (true < torch.tensor([W - 10.0, H - 10.0]))).all(-1)
    search = partial(lucas_kanade, levels=5, normalise="bias")
    share = {}
    for name, begin in (("without", None), ("with", start.coarse_flow)):
        tracks = lucas_kanade_affine(a, b, uv.float(), levels=5, track=search, start=begin)
        miss = (tracks.uv_1[0] - true).norm(dim=-1)
        share[name] = float((tracks.valid[0] & (miss < 0.2))[inside].float().mean())
        assert float((tracks.valid[0] & (miss > 1.0))[inside].float().mean()) < (0.03 if begin else 0.3)
    assert share["with"] > 0.85 and share["with"] > share["without"] + 0.2


def test_the_way_back_starts_from_its_own_estimate() -> None:
    """A start that is wrong on one way only is found out by the other."""
    a, b, _ = _pair(7, (60.0, 0.0))
    uv = torch.tensor([[[100.0, 100.0], [150.0, 120.0], [90.0, 160.0]]])
    right = start.coarse_flow(a, b), start.coarse_flow(b, a)
    track = partial(lucas_kanade, a, b, uv, levels=2)
    assert track(hint=TrackHint(flows=right)).valid.all()
    wrong = right[1].replace(uv_1=right[1].uv_1 + 90.0)
    assert not track(hint=TrackHint(flows=(right[0], wrong))).valid.any()
    assert not track().valid.any()  # two levels do not reach so far
    silent = right[0].replace(uv_1=torch.full_like(right[0].uv_1, torch.nan))
    nowhere = track(hint=TrackHint(flows=(silent, silent)))
    assert torch.equal(nowhere.uv_1, track().uv_1) or not nowhere.valid.any()
