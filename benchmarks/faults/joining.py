"""The line of seats, and several views."""

TESTS: dict[str, list[str]] = {
    "pair": ["tests/test_merge.py", "tests/test_pair.py"],
    "window": ["tests/test_fusion.py", "tests/test_window.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
