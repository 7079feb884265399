"""What there is to see, before any medium: pictures, points, camera path, and what became of every sample.

Everything is a numpy array in metres and pixels of the full picture, so that a page, a Rerun recording or a notebook
can show it without torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dhtorch.codes import Gate, Source, names


@dataclass(frozen=True)
class ExhibitView:
    """A picture and where it was taken."""

    number: int  # place of the frame in the recording
    time: float | None  # s since the recording's first frame
    jpeg: bytes
    jpeg_hw: tuple[int, int]
    hw: tuple[int, int]  # of the full picture, to which pixels refer
    f: tuple[float, float]  # px
    c: tuple[float, float]  # px


@dataclass(frozen=True)
class PointCloud:
    """Points of a depth map in the colours of its picture."""

    xyz: np.ndarray  # (P, 3) m, camera 0, float32
    rgb: np.ndarray  # (P, 3) uint8


@dataclass(frozen=True)
class SweptPointCloud(PointCloud):
    """Points of swept pixels."""

    sigma: np.ndarray  # (P,) m, float32
    score: np.ndarray  # (P,) in [0, 1], float32
    step_px: float = 0.0  # between neighbours in rows and columns of the picture, which make a surface; 0 = no order


@dataclass(frozen=True)
class DepthImage:
    """The sensor's depth of a view as a picture, and its intrinsics."""

    depth: np.ndarray  # (h, w) m float32, 0 = no return
    f: tuple[float, float]  # px of the depth map
    c: tuple[float, float]  # px


EMPTY_CLOUD = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
EMPTY_SWEPT_CLOUD = SweptPointCloud(EMPTY_CLOUD.xyz, EMPTY_CLOUD.rgb, np.zeros(0, np.float32), np.zeros(0, np.float32))


@dataclass(frozen=True)
class PairExhibit:
    """One pair: what the sensor said, what was answered, and what became of the N samples.

    ``samples`` holds arrays of N rows: ``uv_0``, ``uv_1`` (N, 2) px, ``tracked`` bool, ``xyz`` (N, 3) m in camera 0
    (NaN where neither source answers), ``rgb`` (N, 3) uint8 of the picture, ``depth``, ``sigma`` m, ``score``,
    ``source``, ``gate``, ``hole``, ``parallax_deg``, ``residual_px``, ``error`` (|z − z*| / z* where a held-back return
    passes the truth test, else NaN) and ``candidate`` (whether it does).
    """

    label: str
    samples: Mapping[str, np.ndarray]
    T_world_from_0: np.ndarray  # (4, 4)
    T_world_from_1: np.ndarray | None = None  # (4, 4), by the pose that was fitted; None = there is none
    view_0: int | None = None  # positions in ``Exhibit.views``; None = no pictures
    view_1: int | None = None
    seen: PointCloud = EMPTY_CLOUD  # returns that the method saw
    held: PointCloud = EMPTY_CLOUD  # returns that it did not see, or the exact depth there
    swept: SweptPointCloud = EMPTY_SWEPT_CLOUD  # swept pixels of view 0, where a map of every pixel was asked for
    depth_image: DepthImage | None = None  # that the method saw
    facts: Mapping[str, str] = field(default_factory=dict)

    def gates(self) -> dict[str, int]:
        """Samples by what became of them: a usable return of the sensor, an answer, or the reason for silence."""
        sensed = self.samples["source"] == Source.SENSOR
        counts = {"SENSOR": int(sensed.sum())}
        for code, name in names(Gate).items():
            counts[name] = int((~sensed & (self.samples["gate"] == code)).sum())
        return counts


@dataclass(frozen=True)
class PageOpening:
    """What a page begins with, before anything can be turned."""

    numbers: Mapping[str, str]  # what it is → how much
    said: Sequence[str] = ()  # sentences
    picture: bytes | None = None  # PNG
    caption: str = ""


@dataclass(frozen=True)
class Exhibit:
    """All that is shown of one recording."""

    name: str
    shots: Sequence[PairExhibit]
    views: Sequence[ExhibitView] = ()
    path: np.ndarray | None = None  # (n, 3) m, camera centres of the whole recording; None = no trajectory
    facts: Mapping[str, str] = field(default_factory=dict)
    opening: PageOpening | None = None

    @property
    def placed(self) -> bool:
        """Whether all pairs stand in one world; otherwise each stands in its own reference view's frame."""
        return self.path is not None or len(self.shots) == 1
