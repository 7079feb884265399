"""Files that no reader supports: what each is, and the command that converts it."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

from dhtorch.data.codecs import matroska
from dhtorch.data.io.decode import FormatError

_ZED: Final = ("a ZED recording", "ZED_SVO_Export {} FOLDER 4 (ZED SDK: left pictures and 16-bit depth)")
_ARCHIVE: Final = "an archive, unpack it first"

#: Name's end → what the file is and the command that converts it; ``{}`` stands for its name. The longest end counts.
_CONVERTERS: Final = {
    ".zip": (_ARCHIVE, "unzip {}"),
    **dict.fromkeys((".tar.gz", ".tgz", ".tar.xz", ".tar.bz2", ".tar.zst"), (_ARCHIVE, "tar -xf {}")),
    ".gz": (_ARCHIVE, "gunzip {}"),
    ".xz": (_ARCHIVE, "unxz {}"),
    ".bz2": (_ARCHIVE, "bunzip2 {}"),
    ".zst": (_ARCHIVE, "zstd -d {}"),
    ".zstd": (_ARCHIVE, "zstd -d {}"),
    ".7z": (_ARCHIVE, "7z x {}"),
    ".rar": (_ARCHIVE, "unrar x {}"),
    ".svo": _ZED,
    ".svo2": _ZED,
    ".sens": (
        "a ScanNet recording",
        "python reader.py --filename {} --output_path FOLDER --export_depth_images --export_color_images --export_poses"
        " --export_intrinsics (ScanNet/SensReader/python)",
    ),
    ".oni": (
        "an OpenNI recording",
        "pyonitool.py --extractcolor FOLDER/images --extractdepth FOLDER/depth {} (github.com/eruffaldi/pyoni)",
    ),
    ".klg": ("an ElasticFusion log", "klg2png {} FOLDER/images FOLDER/depth 640 480 (github.com/wonhkim/klg2png)"),
    ".xef": ("a Kinect Studio recording", "xefextract {} (github.com/Isaac-W/KinectXEFTools)"),
    ".vrs": ("a VRS recording", "vrs extract-all {} --to FOLDER (github.com/facebookresearch/vrs)"),
    ".bag.active": ("a ROS 1 bag that was not closed", "rosbag reindex {}"),
}
#: What to export from the apps of phones.
PHONE_EXPORTS: Final = (
    "from a phone: Record3D's .r3d or EXR + RGB export, Stray Scanner's folder, Polycam's raw data (developer mode on "
    "before the scan; unzip it). Scaniverse exports finished models only: scan with one of these"
)

#: Endings of finished models, which no longer have the frames they were made from.
_MODEL_SUFFIXES: Final = (
    *(".usdz", ".usdc", ".usda", ".obj", ".fbx", ".stl", ".glb", ".gltf", ".dae", ".ply", ".las", ".laz", ".e57"),
    *(".splat", ".spz", ".pts", ".xyz"),
)
#: Endings of single arrays, which hold the maps of a depth network and no pictures.
_ARRAY_SUFFIXES: Final = (".npy", ".npz", ".pfm")
_VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".avi", ".mkv", ".webm")
#: What a capture without depth lacks, in messages.
NEEDS_DEPTH: Final = "sensor depth of near surfaces is required for metric scale"


class ForeignFile(NamedTuple):
    """What a file is, and the command that converts it."""

    what: str
    command: str | None = None
    export: str | None = None  # what to export instead

    @property
    def remedy(self) -> str | None:
        """What an error names as expected; None where there is neither a command nor another export."""
        if self.export is not None:
            return self.export
        return None if self.command is None else f"the files that this command writes: {self.command}"


def describe_foreign_file(file: Path) -> ForeignFile | None:
    """What a file is and what converts it; None where its name's end is unknown."""
    name = file.name.lower()
    ends = [end for end in _CONVERTERS if name.endswith(end)]
    if ends:
        what, command = _CONVERTERS[max(ends, key=len)]
        return ForeignFile(what, command.format(file.name))
    if file.suffix.lower() in _MODEL_SUFFIXES:
        return ForeignFile("a finished 3D model without its frames", export=f"the frames, {PHONE_EXPORTS}")
    return (
        ForeignFile(_describe_video(file), export=_export_of_video(file))
        if file.suffix.lower() in _VIDEO_SUFFIXES
        else None
    )


def describe_foreign_folder(folder: Path) -> ForeignFile | None:
    """What a folder of arrays alone is, and where its maps can be used; None for a folder of other content."""
    entries = [entry for entry in sorted(folder.iterdir()) if entry.suffix.lower() not in ("", ".md", ".txt")]
    if not entries or any(entry.suffix.lower() not in _ARRAY_SUFFIXES for entry in entries):
        return None
    remedy = f"a capture with images; maps of one are an option: dhtorch validate CAPTURE --depth {folder}"
    return ForeignFile(f"arrays ({entries[0].name}, …) and no images", export=remedy)


def _export_of_video(file: Path) -> str | None:
    """What to export instead of a phone's plain video; None for videos of other devices."""
    return f"colour and depth, {PHONE_EXPORTS}" if file.suffix.lower() in (".mp4", ".mov") else None


def _describe_video(file: Path) -> str:
    if file.suffix.lower() != ".mkv":
        return f"a video without depth; {NEEDS_DEPTH}"
    try:
        tracks = matroska.list_video_tracks(file)
    except FormatError as error:
        return f"a video that cannot be read ({error.args[1]}: {error.args[2]})"
    if len(tracks) < 2:
        return f"a video without depth; {NEEDS_DEPTH}"
    names = ", ".join(track.name or track.codec for track in tracks)
    return f"a video of the tracks {names}, none of which is called DEPTH; {NEEDS_DEPTH}"
