"""Methods of earlier releases with every option written out, as fixed references for later ones.

Changes of defaults elsewhere do not affect them.
"""

from __future__ import annotations

from functools import partial

from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.epipolar import triangulate
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import fuse_consistent, inverse_variance
from dhtorch.stages.holes import classify
from dhtorch.stages.misalignment import reject_misaligned
from dhtorch.stages.pose import map_pose, pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import confidence_from_error, confidence_from_sigma
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.stages.triangulate import two_view

_LUCAS_KANADE = partial(
    lucas_kanade,
    window=21,
    levels=4,
    iterations=30,
    epsilon_px=0.01,
    max_round_trip_px=1.0,
    normalise="none",
    min_eigenvalue=1.5747789311803154e-06,
    start=None,
)

#: First release, one source view: pose from near and far tracks together, a sigma for every answer.
MAP_1 = Method(
    sample=partial(
        spiral,
        turns=None,
        foveation=1.0,
        gaze=None,
        inner_px=1.0,
        margin_px=2.0,
    ),
    backproject=partial(
        backproject,
        near_limit=None,
        min_conf=1,
        sigma_m=0.0,
        sigma_rel=0.01,
        sensor=None,
        search_px=None,
        edge_rel=0.1,
        dark=0.05,
        saturated=0.99,
        highlight=0.85,
    ),
    classify=partial(
        classify,
        block=7,
        min_trackability=1e-05,
    ),
    track=partial(
        lucas_kanade_affine,
        track=_LUCAS_KANADE,
        window=21,
        levels=5,
        iterations=7,
        epsilon_px=0.01,
        max_shift_px=2.0,
        start=None,
    ),
    pose=partial(
        map_pose,
        start=partial(
            pnp_ransac,
            threshold_px=3.0,
            min_inlier=8,
            local_optimisation=2,
            polish_steps=1,
            kernel=None,
            kernel_px=1.0,
        ),
        far_weight=0.1,
        max_rise=0.1,
        isotropic=0.1,
        shutter_sigma=0.01,
        shutter_gain=0.02,
        translation_gain=0.55,
        kernel="geman_mcclure",
        bend=2.0,
        near_steps=4,
        steps=6,
        threshold_px=3.0,
        blocks=None,
    ),
    verify=None,
    triangulate=partial(
        two_view,
        min_parallax_deg=None,
        max_residual_px=3.0,
        max_sigma_rel=0.2,
        min_t_snr=30.0,
        max_mismatch_px=10.0,
        max_far_noise=None,
        max_in_reach=None,
        fitted_noise=True,
        isotropic=0.1,
        mismatch_px=2.0,
        residual_px=0.5,
        round_trip_px=0.4,
        sigma_scale=1.0,
        sensor_share=1.0,
        solver=triangulate,
    ),
    score=partial(
        confidence_from_error,
        residual_scale_px=0.5,
        photometric_scale=None,
        round_trip_scale_px=0.4,
        half_error=0.1,
        recalibration=None,
        min_score=0.0,
    ),
    verify_views=None,
    fuse=partial(
        inverse_variance,
        min_views=2,
        max_chi2=9.0,
        correlation=1.0,
        max_sigma_rel=0.1,
        max_static_ratio=0.5,
    ),
    select_views=None,
    guide=None,
    n=2048,
    pose_samples=0,
    hypotheses=200,
    min_trackability=1e-05,
    views=1,
    chain=True,
)

#: First release, five source views, evenly spaced up to the last one; inverse depths are fused where two or more agree.
WINDOW_1 = MAP_1.replace(views=5)

#: Second release: five source views, selected by previews; consistent or sure estimates are fused.
AUTO_2 = MAP_1.replace(
    track={
        "track": partial(_LUCAS_KANADE, normalise="bias"),
        "start": partial(
            coarse_flow,
            reach=0.25,
            rotations_deg=(0.0, -30.0, -15.0, 15.0, 30.0),
            zooms=(1.0, 1 / 1.4, 1.4),
        ),
    },
    verify=partial(
        reject_misaligned,
        max_unexplained=0.65,
        min_gain=0.85,
        few_returns=3.0,
        min_t_snr=30.0,
    ),
    triangulate={"max_sigma_rel": 1.0, "max_far_noise": 0.0025, "max_in_reach": 0.18},
    score=partial(
        confidence_from_sigma,
        half_error=0.1,
        recalibration=None,
        min_score=0.0,
    ),
    fuse=partial(
        fuse_consistent,
        max_chi2=9.0,
        max_conflict_ratio=0.25,
        sure_rel=0.05,
        sure_rel_each=0.08,
        max_sigma_rel=0.2,
        max_static_ratio=0.7,
    ),
    select_views=partial(
        select_views_by_preview,
        long=240,
        near=0,
        good_sigma_rel=0.1,
        prefer_tracked=False,
        reserve=0,
    ),
    views=5,
    chain=False,
)
