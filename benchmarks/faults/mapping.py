"""Maps of recordings, pages and figures, models under a ruler, and what all share: codes, records, trees."""

CODES = ["tests/test_codes_and_records.py"]
INTEGRATE = ["tests/integrate/test_volume.py", "tests/integrate/test_integrate.py"]
PIN = ["tests/measure/test_pin.py"]
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
    "data.models.colmap": ["tests/data/test_models.py"],
    "data.models.network": ["tests/data/test_models.py"],
    "data.models.scene_model": ["tests/data/test_models.py"],
    "data.models.splat": ["tests/data/test_models.py"],
    "geometry.epipolar_motion": ["tests/geometry/test_epipolar_motion.py"],
    "geometry.motion_fit": ["tests/geometry/test_motion_fit.py", *PIN],
    "measure.pin": PIN,
    "measure.scale": SCALE,
    "metrics.camera_paths": ["tests/metrics/test_grouped.py"],
    "metrics.change_points": ["tests/metrics/test_change_points.py", *PIN],
    "metrics.grouped": ["tests/metrics/test_grouped.py"],
    "pipeline.picture_matching": ["tests/cli/test_numbers.py", *SCALE],
    "viz.plots.axis": PLOTS,
    "viz.plots.maps": PLOTS,
    "viz.plots.previews": PLOTS,
    "viz.viewer.points": PLOTS,
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "codes": [
        ("SOURCES_OF_KIND", "(Source.RECOVERED, Source.SWEPT)", "(Source.RECOVERED, Source.SWEPT, Source.FILLED)"),
        ("is_recovered", "source == Source.SWEPT", "source >= Source.SWEPT"),
        ("is_swept", "(source == Source.SWEPT) | (source == Source.FILLED)", "source == Source.SWEPT"),
        ("is_estimated", " | (source == Source.RECOVERED)", ""),
        ("_name_code", "if value & bit", "if value | bit"),
        ("names", "sorted(pairs.items())", "reversed(pairs.items())"),
    ],
    "pytree": [
        ("chunked_apply", "range(0, count, size)", "range(0, count - 1, size)"),
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
        ("_VoxelTable.gradient", "(ahead - behind) / 2", "(ahead - behind)"),
        ("_VoxelTable.number", "+ y << _SIDE_BITS) + z", "+ z << _SIDE_BITS) + y"),
    ],
    "integrate.sweeps": [("depth_step_rel", "1 / torch.where(", "torch.where(")],
    "integrate.volume": [
        ("make_volume", "4 * voxel", "2 * voxel"),
        ("drop_unconfirmed", "volume.n_swept >= least", "volume.n_swept > least"),
        ("splat_points", "radius * camera.f.amax(-1)[:, None] / z", "radius * camera.f.amax(-1)[:, None] * z"),
    ],
    "measure.local_scales": [
        ("local_scales", "row * REGIONS[1] + column", "row * REGIONS[0] + column"),
        ("local_scales", "np.log(depth / model_depth)", "np.log(model_depth / depth)"),
        ("estimate_scale", "local.sigma[here] ** -2", "local.sigma[here] ** -1"),
        ("find_faults", "np.argsort(-excess)", "np.argsort(excess)"),
        ("_gradients", "4 * x**2", "4 * x"),
    ],
    "geometry.epipolar_motion": [
        ("fit_epipolar_motion", "torch.where(ahead[:, None] < 0, -s, s)", "s"),
        ("_epipolar_step", "tangent @ a), 1)", "-tangent @ a), 1)"),
        ("fit_epipolar_motion", "used & (distance.abs()", "~used & (distance.abs()"),
    ],
    "geometry.motion_fit": [
        ("fit_motion", ".argmin())", ".argmax())"),
        ("fit_motion", "usable & (square <", "usable | (square <"),
        ("_step", "-g[..., None]", "g[..., None]"),
        ("_free", "if rotation_only", "if not rotation_only"),
        ("rotation_from_flow", "-y, 0.0", "y, 0.0"),
        ("scene_flow", "0.5 * ((J @ cov", "((J @ cov"),
    ],
    "measure.pin": [
        ("CameraPin._live_camera", "self.frame.hw, hw)", "hw, self.frame.hw)"),
        ("CameraPin._leave_out", "torch.where(mask[..., None]", "torch.where(~mask[..., None]"),
        ("CameraPin.check", "picture[b : b + 1]", "picture[:1]"),
        ("CameraPin._conclude", "(distance > limit) | translates", "distance > limit"),
        ("CameraPin._conclude", "T_ref = se3.invert(T)", "T_ref = T"),
        ("CameraPin._conclude", "answered = reason == PinReason.ANSWERED", "answered = reason >= PinReason.ANSWERED"),
        ("_select_tracks", "first.valid | second.valid", "first.valid"),
    ],
    "measure.scale": [
        ("_measure", "uv + 0.5", "uv"),
        ("_model_depths", "(view.depth.shape[0], view.depth.shape[1])", "(view.depth.shape[1], view.depth.shape[0])"),
        ("_same_pixels", "view.hw, frame.hw)[None]", "frame.hw, view.hw)[None]"),
        ("_is_clean", "samples.flag[0] & _UNCLEAN == 0", "True"),
        ("_match_views", "sorted(matches, key=lambda m: m.frame)", "matches[:1]"),
    ],
    "metrics.camera_paths": [
        ("align_camera_paths", "np.linalg.det(u @ vt)", "-np.linalg.det(u @ vt)"),
        ("align_camera_paths", "own[:, :3, 3] - turned", "own[:, :3, 3]"),
        ("scale_of_camera_paths", "a[ok] / b[ok]", "b[ok] / a[ok]"),
    ],
    "metrics.change_points": [
        ("median_of_three", ".median(-1)", ".max(-1)"),
        ("mean_changes", "gain > limit", "gain < limit"),
        ("mean_changes", "low + place, high)]", "low + place, high - 1)]"),
        ("_best_split", "k * (n - k) / n", "n"),
    ],
    "metrics.grouped": [
        ("mean_over_stretches", "(n - 1) / n * (", "1 / n * ("),
        ("huber_mean", "np.abs(x - mean) / _HUBER_BEND", "0 * x"),
        ("grouped_slopes", "X - w @ X", "X"),
    ],
    "data.models.scene_model": [
        ("Similarity.apply", "self.scale * xyz @ self.R.T", "self.scale * xyz @ self.R"),
        ("Similarity.apply", "+ self.t", "+ self.scale * self.t"),
        ("Similarity.move", "self.R @ moved[..., :3, :3]", "moved[..., :3, :3]"),
        ("write_points", "np.log(similarity.scale)", "similarity.scale"),
    ],
    "data.models.colmap": [
        ("_move_pose", "similarity.move(image.c2w)", "image.c2w"),
        ("_move_pose", "[3, 0, 1, 2]", "[0, 1, 2, 3]"),
    ],
    "data.models.splat": [("read_splat_model", "w / 2 - 0.5, h / 2 - 0.5", "w / 2, h / 2")],
    "data.models.network": [
        ("_write_arrays", "value * value.dtype.type(similarity.scale)", "value"),
        ("_views_of_arrays", "maps.shape[-1] != trailing", "False"),
    ],
    "pipeline.picture_matching": [
        ("spread_evenly", "len(items) - 1, min(", "len(items) - 2, min("),
        ("match_pictures", "alike[i] > _MIN_CORRELATION", "alike[i] < _MIN_CORRELATION"),
        ("is_same_picture", "moved.median() < _SAME_PICTURE_PX", "moved.median() > _SAME_PICTURE_PX"),
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
