"""Writer of an enriched data set as nerfstudio folders, one per recording: images, depth with its source, poses.

Pixel centres are at integers here and at half-integers in nerfstudio, whose cameras look along −z, with y up.
``sparse_pc.ply`` holds points of the sure depth of all frames, from which splatfacto starts.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.io.decode import decode_image
from dhtorch.export import encode_png, write_ply
from dhtorch.extract.enriched import NUMBER_COLUMNS, DatasetCamera
from dhtorch.extract.targets import MapCounts, Row, iter_rows
from dhtorch.geometry import camera as cameras
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import is_whole

#: File of the points, as nerfstudio names its own.
_POINTS_FILE = "sparse_pc.ply"

#: Transformation from OpenCV camera axes to those of OpenGL.
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])

#: Step in m of the depth images: nerfstudio's ``depth_unit_scale_factor``.
_DEPTH_UNIT_M = 1e-3

#: Relative sigma whose confidence is one half.
_HALF_CONFIDENCE_SIGMA = 0.1

#: nerfstudio's names of the first distortion coefficients, in OpenCV's order.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")


class NerfstudioTarget:
    """One nerfstudio folder per recording.

    Args:
        root: of the folders; the folder itself if there is one recording.
        views: cameras, see :class:`dhtorch.extract.enriched.DatasetCamera`.
        folders: of the recordings, by episode and then by camera.
        key: of the settings and data.
    """

    def __init__(
        self, root: Path, views: Mapping[str, DatasetCamera], folders: Sequence[Mapping[str, str]], key: str
    ) -> None:
        self.root, self.views, self.folders, self.key = root, views, folders, key

    def _file(self, k: int, camera: str) -> Path:
        return self.root / self.folders[k][camera] / "transforms.json"

    def own(self, k: int) -> Row | None:
        """As :meth:`DatasetTarget.own`."""
        files = [self._file(k, key) for key in self.views]
        try:
            contents = [storage.parse_strict_json(storage.read_utf8(file)) for file in files]
            summaries = [content["dhtorch"] for content in contents]
            if any(summary["key"] != self.key for summary in summaries):
                return None
        except (OSError, ValueError, KeyError, TypeError):
            return None
        for file, content in zip(files, contents, strict=True):  # the images and points that it names, with all bytes
            names = [name for shot in content["frames"] for key, name in shot.items() if key.endswith("file_path")]
            if not all(is_whole(file.parent / name) for name in (content["ply_file_path"], *names)):
                return None
        return {**summaries[0], "cameras": {name: x for summary in summaries for name, x in summary["cameras"].items()}}

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """As :meth:`DatasetTarget.assemble`."""
        for key, view in self.views.items():
            tally, shots, cloud = MapCounts(), [], _PointCloud()
            folder = self._file(k, key).parent
            for row in iter_rows(parts[key]):
                tally.add(row)
                if row["depth"] and np.isfinite(row["pose"]).all():
                    stem = f"frame_{row['frame_index']:06d}"
                    depth, sigma = (decode_tiff(row[name], folder / stem, view.map_hw) for name in ("depth", "sigma"))
                    cloud.add(depth, sigma, row, view, folder)
                    steps = quantise_nerfstudio_depth(depth)
                    confidence = encode_confidence(np.where(steps > 0, depth, 0), sigma)
                    pictures = {"images": row["picture"], "depth": encode_png(steps), "source": row["source"]}
                    for name, content in {**pictures, "confidence": encode_png(confidence)}.items():
                        storage.replace_file(folder / name / f"{stem}.png", content)
                    K, pose = np.reshape(row["K"], (3, 3)), np.reshape(row["pose"], (4, 4))
                    shot = make_nerfstudio_frame(stem, view.hw, K, pose, view.lens, row["timestamp"])
                    shots.append(shot | {f"dhtorch_{name}": np.asarray(row[name]).tolist() for name in NUMBER_COLUMNS})
            if not shots:
                raise ValueError(f"{folder.name}: found no frame with a pose, expected poses (format=nerfstudio)")
            cameras = {view.name: tally.summary()}
            summary = storage.to_strict_json({"key": self.key, "number": k, "length": len(shots), "cameras": cameras})
            points = np.concatenate(cloud.parts)
            comment = "metres; world of transforms.json"
            write_ply(folder / _POINTS_FILE, points[:, :3], points[:, 3:].astype(np.uint8), comments=(comment,))
            contents = {
                "camera_model": "OPENCV",
                "depth_unit_scale_factor": _DEPTH_UNIT_M,
                "dhtorch": summary,
            }
            contents |= {"ply_file_path": _POINTS_FILE, "frames": shots}
            storage.write_json(self._file(k, key), contents)
        written = self.own(k)
        assert written is not None  # just written
        return written

    def planned_files(self, missing: Sequence[int]) -> list[Path]:
        """As :meth:`DatasetTarget.planned_files`."""
        files = [self._file(k, key) for k in missing for key in self.views]
        return [*files, *(file.with_name(_POINTS_FILE) for file in files)]

    def finish(self, owns: Sequence[Row]) -> None:
        """As :meth:`DatasetTarget.finish`: nothing to write, the folders are independent."""


class _PointCloud:
    """Coloured points (m, world of the recording) of some pixels of many frames."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []  # (P, 6) each: position, colour 0 to 255
        self.stride = 1

    def add(self, depth: np.ndarray, sigma: np.ndarray, row: Row, view: DatasetCamera, folder: Path) -> None:
        """Add pixels of a frame, evenly taken among those of small sigma.

        A sigma of a tenth of the depth has a confidence of one half, see :func:`encode_confidence`. 5000 points are a
        few times those that an image observes in COLMAP, 200,000 those of a larger COLMAP model.
        """
        chosen = np.flatnonzero((depth > 0) & (sigma <= 0.1 * depth))
        chosen = chosen[:: self.stride * max(1, -(-len(chosen) // 5000))]
        pixels = np.stack(np.unravel_index(chosen, depth.shape)[::-1], 1)  # u, v of the map
        uv = (pixels + 0.5) * np.divide(view.hw, view.map_hw)[::-1] - 0.5
        K, T = np.reshape(row["K"], (3, 3)), np.reshape(row["pose"], (4, 4))
        lens = torch.tensor([view.lens], dtype=torch.float64) if any(view.lens) else None
        camera = cameras.from_matrix(torch.from_numpy(K[None].astype(np.float64)), lens)
        z = torch.from_numpy(depth.astype(np.float64).flatten()[chosen])
        xyz = cameras.unproject(camera, torch.from_numpy(uv)[None], z[None])[0].numpy()
        column, line = (x.clip(0, n - 1) for x, n in zip(uv.round().astype(int).T, view.hw[::-1], strict=True))
        picture = np.broadcast_to(decode_image(row["picture"], folder / _POINTS_FILE), (3, *view.hw))
        xyz, rgb = xyz @ T[:3, :3].T + T[:3, 3], picture[:, line, column].T
        self.parts.append(np.concatenate((xyz, rgb), 1).astype(np.float32))
        if sum(map(len, self.parts)) > 2 * 200_000:
            self.parts, self.stride = [part[::2] for part in self.parts], 2 * self.stride


def make_nerfstudio_frame(
    stem: str,
    hw: Sequence[int],
    K: np.ndarray,  # (3, 3), pixel centres at integers
    T_world_from_cam: np.ndarray,  # (4, 4), OpenCV axes
    lens: Sequence[float] = (),  # OpenCV's order
    time: float = math.nan,  # s, NaN = none
) -> dict[str, Any]:
    """One entry of ``frames`` in a ``transforms.json``.

    ``timestamp`` and ``dhtorch_source_file_path`` (codes.Source of every depth) are no fields of nerfstudio, which
    ignores them; NeRFCapture writes the first, too.

    Raises:
        ValueError: more distortion coefficients than nerfstudio has.
    """
    if any(lens[len(_LENS_NAMES) :]):
        raise ValueError(f"nerfstudio: found {len(lens)} distortion coefficients, expected {' '.join(_LENS_NAMES)}")
    return {
        "file_path": f"images/{stem}.png",
        "depth_file_path": f"depth/{stem}.png",
        "confidence_file_path": f"confidence/{stem}.png",
        "dhtorch_source_file_path": f"source/{stem}.png",
        "w": int(hw[1]),
        "h": int(hw[0]),
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]) + 0.5,
        "cy": float(K[1, 2]) + 0.5,
        **{name: float(x) for name, x in zip(_LENS_NAMES, lens, strict=False)},
        **({"timestamp": float(time)} if math.isfinite(time) else {}),
        "transform_matrix": (np.asarray(T_world_from_cam, np.float64) @ _GL_FROM_CV).tolist(),
    }


def quantise_nerfstudio_depth(depth: np.ndarray) -> np.ndarray:
    """Depth (h, w) in m → uint16 steps, 0 = no depth; depths beyond the last step become 0."""
    z = np.rint(np.asarray(depth, np.float64) / _DEPTH_UNIT_M)
    return np.where((z >= 1) & (z <= 65534), z, 0).astype(np.uint16)


def encode_confidence(depth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Depth and sigma (h, w) in m → confidence (h, w) uint8, 0 = no depth.

    255 · s / (s + sigma / depth), at least 1, with s = :data:`_HALF_CONFIDENCE_SIGMA`.
    """
    valid = depth > 0
    ratio = np.where(valid, sigma, 1) / np.where(valid, depth, 1)
    return np.where(valid, np.rint(255 * _HALF_CONFIDENCE_SIGMA / (_HALF_CONFIDENCE_SIGMA + ratio)).clip(1), 0).astype(
        np.uint8
    )
