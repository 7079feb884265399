"""Steps of an RLDS episode beyond its recordings: actions, states, texts and images in their stored encoding.

Values are read for a range of steps at a time, as they are stored. Features without a stated shape, or stored as
encoded bytes, cannot be decoded and are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dhtorch.data.codecs import tfrecord
from dhtorch.data.io.decode import refuse_if
from dhtorch.data.readers import rlds
from dhtorch.data.recording import Recording

_STEPS, _EPISODE = "steps/", "episode_metadata/"

#: Text features that hold the task's instruction, most common first.
_INSTRUCTION_FEATURES = ("language_instruction", "natural_language_instruction", "instruction", "task")


#: Types of numbers, as TFDS names them.
_NUMERIC = ("bool", "float32", "float64", "float16", "int8", "int16", "int32", "int64", "uint8", "uint16")


@dataclass(frozen=True)
class EpisodeSteps:
    """The features of one episode's steps, read from its record."""

    place: rlds.RecordLocation
    n: int
    features: Mapping[str, rlds.StepFeature]  # the readable ones
    parsed: Mapping[str, tfrecord.ExampleFeature]  # parsed record
    numbers: dict[str, np.ndarray] = field(default_factory=dict)  # cache of features that must be decoded whole

    @classmethod
    def of(cls, recording: Recording) -> "EpisodeSteps":
        """The steps of a recording's episode.

        Raises:
            FormatError: a damaged record, or a feature of another length.
            ValueError: a recording of another format.
        """
        load = recording.load
        if not isinstance(load, rlds.LoadStep):
            raise ValueError(f"{recording.name}: found {recording.format}, expected rlds")
        body = tfrecord.read_record(load.place.file, load.place.span)
        example = tfrecord.parse_example(body, load.place.file, load.place.span.offset)
        n = len(load.images)
        readable = {}
        for name, feature in load.features.items():
            is_array = not feature.encoded and all(size > 0 for size in feature.shape) and feature.dtype in _NUMERIC
            if f"{_STEPS}{name}" in example and (feature.kind != "tensor" or is_array):
                readable[name] = feature
        for name, feature in readable.items():
            spans = example[f"{_STEPS}{name}"].spans
            refuse_if(
                feature.kind != "tensor" and len(spans) != n,
                load.place.file,
                name,
                f"{len(spans)} values",
                f"{n}, one a step",
            )
        return cls(load.place, n, readable, example)

    @property
    def instruction(self) -> str | None:
        """Name of the text feature with the task's instruction; None where there is none."""
        texts = [name for name, f in self.features.items() if f.kind == "text"]
        instructions = [name for ending in _INSTRUCTION_FEATURES for name in texts if name.rpartition("/")[2] == ending]
        return instructions[0] if instructions else None

    def values(self, name: str, steps: range) -> list[Any] | np.ndarray:
        """Values of a range of steps: encoded images, texts, or numbers (steps, size) in the stored type.

        Raises:
            FormatError: a damaged record.
        """
        feature, described = self.parsed[f"{_STEPS}{name}"], self.features[name]
        if described.kind == "tensor":
            return self._numbers(name, steps)
        content = tfrecord.read_spans(self.place.file, [feature.spans[i] for i in steps])
        return content if described.kind == "image" else [text.decode("utf-8", "replace") for text in content]

    def _numbers(self, name: str, steps: range) -> np.ndarray:
        feature, described = self.parsed[f"{_STEPS}{name}"], self.features[name]
        size = int(np.prod(described.shape))
        packed = feature.kind == "float" and len(feature.spans) == 1
        if packed and feature.spans[0].length == 4 * size * self.n:
            at = feature.spans[0].offset + 4 * size * steps.start
            data = tfrecord.read_span(self.place.file, tfrecord.ByteSpan(at, 4 * size * len(steps)))
            values = np.frombuffer(data, "<f4")
        else:
            # The numbers of all steps (n · size), decoded once and cached
            if name not in self.numbers:
                whole = tfrecord.read_feature_numbers(self.place.file, name, feature, size * self.n)
                refuse_if(
                    len(whole) != size * self.n,
                    self.place.file,
                    name,
                    f"{len(whole)} numbers",
                    f"{size} for each of {self.n} steps",
                )
                self.numbers[name] = whole.astype(self.features[name].dtype)
            values = self.numbers[name][size * steps.start : size * steps.stop]
        return values.astype(described.dtype).reshape(len(steps), size)

    @property
    def about(self) -> dict[str, Any]:
        """Metadata of the whole episode: split, number, and the record's texts and numbers."""
        metadata: dict[str, Any] = {"split": self.place.split, "number": self.place.number}
        for name, feature in self.parsed.items():
            if not name.startswith(_EPISODE):
                continue
            if feature.kind == "bytes":
                values: list[Any] = [
                    tfrecord.read_span(self.place.file, s) for s in feature.spans if s.length < 1 << 16
                ]
                values = [v.decode("utf-8", "replace") for v in values]
            else:
                values = tfrecord.read_feature_numbers(self.place.file, name, feature, 1 << 16).tolist()
            metadata[name.removeprefix(_EPISODE)] = values[0] if len(values) == 1 else values
        return metadata
