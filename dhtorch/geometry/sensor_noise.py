"""Depth sensors by class: the standard deviation of a return by its range, from data sheets and published measurements.

A class is stated by whoever knows the device (``sensor=`` of :func:`dhtorch.stages.backproject.backproject`); a
capture's format is only a hint (:func:`sensor_of_format`) and changes nothing. The numbers hold for the class, on matt
surfaces at right angles, not for one device: a device measured by its owner is stated as three numbers.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

from torch import Tensor

#: Formats of captures that one kind of device writes → its class.
_FORMAT_SENSORS: Final = {
    "azure_kinect": "azure_kinect",
    "record3d": "iphone_lidar",
    "stray": "iphone_lidar",
    "arkitscenes": "iphone_lidar",
    "ca1m": "iphone_lidar",
}


class SensorNoise(NamedTuple):
    """Standard deviation of a return at depth z: constant + linear · z + square · z²."""

    constant: float  # m
    linear: float  # 1
    square: float  # 1/m

    def __call__(self, depth: Tensor) -> Tensor:
        """Standard deviation in m; 0 without a return. Gradient: to depth."""
        return (self.constant + self.linear * depth + self.square * depth * depth) * (depth > 0)


#: Classes of sensors. A number stands for one standard deviation of one return, common and random errors together.
SENSORS: Final = {
    # Source: G. Luetzenburg, A. Kroon, A. Bjørk, "Evaluation of the Apple iPhone 12 Pro LiDAR for an application in
    # geosciences", 2021: ± 1 cm on small objects. No dependence on range is published; Apple states nothing.
    "iphone_lidar": SensorNoise(0.01, 0.0, 0.0),
    # Source: derived, z² · subpixel / (f · baseline) of Intel's white papers on tuning D400 cameras, for the D435:
    # .08 px, f = 424 px (848 px, 90°), 50 mm; D415 and D455 have less. The data sheet's 2 % at 2 m is 2.6 times it.
    "realsense_d4xx": SensorNoise(0.0, 0.0, 0.0038),
    # Source: C. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
    # tracking", 2012: .0012 + .0019 (z - .4)², multiplied out; K. Khoshelham, 2011, has 4 cm at the maximum range.
    "kinect_v1": SensorNoise(0.001504, -0.00152, 0.0019),
    # Source: derived, through both ends of "1.5 to tens of millimetres", taken at .5 m and as 21.5 mm at 4.5 m, of
    # A. Corti et al., "A metrological characterization of the Kinect V2 time-of-flight camera", 2016.
    "kinect_v2": SensorNoise(0.00125, 0.0, 0.001),
    # Source: derived, random error 17 mm and systematic error up to 11 mm + .1 % (Microsoft's specification, confirmed
    # to 3.5 m by M. Tölgyessy et al., 2021), the latter uniform within its bound; squares added, at 1 m and 4 m.
    "azure_kinect": SensorNoise(0.0181, 0.00024, 0.0),
    # Source: no number of its own was found; that of azure_kinect, whose time-of-flight chip HoloLens 2 has.
    "hololens": SensorNoise(0.0181, 0.00024, 0.0),
}


def get_sensor_noise(sensor: str | Sequence[float]) -> SensorNoise:
    """Noise of a class in :data:`SENSORS`, or of three numbers [m, 1, 1/m] for a device of one's own.

    Raises:
        ValueError: an unknown name, not three numbers, or negative noise at 1 m.
    """
    if isinstance(sensor, str):
        if sensor not in SENSORS:
            raise ValueError(f"sensor: found {sensor!r}, expected one of {', '.join(SENSORS)}, or three numbers")
        return SENSORS[sensor]
    if len(sensor) != 3 or not sum(sensor) > 0:
        raise ValueError(f"sensor: found {list(sensor)}, expected three numbers: m, m per m, m per m²")
    return SensorNoise(*map(float, sensor))


def sensor_of_format(name: str) -> str | None:
    """Class of the devices that write captures of a format; None where several kinds do."""
    return _FORMAT_SENSORS.get(name)
