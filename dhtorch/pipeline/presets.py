"""Methods by name: the paper's, and pose and abstention by what the errors must be."""

from __future__ import annotations

from functools import partial

from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.stages.fuse import fuse_consistent
from dhtorch.stages.pose import map_pose
from dhtorch.stages.score import confidence_from_error, confidence_from_sigma
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.stages.triangulate import two_view

#: The paper's method and parameters; P3P instead of EPnP as the minimal solver is the one stated difference.
PAPER = Method()

#: The paper's method as a function of two frames.
extend = PAPER

#: Pyramid levels of ``MAP``: one more than the paper, motions are larger than 30 px.
MAP_PYRAMID_LEVELS = 5

#: Pose from near and far tracks together, a sigma in metres for every answer, and silence where that is too large.
#: Tracks are registered once more with an affine window; the pose starts from the paper's. Its constants were chosen on
#: ``data=shared_scenes`` and on the built-in rooms: figures on these are not figures on scenes that it has not seen.
MAP = PAPER.replace(
    track=partial(lucas_kanade_affine, levels=MAP_PYRAMID_LEVELS),
    pose=map_pose,
    triangulate=partial(
        two_view,
        min_parallax_deg=None,  # sigma says it
        max_sigma_rel=0.2,
        min_t_snr=30.0,
        max_mismatch_px=10.0,
        fitted_noise=True,
        mismatch_px=2.0,
        residual_px=0.5,
        round_trip_px=0.4,
        sensor_share=1.0,
    ),
    score=confidence_from_error,
)

#: ``MAP`` for several views of one anchor: each view a pair, their inverse depths fused where they agree.
WINDOW = MAP.replace(views=5)

#: Several views chosen among those around the reference view; the search begins where the whole picture went, whatever
#: the exposures; an answer needs views that agree or one that is sure by itself, and near returns that what lies far
#: does not contradict. A view may be unsure: what counts is how sure they are together.
AUTO = MAP.replace(
    track=partial(
        lucas_kanade_affine, levels=MAP_PYRAMID_LEVELS, start=coarse_flow, track=partial(lucas_kanade, normalise="bias")
    ),
    triangulate={"max_sigma_rel": 1.0, "max_far_noise": 0.0025, "max_in_reach": 0.18},
    fuse=partial(fuse_consistent, max_static_ratio=0.7),
    score=confidence_from_sigma,
    select_views=select_views_by_preview,
    views=5,
    chain=False,
)

METHODS = {"paper": PAPER, "map": MAP, "window": WINDOW, "auto": AUTO}


def get_method(method: str | Method, n: int | None = None) -> Method:
    """A method by its name or as it is, with ``n`` samples where that is said.

    Raises:
        ValueError: a name of :data:`METHODS` is unknown, or something else.
    """
    if method not in METHODS if isinstance(method, str) else not isinstance(method, Method):
        raise ValueError(f"method is {method!r}, expected one of {sorted(METHODS)} or a Method")
    found = METHODS[method] if isinstance(method, str) else method
    return found if n is None else found.replace(n=n)
