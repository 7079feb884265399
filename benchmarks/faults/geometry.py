"""Cameras, rigid motions, two-view geometry, reading of pictures."""

TESTS: dict[str, list[str]] = {
    "geometry.camera": ["tests/test_camera.py", "tests/test_contract.py"],
    "geometry.se3": ["tests/test_se3.py", "tests/test_contract.py"],
    "geometry.epipolar": ["tests/test_epipolar.py", "tests/test_triangulate.py", "tests/test_contract.py"],
    "geometry.lookup": ["tests/test_lookup.py", "tests/test_front_end.py", "tests/test_contract.py"],
    "geometry.pyramid": ["tests/test_track.py", "tests/test_contract.py"],
    "geometry.filters": ["tests/test_filters.py", "tests/test_contract.py"],
    "geometry.thin_lens": ["tests/test_defocus.py", "tests/test_contract.py"],
    "geometry.cells": ["tests/test_mapping.py", "tests/test_contract.py"],
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
