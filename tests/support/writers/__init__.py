"""Test writers: frames -> a small, complete capture of every supported format.

They serve to test readers on scenes with exactly known geometry, and to show a format in a notebook without a download.
They share no code with the decoders: PNG bytes, for example, are assembled here. Frames have B = 1 and their poses in
``T_world_from_cam``.
"""

from dhtorch.synthetic.rh20t import write_rh20t
from support.writers.captures import CAPTURE_WRITERS, CaptureWriter
from support.writers.image_folders import (
    write_bop,
    write_calib_pair,
    write_colmap_capture,
    write_counted_frames,
    write_driving,
    write_icl_nuim,
    write_named_frames,
    write_nerfstudio,
    write_npz_pair,
    write_open3d,
    write_polycam,
    write_replica,
    write_ros_tum,
    write_scannet,
    write_sens_folder,
    write_sun3d,
    write_tum,
)
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

__all__ = [
    "CAPTURE_WRITERS",
    "CaptureWriter",
    "write_arkitscenes",
    "write_bop",
    "write_ca1m",
    "write_calib_pair",
    "write_colmap_capture",
    "write_counted_frames",
    "write_driving",
    "write_icl_nuim",
    "write_lerobot",
    "write_named_frames",
    "write_nerfstudio",
    "write_npz_pair",
    "write_open3d",
    "write_polycam",
    "write_r3d",
    "write_record3d_exr",
    "write_record3d_mp4",
    "write_replica",
    "write_rh20t",
    "write_rlds",
    "write_ros_tum",
    "write_scannet",
    "write_sens_folder",
    "write_stray",
    "write_sun3d",
    "write_tum",
]
