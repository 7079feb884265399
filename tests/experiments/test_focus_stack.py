"""Focal stacks: a best slice that is known, motion that is known, formats of the data sets, sweeps without truth."""

import os
from pathlib import Path

import pytest
import torch

from dhtorch.experiments.focal import focus_stack as experiment
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.sharpness import (
    SHARPNESS_MEASURES,
    align_stack,
    depth_at_focus,
    find_sharpest,
    measure_sharpness,
)
from dhtorch.experiments.focal.stacks import FocalStack
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.synthetic.thin_lens import make_lens, render_defocus

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default

ROOT = os.environ.get("DHTORCH_DATA")


def paint(h=96, w=128, seed=0):
    rough = torch.rand(1, 1, h, w, generator=torch.Generator().manual_seed(seed))
    return 0.7 * torch.nn.functional.avg_pool2d(rough, 3, 1, 1) + 0.3 * rough


def slope(h=96, w=128, near=0.6, far=3.0):
    """Depth that rises to the right, evenly in inverse depth."""
    return (1 / torch.linspace(1 / near, 1 / far, w)).repeat(1, h, 1)


def recorded_stack(near, seed, invert=False):
    """A stack of ten images of a slope, in the reverse order where it is inverted."""
    ten = 1 / torch.linspace(2.0, 1 / 7, 10)[None]
    depth = slope(48, 64, near=near, far=6.0)
    shot = render_defocus(paint(48, 64, seed), depth, make_lens(64.0, f_number=0.2), ten)[0].expand(-1, 3, -1, -1)
    images = (255 * shot).round().to(torch.uint8)[None]
    return FocalStack(images.flip(1) if invert else images, focus_m=ten, depth=depth)


def swept(steps, h=96, w=128):
    lens = make_lens(130.0, f_number=0.35)
    return render_defocus(paint(h, w), slope(h, w), lens, 1 / steps[None], step_px=0.5)


@pytest.mark.parametrize("measure", SHARPNESS_MEASURES)
def test_the_best_slice_is_found(measure):
    """Each third of the picture is sharp in one known picture."""
    soft = [gaussian_blur(paint(), s) for s in (0.6, 1.2, 2.4)]
    order = [(0, 1, 2), (1, 0, 1), (2, 1, 0)]  # blur of every third in every picture
    images = torch.stack(
        [torch.cat([soft[b][..., 43 * k : 43 * (k + 1)] for k, b in enumerate(row)], -1) for row in order], 1
    )
    place = find_sharpest(measure_sharpness(images, measure)).place[0]
    for k in range(3):
        assert float(place[:, 43 * k + 12 : 43 * k + 30].median()) == pytest.approx(k, abs=0.3)


@pytest.mark.parametrize("measure", SHARPNESS_MEASURES)
def test_depth_between_slices(measure):
    steps = torch.linspace(1 / 0.5, 1 / 4.0, 8)
    focus = find_sharpest(measure_sharpness(swept(steps), measure))
    found, true = depth_at_focus(focus.place, 1 / steps[None]), slope()
    inner = (..., slice(12, -12), slice(12, -12))
    off = (1 / found - 1 / true)[inner].abs()
    assert float(off.median()) < 0.25 * float(steps[0] - steps[1]), "finer than the slices"
    nearest = depth_at_focus(focus.place.round(), 1 / steps[None])
    assert float(off.median()) < float((1 / nearest - 1 / true)[inner].abs().median())


def test_a_gaussian_peak_is_placed_exactly_and_an_end_stays():
    at = torch.tensor([1.3, 2.0, 2.49, -0.4, 5.2])
    curve = torch.exp(-0.5 * ((torch.arange(5)[:, None] - at) / 1.2) ** 2)[None, :, None]
    place = find_sharpest(curve).place[0, 0]
    torch.testing.assert_close(place, torch.tensor([1.3, 2.0, 2.49, 0.0, 4.0]), atol=1e-3, rtol=0)
    flat = find_sharpest(torch.ones(1, 5, 1, 1))
    assert float(flat.confidence) == 0 and float(find_sharpest(torch.zeros(1, 5, 1, 1)).confidence) == 0


def test_known_motion_is_found_and_undone():
    base = gaussian_blur(paint(120, 160, seed=3), 1.5)
    want = torch.tensor([[0.0, 0.0, 0.0], [0.01, 1.5, -0.7], [-0.012, -2.2, 1.1]])
    y, x = torch.meshgrid(torch.arange(120) - 59.5, torch.arange(160) - 79.5, indexing="ij")
    pictures = []
    for (
        m,
        du,
        dv,
    ) in want.tolist():  # seen at x (1 + m) + shift: the picture's pixel u shows the base at (u - shift) / (1 + m)
        grid = torch.stack((2 * (x - du) / (1 + m) / 160, 2 * (y - dv) / (1 + m) / 120), -1)[None]
        pictures.append(
            torch.nn.functional.grid_sample(base, grid, mode="bicubic", padding_mode="border", align_corners=False)
        )
    moved = torch.stack(pictures, 1)
    aligned, motion = align_stack(moved, reference=0, blur_px=1.0)
    torch.testing.assert_close(motion[0, :, 0], want[:, 0], atol=5e-4, rtol=0)
    torch.testing.assert_close(motion[0, :, 1:], want[:, 1:], atol=0.05, rtol=0)
    before, after = ((z[0, 1:] - base)[..., 12:-12, 12:-12].abs().mean() for z in (moved, aligned))
    assert float(after) < 0.15 * float(before)
    assert torch.equal(aligned[:, 0], moved[:, 0])


def test_the_order_of_a_sweep_without_truth(tmp_path: Path):
    steps = torch.linspace(1 / 0.5, 1 / 4.0, 8)
    measured = measure_sharpness(swept(steps))
    assert experiment.order_correlation(measured) > 0.95 and experiment.halves_correlation(measured) > 0.8
    shuffled = measured[:, torch.randperm(8, generator=torch.Generator().manual_seed(4))]
    assert experiment.order_correlation(shuffled) < 0.8


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_the_order_of_the_real_sweep_is_recovered():
    stacks = formats.open_stacks(Path(ROOT) / "focus_stack_heatsink" / "assets" / "9")
    images = stacks[0].images[:, :, 1:2, ::2, ::2]
    assert experiment.order_correlation(measure_sharpness(images)) > 0.95
