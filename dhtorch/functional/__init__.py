"""Triangulation, tracking and pose in kornia's conventions, depth as an image or points, and losses: plain tensors."""

from dhtorch.functional.losses import reprojection_loss, risk_coverage_loss, sigma_weighted_depth_loss
from dhtorch.functional.points import (
    PnPSolution,
    PointTracks,
    solve_p3p,
    solve_pnp_ransac,
    track_points_lk,
    triangulate_points_one_sided,
)
from dhtorch.functional.policy_inputs import GeometryImage, decode_geometry_image, geometry_image, point_cloud

__all__ = [
    "GeometryImage",
    "PnPSolution",
    "PointTracks",
    "decode_geometry_image",
    "geometry_image",
    "point_cloud",
    "reprojection_loss",
    "risk_coverage_loss",
    "sigma_weighted_depth_loss",
    "solve_p3p",
    "solve_pnp_ransac",
    "track_points_lk",
    "triangulate_points_one_sided",
]
