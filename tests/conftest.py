"""One thread for every test: answers are then equal bit for bit, and a busy machine does not slow them down.

Whatever draws without a generator of its own draws the same in every run: torch, numpy and random start from one seed
before a test file is read and again before every test, ahead of its fixtures (those of a module too). So a test's draws
depend neither on the tests before it nor on the process that it runs in.

Every test and what it starts hears Ctrl-C, too: a shell has it ignored by what runs in its background.
"""

import math
import random
import signal

import numpy as np
import pytest
import torch

from dhtorch.runtime import console

torch.set_num_threads(1)
console._LINE_INTERVAL_S = math.inf  # no line of progress among the errors that a test compares, on a slow machine
signal.signal(signal.SIGINT, signal.default_int_handler)


def seed():
    """All generators that a draw without one of its own takes from."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  (what draws without a generator)
    torch.manual_seed(0)


def pytest_collectstart(collector):
    """Draws in the body of a test file or among its parameters."""
    seed()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Draws in a test and in its fixtures."""
    seed()


@pytest.fixture(autouse=True)
def seeded():
    """Draws in a test, whichever fixtures drew before it."""
    seed()
