"""Poses: minimal solver, search, least squares, near and far tracks."""

TESTS: dict[str, list[str]] = {
    "geometry.least_squares": ["tests/test_least_squares.py", "tests/test_speed.py", "tests/test_contract.py"],
    "geometry.near_far": ["tests/test_near_far.py", "tests/test_map_pose.py", "tests/test_contract.py"],
    "geometry.most_probable": ["tests/test_most_probable.py", "tests/test_map_pose.py", "tests/test_contract.py"],
    "geometry.ransac": ["tests/test_ransac.py", "tests/test_pose.py", "tests/test_contract.py"],
    "geometry.p3p": ["tests/test_p3p.py", "tests/test_contract.py"],
    "geometry.covariance": ["tests/test_covariance.py", "tests/test_pose.py", "tests/test_contract.py"],
    "stages.pose": ["tests/test_pose.py", "tests/test_map_pose.py", "tests/test_contract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
