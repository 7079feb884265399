"""The metric size of a model: right within its sigma, placed in the capture's world, refused where it is bent."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dhtorch.geometry import se3
from dhtorch.measure import ModelView, SceneModel, metric_scale
from dhtorch.measure.local_scales import LocalScales, ScaleTolerance, estimate_scale, find_faults
from tests.support import room_models as made


def measure(model, **options):
    scene = made.room_scene()
    return metric_scale(model, scene.frames, names=[v.name for v in model.views], cutoff=made.NEAR, **options)


@pytest.mark.parametrize("kind", ["maps", "points"])
def test_the_scale_of_a_sound_model(kind):
    model, true = made.room_model(kind)
    result = measure(model)
    assert result.ok and abs(result.scale / true - 1) < 0.01
    low, high = result.interval()
    assert low < true < high and set(result.terms) == {"frames", "sensor", "model"}


@pytest.mark.parametrize("kind", ["maps", "points"])
@pytest.mark.parametrize("fault", ["drift", "bend", "frames", "region"])
def test_a_bent_model_is_refused_with_where_and_how_much(kind, fault):
    model, _ = made.room_model(kind, fault, 0.08)
    result = measure(model)
    assert not result.ok and 0.03 < max(abs(f.change) for f in result.faults) < 0.2
    along_the_recording = {"drift", "bend", "frames"}
    assert {f.kind for f in result.faults} & (along_the_recording if fault != "region" else {"place"})


def test_a_model_of_reversed_depth_is_refused():
    """Near and far exchanged about a plane, as bundle adjustment of a narrow path can make them."""
    model, _ = made.room_model("maps")
    far = max(view.depth.max() for view in model.views)
    views = [replace(v, depth=np.where(v.depth > 0, 1.3 * far - v.depth, 0.0)) for v in model.views]
    assert {"range"} <= {fault.kind for fault in measure(SceneModel(views)).faults}


def test_the_sensor_enters_sigma_as_stated():
    model, _ = made.room_model("maps")
    unstated, phone = measure(model), measure(model, sensor="iphone_lidar")
    depth = np.median(phone.local.depth)
    assert unstated.terms["sensor"] == 0.01 and phone.terms["sensor"] == pytest.approx(0.01 / depth)
    assert unstated.scale == phone.scale and unstated.sigma != phone.sigma


def test_cameras_place_the_model_in_the_world_of_the_capture():
    model, true = made.room_model("maps")
    result = measure(model)
    scene = made.room_scene()
    moved = result.similarity.move(np.stack([v.c2w for v in model.views]))
    np.testing.assert_allclose(moved[:, :3, :3], scene.poses[:, :3, :3], atol=5e-3)
    np.testing.assert_allclose(moved[:, :3, 3], scene.poses[:, :3, 3], atol=0.03)
    sigma = np.sqrt(np.diag(result.cov))
    assert (np.linalg.eigvalsh(result.cov) > -1e-12).all() and sigma[6] == pytest.approx(result.sigma)
    assert result.path.scale == pytest.approx(true, rel=0.03) and result.path.source == "the capture's poses"


def spoilt(fault, size):
    """A model of the room with another path: longer, curled by degrees, or every fifth view elsewhere by a fraction of
    the depth; or every fifth map of another scale."""
    views = made.room_model("maps")[0].views
    c2w, depths = np.stack([view.c2w for view in views]), [view.depth for view in views]
    middle, depth = c2w[:, :3, 3].mean(0), float(np.median(depths[0][depths[0] > 0]))
    if fault == "longer":
        c2w[:, :3, 3] = middle + (1 + size) * (c2w[:, :3, 3] - middle)
    if fault == "curled":
        turn = se3.exp(torch.tensor([[0, np.radians(size) / len(views), 0, 0, 0, 0]]).double())
        for k in range(1, len(views)):
            c2w[k:] = c2w[k] @ se3.to_matrix(turn)[0].numpy() @ np.linalg.inv(c2w[k]) @ c2w[k:]
    if fault == "views":
        c2w[::5, :3, 3] += size * depth / 3**0.5 * np.random.default_rng(0).choice((-1, 1), (len(c2w[::5]), 3))
    if fault == "maps":
        depths = [d * (1 + size) if k % 5 == 0 else d for k, d in enumerate(depths)]
    return SceneModel([replace(v, c2w=m, depth=d) for v, m, d in zip(views, c2w, depths, strict=True)])


def measure_without_poses(model, **options):
    frames = [frame.replace(T_world_from_cam=None) for frame in made.room_scene().frames]
    return metric_scale(model, frames, names=[v.name for v in model.views], cutoff=made.NEAR, **options)


@pytest.mark.parametrize("measured", [measure, measure_without_poses])
@pytest.mark.parametrize(
    ("fault", "size", "kind"),
    [
        ("longer", 0.03, "path"),
        ("longer", -0.06, "path"),
        ("longer", 0.1, "path"),
        ("curled", 10.0, "curl"),
        ("curled", 40.0, "curl"),
        ("views", 0.03, "views"),
        ("views", 0.1, "views"),
        ("maps", 0.03, "frames"),
        ("maps", 0.1, "frames"),
    ],
)
def test_a_path_that_contradicts_the_depths_is_refused_or_covered(measured, fault, size, kind):
    result = measured(spoilt(fault, size))
    if result.ok:
        assert kind != "curl" and 2 * result.sigma > abs(size)
    else:
        assert kind in {f.kind for f in result.faults}
    if abs(size) > 0.05:
        assert not result.ok


def test_a_sound_model_of_a_capture_without_poses_is_accepted():
    model, true = made.room_model("maps")
    result = measure_without_poses(model)
    low, high = result.interval()
    assert result.ok and low < true < high and result.path.source == "near returns"
    assert result.path.scale == pytest.approx(true, rel=3 * result.path.sigma)


def test_wrong_poses_of_the_capture_are_no_fault_of_the_model():
    """Near returns between the views decide where they know the path better."""
    model, true = made.room_model("maps")
    frames = [
        frame.replace(T_world_from_cam=frame.T_world_from_cam.replace(t=1.5 * frame.T_world_from_cam.t))
        for frame in made.room_scene().frames
    ]
    result = metric_scale(model, frames, names=[v.name for v in model.views], cutoff=made.NEAR)
    assert result.ok and result.path.source == "near returns" and abs(result.scale / true - 1) < 0.01


def test_a_path_that_cannot_be_measured_widens_the_interval():
    """Two views are fewer than three motions: U covers a path that is 10 % longer than the depths."""
    model, _ = made.room_model("maps")
    result = metric_scale(SceneModel(model.views[:2]), made.room_scene().frames[:2], names=["000000", "000001"])
    assert result.path is None and any("a camera path of another scale would not be seen" in x for x in result.notes)
    assert 2 * result.sigma > 0.1


def test_views_without_names_are_found_by_their_pictures(tmp_path):
    made.write_pictures(tmp_path)
    model, true = made.room_model("maps")
    views = [replace(v, name=f"x{k}", image=tmp_path / f"{k:06d}.png") for k, v in enumerate(model.views)]
    result = metric_scale(SceneModel(views), made.room_scene().frames, cutoff=made.NEAR)
    assert all(m.is_same and m.view == m.frame for m in result.matches) and len(result.matches) == len(views)
    assert abs(result.scale / true - 1) < 0.01


def test_views_of_other_pictures_are_registered(tmp_path):
    """Every second picture belongs to the model, the others are the capture's."""
    made.write_pictures(tmp_path)
    model, true = made.room_model("maps")
    views = [replace(v, name=f"x{k}", image=tmp_path / f"{k:06d}.png") for k, v in enumerate(model.views)][::2]
    result = metric_scale(SceneModel(views), made.room_scene().frames[1::2], cutoff=made.NEAR)
    assert not any(m.is_same for m in result.matches) and len(result.matches) >= 3
    assert abs(result.scale / true - 1) < 0.02


def test_nothing_in_common_is_an_error():
    model, _ = made.room_model("maps")
    with pytest.raises(ValueError, match="no picture of the model and no view named"):
        metric_scale(model, made.room_scene().frames, names=[f"y{k}" for k in range(12)])


def test_a_view_of_another_aspect_ratio_is_compared_by_rays():
    """A network's map of the middle of each picture."""
    model, true = made.room_model("maps")
    cut = [
        ModelView(v.name, v.K - [[0, 0, 32], [0, 0, 0], [0, 0, 0]], (96, 64), v.c2w, depth=v.depth[:, 16:48])
        for v in model.views
    ]
    assert abs(measure(SceneModel(cut)).scale / true - 1) < 0.01


def synthetic(change=0.0, seed=0, F=24, noise=0.01):
    draw = np.random.default_rng(seed)
    frame, region = np.repeat(np.arange(F), 12), np.tile(np.arange(12), F)
    log = noise * draw.normal(size=12 * F) + 0.004 * draw.normal(size=F)[frame] + change * frame / (F - 1)
    depth, share = draw.uniform(1, 2, 12 * F), np.stack((region % 4 / 4 + 0.1, region // 4 / 3 + 0.1), 1)
    return LocalScales(frame, region, log, np.full(12 * F, noise), depth, share, draw.normal(size=(12 * F, 3)))


def test_sigma_and_refusals_of_drawn_local_scales():
    """Sound: the mean is within two sigma as often as it should be and none is refused; 3 % of drift always is."""
    names = [str(k) for k in range(24)]
    drawn = [synthetic(seed=seed) for seed in range(60)]
    estimates = [estimate_scale(local, 24)[:2] for local in drawn]
    within = np.mean([abs(mean) <= 2 * sigma for mean, sigma in estimates])
    assert within >= 0.85
    assert np.mean([bool(find_faults(local, names)[0]) for local in drawn]) <= 0.02
    assert all(find_faults(synthetic(0.03, seed), names)[0] for seed in range(20))
    assert not find_faults(synthetic(0.03), names, ScaleTolerance(change=0.06))[0]
    np.testing.assert_allclose(estimate_scale(synthetic(noise=0.02), 24)[3], 0.02 / 12**0.5)


@pytest.mark.parametrize(("region", "row", "column"), [(0, 1, 1), (6, 2, 3), (11, 3, 4)])
def test_a_region_of_the_picture_is_named_by_its_row_and_column(region, row, column):
    local = synthetic(noise=0.004)
    local = local._replace(log=local.log + 0.2 * (local.region == region))
    first = find_faults(local, [str(k) for k in range(24)])[0][0]
    assert first.kind == "region" and first.where == f"picture region row {row} of 3, column {column} of 4"
    assert first.change == pytest.approx(np.expm1(0.2), rel=0.05)
