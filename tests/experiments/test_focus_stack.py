"""Focal stacks: a best slice that is known, motion that is known, formats of the data sets, sweeps without truth."""

import os
from pathlib import Path

import pytest
import torch
from support.writers import focal as stack_writers

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
from dhtorch.experiments.protocol import Settings
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.synthetic.thin_lens import make_lens, render_defocus
from dhtorch.synthetic.viewpoints import open_viewpoints

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default

ROOT = os.environ.get("DHTORCH_DATA")


def paint(h=96, w=128, seed=0):
    rough = torch.rand(1, 1, h, w, generator=torch.Generator().manual_seed(seed))
    return 0.7 * torch.nn.functional.avg_pool2d(rough, 3, 1, 1) + 0.3 * rough


def slope(h=96, w=128, near=0.6, far=3.0):
    """Depth that rises to the right, evenly in inverse depth."""
    return (1 / torch.linspace(1 / near, 1 / far, w)).repeat(1, h, 1)


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


def test_stacks_in_the_formats_of_the_data_sets(tmp_path: Path):
    steps = 1 / torch.tensor([0.1, 0.15, 0.3, 0.7, 1.5])
    near = slope(48, 64, near=0.12, far=1.4)
    lens = make_lens(64.0, f_number=2.0)
    shot = render_defocus(paint(48, 64), near, lens, 1 / steps[None])[0].expand(-1, 3, -1, -1)
    images = (255 * shot).round().to(torch.uint8)[None]
    stack_writers.write_fod500(
        tmp_path / "fod", {0: FocalStack(images, depth=near), 1: FocalStack(images.flip(-1), depth=near.flip(-1))}
    )
    outcome = experiment.run([formats.open_stacks(tmp_path / "fod")], {}, None, Settings(), stride_px=1, window_px=3.0)
    assert set(outcome.scenes("given")) == {"fod/000000", "fod/000001"} and outcome.verdict == "undecided"
    assert all(row["rank_corr"] > 0.9 and row["flip_share"] == 0 for row in outcome.scenes("given").values())
    assert outcome.summary["given.flip_share"]["value"] == 0

    ten = 1 / torch.linspace(2.0, 1 / 7, 10)[None]
    far = slope(48, 64, near=0.6, far=6.0)
    shot = render_defocus(paint(48, 64), far, make_lens(64.0, f_number=0.2), ten)[0].expand(-1, 3, -1, -1)
    stack = FocalStack((255 * shot).round().to(torch.uint8)[None], depth=far)
    stack_writers.write_ddff12(tmp_path / "d.h5", {"val": [stack]})
    outcome = experiment.run([formats.open_stacks(tmp_path / "d.h5")], {}, None, Settings(), stride_px=1, window_px=3.0)
    (row,) = outcome.scenes("given").values()
    assert row["rank_corr"] > 0.9 and row["gated_corr"] > 0.9


def room(near, seed, invert=False):
    """A stack of ten pictures as a light-field camera would refocus them; read back to front where inverted."""
    ten = 1 / torch.linspace(2.0, 1 / 7, 10)[None]
    depth = slope(48, 64, near=near, far=6.0)
    shot = render_defocus(paint(48, 64, seed), depth, make_lens(64.0, f_number=0.2), ten)[0].expand(-1, 3, -1, -1)
    images = (255 * shot).round().to(torch.uint8)[None]
    return FocalStack(images.flip(1) if invert else images, depth=depth)


def test_intervals_resample_rooms_and_not_stacks_of_one_room(tmp_path: Path):
    """Three stacks of one room, two of another: two scenes, whichever room has more stacks."""
    made = [room(0.6, 0), room(0.7, 1), room(0.8, 2, invert=True), room(0.6, 3, invert=True), room(0.9, 4, invert=True)]
    stack_writers.write_ddff12(tmp_path / "d.h5", {"train": made})
    asked = {"stride_px": 1, "window_px": 3.0, "measures": ("modified_laplacian",)}

    def run(**options):
        return experiment.run([formats.open_stacks(tmp_path / "d.h5", **options)], {}, None, Settings(), **asked)

    rooms, unknown = run(per_scene=3), run()
    assert set(rooms.scenes("given")) == {"d/train/scene_00", "d/train/scene_01"} and rooms.n_pairs == 5
    assert [row["n_pairs"] for row in rooms.scenes("given").values()] == [3, 2]
    assert [row["flip_share"] for row in rooms.scenes("given").values()] == [pytest.approx(1 / 3), 1.0]
    summary = rooms.summary["given.rank_corr"]
    said = [row["rank_corr"] for row in rooms.scenes("given").values()]
    assert summary["n"] == 2 and summary["value"] == pytest.approx(sum(said) / 2)
    assert rooms.summary["given.flip_share"]["value"] == pytest.approx(2 / 3) and said[0] > 0 > said[1]
    stacks = [r for r in rooms.rows if r["pair"] is not None and r["method"] == "given"]
    assert [r["pair"] for r in stacks] == [[i, i] for i in range(5)] and all(
        r["n_candidates"] == 48 * 64 for r in stacks
    )
    assert list(unknown.scenes("given")) == ["d/train"] and unknown.summary["given.rank_corr"]["n"] == 1
    assert unknown.summary["given.rank_corr"]["low"] is None, "one room has no interval"


def test_the_order_of_a_sweep_without_truth(tmp_path: Path):
    steps = torch.linspace(1 / 0.5, 1 / 4.0, 8)
    measured = measure_sharpness(swept(steps))
    assert experiment.order_correlation(measured) > 0.95 and experiment.halves_correlation(measured) > 0.8
    shuffled = measured[:, torch.randperm(8, generator=torch.Generator().manual_seed(4))]
    assert experiment.order_correlation(shuffled) < 0.8


def test_rendered_stacks_have_every_condition():
    (view,) = open_viewpoints(1, hw=(60, 80))
    outcome = experiment.run([view], {}, None, Settings(), measures=("gradient_energy",), slices=5, window_px=3.0)
    assert {r["method"] for r in outcome.rows} == set(experiment.RENDERED_CONDITIONS)
    assert outcome.scenes("clean")["viewpoint_00"]["rank_corr"] > 0.5
    assert outcome.verdict in ("supported", "refuted")


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_the_order_of_the_real_sweep_is_recovered():
    stacks = formats.open_stacks(Path(ROOT) / "focus_stack_heatsink" / "assets" / "9")
    images = stacks[0].images[:, :, 1:2, ::2, ::2]
    assert experiment.order_correlation(measure_sharpness(images)) > 0.95
