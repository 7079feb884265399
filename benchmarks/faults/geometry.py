"""Cameras, rigid motions, two-view geometry."""

TESTS: dict[str, list[str]] = {
    "geometry.camera": ["tests/test_camera.py", "tests/test_contract.py"],
    "geometry.se3": ["tests/test_se3.py", "tests/test_contract.py"],
    "geometry.epipolar": ["tests/test_epipolar.py", "tests/test_triangulate.py", "tests/test_contract.py"],
    "geometry.shapes": ["tests/test_pair.py", "tests/test_contract.py"],
    "geometry.steady": ["tests/test_se3.py", "tests/test_contract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "geometry.se3": [
        (
            "exp",
            "1 - theta2 / 6 * (1 - theta2 / 20 * (1 - theta2 / 42))",
            "1 - theta2 / 6 * (1 - theta2 / 21 * (1 - theta2 / 42))",
        ),
    ],
}
