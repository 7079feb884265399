"""Methods of the first release with every option written out, as a fixed reference for later ones.

Changes of defaults elsewhere do not affect them.
"""

from __future__ import annotations

from functools import partial

from dhtorch.geometry.epipolar import triangulate
from dhtorch.pipeline.method import Method
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.holes import classify
from dhtorch.stages.pose import map_pose, pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import confidence_from_error
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.stages.triangulate import two_view

#: One source view: pose from near and far tracks together, a sigma for every answer.
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
        track=partial(
            lucas_kanade,
            window=21,
            levels=4,
            iterations=30,
            epsilon_px=0.01,
            max_round_trip_px=1.0,
            normalise="none",
            min_eigenvalue=1.5747789311803154e-06,
            start=None,
        ),
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
    fuse=partial(
        inverse_variance,
        min_views=2,
        max_chi2=9.0,
        correlation=1.0,
        max_sigma_rel=0.1,
        max_static_ratio=0.5,
    ),
    select_views=None,
    n=2048,
    hypotheses=200,
    min_trackability=1e-05,
    views=1,
    chain=True,
)

#: Five source views, evenly spaced up to the last one; their inverse depths are fused where at least two agree.
WINDOW_1 = MAP_1.replace(views=5)
