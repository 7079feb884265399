"""Triangulation, tracking and pose as functions of plain tensors in kornia's conventions."""

from dhtorch.functional.points import (
    PnPSolution,
    PointTracks,
    solve_p3p,
    solve_pnp_ransac,
    track_points_lk,
    triangulate_points_one_sided,
)

__all__ = [
    "PnPSolution",
    "PointTracks",
    "solve_p3p",
    "solve_pnp_ransac",
    "track_points_lk",
    "triangulate_points_one_sided",
]
