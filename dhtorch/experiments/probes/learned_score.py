"""Question: does a score trained on errors rank answers better than the analytic ones, in rooms not trained on?

Expectation (written after the scorer was designed on rooms of the synthetic data set): over scenes, the geometric mean
of the area under the risk–coverage curve lies below that of the paper's score and below that of
``confidence_from_error``, with both intervals below 1.
What would refute it: either ratio is 1 or more. An interval that reaches 1 leaves it undecided.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.protocol import (
    Batch,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    held_back_truth,
    no_progress,
    run_protocol,
)
from dhtorch.metrics import bootstrap, risk
from dhtorch.pipeline.spec import Trace
from dhtorch.pytree import Record, collate, record
from dhtorch.records import PoseFit, Tracks
from dhtorch.stages.score import LearnedScore, confidence, confidence_from_error, expected_error_loss, score_features

#: Hand-designed scores: variant → function.
_HAND_MADE_SCORES = {"paper": confidence, "by_error": confidence_from_error}


@record
class LabelledAnswers(Record):
    """Score features and relative errors of the answers of one scene that have ground truth."""

    x: Tensor  # (P, 8) features of the score
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
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: answers of one method with three scores; the learned score is cross-validated over rooms.

    The answers of the variants ``paper``, ``by_error`` and ``learned`` differ only in the score. Recordings of one
    place (``room``), and those of one folder, are one room.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method of two views; the first is run.
        hidden, steps, learning_rate, weight_decay, most: of :func:`train_score`.
        save: file for the scorer trained on all scenes, JSON; null = none.

    Returns:
        Outcome; the summary holds ``learned.aurc_ratio`` (to the paper's score), ``by_error.aurc_ratio``
        (likewise) and ``learned.aurc_ratio_by_error``. With fewer than two rooms there is no ``learned``.

    Raises:
        ValueError: a method of several views; otherwise as the main job.
    """
    name, method = next(iter(methods.items()))
    if method.views > 1:
        raise ValueError(f"experiment.method: found {name}, a method of several views, expected a method of two views")
    answers = _AnswerCache()
    all_scenes = replace(settings, finished=FinishedScenes())  # the answers of every scene are needed in memory
    first = Protocol({name: Variant(method)}, {"full": answers.store})
    run_protocol(scenes, first, pairs, all_scenes, progress=progress)
    options: dict[str, Any] = {"hidden": hidden, "steps": steps, "learning_rate": learning_rate}
    options |= {"weight_decay": weight_decay, "most": most}
    rooms = {scene.name: _room_name(scene) for scene in scenes_of(scenes)}
    learned = {}
    for room in dict.fromkeys(rooms.values()):
        training_answers = {scene: labelled for scene, labelled in answers.labelled().items() if rooms[scene] != room}
        if training_answers:
            learned[room] = train_score(list(training_answers.values()), **options)
    options_by_score: dict[str, Callable[[Batch], Mapping[str, Any]]] = {
        "learned": lambda batch: answers._rescore(batch, score=learned[_room_name(batch.scene)])
    }
    options_by_score = {
        score: partial(answers._rescore, score=fn) for score, fn in _HAND_MADE_SCORES.items()
    } | options_by_score
    needs = {"learned": lambda scene: None if _room_name(scene) in learned else "no other room to learn from"}
    variants = {
        score: Variant(method, fit=answers.fit, call_options=make_options, needs=needs.get(score, Variant.needs))
        for score, make_options in options_by_score.items()
    }
    outcome = run_protocol(scenes, Protocol(variants), pairs, settings, progress=progress)
    ratios = _compare_scores(outcome, {scene.name for scene in scenes_of(scenes) if scene.role is not None})
    outcome.summary |= {k: v.entry() for k, v in ratios.items()}
    if save is not None and answers.labelled():
        scorer = train_score(list(answers.labelled().values()), **options)
        scorer.provenance = {"method": name, "scenes": [*answers.labelled()], "seed": settings.seed, **options}
        scorer.save(Path(save))
    return outcome.decide(
        "Does a score trained on errors rank answers better than the analytic ones, in rooms not trained on?",
        "Its AURC is lower than that of the paper's score and of rank_by_error, as a geometric mean over scenes.",
        *verdict(ratios),
    )


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
    """Train a scorer on answers with ground truth; every scene has the same weight.

    Args:
        lessons: answers of each scene; empty ones are skipped.
        hidden: width of the hidden layer.
        steps, learning_rate, weight_decay: of AdamW, full batch; the learning rate decays to zero along a cosine.
        most: largest number of answers of a scene, evenly spaced.
        seed: of the initial weights.

    Raises:
        ValueError: no answer in any scene.
    """
    lessons = [
        labelled[:: max(1, -(-labelled.error.numel() // most))] for labelled in lessons if labelled.error.numel()
    ]
    if not lessons:
        raise ValueError("train_score: found no answer with ground truth, expected at least one")
    answers = collate(lessons)
    x, error = answers.x.detach().float(), answers.error.detach().float()
    weight = torch.cat(
        [torch.full_like(labelled.error, 1 / labelled.error.numel() / len(lessons)) for labelled in lessons]
    ).float()
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
    """Score features and relative errors of the answers of a batch that have ground truth.

    Args:
        trace: of ``extend``.
        true_depth: (B, N) m.
        counts: (B, N) bool, where ``true_depth`` is valid; other depths are not read.
    """
    x, answered = score_features(trace["estimate"], trace["samples"], trace["tracks_ideal"], trace["fit"])
    used = counts & answered
    return LabelledAnswers(x[used], ((trace["estimate"].depth - true_depth).abs() / true_depth)[used])


def _compare_scores(outcome: Outcome, apart: set[str]) -> dict[str, bootstrap.Interval]:
    """Geometric means over scenes of AURC ratios; scenes in ``apart`` and those with few answers are left out."""
    seeds: dict[str, dict[str, list[Any]]] = {}
    for (scene, variant, cohort), points in outcome.points.items():
        if cohort == outcome.cohort and scene not in apart:
            seeds.setdefault(variant, {})[scene] = [points]
    intervals = {}
    for name, ours, theirs in (
        ("by_error.aurc_ratio", "by_error", "paper"),
        ("learned.aurc_ratio", "learned", "paper"),
        ("learned.aurc_ratio_by_error", "learned", "by_error"),
    ):
        own_points = seeds.get(ours, {})
        ratios, _ = compare.ratio_over_seeds(own_points, seeds.get(theirs, {}), lambda p: risk.measure_risk(p)["aurc"])
        intervals[name] = bootstrap.interval_over_scenes(list(ratios.values()), statistic="geometric_mean")
    return intervals


def verdict(intervals: Mapping[str, bootstrap.Interval]) -> tuple[bool | None, str]:
    """Verdict and text from the AURC ratios of the learned score to both hand-designed scores."""
    ratios = [intervals["learned.aurc_ratio"], intervals["learned.aurc_ratio_by_error"]]
    if any(ratio.value is None or ratio.high is None for ratio in ratios):
        return None, "fewer than two rooms with answers"
    texts = [f"{ratio.value:.3f} ({ratio.low:.3f}–{ratio.high:.3f})" for ratio in ratios]
    why = f"AURC {texts[0]} of the paper's score, {texts[1]} of rank_by_error's, over {ratios[0].n} scenes"
    worse, better = any(ratio.value >= 1 for ratio in ratios), all(ratio.high < 1 for ratio in ratios)  # type: ignore[operator]
    return (False if worse else True if better else None), why


class _AnswerCache:
    """Tracks and pose of every batch, reused by the other scores."""

    def __init__(self) -> None:
        self._fits: dict[Any, tuple[Tracks, PoseFit]] = {}
        self._answers: dict[str, list[LabelledAnswers]] = {}

    def store(self, batch: Batch, trace: Trace) -> Any:
        """Ground truth of the held-out returns of a batch; stores its tracks, pose and labelled answers."""
        truth = held_back_truth(batch, trace)
        self._fits[_batch_key(batch)] = trace["tracks"], trace["fit"]
        if batch.scene.role is None:
            self._answers.setdefault(batch.scene.name, []).append(label_answers(trace, truth.depth, truth.ok))
        return truth

    def labelled(self) -> dict[str, LabelledAnswers]:
        """Scene → its labelled answers; scenes without any are left out."""
        joined = {scene: collate(parts) for scene, parts in self._answers.items()}
        return {scene: labelled for scene, labelled in joined.items() if labelled.error.numel()}

    def fit(self, batch: Batch, _n: int) -> PoseFit:
        """Stored pose of a batch."""
        return self._fits[_batch_key(batch)][1]

    def _rescore(self, batch: Batch, score: Any) -> dict[str, Any]:
        """Options of the method that reuse the stored tracks with another score."""
        tracks = self._fits[_batch_key(batch)][0]
        return {"track": lambda *_, **__: tracks, "score": score}


def _batch_key(batch: Batch) -> tuple[str, tuple[tuple[int, int], ...]]:
    """Key of a batch: scene and pairs of frames."""
    return batch.scene.name, tuple(to_fixed_pairs(batch.pairs))


def _room_name(scene: Scene) -> str:
    """Room of a scene, or the first folder of its name."""
    return scene.room or scene.name.split("/")[0]
