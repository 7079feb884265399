"""The line of seats, and several views."""

TESTS: dict[str, list[str]] = {
    "pair": ["tests/test_pair.py"],
    "window": ["tests/test_window.py", "tests/test_contract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
