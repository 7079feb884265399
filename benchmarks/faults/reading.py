"""Readers of captures: what files hold becomes metres, cameras, poses and times."""

BAG = ["tests/data/test_rosbag.py"]
BOMBS = "tests/data/test_decompression_bombs.py"
CODECS = ["tests/data/test_codecs.py"]
FOLDERS = ["tests/data/test_image_folders.py"]
HDF5 = ["tests/data/test_simulator_hdf5.py"]
LEROBOT = ["tests/data/test_lerobot.py"]
POSED = ["tests/data/test_posed_images.py"]
READERS = ["tests/data/test_readers.py"]
RECORD3D = ["tests/data/test_record3d.py"]
RH20T = ["tests/data/test_rh20t.py"]
RLDS = ["tests/data/test_rlds.py"]

TESTS: dict[str, list[str]] = {
    "data.clocks": ["tests/data/test_clocks.py"],
    "data.convert": [*READERS, "tests/data/test_orientation.py"],
    "data.corrections": ["tests/data/test_corrections.py"],
    "data.depth_codes": [*LEROBOT, "tests/transforms/test_adapters.py"],
    "data.depth_maps": ["tests/data/test_depth_maps.py"],
    "data.intrinsics": FOLDERS,
    "data.io.decode": [*CODECS, *READERS],
    "data.members": RECORD3D,
    "data.orientation": ["tests/data/test_orientation.py"],
    "data.pairs": ["tests/data/test_pairs.py"],
    "data.pickled_arrays": ["tests/data/test_pickle.py"],
    "data.plausibility": ["tests/data/test_plausibility.py"],
    "data.pose_convention": ["tests/data/test_pose_convention.py"],
    "data.recording": READERS,
    "data.rig": [*BAG, "tests/data/test_pairs.py"],
    "data.stored_sizes": ["tests/data/test_orientation.py"],
    "data.survey": ["tests/cli/test_inspect.py"],
    "data.units": ["tests/data/test_units.py"],
    "data.codecs.bag_messages": BAG,
    "data.codecs.exr": [*CODECS, *RECORD3D],
    "data.codecs.hdf5": HDF5,
    "data.codecs.lzfse": [*CODECS, *RECORD3D],
    "data.codecs.matroska": ["tests/data/test_azure_kinect.py"],
    "data.codecs.mcap": BAG,
    "data.codecs.mp4": [*CODECS, BOMBS],
    "data.codecs.npy": ["tests/data/test_depth_maps.py", "tests/data/test_pickle.py"],
    "data.codecs.parquet": ["tests/data/test_parquet.py", *LEROBOT],
    "data.codecs.pfm": ["tests/data/test_depth_maps.py", *READERS],
    "data.codecs.pgm": [*FOLDERS, *READERS],
    "data.codecs.pickles": ["tests/data/test_pickle.py"],
    "data.codecs.ros_images": BAG,
    "data.codecs.ros_messages": BAG,
    "data.codecs.rosbag1": BAG,
    "data.codecs.rosbag_database": BAG,
    "data.codecs.tarballs": ["tests/data/test_ca1m.py"],
    "data.codecs.tfrecord": RLDS,
    "data.codecs.thrift": ["tests/data/test_parquet.py"],
    "data.codecs.tiff": ["tests/data/test_tiff.py", *POSED, "tests/data/test_ca1m.py", BOMBS],
    "data.codecs.video": [*CODECS, *RECORD3D],
    "data.codecs.zips": [BOMBS],
    "data.readers.apc": FOLDERS,
    "data.readers.arkitscenes": ["tests/data/test_arkitscenes.py"],
    "data.readers.azure_kinect": ["tests/data/test_azure_kinect.py"],
    "data.readers.bop": FOLDERS,
    "data.readers.ca1m": ["tests/data/test_ca1m.py"],
    "data.codecs.colmap": POSED,
    "data.readers.colmap": POSED,
    "data.readers.driving": READERS,
    "data.readers.frames_dir": [
        *READERS,
        f"{FOLDERS[0]}::test_depth_scale_is_codes_per_metre_or_metres_per_code",
    ],
    "data.readers.image_table": [*FOLDERS, *READERS],
    "data.readers.lerobot": LEROBOT,
    "data.readers.lerobot_meta": LEROBOT,
    "data.readers.lerobot_rows": LEROBOT,
    "data.readers.nerfstudio": POSED,
    "data.readers.open3d": FOLDERS,
    "data.readers.polycam": POSED,
    "data.readers.posed_images": POSED,
    "data.readers.record3d": RECORD3D,
    "data.readers.record3d_video": RECORD3D,
    "data.readers.rectified": READERS,
    "data.readers.replica": FOLDERS,
    "data.readers.rh20t": RH20T,
    "data.readers.rh20t_robot": RH20T,
    "data.readers.rlds": RLDS,
    "data.readers.rlds_steps": ["tests/data/test_rlds_steps.py", "tests/extract/test_enrich_guarantees.py"],
    "data.readers.rosbag": BAG,
    "data.readers.rosbag_cameras": BAG,
    "data.readers.rosbag_index": BAG,
    "data.readers.rosbag_transforms": ["tests/data/test_rosbag_transforms.py", *BAG],
    "data.readers.scannet": FOLDERS,
    "data.readers.sens_folder": FOLDERS,
    "data.readers.simulator_hdf5": HDF5,
    "data.readers.stray": ["tests/data/test_stray.py"],
    "data.readers.sun3d": FOLDERS,
    "data.readers.tum": [
        "tests/data/test_tum.py",
        "tests/data/test_image_folders.py::test_icl_nuim_takes_the_published_K_and_its_frame_numbers",
    ],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "data.clocks": [
        ("_STAMP_UNITS", '"microseconds": 1e-6', '"microseconds": 1e-5'),
        ("pair_stamps", "0.5 * min(", "0.05 * min("),
        ("describe_rate", "low <= rate / seconds <= high", "low <= rate * seconds <= high"),
        ("interpolate_poses", "(1 - weight)[:, None] * t[before]", "weight[:, None] * t[before]"),
        ("_bracketing_stamps", "(after - 1).clip(0), after", "after, after"),
    ],
    "data.convert": [
        ("resize_K", "(s - 1) / 2", "(s - 1)"),
        ("resize_K", "new_hw[1] / hw[1], new_hw[0] / hw[0]", "new_hw[0] / hw[0], new_hw[1] / hw[1]"),
        ("slerp", "np.where(dot < 0, -1.0, 1.0)", "np.where(dot < 0, 1.0, 1.0)"),
        ("rot90_camera", "range(turns % 4)", "range(-turns % 4)"),
        ("rot90_image", "-turns % 4", "turns % 4"),
        ("rot90_pose", "turns % 4", "-turns % 4"),
        ("cv_from_gl", "c2w @ _GL_FROM_CV", "_GL_FROM_CV @ c2w"),
        ("splat_depth", "1.1 * _window_min", "0.5 * _window_min"),
        ("splat_depth", "v * w + u", "u * h + v"),
    ],
    "data.depth_codes": [
        ("metres_by_code", "np.log(high + shift)) - shift", "np.log(high + shift))"),
        ("metres_by_code", "(N_CODES - 1)", "N_CODES"),
        ("metres_by_code", "low + fraction * (high - low)", "fraction * (high - low)"),
    ],
    "data.pairs": [
        ("by_time", "step / 2 if tolerance is None", "step / 20 if tolerance is None"),
        ("by_baseline", "metres / 4 if tolerance is None", "metres * 4 if tolerance is None"),
        ("by_cameras", "q * C + d for q", "q + C * d for q"),
        ("by_scaled_gap", "* scene.gap + 0.5", "* scene.gap"),
        ("spaced_frames", "(k + 1) / views", "k / views"),
        ("_candidates_of_numbers", "(-1,) if past else (-1, 1)", "(1,) if past else (-1, 1)"),
    ],
    "data.plausibility": [
        ("_check_shifted", "metres / 2**n", "metres * 2**n"),
        ("_check_byte_order", "256 * (c % 256) + c // 256", "c"),
        ("_check_byte_order", "stored / swapped", "swapped / stored"),
        ("_check_median", "metres * likely[0]", "metres / likely[0]"),
    ],
    "data.pose_convention": [
        ("PoseConvention.apply", "se3.invert(meant)", "meant"),
        ("PoseConvention.apply", "meant.R @ _axes_matrix(self.axes).to(meant.R)", "meant.R"),
        ("PoseConvention.apply", "poses.t * (", "poses.t / ("),
    ],
    "data.units": [
        ("format_unit", "inverse = 1 / metres", "inverse = metres"),
        ("parse_unit", "float(numerator) / float(denominator or 1)", "float(numerator) * float(denominator or 1)"),
    ],
    "data.stored_sizes": [
        ("describe_mismatch", "depth_hw[1] / depth_hw[0], hw[1] / hw[0]", "depth_hw[1] / depth_hw[0], hw[0] / hw[1]"),
    ],
    "data.orientation": [
        ("_inverse", "k if k >= 4 else -k % 4", "k"),
        ("correlation_of_sums", "product - (sum_a * sum_b).sum(-1) / count", "product"),
    ],
    "data.rig": [
        ("join_cameras", "first[:, None] * C", "first[:, None]"),
        (
            "_nearest_stamp",
            "right = torch.searchsorted(ordered, stamps)",
            "right = torch.searchsorted(ordered, stamps - 1)",
        ),
    ],
    "data.recording": [
        ("Recording._position", "i % n", "i % n - 1"),
        ("consecutive_frame_numbers", "torch.arange(n", "1 + torch.arange(n"),
    ],
    "data.survey": [
        ("describe_camera", "n / 2 / f", "n / f"),
        ("report_depths", "100 * h for h", "h for h"),
        ("_report_times", "1 / median_step", "median_step"),
    ],
    "data.codecs.exr": [
        ("decode_exr_header", "-(-h // per_chunk)", "h // per_chunk"),
        ("_check_chunks", "header.start + 8 * header.chunks", "header.start + 4 * header.chunks"),
    ],
    "data.codecs.matroska": [
        ("_iter_elements", "(1 << 7 * size_length) - 1", "(1 << 7 * size_length)"),
    ],
    "data.codecs.mp4": [
        ("read_display_symmetry", "videos == track", "videos >= track"),
        ("_declared_samples", "sum(n for n, _ in", "max(n for n, _ in"),
    ],
    "data.codecs.pfm": [
        ("read_pfm", '"<f4" if scale < 0 else ">f4"', '">f4" if scale < 0 else "<f4"'),
        ("read_pfm", "[::-1]", ""),
    ],
    "data.codecs.pgm": [("read_pgm", '">u2"', '"<u2"')],
    "data.codecs.ros_images": [
        ("decode_compressed_depth", "np.float32(a) / (code - np.float32(b))", "np.float32(a) / (code + np.float32(b))"),
        ("decode_depth", "to_metres(pixels, 1 / metres)", "to_metres(pixels, metres)"),
        ("_brown_conrady_terms", "r2 + 2 * x * x", "r2 + x * x"),
        ("_invert_brown_conrady", "distorted - ideal", "ideal - distorted"),
    ],
    "data.codecs.ros_messages": [
        ("_Cursor.number", "self.at += -self.at % size", "pass"),
        ("_Cursor.header", "seconds * 10**9 + nanoseconds", "seconds * 10**9"),
    ],
    "data.codecs.rosbag1": [("_parse_record", "seconds * 10**9 + nanoseconds", "seconds * 10**6 + nanoseconds")],
    "data.codecs.tarballs": [
        ("_parse_header", "sum(header[156:])", "sum(header[157:])"),
        ("_iter_headers", "(size + _BLOCK_BYTES - 1) // _BLOCK_BYTES", "size // _BLOCK_BYTES"),
    ],
    "data.codecs.tfrecord": [
        ("read_feature_numbers", '"<f4"', '">f4"'),
        ("_decode_varints", "np.uint64(7) * place", "np.uint64(8) * place"),
        ("_crc_shift_table", "8 * np.arange(4", "4 * np.arange(4"),
    ],
    "data.codecs.tiff": [
        ("_dtype", "bits // 8", "bits // 4"),
        ("_read_first_directory", "at + 2 + 12 * k", "at + 2 + 8 * k"),
    ],
    "data.codecs.video": [
        ("_extract_luma", "plane.line_size // (2 if is_16bit else 1)", "plane.line_size"),
        ("_Decoder._seek", '"right")) - 1', '"right"))'),
        ("read_video_times", "decoder.table() * float(", "decoder.table() / float("),
    ],
    "data.readers.apc": [("_UNITS_PER_METRE", "10000.0", "1000.0")],
    "data.readers.arkitscenes": [
        ("_UNITS_PER_METRE", "1000.0", "100.0"),
        ("_read_poses", "q * [-1, -1, -1, 1]", "q"),
        ("_count_quarter_turns", "c2w[:, 2, :3]", "c2w[:, :3, 2]"),
        ("read", "1 / np.median(np.diff(times))", "np.median(np.diff(times))"),
        ("_count_lost_pictures", "gaps[after[inside] - 1]", "gaps[after[inside] - 2]"),
    ],
    "data.readers.azure_kinect": [
        ("_register", "se3.invert(calibration.depth.T_cam_from_rig)", "calibration.depth.T_cam_from_rig"),
        ("_colour_grid", "(w * aspect - h) / 2", "0.0"),
        ("_parse_lens", "cx * w - left - 0.5, cy * h - top - 0.5", "cx * w - left, cy * h - top"),
    ],
    "data.readers.bop": [
        ("_parse_pose", "-R.T @ (", "-R @ ("),
        ("_MM_PER_M", "1000", "100"),
        ("_read_sensor", "scales[first] / _MM_PER_M", "_MM_PER_M / scales[first]"),
    ],
    "data.readers.ca1m": [
        ("_make_recording", "/ 1e9", "/ 1e6"),
        ("_decode_confidence", "2 / largest", "1 / largest"),
        ("_UNITS_PER_METRE", "1000.0", "100.0"),
    ],
    "data.codecs.colmap": [
        ("_make_lens", "cx - 0.5, cy - 0.5", "cx, cy"),
        ("_make_lens", "focal[0], focal[-1]", "focal[-1], focal[0]"),
    ],
    "data.readers.driving": [
        (
            "_Load.__call__",
            "se3.relative(self.T_world_from_lidar[i : i + 1], self.T_world_from_cam[i : i + 1])",
            "se3.relative(self.T_world_from_cam[i : i + 1], self.T_world_from_lidar[i : i + 1])",
        ),
    ],
    "data.readers.frames_dir": [
        ("_parse_unit", "scale if scale >= 1 else 1 / scale", "scale"),
        ("read", "number.double() / rate", "number.double() * rate"),
    ],
    "data.readers.image_table": [
        ("_pair_stamped", "1e-6", "1e-3"),
        ("_refuse_turned_depth", "((w, h), (h, w))", "((h, w), (w, h))"),
        ("open_image_table", "number.double() / rate", "number.double() * rate"),
    ],
    "data.readers.lerobot": [
        ("_MakeRecording.__call__", "i // len(self.rigs)", "i % len(self.rigs)"),
        ("_Load._depth", "(self.step_m or 1.0)", "1.0"),
        ("_Load._within", "depth <= min(high, 1e6)", "depth < min(high, 1e6) / 2"),
        ("_Load._within", "depth >= low", "depth > 0"),
    ],
    "data.readers.lerobot_meta": [
        ("LeRobotEpisodes.__getitem__", "number // meta.chunks_size", "number % meta.chunks_size"),
    ],
    "data.readers.lerobot_rows": [
        ("select_episode_rows", "grid = number / meta.fps", "grid = number * meta.fps"),
        (
            "select_episode_rows",
            "< _MAX_GRID_ERROR_S, grid, stamp",
            "< 0, grid, stamp",
        ),
        ("read_capture_clock", "own_numbers.astype(np.int64) if whole else numbers", "numbers"),
    ],
    "data.readers.nerfstudio": [
        ("_parse_K", "cx - 0.5, cy - 0.5", "cx, cy"),
        ("_parse_focal", "size / 2 / math.tan(angle / 2)", "size / 2 / math.tan(angle)"),
        ("_parse_pose", "undo @ c2w", "c2w"),
        ("_parse_applied", "np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ applied)", "np.linalg.inv(applied)"),
    ],
    "data.readers.open3d": [
        ("_UNITS_PER_METRE", "1000.0", "100.0"),
        ("_motion_from_first", "np.linalg.inv(matrices[0]) @ matrices", "matrices"),
    ],
    "data.readers.polycam": [
        ("_parse_row", "stamp * 1e-6", "stamp * 1e-3"),
        ("_UNIT", "1e-3", "1e-2"),
    ],
    "data.readers.posed_images": [
        ("PosedImageLoader._depth", "* self.step_m", ""),
        ("open_posed_images", "DepthUnit(1e-3 if first[1] else 1.0)", "DepthUnit(1.0 if first[1] else 1e-3)"),
    ],
    "data.readers.record3d": [
        ("_frame_times", "number.double() / meta.fps", "number.double()"),
    ],
    "data.readers.record3d_video": [
        ("decode_hue_depth", "sixth / 6", "sixth / 5"),
        ("decode_hue_depth", "(b - r) / c + 2", "(b - r) / c + 4"),
        ("decode_hue_depth", "usable & ~jump", "usable"),
        ("_Load.__call__", "picture[:, half:]", "picture[:, :half]"),
    ],
    "data.readers.rectified": [
        ("_LoadPair.__call__", "/ self.codes_per_px + self.doffs", "/ self.codes_per_px"),
        ("_read_calib_pair", '"baseline", file) / 1000', '"baseline", file)'),
        ("_read_views_pair", "(hw[1] - 1) / 2, (hw[0] - 1) / 2", "hw[1] / 2, hw[0] / 2"),
    ],
    "data.readers.replica": [("read", "1 / units", "units")],
    "data.readers.rh20t": [
        ("_Load._depth", "* 256", "* 255"),
        ("_Load._depth", "/ _UNITS_PER_METRE", ""),
    ],
    "data.readers.rh20t_robot": [
        ("hand_camera_poses", "@ np.linalg.inv(cam_from_tcp)", "@ cam_from_tcp"),
        ("hand_camera_poses", "@ np.linalg.inv(arm.align_tcp)", "@ arm.align_tcp"),
        ("read_calibration_tcp", "pose[:3] / 1000", "pose[:3]"),
        ("ms_to_seconds", "value / 1000", "value"),
        ("RobotStream.at", "weight[:, None] * (b - a)", "(1 - weight)[:, None] * (b - a)"),
    ],
    "data.readers.rlds": [
        ("_MakeRecording.__call__", "i // len(self.rigs)", "i % len(self.rigs)"),
        ("_ASSUMED_DEPTH_UNITS", "DepthUnit(1e-3)", "DepthUnit(1e-2)"),
        (
            "_CameraSpec.recording",
            ".double() / self.rate_hz",
            ".double()",
        ),
        ("_CameraSpec._depths", "feature.spans[0].offset + i * size", "feature.spans[0].offset + (i + 1) % n * size"),
    ],
    "data.readers.rlds_steps": [
        ("EpisodeSteps._numbers", "4 * size * steps.start", "4 * steps.start"),
        ("EpisodeSteps._numbers", "feature.spans[0].offset + 4 * size * steps.start", "feature.spans[0].offset"),
        ("EpisodeSteps._numbers", "[size * steps.start : size * steps.stop]", "[: size * len(steps)]"),
        ("EpisodeSteps.values", "for i in steps]", "for i in range(len(steps))]"),
        ("EpisodeSteps.values", 'described.kind == "image"', 'described.kind == "text"'),
    ],
    "data.readers.rosbag": [
        ("_open_pair", "times[0][pairs[:, 0]] / 1e9", "times[0][pairs[:, 0]] / 1e6"),
        (
            "_find_extrinsics",
            "stated[0][reference] @ np.linalg.inv(stated[1][reference])",
            "stated[1][reference] @ np.linalg.inv(stated[0][reference])",
        ),
    ],
    "data.readers.rosbag_cameras": [
        ("_crop", "(h // by, w // bx)), (h // by", "(h, w)), (h // by"),
    ],
    "data.readers.rosbag_transforms": [
        (
            "TransformTree.fixed_transform",
            "np.linalg.inv(to_root[0][common]) @ to_root[1][common]",
            "np.linalg.inv(to_root[1][common]) @ to_root[0][common]",
        ),
        ("TransformTree.poses", "T @ c2w", "c2w @ T"),
        ("_interpolate", "(stamps - origin) / 1e9", "(stamps - origin) / 1e8"),
    ],
    "data.readers.scannet": [
        ("_UNITS_PER_METRE", "1000.0", "100.0"),
        ("_fit_colour_K", "(hw[1] - 1) / 2", "hw[0] / 2"),
    ],
    "data.readers.sens_folder": [("read", "units, source = 1000.0, None", "units, source = 100.0, None")],
    "data.readers.simulator_hdf5": [
        ("_Load.__call__", "(1 - near / far)), 0.0)", "(near / far)), 0.0)"),
        ("_read_poses", "-(R @ poses.t[..., None])", "(R @ poses.t[..., None])"),
        ("_CODES_PER_METRE", "1000.0", "100.0"),
        ("_to_bytes", "* 255", "* 256"),
    ],
    "data.readers.stray": [
        ("_UNITS_PER_METRE", "1000.0", "100.0"),
        ("read", "1 / times.diff().median()", "times.diff().median()"),
    ],
    "data.readers.sun3d": [("_UNITS_PER_METRE", "1000.0", "100.0")],
    "data.readers.tum": [
        ("read", "_FLIP_Y @ c2w @ _FLIP_Y", "_FLIP_Y @ c2w"),
        ("_interpolate_trajectory", "(1 - weight) * a[:, 1:4] + weight * b[:, 1:4]", "a[:, 1:4]"),
        ("_interpolate_trajectory", "< 0, -1.0, 1.0", "< 0, 1.0, 1.0"),
        ("_find_unit", '1 / files.to_positive(meta["depth_scale"]', 'files.to_positive(meta["depth_scale"]'),
        ("_UNITS_PER_METRE", "5000.0", "1000.0"),
    ],
}
