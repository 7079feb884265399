"""Data set card of an enriched LeRobot set: ``README.md`` with the tags of the Hugging Face hub.

Cameras with their intrinsics, where their depth comes from and how exact it is, versions, the licence of the source,
and how the set is loaded and trained on. The card of the source is kept as ``README.source.md``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.cli.enrich_page import summarise_cameras
from dhtorch.codes import SOURCES_OF_KIND, Source, names, words
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import import_optional
from dhtorch.extract.origin import SOURCE_CARD
from dhtorch.extract.policy_columns import N_POINTS
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count

#: Name of the card.
CARD = "README.md"

#: ``license:`` in the head of a card, as the hub writes identifiers of licences.
_LICENCE = re.compile(r"\A---\n(?:.*\n)*?license:[ \t]*[\"']?([A-Za-z0-9][A-Za-z0-9.\-]{0,40})[\"']?[ \t]*\n")


def write_enrich_card(target: LeRobotTarget, about: Mapping[str, Any], owns: Sequence[Mapping[str, Any]]) -> Path:
    """Write the card of a complete set; ``about``: metadata of all files, ``owns``: summaries of all episodes."""
    return storage.replace_file(target.root / CARD, _format_card(target, about, owns).encode("utf-8"))


def _format_card(target: LeRobotTarget, about: Mapping[str, Any], owns: Sequence[Mapping[str, Any]]) -> str:
    root = target.root
    info = files.read_json(root / "meta" / "info.json")
    stats = files.read_json(root / "meta" / "stats.json")
    licence = _source_licence(root / SOURCE_CARD)
    source = _plain(about["data"]["source"])
    head = ["---", *([f"license: {licence}"] if licence else []), "task_categories:", "- robotics", "tags:"]
    head += ["- LeRobot", "- depth", "- dhtorch", "configs:", "- config_name: default"]
    head += ["  data_files: data/*/*.parquet", "---", "", f"# {_plain(about['data']['name'])} with depth", ""]
    frames = format_count(info["total_frames"], "frame")
    size = f"{format_count(info['total_episodes'], 'episode')}, {frames} at {info['fps']:g} per second"
    writer = f"dhtorch {about['version']} (`dhtorch enrich`, method {about['method']})"
    code = info["codebase_version"]
    body = [f"LeRobot {code} set, written from `{source}` by {writer}: {size}.", ""]
    body += ["## Cameras", "", *_camera_table(target, owns, stats), ""]
    body += [_describe_maps(target, about, info), ""]
    known = f"`{licence}`, by its card (`{SOURCE_CARD}`)" if licence else "not stated by the source"
    body += ["## Licence", "", f"Pictures, states and actions are the source's: {known}.", ""]
    return "\n".join([*head, *body, *_loading(target, info)]) + "\n"


def _camera_table(target: LeRobotTarget, owns: Sequence[Mapping[str, Any]], stats: Mapping[str, Any]) -> list[str]:
    columns = (
        "camera",
        "picture",
        "map",
        "fx, fy, cx, cy (px)",
        *map(words, SOURCES_OF_KIND),
        "depth (m)",
        "sigma (m)",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    cameras = {camera.name: camera for camera in summarise_cameras(owns)}
    K = _first_intrinsics(target)
    for key, view in target.views.items():
        camera = cameras.get(view.name)
        percent = ["0.0%"] * len(SOURCES_OF_KIND) if camera is None else camera.format_kinds().values()
        numbers = K.get(key)
        lens = "unknown" if numbers is None else ", ".join(f"{x:.1f}" for x in numbers)
        depth, sigma = (stats.get(target.keys[key].get(name, "")) for name in ("depth", "sigma"))
        span = "–" if camera is None or camera.kinds["no_answer"] == 1 or depth is None else _span(depth)
        typical = "–" if span == "–" or sigma is None else f"{float(np.ravel(sigma['q50'])[0]):.4f}"
        sizes = [f"{w}×{h}" for h, w in (view.hw, view.map_hw)]
        lines.append(f"| {' | '.join([f'`{key}`', *sizes, lens, *percent, span, typical])} |")
    return lines


def _span(entry: Mapping[str, Any]) -> str:
    low, high = (float(np.ravel(entry[name])[0]) for name in ("q01", "q99"))
    return f"{low:.2f}–{high:.2f}"


def _describe_maps(target: LeRobotTarget, about: Mapping[str, Any], info: Mapping[str, Any]) -> str:
    key = next(iter(target.views))
    step = f"in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "not quantised"
    form = "32-bit TIFF" if target.as_images else "an array of numbers (1, h, w)"
    lines = [
        f"`{target.keys[key]['depth']}` is {form} in metres, {step}; **0 = no depth**, which is no distance: mask it",
        "before depth is normalised. Statistics in `meta/stats.json` are over answered pixels, their range holds the",
        "values from the 1 % to the 99 % quantile, as the depths of the table do; its sigma is the median.",
    ]
    if "sigma" in target.keys[key]:
        lines.append(f"`{target.keys[key]['sigma']}` is the standard deviation of the depth, in metres.")
    if "source" in target.keys[key]:
        codes = ", ".join(f"{code} {name.lower()}" for code, name in names(Source).items())
        lines.append(f"`{target.keys[key]['source']}` is where a depth comes from: {codes}.")
    if "geometry_image" in target.keys[key]:
        lines += _describe_geometry(target.keys[key]["geometry_image"], info["features"])
    if "point_cloud" in target.keys[key]:
        lines.append(f"`{target.keys[key]['point_cloud']}` is {N_POINTS} points (x right, y down, z forward) in metres")
        lines.append(
            "of the camera, by pixels with a depth in a fixed order; they repeat where there are fewer, and are"
        )
        lines.append("all 0 in a frame without depth. Its first points are a smaller cloud of the whole picture.")
    if "K" in target.keys[key]:
        lines.append(f"`{target.keys[key]['K']}` is K of the picture by rows; pixel centres are whole numbers.")
    return "\n".join(lines)


def _describe_geometry(key: str, features: Mapping[str, Any]) -> list[str]:
    """Lines on the video of geometry images and its decoding, which the feature's info states too."""
    info = features[key]["info"]
    decoding = info["geometry_image"]
    return [
        f"`{key}` is a video without loss ({info['video.codec']}, {info['video.pix_fmt']}) of bytes that decode as",
        f"`depth_m = {decoding['depth_m']}`,",
        f"`sigma_m = {decoding['sigma_m']}`,",
        f"`source = {decoding['source']}` (`{decoding['function']}`);",
        "encoded again with loss, its depth is no longer exact to half a code.",
    ]


def _loading(target: LeRobotTarget, info: Mapping[str, Any]) -> list[str]:
    key = next(iter(target.views))
    load = [
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset",
        "",
        'dataset = LeRobotDataset("local/set", root="THIS_FOLDER")',
        f'depth = dataset[0]["{target.keys[key]["depth"]}"]  # (1, h, w)',
    ]
    lines = ["## Loading", "", "```python", *load, "```"]
    if {"action", "observation.state"} <= info["features"].keys() and not target.as_images:
        train = "lerobot-train --dataset.repo_id=local/set --dataset.root=THIS_FOLDER --policy.type=act"
        lines += ["", "```bash", f"{train} --policy.push_to_hub=false", "```"]
    return lines


def _first_intrinsics(target: LeRobotTarget) -> dict[str, list[float]]:
    """Camera -> fx, fy, cx, cy of the first row that has them."""
    parquet = import_optional("pyarrow.parquet")
    file, intrinsics = target.file(0), {}
    names = set(parquet.read_schema(file).names)
    for key, view in target.views.items():
        column = f"observation.{view.name}.intrinsics"
        if column in names:
            rows = np.array(parquet.read_table(file, columns=[column]).column(column).to_pylist(), np.float64)
            valid = rows[np.isfinite(rows).all(1)] if rows.ndim == 2 and rows.shape[1] == 9 else rows[:0]
            if len(valid):
                intrinsics[key] = valid[0][[0, 4, 2, 5]].tolist()
    return intrinsics


def _source_licence(card: Path) -> str | None:
    """Identifier of the licence in the head of the source's card; None = no card, or none in it."""
    stated = _LICENCE.match(files.read_text(card).replace("\r\n", "\n")) if card.is_file() else None
    return None if stated is None else stated[1]


def _plain(text: Any) -> str:
    """Text in one line without marks of tables and code."""
    return re.sub(r"[\s|`<>]+", " ", str(text)).strip()
