"""Question: does the classical method, the sharpest picture of every pixel, recover depth from a focal stack?

On scenes of exact depth the stack is rendered through a thin lens, in five conditions: ``clean``; ``noisy`` (4 grey
levels); ``moved`` (breathing by 2 % and a hand's shifts of about a pixel) and ``aligned`` (the same after alignment);
``light_field`` (the optics of DDFF-12, whose spots grow by 1.3 px per dioptre, and 2 grey levels of noise). The control
``no_focus`` is a stack without any blur. Stacks of a data set (FoD500, DDFF-12) are evaluated as recorded (``given``)
and after alignment (``given_aligned``); for sweeps without depth the measures are whether sharpness recovers the order
of the images, and whether the odd and the even images agree.

Expectation (written before the run): on clean stacks yes (the paper: Spearman 0.69, gated Pearson 0.76); on light
fields it fails, with the sign flipped on some scenes (about 1 in 5), and keeping the most confident quarter of the
pixels does not rescue it (|r| 0.15 to 0.21).
What would refute it: a clean Spearman below 0.5; or on light fields a Spearman of more than half the clean one or a
gated |r| of 0.5 or more.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.scene import Scene, SceneLike
from dhtorch.experiments.focal.defocus import has_exact_depth
from dhtorch.experiments.focal.sharpness import align_stack, depth_at_focus, find_sharpest, measure_sharpness
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks
from dhtorch.experiments.outcome import MainMetric, Row, mean_or_none
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
from dhtorch.geometry import filters
from dhtorch.metrics import bootstrap
from dhtorch.metrics.correlation import pearson, spearman
from dhtorch.records import Frame
from dhtorch.synthetic.thin_lens import make_lens, render_defocus

RENDERED_CONDITIONS = ("clean", "noisy", "moved", "aligned", "light_field", "no_focus")
_RECORDED_CONDITIONS = ("given", "given_aligned")

#: The verdict requires at least this Spearman correlation on clean stacks,
_MIN_CLEAN_CORRELATION = 0.5
#: at most this ratio of the light-field to the clean correlation,
_MAX_LIGHT_FIELD_RATIO = 0.5
#: and a gated |Pearson| on light fields below this.
_MAX_GATED_CORRELATION = 0.5

#: Nearest and farthest focus distance of a rendered stack, m, as in DDFF-12; steps are equal in inverse distance.
_FOCUS_RANGE_M = (0.5, 7.0)

#: Blur of DDFF-12 in px per dioptre: focal length 521.4 px × nine sub-apertures 0.271 mm apart.
_LIGHT_FIELD_PX_PER_DPT = 521.4 * 9 * 2.7088e-4

#: Fraction of the pixels, the most confident ones, that the gate keeps.
_CONFIDENT_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class _StackRoom:
    """One stack of a data set, or all of its stacks that show the same room."""

    name: str
    stacks: FocalStacks
    indices: tuple[int, ...]
    role: None = None


def run(
    scenes: Sequence[FocalStacks | SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    measures: Sequence[str] = ("modified_laplacian", "gradient_energy", "variance"),
    window_px: float = 6.0,
    slices: int = 10,
    focal_length_m: float = 0.035,
    f_number: float = 0.35,
    stride_px: int = 2,
    max_stacks: int = 50,
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment on every stack with every sharpness measure; variants: ``<condition>`` for the first measure.

    Rows, per scene: over the pixels of a grid with depth, ``rank_corr`` (Spearman) and ``corr`` (Pearson) of estimated
    and true inverse depth, ``gated_corr`` over the most confident quarter, ``abs_corr`` and ``gated_abs_corr`` their
    absolute values, ``flip_share`` 1 if Spearman is negative (its mean for a scene and in the summary), ``median_rel``
    of depth. Without depth: ``order_corr``, ``halves_corr``, ``motion_px``, see :func:`_measure_without_truth`.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`; recordings with exact depth
            (``lidar`` is "exact"; their first frame), or focal stacks.
        methods, pairs: not used.
        measures: names of sharpness measures; the verdict uses the first.
        window_px: width over which sharpness is averaged.
        slices: images of a rendered stack.
        focal_length_m, f_number: of the lens, as in :func:`dhtorch.experiments.focal.defocus.run`.
        stride_px: of the grid.
        max_stacks: of each data set, evenly spaced. Stacks of one room are one scene.

    Raises:
        ValueError: a recording without exact depth; fewer than two slices.

    Source: paper, "What Does Not Work", classical focus-stack depth.
    """
    if slices < 2:
        raise ValueError(f"experiment.slices: found {slices}, expected at least 2")

    def evaluate_stack(conditions: Mapping[str, Tensor], focus_m: Tensor, depth: Tensor) -> dict[str, Row]:
        evaluate = partial(_evaluate_depth, focus_m=focus_m, depth=depth, window_px=window_px, stride=stride_px)
        return {
            condition if m == measures[0] else f"{condition}, {m}": evaluate(images, measure=m)
            for condition, images in conditions.items()
            for m in measures
        }

    def evaluate_item(scene: _StackRoom | Scene, item: ScreenedItem) -> dict[str, Row]:
        if isinstance(scene, _StackRoom):
            stack = scene.stacks[item[0]].to(settings.dtype).to(settings.device)
            if stack.depth is None or stack.focus_m is None:
                order = slice(None) if stack.focus_m is None else stack.focus_m[0].argsort()
                return _measure_without_truth(stack.replace(images=stack.images[:, order]), measures[0], window_px)
            order = stack.focus_m[0].argsort()  # from near to far
            images = stack.images[:, order]
            conditions = {"given": images, "given_aligned": align_stack(images)[0]}
            return evaluate_stack(conditions, stack.focus_m[:, order], stack.depth)
        frame = scene.recording[0].to(settings.dtype).to(settings.device)
        steps = torch.linspace(1 / _FOCUS_RANGE_M[0], 1 / _FOCUS_RANGE_M[1], slices, dtype=settings.dtype)
        lens = {"focal_length_m": focal_length_m, "f_number": f_number}
        return evaluate_stack(_render_stacks(frame, 1 / steps[None], lens, settings.seed), 1 / steps[None], frame.depth)

    rooms = [room for source in scenes for room in _group_rooms(source, max_stacks)]
    names = [
        c if m == measures[0] else f"{c}, {m}" for c in (*RENDERED_CONDITIONS, *_RECORDED_CONDITIONS) for m in measures
    ]
    kinds = {isinstance(room, _StackRoom) for room in rooms}
    variants = [n for n in names if (n.split(",")[0] in _RECORDED_CONDITIONS) in kinds]
    outcome = screen_scenes(
        rooms,
        lambda room: [(i, i) for i in room.indices] if isinstance(room, _StackRoom) else [(0, 0)],
        evaluate_item,
        variants,
        truth="full",
        whole=_flip_shares,
        metrics=(
            MainMetric("rank_corr", larger_is_better=True),
            MainMetric("corr", larger_is_better=True),
            MainMetric("gated_rank_corr", larger_is_better=True),
            MainMetric("flip_share", larger_is_better=False),
        ),
        finished=settings.finished,
        progress=progress,
    )
    for name in variants:
        flips = [row.get("flip_share") for row in outcome.scenes(name).values()]
        entry = bootstrap.interval_over_scenes(flips, statistic="mean").entry()
        outcome.summary |= {f"{name}.flip_share": entry} if entry["value"] is not None else {}
    return outcome.decide(
        "Does the classical method, the sharpest picture of every pixel, recover depth from a focal stack?",
        "On clean stacks; on light fields it fails, flips sign on some scenes, and confidence does not rescue it.",
        *verdict(outcome),
    )


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Verdict and text: the recipe works on clean stacks, fails on light fields, and the gate does not help."""

    def summary_value(name: str) -> float | None:
        value = outcome.summary.get(name, {}).get("value")
        return None if value is None else float(value)

    clean, field = summary_value("clean.rank_corr"), summary_value("light_field.rank_corr")
    absolute, gated, flips = (summary_value(f"light_field.{m}") for m in ("abs_corr", "gated_abs_corr", "flip_share"))
    if clean is None or field is None or absolute is None or gated is None or flips is None:
        recorded = {
            "Spearman": summary_value("given.rank_corr"),
            "recovered order of the images": summary_value("given_aligned.order_corr"),
        }
        recorded_text = "; ".join(f"{k} {v:.2f}" for k, v in recorded.items() if v is not None)
        return (
            None,
            f"no rendered stacks: clean and light-field ones are not compared{recorded_text and f' ({recorded_text})'}",
        )
    why = (
        f"clean Spearman {clean:.2f} (paper 0.69), gated r {summary_value('clean.gated_corr') or 0:.2f} (0.76); light"
        f" field Spearman {field:.2f}, flipped on {flips:.0%} of scenes (1/5),"
        f" |r| {absolute:.2f} to {gated:.2f} (0.15 to 0.21)"
    )
    return (
        clean >= _MIN_CLEAN_CORRELATION and field <= _MAX_LIGHT_FIELD_RATIO * clean and gated < _MAX_GATED_CORRELATION,
        why,
    )


def _render_stacks(frame: Frame, focus_m: Tensor, lens: Mapping[str, float], seed: int) -> dict[str, Tensor]:
    """Render the grey stacks (1, S, 1, H, W) of every condition from a frame with exact depth."""
    sharp = filters.grayscale(frame.image)
    generator, count = torch.Generator().manual_seed(seed), focus_m.shape[1]
    f_px = float(frame.camera.f[0, 0])
    lens_wide = make_lens(f_px, **lens).to(focus_m.dtype)
    lens_small = make_lens(f_px, focal_length_m=0.0095, f_number=0.0095 * f_px / _LIGHT_FIELD_PX_PER_DPT).to(
        focus_m.dtype
    )
    clean = render_defocus(sharp, frame.depth, lens_wide, focus_m, step_px=1.0)
    field = render_defocus(sharp, frame.depth, lens_small, focus_m, step_px=0.25)

    def add_noise(x: Tensor, levels: float) -> Tensor:
        return (x + levels / 255 * torch.randn(x.shape, generator=generator).to(x)).clamp(0, 1)

    noisy = add_noise(clean, 4)
    # Stack (B, S, C, H, W) with magnification changing by 2 % in all and random shifts of about a pixel
    B, S, _, H, W = clean.shape
    zoom = 1 + torch.linspace(-0.01, 0.01, S)
    shift = torch.randn(S, 2, generator=generator)
    theta = torch.zeros(S, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = zoom
    theta[:, :, 2] = shift * 2 / torch.tensor([W, H])
    grid = torch.nn.functional.affine_grid(theta.to(clean), [S, 1, H, W], align_corners=False)
    options: dict[str, Any] = {"mode": "bicubic", "padding_mode": "border", "align_corners": False}
    moved = add_noise(torch.stack([torch.nn.functional.grid_sample(clean[b], grid, **options) for b in range(B)]), 1)
    return {
        "clean": clean,
        "noisy": noisy,
        "moved": moved,
        "aligned": align_stack(moved)[0],
        "light_field": add_noise(field, 2),
        "no_focus": add_noise(sharp[:, None].expand(-1, count, -1, -1, -1), 2),
    }


def _measure_without_truth(stack: FocalStack, measure: str, window_px: float) -> dict[str, Row]:
    """Measures of a sweep without ground truth depth, as recorded and aligned: condition → row.

    ``order_corr``: |Spearman| of the order of the images with the order estimated from sharpness (neighbours in a sweep
    are sharp in nearly the same places). ``halves_corr``: Spearman of the sharpest positions in the odd and in the even
    images, on the most confident quarter. ``motion_px``: largest motion estimated by the alignment, at the border.
    """
    aligned, motion = align_stack(stack.images)
    half = max(stack.hw) / 2
    largest = float((motion[..., 0].abs() * half + motion[..., 1:].norm(dim=-1)).max())
    rows = {}
    for name, stack_images in (("given", stack.images), ("given_aligned", aligned)):
        sharpness = measure_sharpness(stack_images, measure, window_px=window_px)
        row: Row = {
            "order_corr": order_correlation(sharpness),
            "halves_corr": halves_correlation(sharpness),
            "n_pictures": sharpness.shape[1],
        }
        rows[name] = row | {"motion_px": largest if name == "given" else 0.0}
    return rows


def order_correlation(measured: Tensor) -> float | None:
    """|Spearman| of the true order of the images with that estimated from their sharpness (1, S, H, W).

    The images form a minimum spanning tree under the dissimilarity of their sharpness maps; the estimated order is the
    distance along the tree from one end of its longest path. The true order is not used.
    """
    size = max(4, min(measured.shape[-2:]) // 30)
    level = torch.log(torch.nn.functional.avg_pool2d(measured[0][:, None], size).flatten(1).double() + 1e-9)
    level = level - level.mean(0)  # the mean over the images is texture, not focus
    dissimilarity = (1 - torch.corrcoef(level)).clamp_min(0).sqrt()
    end = int(_tree_distances(dissimilarity, 0).argmax())
    correlation = spearman(
        _tree_distances(dissimilarity, end), torch.arange(len(dissimilarity), dtype=dissimilarity.dtype)
    )
    return None if correlation is None else abs(correlation)


def _tree_distances(distance: Tensor, start: int) -> Tensor:
    """Path length (S,) from a node to every other along the minimum spanning tree of (S, S) distances (Prim)."""
    length = torch.full_like(distance[0], torch.nan)
    length[start] = 0
    for _ in range(len(distance) - 1):
        links = torch.where(length.isfinite()[:, None] & length.isnan(), distance, torch.inf)
        i, j = divmod(int(links.argmin()), len(distance))
        length[j] = length[i] + distance[i, j]
    return length


def halves_correlation(measured: Tensor) -> float | None:
    """Spearman of the sharpest positions in the odd and in the even images, on the most confident quarter."""
    if measured.shape[1] < 4:
        return None
    odd, even = find_sharpest(measured[:, 0::2]), find_sharpest(measured[:, 1::2])
    confidence = torch.minimum(odd.confidence, even.confidence).flatten()
    kept = confidence >= confidence.quantile(1 - _CONFIDENT_SHARE) if confidence.numel() < 2**24 else confidence > 0
    return spearman(odd.place.flatten()[kept].double(), even.place.flatten()[kept].double())


def _evaluate_depth(
    images: Tensor,
    *,
    focus_m: Tensor,
    depth: Tensor,
    measure: str,
    window_px: float,
    stride: int,
) -> Row:
    """Correlations and errors of the inverse depth estimated from a stack against ground truth."""
    focus = find_sharpest(measure_sharpness(images, measure, window_px=window_px))
    estimate = depth_at_focus(focus.place, focus_m)
    x, y, confidence = (v[0, ::stride, ::stride].flatten().double() for v in (estimate, depth, focus.confidence))
    has_truth = y > 0
    x, y, confidence = x[has_truth], y[has_truth], confidence[has_truth]
    kept = (
        confidence >= confidence.sort().values[int((1 - _CONFIDENT_SHARE) * (len(confidence) - 1))]
        if len(confidence)
        else has_truth[:0]
    )
    r = pearson(1 / x, 1 / y)
    gated = pearson(1 / x[kept], 1 / y[kept])
    rank = spearman(1 / x, 1 / y)
    return {
        "n_candidates": len(y),
        "rank_corr": rank,
        "corr": r,
        "gated_corr": gated,
        "gated_rank_corr": spearman(1 / x[kept], 1 / y[kept]),
        "abs_corr": None if r is None else abs(r),
        "gated_abs_corr": None if gated is None else abs(gated),
        "flip_share": None if rank is None else float(rank < 0),
        "median_rel": float(((x - y).abs() / y).median()) if len(y) else None,
    }


def _flip_shares(_scene: _StackRoom | Scene, results: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Variant → fraction of a scene's stacks with a negative correlation: a mean, as a median would be 0 or 1."""
    flips: dict[str, list[float]] = {}
    for variant, row in (item for rows in results for item in rows.items()):
        flips.setdefault(variant, []).extend([row["flip_share"]] if row.get("flip_share") is not None else [])
    return {variant: {"flip_share": mean_or_none(values)} for variant, values in flips.items() if values}


def _group_rooms(source: FocalStacks | SceneLike, most: int) -> list[_StackRoom | Scene]:
    """A scene with exact depth, or the rooms of a data set, each with the selected stacks (at most ``most`` in all)."""
    if isinstance(source, FocalStacks):
        selected = set(torch.linspace(0, len(source) - 1, min(most, len(source))).round().int().tolist())
        rooms = {s: tuple(i for i in indices if i in selected) for s, indices in source.by_scene().items()}
        single = len(source) == 1
        # a folder of images; the path of its last three parts if the name is only a number
        parts = source.root.resolve().parts[-3:] if single and source.root else (source.name,)
        label = "/".join(parts) if parts[-1].isdecimal() and len(parts) > 1 else parts[-1]
        return [
            _StackRoom(label if single else f"{label}/{s}", source, stacks) for s, stacks in rooms.items() if stacks
        ]
    scene = Scene.of(source)
    if not has_exact_depth(scene.recording):
        raise ValueError(f"focus_stack: found {scene.name}, expected focal stacks or a recording with exact depth")
    return [scene]
