"""Small captures of every format that is read: how to write one below a folder, and how to open and read all of it."""

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import torch

from dhtorch.data.codecs import pickles, tiff
from dhtorch.data.readers import rh20t
from dhtorch.experiments.focal.stacks import FocalStack
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose
from support import record3d_captures, stray_frames, writers
from support.arkitscenes_frames import VGA, VGA_HW, shots
from support.box_scene import walk
from support.ca1m_archives import ca1m_archive
from support.damage_harness import read_all
from support.focal_stacks import light_field, random_stack
from support.pickled_values import plain_values
from support.rh20t_frames import BASE, FIXED, HAND, moving, still
from support.robot_episodes import three_episodes, two_episodes
from support.writers import focal as stack_writers
from support.writers.azure_kinect import write_azure_kinect
from support.writers.rosbag import BagLayout, write_rosbag
from support.writers.simulator_hdf5 import write_simulator_hdf5


def small_walk(n: int = 3) -> list[Frame]:
    """A short walk inside the box with depth at every pixel of 24 x 32."""
    return walk(n, hw=(24, 32))


def pair_writer(write: Callable[[Path, Frame, Frame], None]) -> Callable[[Path], None]:
    """The function that writes a stereo pair with a baseline of 12.5 cm by ``write``."""

    def write_pair(root: Path) -> None:
        left = small_walk(1)[0]
        left = left.replace(
            camera=left.camera.replace(f=left.camera.f[:, :1].expand(1, 2)),
            T_world_from_cam=se3.identity(1, torch.zeros(1).double()),
        )
        away = Pose(left.T_world_from_cam.R, torch.tensor([[0.125, 0, 0]], dtype=torch.float64))
        write(root, left, left.replace(T_world_from_cam=away))

    return write_pair


def read_rh20t(root: Path) -> None:
    """Reads frames and robot streams of an RH20T scene."""
    read_all(root)
    rh20t.read_robot_streams(root)


def bag_writer(layout: BagLayout) -> Callable[[Path], Path]:
    """The function that writes a bag of that layout."""

    def write(root: Path) -> Path:
        path = root / ("a.bag" if layout.storage == "ros1" else "bag")
        write_rosbag(path, small_walk(), layout)
        if layout.storage == "mcap":  # the file alone, without its metadata.yaml
            (file,) = path.glob("*.mcap")
            file.rename(root / "a.mcap")
            shutil.rmtree(path)
            return root / "a.mcap"
        return path

    return write


def at(path: str, write: Callable[[Path], object]) -> Callable[[Path], Path]:
    """The function that writes below a folder by ``write`` and returns what to open there."""

    def write_below(root: Path) -> Path:
        write(root)
        return root / path

    return write_below


def arkitscenes() -> dict[str, list[Frame]]:
    """Assets of an ARKitScenes capture with laser depth."""
    frames = shots(100 + np.arange(3) / 60)
    return {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": shots([100.0], VGA, VGA_HW)}


def focal_splits() -> dict[str, list[FocalStack]]:
    """Focal stacks of two splits."""
    return {"train": [random_stack(0, 10), random_stack(1, 10)], "val": [random_stack(2, 10)]}


def kinect() -> list[Frame]:
    """Frames with depth of the device's size."""
    return [frame.replace(depth=torch.ones(1, 288, 320)) for frame in walk(2, hw=(36, 64))]


AT_REST = se3.identity(1, torch.zeros(1).double())
STANDSTILL = Pose(torch.eye(3).double().expand(3, 3, 3), torch.zeros(3, 3).double())
ARKIT_VIDEO = "raw/Training/41048190"

#: Bags need the library rosbags to be written.
BAGS: dict[str, Callable[[Path], Path]] = (
    {}
    if importlib.util.find_spec("rosbags") is None
    else {
        "rosbag_mcap": bag_writer(BagLayout(colour_encoding="png", T_colour_from_depth=np.eye(4), depth_frame="depth")),
        "rosbag_sqlite": bag_writer(BagLayout(storage="sqlite3", depth_encoding="32FC1 png")),
        "rosbag_ros1": bag_writer(BagLayout(storage="ros1", colour_encoding="png")),
        "rosbag_ros1_lz4": bag_writer(BagLayout(storage="ros1", compression="lz4")),
    }
)

Sample = tuple[Callable[[Path], Path | None], Callable[[Path], Any]]

#: By format: a function that writes a small capture below a folder and returns what to open (None = the folder), and
#: one that opens and reads all of it.
SAMPLES: dict[str, Sample] = {
    **{
        name: (write, read_all)
        for name, write in {
            "tum": lambda root: writers.write_tum(root, small_walk()),
            "named": lambda root: writers.write_named_frames(root, small_walk(), fps=30),
            "unregistered": lambda root: writers.write_named_frames(
                root, [f.replace(depth_camera=f.camera) for f in small_walk()], fps=30
            ),
            "counted": lambda root: writers.write_counted_frames(root, small_walk()),
            "icl_nuim": lambda root: writers.write_icl_nuim(root, small_walk()),
            "ros_tum": lambda root: writers.write_ros_tum(root, small_walk()),
            "bop": lambda root: writers.write_bop(root, small_walk()),
            "replica": lambda root: writers.write_replica(root, small_walk()),
            "scannet": lambda root: writers.write_scannet(root, small_walk(), lost=[1]),
            "sens_folder": lambda root: writers.write_sens_folder(root, small_walk()),
            "open3d": lambda root: writers.write_open3d(root, small_walk()),
            "sun3d": lambda root: writers.write_sun3d(root, small_walk()),
            "driving": lambda root: writers.write_driving(root, {"FRONT": small_walk()}, STANDSTILL),
            "calib_pair": pair_writer(writers.write_calib_pair),
            "npz_pair": pair_writer(writers.write_npz_pair),
            "arkitscenes": at(
                ARKIT_VIDEO,
                lambda root: writers.write_arkitscenes(
                    root / ARKIT_VIDEO, arkitscenes(), trajectory=shots(100 + np.arange(3) / 60)
                ),
            ),
            "ca1m": lambda root: ca1m_archive(root, n=2)[0],
            "record3d_archive": record3d_captures.r3d_archive,
            "record3d_exr": lambda root: writers.write_record3d_exr(root, record3d_captures.walk()),
            "record3d_mp4": lambda root: record3d_captures.rgbd_video(root)[0],
            "stray": lambda root: writers.write_stray(root, stray_frames.walk(), per_frame=True),
            "stray_old": lambda root: writers.write_stray(
                root, stray_frames.walk(), depth_format="npy", codec="libx265", first_picture="lost"
            ),
            "lerobot_v3": lambda root: writers.write_lerobot(
                root, [two_episodes()[0], two_episodes()[1][:2]], depth="video"
            ),
            "lerobot_v2": lambda root: writers.write_lerobot(
                root, two_episodes()[:1], version=2, image="image", depth="tiff", intrinsics="side-car"
            ),
            "rlds": at("1.0.0", lambda root: writers.write_rlds(root / "1.0.0", three_episodes()[:2])),
            "rlds_array": at(
                "1.0.0",
                lambda root: writers.write_rlds(root / "1.0.0", three_episodes()[:1], depth="array", has_size=False),
            ),
            "nerfstudio": lambda root: writers.write_nerfstudio(root, small_walk()),
            "polycam": lambda root: writers.write_polycam(root, small_walk()),
            "colmap": lambda root: writers.write_colmap_capture(root, small_walk()),
            "simulator_hdf5": at(
                "a.h5", lambda root: write_simulator_hdf5(root / "a.h5", [small_walk(2)], "maniskill3")
            ),
            "azure_kinect": at(
                "a.mkv", lambda root: write_azure_kinect(root / "a.mkv", kinect(), T_colour_from_depth=AT_REST)
            ),
            **BAGS,
            "fod500": lambda root: stack_writers.write_fod500(root, {0: random_stack(0), 1: random_stack(1)}),
            "ddff12": at(
                "a.h5", lambda root: stack_writers.write_ddff12(root / "a.h5", focal_splits(), compression="gzip")
            ),
            "light_field": lambda root: stack_writers.write_light_field(
                root, "train/a", 1, light_field(torch.tensor(0.1), (12, 16), 3), torch.ones(1, 12, 16)
            ),
            "images": at(
                "focus_stack", lambda root: stack_writers.write_image_folder(root / "focus_stack", random_stack(0, 3))
            ),
        }.items()
    },
    "rh20t": (
        lambda root: writers.write_rh20t(root, {FIXED: still(2), HAND: moving(2)}, T_world_from_base=BASE),
        read_rh20t,
    ),
    "pickle": (at("x.npy", lambda root: np.save(root / "x.npy", plain_values(), allow_pickle=True)), pickles.read_npy),
    "tiff": (
        at(
            "a.tiff",
            lambda root: tifffile.imwrite(
                root / "a.tiff", np.ones((40, 50), np.float32), compression="zlib", predictor=True
            ),
        ),
        tiff.read_tiff,
    ),
}
