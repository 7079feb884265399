"""Evaluation loop of experiments whose estimator is not a method: items of every scene → rows of every variant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol, TypeVar

import torch

from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.outcome import MainMetric
from dhtorch.experiments.protocol import Outcome, Progress
from dhtorch.experiments.rows import Row, mean_or_none, median_or_none, summarise_rows

#: A pair of frames, or a frame alone as (i, i).
ScreenedItem = tuple[int, int]


class HasSceneRow(Protocol):
    """A scene as the loop uses it: its name and role."""

    @property
    def name(self) -> str:
        """Name of the scene in rows."""

    @property
    def role(self) -> str | None:
        """Role of the scene; one with a role enters no mean."""


ScreenedScene = TypeVar("ScreenedScene", bound=HasSceneRow)


def screen_scenes(
    scenes: Sequence[ScreenedScene],
    items: Callable[[ScreenedScene], Sequence[ScreenedItem]],
    evaluate: Callable[[ScreenedScene, ScreenedItem], Mapping[str, Row]],
    variants: Sequence[str],
    *,
    truth: str,
    metrics: Sequence[MainMetric],
    whole: Callable[[ScreenedScene, Sequence[Mapping[str, Row]]], Mapping[str, Row]] = lambda _scene, _results: {},
    finished: FinishedScenes,
    progress: Progress,
) -> Outcome:
    """Evaluate every item of every scene → rows of items and scenes, and their summary.

    Rows: one per item and variant, then one per scene and variant, in which counts are summed, ratios of a
    group (a dict) are means over the items that have them, and other numbers are medians. The summary
    is the median over scenes without a role; intervals come from resampling scenes.

    Args:
        scenes: scenes, each with a row per variant.
        items: scene → pairs or frames to evaluate.
        evaluate: scene, item → variant → numbers; a variant may be left out of an item.
        variants: their names, in order.
        truth: name of the truth, for the rows.
        metrics: main metrics of the experiment.
        whole: scene, results of ``evaluate`` on all its items → variant → numbers that replace those of the scene's
            row.
        finished: scenes of an interrupted run, of the settings.
        progress: wraps the loop over a scene's items: (items, text, number of items) → items.
    """

    def screen(scene: ScreenedScene) -> Outcome:
        part = Outcome()
        chosen = list(items(scene))
        with torch.no_grad():
            results = [evaluate(scene, item) for item in progress(chosen, scene.name, len(chosen))]
            replacements = whole(scene, results)
        scene_name = {"scene": scene.name}
        for item, result in zip(chosen, results, strict=True):
            part.rows += [{**scene_name, "pair": list(item), "method": v, "truth": truth, **result[v]} for v in result]
        for variant in variants:
            variant_results = [result[variant] for result in results if variant in result]
            row = {**scene_name, "pair": None, "method": variant, "truth": truth, "role": scene.role}
            note = {} if variant_results else {"note": "nothing to estimate"}
            part.rows.append(
                row
                | {"n_pairs": len(variant_results)}
                | note
                | _join_rows(variant_results)
                | replacements.get(variant, {})
            )
        part.n_pairs = len(chosen)
        return part

    outcome = Outcome(metrics=metrics)
    keep = finished.loop()
    for scene in scenes:
        outcome.add(keep(scene.name, partial(screen, scene)))
    outcome.summary = summarise_rows(outcome.rows, variants, [truth])
    return outcome


def paired_metric(outcome: Outcome, truth: str, first: str, second: str, metric: str) -> list[tuple[float, float]]:
    """[(first variant's metric, second variant's metric)] of scenes without a role on which both have it."""
    first_rows, second_rows = outcome.scenes(first, truth), outcome.scenes(second, truth)
    both = [
        (row.get(metric), second_rows[scene].get(metric)) for scene, row in first_rows.items() if scene in second_rows
    ]
    return [(a, b) for a, b in both if a is not None and b is not None]


def _join_rows(rows: Sequence[Row]) -> Row:
    joined: Row = {}
    for key in dict.fromkeys(k for row in rows for k in row):
        values = [row[key] for row in rows if row.get(key) is not None]
        if values and isinstance(values[0], Mapping):
            joined[key] = {k: mean_or_none([v[k] for v in values if v[k] is not None]) for k in values[0]}
        else:
            joined[key] = (sum(values) if values else 0) if key.startswith("n_") else median_or_none(values)
    return joined
