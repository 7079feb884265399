"""What a LeRobot data set on disk holds: its files, the rows of its tables, the maps in them."""

import io
from pathlib import Path

import numpy as np
from PIL import Image
from pyarrow import parquet

from dhtorch.runtime.output_folder import is_private


def read_files(root):
    """{path below the folder: content} of all files, dhtorch's private folder excluded."""
    files = [p for p in sorted(Path(root).rglob("*")) if p.is_file() and not is_private(p.relative_to(root))]
    return {str(p.relative_to(root)): p.read_bytes() for p in files}


def read_rows(root):
    """The rows of all tables of a data set, in order."""
    tables = sorted((Path(root) / "data").rglob("*.parquet"))
    return [row for table in tables for row in parquet.read_table(table).to_pylist()]


def decode_map(row, key):
    """The map (H, W) that is stored in a row, as an array or as a picture."""
    if isinstance(row[key], list):
        values = np.array(row[key])[0]
        return values.astype(np.float32) if values.dtype.kind == "f" else values
    return np.array(Image.open(io.BytesIO(row[key]["bytes"])))
