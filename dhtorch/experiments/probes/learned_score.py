"""Question: does a score learnt from errors order answers better, in rooms it has not seen, than those made by hand?

Expectation (written after the scorer was designed on rooms of the synthetic data set): over scenes, the geometric mean
of the area under the risk–coverage curve lies below that of the paper's score and below that of
``confidence_from_error``, with both intervals below 1.
What would refute it: either ratio is 1 or more. An interval that reaches 1 leaves it undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments import protocol
from dhtorch.experiments.protocol import Batch, Method, Outcome, Progress, Protocol, ScenePairs, Settings, Variant
from dhtorch.metrics import bootstrap, risk
from dhtorch.pipeline.spec import Trace
from dhtorch.pytree import Record, collate, record
from dhtorch.records import PoseFit, Tracks
from dhtorch.stages.score import LearnedScore, confidence, confidence_from_error, expected_error_loss, score_features

QUESTION = "Does a score learnt from errors order answers better, in rooms it has not seen, than those made by hand?"
EXPECTATION = "Its AURC is lower than that of the paper's score and of rank_by_error, as a geometric mean over scenes."

#: The scores made by hand.
_HAND_MADE_SCORES = {"paper": confidence, "by_error": confidence_from_error}


@record
class LabelledAnswers(Record):
    """Answers of one scene with truth."""

    x: Tensor  # (P, 8) evidence
    error: Tensor  # (P,) relative error


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    hidden: int = 16,
    steps: int = 200,
    learning_rate: float = 0.01,
    weight_decay: float = 0.01,
    most: int = 1000,
    save: str | None = None,
    progress: Progress = protocol.no_progress,
) -> Outcome:
    """One method, its answers scored three ways; the learned score of a scene has seen the other rooms only.

    Variants ``paper``, ``by_error`` and ``learned``, whose answers differ in nothing but the score. Recordings of one
    place (``room``), and those of one folder, are one room.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method of two views; the first is asked.
        hidden, steps, learning_rate, weight_decay, most: of :func:`train_score`.
        save: file for the scorer trained on all scenes, JSON; null = none.

    Returns:
        Outcome; the summary holds ``learned.aurc_ratio`` (against the paper's score), ``by_error.aurc_ratio`` (the
        same) and ``learned.aurc_ratio_by_error``. With fewer than two rooms there is no ``learned``.

    Raises:
        ValueError: a method of several views; else as the main job.
    """
    name, method = next(iter(methods.items()))
    if method.views > 1:
        raise ValueError(f"experiment.method: found {name}, which looks at several views, expected one of two views")
    answers = _AnswerCache()
    protocol.run(scenes, Protocol({name: Variant(method)}, {"full": answers.look}), pairs, settings, progress=progress)
    options: dict[str, Any] = {"hidden": hidden, "steps": steps, "learning_rate": learning_rate}
    options |= {"weight_decay": weight_decay, "most": most}
    rooms = {scene.name: _room_name(scene) for scene in scenes_of(scenes)}
    learned = {}
    for room in dict.fromkeys(rooms.values()):
        others = {scene: lesson for scene, lesson in answers.lessons().items() if rooms[scene] != room}
        if others:
            learned[room] = train_score(list(others.values()), **options)
    given: dict[str, Callable[[Batch], Mapping[str, Any]]] = {
        "learned": lambda batch: answers.again(batch, score=learned[_room_name(batch.scene)])
    }
    given = {score: partial(answers.again, score=fn) for score, fn in _HAND_MADE_SCORES.items()} | given
    needs = {"learned": lambda scene: None if _room_name(scene) in learned else "no other room to learn from"}
    variants = {
        score: Variant(method, fit=answers.fit, given=of, needs=needs.get(score, Variant.needs))
        for score, of in given.items()
    }
    outcome = protocol.run(scenes, Protocol(variants), pairs, settings, progress=progress)
    found = compare_scores(outcome, {scene.name for scene in scenes_of(scenes) if scene.role is not None})
    outcome.summary |= {k: v.entry() for k, v in found.items()}
    if save is not None and answers.lessons():
        scorer = train_score(list(answers.lessons().values()), **options)
        scorer.provenance = {"method": name, "scenes": [*answers.lessons()], "seed": settings.seed, **options}
        scorer.save(Path(save))
    return outcome.decide(QUESTION, EXPECTATION, *verdict(found))


def train_score(
    lessons: Sequence[LabelledAnswers],
    *,
    hidden: int = 16,
    steps: int = 200,
    learning_rate: float = 0.01,
    weight_decay: float = 0.01,
    most: int = 1000,
    seed: int = 0,
) -> LearnedScore:
    """A scorer fitted to answers with truth, every scene of the same weight.

    Args:
        lessons: one a scene; empty ones are passed over.
        hidden: width of the hidden layer.
        steps, learning_rate, weight_decay: of AdamW on all answers at once, the rate falling to zero along a cosine.
        most: answers of a scene that are looked at, taken evenly.
        seed: of the first weights.

    Raises:
        ValueError: no answer in any lesson.
    """
    lessons = [v[:: max(1, -(-v.error.numel() // most))] for v in lessons if v.error.numel()]
    if not lessons:
        raise ValueError("train_score: found no answer with truth, expected some")
    every = collate(lessons)
    x, error = every.x.detach().float(), every.error.detach().float()
    weight = torch.cat([torch.full_like(v.error, 1 / v.error.numel() / len(lessons)) for v in lessons]).float()
    scorer = LearnedScore(hidden, seed=seed).to(x.device)
    scorer.mean.copy_(x.mean(0))
    scorer.spread.copy_(x.std(0).clamp_min(1e-3) if len(x) > 1 else torch.ones_like(x[0]))
    optimiser = torch.optim.AdamW(scorer.parameters(), lr=learning_rate, weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1))
    with torch.enable_grad():
        for _ in range(steps):
            optimiser.zero_grad()
            expected_error_loss(scorer.log_error(x), error, weight).backward()
            optimiser.step()
            schedule.step()
    return scorer.requires_grad_(False)


def label_answers(trace: Trace, true_depth: Tensor, counts: Tensor) -> LabelledAnswers:
    """The answers of a batch of pairs that count, with evidence and error.

    Args:
        trace: of ``extend``.
        true_depth: (B, N) m.
        counts: (B, N) bool, where it is known; other depths are not read.
    """
    x, stated = score_features(trace["estimate"], trace["samples"], trace["tracks_ideal"], trace["fit"])
    used = counts & stated
    return LabelledAnswers(x[used], ((trace["estimate"].depth - true_depth).abs() / true_depth)[used])


def compare_scores(outcome: Outcome, apart: set[str]) -> dict[str, bootstrap.Interval]:
    """Geometric means over scenes of the ratios of AURC; scenes apart and those with few answers stay out."""
    seeds: dict[str, dict[str, list[Any]]] = {}
    for (scene, variant, cohort), points in outcome.points.items():
        if cohort == "full" and scene not in apart:
            seeds.setdefault(variant, {})[scene] = [points]
    found = {}
    for name, ours, theirs in (
        ("by_error.aurc_ratio", "by_error", "paper"),
        ("learned.aurc_ratio", "learned", "paper"),
        ("learned.aurc_ratio_by_error", "learned", "by_error"),
    ):
        mine = seeds.get(ours, {})
        ratios, _ = compare.ratio_over_seeds(mine, seeds.get(theirs, {}), lambda p: risk.measure_risk(p)["aurc"])
        found[name] = bootstrap.interval_over_scenes(list(ratios.values()), statistic="geometric_mean")
    return found


def verdict(found: Mapping[str, bootstrap.Interval]) -> tuple[bool | None, str]:
    """Hold the learned score against both made by hand."""
    ratios = [found["learned.aurc_ratio"], found["learned.aurc_ratio_by_error"]]
    if any(r.value is None or r.high is None for r in ratios):
        return None, "fewer than two rooms with answers"
    shown = [f"{r.value:.3f} ({r.low:.3f}–{r.high:.3f})" for r in ratios]
    why = f"AURC {shown[0]} of the paper's score, {shown[1]} of rank_by_error's, over {ratios[0].n} scenes"
    worse, better = any(r.value >= 1 for r in ratios), all(r.high < 1 for r in ratios)  # type: ignore[operator]
    return (False if worse else True if better else None), why


class _AnswerCache:
    """What the method found in every batch, so that scoring it again does not track and pose again."""

    def __init__(self) -> None:
        self._known: dict[Any, tuple[Tracks, PoseFit]] = {}
        self._lessons: dict[str, list[LabelledAnswers]] = {}

    def look(self, batch: Batch, trace: Trace) -> Any:
        """The cohort of the range split; on the way, everything is remembered."""
        truth = protocol.held_back_truth(batch, trace)
        self._known[_batch_key(batch)] = trace["tracks"], trace["fit"]
        if batch.scene.role is None:
            self._lessons.setdefault(batch.scene.name, []).append(label_answers(trace, truth.depth, truth.ok))
        return truth

    def lessons(self) -> dict[str, LabelledAnswers]:
        """Scene → its answers with truth, scenes without any left out."""
        joined = {scene: collate(parts) for scene, parts in self._lessons.items()}
        return {scene: whole for scene, whole in joined.items() if whole.error.numel()}

    def fit(self, batch: Batch, _n: int) -> PoseFit:
        """The pose that was found."""
        return self._known[_batch_key(batch)][1]

    def again(self, batch: Batch, score: Any) -> dict[str, Any]:
        """Options that give the same answers with another score."""
        tracks = self._known[_batch_key(batch)][0]
        return {"track": lambda *_, **__: tracks, "score": score}


def _batch_key(batch: Batch) -> tuple[str, tuple[tuple[int, int], ...]]:
    return batch.scene.name, tuple(to_fixed_pairs(batch.pairs))


def _room_name(scene: Scene) -> str:
    return scene.room or scene.name.split("/")[0]
