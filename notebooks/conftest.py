"""Notebooks run in kernels of their own, which get minutes to start: the first import of torch on a busy machine with a
cold disk cache takes longer than nbclient's 60 s."""

from functools import partial

import nbmake.nb_run

#: Time that a kernel may take until it answers, s.
KERNEL_START_S = 600

nbmake.nb_run.NotebookClient = partial(nbmake.nb_run.NotebookClient, startup_timeout=KERNEL_START_S)


def pytest_collection_modifyitems(items):
    """Notebooks run last: by then the test processes have loaded torch from disk."""
    items.sort(key=lambda item: item.path.suffix == ".ipynb")
