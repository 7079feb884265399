"""Notebooks run in kernels of their own, which get minutes to start: the first import of torch on a busy machine with a
cold disk cache takes longer than nbclient's 60 s."""

from functools import partial

import nbmake.nb_run
import pytest

#: Time that a kernel may take until it answers, s.
KERNEL_START_S = 600

#: Notebooks that take half a minute or more each.
SLOW = (
    "0_quickstart.ipynb",
    "1_one_pair.ipynb",
    "3_beside_dinov2.ipynb",
    "4_gradients.ipynb",
    "5_your_own_capture.ipynb",
)

nbmake.nb_run.NotebookClient = partial(nbmake.nb_run.NotebookClient, startup_timeout=KERNEL_START_S)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Notebooks run last: by then the test processes have loaded torch from disk. Those of half a minute are slow."""
    items.sort(key=lambda item: item.path.suffix == ".ipynb")
    for item in items:
        if item.path.name in SLOW:
            item.add_marker(pytest.mark.slow)
