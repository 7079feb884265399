"""One thread for every test: answers are then equal bit for bit, and a busy machine does not slow them down.

Whatever draws without a generator of its own draws the same in every run: torch, numpy and random start from one seed
before a test file is read and again before every test, ahead of its fixtures (those of a module too). So a test's draws
depend neither on the tests before it nor on the process that it runs in.

Every test and what it starts hears Ctrl-C, too: a shell has it ignored by what runs in its background. Where no library
of operators is compiled, torch is chosen, so that no command prints that there is none.
"""

import gc
import math
import os
import random
import signal

import numpy as np
import pytest
import torch
from support import computed_once

from dhtorch.ops import loader
from dhtorch.runtime import console

if not any((folder / loader.file_name(loader.level())).is_file() for folder in (loader.INSTALLED, loader.cache())):
    os.environ.setdefault(loader.SWITCH, "0")
torch.set_num_threads(1)
console._LINE_INTERVAL_S = math.inf  # no line of progress among the errors that a test compares, on a slow machine
signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(20_000, 20, 20)  # reading thousands of tests, and parsing files, makes many objects that stay
computed_once.parse_settings_once()
computed_once.render_once()
computed_once.check_captures_once()
computed_once.list_modules_once()


#: Without a GPU torch.manual_seed notes a call stack for the GPUs that may come, 1.4 ms of each test's time.
_SEED_TORCH = torch.manual_seed if torch.cuda.is_available() else torch.default_generator.manual_seed


def seed():
    """All generators that a draw without one of its own takes from."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  (what draws without a generator)
    _SEED_TORCH(0)


def pytest_collectstart(collector):
    """Draws in the body of a test file or among its parameters."""
    seed()


def pytest_collection_finish(session):
    """The thousands of collected tests are no garbage: the collector does not visit them again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Draws in a test and in its fixtures."""
    seed()


@pytest.fixture(autouse=True)
def seeded():
    """Draws in a test, whichever fixtures drew before it."""
    seed()
