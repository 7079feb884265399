"""Plane sweep of a reference view: depth, sigma and score for every pixel beyond the sensor's reach.

    method ─ poses, gain of the views ──┐
    reference image ────────────────────┼─ sweep ─ surface ─ fit ─ gates ─ filters ─┐
    source images ──────────────────────┘                                           ├─ DepthMap
    sensor ─────────────────────────────────────────────────────────────────────────┘

The sparse method gives the metric poses with their covariances, and the source views that are worth sweeping. The
sweep estimates one number per pixel, its inverse depth. The sensor's returns are no input to that search: where both
have a depth, the returns validate the swept one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, PoseCode, Source, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep
from dhtorch.geometry.checks import any_possible
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.least_squares import select_batch
from dhtorch.geometry.se3 import Pose
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline import surface
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.pipeline.map_filters import (
    FIELD_DTYPES,
    SensorReturns,
    copy_fields,
    filter_map,
    map_fields,
    with_fields,
)
from dhtorch.pipeline.planes import fill_planes
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.records import Camera, DepthMap, Estimate, Frame, PoseFit, Samples, SigmaBudget

#: Closed range of every keyword option of :func:`complete_depth` that is a number.
DENSE_RANGES: Final[dict[str, tuple[float, float]]] = {
    "source_views": (1, plane_sweep.MAX_SWEPT_VIEWS),
    "planes": (3, 1024),
    "size": (16, math.inf),
    "refinements": (0, math.inf),
    "min_correlation": (-1, 1),
    "max_sigma_rel": (0, math.inf),
}
DENSE_OPTIONS: Final = tuple(DENSE_RANGES)

#: Least inverse depth whose inverse is a swept pixel's depth, 1/m. Source: derived, beyond any depth.
MIN_SWEPT_INVERSE_DEPTH: Final = 1e-9


class SelectedViews(NamedTuple):
    """The source views of a reference view with their sparse estimates and poses."""

    joined: Estimate  # (B, N), fused over the views
    frames: Frame  # (V, B)
    estimates: Estimate  # (V, B, N)
    fits: PoseFit  # (V, B)
    samples: Samples  # (B, N) of the reference view


class Sweep(NamedTuple):
    """The surface of reference views from their source views, before its gates; maps (B, h, w)."""

    base: plane_sweep.ReferenceView
    surface: surface.RefinedSurface
    beyond: Tensor  # bool, nearer than the nearest plane
    alone: Tensor  # bool, unique best plane
    n_views: Tensor  # (B,) swept views and the reference view
    pair_gate: Tensor  # (B,) gate of all pixels of reference views without a source view to sweep
    returns: SensorReturns
    near: Samples  # (B, N)
    reach: Tensor  # (B,) m, depth to which the sensor returns
    sparse: Tensor | None  # (B,) bool, whether the returns are sparse


def sweep_depth(
    reference: Frame,
    selected: SelectedViews,
    *,
    method: MethodSpec,
    source_views: int = DenseOptions.source_views,
    planes: int = DenseOptions.planes,
    size: int = DenseOptions.size,
    refinements: int = DenseOptions.refinements,
    min_correlation: float = DenseOptions.min_correlation,
    max_sigma_rel: float = DenseOptions.max_sigma_rel,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> DepthMap:
    """Depth maps (B, h, w) of the sweep alone: near returns, and swept depths under the poses of the selected views.

    Arguments, gates, errors, gradient, memory and cost as of :func:`dhtorch.pipeline.completion.complete_depth`; of
    ``method`` only ``backproject`` is used.
    """
    keywords = dict(
        zip(DENSE_OPTIONS, (source_views, planes, size, refinements, min_correlation, max_sigma_rel), strict=True)
    )
    check_dense_options("sweep_depth", keywords)
    options = replace(options, **keywords)  # type: ignore[arg-type]
    sweep = sweep_views(reference, selected, method, options)
    return merge_returns(filter_sweep(sweep, gate_sweep(sweep, options), options), sweep.returns)


def sweep_views(reference: Frame, selected: SelectedViews, method: MethodSpec, options: DenseOptions) -> Sweep:
    """The surface of the reference views by a plane sweep of the selected views of largest gain."""
    index, use = top_views(selected, options.source_views, options)
    base = plane_sweep.make_reference_view(*downscale_grey(reference, options.size))
    source_views = [
        source_view_of(selected, k, options.size, is_used, base.image) for k, is_used in zip(index, use, strict=True)
    ]
    # The sweep ends at the sensor's reach: a map without holes has none nearer than that. Between the returns of a
    # sparse map are holes at every depth: there it ends where only 1 - ``reach_quantile`` of the returns are nearer.
    depth = torch.where(selected.samples.usable, selected.samples.depth, torch.inf).detach().sort(-1).values
    n = selected.samples.usable.sum(-1)
    rank = (options.reach_quantile * (n - 1).clamp_min(0)).long()
    if reference.sparse is not None:
        rank = torch.where(reference.sparse, ((1 - options.reach_quantile) * n).long(), rank)
    reach = depth.gather(-1, rank[:, None])[:, 0]
    nearest = torch.where(n > 0, options.sweep_overlap * reach, torch.ones_like(reach))
    q = torch.linspace(0, 1, options.planes, device=base.ray.device).to(base.ray) / nearest[:, None].to(base.ray)
    start = surface.sweep_planes(base, source_views, q, options)
    return Sweep(
        base=base,
        surface=surface.refine_surface(base, source_views, start, q, options.refinements, options),
        beyond=start.q >= q[:, -1, None, None] * (1 - 1e-6),
        alone=start.alone,
        n_views=use.sum(0) + 1,
        pair_gate=_pair_gate(selected, use),
        returns=_returns(reference, method, base.hw),
        near=selected.samples,
        reach=nearest / options.sweep_overlap,
        sparse=reference.sparse,
    )


def gate_sweep(sweep: Sweep, options: DenseOptions) -> DepthMap:
    """The swept map (B, h, w) with its gates, before it is filtered by its neighbours."""
    known = sweep.base.known.unflatten(-1, sweep.base.hw)
    returns = sweep.returns.depth.detach(), sweep.returns.sigma.detach(), sweep.returns.usable
    has_sigma = sweep.near.usable & (sweep.near.depth > 0)
    near_depth = torch.where(has_sigma, sweep.near.depth, torch.ones_like(sweep.near.depth))
    # The relative error of the metric scale, which affects all pixels alike, is that of the near samples.
    error = masked_median(sweep.near.sigma / near_depth, has_sigma)
    scale_error = torch.where(has_sigma.any(-1, keepdim=True), error, 0.0)[:, 0].detach()
    place = sweep.beyond, sweep.alone
    depth, sigma, score, source, gate, track, pose, reference = _gate(
        *sweep.surface, known, *place, sweep.pair_gate, scale_error, *returns, options=options
    )
    zero = torch.zeros_like(track[:1, :1, :1]).expand_as(track)
    return DepthMap(depth, sigma, score, source, gate, SigmaBudget(track, pose, reference, zero, zero))


def filter_sweep(sweep: Sweep, swept: DepthMap, options: DenseOptions) -> DepthMap:
    """The swept map without answers that their neighbours or the returns refute, and with those that they imply.

    ``torch.compile`` breaks its graph here: the pixels to fill are gathered, and their number depends on the map.
    Reference views without a source view to sweep keep the sensor's returns alone.
    """
    image, reach, sparse = sweep.base.image, sweep.reach, sweep.sparse
    filtered = filter_map(swept, sweep.returns, image[:, 0], sparse, options)
    filled = fill_planes(filtered, swept, sweep.returns, image, reach, sparse=sparse, options=options)
    is_swept = sweep.pair_gate == Gate.ANSWER
    return select_batch(is_swept, filled, swept) if any_possible(~is_swept) else filled


def sensor_depth_map(reference: Frame, *, method: MethodSpec, size: int = DenseOptions.size) -> DepthMap:
    """The depth maps (B, h, w) of reference views without a source view: near returns, else unanswered (NO_TRACK).

    Arguments, result, errors and gradient as of :func:`complete_depth`.
    """
    check_dense_options("sensor_depth_map", {"size": size})
    nan = torch.full((len(reference.camera.f), *map_hw(reference.hw, size)), torch.nan).to(reference.camera.f)
    code = torch.zeros_like(nan, dtype=torch.int32)
    zero = torch.zeros_like(nan)
    parts = SigmaBudget.single("track", zero)
    unanswered = DepthMap(nan, nan, zero, code, torch.full_like(code, Gate.NO_TRACK), parts)
    return merge_returns(unanswered, _returns(reference, method, map_hw(reference.hw, size)))


def map_hw(hw: tuple[int, int], size: int) -> tuple[int, int]:
    """Height and width of the map of an image of height and width ``hw``: its own, or with a longer side of ``size``
    px."""
    longer = max(hw)
    return hw if longer <= size else (max(1, round(hw[0] * size / longer)), max(1, round(hw[1] * size / longer)))


def map_pixel_centres(reference: Frame, hw: tuple[int, int]) -> Tensor:
    """Centres of the pixels of a map of size ``hw`` in the reference image: (h · w, 2) px, row by row."""
    rows, columns = (torch.arange(n, device=reference.camera.f.device).to(reference.camera.f) for n in hw)
    scale = reference.hw[0] / hw[0], reference.hw[1] / hw[1]
    v, u = torch.meshgrid((rows + 0.5) * scale[0] - 0.5, (columns + 0.5) * scale[1] - 0.5, indexing="ij")
    return torch.stack([u, v]).flatten(1).mT  # each coordinate contiguous in memory


def downscale_grey(frame: Frame, size: int) -> tuple[Tensor, Camera]:
    """Grey image (B, 1, h, w) with a longer side of at most ``size`` px, by area means, and its camera.

    Gradient: to the image and the intrinsics.
    """
    grey = grayscale(frame.image)
    grey = grey.to(torch.promote_types(grey.dtype, frame.camera.f.dtype))
    hw = map_hw(frame.hw, size)
    if hw == frame.hw:
        return grey, frame.camera
    return F.interpolate(grey, hw, mode="area"), cam.resize(frame.camera, frame.hw, hw)


def dense_options(settings: bool | Mapping[str, Any] | None, name: str = "dense") -> dict[str, Any] | None:
    """Keyword options of :func:`complete_depth` from a setting: True = the defaults, a mapping = changes of some,
    False or None = None (no maps).

    Raises:
        ValueError: another type, an unknown option, no number, or one out of range.
    """
    if settings is None or settings is False:
        return None
    if not isinstance(settings, bool | Mapping):
        raise ValueError(
            f"{name}: found {settings!r}, expected true, false or options among {', '.join(DENSE_OPTIONS)}"
        )
    options: dict[str, Any] = {option: getattr(DEFAULT_DENSE_OPTIONS, option) for option in DENSE_OPTIONS}
    for option, value in (settings if isinstance(settings, Mapping) else {}).items():
        if option not in options:
            raise ValueError(f"{name}: found {option!r}, expected some of {', '.join(DENSE_OPTIONS)}")
        is_whole = isinstance(options[option], int)
        if isinstance(value, bool) or not isinstance(value, int if is_whole else (int, float)):
            raise ValueError(f"{name}.{option}: found {value!r}, expected a {'whole ' * is_whole}number")
        options[option] = value
    check_dense_options(name, options)
    return options


def check_dense_options(name: str, options: Mapping[str, float]) -> None:
    """Raise ValueError for an option out of its range."""
    for option, value in options.items():
        low, high = DENSE_RANGES[option]
        if not low <= value <= high:
            upper = f" to {high:g}" if high < math.inf else ""
            raise ValueError(f"{name}: {option} is {value}, expected at least {low:g}{upper}")


def selected_views(joined: Estimate, others: Frame | Sequence[Frame], trace: Trace) -> SelectedViews:
    """The source views that a method used, with their estimates and poses, from its estimate, its other views and its
    trace."""
    if not isinstance(others, Frame):
        others = pytree.stack(others)
    if others.image.dim() == 4:
        others = pytree.stack([others])
    if "views" not in trace:
        estimates, fits = (pytree.stack([trace[name]]) for name in ("estimate", "fit"))
        return SelectedViews(joined, others, estimates, fits, trace["samples"])
    index = trace["choice"].index
    frames = others[index, torch.arange(index.shape[1], device=index.device)]
    estimates, fits = (pytree.stack([view[name] for view in trace["views"]]) for name in ("estimate", "fit"))
    return SelectedViews(joined, frames, estimates, fits, trace["samples"])


def top_views(
    selected: SelectedViews, source_views: int, options: DenseOptions = DEFAULT_DENSE_OPTIONS
) -> tuple[Tensor, Tensor]:
    """Indices (K, B) of the views of largest gain, in descending order, and whether they are to be swept (K, B) bool.

    The gain is Σ log(1 + (0.1 · depth / sigma)²) over a view's answers without a return.
    """
    counts = selected.estimates.keep & ~selected.samples.usable & (selected.estimates.sigma > 0)
    ratio = torch.where(counts, 0.1 * selected.estimates.depth / selected.estimates.sigma, 0.0).detach()
    gain = torch.where(selected.fits.ok, torch.log1p(ratio.square()).sum(-1), -1.0)
    gain, index = gain.sort(dim=0, descending=True, stable=True)
    return index[:source_views], gain[:source_views] > options.min_view_gain


def source_view_of(selected: SelectedViews, index: Tensor, size: int, use: Tensor, like: Tensor) -> surface.SourceView:
    """The source views (B,) with index (B,), their images downscaled to ``size`` px; a placeholder motion where the
    pose is missing.

    ``use`` (B,) bool says which are swept; floating tensors get dtype and device of ``like``.
    """
    rows = index, torch.arange(len(index), device=index.device)
    frame, fit = selected.frames[rows], selected.fits[rows]
    image, camera = downscale_grey(frame, size)
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    R = torch.where(fit.ok[:, None, None], fit.T_1_from_0.R.to(like), eye)
    t = torch.where(fit.ok[:, None], fit.T_1_from_0.t.to(like), eye[0])
    shutter_rate = None if fit.shutter is None else torch.where(fit.ok[:, None], fit.shutter.shutter_rate.to(like), 0.0)
    image = image.to(like)
    return surface.SourceView(
        plane_sweep.SweptView(image, camera, Pose(R, t), shutter_rate), plane_sweep.stack_gradients(image), fit, use
    )


def _pair_gate(selected: SelectedViews, use: Tensor) -> Tensor:
    """Gate (B,) for all pixels of reference views without a source view to sweep, else ANSWER."""
    no_baseline = (selected.fits.code == PoseCode.NO_BASELINE) | (selected.estimates.gate == Gate.NO_BASELINE).any(-1)
    contradicted = (selected.joined.gate == Gate.CONTRADICTED).any(-1) & ~selected.joined.keep.any(-1)
    no_view = ~use.any(0)
    return first_reason(
        (contradicted, Gate.CONTRADICTED),
        (no_view & (selected.fits.code == PoseCode.MISALIGNED).any(0), Gate.MISALIGNED),
        (no_view & (selected.fits.code == PoseCode.REFUTED).any(0), Gate.POSE_REFUTED),
        (no_view & no_baseline.any(0), Gate.NO_BASELINE),
        (no_view & ~selected.fits.ok.any(0), Gate.NO_POSE),
        (no_view, Gate.UNCERTAIN),
    )


def _gate_kernel(*tensors: Tensor, options: DenseOptions) -> tuple[Tensor, ...]:
    maps = [x.contiguous() for x in tensors]
    columns = [torch.empty_like(maps[0]) for _ in range(3)]
    codes = [torch.empty_like(maps[0], dtype=torch.int32) for _ in range(2)]
    parts = [torch.empty_like(maps[0]) for _ in range(3)]
    limits = (
        *(options.min_correlation, options.max_sigma_rel, options.refuting_sigmas, options.refuting_ratio),
        *(options.min_overlap_pixels, MIN_SWEPT_INVERSE_DEPTH),
    )
    torch.ops.dhtorch.gate_map.default(*maps, *columns, *codes, *parts, *limits)
    return (*columns, *codes, *parts)


_GATE_DTYPES = (
    dict.fromkeys(("q", "own", "shared", "correlation"), torch.float32)
    | dict.fromkeys(("seen", "known", "beyond", "alone"), torch.bool)
    | {"pair_gate": torch.int32, "scale_error": torch.float32}
    | {"near_depth": torch.float32, "near_sigma": torch.float32, "usable": torch.bool}
)


@operator(kernel=_gate_kernel, dtypes=_GATE_DTYPES, any_layout=tuple(_GATE_DTYPES))
def _gate(*tensors: Any, options: DenseOptions) -> tuple[Tensor, ...]:
    """Depth, sigma, score, source and gate (B, h, w) of a surface, and its variances by cause.

    Args:
        tensors: the fields of the surface; whether the lens model has a ray, the surface is nearer than the nearest
            plane, and its best plane is unique (B, h, w) bool; gate of all pixels (B,); relative error of the scale
            (B,); depth, sigma and usability of the returns (B, h, w).
        options: tuning constants.
    """
    fitted = surface.RefinedSurface(*tensors[:5])
    known, beyond, alone, pair_gate, scale_error, near_depth, near_sigma, usable = tensors[5:]
    z = 1 / fitted.q.clamp_min(MIN_SWEPT_INVERSE_DEPTH)
    sigma_rel = (fitted.own + fitted.shared).sqrt() * z.detach()
    untracked = ~known | ~fitted.seen | beyond | (fitted.correlation < options.min_correlation)
    uncertain = ~(sigma_rel <= options.max_sigma_rel) | ~alone
    gate = first_reason((untracked, Gate.NO_TRACK), (uncertain, Gate.UNCERTAIN))
    gate = torch.where(pair_gate[:, None, None] != Gate.ANSWER, pair_gate[:, None, None], gate)
    keep = gate == Gate.ANSWER
    depth, sigma = (torch.where(keep, x, torch.full_like(z, torch.nan)) for x in (z, (sigma_rel * z).detach()))
    # CONTRADICTED where near returns refute the map; the metric scale's uncertainty is added to sigma.
    overlap = usable & keep
    error = (torch.where(overlap, depth.detach() - near_depth, 0.0)).abs()
    error_sigma = torch.where(overlap, (sigma.square() + near_sigma.square()).sqrt(), 1.0)
    wrong = overlap & (error > options.refuting_sigmas * error_sigma) & (error > options.refuting_ratio * near_depth)
    n = overlap.sum((1, 2))
    refuted = (n >= options.min_overlap_pixels) & (2 * wrong.sum((1, 2)) > n)
    by_sensor = (scale_error[:, None, None] * depth.detach()).square()
    steep = z.detach().square().square()  # m⁴, of a variance of q to one of depth
    return (
        *(depth, (sigma.square() + by_sensor).sqrt(), torch.where(keep, 0.1 / (0.1 + sigma_rel), 0.0)),
        *(keep.int() * Source.SWEPT, torch.where(refuted[:, None, None] & keep, Gate.CONTRADICTED, gate)),
        *(fitted.own * steep, fitted.shared * steep, by_sensor),
    )


def _returns(reference: Frame, method: MethodSpec, hw: tuple[int, int]) -> SensorReturns:
    """The sensor's returns at every pixel of a map of height and width ``hw``, by ``method.backproject``."""
    samples = method.backproject(reference, map_pixel_centres(reference, hw))
    columns = samples.depth, samples.sigma, samples.confidence, samples.usable
    return SensorReturns(*(x.unflatten(1, hw) for x in columns))


def merge_returns(swept: DepthMap, returns: SensorReturns) -> DepthMap:
    """The sensor's returns where they are usable, else the swept map where it is answered."""
    sensed = (x.to(swept.depth) for x in (returns.depth, returns.sigma, returns.confidence))
    return with_fields(swept, _merge(*map_fields(swept), *sensed, returns.usable))


def _merge_kernel(*tensors: Tensor) -> tuple[Tensor, ...]:
    merged = copy_fields(tensors)
    torch.ops.dhtorch.merge_maps.default(*merged, *(x.contiguous() for x in tensors[len(merged) :]))  # in place
    return tuple(merged)


_MERGE_DTYPES = (
    FIELD_DTYPES | dict.fromkeys(("near_depth", "near_sigma", "confidence"), torch.float32) | {"usable": torch.bool}
)


@operator(kernel=_merge_kernel, dtypes=_MERGE_DTYPES, any_layout=tuple(_MERGE_DTYPES))
def _merge(*tensors: Any) -> tuple[Tensor, ...]:
    """:func:`merge_returns` of the fields of both maps (B, h, w)."""
    depth, sigma, score, source, gate, near_depth, near_sigma, confidence, usable = tensors
    keep = (gate == Gate.ANSWER) & ~usable
    nan = torch.full_like(depth, torch.nan)
    return (
        torch.where(usable, near_depth, torch.where(keep, depth, nan)),
        torch.where(usable, near_sigma, torch.where(keep, sigma, nan)),
        torch.where(usable, confidence, torch.where(keep, score, 0.0)),
        torch.where(keep, source, Source.NONE).masked_fill(usable, Source.SENSOR),
        gate.masked_fill(usable, Gate.ANSWER),
    )
