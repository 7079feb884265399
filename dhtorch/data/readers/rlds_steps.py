"""What an RLDS episode holds beside what a recording reads: actions, states, texts, every picture as it is encoded.

Values come step by step, few at a time, as they are stored; a feature whose sizes are not said, or that is kept as
encoded bytes, cannot be told from others and is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dhtorch.data.codecs import tfrecord
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import rlds
from dhtorch.data.recording import Recording

_STEPS, _EPISODE = "steps/", "episode_metadata/"

#: Texts that say what is to be done, the likeliest first.
_INSTRUCTION_FEATURES = ("language_instruction", "natural_language_instruction", "instruction", "task")


@dataclass(frozen=True)
class EpisodeSteps:
    """The steps of one episode."""

    place: rlds.RecordLocation
    n: int
    features: Mapping[str, rlds.StepFeature]  # those that can be read
    found: Mapping[str, tfrecord.ExampleFeature]  # of the record
    numbers: dict[str, np.ndarray] = field(default_factory=dict)  # that can only be read all at once

    @classmethod
    def of(cls, recording: Recording) -> EpisodeSteps:
        """Those of the episode that a recording belongs to.

        Raises:
            FormatError: a damaged record, or a feature of another length.
            ValueError: a recording of another format.
        """
        load = recording.load
        if not isinstance(load, rlds.LoadStep):
            raise ValueError(f"{recording.name}: found {recording.format}, expected rlds")
        body = tfrecord.read_record(load.place.file, load.place.span)
        found = tfrecord.parse_example(body, load.place.file, load.place.span.offset)
        n = len(load.images)
        there = {name: f for name, f in load.features.items() if _is_readable(f) and f"{_STEPS}{name}" in found}
        for name, feature in there.items():
            spans = found[f"{_STEPS}{name}"].spans
            if feature.kind != "tensor" and len(spans) != n:
                raise FormatError(load.place.file, name, f"{len(spans)} values", f"{n}, one a step")
        return cls(load.place, n, there, found)

    @property
    def instruction(self) -> str | None:
        """The text that says what is to be done."""
        texts = [name for name, f in self.features.items() if f.kind == "text"]
        known = [name for end in _INSTRUCTION_FEATURES for name in texts if name.rpartition("/")[2] == end]
        return known[0] if known else None

    def values(self, name: str, steps: range) -> list[Any] | np.ndarray:
        """Of some steps in a row: encoded pictures, texts, or numbers (steps, size) as they are stored.

        Raises:
            FormatError: damaged.
        """
        feature, described = self.found[f"{_STEPS}{name}"], self.features[name]
        if described.kind == "tensor":
            return self._numbers(name, steps)
        content = tfrecord.read_spans(self.place.file, [feature.spans[i] for i in steps])
        return content if described.kind == "image" else [text.decode("utf-8", "replace") for text in content]

    def _numbers(self, name: str, steps: range) -> np.ndarray:
        feature, described = self.found[f"{_STEPS}{name}"], self.features[name]
        size = int(np.prod(described.shape))
        packed = feature.kind == "float" and len(feature.spans) == 1
        if packed and feature.spans[0].length == 4 * size * self.n:
            at = feature.spans[0].offset + 4 * size * steps.start
            data = tfrecord.read_span(self.place.file, tfrecord.ByteSpan(at, 4 * size * len(steps)))
            read = np.frombuffer(data, "<f4")
        else:
            read = self._whole(name, feature, size)[size * steps.start : size * steps.stop]
        return read.astype(described.dtype).reshape(len(steps), size)

    def _whole(self, name: str, feature: tfrecord.ExampleFeature, size: int) -> np.ndarray:
        """The numbers of all steps, decoded once."""
        if name not in self.numbers:
            whole = tfrecord.read_feature_numbers(self.place.file, name, feature, size * self.n)
            if len(whole) != size * self.n:
                raise FormatError(self.place.file, name, f"{len(whole)} numbers", f"{size} for each of {self.n} steps")
            self.numbers[name] = whole.astype(self.features[name].dtype)
        return self.numbers[name]

    @property
    def about(self) -> dict[str, Any]:
        """What the record says of the whole episode, texts and numbers alone."""
        said: dict[str, Any] = {"split": self.place.split, "number": self.place.number}
        for name, feature in self.found.items():
            if not name.startswith(_EPISODE):
                continue
            if feature.kind == "bytes":
                values: list[Any] = [
                    tfrecord.read_span(self.place.file, s) for s in feature.spans if s.length < 1 << 16
                ]
                values = [v.decode("utf-8", "replace") for v in values]
            else:
                values = tfrecord.read_feature_numbers(self.place.file, name, feature, 1 << 16).tolist()
            said[name.removeprefix(_EPISODE)] = values[0] if len(values) == 1 else values
        return said


def _is_readable(feature: rlds.StepFeature) -> bool:
    if feature.kind != "tensor":
        return True
    known = feature.dtype in (
        "bool",
        "float32",
        "float64",
        "float16",
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
    )
    return known and not feature.encoded and all(size > 0 for size in feature.shape)
