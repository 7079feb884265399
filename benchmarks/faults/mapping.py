"""Maps of recordings, pages and figures, models under a ruler, and what all share: codes, records, trees."""

CODES = ["tests/test_codes_and_records.py"]
INTEGRATE = ["tests/integrate/test_volume.py", "tests/integrate/test_integrate.py"]
PLOTS = ["tests/viz/test_plots.py"]
POLICY = ["tests/functional/test_policy_inputs.py"]
SCALE = ["tests/measure/test_scale.py"]

TESTS: dict[str, list[str]] = {
    "codes": CODES,
    "pytree": CODES,
    "records": [*CODES, "tests/validation/test_pose_check.py"],
    "functional.policy_inputs": POLICY,
    "functional.points": ["tests/functional/test_points.py"],
    "integrate.colmap_model": ["tests/integrate/test_colmap_model.py"],
    "integrate.level": ["tests/integrate/test_level.py"],
    "integrate.mapping": ["tests/integrate/test_mapping.py"],
    "integrate.recording": INTEGRATE,
    "integrate.scales": ["tests/integrate/test_scales.py"],
    "integrate.surface": INTEGRATE,
    "integrate.sweeps": INTEGRATE,
    "integrate.volume": INTEGRATE,
    "losses.risk_coverage": ["tests/losses/test_risk_coverage.py"],
    "losses.weighted": ["tests/losses/test_weighted.py"],
    "measure.local_scales": SCALE,
    "measure.models": ["tests/measure/test_models.py"],
    "viz.plots.axis": PLOTS,
    "viz.plots.maps": PLOTS,
    "viz.plots.previews": PLOTS,
    "viz.viewer.points": PLOTS,
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "codes": [
        ("is_swept", "(source == Source.SWEPT) | (source == Source.FILLED)", "source == Source.SWEPT"),
        ("is_estimated", " | (source == Source.RECOVERED)", ""),
        ("_name_code", "if value & bit", "if value | bit"),
        ("names", "sorted(pairs.items())", "reversed(pairs.items())"),
    ],
    "pytree": [
        ("chunked_apply", "count <= size", "count < size - 1"),
        ("chunked_apply", "x[i : i + size]", "x[:size]"),
        ("collate", "torch.cat(xs, dim)", "torch.cat(xs[::-1], dim)"),
        ("_join", "(v is None) != (first is None)", "False"),
    ],
    "records": [
        ("Frame.map_camera", "return self.depth_camera", "return self.camera"),
        ("depth_interval", "depth / (1 + reach)", "depth * (1 - reach)"),
        ("depth_interval", "reach = k * sigma / depth", "reach = sigma / depth"),
        (
            "SigmaBudget.scaled_to",
            "sigma.square() / torch.where(split, total, 1.0)",
            "sigma / torch.where(split, total, 1.0)",
        ),
        ("SigmaBudget.scaled_to", "torch.where(split, 0.0, 1.0) * sigma.square()", "0.0"),
        ("SigmaBudget.dominating", "terms.argmax(0)", "terms.argmin(0)"),
    ],
    "functional.policy_inputs": [
        ("geometry_image", "(_LAST - 1) * (1 - torch.log(ratio)", "(_LAST - 1) * (torch.log(ratio)"),
        ("geometry_image", "torch.where(known, sigma / z, 1.0)", "torch.where(known, sigma, 1.0)"),
        ("decode_geometry_image", "_LAST * NEAREST_M / red", "NEAREST_M / red"),
        ("point_cloud", "index % w, index // w", "index // w, index % w"),
        ("point_cloud", "% count.clamp(min=1)", "% h * w"),
    ],
    "functional.points": [
        ("triangulate_points_one_sided", "(ray[..., :, None] * ray[..., None, :])", "ray[..., :, None] ** 0"),
        ("solve_pnp_ransac", "torch.where(ok, fit.cov, 0.0)", "torch.where(ok, fit.cov, fit.cov)"),
    ],
    "losses.risk_coverage": [
        ("risk_coverage_loss", "torch.digamma(n + 1)", "torch.digamma(n)"),
        ("risk_coverage_loss", ".clamp(max=1)", ""),
        ("risk_coverage_loss", "1 + torch.where(others, ahead, 0)", "torch.where(others, ahead, 0)"),
    ],
    "losses.weighted": [
        ("_reduce", "cost.sum() / used.sum().clamp_min(1)", "cost.mean()"),
        ("sigma_weighted_depth_loss", "/ torch.where(used, sigma, one)", "* torch.where(used, sigma, one)"),
        ("_inverse_covariance", "b / det, zero", "-b / det, zero"),
    ],
    "integrate.colmap_model": [
        (
            "_sample_points",
            "count == 2, torch.where(agrees, distance, 0.0).sum(1) / 2",
            "count == 2, torch.where(agrees, distance, 0.0).sum(1)",
        ),
        ("_distance_px", "se3.invert(shot.T_world_from_cam)", "shot.T_world_from_cam"),
        ("_undistort", "(camera.c - low) * scale", "camera.c * scale"),
    ],
    "integrate.level": [
        ("mean_camera_up", "-T.R[0, :, 1]", "T.R[0, :, 1]"),
        ("_fit_floor_normal", ".eigenvectors[:, 0]", ".eigenvectors[:, 2]"),
        ("_fit_floor_normal", "normal @ guess > _MIN_GUESS_COSINE", "normal @ guess > -2"),
        ("_fit_upright_direction", "torch.pi / 2 - upright", "torch.pi - upright"),
        ("_spiral_directions", "1 - 2 * k / count", "1 - k / count"),
        ("_is_in_own_world", "(off < 1e-5).any()", "(off < 1e-5).all()"),
    ],
    "integrate.mapping": [
        ("choose_voxel", "frame.camera.f * frame.depth.shape[-1] / frame.hw[1]", "frame.camera.f"),
        ("choose_voxel", "2 * sorted(sizes)", "sorted(sizes)"),
    ],
    "integrate.recording": [
        ("measure_coverage", "sizes.max()", "sizes.min()"),
        ("chain_poses", "se3.compose(poses[k], T_k_from_neighbour)", "se3.compose(T_k_from_neighbour, poses[k])"),
        ("view_from_sensor", "frame.conf >= min_conf", "frame.conf > min_conf"),
        ("view_from_sensor", "frame.conf.to(depth) / 2", "frame.conf.to(depth)"),
        ("_sample_colours", "/ 255", "/ 256"),
        ("place_frames", "links[i].append((j, se3.invert(T)))", "links[i].append((j, T))"),
    ],
    "integrate.scales": [
        ("choose_coarse_voxel", "_MIN_COARSE_RATIO * voxel", "voxel"),
        ("merge_surfaces", "wide.source != Source.SENSOR", "wide.source == Source.SENSOR"),
        ("merge_surfaces", "(keep.cumsum(0) - 1)", "keep.cumsum(0)"),
    ],
    "integrate.surface": [
        ("extract_points", "front / (front - back)", "0.5 * front / front"),
        ("_interpolate_chunk", "torch.stack((1 - t, t))", "torch.stack((t, 1 - t))"),
        ("_distance_gradient", "(ahead - behind) / 2", "(ahead - behind)"),
        ("_voxel_slots", "(x * BLOCK_SIDE + y) * BLOCK_SIDE + z", "(z * BLOCK_SIDE + y) * BLOCK_SIDE + x"),
    ],
    "integrate.sweeps": [("depth_step_rel", "far * near - 1", "far - near")],
    "integrate.volume": [
        ("make_volume", "4 * voxel", "2 * voxel"),
        ("drop_unconfirmed", "volume.n_swept >= least", "volume.n_swept > least"),
        ("splat_points", "radius * camera.f.amax(-1)[:, None] / z", "radius * camera.f.amax(-1)[:, None] * z"),
    ],
    "measure.local_scales": [
        ("local_scales", "row * REGIONS[1] + column", "row * REGIONS[0] + column"),
        ("local_scales", "np.log(depth / model_depth)", "np.log(model_depth / depth)"),
        ("estimate_scale", "local.sigma[here] ** -2", "local.sigma[here] ** -1"),
        ("estimate_scale", "(n - 1) / n * (", "1 / n * ("),
        ("_robust_mean", "np.abs(x - mean) / 1.5", "0 * x"),
        ("find_faults", "np.argsort(-excess)", "np.argsort(excess)"),
        ("_fit_contrasts", "X - w @ X", "X"),
        ("_gradients", "4 * x**2", "4 * x"),
    ],
    "measure.models": [
        ("Similarity.apply", "self.scale * xyz @ self.R.T", "self.scale * xyz @ self.R"),
        ("Similarity.apply", "+ self.t", "+ self.scale * self.t"),
        ("Similarity.move", "self.R @ moved[..., :3, :3]", "moved[..., :3, :3]"),
        ("_move_w2c", "similarity.move(np.linalg.inv(w2c))", "similarity.move(w2c)"),
        ("_move_w2c", "[1, 2, 3, 0]", "[0, 1, 2, 3]"),
        ("_write_points", "np.log(similarity.scale)", "similarity.scale"),
        ("_read_splat", "w / 2 - 0.5, h / 2 - 0.5", "w / 2, h / 2"),
        ("_write_arrays", "value * value.dtype.type(similarity.scale)", "value"),
    ],
    "viz.plots.axis": [
        ("Axis.place", "(at - low) / (high - low)", "(at - low) / high"),
        ("fit_axis", "0.06 * (high - low)", "0.6 * (high - low)"),
        ("Axis.write", "100 * tick", "tick"),
    ],
    "viz.plots.maps": [
        (
            "apply_log_cmap",
            "np.log(np.where(there, values, axis.low).clip(1e-9)) - low",
            "np.where(there, values, axis.low) - low",
        ),
        ("apply_log_cmap", "np.where(there[..., None], ", "np.where(~there[..., None], "),
        ("fit_depth_axis", "1.25 * low", "12.5 * low"),
    ],
    "viz.plots.previews": [("_resample", "(np.arange(n) + 0.5)", "np.arange(n)")],
    "viz.viewer.points": [
        ("read_ply_exhibit", "turn_between(up).T.numpy()", "turn_between(up).numpy()"),
        ("read_ply_exhibit", '("red", "green", "blue")', '("blue", "green", "red")'),
    ],
}
