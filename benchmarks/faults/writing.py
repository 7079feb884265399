"""Files for other programs, and what is drawn."""

EXPORT = ["tests/export/test_export.py"]
CAMERAS = ["tests/viz/test_viewer_cameras.py"]

TESTS: dict[str, list[str]] = {
    "export.colmap": EXPORT,
    "export.nerfstudio": EXPORT,
    "viz.viewer.html": CAMERAS,
    "viz.viewer.rrd": CAMERAS,
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "export.colmap": [
        ("write_colmap", "str(len(observations[shot]))]", "str(len(observations[shot]) + 1)]"),
        ("write_colmap", "_format_number(u + 0.5)", "_format_number(u)"),
        (
            "write_colmap",
            "enumerate(np.nonzero(np.isfinite(points).all(1))[0], start=1)",
            "enumerate(range(P), start=1)",
        ),
        ("write_colmap", "distinct.index(cameras[k]) + 1", "distinct.index(cameras[k])"),
        ("_camera_parameters", "cx + 0.5, cy + 0.5", "cx, cy"),
        ("_pose_parameters", "se3.invert(shot.T_world_from_cam.map(lambda v: v.double()))", "shot.T_world_from_cam"),
    ],
    "export.nerfstudio": [
        ("make_nerfstudio_frame", "zip(_LENS_NAMES, lens, strict=False)", "zip(_LENS_NAMES, (), strict=False)"),
        ("make_nerfstudio_frame", "float(K[0, 2]) + 0.5", "float(K[0, 2])"),
        ("make_nerfstudio_frame", "@ _GL_FROM_CV", ""),
        ("_LENS_NAMES", '"p1", "p2", "k3"', '"k3", "p1", "p2"'),
        ("quantise_nerfstudio_depth", "z <= 65534", "z <= 65536"),
        ("encode_confidence", ".clip(1)", ""),
        ("encode_confidence", "np.where(valid, depth, 1)", "1"),
    ],
    "viz.viewer.html": [
        ("_encode_pair", '"T_world_from_1": shot.T_world_from_1', '"T_world_from_1": shot.T_world_from_0'),
        ("_encode_pair", '"view_1": shot.view_1', '"view_1": shot.view_0'),
        ("_encode_pair", '"held_out": _encode_cloud(shot.held_out)', '"held_out": _encode_cloud(shot.seen)'),
        ("_encode_view", '"c": list(view.c)', '"c": list(view.f)'),
        ("_encode_cloud", "cloud.xyz - low", "cloud.xyz"),
        ("_quantise_scores", "65535", "255"),
    ],
    "viz.viewer.rrd": [
        ("_log_views", '"source", shot.T_world_from_1, view_1', '"source", shot.T_world_from_0, view_1'),
        ("_log_views", '_log_camera(rr, stream, "source", shot.T_world_from_1, view_1)', "pass"),
        ("_log_camera", "(view.c[k] + 0.5) * s[k]", "view.c[k] * s[k]"),
        ("_log_camera", "w / view.hw[1], h / view.hw[0]", "h / view.hw[0], w / view.hw[1]"),
        ("_log_points", "xyz * (1 - ratio)", "xyz"),
        ("_log_points", "else PointCloud(s[", "else PointCloud(-s["),
        ("_to_jpeg_pixels", "uv + 0.5", "uv"),
    ],
}
