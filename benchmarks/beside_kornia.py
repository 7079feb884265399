"""Our functions and kornia's on the calls of whole methods, and the table of docs/kornia.md.

    python benchmarks/beside_kornia.py --clock cpu --json benchmarks/results/kornia.json

The calls of a function in ``PAPER``, ``MAP`` and ``complete_depth`` on the built-in room are recorded with their
arguments; both implementations then answer the same calls in turn. Where kornia's function is the one in use, ours is
the formula that it replaced.
"""

import statistics
import sys
from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import version
from typing import Any, NamedTuple

import harness
import torch
from cells import read
from cells import table as markdown
from kornia import filters as kf
from kornia.feature import gftt_response
from kornia.geometry import epipolar as ke
from kornia.geometry.camera import project_points
from kornia.geometry.camera.projection_z1 import dx_project_points_z1
from kornia.geometry.liegroup import Se3
from kornia.geometry.transform import build_pyramid
from speed_tables import ratio
from torch import Tensor
from torch.utils import _pytree as pytree

from dhtorch import MAP, PAPER, complete_depth
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, filters, least_squares, pyramid, se3
from dhtorch.geometry.patches import luma
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime import storage
from dhtorch.stages import holes
from dhtorch.synthetic import SyntheticRoom

#: Limits the part of a call's time that kornia's function adds where its bits are the same and it is used, in per cent.
#: Source: chosen, as the spread of a call's time between runs (``spread_percent`` of the result).
MAX_ADDED_PERCENT = 0.5


#: Arguments and options of calls.
Calls = list[tuple[tuple[Any, ...], dict[str, Any]]]


class Peer(NamedTuple):
    """A function of dhtorch, and who else computes it."""

    ours: str  # dotted, below dhtorch
    kornia: str  # dotted, below kornia
    recorded: Callable[..., Any]  # the function whose calls are recorded
    mine: Callable[..., Any]
    theirs: Callable[..., Any]
    why: str
    used: str = "ours"


def _unproject(camera: Camera, uv: Tensor, depth: Tensor) -> Tensor:
    xy = (cam.undistort(camera, uv) - camera.c[:, None]) / camera.f[:, None]
    return torch.cat((xy * depth[..., None], depth[..., None]), -1)


def _hat(v: Tensor) -> Tensor:
    return torch.linalg.cross(v[..., None], torch.eye(3).to(v).expand(*v.shape[:-1], 3, 3), dim=-2)


def _triangulate(uv_0: Tensor, uv_1: Tensor, camera_0: Camera, camera_1: Camera, T: Pose) -> Tensor:
    K_0, K_1, matrix = cam.to_matrix(camera_0), cam.to_matrix(camera_1), se3.to_matrix(T)[:, :3]
    P_0 = torch.cat((K_0, torch.zeros_like(K_0[..., :1])), -1)
    return ke.triangulate_points(P_0, K_1 @ matrix, uv_0, uv_1, solver="cofactor")[..., 2]


def _moved(T: Pose, xi: Tensor) -> Tensor:
    return (Se3.exp(xi.roll(3, -1)) * T.to_kornia()).matrix()[:, :3]


def _pyramid(image: Tensor, levels: int, *_: Any, **__: Any) -> list[Tensor]:
    return [kf.spatial_gradient(level) for level in build_pyramid(filters.grayscale(image), levels)]


def _gftt(image: Tensor, uv: Tensor, **_: Any) -> Tensor:
    at = uv.round().long()
    return gftt_response(filters.grayscale(image))[:, 0][:, at[0, :, 1], at[0, :, 0]]


PEERS = (
    Peer(
        "geometry.camera.unproject",
        "geometry.camera.unproject_points",
        cam.unproject,
        _unproject,
        cam.unproject,
        "the same bits",
        "kornia",
    ),
    Peer("geometry.se3.hat", "geometry.liegroup.So3.hat", se3.hat, _hat, se3.hat, "the same bits", "kornia"),
    Peer(
        "geometry.filters.grayscale",
        "color.rgb_to_grayscale",
        filters.grayscale,
        lambda image: luma(image, 1),
        filters.grayscale,
        "the same bits",
        "kornia",
    ),
    Peer(
        "geometry.camera.project",
        "geometry.camera.project_points",
        cam.project,
        cam.project,
        lambda c, xyz: project_points(xyz, cam.to_matrix(c)),
        "multiplies by 1/z where ours divides: other bits",
    ),
    Peer(
        "geometry.epipolar.triangulate",
        "geometry.epipolar.triangulate_points",
        epipolar.triangulate,
        lambda *a: epipolar.triangulate(*a).depth,
        _triangulate,
        "both pixels are noisy there, here the reference view's is exact; no covariance",
    ),
    Peer(
        "geometry.epipolar.point_jacobians",
        "geometry.camera.dx_project_points_z1",
        epipolar.point_jacobians,
        lambda *a: epipolar.point_jacobians(*a)[0],
        lambda c, xyz: dx_project_points_z1(xyz) * c.f[:, None, :, None],
        "no guard at z = 0; the Jacobian of the pose, which shares its terms with ours, is not computed",
    ),
    Peer(
        "geometry.least_squares.move_pose",
        "geometry.liegroup.Se3.exp",
        least_squares.move_pose,
        lambda *a: se3.to_matrix(least_squares.move_pose(*a))[:, :3],
        _moved,
        "in every step of a refinement, where Cayley's map needs no sine",
    ),
    Peer(
        "geometry.pyramid.build_pyramid",
        "geometry.transform.build_pyramid",
        pyramid.build_pyramid,
        pyramid.build_pyramid,
        _pyramid,
        "levels at other places, no padding for windows, Sobel's gradients (`filters.spatial_gradient`), not Scharr's",
    ),
    Peer(
        "stages.holes.min_eigenvalue",
        "feature.gftt_response",
        holes.min_eigenvalue,
        holes.min_eigenvalue,
        _gftt,
        "the whole picture for some points, and another window",
    ),
)


@cache
def _frames() -> list[Frame]:
    """Views of the built-in room as a phone takes them; the sensor ends at 2 m."""
    room = SyntheticRoom(seed=2, n_frames=12, hw=(480, 640), depth_hw=(192, 256))
    frames = [room[k] for k in (3, 4, 5, 7, 9)]
    return [f.replace(image=f.image.contiguous(), depth=torch.where(f.depth > 2, 0.0, f.depth)) for f in frames]


#: Name → a call of a whole method.
METHODS: dict[str, Callable[[], Any]] = {
    "paper": lambda: PAPER(_frames()[0], _frames()[-1]),
    "map": lambda: MAP(_frames()[0], _frames()[-1]),
    "complete": lambda: complete_depth(_frames()[0], _frames()[1:]),
}


def recorded_calls(fn: Callable[..., Any], run: Callable[[], Any]) -> Calls:
    """Arguments of the calls of ``fn`` in a run."""
    calls: Calls = []

    def spy(*args: Any, **options: Any) -> Any:
        calls.append((args, options))
        return fn(*args, **options)

    modules = [m for name, m in sys.modules.items() if name.startswith("dhtorch")]
    places = [(m, name) for m in modules for name, value in vars(m).items() if value is fn]
    for module, name in places:
        setattr(module, name, spy)
    try:
        run()
    finally:
        for module, name in places:
            setattr(module, name, fn)
    normal: Calls = pytree.tree_map_only(Tensor, lambda x: x.clone() if x.is_inference() else x, calls)
    return normal


def replayed(fn: Callable[..., Any], calls: Calls) -> list[Any]:
    """The answers of ``fn`` to recorded calls."""
    return [fn(*args, **options) for args, options in calls]


def largest_difference(a: Any, b: Any) -> float | None:
    """Largest absolute difference of two tensors of one shape where both are finite; None for other answers."""
    if not isinstance(a, Tensor) or a.shape != b.shape:
        return None
    both = a.isfinite() & b.isfinite()
    return float((a - b)[both].abs().amax()) if both.any() else 0.0


def measured(peer: Peer, total_ms: dict[str, float], repeats: int, clock: str) -> dict[str, Any]:
    """A row: both sides on the calls of every method."""
    added: dict[str, float] = {}
    ours_ms = theirs_ms = 0.0
    differences: list[float | None] = []
    for name, run in METHODS.items():
        calls = recorded_calls(peer.recorded, run)
        added[name] = 0.0
        if calls:
            sides = [partial(replayed, fn, calls) for fn in (peer.mine, peer.theirs)]
            times = harness.in_turn(sides, repeats=repeats, least_ms=5, clock=clock)
            ours, theirs = (statistics.median(x) for x in times)
            ours_ms, theirs_ms = ours_ms + ours, theirs_ms + theirs
            added[name] = 100 * (theirs - ours) / total_ms[name]
            differences += [largest_difference(a, b) for a, b in zip(*(side() for side in sides), strict=True)]
    known = [x for x in differences if x is not None]
    largest = max(known) if len(known) == len(differences) else None
    more = {"kornia": peer.kornia, "used": peer.used, "why": peer.why, "added_percent": added, "largest": largest}
    return {"name": peer.ours, "ratio": ours_ms / theirs_ms, **more}


def run(repeats: int, clock: str) -> list[dict[str, Any]]:
    """A row for every pair of functions."""
    with torch.no_grad():
        whole = {name: harness.in_turn([call], repeats=5, warm_up=1, clock=clock)[0] for name, call in METHODS.items()}
        total_ms = {name: statistics.median(times) for name, times in whole.items()}
        rows = [measured(peer, total_ms, repeats, clock) for peer in PEERS]
    spread = {name: 100 * harness.iqr(times) / total_ms[name] for name, times in whole.items()}
    versions = {name: version(name) for name in ("torch", "kornia")}
    where = {"threads": torch.get_num_threads(), "clock": clock, "versions": versions, **harness.place()}
    return [{**row, "total_ms": total_ms, "spread_percent": spread, **where} for row in rows]


def table() -> str:
    """The rows of the result file, those that are kornia's first."""
    rows = read("kornia")
    shown = []
    for r in sorted(rows, key=lambda r: r["used"] != "kornia"):
        cells = [f"`{r['name']}`", f"`{r['kornia']}`", r["used"], ratio(r["ratio"])]
        cells += [f"{round(r['added_percent'][name], 2) + 0:+.2f} %" for name in METHODS]
        shown.append([*cells, "–" if r["largest"] is None else f"{r['largest']:.1g}", r["why"]])
    head = ["ours", "kornia's", "used", "ratio", *(f"adds to `{name}`" for name in METHODS), "largest", "why"]
    first = rows[0]
    versions = ", ".join(f"{name} {value}" for name, value in first["versions"].items())
    times = ", ".join(
        f"`{name}` {first['total_ms'][name]:.0f} ms ± {first['spread_percent'][name]:.1f} %" for name in METHODS
    )
    where = f"Measured on: {first['processor']}; {first['threads']} thread; {versions}. Whole calls: {times}."
    return f"{markdown(head, shown, n_label=3)}\n\n{where}"


def main() -> None:
    """Print the table, and write the result file with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    harness.set_threads(1)
    rows = run(options.repeats, options.clock)
    for r in rows:
        added = " ".join(f"{name} {value:+.3f} %" for name, value in r["added_percent"].items())
        print(f"{r['name']:36} {r['kornia']:40} {r['ratio']:7.3f} {added}  {r['largest']}")
    if options.json is not None:
        storage.write_json(options.json, rows)


#: Tables of docs/kornia.md.
TABLES = {"kornia functions": table}

if __name__ == "__main__":
    main()
