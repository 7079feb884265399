"""Time per pair of the metric pose from near points, against OpenCV, PoseLib and pycolmap, and how well all find it.

    python benchmarks/pnp.py --json benchmarks/results/pnp.json

Random scenes: points 0.5 to 2.5 m away seen by a 640x480 camera, pixels with 0.5 px of noise, a share of them replaced
by any other pixel. Ours is stage 5 of ``paper`` with 64 hypotheses, enough for half the points being wrong. Peers, pair
after pair: ``cv2.solvePnPRansac`` with AP3P and with USAC MAGSAC, both followed by ``cv2.solvePnPRefineLM`` on the
inliers; PoseLib with at least 100 iterations (its default of 1000 would be no fair peer); pycolmap where it is
installed. Mode ``compiled`` is the stage with the compiled code of ``python -m dhtorch.ops``. Ours runs under
``torch.inference_mode``, as one would run it where nothing is to be learned.

Errors: median rotation error in degrees over a hundred pairs; that of the translation is printed above the table.
"""

import importlib.util
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cv2
import harness
import numpy as np
import poselib
import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.records import Camera, Pose, Samples, Tracks
from dhtorch.stages.pose import pnp_ransac

HW, FOCAL, THRESHOLD_PX, HYPOTHESES = (480, 640), 525.0, 3.0, 64
K = np.array([[FOCAL, 0, HW[1] / 2], [0, FOCAL, HW[0] / 2], [0, 0, 1]])

#: Multiply-adds of one pose: of a hypothesis 1500 for its minimal problem, and 16 for each of its 4 solutions and each
#: point that scores it; of a point and step of the refinement 80 (27 sums over two rows of seven, and the projection).
PER_HYPOTHESIS, PER_COST, PER_STEP = 1500, 4 * 16, 80

#: Points that a hypothesis is scored on, and steps of the refinements, as counts.
SCORED, STEPS = 64, 10
PeerPose = tuple[np.ndarray, np.ndarray]
#: pycolmap is optional, and its import takes a while: only where it is asked.
HAS_COLMAP = importlib.util.find_spec("pycolmap") is not None


def scene(batch: int, n: int, outliers: float, seed: int) -> tuple[Samples, Tracks, Camera, Pose]:
    """Near points, where they were seen, the camera of both views and the true pose (float64)."""
    g = torch.Generator().manual_seed(seed)
    size = torch.tensor([HW[1], HW[0]], dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    uv_0, z = uniform(batch, n, 2) * size, 0.5 + 2 * uniform(batch, n)
    camera = Camera(torch.full((batch, 2), FOCAL).double(), (size / 2).expand(batch, 2))
    T = se3.exp(0.1 * torch.randn(batch, 6, generator=g, dtype=torch.float64))
    xyz = cam.unproject(camera, uv_0, z)
    uv_1 = cam.project(camera, se3.apply(T, xyz)) + 0.5 * torch.randn(batch, n, 2, generator=g, dtype=torch.float64)
    wrong = uniform(batch, n) < outliers
    uv_1 = torch.where(wrong[..., None], uniform(batch, n, 2) * size, uv_1)
    one = torch.ones(batch, n)
    code = one.int()
    samples = Samples(uv_0.float(), z.float(), 0.01 * z.float(), xyz.float(), one, code, one, code)
    eye = torch.eye(2).expand(batch, n, 2, 2)
    return samples, Tracks(uv_0.float(), uv_1.float(), 0 * one, 0 * one, eye, one > 0), camera.to(torch.float32), T


def ap3p(xyz: np.ndarray, uv: np.ndarray) -> PeerPose:
    """OpenCV: AP3P in RANSAC, refined on the inliers."""
    options: Any = {"reprojectionError": THRESHOLD_PX, "iterationsCount": 1000, "confidence": 0.999}
    _, r, t, inlier = cv2.solvePnPRansac(xyz, uv, K, None, flags=cv2.SOLVEPNP_AP3P, **options)
    return refined(xyz, uv, r, t, inlier)


def magsac(xyz: np.ndarray, uv: np.ndarray) -> PeerPose:
    """OpenCV: USAC with the MAGSAC score, refined on the inliers."""
    params = cv2.UsacParams()
    params.score, params.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    params.threshold, params.maxIterations, params.confidence = THRESHOLD_PX, 1000, 0.999
    _, _, r, t, inlier = cv2.solvePnPRansac(xyz, uv, K, None, params=params)
    return refined(xyz, uv, r, t, inlier)


def refined(xyz: np.ndarray, uv: np.ndarray, r: Any, t: Any, inlier: Any) -> PeerPose:
    """Levenberg-Marquardt on the inliers."""
    index = inlier[:, 0]
    r, t = cv2.solvePnPRefineLM(xyz[index], uv[index], K, None, r, t)
    return cv2.Rodrigues(r)[0], t[:, 0]


def pose_lib(xyz: np.ndarray, uv: np.ndarray) -> PeerPose:
    """PoseLib's robust absolute pose."""
    camera = {"model": "PINHOLE", "width": HW[1], "height": HW[0], "params": [FOCAL, FOCAL, HW[1] / 2, HW[0] / 2]}
    pose, _ = poselib.estimate_absolute_pose(
        uv, xyz, camera, {"max_reproj_error": THRESHOLD_PX, "min_iterations": 100}, {}
    )
    return pose.R, pose.t


def colmap(xyz: np.ndarray, uv: np.ndarray) -> PeerPose:
    """COLMAP's robust absolute pose, refined."""
    import pycolmap

    camera = pycolmap.Camera(model="PINHOLE", width=HW[1], height=HW[0], params=[FOCAL, FOCAL, HW[1] / 2, HW[0] / 2])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.min_num_trials, options.ransac.confidence = THRESHOLD_PX, 100, 0.999
    result: Any = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, camera, options)
    matrix = np.asarray(result["cam_from_world"].matrix())
    return matrix[:, :3], matrix[:, 3]


PEERS: dict[str, Callable[[np.ndarray, np.ndarray], PeerPose]] = {"opencv_ap3p": ap3p, "opencv_magsac": magsac}
PEERS |= {"poselib": pose_lib} | ({"pycolmap": colmap} if HAS_COLMAP else {})


def arrays(samples: Samples, tracks: Tracks) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and pixels of each pair, as the peers want them."""
    return [(x.double().numpy(), u.double().numpy()) for x, u in zip(samples.xyz, tracks.uv_1, strict=True)]


def work(n: int) -> harness.Work:
    """Least work of a pose from ``n`` points, which are in cache."""
    return harness.Work(HYPOTHESES * (PER_HYPOTHESIS + PER_COST * min(n, SCORED)) + STEPS * n * PER_STEP, 0)


def each(peer: Callable[..., PeerPose], pairs: list[tuple[np.ndarray, np.ndarray]]) -> Pose:
    """A peer's answers to some pairs."""
    R, t = zip(*(peer(*pair) for pair in pairs), strict=True)
    return Pose(torch.from_numpy(np.stack(R)), torch.from_numpy(np.stack(t)))


def errors(pose: Pose, truth: Pose) -> Iterator[tuple[float, float]]:
    """Rotation (degrees) and translation (mm) error of each pair."""
    turn = se3.rotation_angle(pose.R.double() @ truth.R.mT)
    shift = (pose.t.double() - truth.t).norm(dim=-1)
    yield from zip((turn * 180 / np.pi).tolist(), (shift * 1e3).tolist(), strict=True)


def measure(batch: int, n: int, outliers: float, options: Any) -> list[dict[str, Any]]:
    """Rows of one size: eager and compiled against every peer."""
    draws = uniform_draws(torch.arange(batch), batch, HYPOTHESES)
    samples, tracks, camera, _ = scene(batch, n, outliers, seed=1)
    stage = partial(pnp_ransac, samples, tracks, camera, camera, draws)
    calls: dict[str, Callable[[], Any]] = {"eager": stage, "compiled": harness.with_compiled_operators()(stage)}
    pairs = arrays(samples, tracks)
    calls |= {name: partial(each, peer, pairs) for name, peer in PEERS.items()}
    durations = harness.in_turn([*calls.values()], repeats=options.repeats, clock=options.clock, warm_up=2)
    times = {name: [t / batch for t in side] for name, side in zip(calls, durations, strict=True)}
    wrong: dict[str, list[tuple[float, float]]] = {name: [] for name in ("eager", "compiled", *PEERS)}
    for seed in range(-(-96 // batch)):
        samples, tracks, camera, T = scene(batch, n, outliers, seed=100 + seed)
        solve = partial(pnp_ransac, samples, tracks, camera, camera, draws)
        wrong["eager"] += errors(solve().T_1_from_0, T)
        wrong["compiled"] += errors(harness.with_compiled_operators()(solve)().T_1_from_0, T)
        for name, peer in PEERS.items():
            wrong[name] += errors(each(peer, arrays(samples, tracks)), T)
    middle = {name: np.nanmedian(np.array(w), 0) for name, w in wrong.items()}
    title = f"pnp_n{n}_b{batch}" + (f"_o{outliers:.0%}".rstrip("%") if outliers != 0.3 else "")
    print(f"{title}: " + ", ".join(f"{k} {a:.4f}° {b:.3f} mm" for k, (a, b) in middle.items()))
    rows = []
    for mode in ("eager", "compiled"):
        for name in PEERS:
            more: dict[str, Any] = {"mode": mode, "n": n, "batch": batch, "bar": name == "opencv_ap3p"}
            more |= {"ours_error": middle[mode][0], "peer_error": middle[name][0]}
            rows.append(harness.row(title, times[mode], name, times[name], work=work(n), **more))
    return rows


def main() -> None:
    """Print the tables; write the rows with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    if not HAS_COLMAP:
        print("pycolmap: skipped, not installed (pip install pycolmap)")
    rows = []
    with torch.inference_mode():
        for threads in (1, 2):
            harness.set_threads(threads)
            sizes = [(1, 500, 0.3), (16, 500, 0.3)]
            if threads == 1 and not options.full:
                sizes += [(16, 500, 0.1), (16, 500, 0.5), (16, 100, 0.3), (16, 2000, 0.3)]
            if options.full:
                sizes = [(B, n, o) for B in (1, 16, 64) for n in (100, 500, 2000) for o in (0.3, 0.1, 0.5)]
            for size in sizes:
                rows += measure(*size, options)
    print(f"milliseconds per pair, medians of {options.repeats} ({options.clock} clock); errors in degrees of rotation")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
