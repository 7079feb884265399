"""Frame of a recording → row of an enriched data set: encoded maps, camera, and counts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Gate, PoseCode, Source, is_recovered, names
from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.io.decode import decode_image
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.export import encode_png
from dhtorch.export.lerobot import N_BINS, FeatureMoments, LogHistogram
from dhtorch.export.tiff import encode_float_tiff
from dhtorch.extract.columns import Column, Row, stored_column
from dhtorch.extract.dataset import OpenRecording, RowDataset, format_hw, try_read_frame
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline import dense
from dhtorch.records import Frame
from dhtorch.transforms import SampleError, schema

#: Map -> number of its quantisation steps per step of depth; 1 if missing.
MAP_STEPS: Final = {"sigma": 8}

#: File type of a map -> numpy dtype of its pixels.
MAP_DTYPES: Final = {"tiff": np.float32, "png": np.uint8}

#: Maps of the transform that an enriched data set stores, one file per image, by name.
MAP_FILES: Final = {c.key.removesuffix("_map"): c for c in schema.COLUMNS if c.enrich in ("tiff", "png")}

#: Columns of numbers of the transform that an enriched data set stores.
NUMBER_COLUMNS: Final = {c.key: c for c in schema.COLUMNS if c.enrich == "numbers"}

#: Length of the counts of pixels by source.
_N_SOURCES = max(names(Source)) + 1

#: Reason for pixels without an answer beyond the gates: no source view, as for the first frame of an episode.
NO_OTHER_VIEW = max(names(Gate)) + 1

#: Reasons for unanswered pixels, by code: gates, and no source view.
NO_ANSWER_REASONS = {**names(Gate), NO_OTHER_VIEW: "NO_OTHER_VIEW"}


@dataclass(frozen=True)
class DatasetCamera:
    """One camera of a data set."""

    key: str  # LeRobot feature of its images
    hw: tuple[int, int]  # of the image
    map_hw: tuple[int, int]
    posed: bool
    lens: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Name of the camera, without the prefixes of the feature."""
        return self.key.removeprefix("observation.").removeprefix("images.")

    @classmethod
    def of(cls, scene: Scene, size: int) -> "DatasetCamera":
        """Recording and maximum map size -> its camera, from the first readable frame.

        Raises:
            ValueError: no readable frame, or frames without images.
        """
        recording = scene.recording
        frames = (try_read_frame(recording, i) for i in range(len(recording)))
        frame = next((frame for frame in frames if frame is not None), None)
        if frame is None or 0 in frame.hw:
            recording[0]  # raises the error of the reader
            raise ValueError(f"{recording.name}: found no frame with an image, expected one")
        map_hw = dense.map_hw(frame.hw, size)
        return cls(camera_key(recording), frame.hw, map_hw, recording.poses is not None, _get_distortion(frame))


def _get_distortion(frame: Frame) -> tuple[float, ...]:
    """Frame -> distortion coefficients in OpenCV's order; empty without distortion."""
    distortion = frame.camera.distortion
    return () if distortion is None else tuple(distortion[0].tolist())


def camera_key(recording: Recording) -> str:
    """Recording -> LeRobot feature of its images."""
    name = recording.camera_name
    if name is None or recording.format == "lerobot":
        return name or "observation.images.camera"
    return camera_feature(name)


def camera_feature(name: str) -> str:
    """Name of images in another format -> LeRobot feature."""
    return "observation.images." + name.removeprefix("observation/").removeprefix("images/").replace("/", "_")


def map_columns(pictures: bool, n: int = 0) -> dict[str, Column]:
    """Columns of the intermediate shards; ``pictures``: with the encoded image; ``n``: samples of a frame."""
    f, whole = "float64", "int64"
    files = {name: f"{c.meaning}, {c.unit}, as {str(c.enrich).upper()}" for name, c in MAP_FILES.items()}
    return {
        "episode_index": Column(whole, (), "1", "number of the episode"),
        "frame_index": Column(whole, (), "1", "number of the frame in its capture"),
        "timestamp": Column(f, (), "s", "NaN = none"),
        "recording": Column("str", (), "1", "name of the recording"),
        **{name: Column("bytes", (), "file", about) for name, about in files.items()},
        **{key: number_column(c, n) for key, c in NUMBER_COLUMNS.items()},
        **({"picture": Column("bytes", (), "file", "the picture as PNG")} if pictures else {}),
        "K": Column(f, (9,), "px", "of the picture"),
        "pose": Column(f, (16,), "1, m", "T_world_from_cam by rows; NaN = none"),
        "pixels": Column(whole, (_N_SOURCES,), "1", "by source"),
        "no_answer": Column(whole, (len(NO_ANSWER_REASONS),), "1", "unanswered ones by NO_ANSWER_REASONS"),
        "refuted": Column(whole, (), "code", "0 = no pose is, else 1 + which of CONVENTIONS it looks like"),
        "moments": Column(f, (5, 5), "m, 1", "of depth, sigma, red, green, blue"),
        "ranges": Column("int32", (3, N_BINS), "1", "answered pixels by depth, sigma; recovered by sigma / depth"),
        "problem": Column("uint8", (), "code", "what was wrong with the frame"),
    }


def number_column(spec: schema.ColumnSpec, n: int) -> Column:
    """Column of numbers of the transform -> stored column; its shape depends on ``n`` samples, not on the image."""
    return stored_column(spec, {"N": n})


class MapRowDataset(RowDataset):
    """Position in the plan → row with the maps of that frame; see :class:`dhtorch.extract.dataset.RowDataset`.

    Args:
        step: m, quantisation step of depth; that of sigma is an eighth; 0 = unquantised. A power of two, because
            float32 represents its multiples exactly and they compress well.
        views: LeRobot feature of a camera → expected camera.
        more: of :class:`RowDataset`.
    """

    def __init__(self, *args: Any, step: float, views: Mapping[str, DatasetCamera], **more: Any) -> None:
        super().__init__(*args, **more)
        self.step, self.views = step, dict(views)

    def features(self, opened: OpenRecording, i: int) -> Row:
        """Frame ``i`` of an opened recording -> its columns other than the key columns."""
        recording = opened.recording
        reference = opened.frame(i)
        view = self.views[camera_key(recording)]
        if reference.hw != view.hw:
            raise SampleError(
                f"image: found {format_hw(reference.hw)}, expected {format_hw(view.hw)} as of the first frame"
            )
        if _get_distortion(reference) != view.lens:
            expected = list(view.lens) or "none"
            raise SampleError(
                f"distortion: found {list(_get_distortion(reference)) or 'none'}, expected {expected} as of the first "
                "frame"
            )
        others = opened.others(i)
        added = opened.answer(reference, others)
        maps = _extract_maps(added, view)
        source, gate = maps["source"], maps.pop("gate")
        reason = gate if any(other is not None for other in others) else np.full_like(gate, NO_OTHER_VIEW)
        for name in maps:
            if MAP_FILES[name].enrich == "tiff":
                step = self.step / MAP_STEPS.get(name, 1)
                x = maps[name].astype(np.float64)
                # At least one step where positive; 0 = unquantised.
                x = np.where(x > 0, np.rint(x / step).clip(1) * step, 0) if step else x
                maps[name] = x.astype(np.float32)
        recovered = is_recovered(source) & (maps["depth"] > 0)
        measured = (maps["depth"], maps["sigma"], maps["sigma"][recovered] / maps["depth"][recovered])
        image = to_rgb_uint8(reference)
        # Where near returns refute the pose prior: 1 + index of the convention that it matches.
        convention = int(added.get("pose_convention", torch.zeros(())))
        refuted = convention > 0 or int(added["pose_code"]) == PoseCode.REFUTED
        refuted = refuted or bool((added["gate"] == Gate.POSE_REFUTED).any())
        valid = maps["depth"].reshape(-1, 1) > 0
        moments = [FeatureMoments.of(maps[name].reshape(-1, 1), valid) for name in ("depth", "sigma")]
        moments.append(FeatureMoments.of(image.reshape(-1, 3) / 255))
        poses = recording.poses
        pose = np.full(16, np.nan) if poses is None else se3.to_matrix(poses[i : i + 1])[0].double().flatten().numpy()
        columns = {
            **{name: _encode_map(field, name) for name, field in maps.items()},
            **{key: added[key].numpy().astype(self.wanted[key].kind) for key in NUMBER_COLUMNS},
            "K": cam.to_matrix(reference.camera)[0].double().flatten().numpy(),
            "pose": pose,
            "pixels": np.bincount(source.ravel(), minlength=_N_SOURCES),
            "no_answer": np.bincount(reason[source == Source.NONE], minlength=len(NO_ANSWER_REASONS)),
            "refuted": np.asarray(1 + convention if refuted else 0),
            "moments": np.concatenate([np.stack(each) for each in moments], 1),
            "ranges": np.stack([LogHistogram.of(x).counts for x in measured]).astype(np.int32),
            "problem": added["problem"].numpy(),
        }
        return columns if "picture" not in self.wanted else {**columns, "picture": encode_png(image)}


def to_rgb_uint8(frame: Frame) -> np.ndarray:
    """Frame -> image (h, w, 3) uint8; grey is repeated."""
    image = frame.image[0].cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return image.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()


def blank_maps(view: DatasetCamera) -> dict[str, bytes]:
    """Maps of an unreadable frame as files: no depth anywhere."""
    return {name: _encode_map(np.zeros(view.map_hw, MAP_DTYPES[str(c.enrich)]), name) for name, c in MAP_FILES.items()}


def decode_map(content: bytes, name: str, hw: tuple[int, int]) -> np.ndarray:
    """Inverse of the encoding of a map in a shard -> (h, w)."""
    place = Path(f"shard {name}")
    if MAP_FILES[name].enrich == "tiff":
        return decode_tiff(content, place, hw)
    return decode_image(content, place, hw)[0]


def _encode_map(field: np.ndarray, name: str) -> bytes:
    return encode_float_tiff(field, deflate=True) if MAP_FILES[name].enrich == "tiff" else encode_png(field)


def _extract_maps(added: Mapping[str, Tensor], view: DatasetCamera) -> dict[str, np.ndarray]:
    """Columns of the transform -> maps (h, w) by name, and ``gate``; without dense maps only sampled pixels are set."""
    kinds: dict[str, Any] = {name: MAP_DTYPES[str(c.enrich)] for name, c in MAP_FILES.items()} | {"gate": np.int64}
    if "depth_map" in added:
        unasked = torch.zeros_like(added["gate_map"])  # of columns whose option is off
        return {name: added.get(f"{name}_map", unasked).numpy().astype(kind) for name, kind in kinds.items()}
    h, w = view.map_hw
    scale = np.array([w / view.hw[1], h / view.hw[0]])
    pixel = np.rint((added["uv"].double().numpy() + 0.5) * scale - 0.5).astype(np.int64).clip(0, (w - 1, h - 1))
    maps = {}
    for name, kind in kinds.items():
        maps[name] = np.zeros((h, w), kind)
        if name in added:
            maps[name][pixel[:, 1], pixel[:, 0]] = added[name].numpy()
    return maps
