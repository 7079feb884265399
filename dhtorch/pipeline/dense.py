"""Every pixel: a depth with a sigma beyond the sensor's reach, and silence where the pictures do not tell.

    method ─ motions, worth of the views ─┐
    reference picture ───────────────────────┼─ sweep ─ surface ─ fit ─ gates ─┐
    other pictures ───────────────────────┘                                 ├─ DepthMap
    sensor ─────────────────────────────────────────────────────────────────┘

The sparse method gives what the sweep stands on: metric motions with their covariances, and which views are worth
asking. What is searched for is one number a pixel, its inverse depth. Returns of the sensor are no input to that
search: where both speak, they judge it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import pytree
from dhtorch.calibration import list_calibrations, load_calibration
from dhtorch.calibration.score_calibration import Calibration
from dhtorch.codes import Gate, PoseCode, Source, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.se3 import Pose
from dhtorch.pipeline import surface
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO
from dhtorch.pipeline.spec import Trace
from dhtorch.records import NO_HINT, Camera, DepthMap, Estimate, Frame, PoseFit, PosePrior, Samples, TrackHint

#: Share of the sensor's reach (the depth that nearly all its returns are nearer than) at which the sweep ends: what the
#: sensor sees as well is what tells whether the sweep is right.
SWEEP_OVERLAP, REACH_QUANTILE = 0.7, 0.98

#: What a view must be worth to be asked, as Σ log(1 + (0.1 · depth / sigma)²) over its answers without a return.
MIN_VIEW_GAIN = 5.0

#: Pixels where sensor and sweep both speak by which a motion may be refuted; a difference counts beyond so many sigmas
#: and such a share of the depth.
MIN_OVERLAP_PIXELS, REFUTING_SIGMAS, REFUTING_RATIO = 200, 3.0, 0.1


#: What the options of a sweep may be.
DENSE_RANGES: dict[str, tuple[float, float]] = {
    "source_views": (1, plane_sweep.MAX_SWEPT_VIEWS),
    "planes": (3, 1024),
    "size": (16, math.inf),
    "refinements": (0, math.inf),
    "min_correlation": (-1, 1),
    "max_sigma_rel": (0, math.inf),
}
DENSE_OPTIONS = tuple(DENSE_RANGES)


class SelectedViews(NamedTuple):
    """The other views of a reference view and what the sparse method made of them."""

    joined: Estimate  # (B, N) what they say together
    frames: Frame  # (V, B)
    estimates: Estimate  # (V, B, N)
    fits: PoseFit  # (V, B)
    samples: Samples  # (B, N) of the reference view


def complete_depth(
    reference: Frame,
    others: Frame | Sequence[Frame],
    *,
    method: Method = AUTO,
    source_views: int = 3,
    planes: int = 96,
    size: int = 640,
    refinements: int = 2,
    min_correlation: float = 0.75,
    max_sigma_rel: float = 0.2,
    calibration: Calibration | None = None,
    seed: int | Tensor = 0,
    fit: PoseFit | PosePrior | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> DepthMap:
    """A depth for every pixel of the reference views that the sensor left out and the other views tell.

    Args:
        reference: B views.
        others: as :class:`dhtorch.pipeline.method.Method` takes them: B views, or V × B of them, or a sequence of V.
        method: the sparse method that gives motions; it chooses among the views as it does by itself.
        source_views: views that are swept at most, those worth most (at most eight).
        planes: inverse depths that are tried, evenly from infinity to within the sensor's reach; where a reference
            view's returns are ``sparse``, to as near as they are.
        size: longer side of the map and of the pictures that are swept, px; smaller pictures stay as they are.
        refinements: Gauss-Newton steps from the best plane.
        min_correlation: of the windows of a pixel in the view that fits best, below which it is silent.
        max_sigma_rel: sigma / depth above which it is silent, before ``calibration``.
        calibration: what makes sigma and score of swept pixels honest; None leaves them as the pictures tell them.
        seed, fit, hint, trace: as :class:`dhtorch.pipeline.method.Method` takes them; the trace also gets ``sparse``,
            the sparse answers.

    Returns:
        DepthMap (B, h, w) over the field of the reference view's picture: returns of the sensor where it has usable
        ones (as ``method.backproject`` reads them), swept depths, silence. Score is h / (h + sigma / depth), h = 0.1.

    Gates: that of the pair for all pixels where no other view is of use (NO_BASELINE, NO_POSE, CONTRADICTED, or
    UNCERTAIN where all are worth too little); NO_TRACK (seen by no view, nearer than what is swept, or found in none),
    UNCERTAIN. CONTRADICTED where the sensor refutes the sweep.

    Raises:
        ValueError: wrong shapes, no other view, or an option out of range.

    Gradient: swept depth to all images, to intrinsics and through the motions to the near depth, by the implicit
    function theorem where the last fit ends; planes, source views, sigma and gates carry none.
    Memory: less than four bytes for every pixel and plane, whatever the number of views, and pictures.
    Cost: linear in planes, pixels and source views.
    """
    trace = {} if trace is None else trace
    joined = trace["sparse"] = method(reference, others, seed=seed, fit=fit, hint=hint, trace=trace)
    return sweep_depth(
        reference,
        selected_views(joined, others, trace),
        method=method,
        source_views=source_views,
        planes=planes,
        size=size,
        refinements=refinements,
        min_correlation=min_correlation,
        max_sigma_rel=max_sigma_rel,
        calibration=calibration,
    )


def sweep_depth(
    reference: Frame,
    asked: SelectedViews,
    *,
    method: Method = AUTO,
    source_views: int = 3,
    planes: int = 96,
    size: int = 640,
    refinements: int = 2,
    min_correlation: float = 0.75,
    max_sigma_rel: float = 0.2,
    calibration: Calibration | None = None,
) -> DepthMap:
    """The second half of :func:`complete_depth`: the sweep, under motions that are known already.

    Arguments, result, errors, gradient, memory and cost as there; of ``method`` the reading of the sensor counts.
    """
    given = (source_views, planes, size, refinements, min_correlation, max_sigma_rel)
    _check_options("complete_depth", dict(zip(DENSE_OPTIONS, given, strict=True)))
    index, wanted = top_views(asked, source_views)
    base = plane_sweep.make_reference_view(*downscale_grey(reference, size))
    source_view = [source_view_of(asked, k, size, use, base.image) for k, use in zip(index, wanted, strict=True)]
    q = torch.linspace(0, 1, planes).to(base.ray) / _nearest(asked.samples, reference.sparse)[:, None].to(base.ray)
    start = surface.sweep_planes(base, source_view, q)
    found = surface.refine_surface(base, source_view, start, q, refinements)
    beyond = start.q >= q[:, -1, None, None] * (1 - 1e-6)
    silent = _pair_gate(asked, wanted)
    told = _gated(base, found, (beyond, start.alone), silent, min_correlation, max_sigma_rel)
    returns = _returns(reference, method, base.hw)
    told = _check_against_returns(told, returns, asked.samples)
    return _merge_returns(told if calibration is None else calibration.apply(told), returns)


def sensor_depth_map(reference: Frame, *, method: Method = AUTO, size: int = 640) -> DepthMap:
    """The map of views that have no other view: the sensor where it answers, else silence (NO_TRACK).

    Arguments, result, errors and gradient as of :func:`complete_depth`.
    """
    _check_options("sensed", {"size": size})
    nan = torch.full((len(reference.camera.f), *map_hw(reference.hw, size)), torch.nan).to(reference.camera.f)
    code = torch.zeros_like(nan, dtype=torch.int32)
    silent = DepthMap(nan, nan, torch.zeros_like(nan), code, torch.full_like(code, Gate.NO_TRACK))
    return _merge_returns(silent, _returns(reference, method, map_hw(reference.hw, size)))


def map_hw(hw: tuple[int, int], size: int) -> tuple[int, int]:
    """Height and width of the map of a picture: its own, or so that the longer side is ``size`` px."""
    longer = max(hw)
    return hw if longer <= size else (max(1, round(hw[0] * size / longer)), max(1, round(hw[1] * size / longer)))


def map_pixel_centres(reference: Frame, hw: tuple[int, int]) -> Tensor:
    """Where the picture shows what the pixels of its map of size ``hw`` stand for: (h · w, 2) px, row by row."""
    rows, columns = (torch.arange(n, device=reference.camera.f.device).to(reference.camera.f) for n in hw)
    scale = reference.hw[0] / hw[0], reference.hw[1] / hw[1]
    v, u = torch.meshgrid((rows + 0.5) * scale[0] - 0.5, (columns + 0.5) * scale[1] - 0.5, indexing="ij")
    return torch.stack([u, v]).flatten(1).mT  # each axis by itself in memory


def downscale_grey(frame: Frame, size: int) -> tuple[Tensor, Camera]:
    """Grey picture (B, 1, h, w) with a longer side of at most ``size``, each pixel the mean of what it covers, and its
    camera. Gradient: to the image and the intrinsics."""
    picture = grayscale(frame.image)
    picture = picture.to(torch.promote_types(picture.dtype, frame.camera.f.dtype))
    hw = map_hw(frame.hw, size)
    if hw == frame.hw:
        return picture, frame.camera
    return F.interpolate(picture, hw, mode="area"), cam.resize(frame.camera, frame.hw, hw)


def dense_options(given: bool | Mapping[str, Any] | None, name: str = "dense") -> dict[str, Any] | None:
    """What settings ask for as keywords of :func:`complete_depth`: true = its own, a mapping = some others, false = no
    maps.

    Raises:
        ValueError: something else, an unknown option, no number, or one out of range.
    """
    if given is None or given is False:
        return None
    if not isinstance(given, bool | Mapping):
        raise ValueError(f"{name}: found {given!r}, expected true, false or options among {', '.join(DENSE_OPTIONS)}")
    standard = complete_depth.__kwdefaults__ or {}
    found: dict[str, Any] = {option: standard[option] for option in DENSE_OPTIONS}
    for option, value in (given if isinstance(given, Mapping) else {}).items():
        if option not in found:
            raise ValueError(f"{name}: found {option!r}, expected some of {', '.join(DENSE_OPTIONS)}")
        whole = isinstance(found[option], int)
        if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
            raise ValueError(f"{name}.{option}: found {value!r}, expected a {'whole ' * whole}number")
        found[option] = value
    _check_options(name, found)
    return found


def _check_options(name: str, given: Mapping[str, float]) -> None:
    for option, value in given.items():
        low, high = DENSE_RANGES[option]
        if not low <= value <= high:
            upper = f" to {high:g}" if high < math.inf else ""
            raise ValueError(f"{name}: {option} is {value}, expected at least {low:g}{upper}")


def selected_views(joined: Estimate, others: Frame | Sequence[Frame], trace: Trace) -> SelectedViews:
    """The views that a method asked and their answers: what it was given, what it said, and its trace."""
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


def top_views(asked: SelectedViews, source_views: int) -> tuple[Tensor, Tensor]:
    """Which views are swept, (K, B) indices, those worth most first, and which of them are worth it (K, B) bool."""
    said = asked.estimates.keep & ~asked.samples.usable & (asked.estimates.sigma > 0)
    ratio = torch.where(said, 0.1 * asked.estimates.depth / asked.estimates.sigma, 0.0).detach()
    gain = torch.where(asked.fits.ok, torch.log1p(ratio.square()).sum(-1), -1.0)
    gain, index = gain.sort(dim=0, descending=True, stable=True)
    return index[:source_views], gain[:source_views] > MIN_VIEW_GAIN


def source_view_of(asked: SelectedViews, index: Tensor, size: int, use: Tensor, like: Tensor) -> surface.SourceView:
    """The views (B,) of that index and their motions, harmless ones where there are none."""
    at = index, torch.arange(len(index), device=index.device)
    frame, fit = asked.frames[at], asked.fits[at]
    image, camera = downscale_grey(frame, size)
    eye = torch.eye(3).to(like)
    R = torch.where(fit.ok[:, None, None], fit.T_1_from_0.R.to(like), eye)
    t = torch.where(fit.ok[:, None], fit.T_1_from_0.t.to(like), eye[0])
    shutter_rate = None if fit.shutter is None else torch.where(fit.ok[:, None], fit.shutter.shutter_rate.to(like), 0.0)
    image = image.to(like)
    return surface.SourceView(
        plane_sweep.SweptView(image, camera, Pose(R, t), shutter_rate), plane_sweep.stack_gradients(image), fit, use
    )


def _nearest(samples: Samples, sparse: Tensor | None = None) -> Tensor:
    """Depth (B,) in m at which the sweep ends; 1 where the sensor sees nothing.

    A map without holes has none nearer than its reach, so that is where the sweep ends. Between the returns of a
    ``sparse`` one (B,) are holes at every depth: there it ends where hardly a return is nearer.
    """
    depth = torch.where(samples.usable, samples.depth, torch.inf).detach().sort(-1).values
    n = samples.usable.sum(-1)
    last = (REACH_QUANTILE * (n - 1).clamp_min(0)).long()
    if sparse is not None:
        last = torch.where(sparse, ((1 - REACH_QUANTILE) * n).long(), last)
    found = depth.gather(-1, last[:, None])[:, 0]
    return torch.where(n > 0, SWEEP_OVERLAP * found, torch.ones_like(found))


def _pair_gate(asked: SelectedViews, wanted: Tensor) -> Tensor:
    """Gate (B,) for all pixels of reference views that no other view is of use for, else ANSWER."""
    still = (asked.fits.code == PoseCode.NO_BASELINE) | (asked.estimates.gate == Gate.NO_BASELINE).any(-1)
    moving = (asked.joined.gate == Gate.CONTRADICTED).any(-1) & ~asked.joined.keep.any(-1)
    none = ~wanted.any(0)
    return first_reason(
        (moving, Gate.CONTRADICTED),
        (none & (asked.fits.code == PoseCode.REFUTED).any(0), Gate.POSE_REFUTED),
        (none & still.any(0), Gate.NO_BASELINE),
        (none & ~asked.fits.ok.any(0), Gate.NO_POSE),
        (none, Gate.UNCERTAIN),
    )


def _gated(
    base: plane_sweep.ReferenceView,
    found: surface.RefinedSurface,
    place: tuple[Tensor, Tensor],  # (B, h, w) bool each: nearer than the nearest plane, found in one place only
    silent: Tensor,  # (B,)
    min_correlation: float,
    max_sigma_rel: float,
) -> DepthMap:
    """The swept map: depths, and what speaks against them."""
    beyond, alone = place
    depth = 1 / found.q.clamp_min(1e-9)
    sigma_rel = (found.own + found.shared).sqrt() * depth.detach()
    lost = ~base.known.unflatten(-1, base.hw) | ~found.seen | beyond | (found.correlation < min_correlation)
    unsure = ~(sigma_rel <= max_sigma_rel) | ~alone
    gate = first_reason((lost, Gate.NO_TRACK), (unsure, Gate.UNCERTAIN))
    pair = silent[:, None, None]
    gate = torch.where(pair != Gate.ANSWER, pair, gate)
    keep = gate == Gate.ANSWER
    nan = torch.full_like(depth, torch.nan)
    return DepthMap(
        depth=torch.where(keep, depth, nan),
        sigma=torch.where(keep, sigma_rel * depth.detach(), nan),
        score=torch.where(keep, 0.1 / (0.1 + sigma_rel), 0.0),
        source=keep.int() * Source.SWEPT,
        gate=gate,
    )


class SensorReturns(NamedTuple):
    """What the sensor says at every pixel of a map, (B, h, w) each."""

    depth: Tensor  # m
    sigma: Tensor  # m
    confidence: Tensor  # in [0, 1]
    usable: Tensor  # bool


def _returns(reference: Frame, method: Method, hw: tuple[int, int]) -> SensorReturns:
    """What the sensor says at every pixel of a map of that size."""
    samples = method.backproject(reference, map_pixel_centres(reference, hw))
    told = samples.depth, samples.sigma, samples.confidence, samples.usable
    return SensorReturns(*(x.unflatten(1, hw) for x in told))


def _check_against_returns(told: DepthMap, returns: SensorReturns, near: Samples) -> DepthMap:
    """The sweep, silent where the sensor refutes it, and as unsure as the sensor is that the motions' metre is from."""
    usable, depth, sigma = returns.usable, returns.depth.detach(), returns.sigma.detach()
    sigma_told = told.sigma.detach()
    both = usable & told.keep
    miss = (torch.where(both, told.depth.detach() - depth, 0.0)).abs()
    spread = torch.where(both, (sigma_told.square() + sigma.square()).sqrt(), 1.0)
    wrong = both & (miss > REFUTING_SIGMAS * spread) & (miss > REFUTING_RATIO * depth)
    n = both.sum((1, 2))
    refuted = (n >= MIN_OVERLAP_PIXELS) & (2 * wrong.sum((1, 2)) > n)
    gate = torch.where(refuted[:, None, None] & told.keep, Gate.CONTRADICTED, told.gate)
    noise = near.usable & (near.depth > 0)
    share = masked_median(near.sigma / torch.where(noise, near.depth, torch.ones_like(near.depth)), noise)
    share = torch.where(noise.any(-1, keepdim=True), share, 0.0)[..., None].detach()  # a wrong scale passes whole
    sigma_told = (sigma_told.square() + (share * told.depth.detach()).square()).sqrt()
    return told.replace(sigma=sigma_told, gate=gate)


def _merge_returns(told: DepthMap, returns: SensorReturns) -> DepthMap:
    """Returns of the sensor where they are usable, else the sweep where it answers."""
    usable = returns.usable
    keep = told.keep & ~usable
    nan = torch.full_like(told.depth, torch.nan)
    return DepthMap(
        depth=torch.where(usable, returns.depth.to(nan), torch.where(keep, told.depth, nan)),
        sigma=torch.where(usable, returns.sigma.to(nan), torch.where(keep, told.sigma, nan)),
        score=torch.where(usable, returns.confidence.to(nan), torch.where(keep, told.score, 0.0)),
        source=(keep.int() * Source.SWEPT).masked_fill(usable, Source.SENSOR),
        gate=told.gate.masked_fill(usable, Gate.ANSWER),
    )


def default_calibration() -> Calibration | None:
    """The calibration of swept depths that travels with the package."""
    return load_calibration("dense") if "dense" in list_calibrations() else None
