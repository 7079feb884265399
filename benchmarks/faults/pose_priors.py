"""Poses from elsewhere and of rigs, and what asks for no graph."""

TESTS: dict[str, list[str]] = {
    "stages.pose_prior": ["tests/stages/test_pose_prior.py"],
    "stages.misalignment": ["tests/stages/test_misalignment.py"],
    "geometry.pose_conventions": ["tests/stages/test_pose_prior.py", "tests/test_contract.py"],
    "geometry.pose_averaging": ["tests/pipeline/test_rig.py", "tests/test_contract.py"],
    "geometry.inference_mode": ["tests/geometry/test_inference_mode.py"],
    "transforms.poses": ["tests/stages/test_pose_prior.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "stages.pose_prior": [
        (
            "check_pose_prior",
            "refuted, no_baseline = refuted | (enough_near & fit.ok & deviates)",
            "refuted, no_baseline = refuted",
        ),
        ("check_pose_prior", "own_cov + xi[:, :, None] * xi[:, None]", "own_cov"),
        ("check_pose_prior", "(count < min_confirmed) | ", ""),
        ("check_pose_prior", "FIT_SIGMA_INFLATION**2 * own_cov", "0 * own_cov"),
        ("check_pose_prior", "(no_baseline | ~(t_snr >= MIN_PRIOR_T_SNR), PoseCode.NO_BASELINE),\n", ""),
        ("check_pose_prior", "(unconfirmed, PoseCode.TOO_FEW),\n", ""),
        ("check_pose_prior", "inlier=(inlier & ok[:, None])[:, :N]", "inlier=inlier[:, :N]"),
        ("reject_poses", "| (prior_fit.code == PoseCode.TOO_FEW)", ""),
        ("reject_poses", "fit.without_pose(rejected, prior_fit.code)", "fit.without_pose(rejected, fit.code)"),
        ("priors_from_frames", ".unflatten(0, world_1.t.shape[:2])", ".unflatten(0, world_1.t.shape[:2][::-1])"),
        ("make_prior", "[sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3", "[sigma[1] ** 2] * 3 + [sigma[0] ** 2] * 3"),
        ("make_prior", "InitialPose if refine else PosePrior", "PosePrior"),
        ("_square", "(c * x * x - 2 * b * x * y + a * y * y)", "(a * x * x - 2 * b * x * y + c * y * y)"),
        ("_matched_convention", "< 0.5", "< 5.0"),
        ("_t_snr", "torch.where(exact, ", "torch.where(~exact, "),
    ],
    "stages.misalignment": [
        ("_is_misaligned", "few_returns / n.clamp_min(1).sqrt()", "0 * n"),
        ("_is_misaligned", "rejected | (gain", "(gain"),
        ("_is_misaligned", "rejected = rejected | (gain", "rejected = rejected & (gain"),
        ("_is_misaligned", "& (fit.t_snr >= min_t_snr)", ""),
        ("_profile_cost", "(COST_BEND**2 / (COST_BEND**2 + square)) ** 2", "1"),
        ("_near_parallax", "used = tracked & samples.usable", "used = samples.usable"),
    ],
    "geometry.pose_conventions": [
        ("TRANSLATION_UNITS", '"millimetres": 1e-3', '"millimetres": 1e3'),
        ("pose_hypotheses", "other_way if direction else T", "T"),
        ("motion_from_axes", "M.T @ T.R @ M", "M @ T.R @ M.T"),
        ("motion_from_axes", "(M.T @ T.t[..., None])", "(M @ T.t[..., None])"),
        ("relative_covariance", "cov_0 + cov_1", "cov_1"),
        ("relative_covariance", "se3.invert(T_world_from_1)", "T_world_from_1"),
    ],
    "geometry.pose_averaging": [
        ("average_poses", "(1 + square / limit) ** -2", "torch.ones_like(square)"),
        ("average_poses", "& (n >= min_agree * valid.sum(-1))", ""),
        ("average_poses", "n >= at_least", "n >= 1"),
        ("average_poses", "& (square < (max_deviation * bend) ** 2)", ""),
        (
            "_start_pose",
            "argmin(0)",
            "argmax(0)",
            "from an outlier, too, the reweighed steps reach the mean of the others",
        ),
        ("_scale", ".clamp_min(1.0)", ""),
    ],
    "geometry.inference_mode": [
        ("run_without_grad", "forward_ad._current_level >= 0 or ", ""),
        ("_requires_graph", "x.requires_grad", "False"),
        ("_leave_inference_mode", "x.clone() if", "x if"),
    ],
    "transforms.poses": [
        ("check_constant_pose", 'or kind != "1_from_0"', ""),
        ("parse_pose_sigmas", "0 <= s < ", "0 < s < "),
        ("read_pose_priors", "keys[1] or name", "name"),
        (
            "read_pose_priors",
            "conventions.motion_from_axes(_read_pose(leaves, name, T[1], place, unit, checks), M)",
            "_read_pose(leaves, name, T[1], place, unit, checks)",
        ),
        ("match_refuted_poses", "refuted & (matched == 0)", "refuted"),
        ("_read_pose", "x[:, :3, 3] * unit", "x[:, :3, 3]"),
        ("_read_pose", "det < 0", "det < -2"),
        ("_read_pose", "~(last < 1e-6)", "(last > 2)"),
    ],
}
