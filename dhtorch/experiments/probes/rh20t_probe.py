"""Question: do depth features tell a ridge probe as much of a robot's next motion as DINOv2's do?

Samples are frames of the camera on the hand. The target is where the hand will be ``horizon`` later, in its own axes
now: translation and rotation vector. The context, shared by all arms, is what the robot knows without a picture: pose,
joints, gripper, and its motion over the last ``history``. Beside it an arm is given one or two blocks of features: the
downsampled picture, depth tokens with the frame ``history`` ago as second view, those of the front end alone, DINOv2's
class token and mean patch token, or depth tokens and DINOv2. Whole tasks are held out: every task is judged on once, by
probes whose penalty other tasks chose.

Expectation (written before the run): equivalent; the error with depth features is DINOv2's within 2 %, over all samples
and over those that move (the paper: ratios 1.006 and 1.013 without a test, DINOv2-L, 799 tasks).
What would refute it: the 90 % interval of a ratio, from resampling tasks, lies wholly beyond 2 %. Undecided where it
holds 2 % as well, and with random weights, which say nothing about DINOv2.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data.readers import rh20t
from dhtorch.data.recording import Recording
from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments.baselines import dinov2 as visual_branch
from dhtorch.experiments.probes import front_ends, probing
from dhtorch.experiments.probes import ridge as probe
from dhtorch.experiments.probes.probing import (
    ALL_COHORT,
    CONTEXT_BLOCK,
    MOVING_COHORT,
    PROBE_ARMS,
    PROBE_PENALTIES,
    PROBE_TRUTH,
    REFERENCE_BLOCK,
    XFEAT_BLOCK,
    ProbeErrors,
    ProbeShard,
    ProbeShards,
)
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row

QUESTION = "Do depth features tell a ridge probe as much of a robot's next motion as DINOv2's do?"
EXPECTATION = "Yes: its error is that of DINOv2 within 2 %, over all samples and over those that move."

#: Angles of the context; an arm with fewer joints leaves the rest 0.
_N_JOINTS = 7

#: Decimals of the context: micrometres and microradians, less than a robot knows of itself.
_CONTEXT_DECIMALS = 6

_OURS = "dhtorch"


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    horizon: float = 0.4,
    history: float = 0.3,
    stride: int = 1,
    moving: float = 0.01,
    margin: float = 0.02,
    n_folds: int = 5,
    penalties: Sequence[float] = PROBE_PENALTIES,
    depth_cells: int = 4,
    dinov2_cells: int = 1,
    rgb_side: int = 16,
    dinov2: Callable[..., torch.nn.Module] | None = visual_branch.load_dinov2,
    xfeat: bool = False,
    progress: Progress = no_progress,
) -> Outcome:
    """Compute the features of every scene once, fit the probes on tasks, judge them on others.

    Args:
        scenes: of RH20T, one camera each.
        methods: name → method; the first fills the depth tokens.
        pairs: not used: the second view is the frame ``history`` ago.
        settings: of the job; nothing is hidden from the method.
        horizon: s, how far ahead the hand is to be predicted.
        history: s, length of the motion that is known, and age of the second view.
        stride: every how many frames there is a sample.
        moving: m; a sample moves where the hand will have gone farther.
        margin: half the width of what counts as equivalent, as a share.
        n_folds: parts the tasks are dealt into.
        penalties: of a block of features, to choose from.
        depth_cells, dinov2_cells: cells a side that tokens are averaged over.
        rgb_side: side of the downsampled picture, px.
        dinov2: makes the network; None = leave it out.
        xfeat: XFeat's dense features as well, a network whose own weights its package brings.
        progress: wraps the loop over a scene's samples.

    Returns:
        Outcome with one row per task and arm; see :func:`probing.record`.

    Raises:
        ImportError: ``transformers`` or XFeat's package is missing; the message says what to install.
        ValueError: no RH20T scene, no sample, or fewer than three tasks.

    Source: paper, section 6.7, "Downstream behaviour as a visual front-end".
    """
    networks, real = front_ends.load_network_front_ends(
        dinov2, cells=dinov2_cells, xfeat_too=xfeat, device=settings.device
    )
    method = next(iter(methods.values()))
    outcome = Outcome()
    with ProbeShards() as shards:
        for scene in scenes_of(scenes):
            recording = scene.recording
            index, before, context, target = select_robot_samples(
                recording, horizon=horizon, history=history, stride=stride
            )
            if not len(index):
                outcome.rows.append(_skip_reason(recording))
                continue
            options: dict[str, Any] = {"cells": depth_cells, "seed": settings.seed}
            two, one = (front_ends.depth_tokens_for_scene(method, scene, views=v, **options) for v in (2, 1))
            look = partial(_frame_features, recording, settings, two=two, one=one, networks=networks, rgb_side=rgb_side)
            looked = progress(list(zip(index, before, strict=True)), recording.name, len(index))
            rows = [look(i, j) for i, j in looked]
            blocks = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
            far = target[:, :3].norm(dim=-1) > moving
            shards.add(ProbeShard(task_name(recording), {CONTEXT_BLOCK: context, **blocks}, target, far))
        if not shards.n:
            raise ValueError(f"rh20t_probe: found no sample, expected scenes longer than {history + horizon} s")
        arms = {k: blocks for k, blocks in PROBE_ARMS.items() if set(blocks) <= set(shards.widths)}
        judged = probing.evaluate_probes(shards, arms, n_folds=n_folds, penalties=penalties, seed=settings.seed)
        outcome.n_pairs = shards.n
    probing.record_probes(outcome, judged)
    outcome.summary = probing.summarise_probes(judged)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(judged, real, margin))


def select_robot_samples(
    recording: Recording, *, horizon: float, history: float, stride: int
) -> tuple[list[int], list[int], Tensor, Tensor]:
    """The samples of one scene.

    Args:
        recording: of an RH20T scene.
        horizon, history: s.
        stride: frames.

    Returns:
        Numbers of the frames and of the frames about ``history`` before them; context (n, 23): tool centre in the base
        frame, first two columns of its rotation, joints, width of the gripper, last motion in the hand's axes; target
        (n, 6): translation (m) and rotation vector (rad) to the tool centre ``horizon`` later, in the hand's axes.

    Raises:
        ValueError: no RH20T scene. One without the hand's poses has no sample.
    """
    if recording.format != "rh20t" or recording.root is None or recording.times is None:
        expected = "an RH20T scene (data=rh20t_set data.root=PATH, or data=rh20t_synthetic)"
        raise ValueError(f"rh20t_probe: {recording.name} is {recording.format}, expected {expected}")
    streams = rh20t.read_robot_streams(recording.root)
    if "tcp_base" not in streams:
        return [], [], torch.zeros(0, 16 + _N_JOINTS), torch.zeros(0, 6)
    times, tcp = recording.times.numpy(), streams["tcp_base"]
    (now, a), (then, b), (past, c) = (tcp.at(times + shift) for shift in (0.0, horizon, -history))
    before = np.abs(times[:, None] - history - times[None]).argmin(1)
    use = a & b & c & (before < np.arange(len(times)))
    index = np.flatnonzero(use)[::stride]
    T, ahead, behind = (_pose_matrices(x[index], recording.root) for x in (now, then, past))
    hand = np.linalg.inv(T)
    target, last = (_motion_vectors(hand @ other) for other in (ahead, behind))
    angles = np.zeros((len(index), _N_JOINTS))
    if "joint" in streams:
        found = streams["joint"].at(times[index])[0][:, :_N_JOINTS]
        angles[:, : found.shape[1]] = found
    grip = next(
        (streams[k].at(times[index])[0][:, :1] for k in ("gripper_info", "gripper_command") if k in streams), None
    )
    width = np.zeros((len(index), 1)) if grip is None else grip
    turned = T[:, :3, :2].transpose(0, 2, 1).reshape(-1, 6)
    known = np.concatenate((T[:, :3, 3], turned, angles, width), 1)
    context = torch.cat((torch.from_numpy(known), last), 1)
    # A number that varies by rounding alone, as an angle that a task never uses, would be standardised into a signal.
    return index.tolist(), before[index].tolist(), context.round(decimals=_CONTEXT_DECIMALS), target


def verdict(judged: ProbeErrors, real: bool, margin: float) -> tuple[bool | None, str]:
    """Equivalent over all samples and over those that move? Never decided without DINOv2's own weights."""
    n = len(judged.groups)
    own = judged.mean(_OURS, ALL_COHORT).value or 0.0
    times = judged.ratio(_OURS, CONTEXT_BLOCK, ALL_COHORT)
    ratio = _format_interval(times)
    text = f"error {own:.3f} of the targets' variance, {ratio} times that of the context alone ({n} tasks)"
    if (XFEAT_BLOCK, ALL_COHORT) in judged.squares:
        beside = {c: judged.ratio(_OURS, XFEAT_BLOCK, c) for c in (ALL_COHORT, MOVING_COHORT)}
        text += probing.compare_with_xfeat({c: (r.value, r.low, r.high) for c, r in beside.items()})
    if (REFERENCE_BLOCK, ALL_COHORT) not in judged.squares:
        return None, f"DINOv2 was left out; with depth features: {text}"
    found = {
        c: judged.ratio(_OURS, REFERENCE_BLOCK, c, level=probe.EQUIVALENCE_LEVEL) for c in (ALL_COHORT, MOVING_COHORT)
    }
    ratios = ", ".join(f"{c} {_format_interval(r)}" for c, r in found.items())
    published = "paper: 1.006, 1.013"
    if not real:
        said = f"{probing.RANDOM_WEIGHTS_NOTE}; ratio to the random network, 90 % intervals: {ratios} ({published})"
        return None, f"{said}. With depth features: {text}"
    answers = [probe.is_equivalent(r, margin) for r in found.values()]
    holds = False if False in answers else True if all(answers) else None
    return holds, f"ratio to DINOv2, 90 % intervals, margin {margin:.0%}: {ratios}; {published}. {text}"


def task_name(recording: Recording) -> str:
    """The task that a scene shows, by the name of its folder."""
    named = re.search(r"task_\d+", recording.name)
    return named[0] if named else str(recording.name)


def _skip_reason(recording: Recording) -> Row:
    note = "no sample: no pose of the hand over so long a time"
    return {
        "scene": recording.name,
        "pair": None,
        "method": CONTEXT_BLOCK,
        "truth": PROBE_TRUTH,
        "role": None,
        "note": note,
    }


def _frame_features(
    recording: Recording,
    settings: Settings,
    i: int,
    j: int,
    *,
    two: front_ends.DepthTokens,
    one: front_ends.DepthTokens,
    networks: Mapping[str, front_ends.FrontEnd],
    rgb_side: int,
) -> dict[str, Tensor]:
    """Features of frame ``i`` with frame ``j`` as its second view."""
    frame, other = (recording[k].to(settings.dtype).to(settings.device) for k in (i, j))
    with torch.no_grad():
        found = {
            "rgb": front_ends.resize_to_square(frame, side=rgb_side),
            "depth": two(frame, other),
            "depth_one_view": one(frame),
            **{name: network(frame) for name, network in networks.items()},
        }
    return {name: x.cpu() for name, x in found.items()}


def _first_stream(
    streams: Mapping[str, rh20t.RobotStream], names: Sequence[str], times: np.ndarray, size: int
) -> np.ndarray:
    """The first ``size`` numbers (n, size) of the first of these streams that there is, filled up with zeros."""
    whole = np.zeros((len(times), size))
    for name in names:
        if name in streams:
            found = streams[name].at(times)[0][:, :size]
            whole[:, : found.shape[1]] = found
            break
    return whole


def _pose_matrices(tcp: np.ndarray, file: Path) -> np.ndarray:
    return convert.to_c2w(tcp[:, [4, 5, 6, 3]], tcp[:, :3], file, "tcp")


def _motion_vectors(T: np.ndarray) -> Tensor:
    """(n, 6) translation and rotation vector of (n, 4, 4)."""
    R = torch.from_numpy(np.ascontiguousarray(T[:, :3, :3]))
    turn = rotation_matrix_to_axis_angle(R) if len(R) else R.new_zeros(0, 3)
    return torch.cat((torch.from_numpy(T[:, :3, 3]), turn), 1)


def _format_interval(found: Any) -> str:
    if found.value is None:
        return "–"
    return f"{found.value:.3f}" + ("" if found.low is None else f" ({found.low:.3f} to {found.high:.3f})")
