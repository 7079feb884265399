"""Time per frame of stages 1 to 3, against numpy + OpenCV.

    python benchmarks/frontend.py --json benchmarks/results/frontend.json

One view of the built-in room with its LiDAR model (depth 192x256 with confidence), the picture resampled to 224x224 and
1440x1920, three channels uint8, interleaved in memory as decoders leave them. The peer answers the same questions about
the same pixels in numpy + OpenCV: depth, points, noise, confidence, flags, texture, class. Both sides keep the spiral,
which depends on the picture's size alone. Mode ``compiled`` uses the compiled code of ``python -m dhtorch.ops``.

Errors: median relative difference of the trackability from float64 arithmetic on grey values that were not rounded.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import harness
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from dhtorch.codes import Flag, Hole
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import luma
from dhtorch.metrics import holdout
from dhtorch.records import Frame, Samples
from dhtorch.stages.backproject import backproject
from dhtorch.stages.holes import classify
from dhtorch.stages.sample import spiral
from dhtorch.synthetic.recording import SyntheticRoom

SIZES = {"224": (224, 224), "1440": (1440, 1920)}


def view(hw: tuple[int, int], batch: int = 1) -> Frame:
    """One view of the room with its near returns, as often as asked for."""
    room = SyntheticRoom()
    frame = holdout.range_split(room[0], 2.0)
    image = interpolate(frame.image / 255, hw, mode="bilinear", antialias=True, align_corners=False).clamp(0, 1)
    image = (image * 255).round().to(torch.uint8).repeat(batch, 1, 1, 1).contiguous(memory_format=torch.channels_last)
    frame = frame.map(lambda x: x.repeat(batch, *[1] * (x.ndim - 1)))
    return frame.replace(image=image, camera=cam.resize(frame.camera, frame.hw, hw))


def front_end(frame: Frame, n: int) -> Samples:
    """Stages 1 to 3."""
    uv = spiral(frame.hw, n, device=frame.image.device)
    return classify(frame, backproject(frame, uv))


class OpenCVFrontEnd:
    """The same of one frame after another, as one would write it with OpenCV: filters on whole pictures, then look-ups.

    What both sides would do once (the spiral, arrays of the frames) is made before.
    """

    def __init__(self, frame: Frame, n: int) -> None:
        self.uv = spiral(frame.hw, n).numpy()
        self.images = [np.ascontiguousarray(x) for x in frame.image.permute(0, 2, 3, 1).numpy()]
        assert frame.conf is not None
        self.depths, self.levels = frame.depth.numpy(), frame.conf.numpy()
        self.f, self.c = frame.camera.f.numpy(), frame.camera.c.numpy()

    def __call__(self) -> list[dict[str, Any]]:
        """Answers by name, one dict per frame."""
        arrays = zip(self.images, self.depths, self.levels, self.f, self.c, strict=True)
        return [self.one(*x) for x in arrays]

    def one(self, image: Any, depth: Any, level: Any, f: Any, c: Any) -> dict[str, Any]:
        """Answers about one frame."""
        H, W = image.shape[:2]
        h, w = depth.shape
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        texture, mean = cv2.cornerMinEigenVal(grey, 7, ksize=3), cv2.blur(grey, (5, 5))
        box = np.ones((5, 5), np.uint8)
        high, low = cv2.dilate(depth, box), cv2.erode(np.where(depth > 0, depth, np.float32(1e9)), box)
        u, v = np.floor(self.uv + 0.5).astype(np.int32).T
        a, b = np.floor((self.uv + 0.5) * np.array([w / W, h / H], np.float32)).astype(np.int32).T
        z, conf = depth[b, a], level[b, a]
        returned = z > 0
        usable = returned & (conf >= 1)
        edge = returned & (high[b, a] > low[b, a] * np.float32(1.1))
        xyz = np.concatenate(((self.uv - c) / f * z[:, None], z[:, None]), 1)
        xyz[~usable] = np.nan
        around, centre, colour = mean[v, u], grey[v, u].astype(np.float32), image[v, u]
        top, bottom = colour.max(1).astype(np.float32), colour.min(1)
        shine = (top - bottom <= 0.15 * top) & (centre >= 0.85 * 255) & (centre - around >= 0.1 * 255)
        dim, white = around <= 0.05 * 255, around >= 0.99 * 255
        border = (u < 2) | (v < 2) | (u > W - 3) | (v > H - 3)
        flag = ~returned * Flag.NO_DEPTH | (returned & ~usable) * Flag.LOW_CONF | edge * Flag.DEPTH_EDGE
        flag = flag | border * Flag.BORDER | dim * Flag.UNDEREXPOSED | white * Flag.SATURATED | shine * Flag.SPECULAR
        trackability = texture[v, u]
        masks = [usable, border, dim, white, shine, trackability < 1e-5]
        kinds = [Hole.NONE, Hole.AT_BORDER, Hole.TOO_DARK, Hole.TOO_BRIGHT, Hole.HIGHLIGHT, Hole.LOW_TEXTURE]
        halvings = edge.astype(np.int32) + shine + white
        return {
            "depth": z,
            "sigma": np.float32(0.01) * z,
            "xyz": xyz,
            "confidence": np.where(usable, conf * np.float32(0.5) * np.float32(0.5) ** halvings, 0),
            "flag": flag,
            "trackability": trackability,
            "hole": np.select(masks, kinds, Hole.TRACKABLE_NO_LIDAR),
        }


def exact_trackability(frame: Frame, n: int) -> Tensor:
    """(N,) of the first frame in float64, from grey values that were not rounded."""
    whole = cv2.cornerMinEigenVal(luma(frame.image[:1].double() / 255, 1)[0, 0].float().numpy(), 7, ksize=3)
    u, v = torch.floor(spiral(frame.hw, n) + 0.5).long().T
    return torch.from_numpy(whole)[v, u]


def agreement(samples: Samples, peer: list[dict[str, Any]]) -> str:
    """In words, how far both sides say the same."""
    hole, flag = (torch.from_numpy(np.stack([p[k] for p in peer])) for k in ("hole", "flag"))
    xyz = torch.from_numpy(np.stack([p["xyz"] for p in peer]))
    same = [(samples.hole == hole).double().mean().item(), (samples.flag == flag).double().mean().item()]
    apart = (samples.xyz - xyz).abs().nan_to_num().max().item()
    return f"same class {same[0]:.4f}, same flags {same[1]:.4f}, xyz within {apart:.1g} m"


def measure(size: str, n: int, batch: int, options: Any) -> list[dict[str, Any]]:
    """Rows of one size: eager and compiled against OpenCV."""
    frame = view(SIZES[size], batch)
    peer = OpenCVFrontEnd(frame, n)
    calls: list[Callable[[], Any]] = [
        peer,
        partial(front_end, frame, n),
        partial(harness.with_compiled_operators()(front_end), frame, n),
    ]
    times = harness.in_turn(calls, repeats=options.repeats, clock=options.clock, least_ms=20)
    times = [[t / batch for t in side] for side in times]
    exact = exact_trackability(frame, n)
    theirs = peer()
    name = f"frontend_{size}" + (f"_n{n}" if n != 1024 else "") + (f"_b{batch}" if batch > 1 else "")
    errors = [
        ((x - exact).abs() / exact.clamp_min(1e-8)).median().item()
        for x in (calls[1]().trackability[0], torch.from_numpy(theirs[0]["trackability"]))
    ]
    print(f"{name}: {agreement(calls[1](), theirs)}")
    more = {"n": n, "batch": batch, "bar": True, "ours_error": errors[0], "peer_error": errors[1]}
    return [
        harness.row(name, times[k], "numpy_opencv", times[0], **more, mode=mode)
        for k, mode in ((1, "eager"), (2, "compiled"))
    ]


def main() -> None:
    """Print the tables; write the rows with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = []
    with torch.no_grad():
        for threads in (1, 2):
            harness.set_threads(threads)
            sizes = [(name, 1024, 1) for name in SIZES]
            if options.full or threads == 1:
                sizes += [("224", 2048, 1), ("224", 1024, 64)]
            if options.full:
                sizes += [("1440", 2048, 1), ("1440", 1024, 64)]
            for size in sizes:
                rows += measure(*size, options)
    print(f"milliseconds per frame, medians of {options.repeats} ({options.clock} clock)")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
