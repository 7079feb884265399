"""Question: within one scene, do depth features tell a ridge probe more of the camera's own motion than DINOv2's do?

Samples are pairs of frames, a third of the scene's usable gap apart; the target is how the camera moved between them,
rotation vector and translation by the recording's own trajectory. The probe is given the features of the first frame
and how they change to the second; depth tokens of either frame have the other one as second view. A sequence is cut
into consecutive blocks, none of which shares a frame with another, and whole blocks are held out: every block is judged
on once. There is no context, so the arm ``context`` says the mean motion. ``two_view_pose`` is no probe: it is the
method's own pose, no motion where there is none, what the geometry says once it is allowed to finish.

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

#: Block of a shard that holds the method's own answer.
_OWN_POSE_BLOCK = "pose"

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
    """Probes of every scene alone; scenes of one room are one.

    Args:
        scenes: with poses; those without, with a role, or of rooms with few pairs are noted and left out.
        methods: name → method; the first fills the depth tokens.
        pairs: not used: every frame starts a pair, so that there are enough.
        settings: of the job; nothing is hidden from the method.
        gap_parts: a pair spans the scene's own gap, divided by this, and at least one frame.
        blocks: consecutive parts of a scene, at least three; dealt out evenly over the scenes of a room.
        min_pairs: fewest pairs of a scene.
        moving: m; a pair moves where the camera has gone farther.
        penalties, depth_cells, dinov2_cells, rgb_side, dinov2, xfeat, progress: as
            :func:`dhtorch.experiments.probes.rh20t_probe.run`.

    Returns:
        Outcome with one row per scene and arm; see :func:`probing.record`.

    Raises:
        ImportError: ``transformers`` or XFeat's package is missing; the message says what to install.
        ValueError: fewer than three blocks.

    Source: paper, section 6.7, "Downstream behaviour as a visual front-end".
    """
    if blocks < 3:
        raise ValueError(f"vo_probe: blocks is {blocks}, expected at least 3")
    networks, real = front_ends.load_network_front_ends(
        dinov2, cells=dinov2_cells, xfeat_too=xfeat, device=settings.device
    )
    every = [*(arm for arm, blocks in PROBE_ARMS.items() if xfeat or XFEAT_BLOCK not in blocks), _POSE_ARM]
    outcome = Outcome()
    rooms: dict[str, list[Scene]] = {}
    for scene in scenes_of(scenes):
        rooms.setdefault(scene.place, []).append(scene)
    for room, members in rooms.items():
        cut = {s.name: split_into_blocks(s, gap_parts, max(1, -(-blocks // len(members)))) for s in members}
        n = sum(len(block) for own in cut.values() for block in own)
        if n < min_pairs:
            note = f"{n} pairs with known motion, fewer than {min_pairs}"
            outcome.rows += [_empty_row(room, arm, note) for arm in every]
            continue
        with ProbeShards() as shards:
            for scene in members:
                options: dict[str, Any] = {"cells": depth_cells, "seed": settings.seed}
                two, one = (
                    front_ends.depth_tokens_for_scene(next(iter(methods.values())), scene, views=v, **options)
                    for v in (2, 1)
                )
                look = _PairFeatures(scene.recording, settings, two, one, networks, rgb_side)
                found = [pair for block in cut[scene.name] for pair in block]
                rows = iter([look(*pair) for pair in progress(found, scene.name, len(found))])
                for k, block in enumerate(cut[scene.name]):
                    own = [next(rows) for _ in block]
                    shards.add(_make_shard(f"{scene.name} {k}", own, scene.recording, block, moving))
            arms = {k: names for k, names in PROBE_ARMS.items() if set(names) <= set(shards.widths)}
            options = {"n_folds": len(shards.groups), "penalties": penalties, "seed": settings.seed}
            judged = probing.evaluate_probes(shards, arms, told={_POSE_ARM: _OWN_POSE_BLOCK}, **options)
        probing.record_probes(outcome, judged, room)
        outcome.n_pairs += n
    outcome.summary = probing.summarise_over_scenes(outcome, every)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, real))


def split_into_blocks(scene: Scene, gap_parts: int, n: int) -> list[list[tuple[int, int]]]:
    """Pairs of frames in ``n`` consecutive blocks that share no frame; none where the motion is not known."""
    length = len(scene.recording)
    if scene.recording.poses is None or scene.role is not None or length < 2 * n:
        return []
    step = max(1, round((scene.gap or 1) / gap_parts))
    edges = [round(k * length / n) for k in range(n + 1)]
    return [[(i, i + step) for i in range(a, b - step)] for a, b in pairwise(edges)]


def verdict(outcome: Outcome, real: bool) -> tuple[bool | None, str]:
    """Is the error smaller than DINOv2's on every scene? Never decided without DINOv2's own weights."""
    ours, theirs = outcome.scenes(_OURS, PROBE_TRUTH), outcome.scenes(REFERENCE_BLOCK, PROBE_TRUTH)
    beside = probing.compare_with_xfeat(
        {s: (row.get("vs_xfeat"), row.get("vs_xfeat_low"), row.get("vs_xfeat_high")) for s, row in ours.items()}
    )
    scenes = [s for s in ours if ours[s].get("mse") is not None and theirs.get(s, {}).get("mse") is not None]
    if not scenes:
        known = any(row.get("mse") is not None for row in ours.values())
        return None, f"{'DINOv2 was left out' if known else 'no scene with enough pairs'}{beside}"
    parts = [f"{s} {ours[s]['mse']:.2f} against {theirs[s]['mse']:.2f}{_format_interval(ours[s])}" for s in scenes]
    text = f"{'; '.join(parts)} (paper: 1.32 against 1.63, ratio 0.81){beside}"
    if not real:
        return None, f"{probing.RANDOM_WEIGHTS_NOTE}; error with depth features and with the random network: {text}"
    below = [ours[s]["vs_dinov2_high"] is not None and ours[s]["vs_dinov2_high"] < 1 for s in scenes]
    above = [ours[s]["vs_dinov2_low"] is not None and ours[s]["vs_dinov2_low"] > 1 for s in scenes]
    holds = True if all(below) else False if 2 * sum(above) >= len(scenes) else None
    return holds, text


class _PairFeatures:
    """Features of the pairs of one recording; a frame's own are computed once."""

    def __init__(
        self,
        recording: Recording,
        settings: Settings,
        two: front_ends.DepthTokens,
        one: front_ends.DepthTokens,
        networks: Mapping[str, front_ends.FrontEnd],
        rgb_side: int,
    ) -> None:
        self.recording, self.settings, self.two, self.one = recording, settings, two, one
        self.networks, self.rgb_side = networks, rgb_side
        self._known: dict[int, tuple[Frame, dict[str, Tensor]]] = {}

    @torch.no_grad()
    def __call__(self, i: int, j: int) -> dict[str, Tensor]:
        """Each block: features of ``i``, and those of ``j`` less them."""
        (a, alone_a), (b, alone_b) = self._alone(i), self._alone(j)
        forth, added = self.two.features_and_keys(a, b)
        back = self.two(b, a)
        found = {name: torch.cat((x, alone_b[name] - x), 1) for name, x in alone_a.items()}
        found["depth"] = torch.cat((forth, back - forth), 1)
        # The transform's pose maps the reference view into the other view: the same way round as the target.
        found[_OWN_POSE_BLOCK] = torch.where(added["pose_ok"], _motion_vectors(added["T_1_from_0"][None].double()), 0.0)
        return {name: x.cpu() for name, x in found.items()}

    def _alone(self, i: int) -> tuple[Frame, dict[str, Tensor]]:
        if i not in self._known:
            self._known = {k: v for k, v in self._known.items() if k >= i - 64}  # a long recording is not kept whole
            frame = self.recording[i].to(self.settings.dtype).to(self.settings.device)
            found = {"rgb": front_ends.resize_to_square(frame, side=self.rgb_side), "depth_one_view": self.one(frame)}
            found |= {name: network(frame) for name, network in self.networks.items()}
            self._known[i] = frame, found
        return self._known[i]


def _make_shard(
    group: str,
    rows: Sequence[Mapping[str, Tensor]],
    recording: Recording,
    block: Sequence[tuple[int, int]],
    moving: float,
) -> ProbeShard:
    i, j = torch.tensor(list(block), dtype=torch.int64).view(-1, 2).unbind(-1)
    poses = recording.poses
    assert poses is not None  # else there are no blocks
    target = _motion_vectors(se3.to_matrix(se3.relative(poses[i], poses[j])).double())
    blocks = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
    return ProbeShard(
        group, {CONTEXT_BLOCK: target.new_zeros(len(target), 0), **blocks}, target, target[:, 3:].norm(dim=-1) > moving
    )


def _motion_vectors(T: Tensor) -> Tensor:
    """(n, 6) rotation vector (rad) and translation (m) of (n, 4, 4)."""
    return torch.cat((rotation_matrix_to_axis_angle(T[:, :3, :3].contiguous()), T[:, :3, 3]), 1)


def _empty_row(scene: str, arm: str, note: str) -> Row:
    return {"scene": scene, "pair": None, "method": arm, "truth": PROBE_TRUTH, "role": None, "note": note}


def _format_interval(row: Row) -> str:
    low, high = row.get("vs_dinov2_low"), row.get("vs_dinov2_high")
    return "" if low is None or high is None else f", ratio {row['vs_dinov2']:.2f} ({low:.2f} to {high:.2f})"
