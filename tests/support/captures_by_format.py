"""Small captures of every format that is read: how to write one below a folder, and how to open and read all of it."""

from __future__ import annotations

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


# ------------------------------------------------------------------------------------------------ frames in folders


def write_tum(root: Path) -> None:
    """A TUM RGB-D sequence."""
    writers.write_tum(root, small_walk())


def write_named(root: Path) -> None:
    """Frames whose files are named by their times."""
    writers.write_named_frames(root, small_walk(), fps=30)


def write_unregistered(root: Path) -> None:
    """Frames with a depth camera, whose files are named by their times."""
    frames = small_walk()
    writers.write_named_frames(root, [f.replace(depth_camera=f.camera) for f in frames], fps=30)


def write_driving(root: Path) -> None:
    """A log of one camera on a car that stands still."""
    standstill = Pose(torch.eye(3).double().expand(3, 3, 3), torch.zeros(3, 3).double())
    writers.write_driving(root, {"FRONT": small_walk()}, standstill)


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


# ------------------------------------------------------------------------------------------------ phones


def write_arkitscenes(root: Path) -> Path:
    """An ARKitScenes capture with laser depth."""
    root = root / "raw" / "Training" / "41048190"
    frames = shots(100 + np.arange(3) / 60)
    assets = {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": shots([100.0], VGA, VGA_HW)}
    writers.write_arkitscenes(root, assets, trajectory=frames)
    return root


def write_stray(root: Path) -> None:
    """A Stray Scanner capture with a camera in every row."""
    writers.write_stray(root, stray_frames.walk(), per_frame=True)


def write_old_stray(root: Path) -> None:
    """A Stray Scanner capture of an older version, whose video lacks its first picture."""
    writers.write_stray(root, stray_frames.walk(), depth_format="npy", codec="libx265", first_picture="lost")


# ------------------------------------------------------------------------------------------------ robots


def write_lerobot_v3(root: Path) -> None:
    """A LeRobot v3 data set with depth in a video."""
    first, second = two_episodes()
    writers.write_lerobot(root, [first, second[:2]], depth="video")


def write_lerobot_v2(root: Path) -> None:
    """A LeRobot v2.1 data set with pictures in tables and intrinsics in a file beside."""
    writers.write_lerobot(root, two_episodes()[:1], version=2, image="image", depth="tiff", intrinsics="side-car")


def write_rlds(root: Path) -> Path:
    """An RLDS data set of two episodes."""
    writers.write_rlds(root / "1.0.0", three_episodes()[:2])
    return root / "1.0.0"


def write_rlds_array(root: Path) -> Path:
    """An RLDS data set with depth as an array, whose features do not name their encoding."""
    writers.write_rlds(root / "1.0.0", three_episodes()[:1], depth="array", has_size=False)
    return root / "1.0.0"


def write_rh20t(root: Path) -> Path:
    """An RH20T scene with a fixed camera and one on the hand."""
    return writers.write_rh20t(root, {FIXED: still(2), HAND: moving(2)}, T_world_from_base=BASE)


def read_rh20t(root: Path) -> None:
    """Reads frames and robot streams of an RH20T scene."""
    read_all(root)
    rh20t.read_robot_streams(root)


def write_simulator(root: Path) -> Path:
    """A ManiSkill file of one episode."""
    write_simulator_hdf5(root / "a.h5", [small_walk(2)], "maniskill3")
    return root / "a.h5"


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


def write_kinect(root: Path) -> Path:
    """An Azure Kinect video of both cameras with its calibration."""
    frames = [frame.replace(depth=torch.ones(1, 288, 320)) for frame in walk(2, hw=(36, 64))]
    write_azure_kinect(root / "a.mkv", frames, T_colour_from_depth=se3.identity(1, torch.zeros(1).double()))
    return root / "a.mkv"


# ------------------------------------------------------------------------------------------------ focal stacks, files


def write_ddff12(root: Path) -> Path:
    """A DDFF 12-Scene file of two splits."""
    train, val = [random_stack(0, 10), random_stack(1, 10)], [random_stack(2, 10)]
    stack_writers.write_ddff12(root / "a.h5", {"train": train, "val": val}, compression="gzip")
    return root / "a.h5"


def write_light_field(root: Path) -> None:
    """A raw light field of DDFF 12-Scene with its depth."""
    field = light_field(torch.tensor(0.1), (12, 16), 3)
    stack_writers.write_light_field(root, "train/a", 1, field, torch.ones(1, 12, 16))


def write_focus_stack(root: Path) -> Path:
    """A folder of images that is named as a focal stack."""
    stack_writers.write_image_folder(root / "focus_stack", random_stack(0, 3))
    return root / "focus_stack"


def write_pickle(root: Path) -> Path:
    """A pickled ``.npy`` file."""
    np.save(root / "x.npy", plain_values(), allow_pickle=True)
    return root / "x.npy"


def write_tiff(root: Path) -> Path:
    """A compressed TIFF of float32 numbers."""
    tifffile.imwrite(root / "a.tiff", np.ones((40, 50), np.float32), compression="zlib", predictor=True)
    return root / "a.tiff"


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
            "tum": write_tum,
            "named": write_named,
            "unregistered": write_unregistered,
            "counted": lambda root: writers.write_counted_frames(root, small_walk()),
            "icl_nuim": lambda root: writers.write_icl_nuim(root, small_walk()),
            "ros_tum": lambda root: writers.write_ros_tum(root, small_walk()),
            "bop": lambda root: writers.write_bop(root, small_walk()),
            "replica": lambda root: writers.write_replica(root, small_walk()),
            "scannet": lambda root: writers.write_scannet(root, small_walk(), lost=[1]),
            "sens_folder": lambda root: writers.write_sens_folder(root, small_walk()),
            "open3d": lambda root: writers.write_open3d(root, small_walk()),
            "sun3d": lambda root: writers.write_sun3d(root, small_walk()),
            "driving": write_driving,
            "calib_pair": pair_writer(writers.write_calib_pair),
            "npz_pair": pair_writer(writers.write_npz_pair),
            "arkitscenes": write_arkitscenes,
            "ca1m": lambda root: ca1m_archive(root, n=2)[0],
            "record3d_archive": record3d_captures.r3d_archive,
            "record3d_exr": lambda root: writers.write_record3d_exr(root, record3d_captures.walk()),
            "record3d_mp4": lambda root: record3d_captures.rgbd_video(root)[0],
            "stray": write_stray,
            "stray_old": write_old_stray,
            "lerobot_v3": write_lerobot_v3,
            "lerobot_v2": write_lerobot_v2,
            "rlds": write_rlds,
            "rlds_array": write_rlds_array,
            "nerfstudio": lambda root: writers.write_nerfstudio(root, small_walk()),
            "polycam": lambda root: writers.write_polycam(root, small_walk()),
            "colmap": lambda root: writers.write_colmap_capture(root, small_walk()),
            "simulator_hdf5": write_simulator,
            "azure_kinect": write_kinect,
            **BAGS,
            "fod500": lambda root: stack_writers.write_fod500(root, {0: random_stack(0), 1: random_stack(1)}),
            "ddff12": write_ddff12,
            "light_field": write_light_field,
            "images": write_focus_stack,
        }.items()
    },
    "rh20t": (write_rh20t, read_rh20t),
    "pickle": (write_pickle, pickles.read_npy),
    "tiff": (write_tiff, tiff.read_tiff),
}
