"""Where rows are made: data-loader workers of this machine, or the tasks of a Ray cluster. The rows are the same.

An engine yields the answers of some positions in their order. Each is made by one call of one sample on one thread,
and no worker raises: what is wrong with a frame travels in its answer.
"""

from __future__ import annotations

import logging
import pickle
import socket
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from torch.utils.data import DataLoader

from dhtorch.data.io.decode import import_optional, set_opencv_threads
from dhtorch.extract import columns
from dhtorch.extract.dataset import ExtractedRow, RowDataset
from dhtorch.runtime.parent_watch import exit_with_parent
from dhtorch.transforms import SampleError, one_thread

#: Rows of one Ray task: what is done again where a node is lost.
_RAY_TASK_ROWS = 16

#: Bytes of shared memory of a Ray that is started on this machine.
_RAY_STORE_BYTES = 300_000_000

#: Time that a cluster is given to answer, s.
_CONNECT_TIMEOUT_S = 10


#: Names of the places.
ENGINES = ("local", "ray")


def run_engine(
    engine: str, rows: RowDataset, positions: Sequence[int], *, workers: int, address: str | None = None
) -> Iterator[ExtractedRow]:
    """The answers of the engine of that name."""
    return run_ray(rows, positions, address) if engine == "ray" else run_local(rows, positions, workers)


def filter_rows(
    answers: Iterable[ExtractedRow],
    on_error: str,
    rows: RowDataset,
    complaints: list[str],
    otherwise: str = "extract.on_error=skip or flag",
) -> Iterator[columns.Row]:
    """Rows to write: what becomes of a frame that cannot be read is decided here, for every engine alike.

    Raises:
        SampleError: one that cannot be read, where ``on_error`` is raise; ``otherwise`` is what to set.
    """
    for place, features, complaint in answers:
        if features is None and on_error == "raise":
            raise SampleError(f"{complaint} (with {otherwise} the rest goes on)")
        if features is None:
            complaints.append(complaint)
        if features is not None or on_error == "flag":
            yield {**place, **(columns.blank_features(rows.wanted) if features is None else features)}


def run_local(rows: RowDataset, positions: Sequence[int], workers: int) -> Iterator[ExtractedRow]:
    """In this process, or in so many data-loader workers.

    Raises:
        ChildProcessError: a worker was killed.
    """
    one_thread()
    set_opencv_threads(1)
    loader = DataLoader(
        rows,
        batch_size=None,
        sampler=positions,
        num_workers=workers,
        worker_init_fn=_init_worker,
        collate_fn=_identity,
    )
    try:
        yield from loader
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise ChildProcessError(f"{error}; is there memory for {workers} workers?") from error


def run_ray(rows: RowDataset, positions: Sequence[int], address: str | None) -> Iterator[ExtractedRow]:
    """In the tasks of a Ray cluster, through Ray Data; lost nodes are made up for.

    Args:
        rows: what the tasks are sent; data files must lie at the same place on every node.
        positions: in the plan.
        address: of the cluster; None = one that is started on this machine and ends with the last row.

    Raises:
        ConnectionError: no cluster at the address.
    """
    ray, data = import_optional("ray", extra="scale"), import_optional("ray.data", extra="scale")
    _check_reachable(address)
    own = {} if address else {"include_dashboard": False, "object_store_memory": _RAY_STORE_BYTES}
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except Exception as error:  # Ray has no class of its own for a node that does not come up
        raise ConnectionError(f"engine=ray: {error}") from error
    try:
        context = data.DataContext.get_current()
        context.execution_options.preserve_order = True
        context.enable_progress_bars = False
        shared = ray.put(rows)
        cuts = range(_RAY_TASK_ROWS, len(positions), _RAY_TASK_ROWS)
        blocks = np.split(np.asarray(positions, np.int64), cuts)

        def task(batch: dict[str, Any]) -> dict[str, Any]:
            return {
                "answer": [pickle.dumps(answer) for answer in run_local(ray.get(shared), batch["data"].tolist(), 0)]
            }

        tasks = data.from_numpy(blocks).map_batches(task, batch_size=None, num_cpus=1)
        for block in tasks.iter_batches(batch_size=None, prefetch_batches=1):
            yield from map(pickle.loads, block["answer"])
    finally:
        ray.shutdown()


def _check_reachable(address: str | None) -> None:
    """Ask whether anything answers: Ray itself goes on trying for minutes."""
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise ConnectionError(f"address: nothing answers at {address} ({error}), expected a cluster") from None


def _init_worker(number: int) -> None:
    one_thread(number)
    exit_with_parent()


def _identity(answer: Any) -> Any:
    return answer
