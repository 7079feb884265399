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


def test_without_points_the_view_point_is_two_metres_behind_what_is_ahead():
    none = wall().replace(xyz=torch.zeros(0, 3))
    (camera,) = cameras_at((1.0, 2.0, 3.0))
    T = picture._viewpoint(none, [camera], UP)
    np.testing.assert_allclose(T.t[0], np.array([1, 2, 4.0]) - 2.2 * T.R[0, :, 2].numpy(), atol=1e-9)


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


def test_a_camera_without_points_looks_straight_ahead():
    camera = picture._fit_camera(torch.zeros(0, 3), (600, 800))
    assert camera.f.tolist() == [[800, 800]] and camera.c.tolist() == [[400, 300]]


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
    none = wall().map(lambda x: x[:0])
    kept = drawn(none, cameras_at((0.0, 0.0, 0.0)), hw=(30, 40))
    assert kept.metre is None and all((each == 1).all() for each in kept.pictures.values())


# -------------------------------------------------------------------------------------------------------------- canvas


class Strokes:
    """A canvas that keeps what is drawn on it."""

    made: list["Strokes"] = []  # noqa: RUF012  (of one test)

    def __init__(self, width, height, dpi):
        self.size, self.dpi = (width, height), dpi
        self.titles, self.pictures, self.segments, self.points, self.texts = [], [], [], [], []
        Strokes.made.append(self)

    def title(self, text, width, height, left):
        self.titles.append((text, width, height, left))

    def picture(self, pixels, box):
        self.pictures.append((pixels, box))

    def lines(self, segments, stroke):
        self.segments.append(([list(s) for s in segments], stroke.width))

    def dots(self, places, stroke):
        self.points.append(list(places))

    def text(self, text, u, v):
        self.texts.append((text, u, v))

    def finished(self, keys):
        self.keys = keys
        return self


@pytest.fixture
def strokes(monkeypatch):
    Strokes.made = []
    saved = []
    monkeypatch.setattr(picture, "Canvas", Strokes)
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: saved.append((figure, path)))
    return saved


def test_two_pictures_lie_side_by_side_with_path_scale_and_legend(strokes):
    pictures = {"one": np.zeros((150, 200, 3)), "two": np.ones((150, 200, 3))}
    path = np.array([[0.0, 0.0], [99.5, 74.5], [500.0, 10.0], [10.0, -5.0]])
    picture._side_by_side("a.png", pictures, path, {Source.SENSOR: 7, Source.SWEPT: 9, Source.FILLED: 3}, 20.0)
    ((canvas, file),) = strokes
    scale = 346 / 200
    height = 150 * scale
    assert file == "a.png" and canvas.size == (2 * 346 + 10, pytest.approx(height + 20)) and canvas.dpi == 160
    assert [(t, w, left) for t, w, _, left in canvas.titles] == [("one", 346, 0), ("two", 346, 356)]
    assert [h for _, _, h, _ in canvas.titles] == [pytest.approx(height + 20)] * 2
    assert [box for _, box in canvas.pictures] == [
        (0, 0, 346, pytest.approx(height)),
        (356, 0, 346, pytest.approx(height)),
    ]
    for k, left in enumerate((0, 356)):
        places = [(left + 0.5 * scale, height - 0.5 * scale), (left + 100 * scale, height - 75 * scale)]
        np.testing.assert_allclose(canvas.points[k], places)
        np.testing.assert_allclose(canvas.segments[2 * k][0][0], places)
        bar, low, high = canvas.segments[2 * k + 1][0]
        metre = 20 * scale
        np.testing.assert_allclose(bar, [(left + 6, 6), (left + 6 + 2 * metre, 6)])  # 69.2 points of 1, 2, 5: 2 m
        np.testing.assert_allclose(low, [(left + 6, 3.5), (left + 6, 8.5)])
        np.testing.assert_allclose(high, [(left + 6 + 2 * metre, 3.5), (left + 6 + 2 * metre, 8.5)])
        assert canvas.texts[k] == ("2 m", left + 6, 11)
    assert [(key.text, key.colour) for key in canvas.keys] == [
        ("sensor  7", SOURCE_COLOURS[Source.SENSOR]),
        ("recovered (swept)  9", SOURCE_COLOURS[Source.SWEPT]),
        ("filled  3", SOURCE_COLOURS[Source.FILLED]),
    ]


def test_without_a_scale_or_a_path_neither_is_drawn(strokes):
    picture._side_by_side("a.png", {"one": np.zeros((20, 40, 3))}, np.zeros((0, 2)), {}, None)
    ((canvas, _),) = strokes
    assert canvas.size[0] == 346 and canvas.segments == [([], 0.8)] and canvas.points == [[]] and canvas.texts == []


@pytest.mark.parametrize(
    ("metre", "label"),
    [(69.3, "0.5 m"), (69.2, "1 m"), (34.6, "2 m"), (1e6, "0.001 m"), (0.0173, "2000 m"), (1e-9, "5000 m")],
)
def test_the_bar_is_the_longest_round_length_within_a_fifth(strokes, metre, label):
    canvas = Strokes(346, 100, 160)
    picture._scale_bar(canvas, 0, 346, metre)
    assert canvas.texts[0][0] == label
