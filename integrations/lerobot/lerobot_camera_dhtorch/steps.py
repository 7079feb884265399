"""Processor steps of LeRobot that compute depth, validate it and make inputs for policies of it.

A step that needs two views takes them from a window of frames in the batch (training, ``delta_timestamps``), or keeps
the frames of the running episode (a robot, one frame a call); both give the same numbers. A batch that has the columns
already, from a data loader, passes unchanged.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import DataProcessorPipeline, ProcessorStep, ProcessorStepRegistry, TransitionKey
from torch import Tensor

from dhtorch import CameraPin, ExtendDepth
from dhtorch.functional import geometry_image, point_cloud
from dhtorch.geometry.camera import resize, to_matrix
from dhtorch.records import Camera, Frame
from dhtorch.transforms import SampleError, SampleSpec, ValidateDepth, declared_depth_range, declared_depth_unit
from lerobot_camera_dhtorch.window import FrameWindow

#: Description of what passes through a pipeline, as :meth:`ProcessorStep.transform_features` takes it.
Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]

#: Key → kind and shape of what a step adds.
Shapes = dict[str, tuple[FeatureType, tuple[int, ...]]]

#: Start of added keys: LeRobot's processors keep what starts with ``observation.``.
PREFIX = "observation.dh_"

#: Depth units of LeRobot's data sets -> units per metre.
UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}

#: LeRobot's step before which pictures and depth have their own units.
NORMALIZER = "normalizer_processor"


def insert_steps(
    pipeline: DataProcessorPipeline, *, before: Sequence[ProcessorStep] = (), after: Sequence[ProcessorStep] = ()
) -> None:
    """Insert steps around the normaliser of a policy's preprocessor."""
    names = [getattr(type(step), "_registry_name", "") for step in pipeline.steps]
    at = names.index(NORMALIZER)
    pipeline.steps = [*pipeline.steps[:at], *before, pipeline.steps[at], *after, *pipeline.steps[at + 1 :]]


class _DepthStep(ProcessorStep):
    """Base of steps that change observations; options of the constructor are the saved configuration."""

    def __init__(self, **config: Any) -> None:
        self.config = config

    def get_config(self) -> dict[str, Any]:
        return self.config

    def __call__(self, transition: Any) -> Any:
        observation = transition.get(TransitionKey.OBSERVATION)
        if observation is None:
            return transition
        return self._process({**transition, TransitionKey.OBSERVATION: dict(observation)})

    def _process(self, transition: Any) -> Any:
        """Transition with an observation that may be changed -> the result."""
        raise NotImplementedError

    def transform_features(self, features: Features) -> Features:
        shapes = self._added(features.get(PipelineFeatureType.OBSERVATION, {}))
        added = {key: PolicyFeature(kind, shape) for key, (kind, shape) in shapes.items()}
        observation = {**features.get(PipelineFeatureType.OBSERVATION, {}), **added}
        return {**features, PipelineFeatureType.OBSERVATION: observation}

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        """Features of the observation -> key, kind and shape of the added ones."""
        return {}


class _WindowStep(_DepthStep):
    """Base of steps that look at two frames: those of a window, or the newest and the one ``gap`` places before.

    Args:
        image, depth: keys of picture and depth map.
        intrinsics: fx, fy, cx, cy or the nine numbers of K, px of the picture; or the key under which they stand.
        depth_unit: of the data set's depth, ``m`` or ``mm``; :meth:`from_dataset` reads it from the metadata.
        camera_unit: of maps of whole numbers, as LeRobot's cameras give them; they are converted to the data set's
            unit, also for the steps that follow.
        gap: frames between the two views.
        prefix: of added keys; two cameras have two steps with different ones.
        options: of the transform.
    """

    transform_class: type[ExtendDepth] | type[ValidateDepth]
    done_key: str  # of the added keys: it stands in a sample that a data loader has extended

    def __init__(
        self,
        *,
        image: str,
        depth: str,
        intrinsics: str | Sequence[float],
        depth_unit: str,
        camera_unit: str = "mm",
        gap: int = 1,
        prefix: str = PREFIX,
        options: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> None:
        intrinsics = intrinsics if isinstance(intrinsics, str) else [float(x) for x in intrinsics]
        views = {"image": image, "depth": depth, "intrinsics": intrinsics, "depth_unit": depth_unit}
        more |= {"camera_unit": camera_unit, "gap": gap, "prefix": prefix, "options": dict(options or {})}
        super().__init__(**views, **more)
        self.single = self.transform_class(**views, batched=False, prefix=prefix, **(options or {}))
        self.prefix = prefix
        self.views, self.camera = self.single.views, SampleSpec(depth_unit=camera_unit)
        self.keys = self.views.keys()
        self.window = FrameWindow(gap)
        self.place = (-1, -1)  # episode and index of the last frame, as far as the batch states them

    @classmethod
    def from_dataset(cls, dataset: Any, image: str, depth: str | None = None, **more: Any) -> Any:
        """A step for a LeRobot data set, with unit, range and intrinsics as its metadata and columns state them.

        Intrinsics that differ between frames stay a key, which a robot's observation then needs, too.

        Raises:
            ValueError: the data set states no unit or no intrinsics.
        """
        depth = f"{image}_depth" if depth is None else depth
        file = Path(dataset.root) / "meta" / "intrinsics.json"
        lens = json.loads(file.read_text()).get(image, {}) if file.is_file() else {}
        keys = (f"observation.{image.removeprefix('observation.images.')}.intrinsics", f"{image}.intrinsics")
        key = next((key for key in keys if key in dataset.meta.features), None)
        K = np.ravel(lens["K"]).tolist() if "K" in lens and key is None else key
        K = more.pop("intrinsics", K)
        if K is None:
            raise ValueError(f"found no feature {' or '.join(keys)}, expected one, or intrinsics=[fx, fy, cx, cy]")
        if isinstance(K, str):
            stats = dataset.meta.stats.get(K, {})
            if "min" in stats and np.array_equal(stats["min"], stats["max"]):  # one camera: a robot need not state it
                K = dataset[0][K].tolist()
        stated = {"distortion": lens.get("dist"), "depth_intrinsics": np.ravel(lens.get("K_depth", ())).tolist()}
        declared = _declared_depth(dataset, depth)
        unit = declared.pop("depth_unit")
        options = {**{name: x for name, x in stated.items() if x}, **declared, **(more.pop("options", None) or {})}
        return cls(image=image, depth=depth, intrinsics=K, depth_unit=unit, options=options, **more)

    def _process(self, transition: Any) -> Any:
        observation = transition[TransitionKey.OBSERVATION]
        if self.prefix + self.done_key in observation:
            return transition
        observation[self.views.depth] = self._in_unit(torch.as_tensor(observation[self.views.depth]))
        image = torch.as_tensor(observation[self.views.image])
        if image.ndim == 5:
            flags = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
            sample = {key: observation[key] for key in self.keys if key in observation}
            sample |= {key: flags[key] for key in [f"{self.views.image}_is_pad"] if key in flags}
            rows = [self._row({key: x[i] for key, x in sample.items()}) for i in range(len(image))]
            added = torch.utils.data.default_collate(rows)
        else:
            added = self._newest(image, transition)
        return self._finish(transition, added)

    def _newest(self, image: Tensor, transition: Any) -> dict[str, Tensor]:
        """Added keys of the newest frame of the running episode."""
        if image.ndim == 4 and len(image) != 1:
            raise SampleError(
                f"{self.views.image}: found {len(image)} frames without a window, expected one frame of a running "
                f"episode, delta_timestamps for {self.views.image} and {self.views.depth}, or columns of the data set"
            )
        observation = transition[TransitionKey.OBSERVATION]
        self._follow(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        sample = {key: torch.as_tensor(observation[key]) for key in self.keys if key in observation}
        sample = {key: x[0] for key, x in sample.items()} if image.ndim == 4 else sample
        names = self.views.image, self.views.depth, f"{self.views.image}_is_pad"
        window = self.window.push(sample[self.views.image], sample[self.views.depth])
        added = self._row(sample | dict(zip(names, window, strict=True)))
        ends = (transition.get(TransitionKey.DONE), transition.get(TransitionKey.TRUNCATED))
        if any(bool(torch.as_tensor(end).any()) for end in ends if end is not None):
            self.reset()
        return {key: x[None] for key, x in added.items()} if image.ndim == 4 else added

    def _row(self, sample: Mapping[str, Any]) -> dict[str, Tensor]:
        """Sample of two frames -> added keys."""
        with torch.no_grad():
            out = self.single(sample)
        assert out is not None
        return {key: out[key] for key in out if key not in sample}

    def _follow(self, flags: Mapping[str, Any]) -> None:
        """Start an episode where the batch names another one, or a frame that is not the next."""
        numbers = (flags.get("episode_index"), flags.get("index"))
        episode, index = (-1 if x is None else int(torch.as_tensor(x).flatten()[0]) for x in numbers)
        if self.place != (-1, -1) and (episode != self.place[0] or (index >= 0 and index != self.place[1] + 1)):
            self.reset()
        self.place = (episode, index)

    def _in_unit(self, depth: Tensor) -> Tensor:
        """Maps of whole numbers in the camera's unit -> in that of the data set; other maps as they are."""
        unit = self.views.depth_unit
        if depth.is_floating_point() or unit == self.camera.depth_unit:
            return depth
        return self.camera.metres([depth])[0] * UNITS_PER_METRE[unit]

    def _finish(self, transition: Any, added: dict[str, Tensor]) -> Any:
        """Transition and added keys -> the result."""
        transition[TransitionKey.OBSERVATION] |= added
        return transition

    def reset(self) -> None:
        """An episode ends: past frames are dropped."""
        self.window.reset()
        self.place = (-1, -1)

    def state_dict(self) -> dict[str, Tensor]:
        """Past frames and the place of the last one; empty at the start of an episode."""
        state = self.window.state_dict()
        return state | {"place": torch.tensor(self.place)} if state else {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """State of :meth:`state_dict`."""
        self.window.load_state_dict(state)
        self.place = tuple(state["place"].tolist()) if "place" in state else (-1, -1)


@ProcessorStepRegistry.register("dhtorch_extend_depth")
class ExtendDepthStep(_WindowStep):
    """Adds far depth, points, pose and depth tokens: the columns of :class:`dhtorch.ExtendDepth`.

    Args:
        tokens_key: key under which the tokens stand as one row of numbers, too; policies of LeRobot take
            ``observation.environment_state``.
        options: of :class:`dhtorch.ExtendDepth`, for example ``{"n": 256, "dense": true}``.
    """

    transform_class = ExtendDepth
    done_key = "problem"

    def __init__(self, *, tokens_key: str | None = None, **options: Any) -> None:
        super().__init__(tokens_key=tokens_key, **options)

    def _finish(self, transition: Any, added: dict[str, Tensor]) -> Any:
        if self.config["tokens_key"] is not None:
            added[self.config["tokens_key"]] = added[f"{self.prefix}tokens"].flatten(-2)
        return super()._finish(transition, added)

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        if self.views.image not in known:
            return {}
        _, height, width = known[self.views.image].shape
        blank = self.single.blank_columns((height, width))
        shapes = {self.prefix + key: (FeatureType.STATE, tuple(x.shape[1:])) for key, x in blank.items()}
        if self.config["tokens_key"] is not None:
            shapes[self.config["tokens_key"]] = (FeatureType.ENV, (blank["tokens"].numel(),))
        return shapes


@ProcessorStepRegistry.register("dhtorch_validate_depth")
class ValidateDepthStep(_WindowStep):
    """Adds the validation of the depth map (:class:`dhtorch.transforms.ValidateDepth`) and ``depth_ok``.

    A frame is bad if its values contradict unit or intrinsics, if it has no return, if more than ``max_wrong`` of the
    pixels with evidence are wrong, by the lower end of the interval, or if fewer than ``min_known`` of the returns have
    evidence: where most of a map is wrong no motion explains it, and nothing is known.

    Args:
        on_bad: ``flag`` = only ``depth_ok`` says so; ``clear`` = its depth becomes 0, which means none; ``drop`` = the
            row leaves the batch, and a batch without another row raises SampleError.
        max_wrong: in maps of a room without faults the lower end is up to 0.01, with 9 % wrong returns 0.07 and more.
        min_known: the first frame of an episode has evidence nowhere.
        options: of :class:`dhtorch.transforms.ValidateDepth`, for example ``{"judging": {"size": 160}}``.
    """

    transform_class = ValidateDepth
    done_key = "depth_ok"
    numbers = ("state_share", "wrong")  # of what the transform adds

    def __init__(
        self, *, on_bad: str = "flag", max_wrong: float = 0.05, min_known: float = 0.0, **options: Any
    ) -> None:
        if on_bad not in ("flag", "clear", "drop"):
            raise ValueError(f"on_bad is {on_bad!r}, expected flag, clear or drop")
        super().__init__(on_bad=on_bad, max_wrong=max_wrong, min_known=min_known, **options)

    def _row(self, sample: Mapping[str, Any]) -> dict[str, Tensor]:
        keys = [self.prefix + name for name in self.numbers]
        contradicts = bool(self.views.read(sample).bad.any())
        out = dict.fromkeys(keys, torch.zeros(3)) if contradicts else super()._row(sample)
        share, wrong = added = [out[key] for key in keys]
        known = (share.sum() > 0) & (share[1:].sum() >= self.config["min_known"])
        ok = known & (wrong[1] <= self.config["max_wrong"])
        return {**dict(zip(keys, added, strict=True)), f"{self.prefix}depth_ok": ok}

    def _finish(self, transition: Any, added: dict[str, Tensor]) -> Any:
        transition, ok = super()._finish(transition, added), added[f"{self.prefix}depth_ok"]
        observation, key = transition[TransitionKey.OBSERVATION], self.views.depth
        if self.config["on_bad"] == "clear":
            depth = observation[key]
            observation[key] = torch.where(ok.view(*ok.shape, *[1] * (depth.ndim - ok.ndim)), depth, 0)
        elif self.config["on_bad"] == "drop" and not bool(ok.all()):
            if not bool(ok.any()):
                raise SampleError(f"{key}: found no frame with usable depth in the batch, expected one at least")
            return {name: _keep_rows(value, ok) for name, value in transition.items()}
        return transition

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        numbers = {self.prefix + name: (FeatureType.STATE, (3,)) for name in self.numbers}
        return {**numbers, f"{self.prefix}depth_ok": (FeatureType.STATE, ())}


def _keep_rows(value: Any, ok: Tensor) -> Any:
    """Rows of a batch, in a dict, tensor or list -> those that are kept; other values as they are."""
    if isinstance(value, dict):
        return {key: _keep_rows(x, ok) for key, x in value.items()}
    if isinstance(value, Tensor) and value.ndim and len(value) == len(ok):
        return value[ok.to(value.device)]
    if isinstance(value, list) and len(value) == len(ok):
        return [x for x, kept in zip(value, ok.tolist(), strict=True) if kept]
    return value


@ProcessorStepRegistry.register("dhtorch_mask_silence")
class MaskSilenceStep(_DepthStep):
    """No depth (0) stays 0 when maps are normalised; the step stands before the normaliser and again after it.

    Before it the mask ``KEY_known`` is added; after it what is not known becomes 0, the mean of what a policy sees.

    Args:
        keys: of depth maps and their standard deviations.
        stage: ``before`` or ``after`` the normaliser.
        limits: key -> lower and upper limit of depth, in the unit of the map; maps of whole numbers, as a camera gives
            them, have none. :meth:`from_dataset` reads those of depth videos, which have no 0, from the metadata.
    """

    def __init__(self, *, keys: Sequence[str], stage: str, limits: Mapping[str, Sequence[float]] | None = None) -> None:
        if stage not in ("before", "after"):
            raise ValueError(f"stage is {stage!r}, expected before or after")
        super().__init__(keys=list(keys), stage=stage, limits=dict(limits or {}))

    @classmethod
    def from_dataset(cls, dataset: Any, keys: Sequence[str], stage: str) -> MaskSilenceStep:
        """A step for a LeRobot data set, with the limits that its metadata state."""
        limits = {}
        for key in keys:
            if math.isfinite((metres := declared_depth_range(dataset, key))[1]):
                scale = UNITS_PER_METRE[declared_depth_unit(dataset, key)]
                limits[key] = [scale * x for x in metres]
        return cls(keys=keys, stage=stage, limits=limits)

    def _process(self, transition: Any) -> Any:
        observation = transition[TransitionKey.OBSERVATION]
        for key in self.config["keys"]:
            mask = f"{key}_known"
            if self.config["stage"] == "before":
                x = observation[key]
                observation[mask] = x > 0
                if key in self.config["limits"] and x.is_floating_point():
                    low, high = self.config["limits"][key]
                    observation[mask] = (x > low) & (x <= high)
            elif mask not in observation:
                raise SampleError(f"{mask}: found no such key, expected dhtorch_mask_silence before the normaliser")
            else:
                observation[key] = torch.where(observation[mask], observation[key], 0.0)
        return transition

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        keys = [key for key in self.config["keys"] if key in known and self.config["stage"] == "before"]
        return {f"{key}_known": (FeatureType.STATE, tuple(known[key].shape)) for key in keys}


class _MapStep(_DepthStep):
    """Base of steps that encode a depth map for policies.

    Args:
        depth: key of the map (B, H, W) or (B, 1, H, W).
        depth_unit: of the map, ``m`` or ``mm``; None = that of ``dhtorch_extend_depth``, m, for maps of it.
        depth_range: lower and upper limit in m of depth, outside of which there is none; None = there are no limits.

    Raises:
        ValueError: no unit, or another one.
    """

    def __init__(
        self, *, depth: str, depth_unit: str | None = None, depth_range: Sequence[float] | None = None, **more: Any
    ) -> None:
        unit = "m" if depth_unit is None and depth.startswith(PREFIX) else depth_unit
        if unit not in UNITS_PER_METRE:
            expected = "m or mm; from_dataset(dataset, depth) reads it from a data set"
            raise ValueError(f"{depth}: depth_unit is {unit!r}, expected {expected}")
        super().__init__(depth=depth, depth_unit=unit, depth_range=depth_range, **more)
        self.views = SampleSpec(depth=depth, depth_unit=unit, depth_range=depth_range or (0.0, math.inf))

    @classmethod
    def from_dataset(cls, dataset: Any, depth: str, **more: Any) -> Any:
        """A step for depth of a LeRobot data set, in the unit and with the limits that its metadata state.

        Raises:
            ValueError: the data set states no unit.
        """
        return cls(depth=depth, **_declared_depth(dataset, depth), **more)

    def _depth(self, observation: Mapping[str, Any]) -> Tensor:
        """Depth map (B, H, W) m, 0 = none."""
        return self.views.metres([_map(observation[self.views.depth])])[0]


@ProcessorStepRegistry.register("dhtorch_geometry_image")
class GeometryImageStep(_MapStep):
    """Adds a picture that encodes depth, sigma and source: :func:`dhtorch.functional.geometry_image`.

    Args:
        to: key of the picture (B, 3, H, W), in [0, 1] as LeRobot's pictures.
        depth, sigma, source: keys of the maps (B, H, W) or (B, 1, H, W), sigma in the unit of depth; those of
            ``dhtorch_extend_depth`` with ``dense``.
        more: ``depth_unit`` and ``depth_range`` of maps that are not of ``dhtorch_extend_depth``, which
            :meth:`from_dataset` reads from the metadata of a data set.
    """

    def __init__(
        self,
        *,
        to: str,
        depth: str = f"{PREFIX}depth_map",
        sigma: str = f"{PREFIX}sigma_map",
        source: str = f"{PREFIX}source_map",
        **more: Any,
    ) -> None:
        super().__init__(to=to, depth=depth, sigma=sigma, source=source, **more)

    def _process(self, transition: Any) -> Any:
        observation = transition[TransitionKey.OBSERVATION]
        sigma, source = (_map(observation[self.config[name]]) for name in ("sigma", "source"))
        sigma = sigma / UNITS_PER_METRE[self.views.depth_unit]
        observation[self.config["to"]] = geometry_image(self._depth(observation), sigma, source).float() / 255
        return transition

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        key = self.config["depth"]
        return {self.config["to"]: (FeatureType.VISUAL, (3, *known[key].shape[-2:]))} if key in known else {}


@ProcessorStepRegistry.register("dhtorch_point_cloud")
class PointCloudStep(_MapStep):
    """Adds ``n`` points of a depth map in the camera's axes, m (:func:`dhtorch.functional.point_cloud`).

    Args:
        image: key of the picture, whose size the intrinsics belong to.
        intrinsics: as those of ``dhtorch_extend_depth``.
        depth: key of the map (B, H, W) or (B, 1, H, W), over the field of view of the picture.
        to: key of the points (B, n, 3).
        n: number of points.
        more: ``depth_unit`` and ``depth_range`` of maps that are not of ``dhtorch_extend_depth``, which
            :meth:`from_dataset` reads from the metadata of a data set.
    """

    def __init__(
        self,
        *,
        image: str,
        intrinsics: str | Sequence[float],
        depth: str = f"{PREFIX}depth_map",
        to: str = "observation.points",
        n: int = 1024,
        **more: Any,
    ) -> None:
        intrinsics = intrinsics if isinstance(intrinsics, str) else [float(x) for x in intrinsics]
        super().__init__(image=image, intrinsics=intrinsics, depth=depth, to=to, n=n, **more)

    def _process(self, transition: Any) -> Any:
        observation = transition[TransitionKey.OBSERVATION]
        depth, stated = self._depth(observation), self.config["intrinsics"]
        numbers = torch.as_tensor(observation[stated] if isinstance(stated, str) else stated).to(depth)
        rows = numbers.reshape(-1, 4 if numbers.shape[-1] == 4 else 9)
        f, c = (rows[:, :2], rows[:, 2:]) if rows.shape[1] == 4 else (rows[:, 0:5:4], rows[:, 2:6:3])
        hw = torch.as_tensor(observation[self.config["image"]]).shape[-2:]
        K = to_matrix(resize(Camera(f, c), tuple(hw), tuple(depth.shape[-2:])))
        observation[self.config["to"]] = point_cloud(depth, K, n=self.config["n"])
        return transition

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        return {self.config["to"]: (FeatureType.STATE, (self.config["n"], 3))}


@ProcessorStepRegistry.register("dhtorch_camera_pin")
class CameraPinStep(_DepthStep):
    """Adds whether a fixed camera was moved since a reference view, and by how much (:class:`dhtorch.CameraPin`).

    ``observation.dh_pin_verdict`` (B,) is a code of :class:`dhtorch.codes.PinVerdict`, ``…_shift_px`` and
    ``…_shift_sigma_px`` (B,), ``…_offset`` (B, 6) rad and m; NaN where the picture cannot tell. The reference is part
    of the step's state, so a saved preprocessor holds it.

    Args:
        image: key of the camera's picture.
        intrinsics: fx, fy, cx, cy of it, px.
        max_px: shift, less two sigmas, above which a picture is an error instead of an observation; None = never.
        false_alarm_rate: of *moved* for a camera that stands still.
    """

    def __init__(
        self,
        *,
        image: str,
        intrinsics: Sequence[float],
        max_px: float | None = None,
        false_alarm_rate: float = 0.01,
    ) -> None:
        numbers = [float(x) for x in intrinsics]
        super().__init__(image=image, intrinsics=numbers, max_px=max_px, false_alarm_rate=false_alarm_rate)
        self.pin: CameraPin | None = None

    def set_reference(
        self,
        image: Tensor,
        depth: Tensor | None = None,
        *,
        depth_unit: str = "m",
        depth_range: Sequence[float] = (0.0, math.inf),
    ) -> None:
        """The view of the camera in its place.

        Args:
            image: picture (C, H, W) or (1, C, H, W).
            depth: map (h, w), (1, h, w) or (1, 1, h, w) of the same view, 0 = none; None = there is no map.
            depth_unit: of the map; that of a LeRobot data set is its
                :func:`dhtorch.transforms.declared_depth_unit`.
            depth_range: lower and upper limit in m of depth, outside of which there is none; those of a LeRobot data
                set are its :func:`dhtorch.transforms.declared_depth_range`.
        """
        image = image[None] if image.dim() == 3 else image
        depth = torch.zeros_like(image[:, 0], dtype=torch.float32) if depth is None else _map(depth)
        depth = SampleSpec(depth_unit=depth_unit, depth_range=depth_range).metres([depth])[0]
        numbers = torch.tensor([self.config["intrinsics"]])
        frame = Frame(image.cpu(), depth.reshape(1, *depth.shape[-2:]).cpu(), Camera(numbers[:, :2], numbers[:, 2:]))
        self.pin = CameraPin(frame, false_alarm_rate=self.config["false_alarm_rate"])

    def _process(self, transition: Any) -> Any:
        if self.pin is None:
            raise SampleError("dhtorch_camera_pin: found no reference, expected set_reference or a saved state")
        observation = transition[TransitionKey.OBSERVATION]
        image = torch.as_tensor(observation[self.config["image"]])
        result = self.pin.check((image[None] if image.dim() == 3 else image).cpu())
        limit, low = self.config["max_px"], result.shift_low_px
        if limit is not None and bool((low > limit).any()):
            raise SampleError(
                f"{self.config['image']}: camera moved by at least {float(low.max()):.1f} px, limit {limit:g}"
            )
        values = {"verdict": result.verdict, "offset": result.offset.float()}
        values |= {"shift_px": result.shift_px.float(), "shift_sigma_px": result.shift_sigma_px.float()}
        observation.update({f"{PREFIX}pin_{name}": value.to(image.device) for name, value in values.items()})
        return transition

    def _added(self, known: Mapping[str, PolicyFeature]) -> Shapes:
        shapes = {"verdict": (), "offset": (6,), "shift_px": (), "shift_sigma_px": ()}
        return {f"{PREFIX}pin_{name}": (FeatureType.STATE, shape) for name, shape in shapes.items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Picture and depth of the reference."""
        return {} if self.pin is None else {"image": self.pin.frame.image, "depth": self.pin.frame.depth}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """State of :meth:`state_dict`."""
        if "image" in state:
            self.set_reference(state["image"], state["depth"])


def _map(x: Any) -> Tensor:
    """Maps (B, H, W) or (B, 1, H, W) -> (B, H, W)."""
    x = torch.as_tensor(x)
    return x.squeeze(1) if x.ndim == 4 else x


def _declared_depth(dataset: Any, key: str) -> dict[str, Any]:
    """Key of depth in a LeRobot data set -> its ``depth_unit``, and ``depth_range`` where it has limits."""
    low, high = declared_depth_range(dataset, key)
    limits = {"depth_range": [low, high]} if math.isfinite(high) else {}
    return {"depth_unit": declared_depth_unit(dataset, key), **limits}
