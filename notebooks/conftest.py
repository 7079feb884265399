"""The first two articles run with every ``make test``, the others, which take minutes, with the slow tests."""

import pytest

QUICK = ("1_one_pair", "2_what_the_gate_buys")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark them before the runner chooses."""
    for item in items:
        if item.path.suffix == ".ipynb":
            item.add_marker(pytest.mark.timeout(1800))
            if item.path.stem not in QUICK:
                item.add_marker(pytest.mark.slow)
