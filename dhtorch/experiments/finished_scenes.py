"""Scenes that an interrupted experiment has finished: kept in the job's folder until its result is written.

An experiment runs over the scenes in one or several *loops*. With a folder, what a scene contributes to the outcome is
written when it is finished, one file per loop and scene; the next run of the same key reads it instead of computing it.
The files hold tensors, records, numbers and texts alone and are read without executing code.
"""

import io
import pickle
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dhtorch.experiments.outcome import Example, Outcome
from dhtorch.pytree import Record
from dhtorch.records import TrackHint
from dhtorch.runtime import storage

#: Characters of the key that name the folder of a job's scenes. Source: derived, 2^-64 for two keys to agree.
_KEY_CHARACTERS = 16

#: (name of the scene, function that computes it) → outcome of the scene.
KeepScene = Callable[[str, Callable[[], Outcome]], Outcome]


@dataclass
class FinishedScenes:
    """Store of the finished scenes of one job; without a folder nothing is stored."""

    folder: Path | None = None
    key: str = ""  # of everything that determines the outcome
    reuse: bool = True  # False = scenes of an earlier run are computed again
    _n_loops: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.folder is not None and self.folder.is_dir():
            for other in self.folder.iterdir():
                if not (self.reuse and other.name == self.key[:_KEY_CHARACTERS]):
                    shutil.rmtree(other, ignore_errors=True)

    def loop(self, methods: Mapping[str, Any] | None = None) -> KeepScene:
        """Start the next loop over scenes → function that computes a scene, or reads it if it is finished.

        Args:
            methods: variant → method, of examples that are computed again for figures; methods are not stored.
        """
        number, self._n_loops = self._n_loops, self._n_loops + 1
        n_scenes = 0

        def keep(scene: str, compute: Callable[[], Outcome]) -> Outcome:
            nonlocal n_scenes
            name = f"{number}-{n_scenes}.pt"
            n_scenes += 1
            if self.folder is None:
                return compute()
            file = self.folder / self.key[:_KEY_CHARACTERS] / name
            stored = _read(file, (self.key, scene))
            if stored is not None:
                return _from_plain(stored, methods or {})
            outcome = compute()
            buffer = io.BytesIO()
            torch.save({"identity": (self.key, scene), **_to_plain(outcome)}, buffer)
            storage.replace_file(file, buffer.getvalue())
            return outcome

        return keep

    def run(self, scenes: Iterable[Any], evaluate: Callable[[Any], Outcome], **options: Any) -> Outcome:
        """Outcome of a loop that evaluates scene after scene, with these options of the record."""
        outcome, keep = Outcome(**options), self.loop()
        for scene in scenes:
            outcome.add(keep(scene.name, partial(evaluate, scene)))
        return outcome

    def remove(self) -> None:
        """Remove all scenes: the result is written."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


def _read(file: Path, identity: tuple[str, str]) -> dict[str, Any] | None:
    """Content of the file of a scene; None if there is none, or one that is damaged or of another scene."""
    if not file.is_file() or file.is_symlink():
        return None
    try:
        stored = torch.load(file, weights_only=True)
        return stored if stored.pop("identity") == identity else None
    except (RuntimeError, ValueError, KeyError, EOFError, OSError, AttributeError, pickle.UnpicklingError):
        return None


def _to_plain(outcome: Outcome) -> dict[str, Any]:
    """Rows, points and examples of a scene as values that can be stored; tensors are copied out of their batches."""
    examples = []
    for example in outcome.examples:
        plain = {f.name: _copy(getattr(example, f.name)) for f in fields(Example)}
        if example.call_options is not None:
            hint = {f.name: getattr(example.call_options["hint"], f.name) for f in fields(TrackHint)}
            hint["pyramid"] = None  # a cache
            options = {k: _copy(v) for k, v in example.call_options.items() if k not in ("method", "hint")}
            plain["call_options"] = {**options, "hint": hint}
        examples.append(plain)
    points = {key: _copy(value) for key, value in outcome.points.items()}
    return {"rows": outcome.rows, "n_pairs": outcome.n_pairs, "examples": examples, "points": points}


def _from_plain(stored: dict[str, Any], methods: Mapping[str, Any]) -> Outcome:
    examples = [Example(**plain) for plain in stored.pop("examples")]
    for k, example in enumerate(examples):
        if example.call_options is not None:
            options = {**example.call_options, "method": methods[example.method]}
            options["hint"] = TrackHint(**options["hint"])
            examples[k] = replace(example, call_options=options)
    return Outcome(examples=examples, **stored)


def _copy(value: Any) -> Any:
    return value.map(torch.clone) if isinstance(value, Record) else value
