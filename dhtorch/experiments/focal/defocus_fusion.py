"""Question: does defocus help to fill in between the returns of a depth sensor?

The sensor's map is thinned out to every seventh pixel along both axes (a phone's LiDAR against its picture) and filled
again: by plain interpolation (``fill_bilinear``), by the guides a user would try first (``fill_joint_bilateral``,
``fill_guided``), and with the help of defocus (``fill_defocus_guided``: interpolation corrected by what blur says, as
much as it has earned; ``defocus_bold``: the same, trusting it twenty times as much; ``defocus_bilateral``: the
bilateral filter with the map of blur as its guide). All are held against the pixels that
were left out. Scenes of exact depth are photographed through a thin lens; on real recordings blur is what it is.

Expectation (written before the run): interpolation is hard to beat (the paper: r 0.82 to 0.99), and defocus never beats
it but raises the error slightly.
What would refute it: a mean error of ``fill_defocus_guided`` below that of ``fill_bilinear`` in the median over scenes,
and on most of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.focal.blur import estimate_blur
from dhtorch.experiments.focal.defocus import has_exact_depth
from dhtorch.experiments.focal.filling import fill_bilinear, fill_defocus_guided, fill_guided, fill_joint_bilateral
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row
from dhtorch.experiments.screening import ScreenedItem, paired_metric, screen_scenes
from dhtorch.metrics import bootstrap
from dhtorch.metrics.correlation import pearson
from dhtorch.records import Frame
from dhtorch.synthetic.thin_lens import make_lens, render_defocus

QUESTION = "Does defocus help to fill in between the returns of a depth sensor?"
EXPECTATION = "No: plain interpolation is hard to beat, and defocus raises its error slightly."

VARIANTS = ("bilinear", "joint_bilateral", "guided_filter", "defocus_guided", "defocus_bold", "defocus_bilateral")

#: Blur that counts as one unit of the guide of ``defocus_bilateral``, px.
_GUIDE_UNIT_PX = 10.0

#: Share of their variance that the claims of ``defocus_bold`` are said to have.
_BOLD_VARIANCE_RATIO = 0.05

#: Spread (max / min − 1) of 5×5 pixels from which one lies at an edge.
_EDGE_SPREAD = 0.05


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    factor: int = 7,
    sensor_noise: float = 0.005,
    stride: int = 4,
    focal_length_m: float = 0.035,
    f_number: float = 0.35,
    noise: float = 1 / 255,
    progress: Progress = no_progress,
) -> Outcome:
    """Thin out, fill in, compare, on every ``stride``-th frame.

    Rows, per frame and per scene, over the left-out pixels that have a return and that every variant answers:
    ``corr``, ``median_rel``, ``mean_rel``, ``rmse_m``, ``edge_mean_rel`` (beside steps in depth), ``changed_rel`` (mean
    relative change against ``fill_bilinear``) and, in the scene's row, ``mean_rel_ratio`` against ``fill_bilinear``.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`. Depth must be dense and of the
            picture's size; other recordings keep a row that says so.
        methods, pairs: not used.
        factor: every how many pixels a return stays; odd, so that it is the middle of its square.
        sensor_noise: relative noise of the returns, on exact scenes.
        stride: every how many frames.
        focal_length_m, f_number, noise: as in :func:`dhtorch.experiments.focal.defocus.run`.

    Raises:
        ValueError: a factor that is even or below 3.

    Source: paper, "What Does Not Work", defocus–LiDAR fusion for densification.
    """
    if factor < 3 or factor % 2 == 0:
        raise ValueError(f"experiment.factor: found {factor}, expected an odd number from 3")

    def items(scene: Scene) -> list[ScreenedItem]:
        n = len(scene.recording)
        return [(i, i) for i in range(0, n, stride)] if not scene.recording.sparse else []

    def ask(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        frame = scene.recording[item[0]].to(settings.dtype).to(settings.device)
        if frame.depth.shape[-2:] != frame.hw:
            return {}
        draw = torch.Generator().manual_seed(settings.seed)
        picture, spread = frame.image, 0.0
        if has_exact_depth(scene.recording):
            lens = make_lens(float(frame.camera.f[0, 0]), focal_length_m=focal_length_m, f_number=f_number)
            picture, spread = _render_through_lens(frame, lens.to(settings.dtype), noise, draw), sensor_noise
        return _evaluate_frame(picture, frame.depth, factor, spread, noise, draw)

    outcome = screen_scenes(scenes_of(scenes), items, ask, VARIANTS, truth="left_out", progress=progress)
    _add_ratios(outcome)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome))


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Does defocus leave the mean error of plain interpolation as it is, or raise it?"""
    both = paired_metric(outcome, "left_out", "defocus_guided", "bilinear", "mean_rel")
    if not both:
        return None, "no scene with dense depth of the picture's size"
    ratio = bootstrap.interval_over_scenes([a / b for a, b in both]).value or 0.0
    wins = sum(a < b for a, b in both)
    r = (
        bootstrap.interval_over_scenes(
            [row.get("corr") for row in outcome.scenes("bilinear", "left_out").values()]
        ).value
        or 0.0
    )
    why = (
        f"bilinear r {r:.3f} (paper 0.82 to 0.99); mean error with defocus over that of bilinear {ratio:.3f}, median of"
        f" {len(both)} scenes, lower on {wins}"
    )
    better = ratio < 1 and wins > len(both) / 2
    return (None if ratio < 1 and not better else not better), why


def thin_returns(depth: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Returns (B, h, w) in the middle of every square, and the map (B, h·factor, w·factor) they are the middles of."""
    h, w = depth.shape[-2] // factor, depth.shape[-1] // factor
    whole = depth[..., : h * factor, : w * factor]
    return whole[..., factor // 2 :: factor, factor // 2 :: factor], whole


def _render_through_lens(frame: Frame, lens: Any, noise: float, draw: torch.Generator) -> Tensor:
    """The picture through the lens, focused on its middle."""
    h, w = frame.hw
    seen = render_defocus(frame.image, frame.depth, lens, frame.depth[:, h // 2, w // 2, None], step_px=1.0)[:, 0]
    return (seen + noise * torch.randn(seen.shape, generator=draw).to(seen)).clamp(0, 1)


def _evaluate_frame(
    picture: Tensor, depth: Tensor, factor: int, spread: float, noise: float, draw: torch.Generator
) -> dict[str, Row]:
    """Variant → numbers of one frame."""
    coarse, whole = thin_returns(depth, factor)
    coarse = coarse * (1 + spread * torch.randn(coarse.shape, generator=draw).to(coarse))
    h, w = whole.shape[-2:]
    guide = picture[..., :h, :w]
    plain = fill_bilinear(coarse, (h, w))
    blur = estimate_blur(guide, noise=noise, window_px=3.0)
    filled = {
        "bilinear": plain,
        "joint_bilateral": fill_joint_bilateral(coarse, guide),
        "guided_filter": fill_guided(coarse, guide),
        "defocus_guided": fill_defocus_guided(plain, coarse, blur),
        "defocus_bold": fill_defocus_guided(plain, coarse, blur, distrust=_BOLD_VARIANCE_RATIO),
        "defocus_bilateral": fill_joint_bilateral(coarse, blur.sigma[:, None] / _GUIDE_UNIT_PX),
    }
    left_out = torch.ones_like(whole, dtype=torch.bool)
    left_out[..., factor // 2 :: factor, factor // 2 :: factor] = False
    use = left_out & (whole > 0)
    for claim in filled.values():
        use = use & (claim > 0)
    edge = _edge_mask(whole)[use]
    return {
        name: _numbers(claim[use].double(), whole[use].double(), plain[use].double(), edge)
        for name, claim in filled.items()
    }


def _numbers(x: Tensor, y: Tensor, plain: Tensor, edge: Tensor) -> Row:
    """Claims, truth and plain interpolation (P,) m, and which lie at an edge."""
    error = (x - y).abs() / y
    some = bool(len(y))
    at_edge = bool(edge.any())
    return {
        "n_candidates": len(y),
        "corr": pearson(x, y),
        "median_rel": float(error.median()) if some else None,
        "mean_rel": float(error.mean()) if some else None,
        "rmse_m": float(((x - y) ** 2).mean().sqrt()) if some else None,
        "edge_mean_rel": float(error[edge].mean()) if at_edge else None,
        "changed_rel": float(((x - plain).abs() / plain).mean()) if some else None,
    }


def _edge_mask(depth: Tensor) -> Tensor:
    """(B, H, W) bool: the returns of 5×5 pixels spread by more than :data:`_EDGE_SPREAD`."""
    high = torch.nn.functional.max_pool2d(depth, 5, 1, 2)
    low = -torch.nn.functional.max_pool2d(-torch.where(depth > 0, depth, torch.inf), 5, 1, 2)
    return high > (1 + _EDGE_SPREAD) * low


def _add_ratios(outcome: Outcome) -> None:
    """Mean error over that of plain interpolation, in the rows of scenes and in the summary."""
    plain = outcome.scenes("bilinear", "left_out")
    for name in VARIANTS[1:]:
        ratios = []
        for scene, row in outcome.scenes(name, "left_out").items():
            mine = row.get("mean_rel")
            theirs = plain.get(scene, {}).get("mean_rel")
            if mine is not None and theirs:
                row["mean_rel_ratio"] = mine / theirs
                ratios.append(mine / theirs)
        outcome.summary[f"{name}.mean_rel_ratio"] = bootstrap.interval_over_scenes(ratios).entry()
