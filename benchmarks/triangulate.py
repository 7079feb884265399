"""Time of two-view triangulation, 1k to 1M points, against ``cv2.triangulatePoints`` and kornia.

    python benchmarks/triangulate.py --json benchmarks/results/triangulate.json

Ours is ``geometry.epipolar.triangulate_depth``. Peers solve the linear system of the
four equations of each point. The pose is exact; pixels of view 1 have 0.3 px of noise.

Errors: median relative error of depth.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import harness
import kornia.geometry.epipolar as kornia_epipolar
import numpy as np
import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.records import Camera, Pose

#: Points kornia is asked for at most: it takes seconds and gigabytes beyond.
KORNIA_POINTS = 10_000


def scene(n: int) -> tuple[Tensor, Tensor, Camera, Pose, Tensor]:
    """Pixels of both views (1, n, 2), the camera, the pose and the true depth, points 1 to 5 m away."""
    g = torch.Generator().manual_seed(0)
    uv_0 = torch.rand(1, n, 2, generator=g) * torch.tensor([640.0, 480.0])
    depth = 1 + 4 * torch.rand(1, n, generator=g)
    camera = Camera(torch.tensor([[525.0, 525.0]]), torch.tensor([[320.0, 240.0]]))
    T = se3.exp(torch.tensor([[0.01, 0.02, -0.01, 0.2, 0.02, 0.01]]))
    uv_1 = cam.project(camera, se3.apply(T, cam.unproject(camera, uv_0, depth)))
    return uv_0, uv_1 + 0.3 * torch.randn(1, n, 2, generator=g), camera, T, depth


def measure(n: int, options: Any) -> list[dict[str, Any]]:
    """Rows of one number of points."""
    uv_0, uv_1, camera, T, truth = scene(n)
    calls: dict[str, Callable[[], Tensor]] = {
        "eager": partial(epipolar.triangulate_depth, uv_0, uv_1, camera, camera, T)
    }
    P_0 = cam.to_matrix(camera) @ torch.eye(3, 4)
    P_1 = cam.to_matrix(camera) @ se3.to_matrix(T)[:, :3]
    a, b = (np.ascontiguousarray(x[0].T.double().numpy()) for x in (uv_0, uv_1))
    p_0, p_1 = P_0[0].double().numpy(), P_1[0].double().numpy()

    def opencv() -> Tensor:
        X = cv2.triangulatePoints(p_0, p_1, a, b)
        return torch.from_numpy(X[2:3] / X[3:4])

    calls["opencv"] = opencv
    if n <= KORNIA_POINTS:
        calls["kornia"] = lambda: kornia_epipolar.triangulate_points(P_0, P_1, uv_0, uv_1)[..., 2]
    durations = harness.in_turn([*calls.values()], repeats=options.repeats, clock=options.clock, warm_up=2)
    times = dict(zip(calls, durations, strict=True))
    error = {name: ((call() - truth).abs() / truth).median().item() for name, call in calls.items()}
    name = f"triangulate_{n // 1000}k" if n < 1_000_000 else f"triangulate_{n // 1_000_000}M"
    rows = []
    for peer in [*times][1:]:
        more: dict[str, Any] = {"n": n, "bar": peer == "opencv"}
        more |= {"ours_error": error["eager"], "peer_error": error[peer]}
        rows.append(harness.row(name, times["eager"], peer, times[peer], **more))
    return rows


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = []
    with torch.no_grad():
        for threads in (1, 2):
            harness.set_threads(threads)
            sizes = (1_000, 10_000, 100_000, 1_000_000) if options.full or threads == 1 else (100_000,)
            for n in sizes:
                rows += measure(n, options)
    print(
        f"milliseconds, medians of {options.repeats} ({options.clock} clock); errors are median relative depth errors"
    )
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
