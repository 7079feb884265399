"""The stages on kornia."""

TESTS: dict[str, list[str]] = {
    f"stages.kornia.{name}": ["tests/stages/test_kornia_stages.py"]
    for name in ("backproject", "holes", "track", "pose", "triangulate")
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "stages.kornia.backproject": [
        ("backproject_kornia", "depth > (torch.inf if near_limit", "depth >= (torch.inf if near_limit"),
        ("backproject_kornia", "0.15 * colour", "0.5 * colour"),
        ("_read_returns", "offset.abs().amax(-1) <= RADIUS_PX", "offset.abs().amax(-1) <= SPARSE_RADIUS_PX"),
        ("_read_returns", "offset.square().sum(-1)", "-offset.square().sum(-1)"),
        ("_read_windows", "side).flip(-1)", "side)"),
    ],
    "stages.kornia.holes": [
        ("classify_kornia", "4 * gftt_response", "gftt_response"),
        ("classify_kornia", "+ 0.5).floor()", ").floor()"),
        ("classify_kornia", "trackability < min_trackability", "trackability > min_trackability"),
    ],
    "stages.kornia.track": [
        ("lucas_kanade_kornia", "(error < max_round_trip_px)", "(error > max_round_trip_px)"),
        ("lucas_kanade_kornia", "window**2 - 2", "window"),
        ("_newton_step", "y - torch.where(regular, step", "y + torch.where(regular, step"),
        ("_to_level", "other.shape[-1] / picture.shape[-1]", "picture.shape[-1] / other.shape[-1]"),
        ("_template", '"zeros").transpose(1, 2)', '"zeros").transpose(1, 2).flip(2)'),
    ],
    "stages.kornia.pose": [
        ("pnp_ransac_kornia", "movedim(0, 1), -g)", "movedim(0, 1), g)"),
        ("pnp_ransac_kornia", "2 * n_inlier - 6", "n_inlier"),
        ("_linearise", "cross(Y[..., None, :], J_point)", "cross(J_point, Y[..., None, :].expand_as(J_point))"),
        ("_move", "xi[..., 0].roll(3, -1)", "xi[..., 0]"),
    ],
    "stages.kornia.triangulate": [
        ("two_view_kornia", "uv_0, on_line, solver", "uv_0, uv_1, solver"),
        ("two_view_kornia", "cross(Y, by_point), by_point", "by_point, by_point"),
        ("two_view_kornia", "torch.where(usable, 2, 1)", "torch.where(usable, 1, 2)"),
        ("two_view_kornia", "residual_px >= max_residual_px", "residual_px >= 2 * max_residual_px"),
    ],
}
