"""The drawing of a map: where it is seen from, how large it is drawn, and what each of its two pictures shows."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dhtorch.codes import Source
from dhtorch.integrate import picture
from dhtorch.integrate.surface import Surface
from dhtorch.records import Pose
from dhtorch.viz.plots.colours import SOURCE_COLOURS

VOXEL_M = 0.05
UP = (0.0, -1.0, 0.0)


def wall(x0=0.0, source=Source.SENSOR, rgb=(0.25, 0.5, 0.75), facing=-1.0):
    """A square wall 3 m in front of the origin that faces it, a point every 5 cm."""
    steps = torch.arange(-1, 1 + 1e-6, VOXEL_M)
    x, y = torch.meshgrid(steps, steps, indexing="xy")
    xyz = torch.stack((x0 + x.flatten(), y.flatten(), torch.full((x.numel(),), 3.0)), 1)
    n = len(xyz)
    features = torch.tensor([*rgb, 0.5]).expand(n, 4)
    normal = torch.tensor([0.0, 0.0, facing]).expand(n, 3)
    return Surface(xyz, normal, features, torch.full((n,), 0.01), torch.full((n,), source, dtype=torch.int32))


def camera_at(*place, R=torch.eye(3)):  # noqa: B008  (looks along z)
    return Pose(R[None], torch.tensor([place]))


DOWN = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # z of the camera = +y
BACK = torch.diag(torch.tensor([-1.0, 1, -1]))


@pytest.fixture
def drawn(monkeypatch):
    """Draws a map: the axes of both pictures, their titles and pixels, and the words of the legend."""
    figures = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: figures.append(figure))

    def call(surface, cameras, **options):
        picture.draw_map("a.png", surface, cameras, UP, voxel=VOXEL_M, **options)
        axes, legends = figures[-1].axes, figures[-1].legends
        words = [text.get_text() for legend in legends for text in legend.get_texts()]
        images = [each.images[0].get_array() for each in axes]
        return SimpleNamespace(
            axes=axes, titles=[each.get_title("left") for each in axes], images=images, words=words, legends=legends
        )

    return call


@pytest.mark.parametrize(
    ("cameras", "direction", "hw"),
    [
        # ahead = z, above = -y, beside = ahead x above = x: from behind, above and beside the cameras
        ([camera_at(0.0, 0.0, 0.0), camera_at(0.2, 0.0, 0.0)], (-0.25, 0.45, 1.0), (150, 200)),
        ([camera_at(-0.5, 0.0, 1.0), camera_at(0.0, 0.0, 1.0), camera_at(0.5, 0.0, 1.0)], (-0.25, 0.45, 1.0), (100, 300)),
        ([camera_at(0.0, 0.0, 0.0, R=DOWN)], (1.0, 0.45, 0.25), (150, 200)),
        ([camera_at(0.0, 0.0, 0.0), camera_at(0.0, 0.0, 0.0, R=BACK)], (-0.25, 0.45, 1.0), (150, 200)),
    ],
)  # fmt: skip
def test_a_wall_fills_nine_tenths_of_the_narrower_side_seen_from_behind_and_above(drawn, cameras, direction, hw):
    surface, size = wall(), np.array(hw[::-1])
    z = np.array(direction) / np.linalg.norm(direction)
    x = np.cross([0, 1, 0], z) / np.linalg.norm(np.cross([0, 1, 0], z))  # level, so that up is up in the picture
    R, xyz = np.stack((x, np.cross(z, x), z)), surface.xyz.double().numpy()
    middle = np.median(xyz, 0)
    eye = middle - 2.2 * np.quantile(np.linalg.norm(xyz - middle, axis=1), 0.9) * z
    points, path = ((each - eye) @ R.T for each in (xyz, np.concatenate([c.t for c in cameras])))
    path = path[path[:, 2] > VOXEL_M]
    flat = np.concatenate((points, path))[:, :2] / np.concatenate((points, path))[:, 2:]
    low, high = np.quantile(flat, (0.005, 0.995), axis=0)
    focal = (0.9 * size / (high - low)).min()
    at = focal * flat + size / 2 - focal * (low + high) / 2
    found = drawn(surface, cameras, hw=hw)
    inside = ((at >= -0.5) & (at <= size - 0.5)).all(1)
    for axes in found.axes:
        dots, bar = (line.get_xydata() for line in axes.lines)
        np.testing.assert_allclose(dots, at[len(xyz) :][inside[len(xyz) :]], atol=1e-6)
        metres = float(axes.texts[0].get_text().removesuffix(" m"))
        assert np.ptp(bar, 0) == pytest.approx([metres * focal / np.median(points[:, 2]), 0])
    column, row = np.rint(at[: len(xyz)][inside[: len(xyz)]]).astype(int).clip(0, size - 1).T
    assert (found.images[0][row, column] == (0.25, 0.5, 0.75)).all() and (found.images[0] == 1).all(-1).any()


def test_both_pictures_show_the_walls_in_their_colours_and_in_those_of_their_sources(drawn):
    """Walls that face away are left out and counted."""
    own = {Source.SENSOR: (0.25, 0.5, 0.75), Source.RECOVERED: (0.75, 0.25, 0.5), Source.SWEPT: (0.0, 1.0, 0.0)}
    walls = [wall(2.1 * k, code, rgb, (-1.0, -1.0, 1.0)[k]) for k, (code, rgb) in enumerate(own.items())]
    parts = [[getattr(s, name) for s in walls] for name in ("xyz", "normal", "features", "sigma", "source")]
    surface = Surface(*(torch.cat(each) for each in parts))
    found = drawn(surface, [camera_at(-0.5, 0.0, 0.0), camera_at(0.5, 0.0, 0.0)], title="a scene", hw=(150, 200))
    assert found.titles == ["a scene: map of 2 views", "Sensor, recovered and swept"]
    assert found.words == [f"{name} {len(walls[0].xyz)}" for name in ("sensor", "recovered", "recovered (swept)")]
    colours = [SOURCE_COLOURS[code] for code in own]
    assert [handle.get_color() for handle in found.legends[0].legend_handles] == colours
    one, by_source = found.images
    shown = ~(one == 1).all(-1)
    assert 0.2 < shown.mean() < 0.9 and ((by_source == 1).all(-1) == ~shown).all()
    # seen along z, with x level: the walls' normal, lit from the upper left in the picture
    z = np.array([-0.25, 0.45, 1.0]) / np.linalg.norm([-0.25, 0.45, 1.0])
    x = np.array([z[2], 0, -z[0]]) / np.hypot(z[0], z[2])
    shade = 0.35 + 0.65 * abs(-np.stack((x, np.cross(z, x), z))[:, 2] @ np.array([0.3, -0.5, -0.8]))
    masks = [(np.abs(one - rgb) < 1e-6).all(-1) for rgb in own.values()]
    assert sum(masks[:2]).sum() == shown.sum() and not masks[2].any()
    assert np.nonzero(masks[0])[1].mean() < np.nonzero(masks[1])[1].mean(), "what is left is left"
    for mask, colour in itertools.islice(zip(masks, colours, strict=True), 2):
        rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        np.testing.assert_allclose(by_source[mask], np.broadcast_to(rgb * shade, by_source[mask].shape), atol=1e-6)


def test_a_map_of_which_nothing_is_seen_is_white_and_has_no_scale(drawn):
    nothing = wall().map(lambda x: x[:0])
    for surface, place, path in ((nothing, (1.0, 2.0, 3.0), [[20, 15]]), (wall(facing=1.0), (0.0, 0.0, -50.0), [])):
        found = drawn(surface, [camera_at(*place)], hw=(30, 40))
        assert found.titles == ["Map of 1 view", "Sensor and recovered"]
        assert found.words == [f"sensor {len(surface.xyz)}", "recovered 0"]
        assert all((each == 1).all() for each in found.images) and not any(axes.texts for axes in found.axes)
        np.testing.assert_allclose(found.axes[0].lines[0].get_xydata(), np.reshape(path, (-1, 2)), atol=1e-6)


@pytest.mark.parametrize(
    ("metre", "label"),
    [(69.3, "0.5 m"), (69.2, "1 m"), (34.6, "2 m"), (1e6, "0.001 m"), (0.0173, "2000 m"), (1e-9, "5000 m")],
)
def test_the_bar_is_the_longest_round_length_within_a_fifth(monkeypatch, metre, label):
    saved = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: saved.append(figure))
    picture._side_by_side("a.png", {"one": np.zeros((100, 346, 3))}, np.zeros((0, 2)), {}, metre)
    assert saved[0].axes[0].texts[0].get_text() == label
