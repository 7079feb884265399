"""The three code tables: what is wrong with a sample, why a return is missing, why an answer is withheld.

Codes are plain integers (an ``IntEnum`` member compared with a tensor inside ``torch.compile(fullgraph=True)`` becomes
a Python bool). The numbers are fixed once published; the names in the tables are what results and figures print.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor


class Flag:
    """Bits of ``Samples.flag``: several may hold at once. The first five are the paper's."""

    NO_DEPTH: Final = 1  #: the sensor gave no return at this pixel
    LOW_CONF: Final = 2  #: the sensor's own confidence is below the accepted level
    SPECULAR: Final = 4  #: a bright, colourless highlight: returns there are unreliable
    SATURATED: Final = 8  #: the image is clipped at white
    UNDEREXPOSED: Final = 16  #: the image is too dark to see texture
    DEPTH_EDGE: Final = 32  #: returns around the pixel differ: foreground and background meet
    BEYOND_NEAR: Final = 64  #: a return beyond the user's near limit; kept in ``depth``, not in ``xyz``
    BORDER: Final = 128  #: too close to the image border for a full neighbourhood

    #: Any of these bits makes a return unusable (``xyz`` is NaN).
    UNUSABLE: Final = NO_DEPTH | LOW_CONF | BEYOND_NEAR


class Hole:
    """Classes of ``Samples.hole``: why a sample has no usable return, and so what could be done about it."""

    NONE: Final = 0  #: not a hole: the sensor answered
    TRACKABLE_NO_LIDAR: Final = 1  #: normal brightness, enough texture, no usable depth: the key class
    LOW_TEXTURE: Final = 2  #: normal brightness, but nothing to track
    TOO_BRIGHT: Final = 3  #: clipped at white
    TOO_DARK: Final = 4  #: underexposed
    HIGHLIGHT: Final = 5  #: a specular highlight, which moves with the viewer
    AT_BORDER: Final = 6  #: at the image border, where no track can start


class Route:
    """A hint to the user of the map: what could fill this hole (one per :class:`Hole` class)."""

    NOTHING: Final = 0
    TRIANGULATE: Final = 1
    CHANGE_EXPOSURE: Final = 2
    GET_CLOSER: Final = 3
    TURN_HEAD: Final = 4


class Gate:
    """Codes of ``Estimate.gate``, in the order asked; the first reason for silence wins."""

    ANSWER: Final = 0  #: answered
    NO_TRACK: Final = 1  #: not tracked into the other view, or lost on the way back
    NO_TEXTURE: Final = 2  #: trackability below the limit
    NO_POSE: Final = 3  #: no metric relative pose for this pair
    NO_BASELINE: Final = 4  #: the cameras did not translate (significantly)
    BEHIND: Final = 5  #: the rays meet behind a camera
    PARALLAX: Final = 6  #: the rays are too close to parallel
    RESIDUAL: Final = 7  #: the rays miss each other by too many pixels
    INCONSISTENT: Final = 8  #: another view, or the patch itself, contradicts the answer
    UNCERTAIN: Final = 9  #: sigma / depth above the limit
    LOW_SCORE: Final = 10  #: score below the threshold
    CONTRADICTED: Final = 11  #: what lies far contradicts the near returns: these move on their own
    POSE_REFUTED: Final = 12  #: a pose was given, and the near returns contradict it


class PoseCode:
    """Codes of ``PoseFit.code``."""

    OK: Final = 0
    TOO_FEW: Final = 1  #: fewer usable correspondences or inliers than the minimum
    DEGENERATE: Final = 2  #: the points do not determine a pose (collinear, coincident)
    NO_BASELINE: Final = 3  #: the camera did not translate significantly, or stood still
    KEPT_PNP: Final = 4  #: refinement did not improve the fit; the PnP pose was kept
    REFUTED: Final = 5  #: a pose was given, and the near returns contradict it


class Source:
    """Where a value of a merged map comes from."""

    NONE: Final = 0
    SENSOR: Final = 1
    RECOVERED: Final = 2  #: a tracked sample, triangulated
    SWEPT: Final = 3  #: a pixel of a dense map, found on its epipolar line
    ALIGNED: Final = 4  #: a pixel of somebody else's map, tied to returns and answers


class State:
    """What is said of a pixel of a judged depth map."""

    CANNOT_KNOW: Final = 0  #: nothing that was seen could tell: no baseline, no texture, hidden, or no depth
    CONSISTENT: Final = 1  #: what would have told an error of a fifth speaks for it
    WRONG: Final = 2  #: something speaks against it, and nothing for it


def names(table: type) -> dict[int, str]:
    """``{code: name}`` of a code table, in numeric order; composite masks are left out for bit sets."""
    pairs = {v: k for k, v in vars(table).items() if k.isupper() and isinstance(v, int) and k != "UNUSABLE"}
    return dict(sorted(pairs.items()))


def words(name: str) -> str:
    """A code's name as people read it: TRACKABLE_NO_LIDAR → trackable, no LiDAR."""
    return name.lower().replace("_no_lidar", ", no LiDAR").replace("_", " ")


#: What to try for each class of hole.
ROUTE_OF_HOLE: Final[dict[int, int]] = {
    Hole.NONE: Route.NOTHING,
    Hole.TRACKABLE_NO_LIDAR: Route.TRIANGULATE,
    Hole.LOW_TEXTURE: Route.GET_CLOSER,
    Hole.TOO_BRIGHT: Route.CHANGE_EXPOSURE,
    Hole.TOO_DARK: Route.CHANGE_EXPOSURE,
    Hole.HIGHLIGHT: Route.NOTHING,
    Hole.AT_BORDER: Route.TURN_HEAD,
}


def first_reason(*reasons: tuple[Tensor, int], otherwise: int = 0) -> Tensor:
    """Codes int32 of the first mask that holds, asked in the order given; ``otherwise`` where none does.

    Args:
        reasons: (mask, code) pairs; masks are equally shaped bool tensors.
        otherwise: code where no mask holds.
    """
    code = torch.full_like(reasons[0][0], otherwise, dtype=torch.int32)
    for mask, reason in reversed(reasons):
        code.masked_fill_(mask, reason)
    return code
