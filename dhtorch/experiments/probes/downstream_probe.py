"""Question: do the recovered depths of an enriched data set help a linear policy predict the camera's next motion?

The samples are rows of LeRobot sets that ``dhtorch enrich`` wrote from recordings whose sensor was cut off at a short
range; the cut-off depth stands in the sets as their own. The target is the camera's next motion in its present axes
(rotation vector in rad, translation in m), a third of the scene's usable gap ahead. The context, shared by all arms, is
its last motion over as many frames, as a robot has it in its state. Every arm adds blocks of features of the present
frame and of their change since the past one: DINOv2's of the picture, and 4 × 4 cells of mean inverse depth and share
of answered pixels of a depth column: the sensor's returns alone (``sensor``), with the recovered ones (``dhtorch``), or
the depth before the cut-off (``true_depth``). All streams share their probes; held out are, in turn, consecutive blocks
of a stream that share no frame, and whole streams.

Expectation (written before the run): yes; beside DINOv2, the error with the recovered depths is smaller than with the
sensor's alone, blocks held out.
What would refute it: the 95 % interval of the ratio of the two errors, from resampling blocks, lies wholly above 1.
Undecided in between, and where a control fails: noisy true motion must beat the context, shuffled depth must not, and
the true depth must beat the sensor's, or there is nothing that any depth beyond the cut-off could add.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.baselines import dinov2 as visual_branch
from dhtorch.experiments.probes import front_ends, probing
from dhtorch.experiments.probes.probing import (
    ALL_COHORT,
    CONTEXT_BLOCK,
    DEPTH_CONTROL,
    NEGATIVE_CONTROL,
    POSITIVE_CONTROL,
    PROBE_ARMS,
    PROBE_METRICS,
    PROBE_PENALTIES,
    REFERENCE_BLOCK,
    SENSOR_BLOCK,
    ProbeErrors,
    ProbeShard,
    ProbeShards,
)
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.geometry import se3

#: What is held out at a time, as the rows of the result name it.
BLOCKS_OUT, STREAMS_OUT = "blocks held out", "streams held out"

#: Ratio of two errors for which the number of groups is stated that would show it.
#: Source: derived, a tenth less error, the least that would matter to a user.
_RATIO_OF_INTEREST = 0.9

_OURS = "dhtorch"

#: Arm → blocks beside the context.
DOWNSTREAM_ARMS: dict[str, tuple[str, ...]] = {
    **PROBE_ARMS,
    SENSOR_BLOCK: (SENSOR_BLOCK,),
    f"{SENSOR_BLOCK} + {REFERENCE_BLOCK}": (SENSOR_BLOCK, REFERENCE_BLOCK),
    f"{DEPTH_CONTROL} + {REFERENCE_BLOCK}": (DEPTH_CONTROL, REFERENCE_BLOCK),
}


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    readings: Mapping[str, Mapping[str, Any]],
    gap_parts: int = 3,
    blocks: int = 4,
    min_samples: int = 3,
    moving: float = 0.01,
    n_folds: int = 5,
    penalties: Sequence[float] = PROBE_PENALTIES,
    depth_cells: int = 4,
    dinov2_cells: int = 1,
    dinov2: Callable[..., torch.nn.Module] | None = visual_branch.load_dinov2,
    features: str | None = None,
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: features of every enriched set, cross-validated ridge probes, verdict.

    Args:
        scenes: LeRobot sets with poses, each with its gap.
        methods, pairs: not used: the depths are those of the sets.
        settings: of the job; ``batch`` pictures per forward pass.
        readings: for ``sensor``, ``depth`` (the recovered ones) and ``true_depth`` the options of the LeRobot reader.
        gap_parts: the frames of a motion are the scene's own gap divided by this apart, at least one frame.
        blocks: consecutive parts of a stream; fewer where a part would have less than ``min_samples`` samples.
        min_samples: of a block.
        moving: m; a sample moves if the camera's translation is larger.
        features: folder that keeps the features, so that an interrupted run resumes; None = a temporary one.
        n_folds: parts into which blocks, or streams, are split.
        penalties, depth_cells, dinov2_cells, dinov2, progress: as
            :func:`dhtorch.experiments.probes.rh20t_probe.run`.

    Returns:
        Outcome with one row per arm, for blocks and for streams held out; see :func:`probing.record_probes`.

    Raises:
        ImportError: ``transformers`` is missing; the message says what to install.
        ValueError: a scene that is no LeRobot set or has no poses, or fewer than three blocks or streams.
    """
    networks, origin = front_ends.load_network_front_ends(dinov2, cells=dinov2_cells, device=settings.device)
    extract = partial(_extract_features, readings=readings, networks=networks, settings=settings, cells=depth_cells)
    outcome = Outcome(metrics=PROBE_METRICS)
    samples = [(s, split_into_samples(s, gap_parts, blocks, min_samples)) for s in scenes_of(scenes)]
    errors_by_split: dict[str, ProbeErrors] = {}
    sources = [scene for scene, _ in samples]
    with ProbeShards(features, sources) as by_block, ProbeShards(features, sources) as by_stream:
        for scene, scene_blocks in progress(samples, "enriched sets", len(samples)):
            for k, block in enumerate(scene_blocks):
                make = cache(partial(_make_shard, scene, block, extract, moving))
                sizes = (moving, depth_cells, origin, sorted(networks), settings.seed)
                key = (scene.name, block, {name: dict(options) for name, options in readings.items()}, *sizes)
                for shards, group in ((by_block, f"{scene.name} {k}"), (by_stream, scene.name)):
                    shards.add(group, key, partial(_in_group, make, group))
        arms = {k: names for k, names in DOWNSTREAM_ARMS.items() if set(names) <= set(by_block.widths)}
        for name, shards in ((BLOCKS_OUT, by_block), (STREAMS_OUT, by_stream)):
            errors_by_split[name] = probing.evaluate_probes(
                shards, arms, n_folds=n_folds, penalties=penalties, seed=settings.seed
            )
            probing.record_probes(outcome, errors_by_split[name], name)
        outcome.n_pairs = by_block.n
    outcome.summary = probing.summarise_probes(errors_by_split[BLOCKS_OUT])
    return outcome.decide(
        "Do the recovered depths of an enriched data set help a linear policy predict the camera's next motion?",
        "Yes: beside DINOv2, the error is smaller than with the sensor's returns alone.",
        *verdict(errors_by_split[BLOCKS_OUT], errors_by_split[STREAMS_OUT], origin),
    )


def split_into_samples(scene: Scene, gap_parts: int, blocks: int, min_samples: int) -> list[list[tuple[int, int, int]]]:
    """Past, present and next frame of every sample, in consecutive blocks that share no frame.

    Raises:
        ValueError: no poses.
    """
    recording = scene.recording
    if recording.poses is None:
        raise ValueError(f"downstream_probe: {recording.name} has no poses, expected a set with T_world_from_cam")
    step = max(1, round((scene.gap or 1) / gap_parts))
    n = max(1, min(blocks, len(recording) // (2 * step + min_samples)))
    edges = [round(k * len(recording) / n) for k in range(n + 1)]
    parts = [[(i - step, i, i + step) for i in range(a + step, b - step)] for a, b in pairwise(edges)]
    return [part for part in parts if part]


def _extract_features(
    scene: Scene,
    block: Sequence[tuple[int, int, int]],
    *,
    readings: Mapping[str, Mapping[str, Any]],
    networks: Mapping[str, front_ends.FrontEnd],
    settings: Settings,
    cells: int,
) -> dict[str, Tensor]:
    """Features (n, F) of samples by block of features: of the present frame, and their change since the past one."""
    numbers = sorted({k for past, now, _ in block for k in (past, now)})
    order = {k: n for n, k in enumerate(numbers)}
    past, now = ([order[sample[side]] for sample in block] for side in (0, 1))
    pool = partial(front_ends.pool_depth_maps, cells=cells)
    features: dict[str, Tensor] = {}
    for name, options in readings.items():
        recording = read_again(scene.recording, options)
        frames = [recording[k].to(settings.dtype).to(settings.device) for k in numbers]
        wanted: dict[str, front_ends.FrontEnd] = {name: pool, **({} if features else networks)}
        for block_name, front_end in wanted.items():
            chunks = probing.split_into_chunks(frames, settings.batch)
            x = torch.cat([front_end(chunk).cpu() for chunk in chunks])
            features[block_name] = torch.cat((x[now], x[now] - x[past]), 1)
    return features


def read_again(recording: Recording, options: Mapping[str, Any]) -> Recording:
    """The same episode and camera of a LeRobot set, with other options of the reader.

    Raises:
        ValueError: no LeRobot set on disk.
    """
    if recording.format != "lerobot" or recording.root is None:
        actual = f"{recording.name} is {recording.format}"
        raise ValueError(f"downstream_probe: {actual}, expected a LeRobot set that dhtorch enrich wrote")
    again = data.open_all(recording.root, "lerobot", **options)
    return next(r for r in again if r.name == recording.name)


def verdict(by_block: ProbeErrors, by_stream: ProbeErrors, origin: str | None) -> tuple[bool | None, str]:
    """Verdict and text: error with the recovered depths below that with the sensor's, beside DINOv2 where it was run.

    Args:
        by_block, by_stream: errors with blocks, streams held out.
        origin: of DINOv2's weights; None = random: said in the text.
    """
    beside = f" + {REFERENCE_BLOCK}" if (REFERENCE_BLOCK, ALL_COHORT) in by_block.squares else ""
    ours, sensor, true = (f"{arm}{beside}" for arm in (_OURS, SENSOR_BLOCK, DEPTH_CONTROL))
    ratio = by_block.ratio(ours, sensor, ALL_COHORT)
    error = by_block.mean(ours, ALL_COHORT).value
    vs_context = by_block.ratio(ours, CONTEXT_BLOCK, ALL_COHORT)
    positive, negative = (by_block.ratio(a, CONTEXT_BLOCK, ALL_COHORT) for a in (POSITIVE_CONTROL, NEGATIVE_CONTROL))
    true_ratio, alone = by_block.ratio(true, sensor, ALL_COHORT), by_block.ratio(_OURS, SENSOR_BLOCK, ALL_COHORT)
    n = len(by_block.groups)
    samples = int(by_block.counts[ALL_COHORT].sum())
    needed = probing.groups_needed(by_block, ours, sensor, ALL_COHORT, _RATIO_OF_INTEREST)
    failed = probing.check_controls(positive, negative)
    if failed is None and not (true_ratio.high is not None and true_ratio.high < 1):
        failed = f"the true depth does not beat the sensor's ({probing.format_ratio(true_ratio)})"
    streams = by_stream.ratio(ours, sensor, ALL_COHORT)
    parts = [
        f"{ours} against {sensor}, {n} blocks held out, {samples} samples: {probing.format_ratio(ratio)}",
        f"without the picture {probing.format_ratio(alone)}",
        f"{len(by_stream.groups)} streams held out: {probing.format_ratio(streams)}",
        f"error {error or 0.0:.3f} of the targets' variance, {probing.format_ratio(vs_context)} times the context's",
        f"controls: true motion {probing.format_ratio(positive)}, shuffled depth {probing.format_ratio(negative)} "
        f"times the context's, true depth {probing.format_ratio(true_ratio)} times the sensor's",
    ]
    if needed is not None:
        parts.append(f"a ratio of {_RATIO_OF_INTEREST} would be seen with about {needed} such blocks")
    if beside:
        parts.append(f"pictures: {origin or 'a network with random weights, a random projection'}")
    text = "; ".join(parts)
    if failed:
        return None, f"no verdict, {failed}; {text}"
    holds = True if (ratio.high or 1.0) < 1 else False if (ratio.low or 0.0) > 1 else None
    return holds, text


def _in_group(make: Callable[[], ProbeShard], group: str) -> ProbeShard:
    """The shard of ``make`` under the name of a group."""
    return replace(make(), group=group)


@torch.no_grad()
def _make_shard(
    scene: Scene,
    block: Sequence[tuple[int, int, int]],
    extract: Callable[..., dict[str, Tensor]],
    moving: float,
) -> ProbeShard:
    """Shard of one block of samples: last motion as context, features, next motion as target."""
    poses = scene.recording.poses
    assert poses is not None  # split_into_samples refuses a scene without
    past, now, ahead = torch.tensor(list(block), dtype=torch.int64).unbind(-1)
    last, target = (
        probing.motion_vectors(se3.to_matrix(se3.relative(poses[b], poses[a])).double())
        for a, b in ((past, now), (now, ahead))
    )
    return ProbeShard("", {CONTEXT_BLOCK: last, **extract(scene, block)}, target, target[:, 3:].norm(dim=-1) > moving)
