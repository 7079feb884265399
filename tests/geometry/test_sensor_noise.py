"""Noise of sensor classes: published values, what stating a class changes, and what is refused."""

import pytest
import torch

from dhtorch.geometry.sensor_noise import get_sensor_noise
from dhtorch.metrics.holdout import range_split
from dhtorch.stages.backproject import backproject
from dhtorch.synthetic import SyntheticRoom


@pytest.fixture(scope="module")
def frames():
    room = SyntheticRoom(n_frames=8, hw=(120, 160), depth_hw=(120, 160), seed=3, lidar="exact", supersample=1)
    return [range_split(room[k], 2.0) for k in (1, 7)]


@pytest.mark.parametrize(
    ("name", "z", "sigma"),
    [
        ("kinect_v1", 0.4, 0.0012),
        ("kinect_v1", 5.0, 0.0012 + 0.0019 * 4.6**2),
        ("kinect_v2", 0.5, 0.0015),
        ("kinect_v2", 4.5, 0.0215),
        ("azure_kinect", 1.0, 0.0183),
        ("azure_kinect", 4.0, 0.0190),
        ("hololens", 2.0, 0.0186),
        ("realsense_d4xx", 2.0, 0.0151),
        ("iphone_lidar", 3.0, 0.01),
    ],
)
def test_noise_is_that_of_the_source(name, z, sigma):
    assert float(get_sensor_noise(name)(torch.tensor(z, dtype=torch.float64))) == pytest.approx(sigma, rel=0.01)


def test_a_stated_class_changes_sigma_alone_and_only_where_there_is_a_return(frames):
    uv = torch.rand(256, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([159.0, 119.0])
    plain, stated, own = (backproject(frames[0], uv, sensor=s) for s in (None, "kinect_v1", (0.01, 0.0, 0.0)))
    returned = plain.depth > 0
    torch.testing.assert_close(plain.sigma, 0.01 * plain.depth, rtol=0, atol=0)
    torch.testing.assert_close(stated.sigma[returned], get_sensor_noise("kinect_v1")(plain.depth[returned]))
    assert (
        bool((own.sigma[returned] == 0.01).all()) and bool((own.sigma[~returned] == 0).all()) and bool(returned.any())
    )
    for name in ("depth", "confidence", "flag"):
        assert torch.equal(getattr(plain, name), getattr(stated, name))


@pytest.mark.parametrize("sensor", ["kinect", (0.01, 0.0), (1.0, 2.0, 3.0, 4.0), (-1.0, 0.0, 0.0)])
def test_what_is_no_sensor_is_refused_in_one_line(sensor):
    with pytest.raises(ValueError, match=r"sensor: found .*, expected ") as raised:
        get_sensor_noise(sensor)
    assert "\n" not in str(raised.value)
