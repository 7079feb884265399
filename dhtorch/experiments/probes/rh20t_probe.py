"""Question: do depth features predict a robot's next motion as well as DINOv2's in a ridge probe?

Samples are frames of the wrist camera. The target is the pose of the hand after ``horizon``, in its present axes:
translation and rotation vector. The context, shared by all arms, is the robot's state, which needs no image: pose,
joints, gripper, and the motion over the last ``history``. An arm adds one or two blocks of features: the downsampled
image, depth tokens with the frame ``history`` ago as second view, depth tokens of the single-view front end, DINOv2's
class token and mean patch token, or depth tokens and DINOv2. Whole tasks are held out: every task is evaluated once, by
probes whose penalty was chosen on other tasks. Where a set has true depth, as the synthetic one, ``true_depth`` is a
control: the tokens of the true depth at every pixel, computed, pooled and evaluated as the method's.

Expectation (written before the run): equivalent; the error with depth features is DINOv2's within 2 %, over all samples
and over those that move (the paper: ratios 1.006 and 1.013 without a test, DINOv2-L, 799 tasks).
What would refute it: the 90 % interval of a ratio, from resampling tasks, lies wholly beyond 2 %, on either side.
Undecided where it holds 2 % as well, where a control fails (:mod:`dhtorch.experiments.probes.probing`), and with random
weights, which say nothing about DINOv2.

A task is a task number of RH20T, ``task_NNNN`` in the name of a scene's folder, whatever robot, user and scene. The
paper does not define its 799 tasks. They are not task numbers: a public conversion of 82,894 episodes
(``InternRobotics/RoboInter-Data``) lists 146. If they are finer units, such as a task number by robot configuration or
user, the paper's training and test sets share task numbers and objects, and its hold-out is weaker than the one here.
Intervals here come from resampling tasks: about 146 units of RH20T, not 799.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data.readers import rh20t
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.baselines import dinov2 as visual_branch
from dhtorch.experiments.loading import LoadedChunk
from dhtorch.experiments.probes import front_ends, probing
from dhtorch.experiments.probes import ridge as probe
from dhtorch.experiments.probes.probing import (
    ALL_COHORT,
    CONTEXT_BLOCK,
    DEPTH_CONTROL,
    MOVING_COHORT,
    NEGATIVE_CONTROL,
    POSITIVE_CONTROL,
    PROBE_ARMS,
    PROBE_METRICS,
    PROBE_PENALTIES,
    PROBE_TRUTH,
    REFERENCE_BLOCK,
    XFEAT_BLOCK,
    ProbeErrors,
    ProbeShard,
    ProbeShards,
)
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress

#: Joint angles in the context; zeros fill up for a robot with fewer joints.
_N_JOINTS = 7

#: Decimals of context and target: micrometres and microradians, below the accuracy of a robot's encoders.
_DECIMALS = 6

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
    efficientnet: bool = False,
    features: str | None = None,
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: features of every scene, cross-validated ridge probes over tasks, verdict.

    Args:
        scenes: of RH20T, one camera each.
        methods: name → method; the first fills the depth tokens.
        pairs: not used: the second view is the frame ``history`` ago.
        settings: of the job; the method sees all returns. ``workers`` processes read the frames; features are computed
            in this one, on ``device``, ``batch`` pictures at once.
        horizon: s, how far ahead the pose of the hand is predicted.
        history: s, length of the past motion in the context, and age of the second view.
        stride: frames from one sample to the next.
        moving: m; a sample moves if the hand's translation is larger.
        margin: half the width of the equivalence interval around a ratio of 1.
        n_folds: parts into which the tasks are split.
        penalties: candidates of the ridge penalty of a block.
        depth_cells, dinov2_cells: cells per side over which tokens are averaged.
        rgb_side: side of the downsampled image, px.
        dinov2: builds the network; None = leave it out.
        xfeat, efficientnet: also run XFeat's dense features, EfficientNet-Lite0's; their packages contain the trained
            weights.
        features: folder that keeps the features, so that an interrupted run resumes; None = a temporary one.
        progress: wraps the loop over a scene's samples.

    Returns:
        Outcome with one row per task and arm; see :func:`probing.record_probes`.

    Raises:
        ImportError: ``transformers`` or XFeat's package is missing; the message says what to install.
        ValueError: no RH20T scene, no sample, or fewer than three tasks.

    Source: paper, section 6.7, "Downstream behaviour as a visual front-end".
    """
    networks, origin = front_ends.load_network_front_ends(
        dinov2, cells=dinov2_cells, xfeat_too=xfeat, efficientnet_too=efficientnet, device=settings.device
    )
    select = partial(select_robot_samples, horizon=horizon, history=history, stride=stride)
    chosen = [(scene, select(scene.recording)) for scene in scenes_of(scenes)]
    tasks = [task_name(scene.recording) for scene, (index, *_) in chosen if index]
    if not tasks:
        raise ValueError(f"rh20t_probe: found no sample, expected scenes longer than {history + horizon} s")
    probe.make_folds(tasks, n_folds, seed=settings.seed)  # too few tasks are refused before the features are computed
    method = next(iter(methods.values()))
    outcome = Outcome(metrics=PROBE_METRICS)
    with ProbeShards(features, [scene for scene, _ in chosen]) as shards:
        common = {"pair": None, "method": CONTEXT_BLOCK, "truth": PROBE_TRUTH, "role": None}
        note = "no sample: poses of the hand do not cover history and horizon"
        outcome.rows += [{"scene": s.recording.name, **common, "note": note} for s, samples in chosen if not samples[0]]
        chosen = [(scene, samples) for scene, samples in chosen if samples[0]]
        true_depth = all(isinstance(scene.recording, TruthRecording) for scene, _ in chosen)
        sizes: dict[str, Any] = {"cells": depth_cells, "rgb_side": rgb_side, "moving": moving}
        key = (method, sizes, origin, sorted(networks), settings.seed, str(settings.dtype), true_depth)
        entries = []
        for scene, samples in chosen:
            rows = probing.split_into_chunks(list(zip(*samples[:2], strict=True)), settings.batch)
            make = partial(_make_shard, scene, samples, method, networks, settings=settings, progress=progress, **sizes)
            chunks = [(scene.recording, part, true_depth) for part in rows]
            entries.append((task_name(scene.recording), (scene.name, samples[:2], *key), chunks, make))
        shards.add_all(entries, settings)
        arms = {k: blocks for k, blocks in PROBE_ARMS.items() if set(blocks) <= set(shards.widths)}
        probe_errors = probing.evaluate_probes(shards, arms, n_folds=n_folds, penalties=penalties, seed=settings.seed)
        outcome.n_pairs = shards.n
    probing.record_probes(outcome, probe_errors)
    outcome.summary = probing.summarise_probes(probe_errors)
    return outcome.decide(
        "Do depth features predict a robot's next motion as well as DINOv2's in a ridge probe?",
        "Yes: its error is that of DINOv2 within 2 %, over all samples and over those that move.",
        *verdict(probe_errors, origin, margin),
    )


def select_robot_samples(
    recording: Recording, *, horizon: float, history: float, stride: int
) -> tuple[list[int], list[int], Tensor, Tensor]:
    """Samples of one scene: frame indices, context features and target motions.

    Args:
        recording: of an RH20T scene.
        horizon, history: s.
        stride: frames.

    Returns:
        Indices of the frames and of the frames about ``history`` before them; context (n, 23): tool centre point in the
        base frame, first two columns of its rotation, joints, width of the gripper, last motion in the hand's axes;
        target (n, 6): translation (m) and rotation vector (rad) to the tool centre point ``horizon`` later, in the
        hand's axes. No sample if the scene lacks poses of the hand.

    Raises:
        ValueError: the recording is no RH20T scene.
    """
    if recording.format != "rh20t" or recording.root is None or recording.times is None:
        expected = "an RH20T scene (data=rh20t_set data.root=PATH, or data=rh20t_synthetic)"
        raise ValueError(f"rh20t_probe: {recording.name} is {recording.format}, expected {expected}")
    streams = rh20t.read_robot_streams(recording.root)
    if "tcp_base" not in streams:
        return [], [], torch.zeros(0, 16 + _N_JOINTS), torch.zeros(0, 6)
    times, tcp = recording.times.numpy(), streams["tcp_base"]
    (now, has_now), (then, has_then), (past, has_past) = (tcp.at(times + shift) for shift in (0.0, horizon, -history))
    before = np.abs(times[:, None] - history - times[None]).argmin(1)
    valid = has_now & has_then & has_past & (before < np.arange(len(times)))
    index = np.flatnonzero(valid)[::stride]
    hand_pose, ahead, behind = (
        # translations (m) and quaternions wxyz
        convert.to_c2w(x[index][:, [4, 5, 6, 3]], x[index][:, :3], recording.root, "tcp")
        for x in (now, then, past)
    )
    base_to_hand = np.linalg.inv(hand_pose)
    target, last = (_motion_vectors(base_to_hand @ pose) for pose in (ahead, behind))
    angles = np.zeros((len(index), _N_JOINTS))
    if "joint" in streams:
        joints = streams["joint"].at(times[index])[0][:, :_N_JOINTS]
        angles[:, : joints.shape[1]] = joints
    grip = next(
        (streams[k].at(times[index])[0][:, :1] for k in ("gripper_info", "gripper_command") if k in streams), None
    )
    width = np.zeros((len(index), 1)) if grip is None else grip
    rotation = hand_pose[:, :3, :2].transpose(0, 2, 1).reshape(-1, 6)
    state = np.concatenate((hand_pose[:, :3, 3], rotation, angles, width), 1)
    context = torch.cat((torch.from_numpy(state), last), 1)
    # Without rounding, the division by their spread would amplify the rounding noise of constant values, such as an
    # unused joint or an axis about which the hand never turns.
    return index.tolist(), before[index].tolist(), context.round(decimals=_DECIMALS), target.round(decimals=_DECIMALS)


def verdict(probe_errors: ProbeErrors, origin: str | None, margin: float) -> tuple[bool | None, str]:
    """Verdict and text: equivalence over all samples and over those that move.

    Args:
        probe_errors: of all arms.
        origin: of DINOv2's weights; None = random: no verdict.
        margin: of equivalence.
    """
    n = len(probe_errors.groups)
    error = probe_errors.mean(_OURS, ALL_COHORT).value or 0.0
    context_ratio = probe_errors.ratio(_OURS, CONTEXT_BLOCK, ALL_COHORT)
    ratio = probing.format_ratio(context_ratio)
    text = f"error {error:.3f} of the targets' variance, {ratio} times that of the context alone ({n} tasks)"
    if (XFEAT_BLOCK, ALL_COHORT) in probe_errors.squares:
        cohorts = (ALL_COHORT, MOVING_COHORT)
        xfeat_ratios = {cohort: probe_errors.ratio(_OURS, XFEAT_BLOCK, cohort) for cohort in cohorts}
        text += probing.compare_with_xfeat(
            {cohort: (interval.value, interval.low, interval.high) for cohort, interval in xfeat_ratios.items()}
        )
    if (REFERENCE_BLOCK, ALL_COHORT) not in probe_errors.squares:
        return None, f"DINOv2 was left out; with depth features: {text}"
    reference_ratios = {
        cohort: probe_errors.ratio(_OURS, REFERENCE_BLOCK, cohort, level=probe.EQUIVALENCE_LEVEL)
        for cohort in (ALL_COHORT, MOVING_COHORT)
    }
    ratios = ", ".join(f"{cohort} {probing.format_ratio(interval)}" for cohort, interval in reference_ratios.items())
    published = "paper: 1.006, 1.013"
    if origin is None:
        reason = f"{probing.RANDOM_WEIGHTS_NOTE}; ratio to the random network, 90 % intervals: {ratios} ({published})"
        return None, f"{reason}. With depth features: {text}"
    failed = None
    if (POSITIVE_CONTROL, ALL_COHORT) in probe_errors.squares:
        has_depth = (DEPTH_CONTROL, ALL_COHORT) in probe_errors.squares
        names = (POSITIVE_CONTROL, NEGATIVE_CONTROL, *([DEPTH_CONTROL] if has_depth else []))
        controls = {name: probe_errors.ratio(name, CONTEXT_BLOCK, ALL_COHORT) for name in names}
        failed = probing.check_controls(*controls.values())
        listed = ", ".join(f"{name} {probing.format_ratio(interval)}" for name, interval in controls.items())
        text += f". Controls, ratio to the context: {listed}"
    remarks = "; ".join(filter(None, (failed, probing.describe_error(error, context_ratio))))
    text = f"{origin}. {text}{f' [{remarks}]' * bool(remarks)}"
    if failed:
        return None, f"no verdict, {failed}; ratio to DINOv2, 90 % intervals: {ratios}; {published}. {text}"
    equivalent = [probe.is_equivalent(interval, margin) for interval in reference_ratios.values()]
    holds = False if False in equivalent else True if all(equivalent) else None
    beyond = probe_errors.ratio(_OURS, REFERENCE_BLOCK, ALL_COHORT).value if holds is False else None
    side = "" if beyond is None else f", so the error is {'smaller' if beyond < 1 else 'larger'} than DINOv2's"
    return holds, f"ratio to DINOv2, 90 % intervals, margin {margin:.0%}: {ratios}{side}; {published}. {text}"


def task_name(recording: Recording) -> str:
    """Name of the task, from the name of the scene's folder."""
    match = re.search(r"task_\d+", recording.name)
    return match[0] if match else str(recording.name)


@torch.no_grad()
def _make_shard(
    scene: Scene,
    samples: tuple[list[int], list[int], Tensor, Tensor],
    method: Method,
    networks: Mapping[str, front_ends.FrontEnd],
    read: Iterator[LoadedChunk],
    *,
    settings: Settings,
    progress: Progress,
    cells: int,
    rgb_side: int,
    moving: float,
) -> ProbeShard:
    """Shard of one scene's samples (indices, second views, context, target), from its chunks of frames."""
    _, _, context, target = samples
    options: dict[str, Any] = {"cells": cells, "seed": settings.seed, "hint": scene.hint}
    options["sparse"] = scene.recording.sparse
    two_view, one_view = (front_ends.DepthTokens(method, views=v, **options) for v in (2, 1))
    all_front_ends: dict[str, front_ends.FrontEnd] = {
        "rgb": partial(front_ends.resize_to_square, side=rgb_side),
        "depth": two_view,
        "depth_one_view": one_view,
        **networks,
    }
    parts: dict[str, list[Tensor]] = {name: [] for name in all_front_ends}
    n_chunks = -(-len(target) // max(1, settings.batch))
    for rows, truth in progress(read, scene.name, n_chunks):
        frames, seconds = ([frame.to(settings.device) for frame in column] for column in zip(*rows, strict=True))
        for name, front_end in all_front_ends.items():
            parts[name].append(front_end(frames, seconds).cpu())
        if truth:
            depths = (depth.to(settings.device) for depth in truth)
            exact = [f.replace(depth=d, depth_camera=None, conf=None) for f, d in zip(frames, depths, strict=True)]
            parts.setdefault(DEPTH_CONTROL, []).append(one_view(exact).cpu())
    blocks = {name: torch.cat(x) for name, x in parts.items()}
    is_moving = target[:, :3].norm(dim=-1) > moving
    return ProbeShard(task_name(scene.recording), {CONTEXT_BLOCK: context, **blocks}, target, is_moving)


def _motion_vectors(T: np.ndarray) -> Tensor:
    """Translation (m) and rotation vector (rad), (n, 6), of motions (n, 4, 4)."""
    R = torch.from_numpy(np.ascontiguousarray(T[:, :3, :3]))
    turn = rotation_matrix_to_axis_angle(R) if len(R) else R.new_zeros(0, 3)
    return torch.cat((torch.from_numpy(T[:, :3, 3]), turn), 1)
