"""Hugging Face ``datasets``: depth tokens made by ``set_transform``, which hands over and takes lists.

In an environment that has datasets and dhtorch:  python benchmarks/clients/hf_datasets.py DST
"""

import sys
from pathlib import Path
from typing import Any

import datasets
import torch
from columns import columns, train_step

from dhtorch import ExtendDepth

GAP = 2


def main(root: str) -> None:
    spec = columns(root, tables=True)
    files = [str(file) for file in sorted((Path(root) / "data").rglob("*.parquet"))]
    data = datasets.Dataset.from_parquet(files, cache_dir=str(Path(root).parent / "cache"), keep_in_memory=True)
    stored, image = data.with_format(None), spec["keys"]["image"]
    transform = ExtendDepth(**spec["keys"], other_image="before", n=256, tokens_hw=(56, 56))

    def extended(batch: dict[str, list[Any]]) -> dict[str, list[Any]]:
        earlier = stored[[max(i - GAP, 0) for i in batch["index"]]]
        rows = [dict(zip(batch, values, strict=True)) for values in zip(*batch.values(), strict=True)]
        for i, row in enumerate(rows):
            row["before"] = earlier[image][i]
            row["before_is_pad"] = [row["index"] < GAP or earlier["episode_index"][i] != row["episode_index"]]
        out = [transform(row) for row in rows]
        return {
            key: [row[key] for row in out]
            for key in ("observation.dh_tokens", "observation.dh_tokens_valid", spec["target"])
        }

    data.set_transform(extended)
    batch = data[:3]
    tokens, target = torch.stack(batch["observation.dh_tokens"]), torch.tensor(batch[spec["target"]])
    known = torch.stack(batch["observation.dh_tokens_valid"])
    train_step(tokens, known, target, frames=len(data), target_column=spec["target"])


if __name__ == "__main__":
    main(sys.argv[1])
