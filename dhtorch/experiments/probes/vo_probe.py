"""Question: within one scene, do depth features predict the camera's motion better than DINOv2's in a ridge probe?

Samples are pairs of frames, a third of the scene's usable gap apart; the target is how the camera moved between them,
rotation vector and translation from the recording's own trajectory. The input of the probe is the features of the
first frame and their change to the second; depth tokens of either frame have the other one as second view. A sequence
is cut into consecutive blocks that share no frame, and whole blocks are held out: every block is evaluated once. With
``hold_out=rooms`` all rooms share their probes and whole rooms are held out, so that intervals are over rooms. There is
no context, so the arm ``context`` predicts the mean motion. ``two_view_pose`` is no probe but the method's own relative
pose, no motion if it has none: the estimate of the geometry itself.

Expectation (written before the run): yes; on every scene the error with depth features is smaller than DINOv2's (the
paper: 1.32 against 1.63, ratio 0.81, one scene, geometry-favoured as it says itself).
What would refute it: the 95 % interval of the ratio, from resampling blocks, lies wholly above 1 on half of the scenes.
Undecided in between, where the controls fail (:mod:`dhtorch.experiments.probes.probing`), and with random weights,
which say nothing about DINOv2. An undecided ratio comes with the number of rooms or blocks that would show the paper's.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import torch

from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.baselines import dinov2 as visual_branch
from dhtorch.experiments.loading import LoadedChunk
from dhtorch.experiments.outcome import Row
from dhtorch.experiments.probes import front_ends, probing
from dhtorch.experiments.probes.probing import (
    CONTEXT_BLOCK,
    DEPTH_CONTROL,
    EFFICIENTNET_BLOCK,
    NEGATIVE_CONTROL,
    POSITIVE_CONTROL,
    PROBE_ARMS,
    PROBE_METRICS,
    PROBE_PENALTIES,
    PROBE_TRUTH,
    REFERENCE_BLOCK,
    XFEAT_BLOCK,
    ProbeShard,
    ProbeShards,
)
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.geometry import se3
from dhtorch.metrics.bootstrap import Interval

#: Block of a shard with the method's own relative pose.
_OWN_POSE_BLOCK = "pose"

#: Least number of blocks: one for the test, one for the penalties, one to train on.
_MIN_BLOCKS = 3

_OURS, _POSE_ARM = "dhtorch", "two_view_pose"

#: Ratio of the errors in the paper: 1.32 against 1.63. Source: paper.
_PUBLISHED_RATIO = 0.81

#: What is held out at a time.
_HOLD_OUTS = ("blocks", "rooms")

#: Name of the rows of probes that all rooms share.
_ALL_ROOMS = "all rooms"


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    hold_out: str = "blocks",
    gap_parts: int = 3,
    blocks: int = 5,
    min_pairs: int = 30,
    moving: float = 0.01,
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
    """Run the experiment: ridge probes of every room separately or of all together, verdict.

    Args:
        scenes: with poses; those without, with a role, or of rooms with few pairs are left out, with a note.
        methods: name → method; the first fills the depth tokens.
        pairs: not used: every frame starts a pair, to have enough samples.
        settings: of the job; the method sees all returns; ``batch`` pairs or pictures per forward pass, on ``device``,
            of frames that ``workers`` processes read.
        hold_out: ``blocks`` of a room, each room with probes of its own; or ``rooms``, with probes that all share.
        gap_parts: the frames of a pair are the scene's own gap divided by this apart, at least one frame.
        blocks: consecutive parts of a scene, at least three; split evenly over the scenes of a room.
        min_pairs: smallest number of pairs of a room.
        moving: m; a pair moves if the camera's translation is larger.
        features: folder that keeps the features, so that an interrupted run resumes; None = a temporary one.
        penalties, depth_cells, dinov2_cells, rgb_side, dinov2, xfeat, efficientnet, progress: as
            :func:`dhtorch.experiments.probes.rh20t_probe.run`.

    Returns:
        Outcome with one row per room (or for all rooms) and arm; see :func:`probing.record_probes`.

    Raises:
        ImportError: ``transformers`` or XFeat's package is missing; the message says what to install.
        ValueError: fewer than three blocks, or an unknown ``hold_out``.

    Source: paper, section 6.7, "Downstream behaviour as a visual front-end".
    """
    if blocks < _MIN_BLOCKS:
        raise ValueError(f"vo_probe: blocks is {blocks}, expected at least {_MIN_BLOCKS}")
    if hold_out not in _HOLD_OUTS:
        raise ValueError(f"vo_probe: hold_out is {hold_out!r}, expected {' or '.join(_HOLD_OUTS)}")
    networks, origin = front_ends.load_network_front_ends(
        dinov2, cells=dinov2_cells, xfeat_too=xfeat, efficientnet_too=efficientnet, device=settings.device
    )
    left_out = {XFEAT_BLOCK: not xfeat, EFFICIENTNET_BLOCK: not efficientnet, DEPTH_CONTROL: True}
    arm_names = [*(a for a, names in PROBE_ARMS.items() if not any(left_out.get(n) for n in names)), _POSE_ARM]
    method = next(iter(methods.values()))
    options: dict[str, Any] = {"networks": networks, "cells": depth_cells, "rgb_side": rgb_side, "moving": moving}
    options |= {"method": method, "settings": settings, "progress": progress}
    outcome = Outcome(metrics=PROBE_METRICS)
    rooms: dict[str, list[Scene]] = {}
    for scene in scenes_of(scenes):
        rooms.setdefault(scene.place, []).append(scene)
    probed: dict[str, list[tuple[Scene, list[list[tuple[int, int]]]]]] = {}
    for room, members in rooms.items():
        blocks_of = [(s, split_into_blocks(s, gap_parts, max(1, -(-blocks // len(members))))) for s in members]
        lengths = [len(block) for _, scene_blocks in blocks_of for block in scene_blocks]
        few = f"fewer than {_MIN_BLOCKS} blocks with pairs" if sum(map(bool, lengths)) < _MIN_BLOCKS else ""
        note = few if sum(lengths) >= min_pairs else f"{sum(lengths)} pairs with known motion, fewer than {min_pairs}"
        if note:
            outcome.rows += [
                {"scene": room, "pair": None, "method": arm, "truth": PROBE_TRUTH, "role": None, "note": note}
                for arm in arm_names
            ]
        else:
            probed.setdefault(_ALL_ROOMS if hold_out == "rooms" else room, []).extend(blocks_of)
    needed: dict[str, int | None] = {}
    for name, members_blocks in probed.items():
        with ProbeShards(features, [scene for scene, _ in members_blocks]) as shards:
            parts = [
                (scene.place if hold_out == "rooms" else f"{scene.name} {k}", scene, block)
                for scene, scene_blocks in members_blocks
                for k, block in enumerate(scene_blocks)
                if block
            ]
            key = (method, depth_cells, rgb_side, origin, sorted(networks), settings.seed)
            entries = []
            for group, scene, block in parts:
                positions = sorted({k for pair in block for k in pair})
                rows = probing.split_into_chunks([(i,) for i in positions], settings.batch)
                make = partial(_make_shard, group, scene, block, **options)
                chunks = [(scene.recording, part, False) for part in rows]
                entries.append((group, (scene.name, len(scene.recording), list(block), moving, *key), chunks, make))
            shards.add_all(entries, settings)
            arms = {k: names for k, names in PROBE_ARMS.items() if set(names) <= set(shards.widths)}
            folds: dict[str, Any] = {"n_folds": len(shards.groups), "penalties": penalties, "seed": settings.seed}
            errors = probing.evaluate_probes(shards, arms, predictions={_POSE_ARM: _OWN_POSE_BLOCK}, **folds)
            outcome.n_pairs += shards.n
        probing.record_probes(outcome, errors, name)
        if REFERENCE_BLOCK in arms:
            needed[name] = probing.groups_needed(errors, _OURS, REFERENCE_BLOCK, probing.ALL_COHORT, _PUBLISHED_RATIO)
    outcome.summary = probing.summarise_over_scenes(outcome, arm_names)
    return outcome.decide(
        "Within one scene, do depth features predict the camera's motion better than DINOv2's in a ridge probe?",
        "Yes: on every scene the error with depth features is smaller than DINOv2's.",
        *verdict(outcome, origin, needed),
    )


def split_into_blocks(scene: Scene, gap_parts: int, n: int) -> list[list[tuple[int, int]]]:
    """Pairs of frames in ``n`` consecutive blocks that share no frame; empty without poses or with a role."""
    length = len(scene.recording)
    if scene.recording.poses is None or scene.role is not None or length < 2 * n:
        return []
    step = max(1, round((scene.gap or 1) / gap_parts))
    edges = [round(k * length / n) for k in range(n + 1)]
    return [[(i, i + step) for i in range(a, b - step)] for a, b in pairwise(edges)]


def verdict(
    outcome: Outcome, origin: str | None, needed: Mapping[str, int | None] | None = None
) -> tuple[bool | None, str]:
    """Verdict and text: error below DINOv2's in every room.

    Args:
        outcome: with its rows.
        origin: of DINOv2's weights; None = random: no verdict.
        needed: number of blocks, or rooms, with which the paper's ratio would be seen, by the name of the row.
    """
    ours, theirs = outcome.scenes(_OURS, PROBE_TRUTH), outcome.scenes(REFERENCE_BLOCK, PROBE_TRUTH)
    xfeat_text = probing.compare_with_xfeat(
        {s: (row.get("vs_xfeat"), row.get("vs_xfeat_low"), row.get("vs_xfeat_high")) for s, row in ours.items()}
    )
    scenes = [s for s in ours if ours[s].get("mse") is not None and theirs.get(s, {}).get("mse") is not None]
    if not scenes:
        has_error = any(row.get("mse") is not None for row in ours.values())
        return None, f"{'DINOv2 was left out' if has_error else 'no scene with enough pairs'}{xfeat_text}"
    parts = [_describe_room(s, ours[s], theirs[s], (needed or {}).get(s)) for s in scenes]
    text = f"{'; '.join(parts)} (paper: 1.32 against 1.63, ratio 0.81, one scene){xfeat_text}"
    if origin is None:
        return None, f"{probing.RANDOM_WEIGHTS_NOTE}; error with depth features and with the random network: {text}"
    text = f"{origin}: {text}"
    failed = {s: reason for s in scenes if (reason := _failed_control(outcome, s))}
    decided = [s for s in scenes if s not in failed]
    if failed:
        text += f". No verdict on {'; '.join(f'{s}: {reason}' for s, reason in failed.items())}"
    below = [ours[s]["vs_dinov2_high"] is not None and ours[s]["vs_dinov2_high"] < 1 for s in decided]
    above = [ours[s]["vs_dinov2_low"] is not None and ours[s]["vs_dinov2_low"] > 1 for s in decided]
    refuted = bool(decided) and 2 * sum(above) >= len(decided)
    return (True if below and all(below) and not failed else False if refuted else None), text


def _failed_control(outcome: Outcome, scene: str) -> str | None:
    """Reason why the controls of a row allow no verdict; None = they do, or were not run."""
    rows = [outcome.scenes(arm, PROBE_TRUTH).get(scene, {}) for arm in (POSITIVE_CONTROL, NEGATIVE_CONTROL)]
    return probing.check_controls(*(_interval(row, "vs_context") for row in rows)) if any(rows) else None


def _describe_room(scene: str, ours: Row, theirs: Row, needed: int | None) -> str:
    """Errors, ratio and what is to be said of them."""
    text = f"{scene} {ours['mse']:.2f} against {theirs['mse']:.2f}"
    remarks = probing.describe_error(ours["mse"], _interval(ours, "vs_context"))
    low, high = ours.get("vs_dinov2_low"), ours.get("vs_dinov2_high")
    text += "" if low is None or high is None else f", ratio {ours['vs_dinov2']:.2f} ({low:.2f} to {high:.2f})"
    if needed is not None and low is not None and high is not None and low <= 1 <= high:
        remarks += f"{'; ' * bool(remarks)}the paper's ratio would be seen with about {needed} such groups"
    return f"{text} [{remarks}]" if remarks else text


def _interval(row: Row, name: str) -> Interval:
    return Interval(row.get(name), row.get(f"{name}_low"), row.get(f"{name}_high"), row.get("n_samples") or 0)


@torch.no_grad()
def _make_shard(
    group: str,
    scene: Scene,
    block: Sequence[tuple[int, int]],
    read: Iterator[LoadedChunk],
    *,
    method: Method,
    networks: Mapping[str, front_ends.FrontEnd],
    settings: Settings,
    cells: int,
    rgb_side: int,
    moving: float,
    progress: Progress,
) -> ProbeShard:
    """Shard of one block of pairs, ``settings.batch`` at once; those of a single frame are computed once.

    Features (n, F) by block of features: of frame ``i``, then of ``j`` minus ``i``.
    """
    i, j = torch.tensor(list(block), dtype=torch.int64).view(-1, 2).unbind(-1)
    poses = scene.recording.poses
    assert poses is not None  # scenes without poses have no blocks
    target = probing.motion_vectors(se3.to_matrix(se3.relative(poses[i], poses[j])).double())
    in_order = [frame.to(settings.device) for rows, _ in read for (frame,) in rows]
    frames = dict(zip(sorted({k for pair in block for k in pair}), in_order, strict=True))
    tokens: dict[str, Any] = {"cells": cells, "seed": settings.seed, "hint": scene.hint}
    tokens["sparse"] = scene.recording.sparse
    two_view, one_view = (front_ends.DepthTokens(method, views=v, **tokens) for v in (2, 1))
    single: dict[str, front_ends.FrontEnd] = {
        "rgb": partial(front_ends.resize_to_square, side=rgb_side),
        "depth_one_view": one_view,
        **networks,
    }
    order = {k: n for n, k in enumerate(frames)}
    a, b = ([order[p[side]] for p in block] for side in (0, 1))
    blocks = {CONTEXT_BLOCK: target.new_zeros(len(target), 0)}
    for name, front_end in single.items():
        x = torch.cat([front_end(chunk) for chunk in probing.split_into_chunks(in_order, settings.batch)]).cpu()
        blocks[name] = torch.cat((x[a], x[b] - x[a]), 1)
    forth, back, own = [], [], []
    chunks = probing.split_into_chunks(list(block), settings.batch)
    for chunk in progress(chunks, scene.name, len(chunks)):
        first, second = ([frames[p[side]] for p in chunk] for side in (0, 1))
        x, added = two_view.features_and_keys(first, second)
        forth.append(x.cpu())
        back.append(two_view(second, first).cpu())
        # The transform's pose maps the reference view into the other view: the same way round as the target.
        motion = probing.motion_vectors(added["T_1_from_0"].double())
        own.append(torch.where(added["pose_ok"].view(-1, 1), motion, 0.0).cpu())
    depth = torch.cat(forth)
    blocks |= {"depth": torch.cat((depth, torch.cat(back) - depth), 1), _OWN_POSE_BLOCK: torch.cat(own)}
    return ProbeShard(group, blocks, target, target[:, 3:].norm(dim=-1) > moving)
