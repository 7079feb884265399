"""README's pictures, of real frames and of result files.

    python docs/pictures.py                    all of them, into docs/assets/
    python docs/pictures.py triptych risk      some

``triptych`` and ``viewer`` show holo_a below DHTORCH_DATA (HoloLens frames of ardaduz/deep-video-mvs, MIT), returns
beyond 2.5 m hidden; ``viewer`` is the page of ``dhtorch view``, turned by a headless Chromium; ``risk`` is drawn from
``benchmarks/results/method_comparison.json``. ``maps`` shows dense maps before and after their filters: four built-in
rooms, holo_a and holo_stream (MIT), tum_fr1_desk9 (TUM, CC BY 4.0) and the three cameras of dgp_drive6cam (MIT).
"""

import argparse
import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.utils import instantiate
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from PIL import Image

from dhtorch import data
from dhtorch.cli.run import config_dir
from dhtorch.codes import Source
from dhtorch.data.pairs import by_choice
from dhtorch.data.scene import Scene
from dhtorch.experiments.exhibits import make_exhibit
from dhtorch.experiments.protocol import Settings
from dhtorch.integrate.sweeps import DenseSweep
from dhtorch.metrics import calibration
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS
from dhtorch.pipeline.fused import fuse_with_sweep
from dhtorch.pipeline.presets import AUTO, FUSED
from dhtorch.pytree import stack
from dhtorch.synthetic.recording import open_rooms
from dhtorch.viz.plots import colours, make_figure, save_figure, set_axis, set_title
from dhtorch.viz.viewer import html

REPO = Path(__file__).resolve().parents[1]
ASSETS = REPO / "docs" / "assets"

#: Metres beyond which returns are hidden, and the position of the frame that is shown.
CUTOFF, FRAME = 2.5, 0

#: Depths of one colour scale, m.
DEPTHS = (1.0, 6.0)

#: Scenes of the contact sheet besides the rooms, those whose licences allow it.
SHEET_SCENES = (
    "holo_a",
    "holo_stream",
    "tum_fr1_desk9",
    *(f"dgp_drive6cam/CAMERA_0{k}" for k in (1, 5, 7)),
)

CHROMIUM = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome")


def kitchen() -> Scene:
    """The scene that is shown.

    Raises:
        SystemExit: DHTORCH_DATA is not set.
    """
    root = os.environ.get("DHTORCH_DATA")
    if not root:
        raise SystemExit("DHTORCH_DATA is not set: expected the folder that holds holo_a")
    return Scene(data.open(Path(root) / "holo_a"), near=CUTOFF)


def triptych(path: Path) -> None:
    """A picture, what the sensor may say of it, and what is known of it now, on one scale of depth."""
    scene = kitchen()
    recording = scene.recording
    (pair,) = (p for p in by_choice(scene, stride=1) if p.reference == FRAME)
    whole = recording[FRAME]
    near = range_split(whole, CUTOFF)
    others = stack([range_split(recording[k], CUTOFF) for k in pair.candidates])
    completed = complete_depth(near, others, calibration=calibration.load_calibration("fused"))
    image = whole.image[0].permute(1, 2, 0)
    depth, source = completed.depth[0].numpy(), completed.source[0].numpy()
    sensed, known = source == Source.SENSOR, source != Source.NONE
    figure = Figure((15, 3.9), facecolor=colours.PICTURE)
    axes = figure.subplots(1, 3)
    axes[0].imshow(image)
    for axis, mask in zip(axes[1:], (sensed, known), strict=True):
        shown = axis.imshow(np.where(mask, depth, np.nan), cmap=colours.DEPTH_CMAP, vmin=DEPTHS[0], vmax=DEPTHS[1])
    titles = (
        f"holo_a, frame {int(recording.number[FRAME])}",
        f"sensor, within {CUTOFF:g} m: {100 * sensed.mean():.0f} %",
        f"completed: {100 * known.mean():.0f} % of the pixels",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=13)
        axis.axis("off")
    figure.subplots_adjust(wspace=0.03)
    figure.colorbar(shown, ax=axes, label="depth, m", shrink=0.78, pad=0.01)
    figure.savefig(path, dpi=160, bbox_inches="tight", pil_kwargs={"quality": 88})


def maps(path: Path) -> None:
    """Contact sheet: picture, sensor, swept map without filters, joint map, of the middle frame of ten scenes."""
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        shown = [hydra.compose("run", [f"data={name}"]) for name in ("shared_scenes", "streams")]
    scenes = [scene for cfg in shown for scene in instantiate(cfg.data, _convert_="all") if scene.name in SHEET_SCENES]
    scenes += open_rooms(paths=["walk"], seed=[100, 101, 102, 103])
    figure = Figure((16, 3 * len(scenes)), facecolor=colours.PICTURE)
    axes = figure.subplots(len(scenes), 4)
    for scene, row in zip(scenes, axes, strict=True):
        pairs = by_choice(scene, stride=1)
        pair = pairs[len(pairs) // 2]
        near = range_split(scene.recording[pair.reference], scene.near)
        others = stack([range_split(scene.recording[k], scene.near) for k in pair.candidates])
        trace: dict[str, Any] = {}
        selected = dense.selected_views(AUTO(near, others, trace=trace), others, trace)
        swept = dense.sweep_views(near, selected, AUTO, DEFAULT_DENSE_OPTIONS)
        before = dense.merge_returns(dense.gate_sweep(swept, DEFAULT_DENSE_OPTIONS), swept.returns)
        after = fuse_with_sweep(FUSED, near, selected).depth_map
        low, high = np.nanpercentile(after.depth.numpy(), (1, 99))
        norm = LogNorm(low, high)
        row[0].imshow(near.image[0].permute(1, 2, 0), cmap=colours.GREY_CMAP)
        sensed = torch.where(after.source == Source.SENSOR, after.depth, torch.nan)
        for axis, depth in zip(row[1:], (sensed, before.depth, after.depth), strict=True):
            axis.imshow(depth[0], cmap=colours.DEPTH_CMAP, norm=norm, interpolation="nearest")
        titles = (f"{scene.name}, frame {int(scene.recording.number[pair.reference])}", f"sensor to {scene.near:g} m")
        for axis, title in zip(row, (*titles, "swept", "joint map"), strict=True):
            axis.set_title(title, fontsize=9)
            axis.axis("off")
    figure.subplots_adjust(wspace=0.02, hspace=0.12)
    figure.savefig(path, dpi=75, bbox_inches="tight", pil_kwargs={"quality": 80})


def risk(path: Path) -> None:
    """Mean error of the surest answers against the fraction answered, pooled over scenes, by method."""
    rows = json.loads((REPO / "benchmarks/results/method_comparison.json").read_text())["rows"]
    fraction = np.linspace(0.05, 1.0, 191)  # of fewer a mean says little
    figure, (axes,) = make_figure(size=(560, 330))
    for name in ("paper", "map", "auto", "fused"):
        curves = [
            r["curves"]["risk_coverage"]
            for r in rows
            if r["pair"] is None and r["truth"] == "full" and r["method"] == name and r.get("curves") and not r["role"]
        ]
        parts = [_at(curve, fraction) for curve in curves if curve["coverage"]]
        coverage, error = (np.mean([part[k] for part in parts], 0) for k in (0, 1))
        # the file's `map` is that of release 1, without the test of misaligned depth
        label = "map of release 1" if name == "map" else name
        axes.plot(coverage, error, color=colours.METHOD_COLOURS[name], linewidth=2.2, label=label)
        axes.plot(coverage[-1], error[-1], "o", color=colours.METHOD_COLOURS[name], markersize=7, clip_on=False)
    set_title(axes, "Error of the surest answers, eleven real scenes", 560)
    set_axis(axes, "x", "held-back returns answered, %, mean over scenes", percent=True, limits=(0.0, 0.8))
    set_axis(axes, "y", "mean relative error (at most 1), %, mean over scenes", percent=True, limits=(0.0, 0.15))
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9, labelcolor=colours.INK)
    save_figure(figure, path)


def _at(curve: dict[str, Any], fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coverage and risk of a scene where so large a fraction of its own answers is kept."""
    coverage, error = (np.array(curve[k], float) for k in ("coverage", "risk"))
    at = fraction * coverage[-1]
    return at, np.interp(at, coverage, error)


def viewer(path: Path, frames: int = 40, height: int = 450) -> None:
    """The page of ``dhtorch view``, turned from side to side.

    Raises:
        SystemExit: no Chromium is installed.
    """
    browser = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if browser is None:
        raise SystemExit(f"found none of {', '.join(CHROMIUM)}: the page is drawn by a browser")
    common = Settings(cutoff=CUTOFF)
    shown = make_exhibit(kitchen(), AUTO, by_choice, common, most=1, sweep=DenseSweep.from_options(True))
    script = f"""
      const made = [];
      setTimeout(() => {{
        lookFrom("over");
        const yaw = eye.yaw, pitch = eye.pitch;
        for (let k = 0; k < {frames}; k++) {{
          const turn = (2 * Math.PI * k) / {frames};
          eye.yaw = yaw + 0.35 * Math.sin(turn);
          eye.pitch = pitch - 0.12 * (1 - Math.cos(turn));
          drawSpace();
          made.push(space.canvas.toDataURL("image/png"));
        }}
        document.body.replaceChildren(...made.map((src) => Object.assign(new Image(), {{ src, className: "made" }})));
      }}, 1500);
    """
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(
            html.build_viewer_page(shown).replace("</script>\n</body>", f"{script}</script>\n</body>"), encoding="utf-8"
        )
        options = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        options += [f"--window-size=1180,{height + 330}", "--virtual-time-budget=60000", "--dump-dom"]
        done = subprocess.run([browser, *options, page.as_uri()], capture_output=True, text=True, check=True)
    encoded = re.findall(r'<img src="data:image/png;base64,([^"]+)"', done.stdout)
    pictures = [Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB") for text in encoded]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=90, loop=0, quality=60, method=4, minimize_size=True
    )


PICTURES = {"triptych": (triptych, "jpg"), "maps": (maps, "jpg"), "risk": (risk, "png"), "viewer": (viewer, "webp")}


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    names = parser.parse_args().names or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            parser.error(f"found {name!r}, expected {', '.join(PICTURES)}")
    torch.set_num_threads(1)
    for name in names:
        draw, ending = PICTURES[name]
        draw(ASSETS / f"{name}.{ending}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
