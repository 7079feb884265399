"""Poses from elsewhere and of rigs, and what asks for no graph."""

TESTS: dict[str, list[str]] = {
    "stages.pose_prior": ["tests/stages/test_pose_prior.py"],
    "geometry.pose_conventions": ["tests/stages/test_pose_prior.py", "tests/test_contract.py"],
    "geometry.pose_averaging": ["tests/pipeline/test_rig.py", "tests/test_contract.py"],
    "geometry.inference_mode": ["tests/geometry/test_inference_mode.py"],
    "transforms.poses": ["tests/stages/test_pose_prior.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "stages.pose_prior": [
        ("hold", "refuted, still = refuted | (enough & found.ok & far)", "refuted, still = refuted"),
        ("hold", "own_cov + xi[:, :, None] * xi[:, None]", "own_cov"),
        ("hold", "(count < min_confirmed) | ", ""),
        ("hold", "DOUBT**2 * own_cov", "0 * own_cov"),
        ("hold", "(still | ~(t_snr >= MIN_T_SNR), PoseCode.NO_BASELINE),\n", ""),
        ("hold", "(unknown, PoseCode.TOO_FEW),\n", ""),
        ("hold", "inlier=(inlier & ok[:, None])[:, :N]", "inlier=inlier[:, :N]"),
        ("without", "| (held.code == PoseCode.TOO_FEW)", ""),
        ("without", "code=torch.where(gone, held.code, fit.code)", "code=fit.code"),
        ("from_frames", ".unflatten(0, world_1.t.shape[:2])", ".unflatten(0, world_1.t.shape[:2][::-1])"),
        ("stated", "[sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3", "[sigma[1] ** 2] * 3 + [sigma[0] ** 2] * 3"),
        ("stated", "StartPose if refine else GivenPose", "GivenPose"),
        ("_square", "(c * x * x - 2 * b * x * y + a * y * y)", "(a * x * x - 2 * b * x * y + c * y * y)"),
        ("_looks", "< 0.5", "< 5.0"),
        ("_t_snr", "torch.where(exact, ", "torch.where(~exact, "),
    ],
    "geometry.pose_conventions": [
        ("UNITS", '"millimetres": 1e-3', '"millimetres": 1e3'),
        ("readings", "other_way if way else T", "T"),
        ("in_axes", "M.T @ T.R @ M", "M @ T.R @ M.T"),
        ("in_axes", "(M.T @ T.t[..., None])", "(M @ T.t[..., None])"),
        ("relative_covariance", "cov_0 + cov_1", "cov_1"),
        ("relative_covariance", "se3.invert(T_world_from_1)", "T_world_from_1"),
    ],
    "geometry.pose_averaging": [
        ("rigid_mean", "(1 + square / limit) ** -2", "torch.ones_like(square)"),
        ("rigid_mean", "& (n >= min_agree * valid.sum(-1))", ""),
        ("rigid_mean", "n >= at_least", "n >= 1"),
        ("rigid_mean", "& (square < (max_deviation * bend) ** 2)", ""),
        ("_start", "argmin(0)", "argmax(0)", "from an outlier, too, the reweighed steps reach the mean of the others"),
        ("_scale", ".clamp_min(1.0)", ""),
    ],
    "geometry.inference_mode": [
        ("spared", "forward_ad._current_level >= 0 or ", ""),
        ("_asked", "x.requires_grad", "False"),
        ("_usual", "x.clone() if", "x if"),
    ],
    "transforms.poses": [
        ("check_constant", 'or kind != "1_from_0"', ""),
        ("sigmas", "0 <= s < ", "0 < s < "),
        ("motions", "keys[1] or name", "name"),
        (
            "motions",
            "conventions.in_axes(_pose(leaves, name, T[1], place, unit, checks), M)",
            "_pose(leaves, name, T[1], place, unit, checks)",
        ),
        ("keys", "here & (looks == 0)", "here"),
        ("_pose", "x[:, :3, 3] * unit", "x[:, :3, 3]"),
        ("_pose", "det < 0", "det < -2"),
        ("_pose", "~(last < 1e-6)", "(last > 2)"),
    ],
}
