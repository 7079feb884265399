"""The loop of an experiment whose estimator is no method: items of a scene in, rows of every variant out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

import torch

from dhtorch.experiments.protocol import Outcome, Progress
from dhtorch.experiments.rows import Row, mean_or_none, median_or_none, summarise_rows

#: A pair of frames, or a frame alone as (i, i).
ScreenedItem = tuple[int, int]


class HasSceneRow(Protocol):
    """What has a row of its own in a result."""

    @property
    def name(self) -> str:
        """Of the row."""

    @property
    def role(self) -> str | None:
        """Not None: enters no mean."""


ScreenedScene = TypeVar("ScreenedScene", bound=HasSceneRow)


def screen_scenes(
    scenes: Sequence[ScreenedScene],
    items: Callable[[ScreenedScene], Sequence[ScreenedItem]],
    ask: Callable[[ScreenedScene, ScreenedItem], Mapping[str, Row]],
    variants: Sequence[str],
    *,
    truth: str,
    whole: Callable[[ScreenedScene, Sequence[Mapping[str, Row]]], Mapping[str, Row]] = lambda _scene, _found: {},
    progress: Progress,
) -> Outcome:
    """Ask every item of every scene, one after the other.

    Rows: one per item and variant, then one per scene and variant, in which counts are added up and everything else
    is joined: shares of a group (a dict) by mean over the items that have them, other numbers by median. The summary
    is the median over scenes without a role; intervals come from resampling scenes.

    Args:
        scenes: what there is a row for.
        items: scene → what to ask.
        ask: scene, item → variant → numbers; a variant that is left out has nothing to say there.
        variants: their names, in order.
        truth: what the numbers are held against, for the rows.
        whole: scene, all that ``ask`` found there → variant → numbers of the scene, in place of the joined ones.
        progress: wraps the loop over a scene's items: (items, text, number of items) → items.
    """
    outcome = Outcome()
    for scene in scenes:
        chosen = list(items(scene))
        with torch.no_grad():
            found = [ask(scene, item) for item in progress(chosen, scene.name, len(chosen))]
            over = whole(scene, found)
        name = {"scene": scene.name}
        for item, answer in zip(chosen, found, strict=True):
            outcome.rows += [{**name, "pair": list(item), "method": v, "truth": truth, **answer[v]} for v in answer]
        for variant in variants:
            mine = [answer[variant] for answer in found if variant in answer]
            row = {**name, "pair": None, "method": variant, "truth": truth, "role": scene.role}
            note = {} if mine else {"note": "nothing to ask"}
            outcome.rows.append(row | {"n_pairs": len(mine)} | note | _join_rows(mine) | over.get(variant, {}))
        outcome.n_pairs += len(chosen)
    outcome.summary = summarise_rows(outcome.rows, variants, [truth])
    return outcome


def paired_metric(outcome: Outcome, truth: str, first: str, second: str, metric: str) -> list[tuple[float, float]]:
    """A metric of two variants on the scenes without a role on which both have it."""
    one, other = outcome.scenes(first, truth), outcome.scenes(second, truth)
    both = [(row.get(metric), other[scene].get(metric)) for scene, row in one.items() if scene in other]
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
