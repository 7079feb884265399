"""Question: how much depth is there in the defocus of a single picture?

On scenes of exact depth the image is rendered through a thin lens focused on the depth at its centre; blur is measured
at edges and converted to inverse depth with the true lens, so that only the measurement and the *side* of the focus are
unknown. The side is the true one (``oracle_side``) or estimated: from the height in the image (``by_height``), from the
colour of the blur (``by_colour``: none without axial colour), or always beyond the focus (``all_beyond``). Controls:
the height in the image alone, without any blur (``height_alone``), and blur measured in the image without lens blur
(``texture_alone``). ``natural`` is the unchanged image, the only variant on recordings without exact depth: its optics
are unknown, so only ``rho_abs`` is measured.

Expectation (written before the run): the signal is there and weak (|rho| of blur and inverse depth at most 0.5; the
paper: 0.22); with the oracle's side r is at least 0.4 (paper: 0.66); a side that has to be produced loses more than
half of it (paper: 0.06).
What would refute it: |rho| above 0.5, r with the oracle's side below 0.4, or a deployable r of half the oracle's.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.focal.blur import (
    estimate_blur,
    guess_side_by_colour,
    guess_side_by_height,
    inverse_depth_from_blur,
)
from dhtorch.experiments.outcome import MainMetric, Row, median_or_none
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    ScenePairs,
    ScreenedItem,
    Settings,
    no_progress,
    screen_scenes,
)
from dhtorch.geometry.thin_lens import GAUSSIAN_OF_DISC, Lens, spot_diameter
from dhtorch.metrics import bootstrap, holdout
from dhtorch.metrics.correlation import pearson, spearman
from dhtorch.records import Frame
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.thin_lens import make_lens, render_defocus

#: Variants that estimate the side of the focus.
_DEPLOYABLE_SIDES = ("by_height", "by_colour", "all_beyond")
VARIANTS = ("oracle_side", *_DEPLOYABLE_SIDES, "height_alone", "texture_alone", "natural")

#: Smallest number of pixels for a correlation.
_MIN_CORRELATION_SITES = 50

#: Smallest inverse focus distance, 1/m.
_MIN_FOCUS_DPT = 0.01

#: The verdict requires at most this |Spearman| of blur and inverse depth,
_MAX_WEAK_CORRELATION = 0.5
#: at least this Pearson correlation with the true side,
_MIN_ORACLE_CORRELATION = 0.4
#: and less than this fraction of it with an estimated side.
_MAX_KEPT_RATIO = 0.5


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    focal_length_m: float = 0.035,
    f_number: float = 0.35,
    axial_colour_dpt: float = 0.0,
    noise: float = 1 / 255,
    stride_px: int = 4,
    window_px: float = 6.0,
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: blur of one image per scene at the pixels of a grid with valid ground truth depth.

    Rows, per image and per scene: ``rho_abs``, |Spearman| of blur and inverse depth; ``corr`` and ``rank_corr`` of
    estimated and true inverse depth; ``side_right``, fraction of pixels with the correct side; ``blur_corr``, Pearson
    of measured and true blur; ``texture_corr``, Pearson of measured blur and the blur measured without a lens;
    ``rho_perfect``, ``rho_abs`` of the true blur; ``coverage``, fraction of the candidates with edges. The summary has
    the two ambiguities as ``blank_wall.*`` and ``two_sides.*``, see :func:`_measure_ambiguities`.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`. The first
            frame of each; with exact depth (``lidar`` is "exact") it is rendered through the lens.
        methods, pairs: not used.
        focal_length_m, f_number: of the lens; its pixel pitch is such that the image keeps its field of view. The
            spot in pixels is what matters: in an image of 320 columns f/0.35 gives the spots of f/1.4 at 1280 columns,
            and f/1.8 those of a phone (5.7 mm, f/1.8) at 1920.
        axial_colour_dpt: dioptres by which blue is focused nearer than red; about 0.5 for a lens of one glass.
        noise: standard deviation of a pixel, added after the lens.
        stride_px: of the grid.
        window_px: standard deviation of the window in which blur is measured.

    Source: paper, "What Does Not Work", single-frame depth from defocus.
    """

    def evaluate_item(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        frame = scene.recording[item[0]].to(settings.dtype).to(settings.device)
        v, u = (torch.arange(stride_px // 2, side, stride_px).to(frame.camera.f) for side in frame.hw)
        sites = _Sites(frame, torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(1, -1, 2))
        if not has_exact_depth(scene.recording):  # of unknown optics
            blur = estimate_blur(frame.image, noise=noise, window_px=window_px)
            return {"natural": {"rho_abs": sites.rho(blur.valid, blur.sigma)}}
        lens = make_lens(float(frame.camera.f[0, 0]), focal_length_m=focal_length_m, f_number=f_number)
        options: dict[str, Any] = {"noise": noise, "window_px": window_px, "seed": settings.seed}
        return _measure_through_lens(frame, sites, lens.to(settings.dtype), colour=axial_colour_dpt, **options)

    outcome = screen_scenes(
        scenes_of(scenes),
        lambda _r: [(0, 0)],
        evaluate_item,
        VARIANTS,
        truth="full",
        metrics=(
            MainMetric("rho_abs", larger_is_better=True),
            MainMetric("rank_corr", larger_is_better=True),
            MainMetric("side_right", larger_is_better=True),
            MainMetric("coverage", larger_is_better=True),
        ),
        finished=settings.finished,
        progress=progress,
    )
    outcome.summary |= {
        k: bootstrap.without_interval(v, 1) for k, v in _measure_ambiguities(noise=noise, window_px=window_px).items()
    }
    return outcome.decide(
        "How much depth is there in the defocus of a single picture?",
        (
            "A weak signal, useful once an oracle gives the side of the focus, next to nothing when it has to "
            "be produced."
        ),
        *verdict(outcome),
    )


def has_exact_depth(recording: Recording) -> bool:
    """Whether every pixel of a recording has exact depth, which rendering through a lens requires."""
    return isinstance(recording, SyntheticRoom) and recording.lidar == "exact"


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Verdict and text: weak without a side, useful with the true side, mostly lost with an estimated side."""

    def over_scenes(variant: str, metric: str) -> float | None:
        return bootstrap.interval_over_scenes([r.get(metric) for r in outcome.scenes(variant).values()]).value

    rho, oracle = over_scenes("oracle_side", "rho_abs"), over_scenes("oracle_side", "corr")
    estimated = {v: r for v in _DEPLOYABLE_SIDES if (r := over_scenes(v, "corr")) is not None}
    if rho is None or oracle is None or not estimated:
        natural = over_scenes("natural", "rho_abs")
        natural_text = "" if natural is None else f"; |rho| of the pictures as they are {natural:.2f} (paper 0.22)"
        return None, f"no scene with exact depth and enough edges{natural_text}"
    best = max(estimated, key=lambda v: estimated[v])
    why = (
        f"medians over {len(outcome.scenes('oracle_side'))} scenes: |rho| {rho:.2f} (paper 0.22), r with the oracle's"
        f" side {oracle:.2f} (0.66), best deployable {best} {estimated[best]:+.2f} (0.06);"
        f" the height in the picture alone, without any blur, {over_scenes('height_alone', 'corr') or 0:+.2f}"
    )
    return rho <= _MAX_WEAK_CORRELATION and oracle >= _MIN_ORACLE_CORRELATION and estimated[
        best
    ] < _MAX_KEPT_RATIO * oracle, why


def _measure_ambiguities(*, noise: float = 0.0, window_px: float = 6.0, seed: int = 0) -> dict[str, float | None]:
    """Measure the two ambiguities of a single image, texture and side of the focus, on a rendered fronto-parallel wall.

    Returns:
        ``blank_wall.…``: a wall *in focus*: measured blur in px of a texture with sharp edges, of the same texture with
        soft edges, and the fraction of valid pixels of a plain wall with a soft shadow. ``two_sides.…``: the sharp
        texture equally far (in dioptres) in front of the focus and beyond it: measured blur, true blur, and the ratio
        of the two measurements, 1 = indistinguishable.
    """
    hw, focus = (120, 160), torch.tensor([[2.0]])
    lens = make_lens(265.0, f_number=0.35)
    generator = torch.Generator().manual_seed(seed)
    blocks = torch.rand(1, 1, 8, 10, generator=generator).repeat_interleave(15, 2).repeat_interleave(16, 3)
    shadow = torch.linspace(0.3, 0.7, hw[1]).expand(1, 1, *hw)

    def measured(texture: Tensor, z: float) -> tuple[float | None, float]:
        image = render_defocus(texture, torch.full((1, *hw), z), lens, focus)[:, 0]
        image = image + noise * torch.randn(image.shape, generator=generator)
        blur = estimate_blur(image, noise=noise, window_px=window_px)
        return median_or_none(blur.sigma[blur.valid].tolist()), float(blur.valid.float().mean())

    soft_blocks = render_defocus(blocks, torch.full((1, *hw), 8.0), lens, focus)[
        :, 0
    ]  # soft by the spot of a wall 6 m behind the focus
    near, far = (measured(blocks, 1 / (0.5 + d))[0] for d in (0.25, -0.25))
    true = GAUSSIAN_OF_DISC * abs(float(spot_diameter(lens, torch.tensor([[4.0]]), focus[:, 0])))
    return {
        "blank_wall.sharp_paint_px": measured(blocks, 2.0)[0],
        "blank_wall.soft_paint_px": measured(soft_blocks, 2.0)[0],
        "blank_wall.plain_share": measured(shadow, 2.0)[1],
        "two_sides.near_px": near,
        "two_sides.far_px": far,
        "two_sides.true_px": true,
        "two_sides.ratio": near / far if near and far else None,
    }


def _measure_through_lens(
    frame: Frame, sites: "_Sites", lens: Lens, *, colour: float, noise: float, window_px: float, seed: int
) -> dict[str, Row]:
    """Variant → row of one image, rendered with the focus on the depth at its centre."""
    depth, (h, w) = frame.depth, frame.hw
    sharp = frame.image / 255.0 if frame.image.dtype == torch.uint8 else frame.image
    focus = depth[:, h // 2, w // 2]
    shifts = (-colour / 2, 0.0, colour / 2) if sharp.shape[1] == 3 else (0.0,)
    channels = [(sharp, 0.0)] if not colour else [(sharp[:, k : k + 1], shift) for k, shift in enumerate(shifts)]
    # With axial colour, red of a lens focused far may have no focus distance; the lower bound replaces it.
    focused = [(x, (1 / (1 / focus + d).clamp_min(_MIN_FOCUS_DPT))[:, None]) for x, d in channels]
    image = torch.cat([render_defocus(x, depth, lens, s)[:, 0] for x, s in focused], 1)
    noise_image = noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed)).to(image)
    image = image + noise_image
    blur = estimate_blur(image, noise=noise, window_px=window_px)
    pinhole = estimate_blur(sharp + noise_image, noise=noise, window_px=window_px)
    spot = spot_diameter(lens, depth.flatten(1), focus).view(depth.shape)
    true_side = torch.where(spot < 0, -torch.ones_like(spot), torch.ones_like(spot))
    row_up = torch.arange(h, 0, -1, dtype=depth.dtype)[:, None].expand(depth.shape)
    sides = {
        "oracle_side": true_side,
        "by_height": guess_side_by_height(blur),
        "by_colour": guess_side_by_colour(image, window_px=window_px, noise=noise) if colour else None,
        "all_beyond": torch.ones_like(spot),
    }
    rows = {}
    for name, side in sides.items():
        if side is not None:
            estimate = inverse_depth_from_blur(blur, side, lens, focus)
            rows[name] = sites.correlations(blur.valid & (side != 0), estimate, blur.sigma) | {
                "side_right": sites.fraction(blur.valid & (side != 0), side == true_side),
                "blur_corr": sites.correlate(pearson, blur.valid, blur.sigma, GAUSSIAN_OF_DISC * spot.abs()),
                "texture_corr": sites.correlate(pearson, blur.valid & pinhole.valid, blur.sigma, pinhole.sigma),
                "rho_perfect": sites.rho(blur.valid, spot.abs()),
            }
    rows["height_alone"] = sites.correlations(blur.valid, -row_up, row_up)
    rows["texture_alone"] = sites.correlations(pinhole.valid, -pinhole.sigma, pinhole.sigma)
    return rows


class _Sites:
    """Candidates of an image: pixels of the grid with valid ground truth depth, and correlations over them."""

    def __init__(self, frame: Frame, uv: Tensor) -> None:
        truth = holdout.sample_truth(frame, uv)
        self.index = (uv[0, :, 1].long(), uv[0, :, 0].long())
        self.candidate, self.depth = truth.ok[0], truth.depth[0].double()

    def correlations(self, valid: Tensor, estimate: Tensor, blur: Tensor) -> Row:
        """Row of correlations of estimated inverse depth (1, H, W) and of blur with true inverse depth."""
        n, n_kept = int(self.candidate.sum()), int((self.candidate & valid[0][self.index]).sum())
        return {
            "n_candidates": n,
            "n_kept": n_kept,
            "coverage": n_kept / n if n else None,
            "rho_abs": self.rho(valid, blur),
            "corr": self.correlate(pearson, valid, estimate),
            "rank_corr": self.correlate(spearman, valid, estimate),
        }

    def rho(self, valid: Tensor, x: Tensor) -> float | None:
        """|Spearman| of a map with true inverse depth; None with too few pixels."""
        correlation = self.correlate(spearman, valid, x)
        return None if correlation is None else abs(correlation)

    def correlate(
        self, statistic: Callable[..., float | None], valid: Tensor, x: Tensor, y: Tensor | None = None
    ) -> float | None:
        """Correlation of a map with another, or with true inverse depth; None with too few pixels."""
        kept = self.candidate & valid[0][self.index]
        if int(kept.sum()) < _MIN_CORRELATION_SITES:
            return None
        other = 1 / self.depth[kept] if y is None else y[0][self.index][kept].double()
        return statistic(x[0][self.index][kept].double(), other)

    def fraction(self, valid: Tensor, mask: Tensor) -> float | None:
        """Fraction of the valid candidates where a mask is True."""
        kept = self.candidate & valid[0][self.index]
        return float(mask[0][self.index][kept].double().mean()) if bool(kept.any()) else None
