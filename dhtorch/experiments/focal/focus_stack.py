"""Question: does the classical recipe, the sharpest picture of every pixel, read depth off a focal stack?

On scenes of exact depth the stack is rendered through a thin lens, in five conditions: ``clean``; ``noisy`` (4 grey
levels); ``moved`` (breathing by 2 % and a hand's shifts of about a pixel) and ``aligned`` (the same after alignment);
``light_field`` (the optics of DDFF-12, whose spots grow by 1.3 px per dioptre, and 2 grey levels of noise). The control
``no_focus`` is a stack in which nothing was blurred. Stacks of a data set (FoD500, DDFF-12) are taken as they are
(``given``), after alignment as well; on sweeps without depth it is asked whether the order of the pictures can be read
off them, and whether the odd and the even pictures agree.

Expectation (written before the run): on clean stacks yes (the paper: Spearman 0.69, gated Pearson 0.76); on light
fields it fails, with the sign flipped on some scenes (about 1 in 5), and keeping the most confident quarter of the
pixels does not rescue it (|r| 0.15 to 0.21).
What would refute it: a clean Spearman below 0.5; or on light fields a Spearman of more than half the clean one or a
gated |r| of 0.5 or more.
"""

from __future__ import annotations

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
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row, mean_or_none
from dhtorch.experiments.screening import ScreenedItem, screen_scenes
from dhtorch.geometry import filters
from dhtorch.metrics import bootstrap
from dhtorch.metrics.correlation import pearson, spearman
from dhtorch.records import Frame
from dhtorch.synthetic.thin_lens import make_lens, render_defocus

QUESTION = "Does the classical recipe, the sharpest picture of every pixel, read depth off a focal stack?"
EXPECTATION = "On clean stacks; on light fields it fails, flips sign on some scenes, and confidence does not rescue it."

RENDERED_CONDITIONS = ("clean", "noisy", "moved", "aligned", "light_field", "no_focus")
_RECORDED_CONDITIONS = ("given", "given_aligned")

#: What the verdict asks of clean stacks, and of light fields.
_MIN_CLEAN_CORRELATION, _MAX_LIGHT_FIELD_RATIO, _MAX_GATED_CORRELATION = 0.5, 0.5, 0.5

#: Nearest and farthest distance in focus, m, in equal steps of inverse distance, as DDFF-12 has them.
_FOCUS_RANGE_M = (0.5, 7.0)

#: The optics of DDFF-12: spot px per dioptre = focal length 521.4 px times nine sub-apertures 0.271 mm apart.
_LIGHT_FIELD_PX_PER_DPT = 521.4 * 9 * 2.7088e-4

#: Pixels kept by the gate.
_CONFIDENT_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class _StackRoom:
    """What the stacks of a data set show: one stack, or all that show the same room."""

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
    """Ask every stack, with every measure of sharpness; variants are called ``<condition>`` for the first measure.

    Rows, per scene: over the pixels of a grid with depth, ``rank_corr`` (Spearman) and ``corr`` (Pearson) of claimed
    and true inverse depth, ``gated_corr`` over the most confident quarter, ``abs_corr`` and ``gated_abs_corr`` their
    sizes, ``flip_share`` 1 where Spearman is negative (a scene and the summary have its mean), ``median_rel`` of
    depth. Without depth: ``order_corr``, ``halves_corr``, ``motion_px``, see :func:`measure_without_truth`.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`; recordings with exact depth
            (``lidar`` is "exact"; their first frame), or focal stacks.
        methods, pairs: not used.
        measures: of sharpness; the first decides.
        window_px: in which sharpness is averaged.
        slices: pictures of a rendered stack.
        focal_length_m, f_number: of the lens, as in :func:`dhtorch.experiments.focal.defocus.run`.
        stride_px: of the grid.
        max_stacks: of each data set, evenly spread. Stacks of one room are one scene.

    Raises:
        ValueError: a recording with neither; fewer than two slices.

    Source: paper, "What Does Not Work", classical focus-stack depth.
    """
    if slices < 2:
        raise ValueError(f"experiment.slices: found {slices}, expected at least 2")
    ask_maps = partial(_numbers, measures=measures, window_px=window_px, stride=stride_px)

    def ask(scene: _StackRoom | Scene, item: ScreenedItem) -> dict[str, Row]:
        if isinstance(scene, _StackRoom):
            stack = _sort_by_focus(scene.stacks[item[0]].to(settings.dtype).to(settings.device))
            if stack.depth is None or stack.focus_m is None:
                return measure_without_truth(stack, measures[0], window_px)
            taken = {"given": stack.images, "given_aligned": align_stack(stack.images)[0]}
            return _evaluate_stack(taken, stack.focus_m, stack.depth, ask_maps, measures)
        frame = scene.recording[0].to(settings.dtype).to(settings.device)
        steps = torch.linspace(1 / _FOCUS_RANGE_M[0], 1 / _FOCUS_RANGE_M[1], slices, dtype=settings.dtype)
        lens = {"focal_length_m": focal_length_m, "f_number": f_number}
        made = render_stacks(frame, 1 / steps[None], lens, settings.seed)
        return _evaluate_stack(made, 1 / steps[None], frame.depth, ask_maps, measures)

    rooms = [room for given in scenes for room in _group_rooms(given, max_stacks)]
    names = [
        c if m == measures[0] else f"{c}, {m}" for c in (*RENDERED_CONDITIONS, *_RECORDED_CONDITIONS) for m in measures
    ]
    wanted = _possible_variants(rooms, names)
    outcome = screen_scenes(rooms, _stack_items, ask, wanted, truth="full", whole=_flip_shares, progress=progress)
    for name in wanted:
        flips = [row.get("flip_share") for row in outcome.scenes(name).values()]
        entry = bootstrap.interval_over_scenes(flips, statistic="mean").entry()
        outcome.summary |= {f"{name}.flip_share": entry} if entry["value"] is not None else {}
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome))


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Good on clean stacks, bad on light fields, and not rescued by confidence?"""

    def at(name: str) -> float | None:
        value = outcome.summary.get(name, {}).get("value")
        return None if value is None else float(value)

    clean, field = at("clean.rank_corr"), at("light_field.rank_corr")
    plain, gated, flips = (at(f"light_field.{m}") for m in ("abs_corr", "gated_abs_corr", "flip_share"))
    if clean is None or field is None or plain is None or gated is None or flips is None:
        known = {"Spearman": at("given.rank_corr"), "order of the pictures recovered": at("given_aligned.order_corr")}
        said = "; ".join(f"{k} {v:.2f}" for k, v in known.items() if v is not None)
        return None, f"no rendered stacks: clean and light-field ones are not compared{said and f' ({said})'}"
    why = (
        f"clean Spearman {clean:.2f} (paper 0.69), gated r {at('clean.gated_corr') or 0:.2f} (0.76); light"
        f" field Spearman {field:.2f}, flipped on {flips:.0%} of scenes (1/5),"
        f" |r| {plain:.2f} to {gated:.2f} (0.15 to 0.21)"
    )
    return (
        clean >= _MIN_CLEAN_CORRELATION and field <= _MAX_LIGHT_FIELD_RATIO * clean and gated < _MAX_GATED_CORRELATION,
        why,
    )


def render_stacks(frame: Frame, focus_m: Tensor, lens: Mapping[str, float], seed: int) -> dict[str, Tensor]:
    """Condition → grey stack (1, S, 1, H, W) of a frame with exact depth."""
    sharp = filters.grayscale(frame.image)
    draw, count = torch.Generator().manual_seed(seed), focus_m.shape[1]
    f_px = float(frame.camera.f[0, 0])
    wide = make_lens(f_px, **lens).to(focus_m.dtype)
    small = make_lens(f_px, focal_length_m=0.0095, f_number=0.0095 * f_px / _LIGHT_FIELD_PX_PER_DPT).to(focus_m.dtype)
    clean = render_defocus(sharp, frame.depth, wide, focus_m, step_px=1.0)
    field = render_defocus(sharp, frame.depth, small, focus_m, step_px=0.25)

    def grain(x: Tensor, levels: float) -> Tensor:
        return (x + levels / 255 * torch.randn(x.shape, generator=draw).to(x)).clamp(0, 1)

    noisy = grain(clean, 4)
    moved = grain(_jitter(clean, draw), 1)
    return {
        "clean": clean,
        "noisy": noisy,
        "moved": moved,
        "aligned": align_stack(moved)[0],
        "light_field": grain(field, 2),
        "no_focus": grain(sharp[:, None].expand(-1, count, -1, -1, -1), 2),
    }


def measure_without_truth(stack: FocalStack, measure: str, window_px: float) -> dict[str, Row]:
    """What can be asked of a sweep without depth, as it is and aligned.

    ``order_corr``: |Spearman| of the order of the pictures with the order read off their sharpness (neighbours in a
    sweep are sharp in nearly the same places). ``halves_corr``: Spearman of the places found in the odd and in the even
    pictures, on the most confident quarter. ``motion_px``: largest motion found by the alignment, at the border.
    """
    images, motion = align_stack(stack.images)
    half = max(stack.hw) / 2
    largest = float((motion[..., 0].abs() * half + motion[..., 1:].norm(dim=-1)).max())
    found = {}
    for name, pictures in (("given", stack.images), ("given_aligned", images)):
        measured = measure_sharpness(pictures, measure, window_px=window_px)
        row: Row = {
            "order_corr": order_correlation(measured),
            "halves_corr": halves_correlation(measured),
            "n_pictures": measured.shape[1],
        }
        found[name] = row | {"motion_px": largest if name == "given" else 0.0}
    return found


def order_correlation(measured: Tensor) -> float | None:
    """|Spearman| of the true order of the pictures of (1, S, H, W) with the one read off their sharpness.

    Every picture is linked to the one that is sharp in most nearly the same places (the shortest tree of links); the
    order is the way along the tree from the one end of its longest path. The true order takes no part.
    """
    size = max(4, min(measured.shape[-2:]) // 30)
    level = torch.log(torch.nn.functional.avg_pool2d(measured[0][:, None], size).flatten(1).double() + 1e-9)
    level = level - level.mean(0)  # what a place has in all pictures is its texture, not its focus
    unlike = (1 - torch.corrcoef(level)).clamp_min(0).sqrt()
    end = int(_along_tree(unlike, 0).argmax())
    found = spearman(_along_tree(unlike, end), torch.arange(len(unlike), dtype=unlike.dtype))
    return None if found is None else abs(found)


def _along_tree(distance: Tensor, start: int) -> Tensor:
    """Way (S,) from one node to every other along the shortest tree that joins all (Prim)."""
    way = torch.full_like(distance[0], torch.nan)
    way[start] = 0
    for _ in range(len(distance) - 1):
        links = torch.where(way.isfinite()[:, None] & way.isnan(), distance, torch.inf)
        i, j = divmod(int(links.argmin()), len(distance))
        way[j] = way[i] + distance[i, j]
    return way


def halves_correlation(measured: Tensor) -> float | None:
    """Spearman of the places found in the odd and in the even pictures, on the most confident quarter."""
    if measured.shape[1] < 4:
        return None
    odd, even = find_sharpest(measured[:, 0::2]), find_sharpest(measured[:, 1::2])
    sure = torch.minimum(odd.confidence, even.confidence).flatten()
    use = sure >= sure.quantile(1 - _CONFIDENT_SHARE) if sure.numel() < 2**24 else sure > 0
    return spearman(odd.place.flatten()[use].double(), even.place.flatten()[use].double())


def _evaluate_stack(
    taken: Mapping[str, Tensor], focus_m: Tensor, depth: Tensor, ask: Any, measures: Sequence[str]
) -> Any:
    """Variant → numbers."""
    return {
        condition if m == measures[0] else f"{condition}, {m}": ask(images, focus_m, depth, measure=m)
        for condition, images in taken.items()
        for m in measures
    }


def _numbers(
    images: Tensor,
    focus_m: Tensor,
    depth: Tensor,
    *,
    measure: str,
    measures: Sequence[str],
    window_px: float,
    stride: int,
) -> Row:
    """How the depth read off a stack goes with the true one."""
    focus = find_sharpest(measure_sharpness(images, measure, window_px=window_px))
    claim = depth_at_focus(focus.place, focus_m)
    x, y, sure = (v[0, ::stride, ::stride].flatten().double() for v in (claim, depth, focus.confidence))
    known = y > 0
    x, y, sure = x[known], y[known], sure[known]
    kept = sure >= sure.sort().values[int((1 - _CONFIDENT_SHARE) * (len(sure) - 1))] if len(sure) else known[:0]
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


def _stack_items(scene: _StackRoom | Scene) -> list[ScreenedItem]:
    """The stacks of a scene; the first frame of a recording."""
    return [(i, i) for i in scene.indices] if isinstance(scene, _StackRoom) else [(0, 0)]


def _flip_shares(_scene: _StackRoom | Scene, found: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Variant → share of a scene's stacks whose sign is flipped; the median of yes and no would not say it."""
    said: dict[str, list[float]] = {}
    for answer in found:
        for variant, row in answer.items():
            said.setdefault(variant, []).extend([row["flip_share"]] if row.get("flip_share") is not None else [])
    return {variant: {"flip_share": mean_or_none(shares)} for variant, shares in said.items() if shares}


def _group_rooms(given: FocalStacks | SceneLike, most: int) -> list[_StackRoom | Scene]:
    """A scene with exact depth, or every room of a data set with those of its stacks that were chosen."""
    if isinstance(given, FocalStacks):
        chosen = set(torch.linspace(0, len(given) - 1, min(most, len(given))).round().int().tolist())
        rooms = {s: tuple(i for i in all_ if i in chosen) for s, all_ in given.by_scene().items()}
        single = len(given) == 1
        label = given.name if given.root is None or not single else _folder_name(given)
        return [_StackRoom(label if single else f"{label}/{s}", given, stacks) for s, stacks in rooms.items() if stacks]
    scene = Scene.of(given)
    if not has_exact_depth(scene.recording):
        raise ValueError(f"focus_stack: {scene.name} expected focal stacks, or a recording with exact depth")
    return [scene]


def _folder_name(stacks: FocalStacks) -> str:
    """Name of a folder of pictures; one that is a mere number takes its parents' along."""
    parts = stacks.root.resolve().parts[-3:] if stacks.root else (stacks.name,)
    return parts[-1] if not parts[-1].isdecimal() else "/".join(parts)


def _possible_variants(scenes: Sequence[_StackRoom | Scene], names: Sequence[str]) -> list[str]:
    """The variants that these scenes can have."""
    kinds = {isinstance(s, _StackRoom) for s in scenes}
    return [n for n in names if (n.split(",")[0] in _RECORDED_CONDITIONS) in kinds]


def _sort_by_focus(stack: FocalStack) -> FocalStack:
    """The stack from near to far focus, where the distances are known."""
    if stack.focus_m is None:
        return stack
    by = stack.focus_m[0].argsort()
    return stack.replace(images=stack.images[:, by], focus_m=stack.focus_m[:, by])


def _jitter(images: Tensor, draw: torch.Generator) -> Tensor:
    """The stack with a magnification that changes by 2 % and shifts of about a pixel."""
    B, S, _, H, W = images.shape
    zoom = 1 + torch.linspace(-0.01, 0.01, S)
    shift = torch.randn(S, 2, generator=draw)
    theta = torch.zeros(S, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = zoom
    theta[:, :, 2] = shift * 2 / torch.tensor([W, H])
    grid = torch.nn.functional.affine_grid(theta.to(images), [S, 1, H, W], align_corners=False)
    options: dict[str, Any] = {"mode": "bicubic", "padding_mode": "border", "align_corners": False}
    return torch.stack([torch.nn.functional.grid_sample(images[b], grid, **options) for b in range(B)])
