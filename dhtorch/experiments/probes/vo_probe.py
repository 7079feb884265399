"""Question: within one scene, do depth features tell a ridge probe more of the camera's own motion than DINOv2's do?

Samples are pairs of frames, a third of the scene's usable gap apart; the target is how the camera moved between them,
rotation vector and translation from the recording's own trajectory. The input of the probe is the features of the
first frame and their change to the second; depth tokens of either frame have the other one as second view. A sequence
is cut into consecutive blocks that share no frame, and whole blocks are held out: every block is evaluated once. There
is no context, so the arm ``context`` predicts the mean motion. ``two_view_pose`` is no probe but the method's own
relative pose, no motion if it has none: the estimate of the geometry itself.

Expectation (written before the run): yes; on every scene the error with depth features is smaller than DINOv2's (the
paper: 1.32 against 1.63, ratio 0.81, one scene, geometry-favoured as it says itself).
What would refute it: the 95 % interval of the ratio, from resampling blocks, lies wholly above 1 on half of the scenes.
Undecided in between, and with random weights, which say nothing about DINOv2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.baselines import dinov2 as visual_branch
from dhtorch.experiments.probes import front_ends, probing
from dhtorch.experiments.probes.probing import (
    CONTEXT_BLOCK,
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
from dhtorch.experiments.rows import Row
from dhtorch.geometry import se3
from dhtorch.records import Frame

QUESTION = "Within one scene, do depth features tell a ridge probe more of the camera's motion than DINOv2's do?"
EXPECTATION = "Yes: on every scene the error with depth features is smaller than DINOv2's."

#: Block of a shard with the method's own relative pose.
_OWN_POSE_BLOCK = "pose"

#: Least number of blocks: one for the test, one for the penalties, one to train on.
_MIN_BLOCKS = 3

_OURS, _POSE_ARM = "dhtorch", "two_view_pose"


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
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
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: ridge probes of every scene separately, verdict; scenes of one room are joined.

    Args:
        scenes: with poses; those without, with a role, or of rooms with few pairs are left out, with a note.
        methods: name → method; the first fills the depth tokens.
        pairs: not used: every frame starts a pair, to have enough samples.
        settings: of the job; the method sees all returns.
        gap_parts: the frames of a pair are the scene's own gap divided by this apart, at least one frame.
        blocks: consecutive parts of a scene, at least three; split evenly over the scenes of a room.
        min_pairs: smallest number of pairs of a scene.
        moving: m; a pair moves if the camera's translation is larger.
        penalties, depth_cells, dinov2_cells, rgb_side, dinov2, xfeat, progress: as
            :func:`dhtorch.experiments.probes.rh20t_probe.run`.

    Returns:
        Outcome with one row per scene and arm; see :func:`probing.record_probes`.

    Raises:
        ImportError: ``transformers`` or XFeat's package is missing; the message says what to install.
        ValueError: fewer than three blocks.

    Source: paper, section 6.7, "Downstream behaviour as a visual front-end".
    """
    if blocks < _MIN_BLOCKS:
        raise ValueError(f"vo_probe: blocks is {blocks}, expected at least {_MIN_BLOCKS}")
    networks, real = front_ends.load_network_front_ends(
        dinov2, cells=dinov2_cells, xfeat_too=xfeat, device=settings.device
    )
    arm_names = [*(arm for arm, blocks in PROBE_ARMS.items() if xfeat or XFEAT_BLOCK not in blocks), _POSE_ARM]
    outcome = Outcome(metrics=PROBE_METRICS)
    rooms: dict[str, list[Scene]] = {}
    for scene in scenes_of(scenes):
        rooms.setdefault(scene.place, []).append(scene)
    for room, members in rooms.items():
        blocks_of = {s.name: split_into_blocks(s, gap_parts, max(1, -(-blocks // len(members)))) for s in members}
        n_pairs = sum(len(block) for scene_blocks in blocks_of.values() for block in scene_blocks)
        if n_pairs < min_pairs:
            note = f"{n_pairs} pairs with known motion, fewer than {min_pairs}"
            outcome.rows += [_empty_row(room, arm, note) for arm in arm_names]
            continue
        if sum(bool(block) for scene_blocks in blocks_of.values() for block in scene_blocks) < _MIN_BLOCKS:
            note = f"fewer than {_MIN_BLOCKS} blocks with pairs"
            outcome.rows += [_empty_row(room, arm, note) for arm in arm_names]
            continue
        with ProbeShards() as shards:
            for scene in members:
                options: dict[str, Any] = {"cells": depth_cells, "seed": settings.seed}
                two_view, one_view = (
                    front_ends.depth_tokens_for_scene(next(iter(methods.values())), scene, views=v, **options)
                    for v in (2, 1)
                )
                features_of = _PairFeatures(scene.recording, settings, two_view, one_view, networks, rgb_side)
                pairs_of_scene = [pair for block in blocks_of[scene.name] for pair in block]
                rows = iter([features_of(*pair) for pair in progress(pairs_of_scene, scene.name, len(pairs_of_scene))])
                for k, block in enumerate(blocks_of[scene.name]):
                    features = [next(rows) for _ in block]
                    shards.add(_make_shard(f"{scene.name} {k}", features, scene.recording, block, moving))
            arms = {k: names for k, names in PROBE_ARMS.items() if set(names) <= set(shards.widths)}
            options = {"n_folds": len(shards.groups), "penalties": penalties, "seed": settings.seed}
            probe_errors = probing.evaluate_probes(shards, arms, predictions={_POSE_ARM: _OWN_POSE_BLOCK}, **options)
        probing.record_probes(outcome, probe_errors, room)
        outcome.n_pairs += n_pairs
    outcome.summary = probing.summarise_over_scenes(outcome, arm_names)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, real))


def split_into_blocks(scene: Scene, gap_parts: int, n: int) -> list[list[tuple[int, int]]]:
    """Pairs of frames in ``n`` consecutive blocks that share no frame; empty without poses or with a role."""
    length = len(scene.recording)
    if scene.recording.poses is None or scene.role is not None or length < 2 * n:
        return []
    step = max(1, round((scene.gap or 1) / gap_parts))
    edges = [round(k * length / n) for k in range(n + 1)]
    return [[(i, i + step) for i in range(a, b - step)] for a, b in pairwise(edges)]


def verdict(outcome: Outcome, real: bool) -> tuple[bool | None, str]:
    """Verdict and text: error below DINOv2's on every scene; None with random DINOv2 weights."""
    ours, theirs = outcome.scenes(_OURS, PROBE_TRUTH), outcome.scenes(REFERENCE_BLOCK, PROBE_TRUTH)
    xfeat_text = probing.compare_with_xfeat(
        {s: (row.get("vs_xfeat"), row.get("vs_xfeat_low"), row.get("vs_xfeat_high")) for s, row in ours.items()}
    )
    scenes = [s for s in ours if ours[s].get("mse") is not None and theirs.get(s, {}).get("mse") is not None]
    if not scenes:
        has_error = any(row.get("mse") is not None for row in ours.values())
        return None, f"{'DINOv2 was left out' if has_error else 'no scene with enough pairs'}{xfeat_text}"
    parts = [f"{s} {ours[s]['mse']:.2f} against {theirs[s]['mse']:.2f}{_format_interval(ours[s])}" for s in scenes]
    text = f"{'; '.join(parts)} (paper: 1.32 against 1.63, ratio 0.81){xfeat_text}"
    if not real:
        return None, f"{probing.RANDOM_WEIGHTS_NOTE}; error with depth features and with the random network: {text}"
    below = [ours[s]["vs_dinov2_high"] is not None and ours[s]["vs_dinov2_high"] < 1 for s in scenes]
    above = [ours[s]["vs_dinov2_low"] is not None and ours[s]["vs_dinov2_low"] > 1 for s in scenes]
    holds = True if all(below) else False if 2 * sum(above) >= len(scenes) else None
    return holds, text


class _PairFeatures:
    """Features of the pairs of one recording; single-frame features are computed once per frame."""

    def __init__(
        self,
        recording: Recording,
        settings: Settings,
        two_view: front_ends.DepthTokens,
        one_view: front_ends.DepthTokens,
        networks: Mapping[str, front_ends.FrontEnd],
        rgb_side: int,
    ) -> None:
        self.recording, self.settings, self.two_view, self.one_view = recording, settings, two_view, one_view
        self.networks, self.rgb_side = networks, rgb_side
        self._cache: dict[int, tuple[Frame, dict[str, Tensor]]] = {}

    @torch.no_grad()
    def __call__(self, i: int, j: int) -> dict[str, Tensor]:
        """Features of a pair by block: those of frame ``i``, concatenated with those of ``j`` minus those of ``i``."""
        (a, single_a), (b, single_b) = self._single_frame(i), self._single_frame(j)
        forth, added = self.two_view.features_and_keys(a, b)
        back = self.two_view(b, a)
        features = {name: torch.cat((x, single_b[name] - x), 1) for name, x in single_a.items()}
        features["depth"] = torch.cat((forth, back - forth), 1)
        # The transform's pose maps the reference view into the other view: the same way round as the target.
        features[_OWN_POSE_BLOCK] = torch.where(
            added["pose_ok"], _motion_vectors(added["T_1_from_0"][None].double()), 0.0
        )
        return {name: x.cpu() for name, x in features.items()}

    def _single_frame(self, i: int) -> tuple[Frame, dict[str, Tensor]]:
        """Frame ``i`` on the device, and the features that need no second view; the latest frames are cached."""
        if i not in self._cache:
            self._cache = {k: v for k, v in self._cache.items() if k >= i - 64}  # bounds the memory of a long recording
            frame = self.recording[i].to(self.settings.dtype).to(self.settings.device)
            features = {
                "rgb": front_ends.resize_to_square(frame, side=self.rgb_side),
                "depth_one_view": self.one_view(frame),
            }
            features |= {name: network(frame) for name, network in self.networks.items()}
            self._cache[i] = frame, features
        return self._cache[i]


def _make_shard(
    group: str,
    rows: Sequence[Mapping[str, Tensor]],
    recording: Recording,
    block: Sequence[tuple[int, int]],
    moving: float,
) -> ProbeShard:
    """Shard of one block: concatenated features, target motions, and whether each pair moves more than ``moving`` m."""
    i, j = torch.tensor(list(block), dtype=torch.int64).view(-1, 2).unbind(-1)
    poses = recording.poses
    assert poses is not None  # scenes without poses have no blocks
    target = _motion_vectors(se3.to_matrix(se3.relative(poses[i], poses[j])).double())
    blocks = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
    return ProbeShard(
        group, {CONTEXT_BLOCK: target.new_zeros(len(target), 0), **blocks}, target, target[:, 3:].norm(dim=-1) > moving
    )


def _motion_vectors(T: Tensor) -> Tensor:
    """Rotation vector (rad) and translation (m), (n, 6), of motions (n, 4, 4)."""
    return torch.cat((rotation_matrix_to_axis_angle(T[:, :3, :3].contiguous()), T[:, :3, 3]), 1)


def _empty_row(scene: str, arm: str, note: str) -> Row:
    """Row of a scene that was left out, with the reason as its note."""
    return {"scene": scene, "pair": None, "method": arm, "truth": PROBE_TRUTH, "role": None, "note": note}


def _format_interval(row: Row) -> str:
    """Text of the ratio to DINOv2's error with its interval; empty without an interval."""
    low, high = row.get("vs_dinov2_low"), row.get("vs_dinov2_high")
    return "" if low is None or high is None else f", ratio {row['vs_dinov2']:.2f} ({low:.2f} to {high:.2f})"
