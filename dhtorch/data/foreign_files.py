"""Files that no reader supports: what each is, and the command that converts it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from dhtorch.data.codecs import matroska
from dhtorch.data.io.decode import FormatError

_UNPACK: Final = "an archive, unpack it first: {}"
_TAR: Final = _UNPACK.format("tar -xf {}")

#: Name's end → description of the file; ``{}`` stands for its name. The longest end that fits counts.
_DESCRIPTIONS: Final = {
    ".zip": _UNPACK.format("unzip {}"),
    ".tar.gz": _TAR,
    ".tgz": _TAR,
    ".tar.xz": _TAR,
    ".tar.bz2": _TAR,
    ".tar.zst": _TAR,
    ".gz": _UNPACK.format("gunzip {}"),
    ".xz": _UNPACK.format("unxz {}"),
    ".bz2": _UNPACK.format("bunzip2 {}"),
    ".zst": _UNPACK.format("zstd -d {}"),
    ".zstd": _UNPACK.format("zstd -d {}"),
    ".7z": _UNPACK.format("7z x {}"),
    ".rar": _UNPACK.format("unrar x {}"),
    ".svo": "a ZED recording; convert it: ZED_SVO_Export {} FOLDER 4 (ZED SDK; left pictures and 16-bit depth)",
    ".svo2": "a ZED recording; convert it: ZED_SVO_Export {} FOLDER 4 (ZED SDK; left pictures and 16-bit depth)",
    ".sens": "a ScanNet recording; convert it: python reader.py --filename {} --output_path FOLDER"
    " --export_depth_images --export_color_images --export_poses --export_intrinsics (ScanNet/SensReader/python)",
    ".oni": "an OpenNI recording; convert it: pyonitool.py --extractcolor FOLDER/images --extractdepth FOLDER/depth {}"
    " (github.com/eruffaldi/pyoni)",
    ".klg": "an ElasticFusion log; convert it: klg2png {} images depth 640 480 (github.com/wonhkim/klg2png)",
    ".xef": "a Kinect Studio recording; convert it: xefextract {} (github.com/Isaac-W/KinectXEFTools)",
    ".vrs": "a VRS recording; convert it: vrs extract-all {} --to FOLDER (github.com/facebookresearch/vrs)",
    ".bag.active": "a ROS 1 bag that was not closed; mend it: rosbag reindex {}",
}
_VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".avi", ".mkv", ".webm")
_NO_DEPTH: Final = "sensor depth of near surfaces is required for metric scale"


def describe_foreign_file(file: Path) -> str | None:
    """What a file is and what converts it; None where its name's end is unknown."""
    name = file.name.lower()
    ends = [end for end in _DESCRIPTIONS if name.endswith(end)]
    if ends:
        return _DESCRIPTIONS[max(ends, key=len)].format(file.name)
    return _describe_video(file) if file.suffix.lower() in _VIDEO_SUFFIXES else None


def _describe_video(file: Path) -> str:
    if file.suffix.lower() != ".mkv":
        return f"a video without depth; {_NO_DEPTH}"
    try:
        tracks = matroska.list_video_tracks(file)
    except FormatError as error:
        return f"a video that cannot be read ({error.args[1]}: {error.args[2]})"
    if len(tracks) < 2:
        return f"a video without depth; {_NO_DEPTH}"
    names = ", ".join(track.name or track.codec for track in tracks)
    return f"a video of the tracks {names}, none of which is called DEPTH; {_NO_DEPTH}"
