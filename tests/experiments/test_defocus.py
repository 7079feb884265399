"""Depth from defocus: blur of known radius, the thin lens against exact light fields, both ambiguities, the verdict."""

import math

import pytest
import torch

from dhtorch.experiments.focal.blur import (
    BlurMap,
    estimate_blur,
    guess_side_by_colour,
    guess_side_by_height,
    inverse_depth_from_blur,
)
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.thin_lens import spot_diameter
from dhtorch.records import Pose
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.thin_lens import make_lens, render_defocus


def edge(angle_deg=0.0, contrast=0.8):
    """A step edge through the middle of a picture, sampled finely and then averaged."""
    y, x = torch.meshgrid(torch.arange(384) - 191.5, torch.arange(640) - 319.5, indexing="ij")
    a = math.radians(angle_deg)
    step = ((x * math.cos(a) + y * math.sin(a)) > 0).double() * contrast + 0.1
    return torch.nn.functional.avg_pool2d(step[None, None], 4)


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
@pytest.mark.parametrize("contrast", [0.1, 0.8])
def test_a_gaussian_blur_of_known_radius_is_recovered(sigma, angle, contrast):
    blur = estimate_blur(gaussian_blur(edge(angle, contrast), sigma), noise=0.0, window_px=12.0)
    assert bool(blur.valid[0, 48, 80])
    # Between the blur alone and that with a pixel's own square, as the edge falls on the pixels; the window costs 3 %.
    assert 0.93 * sigma < float(blur.sigma[0, 48, 80]) < 1.02 * math.sqrt(sigma**2 + 1 / 12)


def test_noise_is_taken_off():
    draw = torch.Generator().manual_seed(0)
    clean = gaussian_blur(edge(), 2.0)
    noisy = clean + 4 / 255 * torch.randn(clean.shape, generator=draw)
    found = estimate_blur(noisy, noise=4 / 255).sigma[0, 40:56, 78:82].median()
    want = estimate_blur(clean, noise=0.0).sigma[0, 40:56, 78:82].median()
    assert float(found) == pytest.approx(float(want), rel=0.08)
    blind = estimate_blur(noisy, noise=1e-6).sigma[0, 40:56, 78:82].median()
    assert float(blind) < float(found), "noise that is not taken off reads as sharpness"
    flat = 0.5 + 4 / 255 * torch.randn(1, 1, 96, 160, generator=draw)
    assert float(estimate_blur(flat, noise=4 / 255).valid.float().mean()) == 0


def test_a_point_becomes_a_disc_of_its_diameter():
    lens, depth = make_lens(400.0, f_number=0.7), torch.full((1, 64, 64), 2.0)
    point = torch.zeros(1, 1, 64, 64)
    point[..., 32, 32] = 1.0
    seen = render_defocus(point, depth, lens, torch.tensor([[1.0]]), gamma=1.0)[0, 0, 0]
    diameter = float(spot_diameter(lens, torch.tensor([[2.0]]), torch.tensor([1.0])))
    y, x = torch.meshgrid(torch.arange(64) - 32.0, torch.arange(64) - 32.0, indexing="ij")
    assert float(seen.sum()) == pytest.approx(1.0, rel=0.1)
    r = (x * x + y * y).sqrt()
    inside, half = float(seen[r < diameter / 2 + 0.7].sum()), float(seen[r < diameter / 8**0.5].sum())
    assert inside > 0.93 and half == pytest.approx(0.5, abs=0.06)  # uniform: half the area holds half the light
    sharp = render_defocus(point, depth, lens, torch.tensor([[2.0]]), gamma=1.0)[0, 0]
    torch.testing.assert_close(sharp, point[0], atol=1e-5, rtol=0)


@pytest.mark.slow
def test_the_lens_covers_what_is_behind_as_an_exact_light_field_does():
    """The mean of pinhole pictures from all over the aperture is the truth, occlusion included."""

    def pictured(change=lambda room: None):
        """The room and what a pinhole sees of it, as a share of white."""
        room = SyntheticRoom(hw=(60, 80), lidar="exact", n_frames=1, image_noise=0.0)
        change(room)
        return room, room[0].image.float() / 255

    (room, pinhole), focus = pictured(), 1.6
    pose, depth = room.true_poses[:1], room.truth(0)["depth"]
    aperture = 0.15
    lens = make_lens(float(room.camera.f[0, 0]), f_number=0.035 / aperture)
    made = render_defocus(pinhole, depth, lens, torch.tensor([[focus]]))[0, 0]
    total, count = torch.zeros_like(made), 0
    for i in range(4):
        for k in range(4):
            at = torch.tensor([(i - 1.5) / 4 * aperture, (k - 1.5) / 4 * aperture], dtype=torch.float64)
            if float(at.norm()) <= aperture / 2:

                def lean(other, at=at):
                    other.true_poses = Pose(pose.R, pose.t + pose.R @ torch.cat((at, at.new_zeros(1))))
                    other.camera = room.camera.replace(c=room.camera.c + room.camera.f * at.float() / focus)

                total, count = total + pictured(lean)[1][0] ** 2, count + 1
    exact = (total / count).sqrt()
    psnr = [-10 * math.log10(float(((x - exact) ** 2).mean())) for x in (made, pinhole[0])]
    assert psnr[0] > 32 and psnr[0] > psnr[1] + 6, psnr


def test_inverse_depth_needs_the_side():
    lens, focus = make_lens(400.0, f_number=0.7), torch.tensor([2.0])
    spot = spot_diameter(lens, torch.tensor([[1.25, 5.0]]), focus)
    assert float(spot[0, 0]) == pytest.approx(-float(spot[0, 1])), "two depths, one spot"
    blur = BlurMap(0.25 * spot.abs()[..., None], torch.ones(1, 2, 1), torch.ones(1, 2, 1, dtype=torch.bool))
    found = inverse_depth_from_blur(blur, torch.sign(spot)[..., None], lens, focus)
    torch.testing.assert_close(found[0, :, 0], torch.tensor([0.8, 0.2]), rtol=1e-5, atol=0)
    huge = blur.replace(sigma=100 * blur.sigma)
    assert inverse_depth_from_blur(huge, torch.ones(1, 2, 1), lens, focus)[0, :, 0].tolist() == [0, 0], (
        "as far as can be"
    )
    silent = blur.replace(valid=torch.zeros(1, 2, 1, dtype=torch.bool))
    assert bool(inverse_depth_from_blur(silent, torch.ones(1, 2, 1), lens, focus).isnan().all())


def test_sides():
    sigma = torch.full((1, 40, 30), 3.0)
    sigma[:, 25:28] = 0.2
    side = guess_side_by_height(BlurMap(sigma, torch.ones_like(sigma), torch.ones_like(sigma, dtype=torch.bool)))
    assert bool((side[0, :20] == 1).all()) and bool((side[0, 30:] == -1).all())
    red_sharp = torch.cat([gaussian_blur(edge().float(), s) for s in (1.0, 1.5, 2.0)], 1)
    assert (
        float(guess_side_by_colour(red_sharp)[0, 48, 80]) == 1
        and float(guess_side_by_colour(red_sharp.flip(1))[0, 48, 80]) == -1
    )
