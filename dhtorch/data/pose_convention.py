"""Conventions of stated camera poses: camera axes, direction, quaternion order and unit, each undone by one function.

A reader takes poses as camera-to-world with our camera axes (x right, y down, z forward), quaternions as x y z w, and
translations in metres, unless its format states otherwise. A :class:`PoseConvention` is what a file means instead;
:meth:`PoseConvention.apply` takes the poses as they were read to the poses that were meant.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from dhtorch.data.convert import quaternions_of
from dhtorch.data.units import UNIT_METRES
from dhtorch.geometry import se3
from dhtorch.records import Pose

#: Direction of a camera axis → vector in our camera axes.
_DIRECTIONS: Final = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}

#: Other names of camera axes.
_AXES_ALIASES: Final = {"opencv": "right_down_forward", "opengl": "right_up_back", "ros": "forward_left_up"}

#: Order of a stored quaternion, where its reader takes another one → indices of x y z w among the numbers as read.
_QUATERNION_ORDERS: Final = {"wxyz": (1, 2, 3, 0), "xyzw": (3, 0, 1, 2)}

#: Directions of x, y and z of our own axes.
_OWN_AXES: Final = "right_down_forward"


@dataclass(frozen=True)
class PoseConvention:
    """What stated poses mean where this differs from what was read."""

    axes: str = _OWN_AXES  # directions of the camera's x, y and z axes
    inverse: bool = False  # world-to-camera
    quaternion: str | None = None  # wxyz: scalar first, read as scalar last; xyzw: the reverse
    unit: str | float = "m"  # of translations: a name of UNIT_METRES, or metres

    def apply(self, poses: Pose) -> Pose:
        """Poses (B) as read → T_world_from_cam (B) that was meant."""
        R, t = poses.R, poses.t * (UNIT_METRES[self.unit] if isinstance(self.unit, str) else self.unit)
        if self.quaternion is not None:
            R = _rotation(quaternions_of(R)[:, list(_QUATERNION_ORDERS[self.quaternion])])
        meant = Pose(R, t)
        if self.inverse:
            meant = se3.invert(meant)
        return Pose(meant.R @ _axes_matrix(self.axes).to(meant.R), meant.t)

    @property
    def is_trivial(self) -> bool:
        """Whether the poses are as they were read."""
        return self == PoseConvention()

    def __str__(self) -> str:
        """The words of :func:`parse_pose_convention`, as ``world_to_camera+opengl``."""
        names = {axes: name for name, axes in _AXES_ALIASES.items()}
        words = [
            *(["world_to_camera"] if self.inverse else []),
            *([names.get(self.axes, self.axes)] if self.axes != _OWN_AXES else []),
            *([self.quaternion] if self.quaternion else []),
            *([f"{self.unit}"] if self.unit != "m" else []),
        ]
        return "+".join(words) or "opencv"

    def describe(self) -> str:
        """What the poses are, as a phrase."""
        phrases = []
        if self.inverse:
            phrases.append("world-to-camera poses (inverted)")
        if self.axes == _AXES_ALIASES["opengl"]:
            phrases.append("OpenGL camera axes (x right, y up, z back)")
        elif self.axes != _OWN_AXES:
            x, y, z = self.axes.split("_")
            phrases.append(f"camera axes x {x}, y {y}, z {z}")
        if self.quaternion:
            phrases.append(f"quaternion order {self.quaternion}")
        if isinstance(self.unit, str) and self.unit != "m":
            phrases.append(f"translations in {self.unit}")
        elif self.unit != "m":
            phrases.append(f"translations in units of {self.unit:.3g} m")
        return " with ".join(phrases)


def _axes_matrix(axes: str) -> Tensor:
    """Matrix (3, 3) that takes vectors in our camera axes to the named ones."""
    return torch.tensor([_DIRECTIONS[word] for word in axes.split("_")], dtype=torch.float64)


def right_handed_axes() -> list[str]:
    """All 24 right-handed choices of camera axes, as words of :class:`PoseConvention`."""
    words = ["_".join(each) for each in itertools.permutations(_DIRECTIONS, 3)]
    return [axes for axes in words if float(torch.linalg.det(_axes_matrix(axes))) > 0.5]


def parse_pose_convention(text: str | float) -> PoseConvention:
    """Words joined by ``+`` → convention: ``opengl``, ``world_to_camera+opengl``, ``wxyz``, ``mm``, ``0.1``.

    Words: ``world_to_camera``; ``opengl``, ``ros`` or the directions of three axes, as ``right_up_back``; ``wxyz`` or
    ``xyzw``; a unit of translations, or its metres.

    Raises:
        ValueError: another word.
    """
    convention: dict[str, str | float | bool] = {}
    for word in str(text).split("+"):
        axes = _AXES_ALIASES.get(word, word)
        if word == "world_to_camera":
            convention["inverse"] = True
        elif axes in right_handed_axes():
            convention["axes"] = axes
        elif word in _QUATERNION_ORDERS:
            convention["quaternion"] = word
        elif word in UNIT_METRES:
            convention["unit"] = word
        else:
            convention["unit"] = _parse_metres(word)
    return PoseConvention(**convention)  # type: ignore[arg-type]


def _parse_metres(word: str) -> float:
    """A number of metres, greater than 0, as text → the number."""
    try:
        metres = float(word)
    except ValueError:
        metres = 0.0
    if 0 < metres < math.inf:
        return metres
    known = ("world_to_camera", *_AXES_ALIASES, "right_up_back …", *_QUATERNION_ORDERS, *UNIT_METRES, "metres")
    raise ValueError(f"pose_convention: found {word!r}, expected {', '.join(known)}")


def _rotation(q: Tensor) -> Tensor:
    """Quaternions (B, 4), x y z w → rotations (B, 3, 3)."""
    from kornia.geometry.conversions import quaternion_to_rotation_matrix  # noqa: PLC0415  (0.2 s)

    return quaternion_to_rotation_matrix(q[:, [3, 0, 1, 2]])
