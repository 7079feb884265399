"""Methods by name: that of the paper, and those with a most probable pose and abstention by the stated error."""

from collections.abc import Sequence
from functools import partial

from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.sensor_noise import get_sensor_noise
from dhtorch.pipeline.fused import fuse_with_sweep
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.stages.fuse import fuse_consistent
from dhtorch.stages.guided_search import guided_search
from dhtorch.stages.kornia.backproject import backproject_kornia
from dhtorch.stages.kornia.holes import classify_kornia
from dhtorch.stages.kornia.pose import pnp_ransac_kornia
from dhtorch.stages.kornia.track import lucas_kanade_kornia
from dhtorch.stages.kornia.triangulate import two_view_kornia
from dhtorch.stages.pose import map_pose
from dhtorch.stages.score import confidence_from_error, confidence_from_sigma
from dhtorch.stages.shared_error import verify_views
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.stages.track_chain import track_chain
from dhtorch.stages.triangulate import two_view

#: The paper's method. Its text fixes the order of the stages and the two gates; numbers, score formula and minimal
#: solver that it leaves open were chosen here, and are listed in docs/methods.md, "What `paper` is". Tracks go through
#: the images between the two views where the hint has them.
PAPER = Method()

#: ``PAPER`` with one jump of the tracks from view to view, whatever lies between.
PAPER_DIRECT = PAPER.replace(track=lucas_kanade)

#: The paper's method as a function of two frames.
extend = PAPER

#: ``PAPER`` written on kornia and torch alone: the method in its shortest form, differentiable from end to end, and the
#: independent implementation that the tests compare ``PAPER`` with. It is slower, and its answers depend on the batch
#: within rounding.
KORNIA = PAPER.replace(
    backproject=backproject_kornia,
    classify=classify_kornia,
    track=partial(track_chain, track=lucas_kanade_kornia),
    pose=pnp_ransac_kornia,
    triangulate=two_view_kornia,
)

#: Pyramid levels of ``MAP``, for motions larger than 30 px. Source: derived, the paper's 4 levels + 1.
MAP_PYRAMID_LEVELS = 5

#: Pose from near and far tracks together, a sigma in metres for every estimate, and no answer where sigma is too large.
#: Tracks are registered once more with an affine window; the pose search starts at the paper's. Its constants were
#: chosen on ``data=shared_scenes`` and on the built-in rooms: results on these are not results on unseen scenes.
MAP = PAPER.replace(
    track=partial(lucas_kanade_affine, levels=MAP_PYRAMID_LEVELS),
    pose=map_pose,
    triangulate=partial(
        two_view,
        min_parallax_deg=None,  # max_sigma_rel limits it
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

#: Source views are selected among those around the reference view; tracks start at the coarse flow of the whole image,
#: whatever the exposures; with a pose prior, what no track answers is searched for. An answer needs consistent views or
#: one with a small sigma, near returns that far points do not contradict, and poses without a large error that all
#: points share. Single views may be uncertain: the sigma of the fused estimate counts.
AUTO = MAP.replace(
    track=partial(
        lucas_kanade_affine, levels=MAP_PYRAMID_LEVELS, start=coarse_flow, track=partial(lucas_kanade, normalise="bias")
    ),
    triangulate={"max_sigma_rel": 1.0, "max_far_noise": 0.0025, "max_in_reach": 0.18},
    verify_views=verify_views,
    fuse=partial(fuse_consistent, max_static_ratio=0.7),
    score=confidence_from_sigma,
    select_views=select_views_by_preview,
    pose_samples=256,
    guide=guided_search,
    views=5,
    chain=False,
)

#: ``AUTO`` joined with a plane sweep of its views: one answer per sample and per pixel, of either or of both.
FUSED = AUTO.replace(complete=fuse_with_sweep)

#: Methods by name.
METHODS = {"paper": PAPER, "kornia": KORNIA, "map": MAP, "auto": AUTO, "fused": FUSED}

#: Name of a method that is gone → what replaces it, in Python and on the command line. Kept for one release.
GONE_METHODS = {
    "window": "MAP.replace(views=5), or method=map method.views=5",
    "map_1": "MAP.replace(verify=None), or method=map method.verify=null",
    "window_1": "MAP.replace(verify=None, views=5), or method=map method.verify=null method.views=5",
    "auto_2": "AUTO.replace(verify_views=None, guide=None, pose_samples=0, select_views={'near': 0, 'reserve': 0, "
    "'prefer_tracked': False})",
    "paper_dlt": "PAPER.replace(triangulate={'solver': opencv_triangulate}) of dhtorch.experiments.baselines.opencv",
}


def gone_method(name: str) -> str:
    """Sentence for the name of a method in :data:`GONE_METHODS`."""
    return f"method {name} is gone (CHANGELOG.md; commit affa1d37 has it), use {GONE_METHODS[name]}"


def with_sensor(method: Method, sensor: str | Sequence[float] | None) -> Method:
    """The method with the noise of a class of sensors, or of three numbers; None = as it is.

    Raises:
        ValueError: as :func:`dhtorch.geometry.sensor_noise.get_sensor_noise`.
    """
    if sensor is None:
        return method
    return method.replace(backproject={"sensor": tuple(get_sensor_noise(sensor))})


def get_method(method: str | Method, n: int | None = None) -> Method:
    """The method of a name in :data:`METHODS`, or the given method; with ``n`` samples if ``n`` is not None.

    Raises:
        ValueError: an unknown name, or another type.
    """
    if isinstance(method, str) and method in GONE_METHODS:
        raise ValueError(gone_method(method))
    if method not in METHODS if isinstance(method, str) else not isinstance(method, Method):
        raise ValueError(f"method is {method!r}, expected one of {sorted(METHODS)} or a Method")
    resolved = METHODS[method] if isinstance(method, str) else method
    return resolved if n is None else resolved.replace(n=n)
