"""The drawing of a map: where it is seen from, how large it is drawn, and what each of its two pictures shows."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dhtorch.codes import Source
from dhtorch.geometry import se3
from dhtorch.integrate import picture
from dhtorch.integrate.surface import Surface
from dhtorch.records import Pose
from dhtorch.viz.plots.colours import SOURCE_COLOURS

VOXEL_M = 0.05
UP = (0.0, -1.0, 0.0)


def wall(depth=3.0, half=1.0, source=Source.SENSOR, rgb=(0.25, 0.5, 0.75)):
    """A square wall in front of the origin that faces it, a point every 5 cm."""
    steps = torch.arange(-half, half + 1e-6, VOXEL_M)
    x, y = torch.meshgrid(steps, steps, indexing="xy")
    xyz = torch.stack((x.flatten(), y.flatten(), torch.full((x.numel(),), depth)), 1)
    n = len(xyz)
    features = torch.tensor([*rgb, 0.5]).expand(n, 4)
    normal = torch.tensor([0.0, 0.0, -1.0]).expand(n, 3)
    return Surface(xyz, normal, features, torch.full((n,), 0.01), torch.full((n,), source, dtype=torch.int32))


def joined(*surfaces):
    """One surface of all points."""
    parts = [[getattr(s, name) for s in surfaces] for name in ("xyz", "normal", "features", "sigma", "source")]
    return Surface(*(torch.cat(each) for each in parts))


def cameras_at(*places):
    """Cameras that look along z, by their places in the world."""
    return [Pose(torch.eye(3)[None], torch.tensor([place])) for place in places]


@pytest.fixture
def drawn(monkeypatch):
    """Draws a map and returns what is handed to the canvas."""

    def call(surface, cameras, **options):
        kept = SimpleNamespace()

        def keep(path, pictures, camera_path, counts, metre):
            kept.pictures, kept.camera_path, kept.counts, kept.metre = pictures, camera_path, counts, metre

        monkeypatch.setattr(picture, "_side_by_side", keep)
        picture.draw_map("a.png", surface, cameras, UP, voxel=VOXEL_M, **options)
        return kept

    return call


# ---------------------------------------------------------------------------------------------------------- view point


def test_the_view_point_is_behind_above_and_beside_the_cameras():
    surface, cameras = wall(), cameras_at((0.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    T = picture._viewpoint(surface, cameras, UP)
    R, t = T.R[0], T.t[0]
    torch.testing.assert_close(R.T @ R, torch.eye(3).double())
    assert float(torch.linalg.det(R)) == pytest.approx(1)
    # ahead = z, above = -y, beside = ahead x above = x
    wanted = np.array([-0.25, 0.45, 1.0]) / math.sqrt(0.25**2 + 0.45**2 + 1)
    np.testing.assert_allclose(R[:, 2], wanted, atol=1e-12)
    assert float(R[1, 0]) == pytest.approx(0, abs=1e-12), "the horizon is level"
    assert float(R[1, 1]) > 0, "up in the world is up in the picture"
    xyz = surface.xyz.double()
    middle = xyz.median(0).values
    far = np.quantile((xyz - middle).norm(dim=-1).numpy(), 0.9)
    np.testing.assert_allclose(t, middle.numpy() - 2.2 * far * wanted, atol=1e-6)


def test_cameras_that_look_down_or_at_one_another_still_have_a_level_direction():
    down = Pose(torch.tensor([[[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]]), torch.zeros(1, 3))  # z of the camera = +y
    T = picture._viewpoint(wall(), [down], UP)
    np.testing.assert_allclose(T.R[0, :, 2] * math.sqrt(1 + 0.25**2 + 0.45**2), [1, 0.45, 0.25], atol=1e-12)
    opposite = [*cameras_at((0.0, 0.0, 0.0)), Pose(torch.diag(torch.tensor([-1.0, 1, -1]))[None], torch.zeros(1, 3))]
    T = picture._viewpoint(wall(), opposite, UP)
    np.testing.assert_allclose(T.R[0, :, 2] * math.sqrt(1 + 0.25**2 + 0.45**2), [-0.25, 0.45, 1], atol=1e-12)


# -------------------------------------------------------------------------------------------------------------- camera


@pytest.mark.parametrize("hw", [(600, 800), (300, 900)])
def test_the_points_fill_nine_tenths_of_the_narrower_side(hw):
    draw = np.random.default_rng(0)
    flat = draw.uniform((-0.4, -0.1), (0.8, 0.5), (4000, 2))
    z = draw.uniform(1, 5, (4000, 1))
    camera = picture._fit_camera(torch.from_numpy(np.hstack((flat * z, z))), hw)
    low, high = np.quantile(flat, 0.005, 0), np.quantile(flat, 0.995, 0)
    focal = min(0.9 * hw[1] / (high - low)[0], 0.9 * hw[0] / (high - low)[1])
    np.testing.assert_allclose(camera.f, [[focal, focal]], rtol=1e-9)
    np.testing.assert_allclose(camera.c, [np.array([hw[1], hw[0]]) / 2 - focal * (low + high) / 2], rtol=1e-9)
    for k, size in enumerate((hw[1], hw[0])):
        ends = focal * np.array([low[k], high[k]]) + float(camera.c[0, k])
        assert ends.mean() == pytest.approx(size / 2), "in the middle"


# ------------------------------------------------------------------------------------------------------------ pictures


def test_both_pictures_show_the_wall_in_its_colours_and_in_those_of_its_sources(drawn):
    left = wall(source=Source.SENSOR, rgb=(0.25, 0.5, 0.75))
    right = wall(source=Source.RECOVERED, rgb=(0.75, 0.25, 0.5))
    right = right.replace(xyz=right.xyz + torch.tensor([2.1, 0.0, 0.0]))
    cameras = cameras_at((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    kept = drawn(joined(left, right), cameras, title="a scene", hw=(150, 200))
    assert list(kept.pictures) == ["a scene: map of 2 views", "Sensor and recovered"]
    own, by_source = kept.pictures.values()
    assert own.shape == by_source.shape == (150, 200, 3)
    shown = ~(own == 1).all(-1)
    assert 0.2 < shown.mean() < 0.9 and ((by_source == 1).all(-1) == ~shown).all()
    own_colours = {tuple(np.round(c, 6)) for c in own[shown]}
    assert own_colours == {(0.25, 0.5, 0.75), (0.75, 0.25, 0.5)}
    columns = [np.nonzero((np.abs(own - colour) < 1e-6).all(-1))[1].mean() for colour in sorted(own_colours)]
    assert columns[0] < columns[1], "what is left is left"
    for colour, code in zip(sorted(own_colours), (Source.SENSOR, Source.RECOVERED), strict=True):
        pixel = by_source[(np.abs(own - colour) < 1e-6).all(-1)]
        rgb = np.array([int(SOURCE_COLOURS[code][k : k + 2], 16) for k in (1, 3, 5)]) / 255
        np.testing.assert_allclose(pixel, np.broadcast_to(rgb * shade_of_the_wall(), pixel.shape), atol=1e-6)
    assert kept.counts == {Source.SENSOR: len(left.xyz), Source.RECOVERED: len(right.xyz)}


def shade_of_the_wall():
    """Of a wall whose normal is -z in the world, lit from the upper left in the picture."""
    T = picture._viewpoint(wall(), cameras_at((0.0, 0.0, 0.0)), UP)
    normal = T.R[0].numpy().T @ np.array([0.0, 0, -1])
    return 0.35 + 0.65 * min(abs(normal @ np.array([0.3, -0.5, -0.8])), 1)


def test_walls_that_face_away_are_left_out_and_swept_points_are_counted_where_there_are_any(drawn):
    behind = wall(source=Source.SWEPT)
    facing = wall(depth=4.0)
    away = behind.replace(normal=-behind.normal, features=torch.tensor([0.0, 1.0, 0.0, 1.0]).expand(len(behind.xyz), 4))
    kept = drawn(joined(facing, away), cameras_at((0.0, 0.0, 0.0)), hw=(90, 120))
    own = next(iter(kept.pictures.values()))
    assert not (np.abs(own - [0, 1, 0]) < 1e-6).all(-1).any()
    assert list(kept.pictures) == ["Map of 1 view", "Sensor, recovered and swept"]
    assert kept.counts == {Source.SENSOR: len(facing.xyz), Source.RECOVERED: 0, Source.SWEPT: len(away.xyz)}


def test_the_path_and_the_length_of_a_metre_are_those_of_the_drawing(drawn):
    cameras, hw = cameras_at((-0.5, 0.0, 1.0), (0.0, 0.0, 1.0), (0.5, 0.0, 1.0)), (150, 200)
    surface = wall()
    kept = drawn(surface, cameras, hw=hw)
    T = picture._viewpoint(surface, cameras, UP)
    xyz = se3.apply(se3.invert(T), surface.xyz[None].double())[0]
    path = se3.apply(se3.invert(T), torch.cat([c.t for c in cameras])[None].double())[0]
    camera = picture._fit_camera(torch.cat((xyz, path)), hw)
    assert kept.metre == pytest.approx(float(camera.f[0, 0] / xyz[:, 2].median()))
    wanted = camera.f * path[:, :2] / path[:, 2:] + camera.c
    np.testing.assert_allclose(kept.camera_path, wanted, atol=1e-9)


def test_a_map_without_points_is_white_and_has_no_scale(drawn):
    none, (camera,) = wall().map(lambda x: x[:0]), cameras_at((1.0, 2.0, 3.0))
    kept = drawn(none, [camera], hw=(30, 40))
    assert kept.metre is None and all((each == 1).all() for each in kept.pictures.values())
    T = picture._viewpoint(none, [camera], UP)
    np.testing.assert_allclose(T.t[0], np.array([1, 2, 4.0]) - 2.2 * T.R[0, :, 2].numpy(), atol=1e-9)
    ahead = picture._fit_camera(torch.zeros(0, 3), (600, 800))
    assert ahead.f.tolist() == [[800, 800]] and ahead.c.tolist() == [[400, 300]]


# -------------------------------------------------------------------------------------------------------------- figure


@pytest.fixture
def saved(monkeypatch):
    """The figures that are saved."""
    figures = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: figures.append(figure))
    return figures


def test_two_pictures_lie_side_by_side_with_path_scale_and_legend(saved):
    pictures = {"one": np.zeros((150, 200, 3)), "two": np.ones((150, 200, 3))}
    path = np.array([[0.0, 0.0], [99.5, 74.5], [500.0, 10.0], [10.0, -5.0]])
    picture._side_by_side("a.png", pictures, path, {Source.SENSOR: 7, Source.SWEPT: 9, Source.FILLED: 3}, 20.0)
    (figure,) = saved
    lefts = [72 * figure.get_figwidth() * axes.get_position().x0 for axes in figure.axes]
    assert lefts == pytest.approx([0, 356]) and 72 * figure.get_figwidth() == pytest.approx(702)
    for axes, (title, pixels) in zip(figure.axes, pictures.items(), strict=True):
        assert axes.get_title("left") == title and (axes.images[0].get_array() == pixels).all()
        cameras, bar = axes.lines
        assert cameras.get_xydata().tolist() == path[:2].tolist(), "those inside"
        ends = bar.get_xydata()
        assert ends[1, 0] - ends[0, 0] == 2 * 20.0 and ends[0, 1] == ends[1, 1] and axes.texts[0].get_text() == "2 m"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["sensor 7", "recovered (swept) 9", "filled 3"]
    assert [h.get_color() for h in legend.legend_handles] == [
        SOURCE_COLOURS[code] for code in (Source.SENSOR, Source.SWEPT, Source.FILLED)
    ]


def test_without_a_scale_or_a_path_neither_is_drawn(saved):
    picture._side_by_side("a.png", {"one": np.zeros((20, 40, 3))}, np.zeros((0, 2)), {}, None)
    (axes,) = saved[0].axes
    assert not len(axes.lines[0].get_xydata()) and len(axes.lines) == 1 and not axes.texts and not saved[0].legends


@pytest.mark.parametrize(
    ("metre", "label"),
    [(69.3, "0.5 m"), (69.2, "1 m"), (34.6, "2 m"), (1e6, "0.001 m"), (0.0173, "2000 m"), (1e-9, "5000 m")],
)
def test_the_bar_is_the_longest_round_length_within_a_fifth(saved, metre, label):
    picture._side_by_side("a.png", {"one": np.zeros((100, 346, 3))}, np.zeros((0, 2)), {}, metre)
    assert saved[0].axes[0].texts[0].get_text() == label
