"""Numbers from answers and truth."""

TESTS: dict[str, list[str]] = {
    "evaluate.bootstrap": ["tests/test_evaluate.py"],
    "evaluate.correlation": ["tests/test_evaluate.py"],
    "evaluate.curves": ["tests/test_evaluate.py"],
    "evaluate.errors": ["tests/test_evaluate.py"],
    "evaluate.holdout": ["tests/test_holdout.py"],
    "evaluate.risk": ["tests/test_risk.py"],
    "evaluate.calibrate": ["tests/test_reliability.py"],
    "evaluate.monotone": ["tests/test_monotone.py"],
    "evaluate.recalibrate": ["tests/test_calibrate.py"],
    "evaluate.compare": ["tests/test_compare.py"],
    "evaluate.control": ["tests/test_control.py"],
    "evaluate.probe": ["tests/test_ridge.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
