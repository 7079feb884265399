"""Columns of an enriched LeRobot set for policies that take pictures or points: geometry images and point clouds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.export import lerobot
from dhtorch.export.lerobot import FeatureMoments, FeatureSpec
from dhtorch.export.video import LOSSLESS_CODEC, LOSSLESS_PIXELS, AppendFrame
from dhtorch.extract.enriched import DatasetCamera, decode_map
from dhtorch.extract.targets import Row
from dhtorch.functional import policy_inputs
from dhtorch.geometry import camera as cam

#: Columns that are computed from the maps of a frame, by name in ``columns=``.
POLICY_COLUMNS: Final[tuple[str, ...]] = ("geometry_image", "point_cloud")

#: Points of a cloud. Source: the number that 3D Diffusion Policy (DP3) takes from a camera.
N_POINTS: Final = 1024

#: Description file of GR00T, below the data set.
MODALITY_FILE: Final = "meta/modality.json"


def geometry_feature(hw: tuple[int, int], fps: float) -> FeatureSpec:
    """LeRobot feature of a video of geometry images; its info has the decoding of the three bytes."""
    last, near, low = 255, policy_inputs.NEAREST_M, policy_inputs.LOWEST_RATIO
    decoding = {
        "depth_m": f"{last * near:g} / channel_0",
        "sigma_m": f"depth_m * {low:g} ** (1 - (channel_1 - 1) / {last - 1}); unknown where channel_1 = 0",
        "source": f"round(channel_2 / {policy_inputs.SOURCE_STEP}); 0 = no depth",
        "function": "dhtorch.functional.decode_geometry_image",
    }
    video: dict[str, Any] = {
        "video.height": hw[0],
        "video.width": hw[1],
        "video.codec": LOSSLESS_CODEC,
        "video.pix_fmt": LOSSLESS_PIXELS,
        "video.is_depth_map": False,
        "video.fps": int(fps) if float(fps).is_integer() else fps,
        "video.channels": 3,
        "has_audio": False,
    }
    return {**lerobot.image_feature(hw, **video, geometry_image=decoding), "dtype": "video"}


#: LeRobot feature of a point cloud.
CLOUD_FEATURE: Final[FeatureSpec] = {
    "dtype": "float32",
    "shape": [N_POINTS, 3],
    "names": ["point", "xyz"],
    "info": {"unit": "m", "axes": "camera of the picture: x right, y down, z forward", "no_depth": "all points 0"},
}


class PolicyColumnWriter:
    """The policy columns of one camera in one episode: pictures go to a video, points into the table.

    Args:
        keys: kind → column name, see :data:`POLICY_COLUMNS`.
        view: the camera.
        append: writes a picture (h, w, 3) of the video at its time; None = without geometry images.
    """

    def __init__(self, keys: Mapping[str, str], view: DatasetCamera, append: AppendFrame | None) -> None:
        self.keys, self.view, self.append = keys, view, append
        self.moments: dict[str, FeatureMoments] = {}

    def add(self, rows: Sequence[Row | None], times: Sequence[float]) -> dict[str, Any]:
        """Next rows (None = unreadable) at their times in s -> column → Arrow array; the video gets their pictures."""
        clouds = []
        for row, time in zip(rows, times, strict=True):
            maps = (
                None
                if row is None or not row["depth"]
                else {name: decode_map(row[name], name, self.view.map_hw) for name in ("depth", "sigma", "source")}
            )
            if self.append is not None:
                picture = np.zeros((*self.view.hw, 3), np.uint8)
                if maps is not None:  # of the picture's size, by nearest pixels
                    image = policy_inputs.geometry_image(*map(torch.from_numpy, maps.values())).permute(1, 2, 0).numpy()
                    sizes = zip(self.view.hw, self.view.map_hw, strict=True)
                    v, u = ((2 * np.arange(n) + 1) * m // (2 * n) for n, m in sizes)
                    picture = image[v[:, None], u]
                self.append(picture, time)
                self._count(self.keys["geometry_image"], picture.reshape(-1, 3) / 255)
            if "point_cloud" in self.keys:
                points = np.zeros((N_POINTS, 3), np.float32)
                if maps is not None and row is not None and maps["depth"].any():
                    lens = torch.tensor(self.view.lens, dtype=torch.float64) if self.view.lens else None
                    camera = cam.from_matrix(torch.tensor(row["K"], dtype=torch.float64).view(1, 3, 3))
                    K = cam.to_matrix(cam.resize(camera, self.view.hw, self.view.map_hw))[0]
                    depth = torch.from_numpy(maps["depth"]).double()
                    points = policy_inputs.point_cloud(depth, K, n=N_POINTS, distortion=lens).float().numpy()
                    self._count(self.keys["point_cloud"], points)
                clouds.append(points)
        return {self.keys["point_cloud"]: lerobot.nested_lists(np.stack(clouds))} if clouds else {}

    def _count(self, column: str, values: np.ndarray) -> None:
        here = FeatureMoments.of(values)
        self.moments[column] = self.moments[column] + here if column in self.moments else here


def make_modality(root: Path | None, features: Mapping[str, FeatureSpec], videos: Mapping[str, str]) -> dict[str, Any]:
    """Contents of GR00T's ``modality.json``: the source's with further videos, or of the features where it has none.

    Args:
        root: of the source; None = it has no such file.
        features: of the new data set.
        videos: name → video feature, to be added.

    Raises:
        FormatError: a file that is not an object of objects.
    """
    path = Path(MODALITY_FILE) if root is None else root / MODALITY_FILE
    if root is None:  # state and action as one part each, and every video by its name
        parts = {"state": "observation.state", "action": "action"}
        modality: dict[str, Any] = {
            part: {part: {"start": 0, "end": int(np.prod(features[key]["shape"]))}}
            for part, key in parts.items()
            if key in features
        }
        names = (key for key, feature in features.items() if feature["dtype"] == "video")
        modality["video"] = {key.removeprefix("observation.images."): {"original_key": key} for key in names}
        modality["annotation"] = {"human.action.task_description": {"original_key": "task_index"}}
    else:
        modality = files.read_json(path)
    if not isinstance(modality, dict) or not isinstance(modality.get("video", {}), dict):
        raise FormatError(path, "video", "no object", "names of videos, each with original_key")
    added = {name: {"original_key": key} for name, key in videos.items()}
    return {**modality, "video": {**modality.get("video", {}), **added}}
