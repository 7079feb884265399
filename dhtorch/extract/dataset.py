"""Frame of a recording → row of features: the frame and other frames form a sample for the transform."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dhtorch.data.recording import Recording
from dhtorch.data.rig import match_instants
from dhtorch.data.scene import Scene
from dhtorch.extract.columns import KEY_COLUMNS, Column, Row
from dhtorch.extract.plan import ExtractionPlan, candidates_by_frame, view_offsets
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.records import Frame
from dhtorch.transforms import DenseMaps, ExtendDepth, SampleError

#: Readers return metres and the camera of the same pixels: the checks of unit and intrinsics are switched off.
_READER_OPTIONS = {"depth_unit": "m", "layout": "chw", "max_depth": np.inf, "min_depth": 0.0, "min_focal": 0.0}


class ExtractedRow(NamedTuple):
    """Result of one row of the plan."""

    place: Row  # the key columns
    features: Row | None  # the other columns; None = the frame cannot be read
    complaint: str = ""  # the reason


class RowDataset(Dataset[ExtractedRow]):
    """Position in the plan → row. Depends on the position only: not on the worker, the engine or the order.

    The sample is that of a robot data loader with ``delta_timestamps``: source images, then the frame itself. Source
    views are the candidates of view selection, or the frame ``gap`` frames earlier (for a multi-view method several,
    evenly spaced over the gap). If such a frame is missing or cannot be read, a copy of the frame pads, and only the
    front end runs; an unreadable candidate of view selection is left out.

    Args:
        scenes: of the data set.
        plan: from :func:`dhtorch.extract.plan.make_plan`.
        wanted: columns of the rows.
        method: for one source view or several.
        gap: ``auto`` = view selection among earlier frames; number of frames back to the source view, 0 = none;
            None = the scene's own.
        past: candidates are earlier frames only; else also later ones of the same recording.
        beside: candidates are also the frames of the episode's other cameras at the same instant; with ``gap`` auto.
        options: of :class:`dhtorch.transforms.ExtendDepth`.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        plan: ExtractionPlan,
        wanted: dict[str, Column],
        *,
        method: Method,
        gap: int | str | None,
        past: bool = True,
        beside: bool = False,
        **options: Any,
    ) -> None:
        self.scenes, self.plan, self.wanted = scenes, plan, wanted
        self.method, self.gap, self.past, self.options = method, gap, past, options
        self.beside = beside
        self._opened: tuple[int, OpenRecording] | None = None

    def __len__(self) -> int:
        return len(self.plan)

    def __getitem__(self, position: int) -> ExtractedRow:
        k, episode, i = self.plan.place(position)
        if self._opened is None or self._opened[0] != k:
            beside = [self.scenes[i].recording for i in self.plan.beside(k)] if self.beside else []
            self._opened = (k, OpenRecording(self.scenes[k], self.method, self.gap, self.past, self.options, beside))
        opened = self._opened[1]
        recording = opened.recording
        stamp = np.nan if recording.times is None else float(recording.times[i])
        place: Row = dict(zip(KEY_COLUMNS, (episode, int(recording.number[i]), stamp, recording.name), strict=True))
        try:
            with torch.no_grad():
                return ExtractedRow(place, self.features(opened, i))
        except Exception as error:  # any error of a decoder; lack of memory is no property of a frame
            if isinstance(error, MemoryError | torch.OutOfMemoryError):
                raise
            message = f"{recording.name}, frame {place['frame_index']}: {error}"
            return ExtractedRow(place, None, " ".join(message.split()))

    def features(self, opened: "OpenRecording", i: int) -> Row:
        """Frame ``i`` of an opened recording -> its columns other than the key columns."""
        reference = opened.frame(i)
        added = opened.answer(reference, opened.others(i))
        for name, column in self.wanted.items():  # only maps depend on the image size
            if name in added and tuple(added[name].shape) != column.shape:
                actual, expected = (format_hw(shape) for shape in (added[name].shape, column.shape))
                raise SampleError(
                    f"{name}: found {actual}, expected {expected} as of the first frame; extract it apart"
                )
        columns = {k: c for k, c in self.wanted.items() if k not in KEY_COLUMNS}
        return {k: added[k].numpy().astype(c.kind) for k, c in columns.items()}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}


class OpenRecording:
    """One recording with a cache of frames, and the transforms for its kinds of samples."""

    def __init__(
        self,
        scene: Scene,
        method: Method,
        gap: int | str | None,
        past: bool,
        options: dict[str, Any],
        beside: Sequence[Recording] = (),
    ) -> None:
        self.scene, self.recording, self.options = scene, scene.recording, options
        self.offers = candidates_by_frame(scene, past) if isinstance(gap, str) else None
        self.method = method if self.offers is None else with_view_selection(method)
        self.steps = [] if isinstance(gap, str) else view_offsets(scene, gap, method.views)
        self.position = {int(number): i for i, number in enumerate(self.recording.number)} if self.steps else {}
        self.transforms: dict[tuple[Any, ...], ExtendDepth] = {}
        self.cached: OrderedDict[int, Frame | None] = OrderedDict()
        self.beside = [(other, match_instants(self.recording, other)) for other in beside]

    def frame(self, i: int) -> Frame:
        """Frame ``i``; it is cached, because later frames use it as a source view."""
        self.cached[i] = frame = self.recording[i]
        self._forget()
        return frame

    def answer(self, reference: Frame, others: Sequence[Frame | None]) -> dict[str, Tensor]:
        """Reference frame and source frames -> columns that the transform adds to their sample, without prefix."""
        # A sample of frames along time, the reference view last.
        frames = [*(reference if other is None else other for other in others), reference]
        cameras = [frame.camera for frame in frames]
        sample = {
            "image": torch.cat([frame.image for frame in frames]),
            "image_is_pad": torch.tensor([*(other is None for other in others), False]),
            "depth": reference.depth,
            "intrinsics": torch.cat([cam.to_matrix(camera) for camera in cameras]),
        }
        if reference.conf is not None:
            sample["confidence"] = reference.conf
        lenses = [camera.distortion for camera in cameras if camera.distortion is not None]
        if lenses:
            size = max(lens.shape[-1] for lens in lenses)
            none = lenses[0].new_zeros(1, 0)
            padded = (none if camera.distortion is None else camera.distortion for camera in cameras)
            sample["distortion"] = torch.cat([torch.nn.functional.pad(x, (0, size - x.shape[-1])) for x in padded])
        if reference.depth_camera is not None:
            sample["depth_intrinsics"] = cam.to_matrix(reference.depth_camera)[0]
        poses = [frame.T_world_from_cam for frame in frames]
        if all(pose is not None for pose in poses):
            sample["pose"] = torch.cat([se3.to_matrix(pose) for pose in poses if pose is not None])
        optional = tuple(key for key in ("confidence", "distortion", "depth_intrinsics") if key in sample)
        sample_kind = (len(sample["image"]), *optional)
        if sample_kind not in self.transforms:
            views = len(sample["image"]) - 1
            options: dict[str, Any] = {**_READER_OPTIONS, **self.options, **{key: key for key in optional}}
            options |= {"sparse": self.recording.sparse, "hint": self.scene.hint}
            other_at = list(range(views)) if views > 1 else 0
            self.transforms[sample_kind] = ExtendDepth(method=self.method, other_at=other_at, **options)
        transform = self.transforms[sample_kind]
        extended = transform(sample)
        assert extended is not None  # on_error is raise
        return {k.removeprefix(transform.prefix): v for k, v in extended.items() if k.startswith(transform.prefix)}

    def others(self, i: int) -> list[Frame | None]:
        """Source frames of frame ``i``; None = missing or unreadable."""
        if self.offers is None:
            number = int(self.recording.number[i])
            return [self._cached_frame(self.position.get(number - step)) for step in self.steps]
        frames: list[Frame | None] = [f for k in self.offers.get(i, ()) if (f := self._cached_frame(k)) is not None]
        for recording, indices in self.beside:
            frame = None if indices[i] < 0 else try_read_frame(recording, indices[i])
            frames += [] if frame is None else [frame]
        return frames or [None]

    def _cached_frame(self, at: int | None) -> Frame | None:
        """Frame ``at`` from the cache; None = no index, or unreadable."""
        if at is not None and at not in self.cached:
            self.cached[at] = try_read_frame(self.recording, at)
            self._forget()
        return None if at is None else self.cached[at]

    def _forget(self) -> None:
        """Drop the oldest frames beyond the cache size. (Uncached, decoding backwards restarts at a key frame.)"""
        frames = [frame for frame in self.cached.values() if frame is not None]
        size = max((frame.image.nbytes + frame.depth.nbytes for frame in frames), default=1)
        while len(self.cached) > max(2, (1 << 26) // size):  # 64 MB: they are source views of later frames
            self.cached.popitem(last=False)


def common_map_hw(scenes: Sequence[Scene], maps: DenseMaps) -> tuple[int, int]:
    """Scenes -> height and width of all their maps, from the first readable frame of each recording.

    Raises:
        ValueError: recordings whose maps have different sizes, or no frame that can be read.
    """
    first: tuple[str, tuple[int, int]] | None = None
    for recording in (scene.recording for scene in scenes):
        frames = (try_read_frame(recording, i) for i in range(len(recording)))
        frame = next((frame for frame in frames if frame is not None), None)
        if frame is None:
            continue  # reported row by row
        hw = maps.hw(frame.hw)
        if first is not None and hw != first[1]:
            actual = f"{recording.name} has pictures of {format_hw(frame.hw)} and maps of {format_hw(hw)}"
            raise ValueError(
                f"extract.dense: {actual}, expected maps of {format_hw(first[1])} as of {first[0]}; extract them apart"
            )
        first = first or (recording.name, hw)
    if first is None:
        raise ValueError("extract.dense: found no frame that can be read, expected one to set the size of the maps")
    return first[1]


def try_read_frame(recording: Recording, at: int) -> Frame | None:
    """Frame ``at``, None if it cannot be read; the error is reported where that frame is the reference view."""
    try:
        return recording[at]
    except MemoryError:
        raise
    except Exception:
        return None


def format_hw(hw: Sequence[int]) -> str:
    """Height and width as text."""
    return f"{hw[0]}x{hw[1]}"
