"""Stage 3 on kornia: samples → samples with trackability and a hole class, the cause of a missing return."""

from kornia.feature import gftt_response
from kornia.geometry.transform import remap

from dhtorch.codes import Flag, Hole, first_reason
from dhtorch.geometry.filters import grayscale
from dhtorch.records import MIN_TRACKABILITY, Frame, Samples


def classify_kornia(frame: Frame, samples: Samples, *, min_trackability: float = MIN_TRACKABILITY) -> Samples:
    """Samples with their trackability and, where they have no usable return, their hole class.

    Trackability is the smaller eigenvalue of the gradients' second moments (Shi–Tomasi) under a Gaussian of 1 px;
    :func:`dhtorch.stages.holes.classify`, whose classes and order are used, takes the mean over 7 × 7 px.

    Gradient: ``trackability`` to the image; classes carry none.
    Source: paper, "Hole taxonomy".
    """
    # Gradients are per px, but per 2 px in ``MIN_TRACKABILITY`` and in OpenCV: hence 4 = 2².
    response = 4 * gftt_response(grayscale(frame.image).to(samples.uv.dtype))
    u, v = (samples.uv.detach() + 0.5).floor()[:, None].unbind(-1)
    trackability = remap(response, u, v, mode="nearest", padding_mode="border", align_corners=True)[:, 0, 0]
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
