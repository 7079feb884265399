"""Files and folders that no reader recognises: what each is or lacks, and what makes it a capture."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from dhtorch.data.codecs import video
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
#: Endings of files, other than images, that may hold depth.
_DEPTH_SUFFIXES: Final = (*_ARRAY_SUFFIXES, ".exr", ".tif", ".tiff", ".h5", ".hdf5", ".pgm", ".raw", ".bin")

#: Entries of a folder and of each level below that are looked at. Limits the time.
_MAX_ENTRIES: Final = 10_000
#: Folders and files that the description of a folder names. Limits its length.
_MAX_NAMED: Final = 5
#: What a capture without depth lacks, in messages.
NEEDS_DEPTH: Final = "sensor depth of near surfaces is required for metric scale"

#: What to write where no reader supports a layout.
_OWN_LAYOUT: Final = (
    "images/NAME.jpg, depth/NAME.png (16 bits, millimetres along the optical axis), K.txt and poses.txt (camera to "
    "world), see docs/data.md"
)


class _Layout(NamedTuple):
    """A layout of folders that is recognised by some of its files.

    A pattern is one of :meth:`pathlib.Path.glob`; ``|`` separates alternatives.
    """

    what: str
    signs: tuple[str, ...]  # it is this layout where all patterns, separated by spaces, of one of these are there
    parts: tuple[str, ...] = ()  # patterns of what must be there; those that are not are named
    remedy: str = _OWN_LAYOUT
    inner: str = ""  # folder of the parts where the capture has one, which alone is a sign
    is_read: bool = False  # whether a reader supports it when it is complete


#: Layouts, in the order of recognition. Source: descriptions of the apps and data sets of their own files.
_LAYOUTS: Final = (
    _Layout(
        "a Stray Scanner capture",
        (
            *("camera_matrix.csv", "odometry.csv depth/*|rgb.mp4", "imu.csv confidence/*"),
            *("rgb.mp4 confidence/*", "rgb.mp4 depth/000000.png|depth/000000.npy"),
        ),
        ("rgb.mp4", "depth/*", "odometry.csv", "camera_matrix.csv"),
        "the whole folder of the capture: share it from Stray Scanner again",
        is_read=True,
    ),
    _Layout(
        "an unpacked Record3D capture",
        ("metadata rgbd/*|icon", "rgbd/*.depth", "rgbd/0.jpg", "rgbd/0.conf"),
        ("metadata", "rgbd/*.jpg", "rgbd/*.depth"),
        "the .r3d file, which is read without unpacking: share it from Record3D again",
        is_read=True,
    ),
    _Layout(
        "an EXR + RGB export of Record3D",
        ("metadata.json rgb/0.jpg", "metadata.json depth/0.exr", "rgb/0.jpg depth/0.exr"),
        ("metadata.json", "rgb/*.jpg", "depth/*.exr"),
        "the whole folder: export it from Record3D again, or share the .r3d",
        inner="EXR_RGBD",
        is_read=True,
    ),
    _Layout(
        "Polycam's raw data",
        ("mesh_info.json cameras/*|corrected_cameras/*", "corrected_cameras/*", "corrected_images/*"),
        ("cameras/*.json|corrected_cameras/*.json", "images/*|corrected_images/*", "depth/*"),
        "all folders of keyframes/: export the raw data again (developer mode on before the scan) and unzip it",
        inner="keyframes",
        is_read=True,
    ),
    _Layout(
        "an ARKitScenes capture",
        ("lowres_wide/*", "lowres_depth/*", "vga_wide/*", "lowres_wide.traj"),
        ("lowres_wide/*|vga_wide/*|wide/*|color/*", "lowres_depth/*|highres_depth/*"),
        "these assets: download_data.py --raw_dataset_assets lowres_wide lowres_depth lowres_wide_intrinsics "
        "lowres_wide.traj",
        is_read=True,
    ),
    _Layout(
        "a TUM RGB-D sequence",
        ("rgb.txt", "groundtruth.txt rgb/*|depth/*"),
        ("rgb/*", "depth/*"),
        "both folders: unpack the sequence's archive again",
        is_read=True,
    ),
    _Layout(
        "a ScanNet export",
        ("intrinsic/intrinsic_color.txt|intrinsic/intrinsic_depth.txt",),
        ("color/*", "depth/*", "pose/*"),
        "the folders of SensReader: --export_depth_images --export_color_images --export_poses --export_intrinsics",
        is_read=True,
    ),
    _Layout(
        "a BOP scene",
        ("scene_camera.json",),
        ("rgb/*|gray/*", "depth/*"),
        "the whole folder of the scene",
        is_read=True,
    ),
    _Layout(
        "a COLMAP model",
        ("sparse/0/cameras.txt|sparse/cameras.txt depth/*",),
        ("images/*",),
        "its images beside sparse/ and depth/",
        is_read=True,
    ),
    _Layout(
        "an RTAB-Map export",
        ("calib/*.yaml rgb/*|depth/*",),
        ("rgb/*", "depth/*"),
        "rgb/ and depth/ with the same names: export the images again",
        is_read=True,
    ),
    _Layout(
        "an 'All data' export of 3D Scanner App",
        ("info.json frame_*.json", "frame_*.json depth_*.png", "frame_*.jpg depth_*.png|conf_*.png"),
        ("frame_*.jpg", "frame_*.json", "depth_*.png"),
        f"the whole export, written as {_OWN_LAYOUT}",
    ),
    _Layout("an AirSim recording", ("airsim_rec.txt",)),
    _Layout("a scene of Virtual KITTI 2", ("extrinsic.txt intrinsic.txt frames/*",)),
    _Layout("an MVSNet or BlendedMVS scene", ("cams/*_cam.txt",)),
    _Layout("KITTI's depth completion selection", ("velodyne_raw/* image/*|groundtruth_depth/*",)),
    _Layout("a Hypersim scene", ("_detail/metadata_scene.csv", "images/scene_cam_*_geometry_hdf5/*")),
    _Layout("AgiBot World data", ("observations/*/*/depth/* parameters/*|observations/*/*/videos/*",)),
    _Layout("an Isaac Sim (Replicator) recording", ("rgb/*|rgb_*.png distance_to_*", "rgb_*.png camera_params_*.json")),
    _Layout("a TartanAir trajectory", ("image_left/* depth_left/*", "image_lcam_front/* depth_lcam_front/*")),
    _Layout("a Kubric sequence", ("rgba_*.png depth_*.tif*",)),
    _Layout(
        "maps of MoGe",
        ("*/depth.exr */fov.json",),
        remedy="a capture with images; maps of one, a file for each frame in one folder, are an option: "
        "dhtorch validate CAPTURE --depth FOLDER",
    ),
    _Layout(
        "images beside depth maps of another type than PNG",
        (
            "images/*|image/*|rgb/*|color/* "
            "depth/*.npy|depth/*.npz|depth/*.tif|depth/*.tiff|depth/*.pfm|depth/*.exr|depth/*.pgm",
        ),
    ),
)


class _ForeignFile(NamedTuple):
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


def describe_foreign_file(file: Path) -> _ForeignFile | None:
    """What a file is and what converts it; None where its name's end is unknown."""
    name = file.name.lower()
    ends = [end for end in _CONVERTERS if name.endswith(end)]
    if ends:
        what, command = _CONVERTERS[max(ends, key=len)]
        return _ForeignFile(what, command.format(file.name))
    if file.suffix.lower() in _MODEL_SUFFIXES:
        return _ForeignFile("a finished 3D model without its frames", export=f"the frames, {PHONE_EXPORTS}")
    return (
        _ForeignFile(
            _describe_video(file),
            export=f"colour and depth, {PHONE_EXPORTS}" if file.suffix.lower() in (".mp4", ".mov") else None,
        )
        if file.suffix.lower() in _VIDEO_SUFFIXES
        else None
    )


def describe_layout(folder: Path, *, is_read: bool = False) -> _ForeignFile | None:
    """What a folder with files of a known layout is or lacks, and what to do; None for a folder of another layout.

    Args:
        folder: one that no reader recognises, or whose reader misses something.
        is_read: consider only layouts that a reader supports. These are described where a part is missing.
    """
    for layout in _LAYOUTS if folder.is_dir() else ():
        base = folder / layout.inner if layout.inner and (folder / layout.inner).is_dir() else folder
        if base is folder and not any(all(_has(base, each) for each in sign.split()) for sign in layout.signs):
            continue
        missing = [part.partition("|")[0].removesuffix("*") for part in layout.parts if not _has(base, part)]
        if missing and layout.is_read >= is_read:
            return _ForeignFile(f"{layout.what} without {', '.join(missing)}", export=layout.remedy)
        if not (layout.is_read or is_read):
            return _ForeignFile(f"{layout.what}, which no reader supports", export=layout.remedy)
    return None


def _has(folder: Path, pattern: str) -> bool:
    return any(any(folder.glob(each)) for each in pattern.split("|"))


def describe_content(folder: Path) -> str:
    """The files of a folder and of three levels below it, by folder and ending: ``rgb/ (5 .png), K.txt``."""
    names: dict[Path, list[str]] = {}
    for file in list_files(folder):
        names.setdefault(file.relative_to(folder).parent, []).append(file.name)
    places = sorted(names, key=lambda place: (len(place.parts), place))
    listed = [_count_by_suffix(place, sorted(names[place])) for place in places[:_MAX_NAMED]]
    return ", ".join([*listed, *(["…"] if len(places) > _MAX_NAMED else [])]) or "no files"


def _count_by_suffix(place: Path, names: list[str]) -> str:
    """The files of the folder ``place`` by their endings: ``rgb/ (5 .png)``; of one file of its kind the name."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(Path(name).suffix.lower() or name, []).append(name)
    counted = [same[0] if len(same) == 1 else f"{len(same)} {kind}" for kind, same in kinds.items()]
    listed = ", ".join([*counted[:_MAX_NAMED], *(["…"] if len(counted) > _MAX_NAMED else [])])
    return f"{place.as_posix()}/ ({listed})" if place.parts else listed


def may_hold_depth(folder: Path) -> bool:
    """Whether a name in a folder, or in three levels below it, is one that depth maps or arrays have."""
    return any(
        file.suffix.lower() in _DEPTH_SUFFIXES or "depth" in file.relative_to(folder).as_posix().lower()
        for file in list_files(folder)
    )


def list_files(folder: Path) -> Iterator[Path]:
    """Files in a folder and in three levels below it, up to ``_MAX_ENTRIES`` entries a level."""
    for pattern in ("*", "*/*", "*/*/*", "*/*/*/*"):
        for entry in islice(folder.glob(pattern), _MAX_ENTRIES):
            if entry.is_file() and not entry.name.startswith("."):
                yield entry


def describe_foreign_folder(folder: Path) -> _ForeignFile | None:
    """What a folder of a known layout, or of arrays alone, is or lacks, and what to do; None for other content."""
    if layout := describe_layout(folder):
        return layout
    entries = [entry for entry in sorted(folder.iterdir()) if entry.suffix.lower() not in ("", ".md", ".txt")]
    if not entries or any(entry.suffix.lower() not in _ARRAY_SUFFIXES for entry in entries):
        return None
    remedy = f"a capture with images; maps of one are an option: dhtorch validate CAPTURE --depth {folder}"
    return _ForeignFile(f"arrays ({entries[0].name}, …) and no images", export=remedy)


def _describe_video(file: Path) -> str:
    if file.suffix.lower() != ".mkv":
        return f"a video without depth; {NEEDS_DEPTH}"
    try:
        tracks = video.list_video_tracks(file)
    except FormatError as error:
        return f"a video that cannot be read ({error.args[1]}: {error.args[2]})"
    if len(tracks) < 2:
        return f"a video without depth; {NEEDS_DEPTH}"
    names = ", ".join(track.name or track.codec for track in tracks)
    return f"a video of the tracks {names}, none of which is called DEPTH; {NEEDS_DEPTH}"
