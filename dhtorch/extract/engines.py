"""Engines that compute rows: data-loader workers of this machine, or tasks of a Ray cluster, with the same result.

An engine yields the rows of some positions in their order. Each is computed by one call for one sample on one thread,
and no worker raises: the error of a frame is part of its row.
"""

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

#: Names of the engines.
ENGINES = ("local", "ray")


def run_engine(
    engine: str, rows: RowDataset, positions: Sequence[int], *, workers: int, address: str | None = None
) -> Iterator[ExtractedRow]:
    """Engine name, rows and positions -> computed rows, in the order of the positions."""
    return run_ray(rows, positions, address) if engine == "ray" else run_local(rows, positions, workers)


def filter_rows(
    answers: Iterable[ExtractedRow],
    on_error: str,
    rows: RowDataset,
    complaints: list[str],
    otherwise: str = "extract.on_error=skip or flag",
) -> Iterator[columns.Row]:
    """Computed rows -> rows to write; applies ``on_error`` to unreadable frames, for all engines alike.

    Raises:
        SampleError: an unreadable frame if ``on_error`` is raise; ``otherwise`` names the option in the message.
    """
    for place, features, complaint in answers:
        if features is None and on_error == "raise":
            raise SampleError(f"{complaint} (set {otherwise} to continue with the other frames)")
        if features is None:
            complaints.append(complaint)
        if features is not None or on_error == "flag":
            yield {**place, **(columns.blank_features(rows.wanted) if features is None else features)}


def run_local(rows: RowDataset, positions: Sequence[int], workers: int) -> Iterator[ExtractedRow]:
    """Compute rows in this process (``workers`` 0), or in data-loader workers.

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
        raise ChildProcessError(f"{error}; is there enough memory for {workers} workers?") from error


def run_ray(rows: RowDataset, positions: Sequence[int], address: str | None) -> Iterator[ExtractedRow]:
    """Compute rows in tasks of a Ray cluster, through Ray Data, which repeats the tasks of lost nodes.

    Args:
        rows: sent to the tasks; data files must have the same path on every node.
        positions: in the plan.
        address: of the cluster; None = start one on this machine, which ends with the last row.

    Raises:
        ConnectionError: no cluster at the address.
    """
    ray, data = import_optional("ray", extra="scale"), import_optional("ray.data", extra="scale")
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if port.isdigit():  # Ray itself retries for minutes
        try:
            socket.create_connection((host, int(port)), timeout=10).close()
        except OSError as error:
            raise ConnectionError(f"address: no connection to {address} ({error}), expected a Ray cluster") from None
    init_args = {} if address else {"include_dashboard": False, "object_store_memory": 300_000_000}
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **init_args)
    except Exception as error:  # Ray has no specific class for a node that does not start
        raise ConnectionError(f"engine=ray: {error}") from error
    try:
        context = data.DataContext.get_current()
        context.execution_options.preserve_order = True
        context.enable_progress_bars = False
        shared = ray.put(rows)
        # A task of 16 rows is repeated if a node is lost.
        blocks = np.split(np.asarray(positions, np.int64), range(16, len(positions), 16))

        def task(batch: dict[str, Any]) -> dict[str, Any]:
            return {
                "answer": [pickle.dumps(answer) for answer in run_local(ray.get(shared), batch["data"].tolist(), 0)]
            }

        tasks = data.from_numpy(blocks).map_batches(task, batch_size=None, num_cpus=1)
        for block in tasks.iter_batches(batch_size=None, prefetch_batches=1):
            yield from map(pickle.loads, block["answer"])
    finally:
        ray.shutdown()


def _init_worker(number: int) -> None:
    one_thread(number)
    exit_with_parent()


def _identity(answer: Any) -> Any:
    return answer
