"""Table of test writers with one signature: the same frames as a small capture of every layout."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.records import Frame
from support.writers import image_folders
from support.writers.image_folders import write_colmap_capture, write_nerfstudio, write_polycam
from support.writers.lerobot import write_lerobot
from support.writers.phones import (
    write_arkitscenes,
    write_ca1m,
    write_r3d,
    write_record3d_exr,
    write_record3d_mp4,
    write_stray,
)
from support.writers.rlds import write_rlds

#: Range of depth of the Record3D film in m, which limits its step: 8 m in 1530 hues. Source: chosen for rooms.
_MP4_RANGE_M = (0.0, 8.0)

#: Upwards in the world of ARKitScenes. Source: its description.
_ARKITSCENES_UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class CaptureWriter:
    """Frames with image, depth, camera, time and pose → files of one layout."""

    write: Callable[[Path, Sequence[Frame]], object]
    format: str  # name of the reader
    step_m: float | None = None  # metres of one depth code; None = the layout stores metres, or rounds to no fixed step
    max_m: float | None = None  # largest depth that the layout holds; None = that of 16-bit codes, or no limit
    path: str = "."  # what to open, relative to the folder
    has_poses: bool = True
    up: Sequence[float] = (0.0, -1.0, 0.0)  # in the written world; in that of the frames −y, as in the built-in scenes
    is_exact: bool = True  # images and depth come back bit for bit, apart from the step of depth
    states_unit: bool = True  # whether the layout states the unit of its depth
    wants_even_sides: bool = False  # the images are stored as a film
    options: Mapping[str, object] = field(default_factory=dict)  # of the reader, so that images come back as written

    def holds(self, depth_m: float) -> bool:
        """Whether the layout stores a depth, m, instead of clipping it."""
        limit = self.max_m if self.step_m is None else 65534 * self.step_m
        return limit is None or depth_m <= limit

    def __call__(self, root: Path, frames: Sequence[Frame]) -> Path:
        """Write the capture below the folder ``root`` → the path to open."""
        self.write(root, frames)
        return root / self.path


#: Layout → its writer. Frames have B = 1, image and depth of one size unless the reader accepts others.
CAPTURE_WRITERS: Final[dict[str, CaptureWriter]] = {
    "named_frames": CaptureWriter(image_folders.write_named_frames, "frames_dir", 1 / 1000, states_unit=False),
    "counted_frames": CaptureWriter(image_folders.write_counted_frames, "frames_dir", 1 / 1000, states_unit=False),
    "tum": CaptureWriter(image_folders.write_tum, "tum", 1 / 5000, states_unit=False),
    "ros_tum": CaptureWriter(
        lambda root, frames: image_folders.write_ros_tum(root, frames, units_per_metre=5000),
        "tum",
        1 / 5000,
        states_unit=False,
    ),
    "icl_nuim": CaptureWriter(image_folders.write_icl_nuim, "tum", 1 / 5000),
    "bop": CaptureWriter(image_folders.write_bop, "bop", 1 / 10000),
    "replica": CaptureWriter(image_folders.write_replica, "replica", 1 / 6553.5, is_exact=False),
    "scannet": CaptureWriter(image_folders.write_scannet, "scannet", 1 / 1000, is_exact=False),
    "sens_folder": CaptureWriter(image_folders.write_sens_folder, "sens_folder", 1 / 1000, is_exact=False),
    "open3d": CaptureWriter(image_folders.write_open3d, "open3d", 1 / 1000, states_unit=False),
    "sun3d": CaptureWriter(image_folders.write_sun3d, "sun3d", 1 / 1000),
    "nerfstudio": CaptureWriter(write_nerfstudio, "nerfstudio", 1 / 1000),
    "nerfcapture": CaptureWriter(
        lambda root, frames: write_nerfstudio(
            root, frames, unit_key="integer_depth_scale", unit_m=10 / 65535, depth_key="depth_path", suffix=""
        ),
        "nerfstudio",
        10 / 65535,
    ),
    "polycam": CaptureWriter(write_polycam, "polycam", 1 / 1000),
    "colmap": CaptureWriter(write_colmap_capture, "colmap", 1 / 1000, states_unit=False),
    "stray": CaptureWriter(write_stray, "stray", 1 / 1000, up=ARKIT_UP, is_exact=False, wants_even_sides=True),
    "r3d": CaptureWriter(
        lambda root, frames: write_r3d(root / "capture.r3d", frames),
        "record3d",
        path="capture.r3d",
        up=ARKIT_UP,
        is_exact=False,
    ),
    "record3d_exr": CaptureWriter(write_record3d_exr, "record3d", up=ARKIT_UP, is_exact=False),
    "record3d_mp4": CaptureWriter(
        lambda root, frames: write_record3d_mp4(
            root / "capture.mp4", frames, depth_range=_MP4_RANGE_M, stored="yuv444p"
        ),
        "record3d",
        path="capture.mp4",
        has_poses=False,
        is_exact=False,
        wants_even_sides=True,
    ),
    "arkitscenes": CaptureWriter(
        lambda root, frames: write_arkitscenes(
            root / "41048190",
            {"vga_wide": frames, "lowres_depth": frames},
            trajectory=[turn_world(frame, _ARKITSCENES_UP) for frame in frames],
        ),
        "arkitscenes",
        1 / 1000,
        path="41048190",
        up=_ARKITSCENES_UP,
        options={"upright": False},
    ),
    "ca1m": CaptureWriter(
        lambda root, frames: write_ca1m(root / "ca1m-val-1.tar", frames, frames),
        "ca1m",
        1 / 1000,
        path="ca1m-val-1.tar",
    ),
    "lerobot": CaptureWriter(
        lambda root, frames: write_lerobot(root, [frames], image="image", depth="tiff"), "lerobot"
    ),
    "lerobot_png": CaptureWriter(
        lambda root, frames: write_lerobot(root, [frames], image="image", depth="png"),
        "lerobot",
        1 / 1000,
        states_unit=False,
    ),
    "lerobot_video": CaptureWriter(
        lambda root, frames: write_lerobot(root, [frames]),
        "lerobot",
        max_m=10.0,
        is_exact=False,
        wants_even_sides=True,
    ),
    "rlds": CaptureWriter(
        lambda root, frames: write_rlds(root / "1.0.0", [frames]), "rlds", 1 / 1000, path="1.0.0", states_unit=False
    ),
}
