"""A confidence trained end to end, on the area under the risk–coverage curve, against the analytic ones.

    python benchmarks/learning/learned_confidence.py                     the built-in rooms, one seed
    python benchmarks/learning/learned_confidence.py --data rooms shared_scenes --seeds 0 1 2 --json FILE

``MAP`` answers pairs whose far returns are hidden, so that the answers have a known error. Four scores order them:

- ``paper``: from parallax and residual, ``stages.score.confidence``;
- ``by_error``: the expected error, ``stages.score.confidence_from_error``, which ``MAP`` uses;
- ``regressed``: ``LearnedScore`` trained to predict the error, as ``dhtorch experiment=learned_score`` does;
- ``by_risk``: the same network from the same start, trained on what it is measured by: the mean over scenes of the
  logarithm of ``losses.risk_coverage_loss``.

A scene is scored by networks trained on other rooms. No stage before the score has weights, so that answers are
computed once. Measured is the area under the risk–coverage curve (AURC), as a ratio to that of ``by_error``. Learning
rate and temperature were chosen on the built-in rooms, which share one layout; the shared scenes, below DHTORCH_DATA,
decide.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import MAP, Method, data
from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.experiments import protocol
from dhtorch.experiments.probes.learned_score import LabelledAnswers, label_answers, train_score
from dhtorch.functional import risk_coverage_loss
from dhtorch.metrics import bootstrap, risk
from dhtorch.pytree import collate
from dhtorch.runtime import storage
from dhtorch.stages.score import SCORE_FEATURES, LearnedScore
from dhtorch.synthetic import open_room

#: Fewest answers with truth of a scene that enters: an area of fewer is noise.
FEWEST = 50


def open_scenes(name: str) -> Sequence[Scene]:
    """Scenes: the built-in room of several seeds, or those of ``conf/data/shared_scenes.yaml`` below DHTORCH_DATA."""
    if name == "rooms":
        paths = ("walk", "orbit", "lateral", "forward")
        options: dict[str, Any] = {"n_frames": 14, "hw": (240, 320), "step_m": 0.03, "gap": 6}
        return [open_room(seed=k, path=path, name=f"room_{k}_{path}", **options) for k, path in enumerate(paths)]
    from omegaconf import OmegaConf

    settings = OmegaConf.load(Path(__file__).resolve().parents[2] / "conf/data" / f"{name}.yaml")
    scenes = OmegaConf.to_container(settings.scenes)
    return [scene for scene in data.open_scenes(None, scenes) if scene.role is None]


def label_scenes(scenes: Sequence[Scene], method: Method, stride: int | None = None) -> dict[str, LabelledAnswers]:
    """Scene → evidence and errors of its answers that have truth."""
    labelled: dict[str, list[LabelledAnswers]] = {}

    def store(batch: protocol.Batch, trace: Any) -> Any:
        truth = protocol.held_back_truth(batch, trace)
        labelled.setdefault(batch.scene.name, []).append(label_answers(trace, truth.depth, truth.ok))
        return truth

    plan = protocol.Protocol({"map": protocol.Variant(method)}, {"full": store})
    protocol.run(scenes, plan, lambda scene: by_gap(scene, stride=stride), protocol.Settings())
    joined = {name: collate(parts) for name, parts in labelled.items()}
    return {name: answers for name, answers in joined.items() if answers.error.numel() >= FEWEST}


def train_by_risk(
    lessons: Sequence[LabelledAnswers],
    seed: int,
    *,
    steps: int = 200,
    size: int = 400,
    learning_rate: float = 0.01,
    temperature: float = 0.1,
) -> LearnedScore:
    """A learned score whose order minimises the mean logarithm of the areas of scenes; starts at the analytic score."""
    scorer = train_score(lessons, steps=0, seed=seed).requires_grad_()
    draw = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(scorer.parameters(), lr=learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1))
    for _ in range(steps):
        sets = [answers[torch.randint(answers.error.numel(), (size,), generator=draw)] for answers in lessons]
        x, error = torch.stack([s.x for s in sets]), torch.stack([s.error for s in sets])
        area = risk_coverage_loss(-scorer.log_error(x), error, temperature=temperature)
        optimiser.zero_grad()
        area.clamp_min(1e-6).log().mean().backward()
        optimiser.step()
        schedule.step()
    return scorer.requires_grad_(False)


def analytic_scores(x: Tensor) -> dict[str, Tensor]:
    """The scores without weights, of the evidence (P, 8)."""
    evidence = dict(zip(SCORE_FEATURES, x.exp().unbind(-1), strict=True))
    parallax, residual = evidence["parallax_deg"], evidence["residual_px"]
    paper = parallax / (parallax + 2.0) * (1 - residual / 3.0).clamp_min(0)
    return {"paper": paper, "by_error": -x[:, 0]}


def area(answers: LabelledAnswers, score: Tensor) -> float:
    """Area under the risk–coverage curve of a score."""
    return float(risk.risk_curve(risk.cap_error(answers.error), score).mean())


def measure(labelled: Mapping[str, LabelledAnswers], rooms: Mapping[str, str], seed: int, steps: int) -> dict[str, Any]:
    """Scene → score → AURC, learned scores trained on the scenes of the other rooms."""
    areas: dict[str, dict[str, float]] = {}
    for room in dict.fromkeys(rooms[name] for name in labelled):
        lessons = [answers for name, answers in labelled.items() if rooms[name] != room]
        learned = {"regressed": train_score(lessons, seed=seed, steps=steps)}
        learned["by_risk"] = train_by_risk(lessons, seed, steps=steps)
        for name in (name for name in labelled if rooms[name] == room):
            answers = labelled[name]
            scores = analytic_scores(answers.x) | {k: -scorer.log_error(answers.x) for k, scorer in learned.items()}
            areas[name] = {k: area(answers, score) for k, score in scores.items()}
    return areas


def compare(areas: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, Any]:
    """AURC of seeds, scenes and scores → ratios to the analytic score, with intervals over scenes."""
    summary: dict[str, Any] = {}
    pairs = [(score, "by_error") for score in ("paper", "regressed", "by_risk")]
    for score, other in (*pairs, ("by_risk", "regressed")):
        ratio = torch.tensor([[a[score] / a[other] for a in of_seed.values()] for of_seed in areas]).log()
        over_scenes = bootstrap.interval_over_scenes(ratio.mean(0).exp().tolist(), statistic="geometric_mean")
        name = f"{score}.aurc_ratio" + ("" if other == "by_error" else f"_{other}")
        summary[name] = over_scenes.entry() | {"of_seeds": ratio.mean(1).exp().tolist()}
    return summary


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", nargs="+", choices=("rooms", "shared_scenes"), default=["rooms"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of weights and subsets")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--json", type=Path, help="result file")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in args.data:
        scenes = open_scenes(name)
        labelled = label_scenes(scenes, MAP)
        rooms = {scene.name: scene.room or scene.name.split("/")[0] for scene in scenes}
        areas = [measure(labelled, rooms, seed, args.steps) for seed in args.seeds]
        answers = {scene: found.error.numel() for scene, found in labelled.items()}
        row = {"data": name, "answers": answers, "rooms": len({rooms[scene] for scene in labelled})}
        rows.append(row | compare(areas) | {"aurc": areas, "seeds": args.seeds, "steps": args.steps})
        for key, entry in rows[-1].items():
            if "aurc_ratio" in key:
                print(f"{name:14} {key:30} {entry['value']:.3f} ({entry['low']:.3f}–{entry['high']:.3f})", flush=True)
    if args.json is not None:
        storage.write_json(args.json, rows)


if __name__ == "__main__":
    main()
