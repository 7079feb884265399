"""WebDataset: rows of an enriched set as a tar archive, and the stream of it with depth tokens.

In an environment that has webdataset and dhtorch:  python benchmarks/clients/webdataset_stream.py DST ARCHIVE.tar
"""

import sys

import webdataset
from columns import columns, train_step
from torch.utils.data import DataLoader
from torch_loader import Rows

from dhtorch import ExtendDepth
from dhtorch.transforms import ExtendedStream

GAP = 2


def main(root: str, archive: str) -> None:
    spec = columns(root, tables=True)
    keys, rows = spec["keys"], Rows(root)
    with webdataset.TarWriter(archive) as tar:
        for i in range(GAP, len(rows)):
            row, before = rows[i], rows[i - GAP]
            if row["episode_index"] == before["episode_index"]:
                numbers = {"intrinsics.npy": row[keys["intrinsics"]], "target.npy": row[spec["target"]]}
                pictures = {"image.png": row[keys["image"]], "before.png": before[keys["image"]]}
                tar.write({"__key__": f"{i:06d}", "depth.npy": row[keys["depth"]], **pictures, **numbers})

    stream = webdataset.WebDataset(archive, shardshuffle=False).decode("rgb8")
    places = {"image": "image.png", "other_image": "before.png", "depth": "depth.npy", "intrinsics": "intrinsics.npy"}
    transform = ExtendDepth(**places, depth_unit=keys["depth_unit"], n=256, tokens_hw=(56, 56))
    batch = next(iter(DataLoader(ExtendedStream(stream, transform), batch_size=2)))
    tokens, target = batch["dhtorch.tokens"], batch["target.npy"].float()
    train_step(tokens, batch["dhtorch.tokens_valid"], target, frames=len(rows), target_column=spec["target"])


if __name__ == "__main__":
    main(*sys.argv[1:])
