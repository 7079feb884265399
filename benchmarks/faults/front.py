"""Seats 1 to 3, 6 and 7."""

TESTS: dict[str, list[str]] = {
    "stages.sample": ["tests/test_sample.py", "tests/test_front_end.py", "tests/test_contract.py"],
    "stages.backproject": ["tests/test_backproject.py", "tests/test_front_end.py", "tests/test_contract.py"],
    "stages.holes": ["tests/test_holes.py", "tests/test_front_end.py", "tests/test_contract.py"],
    "stages.triangulate": ["tests/test_two_view.py", "tests/test_triangulate.py", "tests/test_contract.py"],
    "stages.score": ["tests/test_score.py", "tests/test_contract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
