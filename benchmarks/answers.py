"""``python benchmarks/answers.py FILE``: what both methods say of real pairs (``DHTORCH_DATA``).

Asked by ``beside_kornia.py``. Runs whatever ``dhtorch`` is on the path, so that two checkouts can be compared.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

from dhtorch import MAP, PAPER, data
from dhtorch.data.pairs import by_gap
from dhtorch.metrics import holdout

#: Scene, near limit (m) and gap (frames); the last one was taken through a lens.
SCENES = (("holo_a", 2.5, 3), ("7s_redkitchen_000", 2.0, 20), ("7s_redkitchen_400", 2.0, 20), ("tum_fr1_desk9", 1.0, 4))

#: Pairs of a scene, at even steps.
PAIRS = 5


def main() -> None:
    """Write scene, method and pair → depth and gate."""
    torch.set_num_threads(1)
    dumped = {}
    for name, near, gap in SCENES:
        recording = data.open(Path(os.environ["DHTORCH_DATA"]) / name)
        pairs = by_gap(recording, gap)
        for i, j in pairs[:: max(len(pairs) // PAIRS, 1)][:PAIRS]:
            reference, other = (holdout.range_split(recording[k], near) for k in (i, j))
            for method, run in (("paper", PAPER), ("map", MAP)):
                with torch.no_grad():
                    estimate = run(reference, other)
                dumped[name, method, i] = {"depth": estimate.depth[0], "gate": estimate.gate[0]}
    torch.save(dumped, sys.argv[1])


if __name__ == "__main__":
    main()
