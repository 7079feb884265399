"""Plain torch: an enriched set's tables as a map-style data set, depth tokens, one training step.

python benchmarks/clients/torch_loader.py DST [WORKERS]
"""

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
from columns import columns, train_step
from PIL import Image
from pyarrow import parquet
from torch.utils.data import DataLoader, Dataset

from dhtorch import ExtendDepth
from dhtorch.transforms import ExtendedDataset, one_thread


class Rows(Dataset[dict[str, Any]]):
    """Rows of a set whose pictures stand in its tables."""

    def __init__(self, root: str) -> None:
        files = sorted((Path(root) / "data").rglob("*.parquet"))
        self.rows = [row for file in files for row in parquet.read_table(file).to_pylist()]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, i: int) -> dict[str, Any]:
        row = self.rows[i]
        pictures = {k: np.array(Image.open(io.BytesIO(v["bytes"]))) for k, v in row.items() if isinstance(v, dict)}
        return {**{k: np.asarray(v) for k, v in row.items()}, **pictures}


def main(root: str, workers: str = "1") -> None:
    spec = columns(root, tables=True)
    transform = ExtendDepth(**spec["keys"], other_image="before", n=256, tokens_hw=(56, 56))
    data = ExtendedDataset(Rows(root), transform, gap=2)
    loader = DataLoader(data, batch_size=3, num_workers=int(workers), worker_init_fn=one_thread)
    batch = next(iter(loader))
    tokens, known = batch["observation.dh_tokens"], batch["observation.dh_tokens_valid"]
    train_step(tokens, known, batch[spec["target"]].float(), frames=len(data), target_column=spec["target"])


if __name__ == "__main__":
    main(*sys.argv[1:])
