"""Depth of LeRobot data sets: the depth feature of a camera, and its images or video codes -> metres.

A depth video holds 12-bit codes (:mod:`dhtorch.data.depth_codes`). A video of more bits without a stated range holds
steps of a unit, as images and arrays do.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data.codecs.tiff import decode_tiff, decode_tiff_header
from dhtorch.data.codecs.video import read_video_header
from dhtorch.data.depth_codes import CODE_BITS, DEFAULT_RANGE, N_CODES, find_return_range, metres_by_code
from dhtorch.data.io import decode as files
from dhtorch.data.readers.lerobot_meta import LeRobotEpisode, LeRobotFeature, LeRobotMeta, select_colour_keys
from dhtorch.data.readers.lerobot_rows import read_encoded_image
from dhtorch.data.units import UNIT_METRES, DepthUnit

_GREY = "gray"  # start of FFmpeg's names of pixel formats with one channel


class _PixelType(NamedTuple):
    """Type of the stored pixels of a feature."""

    name: str  # such as gray12le, uint16, float32
    bits: int  # per channel
    channels: int


def flag_unmarked_depth(
    meta: LeRobotMeta, episode: LeRobotEpisode, requested: str | None
) -> tuple[LeRobotMeta, tuple[str, ...]]:
    """Flag features that are depth by their pixels: one channel of more than 8 bits, without ``is_depth_map``.

    Returns:
        The metadata with these features flagged, and a remark on each that is not ``requested``.

    Raises:
        FormatError: a damaged video or image of the episode.
    """
    features, remarks = dict(meta.features), list[str]()
    for key, feature in meta.features.items():
        if feature.dtype not in ("video", "image") or feature.is_depth:
            continue
        if feature.channels != 1 and not str(_stated_pixel_format(feature)).startswith(_GREY):
            continue
        if key in episode.videos and not episode.videos[key][0].is_file():
            continue
        pixels = _read_pixel_type(meta, feature, episode, 0)
        if pixels.channels != 1 or pixels.bits <= 8:
            continue
        features[key] = replace(feature, info={**feature.info, "is_depth_map": True})
        if key != requested:
            remark = f"{key} looks like depth: one channel, {pixels.name}, without is_depth_map"
            remarks.append(f"{remark}; data.depth={key} sets it")
    return replace(meta, features=features), tuple(remarks)


def find_depth_unit(meta: LeRobotMeta, feature: LeRobotFeature, episode: LeRobotEpisode, row: int) -> DepthUnit | None:
    """Unit of the stored depth; None = a video of LeRobot's codes, whose range defines metres.

    ``depth_unit`` of the feature's info, for an array also ``unit`` (as ``dhtorch enrich`` writes it), else m for
    floats and mm for integers, as in LeRobot. ``row`` of the table holds an image of the episode.

    Raises:
        FormatError: an unknown unit, or a damaged image or video.
    """
    if feature.dtype == "video":
        has_range = any(f"{prefix}{name}" in feature.info for name in DEFAULT_RANGE for prefix in ("", "video."))
        if has_range or _read_pixel_type(meta, feature, episode, row).bits <= CODE_BITS:
            return None
        return DepthUnit(UNIT_METRES["mm"])
    entry = "unit" if feature.dtype != "image" and "depth_unit" not in feature.info else "depth_unit"
    stated = feature.info.get(entry)
    if stated is None:
        is_float = _read_pixel_type(meta, feature, episode, row).name.startswith("float")
        return DepthUnit(UNIT_METRES["m" if is_float else "mm"])
    if not isinstance(stated, str) or stated not in UNIT_METRES:
        expected = f"one of {', '.join(UNIT_METRES)}"
        raise files.FormatError(meta.root / "meta" / "info.json", f"{feature.key} {entry}", stated, expected)
    return DepthUnit(UNIT_METRES[stated], f"meta/info.json: {feature.key} {entry}")


def _stated_pixel_format(feature: LeRobotFeature) -> str | None:
    """FFmpeg's name of a video's pixel format in the feature's info; None = not stated."""
    stated = feature.info.get("video.pix_fmt", feature.info.get("pix_fmt"))
    return stated if isinstance(stated, str) else None


def _read_pixel_type(meta: LeRobotMeta, feature: LeRobotFeature, episode: LeRobotEpisode, row: int) -> _PixelType:
    """Type of a feature's pixels: from its info or the header of its video or of the image in ``row``."""
    if feature.dtype == "video":
        name = _stated_pixel_format(feature) or read_video_header(episode.videos[feature.key][0]).pixels
        bits = re.search(r"(\d+)[lb]e$", name)
        return _PixelType(name, int(bits[1]) if bits else 8, 1 if name.startswith(_GREY) else feature.channels)
    if feature.dtype != "image":
        return _PixelType(feature.dtype, 8 * np.dtype(feature.dtype).itemsize, 1)
    data, file = read_encoded_image(episode.data, meta.root, feature.key, row)
    if data[:2] in (b"II", b"MM"):
        tiff = decode_tiff_header(data, file)
        return _PixelType(str(tiff.dtype), 8 * tiff.dtype.itemsize, tiff.samples)
    header = files.decode_image_header(data, file)
    return _PixelType(f"uint{header.bits}", header.bits, header.channels)


def find_depth_feature(meta: LeRobotMeta, camera: str, requested: str | None) -> LeRobotFeature | None:
    """The depth feature of a camera: as ``requested``, named like the camera, enriched, or the only one; else None."""
    depths = {key: f for key, f in meta.features.items() if f.is_depth and len(f.shape) >= 2}
    if requested is not None:
        files.refuse_if(
            requested not in meta.features or len(meta.features[requested].shape) < 2,
            meta.root,
            "option depth",
            requested,
            f"one of {', '.join(depths) or 'none'}",
        )
        return meta.features[requested]
    matching = [f for key, f in depths.items() if _distinctive_words(key) == _distinctive_words(camera)]
    if len(matching) == 1:
        return matching[0]
    if (enriched := f"{camera}_depth_enriched") in depths:  # by dhtorch enrich, of a source with a depth video
        return depths[enriched]
    return next(iter(depths.values())) if len(depths) == 1 and len(select_colour_keys(meta)) == 1 else None


def find_origin_feature(meta: LeRobotMeta, camera: str, depth: LeRobotFeature) -> LeRobotFeature | None:
    """The map of codes.Source that ``dhtorch enrich`` wrote beside its depth; None for depth of another writer."""
    origin = meta.features.get(f"{camera}_dhtorch_source")
    return origin if origin is not None and "quantiser_step_m" in depth.info and origin.hw == depth.hw else None


def _distinctive_words(key: str) -> frozenset[str]:
    """The words of a key without those that name the kind of image (rgb, depth, images, …)."""
    kinds = {"observation", "images", "image", "depth", "depths", "rgb", "color", "colour", ""}
    return frozenset(re.split(r"[._\-]", key.lower())) - kinds


def dequantise_depth(feature: LeRobotFeature, codes: np.ndarray, file: Path) -> np.ndarray:
    """12-bit codes (h, w) → depth in m, 0 = no return.

    Raises:
        FormatError: codes of more bits, or an invalid range in the feature's info.
    """
    files.refuse_if(
        codes.dtype != np.uint16 or codes.max(initial=0) >= N_CODES,
        file,
        f"{feature.key} pixels",
        f"{codes.dtype} up to {codes.max(initial=0)}",
        "12-bit codes",
    )
    metres = metres_by_code(feature.info, feature.key, file)
    low, high = find_return_range(feature.info, feature.key, file)
    return np.where((metres > low) & (metres <= high), metres, 0.0)[codes]


def decode_depth_picture(data: bytes, file: Path, hw: tuple[int, int]) -> np.ndarray:
    """TIFF or 16-bit PNG → numbers (h, w) as stored.

    Raises:
        FormatError: another format or size.
    """
    if data[:2] in (b"II", b"MM"):
        return decode_tiff(data, file, hw)
    return files.decode_depth_png(data, file, 1.0, hw).astype(np.uint16)
