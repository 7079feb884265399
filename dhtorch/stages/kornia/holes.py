"""Stage 3 on kornia: samples → samples with trackability and a hole class, the cause of a missing return."""

from __future__ import annotations

from kornia.feature import gftt_response
from kornia.geometry.transform import remap

from dhtorch.codes import Flag, Hole, first_reason
from dhtorch.geometry.filters import grayscale
from dhtorch.records import MIN_TRACKABILITY, Frame, Samples

#: Factor on kornia's response to squared gradients per px, which ``MIN_TRACKABILITY`` counts per 2 px, as OpenCV does.
#: Source: derived, 2².
RESPONSE_SCALE = 4.0


def classify_kornia(frame: Frame, samples: Samples, *, min_trackability: float = MIN_TRACKABILITY) -> Samples:
    """Samples with their trackability and, where they have no usable return, their hole class.

    Trackability is the smaller eigenvalue of the gradients' second moments (Shi–Tomasi), under kornia's Gaussian window
    of 1 px where :func:`dhtorch.stages.holes.classify` takes the mean over 7 × 7 px. The classes and their order are
    the same.

    Gradient: ``trackability`` to the image; classes carry none.
    Source: paper, "Hole taxonomy".
    """
    grey = grayscale(frame.image).to(samples.uv.dtype)
    u, v = (samples.uv.detach() + 0.5).floor()[:, None].unbind(-1)
    response = remap(gftt_response(grey), u, v, mode="nearest", padding_mode="border", align_corners=True)
    trackability = RESPONSE_SCALE * response[:, 0, 0]
    hole = first_reason(
        (samples.usable, Hole.NONE),
        ((samples.flag & Flag.BORDER) > 0, Hole.AT_BORDER),
        ((samples.flag & Flag.UNDEREXPOSED) > 0, Hole.TOO_DARK),
        ((samples.flag & Flag.SATURATED) > 0, Hole.TOO_BRIGHT),
        ((samples.flag & Flag.SPECULAR) > 0, Hole.HIGHLIGHT),
        (trackability < min_trackability, Hole.LOW_TEXTURE),
        otherwise=Hole.TRACKABLE_NO_LIDAR,
    )
    return samples.replace(trackability=trackability, hole=hole)
