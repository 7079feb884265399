"""Question: does a reference view tell whether its camera was moved, and by how much?

Expectation (written before the run on the test seeds): a shift of 2 px at the scene's median depth is found in 95 % of
the pictures, at 1 % false alarms on unmoved pairs at other lights; half occluded, the offset is right to 2 mm and 0.1
degrees (median), within one stated sigma in 61 to 75 % and within two in 92 % at least.
What would refute it: any of these numbers missed.
"""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from random import Random
from statistics import median
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import PinReason, PinVerdict, name
from dhtorch.data import open_all, scenes_root
from dhtorch.data.recording import Recording
from dhtorch.data.scene import SceneLike
from dhtorch.experiments.outcome import Bars, MainMetric, Row, judge_bars
from dhtorch.experiments.protocol import Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.measure import CameraPin
from dhtorch.metrics import bootstrap
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import MAP
from dhtorch.pytree import collate
from dhtorch.records import Camera, Frame, Pose
from dhtorch.synthetic.fixed_camera import ROOM_LIGHTS, LitRoom, hide_behind_arms, photograph_again
from dhtorch.synthetic.paths import hand_held_path, rotation_from_angles

#: Planted shifts of the median point of the scene, px, in scenes of even and of odd seeds.
SHIFTS_PX = ((0.5, 2.0, 20.0), (1.0, 2.0, 5.0, 60.0))

#: Planted turns about a random axis, degrees, likewise.
TURNS_DEG = ((0.1, 1.0, 5.0), (0.5, 2.0))

#: Planted motions along the axis, m, and changes of the focal length, a fraction, likewise.
AHEAD_M = ((0.005, 0.02, -0.05), (0.01, 0.05, 0.1))
FOCAL_CHANGES = ((-0.02, 0.01, 0.04), (-0.04, -0.01, 0.02))

#: Frames of the walk through a room, at one of which the camera is fixed.
_WALK_FRAMES = 60

#: Views of near things by a robot's in-hand camera, by the seed of their room: x, y, z, m, in the room's axes; yaw,
#: pitch and roll, degrees.
_HAND_VIEWS = {
    40: (-0.6451562338272959, -0.6330819928967936, 0.9900038014875783, 0.5743682646317088, -1.886077491937736, 0.0),
    41: (0.28339298116278344, -0.7240929029209617, 2.6755582776203513, 10.959030472411982, -34.40247730169597, 0.0),
    50: (0.17631704239040302, -1.0425272866973005, 1.487560624160218, -6.738759430204524, -11.497159360827037, 0.0),
    51: (-1.0944453425761174, -1.0976297617754658, 1.4519560340299307, -3.303042414038269, -9.995246291159521, -0.0),
}

#: Shares of the picture that arms hide in the reference and in a live picture.
_REFERENCE_SHARE, _LIVE_SHARES = 0.15, (0.0, 0.5, 0.6)

#: Runs of each timing; the least counts.
_TIMED_RUNS = 5

#: Real sets of fixed cameras, and the shift above which their camera counts as moved, px.
_REAL_SETS = (("gr00t_demo", 2.0), ("lerobot_g1", 8.0))

#: Frames of a real episode that are compared, and the field of view assumed for them, degrees.
_REAL_FRAMES, _REAL_FOV_DEG = 8, 60.0


#: Number → (least, largest) value of its bar.
PIN_BARS: Bars = {
    "pin.found_2px": (0.95, 1.0),
    "pin.false_alarms": (0.0, 0.01),
    "pin.zoom_moved": (0.0, 0.01),
    "pin.error_mm_half": (0.0, 2.0),
    "pin.error_deg_half": (0.0, 0.1),
    "pin.within_1sigma_half": (0.61, 0.75),
    "pin.within_2sigma_half": (0.92, 1.0),
    "pin.time_ratio": (0.0, 1.5),
    "pin.gr00t_demo_moved": (0.0, 0.0),
    "pin.lerobot_g1_moved": (0.0, 0.0),
}


#: One rendered image of a fixed camera: its row (kind: "shift" in px, "turn" in degrees, "ahead" in m, "zoom" as a
#: fraction, or "still"; size; light), ``T_ref_from_live``, and the frame.
PlantedMove = tuple[Row, Pose, Frame]


def _render_scene(kind: str, seed: int, hw: tuple[int, int], *, supersample: int = 2) -> list[PlantedMove]:
    """Images of a camera in the room of a seed, the reference first: views of the ``room``, or at a ``robot``."""
    draw = Random(f"pin {kind} {seed}")
    if kind == "robot":
        if seed not in _HAND_VIEWS:
            raise ValueError(f"experiment.robots: found {seed}, expected of {', '.join(map(str, _HAND_VIEWS))}")
        x, y, z, *angles = _HAND_VIEWS[seed]
        R = torch.tensor([rotation_from_angles(*angles)], dtype=torch.float64)
        here = Pose(R, torch.tensor([[x, y, z]], dtype=torch.float64))
    else:
        here = hand_held_path("walk", _WALK_FRAMES, step_m=0.02, rate_hz=30.0, seed=seed)[draw.randrange(_WALK_FRAMES)]
        here = here.map(lambda x: x[None])
    options: dict[str, Any] = {"seed": seed, "hw": hw, "supersample": supersample}
    still = LitRoom(n_frames=1, true_poses=here, **options)
    depth = still.truth(0)["depth"]
    sizes = {"shift": SHIFTS_PX, "turn": TURNS_DEG, "ahead": AHEAD_M}
    wanted = [(name, size) for name, of in sizes.items() for size in of[seed % 2]]
    moves = [(name, size, _draw_move(name, size, depth, still.camera, draw)) for name, size in wanted]
    moves = [("still", 0.0, se3.identity(1, here.t)), *moves]
    images: list[PlantedMove] = []
    for k, light in enumerate(ROOM_LIGHTS):
        mine = [moves[0], *moves[1 + k :: len(ROOM_LIGHTS)]]
        poses = collate(se3.compose(here, T) for _, _, T in mine)
        room = LitRoom(light=light, n_frames=len(mine), true_poses=poses, **options)
        images += [({"kind": name, "size": size, "light": light}, T, room[i]) for i, (name, size, T) in enumerate(mine)]
        lens = LitRoom(light=light, n_frames=1, true_poses=here, **options)
        lens.camera = lens.camera.replace(f=lens.camera.f * (1 + (zoom := FOCAL_CHANGES[seed % 2][k])))
        images.append(({"kind": "zoom", "size": zoom, "light": light}, moves[0][2], lens[0]))
    return images


def _draw_move(kind: str, size: float, depth: Tensor, camera: Camera, draw: Random) -> Pose:
    """A motion ``T_ref_from_live`` (1), float64: random, of ``size`` px at the median point of the scene or degrees, or
    along the axis, m."""
    turn, shift = (torch.tensor([draw.gauss(0, 1) for _ in range(3)], dtype=torch.float64) for _ in range(2))
    turn, shift = turn / turn.norm(), shift / shift.norm()
    if kind == "ahead":
        return Pose(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, size]], dtype=torch.float64))
    if kind == "turn":
        return se3.exp(torch.cat((turn * math.radians(size), 0 * shift))[None])
    part, scale = draw.uniform(0.2, 0.8), size
    xi = torch.cat((part * turn, (1 - part) * float(depth.median()) * shift))[None] / float(camera.f.mean())
    for _ in range(6):
        scale *= size / max(_median_flow(se3.exp(scale * xi), depth, camera), 1e-9)
    return se3.exp(scale * xi)


def _median_flow(T_ref_from_live: Pose, depth: Tensor, camera: Camera) -> float:
    """Median motion, px, of the points of a depth map (1, H, W) of the reference in the live picture."""
    H, W = depth.shape[-2:]
    v, u = torch.meshgrid(torch.arange(0, H, 8), torch.arange(0, W, 8), indexing="ij")
    uv = torch.stack((u, v), -1).reshape(1, -1, 2).double()
    camera = camera.map(lambda x: x.double())
    xyz = cam.unproject(camera, uv, depth[:, v, u].reshape(1, -1).double())
    moved = cam.project(camera, se3.apply(se3.invert(T_ref_from_live), xyz))
    return float((moved - uv).norm(dim=-1).median())


def _live_images(scene: str, images: Sequence[PlantedMove], draws: int) -> Iterator[PlantedMove]:
    """Every rendered image, taken again ``draws`` times with other exposure, noise and arms; the row states the hidden
    fraction."""
    for row, T, rendered in images:
        for k in range(draws * (3 if row["kind"] == "still" else 1)):
            draw = Random(f"{scene} {row['kind']} {row['size']} {row['light']} {k}")
            hidden = _LIVE_SHARES[k % len(_LIVE_SHARES)]
            frame, _ = hide_behind_arms(rendered, hidden, arm_seed=k % 2, draw=draw)
            yield row | {"hidden": hidden}, T, photograph_again(frame, draw)


def run(
    _scenes: Sequence[SceneLike],
    _chosen: Mapping[str, Method],
    _pairs: ScenePairs,
    settings: Settings,
    *,
    rooms: Sequence[int],
    robots: Sequence[int],
    draws: int = 4,
    hw: Sequence[int] = (480, 640),
    real: bool = True,
    root: str | None = None,
    progress: Progress = no_progress,
) -> Outcome:
    """Verdicts and offsets of planted moves, of cameras that stand still, and of real fixed cameras.

    Args:
        rooms, robots: seeds of the scenes, each at its own place; thresholds were chosen on others.
        draws: live pictures of each rendered one, with other exposure, response, noise and arms; three times as many of
            a camera that stands still.
        hw: size of the pictures.
        real: also compare the episodes of ``gr00t_demo`` and ``lerobot_g1``.
        root: folder of the shared data; None = the environment variable ``DHTORCH_DATA``.

    Rows: one per live picture, one per real episode. In the summary, fractions are means over scenes with intervals
    over scenes; ``half`` are pictures half hidden by arms; errors and coverage of sigma are over pictures of moved
    cameras, the coverage of the six components of the offset.
    """
    outcome = Outcome(
        metrics=(
            MainMetric("found_2px", larger_is_better=True),
            MainMetric("false_alarms", larger_is_better=False),
            MainMetric("unknown", larger_is_better=False),
            MainMetric("error_mm_half", larger_is_better=False),
            MainMetric("error_deg_half", larger_is_better=False),
        )
    )
    times: list[dict[str, float]] = []
    places = [*(("room", seed) for seed in rooms), *(("robot", seed) for seed in robots)]
    for kind, seed in progress(places, "scenes", len(places)):
        scene, images = f"{kind}_{seed}", _render_scene(kind, seed, (hw[0], hw[1]))
        # the reference with arms over a part of it, as a robot stands in its camera's view
        draw = Random(f"{scene} reference")
        reference, _ = hide_behind_arms(images[0][2], _REFERENCE_SHARE, arm_seed=0, draw=draw)
        pin = CameraPin(reference, seed=settings.seed)
        outcome.rows += [_image_row(scene, pin, *image) for image in _live_images(scene, images, draws)]
        times.append(_time_ratio(scene, images, pin))
        outcome.n_pairs = len(outcome.rows)
    if real:
        outcome.rows += _real_rows(scenes_root(root))
    outcome.summary = _summarise_pin(outcome.rows, times)
    return outcome.decide(
        "Does a reference view tell whether its camera was moved, and by how much?",
        "Every number of the list of bars is met; scenes are the unit of fractions.",
        *judge_bars(outcome.summary, PIN_BARS),
    )


def _image_row(scene: str, pin: CameraPin, planted: Row, T_ref_from_live: Pose, frame: Frame) -> Row:
    """One live image -> row with the verdict and, where there is one, the error of the offset."""
    result = pin.check(frame.image)
    row: Row = {"scene": scene, "pair": [0, 0], "method": "pin", "truth": None, **planted}
    row["verdict"] = name(PinVerdict, int(result.verdict)).lower()
    row["reason"] = name(PinReason, int(result.reason)).lower()
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        return row
    error = se3.log(se3.compose(result.T_ref_from_live, se3.invert(T_ref_from_live)))[0]
    return row | {
        "shift_px": float(result.shift_px),
        "sigma_px": float(result.shift_sigma_px),
        "error_mm": 1e3 * float((result.T_ref_from_live.t - T_ref_from_live.t).norm()),
        "error_deg": math.degrees(float(error[:3].norm())),
        "sigmas": (error / result.cov[0].diagonal().sqrt()).tolist(),
    }


def _time_ratio(scene: str, images: Sequence[PlantedMove], pin: CameraPin) -> dict[str, float]:
    """Time of one image over that of one pair of the method ``map``, the least of alternating runs: plain and half
    hidden."""
    moved = next(frame for row, _, frame in images if row["kind"] == "shift")
    hidden, _ = hide_behind_arms(moved, 0.5, arm_seed=1, draw=Random(f"{scene} time"))
    calls: dict[str, Any] = {
        "time_ratio": partial(pin.check, moved.image),
        "time_ratio_half": partial(pin.check, hidden.image),
        "map": partial(MAP, images[0][2], moved),
    }
    best = dict.fromkeys(calls, math.inf)
    for _ in range(_TIMED_RUNS):
        for key, call in calls.items():
            start = time.perf_counter()
            call()
            best[key] = min(best[key], time.perf_counter() - start)
    return {key: seconds / best["map"] for key, seconds in best.items() if key != "map"}


def _real_rows(root: Path) -> list[Row]:
    """Episodes of real fixed cameras: a row each, against the set's first episode and against its own first frames."""
    rows: list[Row] = []
    for data, _ in _REAL_SETS:
        recordings = open_all(root / data, fov=_REAL_FOV_DEG)
        first = CameraPin(_spread_frames(recordings[0], _REAL_FRAMES))
        for recording in recordings:
            frames = _spread_frames(recording, _REAL_FRAMES)
            own = CameraPin(frames[:1])
            for against, pin in (("first_episode", first), ("own_start", own)):
                results = collate(pin.check(frame.image) for frame in frames)
                known = results.verdict != PinVerdict.CANNOT_KNOW
                low = float(results.shift_low_px.nanmedian())
                turned = known & (results.T_ref_from_live.t.norm(dim=-1) == 0)
                row: Row = {"scene": data, "pair": [0, len(recording) - 1], "method": against, "truth": None}
                row |= {"note": f"episode {recording.episode}", "known": int(known.sum())}
                row |= {"moved": int(results.moved.sum()), "low_px": None if math.isnan(low) else low}
                rows.append(row | {"turned": int(turned.sum())})
    return rows


def _spread_frames(recording: Recording, n: int) -> list[Frame]:
    return [recording[k * len(recording) // n] for k in range(n)]


def _summarise_pin(rows: Sequence[Row], times: Sequence[Mapping[str, float]]) -> Row:
    """Rows -> summary: key -> value, with its interval over scenes where it is a fraction of pictures."""
    planted = [row for row in rows if row["method"] == "pin"]
    scenes = sorted({row["scene"] for row in planted})
    summary: Row = {}

    def add_share(key: str, chosen: Sequence[Row], verdict: str) -> None:
        parts = [[row["verdict"] == verdict for row in chosen if row["scene"] == scene] for scene in scenes]
        shares = [sum(part) / len(part) for part in parts if part]
        if shares:
            summary[f"pin.{key}"] = bootstrap.interval_over_scenes(shares, statistic="mean").entry("1")

    add_share("false_alarms", [row for row in planted if row["kind"] == "still"], "moved")
    add_share("unknown", [row for row in planted if row["kind"] != "zoom"], "cannot_know")
    add_share("zoom_moved", [row for row in planted if row["kind"] == "zoom"], "moved")
    for kind, unit in (("shift", "px"), ("turn", "deg"), ("ahead", "m")):
        for size in sorted({row["size"] for row in planted if row["kind"] == kind}):
            chosen = [row for row in planted if (row["kind"], row["size"]) == (kind, size)]
            add_share(f"found_{size:g}{unit}", chosen, "moved")
    moved = [row for row in planted if row["kind"] in ("shift", "turn", "ahead") and "sigmas" in row]
    for suffix, chosen in (("half", [row for row in moved if row["hidden"] == 0.5]), ("all", moved)):
        if chosen:
            sigmas = torch.tensor([row["sigmas"] for row in chosen]).abs()
            values = {f"{key}_{suffix}": median(row[key] for row in chosen) for key in ("error_mm", "error_deg")}
            values |= {f"within_{k}sigma_{suffix}": float((sigmas < k).double().mean()) for k in (1, 2)}
            summary |= {f"pin.{key}": bootstrap.without_interval(x, len(chosen)) for key, x in values.items()}
    for key in times[0] if times else ():
        summary[f"pin.{key}"] = bootstrap.without_interval(median(each[key] for each in times), len(times))
    for data, limit in _REAL_SETS:
        episodes = [row for row in rows if row["scene"] == data]
        if episodes:
            counts = {f"{data}_moved": sum((row["low_px"] or 0.0) > limit for row in episodes)}
            known = sum(row["known"] for row in episodes)
            counts |= {f"{data}_turned": sum(row["turned"] for row in episodes) / max(known, 1)}
            summary |= {f"pin.{key}": bootstrap.without_interval(float(x), len(episodes)) for key, x in counts.items()}
    return summary
