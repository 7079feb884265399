"""Time of a dense map's sweep, beside rectification and semi-global matching by OpenCV.

    python benchmarks/dense.py --json benchmarks/results/dense_speed.json --clock cpu --repeats 5

Ours is ``dense.swept`` with one other view and 96 planes, motions known, from the frames to the map; the peer is
``cv2.stereoRectify``, both maps and pictures, and ``cv2.StereoSGBM`` with 96 disparities in MODE_HH4, from grey
pictures to disparities, without reading them back into the view. Frames of the built-in room at 640×480, and at
1440×1920 with ``size=640``, where the peer's pictures are made as small. Both sides take turns in one process.
"""

from typing import Any

import cv2
import harness
import numpy as np
import torch

from dhtorch import MAP
from dhtorch.experiments.baselines import stereo
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.records import Frame
from dhtorch.synthetic import SyntheticRoom

#: The room's frames: height and width, reference view and other view, near limit in m.
SIZES, VIEWS, NEAR = ((480, 640), (1440, 1920)), (1, 9), 2.0


#: Bytes of memory per pixel and plane: a cost of one byte written and read in two passes, sums of two bytes that are
#: written by the first and read by the second.
PER_PLANE = 3 * 1 + 2 * 2

#: Planes of the sweep.
PLANES = 96


def measure(hw: tuple[int, int], threads: int, options: Any) -> list[dict[str, Any]]:
    """The sweep beside its peer: in torch, and with compiled code."""
    harness.set_threads(threads)
    room = SyntheticRoom(n_frames=max(VIEWS) + 1, hw=hw, depth_hw=(192, 256))
    reference, other = (range_split(room[k], NEAR) for k in VIEWS)
    trace: dict[str, Any] = {}
    with torch.no_grad():
        joined = MAP(reference, other, trace=trace)
    selected = dense.selected_views(joined, other, trace)
    bytes_0, bytes_1 = (_bytes(frame) for frame in (reference, other))
    size = dense.map_hw(hw, 640)
    cameras = [dense.downscale_grey(frame, 640)[1] for frame in (reference, other)]

    def ours() -> None:
        with torch.no_grad():
            dense.sweep_depth(reference, selected, method=MAP, source_views=1)

    def peer() -> None:
        small = [
            cv2.resize(x, size[::-1], interpolation=cv2.INTER_AREA) if size != hw else x for x in (bytes_0, bytes_1)
        ]
        views = (small[0], cameras[0]), (small[1], cameras[1])
        stereo.match_disparity(stereo.rectify_pair(*views, trace["fit"].T_1_from_0, nearest_m=0.7 * NEAR).pictures)

    a, b, c = harness.in_turn(
        [ours, peer, harness.with_compiled_operators()(ours)], repeats=options.repeats, clock=options.clock
    )
    least = harness.Work(0, PER_PLANE * PLANES * size[0] * size[1])
    more: dict[str, Any] = {"n": size[0] * size[1], "bar": True, "work": least}
    name, other_side = f"sweep_{hw[1]}x{hw[0]}", "rectify + SGBM"
    return [
        harness.row(name, a, other_side, b, **more),
        harness.row(name, c, other_side, b, mode="compiled", **more),
    ]


def _bytes(frame: Frame) -> np.ndarray:
    """Grey picture (H, W) uint8."""
    picture: np.ndarray = cv2.cvtColor(
        np.ascontiguousarray((255 * _float(frame)).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()),
        cv2.COLOR_RGB2GRAY,
    )
    return picture


def _float(frame: Frame) -> torch.Tensor:
    return frame.image[0] / 255 if frame.image.dtype == torch.uint8 else frame.image[0]


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = [row for hw in SIZES for row in measure(hw, 1, options)]
    print(f"milliseconds, medians of {options.repeats}")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
