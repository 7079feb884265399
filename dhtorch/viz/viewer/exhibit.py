"""Data of the viewers: images, points, camera path, and the outcome of every sample.

All arrays are numpy, in metres and pixels of the full image, so that a page, a Rerun recording or a notebook can show
them without torch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dhtorch.codes import Gate, Source, names


@dataclass(frozen=True)
class ExhibitView:
    """Image, time and intrinsics of one view."""

    number: int  # position of the frame in the recording
    time: float | None  # s since the recording's first frame
    jpeg: bytes
    jpeg_hw: tuple[int, int]
    hw: tuple[int, int]  # of the full image, whose pixels all uv refer to
    f: tuple[float, float]  # px
    c: tuple[float, float]  # px


@dataclass(frozen=True)
class PointCloud:
    """Points of a depth map in the colours of its image."""

    xyz: np.ndarray  # (P, 3) m, camera 0, float32
    rgb: np.ndarray  # (P, 3) uint8


@dataclass(frozen=True)
class SweptPointCloud(PointCloud):
    """Points of swept and filled pixels."""

    sigma: np.ndarray  # (P,) m, float32
    score: np.ndarray  # (P,) in [0, 1], float32
    source: np.ndarray  # (P,) uint8, SWEPT or FILLED
    step_px: float = 0.0  # spacing of the pixel grid that the points form, which makes a surface; 0 = no grid
    cause: np.ndarray | None = None  # (P,) uint8, as ``cause`` of samples; None = not known


@dataclass(frozen=True)
class DepthImage:
    """Sensor depth image of a view, and its intrinsics."""

    depth: np.ndarray  # (h, w) m float32, 0 = no return
    f: tuple[float, float]  # px of the depth map
    c: tuple[float, float]  # px


EMPTY_CLOUD = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
EMPTY_SWEPT_CLOUD = SweptPointCloud(
    EMPTY_CLOUD.xyz, EMPTY_CLOUD.rgb, np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8)
)


@dataclass(frozen=True)
class PairExhibit:
    """One pair: sensor returns, answers, and the outcome of the N samples.

    ``samples`` holds arrays of N rows: ``uv_0``, ``uv_1`` (N, 2) px, ``tracked`` bool, ``xyz`` (N, 3) m in camera 0
    (NaN without an answer), ``rgb`` (N, 3) uint8 of the image, ``depth``, ``sigma`` m, ``score``,
    ``source``, ``gate``, ``hole``, ``parallax_deg``, ``residual_px``, ``error`` (|z − z*| / z* where a held-out return
    passes the truth test, else NaN) and ``candidate`` (whether it does); and, where known, ``cause`` (codes.Cause).
    """

    label: str
    samples: Mapping[str, np.ndarray]
    T_world_from_0: np.ndarray  # (4, 4)
    T_world_from_1: np.ndarray | None = None  # (4, 4), from the estimated pose; None = no pose
    view_0: int | None = None  # positions in ``Exhibit.views``; None = no images
    view_1: int | None = None
    seen: PointCloud = EMPTY_CLOUD  # input returns of the method
    held_out: PointCloud = EMPTY_CLOUD  # held-out returns, or exact depth
    swept: SweptPointCloud = EMPTY_SWEPT_CLOUD  # swept and filled pixels of view 0, with dense depth
    depth_image: DepthImage | None = None  # input depth of the method
    facts: Mapping[str, str] = field(default_factory=dict)

    def gates(self) -> dict[str, int]:
        """Number of samples by outcome: sensor return, answer, or the gate that rejected it."""
        sensed = self.samples["source"] == Source.SENSOR
        counts = {"SENSOR": int(sensed.sum())}
        for code, name in names(Gate).items():
            counts[name] = int((~sensed & (self.samples["gate"] == code)).sum())
        return counts


@dataclass(frozen=True)
class PageOpening:
    """Opening of a page, above the 3D view."""

    numbers: Mapping[str, str]  # name → value
    sentences: Sequence[str] = ()  # sentences
    picture: bytes | None = None  # PNG
    caption: str = ""


@dataclass(frozen=True)
class Exhibit:
    """All displayed data of one recording."""

    name: str
    shots: Sequence[PairExhibit]
    views: Sequence[ExhibitView] = ()
    path: np.ndarray | None = None  # (n, 3) m, camera centres of the recording; None = no trajectory
    facts: Mapping[str, str] = field(default_factory=dict)
    opening: PageOpening | None = None

    @property
    def placed(self) -> bool:
        """Whether all pairs share one world frame; otherwise each is in its reference view's frame."""
        return self.path is not None or len(self.shots) == 1
