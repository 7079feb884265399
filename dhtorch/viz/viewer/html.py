"""A scene as one HTML page that needs nothing beside itself: no installation, no server, no network.

The page draws with WebGL and two-dimensional canvases, in plain JavaScript that lies beside this file. Arrays travel as
base64. Names come from files of others: they enter as JSON text in which no markup can end, and are shown as text.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Hole, names, words
from dhtorch.runtime import storage
from dhtorch.runtime.console import many
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.colours import GATES, HOLES, RECOVERED, SENSOR
from dhtorch.viz.plots.document import sheet
from dhtorch.viz.plots.markup import Markup, escape, png_address, tag
from dhtorch.viz.viewer.exhibit import Cloud, Exhibit, Opening, Picture, Shot, SweptCloud

ENDINGS = (".html", ".htm")

_HERE = Path(__file__).parent
_SCRIPTS = ("space.js", "pictures.js", "layers.js", "page.js")

#: Colours that the scripts ask for by name, and their colour maps.
_COLOURS = ("SENSOR", "RECOVERED", "SWEPT", "SILENT", "PALE", "HELD", "WHITE", "BLACK")
_RAMPS = {"depth": colours.DEPTH, "score": colours.SCORE, "error": colours.ERROR}

#: Pixels travel in 16 bits: this many steps a pixel, from this far outside the picture.
PER_PIXEL, MARGIN_PX = 8, 64

#: Column of a shot's samples → type it travels as.
_TYPES = {
    **dict.fromkeys(("xyz", "depth", "sigma", "parallax_deg", "residual_px", "error"), "f4"),
    **dict.fromkeys(("uv_0", "uv_1", "score"), "u2"),
    **dict.fromkeys(("rgb", "tracked", "source", "gate", "hole", "candidate"), "u1"),
}


def page(scene: Exhibit) -> str:
    """The scene as one page.

    Raises:
        ValueError: there is nothing to show.
    """
    if not scene.shots:
        raise ValueError(f"view: found no pair in {scene.name}, expected at least one")
    text = storage.dumps(_data(scene), ensure_ascii=True, separators=(",", ":"))
    parts = {
        "title": escape(f"{scene.name} · dhtorch"),
        "style": sheet(_HERE / "page.css"),
        "opening": _opening(scene.opening) if scene.opening is not None else "",
        # Neither "</script" nor "<!--" may stand in a script's text; in JSON strings an escape says the same.
        "data": text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"),
        "script": "\n".join(_file(name) for name in _SCRIPTS),
    }
    skeleton = _file("page.html").split("{{")
    filled = [skeleton[0]]
    for piece in skeleton[1:]:
        name, rest = piece.split("}}", 1)
        filled += [parts[name], rest]
    return "".join(filled)


def write(path: Path, scene: Exhibit) -> Path:
    """Write the page.

    Raises:
        ValueError: nothing to show.
        OSError: the file cannot be written.
    """
    return storage.replace_file(path, page(scene).encode("utf-8"))


def _opening(opening: Opening) -> Markup:
    """Numbers, sentences and a picture, above what can be turned."""
    numbers = (tag("div", tag("dt", what), tag("dd", amount)) for what, amount in opening.numbers.items())
    parts = [tag("dl", *numbers, class_="numbers"), *(tag("p", text) for text in opening.said)]
    if opening.picture is not None:
        shown = tag("img", alt=opening.caption, src=png_address(opening.picture))
        below = tag("figcaption", opening.caption) if opening.caption else ""
        parts.append(tag("figure", tag("div", shown, class_="scroll", tabindex="0"), below))
    return tag("section", *parts, id="opening", aria_label="What was recovered")


def _data(scene: Exhibit) -> dict[str, Any]:
    gates = [_code(code, name, GATES) for code, name in names(Gate).items() if code != Gate.ANSWER]
    outcomes = [("SENSOR", "sensor", SENSOR), ("ANSWER", "recovered", RECOVERED)]
    outcomes += [(name, words(name), GATES[code]) for code, name in names(Gate).items() if code != Gate.ANSWER]
    n = sum(len(shot.samples["depth"]) for shot in scene.shots)
    swept = sum(len(shot.swept.xyz) for shot in scene.shots)
    said = f"{many(len(scene.shots), 'pair')}, {n:,} samples" if scene.views else f"{n + swept:,} points"
    said += f", {swept} swept pixels" if scene.views and swept else ""
    return {
        "title": scene.name,
        "about": said,
        "facts": dict(scene.facts),
        "placed": scene.placed,
        "per_pixel": PER_PIXEL,
        "margin_px": MARGIN_PX,
        "colours": {name.lower(): getattr(colours, name) for name in _COLOURS},
        "page": {name: list(colours.PAGE[name]) for name in ("stage", "rim")},
        "ramps": {name: colours.ramp(kind) for name, kind in _RAMPS.items()},
        "gates": gates,
        "holes": [_code(code, name, HOLES) for code, name in names(Hole).items() if code != Hole.NONE],
        "outcomes": [{"key": key, "name": name, "colour": colour} for key, name, colour in outcomes],
        "views": [_view(view) for view in scene.views],
        "shots": [_shot(shot) for shot in scene.shots],
        "path": None if scene.path is None else _packed(scene.path, "f4"),
    }


def _shot(shot: Shot) -> dict[str, Any]:
    columns = {**shot.samples, "score": _shares(shot.samples["score"])}
    for name in ("uv_0", "uv_1"):
        steps = np.round((np.nan_to_num(columns[name]) + MARGIN_PX) * PER_PIXEL)
        columns[name] = steps.clip(0, 65535)
    made: dict[str, Any] = {"samples": {name: _packed(columns[name], kind) for name, kind in _TYPES.items()}}
    made |= {"label": shot.label, "counts": shot.gates(), "facts": dict(shot.facts)}
    made |= {"view_0": shot.view_0, "view_1": shot.view_1, "seen": _cloud(shot.seen), "held": _cloud(shot.held)}
    made["swept"] = _cloud(shot.swept) | _surely(shot.swept)
    poses = {"T_world_from_0": shot.T_world_from_0, "T_world_from_1": shot.T_world_from_1}
    return made | {k: None if T is None else [float(x) for x in T[:3].ravel()] for k, T in poses.items()}


def _view(view: Picture) -> dict[str, Any]:
    facts = {"number": view.number, "time": view.time, "hw": list(view.hw), "f": list(view.f), "c": list(view.c)}
    return facts | {"jpeg": base64.b64encode(view.jpeg).decode("ascii")}


def _cloud(cloud: Cloud) -> dict[str, Any]:
    """Coordinates in 16 bits between the smallest and the largest."""
    empty = not len(cloud.xyz)
    low = np.zeros(3) if empty else cloud.xyz.min(0).astype(np.float64)
    step = np.ones(3) if empty else np.maximum((cloud.xyz.max(0) - low) / 65535, 1e-9)
    steps = np.round((cloud.xyz - low) / step)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "xyz": _packed(steps, "u2"),
        "rgb": _packed(cloud.rgb, "u1"),
    }


def _surely(cloud: SweptCloud) -> dict[str, Any]:
    return {"sigma": _packed(cloud.sigma, "f4"), "score": _packed(_shares(cloud.score), "u2"), "step_px": cloud.step_px}


def _shares(score: np.ndarray) -> np.ndarray:
    """Scores in 16 bits."""
    return np.round(65535 * np.nan_to_num(score).clip(0, 1))


def _packed(values: np.ndarray, kind: str) -> dict[str, str]:
    data = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    return {"type": kind, "base64": base64.b64encode(data).decode("ascii")}


def _code(code: int, name: str, of: Mapping[int, str]) -> dict[str, Any]:
    return {"code": code, "name": words(name), "colour": of[code]}


def _file(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")
