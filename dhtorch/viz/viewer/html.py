"""Exhibit -> one self-contained HTML page: no installation, server or network.

The page draws with WebGL and 2D canvases, in plain JavaScript stored beside this file. Arrays are embedded as base64.
Names from files are untrusted: they are embedded as JSON text with markup characters escaped, and shown as text.
"""

import base64
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import Cause, Gate, Hole, Source, names, words
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.colours import CAUSE_COLOURS, GATE_COLOURS, HOLE_COLOURS, RECOVERED, SENSOR
from dhtorch.viz.plots.markup import Markup, build_style_sheet, encode_png_uri, escape_html, make_tag
from dhtorch.viz.viewer.exhibit import Exhibit, PageOpening, PairExhibit, PointCloud

HTML_SUFFIXES = (".html", ".htm")

_FOLDER = Path(__file__).parent
_SCRIPTS = ("space.js", "pictures.js", "layers.js", "page.js")

#: Colours that the scripts refer to by name.
_COLOUR_NAMES = ("SENSOR", "RECOVERED", "SWEPT", "FILLED", "UNANSWERED", "PALE", "HIDDEN_RETURN", "WHITE", "BLACK")
_CMAP_OF_QUANTITY = {"depth": colours.DEPTH_CMAP, "score": colours.SCORE_CMAP, "error": colours.ERROR_CMAP}

#: Quantisation of pixel coordinates in 16 bits, steps per px.
_STEPS_PER_PX = 8
#: Offset of quantised pixel coordinates: positions outside the image down to this margin, px.
_MARGIN_PX = 64

#: Column of the samples → type of its encoding.
_COLUMN_TYPES = {
    **dict.fromkeys(("xyz", "depth", "sigma", "parallax_deg", "residual_px", "error"), "f4"),
    **dict.fromkeys(("uv_0", "uv_1", "score"), "u2"),
    **dict.fromkeys(("rgb", "tracked", "source", "gate", "hole", "candidate", "cause"), "u1"),
}


def build_viewer_page(scene: Exhibit) -> str:
    """Exhibit -> HTML page.

    Raises:
        ValueError: no pair to show.
    """
    if not scene.shots:
        raise ValueError(f"view: found no pair in {scene.name}, expected at least one")
    text = storage.dump_strict_json(_encode_exhibit(scene), ensure_ascii=True, separators=(",", ":"))
    opening, poster = _format_opening(scene.opening)
    parts = {
        "title": escape_html(f"{scene.name} · dhtorch"),
        "style": build_style_sheet(_FOLDER / "page.css"),
        "opening": opening,
        "poster": poster,
        # "</script" and "<!--" must not occur in a script; in JSON strings an escape is equivalent.
        "data": text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"),
        "script": "\n".join(_read_asset(name) for name in _SCRIPTS),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read_asset("page.html"))


def write_viewer_page(path: Path, scene: Exhibit) -> Path:
    """Write the page.

    Raises:
        ValueError: no pair to show.
        OSError: the file cannot be written.
    """
    return storage.replace_file(path, build_viewer_page(scene).encode("utf-8"))


def _format_opening(opening: PageOpening | None) -> tuple[Markup | str, Markup | str]:
    """Opening -> markup of its numbers and sentences, above the 3D view, and of its image, below; empty without one."""
    if opening is None:
        return "", ""
    numbers = (make_tag("div", make_tag("dt", name), make_tag("dd", value)) for name, value in opening.numbers.items())
    parts = [make_tag("dl", *numbers, class_="numbers"), *(make_tag("p", text) for text in opening.sentences)]
    above = make_tag("section", *parts, id="opening", aria_label="What was recovered")
    if opening.picture is None:
        return above, ""
    image = make_tag("img", alt=opening.caption, src=encode_png_uri(opening.picture))
    below = make_tag("figcaption", opening.caption) if opening.caption else ""
    figure = make_tag("figure", make_tag("div", image, class_="scroll", tabindex="0"), below)
    return above, make_tag("section", figure, id="poster", aria_label="A frame and its depth")


def _encode_exhibit(scene: Exhibit) -> dict[str, Any]:
    gates = [_describe_code(code, name, GATE_COLOURS) for code, name in names(Gate).items() if code != Gate.ANSWER]
    outcomes = [("SENSOR", "sensor", SENSOR), ("ANSWER", "recovered", RECOVERED)]
    outcomes += [(name, words(name), GATE_COLOURS[code]) for code, name in names(Gate).items() if code != Gate.ANSWER]
    n = sum(len(shot.samples["depth"]) for shot in scene.shots)
    clouds = [shot.swept.source for shot in scene.shots]
    swept, filled = (sum(int((source == code).sum()) for source in clouds) for code in (Source.SWEPT, Source.FILLED))
    about = f"{n + swept + filled:,} points"
    if scene.views:
        about = f"{format_count(len(scene.shots), 'pair')}, {n:,} samples"
        about += f", {swept:,} swept and {filled:,} filled pixels" if swept + filled else ""
    return {
        "title": scene.name,
        "about": about,
        "facts": dict(scene.facts),
        "placed": scene.placed,
        "per_pixel": _STEPS_PER_PX,
        "margin_px": _MARGIN_PX,
        "colours": {name.lower(): getattr(colours, name) for name in _COLOUR_NAMES},
        "page": {name: list(colours.PAGE_COLOURS[name]) for name in ("stage", "rim")},
        "ramps": {name: colours.sample_cmap(kind) for name, kind in _CMAP_OF_QUANTITY.items()},
        "gates": gates,
        "holes": [_describe_code(code, name, HOLE_COLOURS) for code, name in names(Hole).items() if code != Hole.NONE],
        "causes": [_describe_code(code, name, CAUSE_COLOURS) for code, name in names(Cause).items() if code],
        "outcomes": [{"key": key, "name": name, "colour": colour} for key, name, colour in outcomes],
        "views": [
            {
                **{name: getattr(view, name) for name in ("number", "time", "hw", "f", "c")},
                "jpeg": base64.b64encode(view.jpeg).decode("ascii"),
            }
            for view in scene.views
        ],
        "shots": [_encode_pair(shot) for shot in scene.shots],
        "path": None if scene.path is None else _encode_array(scene.path, "f4"),
    }


def _encode_pair(shot: PairExhibit) -> dict[str, Any]:
    unknown = np.zeros(len(shot.samples["depth"]), np.uint8)
    columns = {"cause": unknown, **shot.samples, "score": _quantise_scores(shot.samples["score"])}
    for name in ("uv_0", "uv_1"):
        steps = np.round((np.nan_to_num(columns[name]) + _MARGIN_PX) * _STEPS_PER_PX)
        columns[name] = steps.clip(0, 65535)
    encoded: dict[str, Any] = {
        "samples": {name: _encode_array(columns[name], kind) for name, kind in _COLUMN_TYPES.items()}
    }
    encoded |= {"label": shot.label, "counts": shot.gates(), "facts": dict(shot.facts)}
    encoded |= {
        "view_0": shot.view_0,
        "view_1": shot.view_1,
        "seen": _encode_cloud(shot.seen),
        "held_out": _encode_cloud(shot.held_out),
    }
    encoded["swept"] = _encode_cloud(shot.swept) | {
        "sigma": _encode_array(shot.swept.sigma, "f4"),
        "score": _encode_array(_quantise_scores(shot.swept.score), "u2"),
        "source": _encode_array(shot.swept.source, "u1"),
        "cause": _encode_array(
            np.zeros(len(shot.swept.xyz), np.uint8) if shot.swept.cause is None else shot.swept.cause, "u1"
        ),
        "step_px": shot.swept.step_px,
    }
    poses = {"T_world_from_0": shot.T_world_from_0, "T_world_from_1": shot.T_world_from_1}
    return encoded | {k: None if T is None else [float(x) for x in T[:3].ravel()] for k, T in poses.items()}


def _encode_cloud(cloud: PointCloud) -> dict[str, Any]:
    """Cloud -> coordinates quantised to 16 bits between minimum and maximum, and colours."""
    empty = not len(cloud.xyz)
    low = np.zeros(3) if empty else cloud.xyz.min(0).astype(np.float64)
    step = np.ones(3) if empty else np.maximum((cloud.xyz.max(0) - low) / 65535, 1e-9)
    steps = np.round((cloud.xyz - low) / step)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "xyz": _encode_array(steps, "u2"),
        "rgb": _encode_array(cloud.rgb, "u1"),
    }


def _quantise_scores(score: np.ndarray) -> np.ndarray:
    """Scores [0, 1] -> 16 bits."""
    return np.round(65535 * np.nan_to_num(score).clip(0, 1))


def _encode_array(values: np.ndarray, kind: str) -> dict[str, str]:
    data = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    return {"type": kind, "base64": base64.b64encode(data).decode("ascii")}


def _describe_code(code: int, name: str, colour_of: Mapping[int, str]) -> dict[str, Any]:
    return {"code": code, "name": words(name), "colour": colour_of[code]}


def _read_asset(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")
