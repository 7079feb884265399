"""Numbers from answers and truth."""

TESTS: dict[str, list[str]] = {
    "evaluate.bootstrap": ["tests/test_evaluate.py"],
    "evaluate.correlation": ["tests/test_evaluate.py"],
    "evaluate.curves": ["tests/test_evaluate.py"],
    "evaluate.errors": ["tests/test_evaluate.py"],
    "evaluate.holdout": ["tests/test_evaluate.py"],
    "evaluate.risk": ["tests/test_evaluate.py"],
    "evaluate.calibrate": ["tests/test_calibrate.py"],
    "evaluate.monotone": ["tests/test_calibrate.py"],
    "evaluate.recalibrate": ["tests/test_calibrate.py"],
    "evaluate.compare": ["tests/test_method_comparison.py"],
    "evaluate.control": ["tests/test_control.py"],
    "evaluate.probe": ["tests/test_probe.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
