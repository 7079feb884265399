"""Is this depth right? Of every pixel consistent, wrong or cannot know; of the frame scale, shift, tilt, share wrong.

    method ─ near returns, triangulated points ─ sparse_evidence ─┐
           └ motions ─ pictures of other views ─ photometric_evidence ───┼─ states ─┐
                     └ maps of other views ───── consistency_evidence ────┘          ├─ Verdict
             ratios to the answers ─ scale, shift, tilt ────────────────┘

The map may come from anywhere. Where it is the sensor's own, its returns fix the motions' metre: a wrong scale passes
through everything that stands on it, and only a given trajectory (``T_world_from_cam``) can tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, State
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.records import NO_HINT, DepthValidation, Estimate, Frame, PoseFit, TrackHint
from dhtorch.validation import evidence
from dhtorch.validation.evidence import Evidence, ValidationReferences

#: The sparse method of a verdict in little time, by one other view (with ``views=False``): a metre is told by some
#: dozens of points, and their motion by as few. ``experiment=validate_study`` holds what it says against the whole
#: method.
QUICK_METHOD = MAP.replace(n=256, hypotheses=64, pose={"near_steps": 2, "steps": 3})

#: Sigmas from which on evidence speaks against a pixel, and up to which it speaks for it.
REFUTING_EVIDENCE_SIGMAS, SUPPORTING_EVIDENCE_SIGMAS = 3.0, 2.0

#: References that count as independent at most: they share tracks' neighbourhoods, lens and sensor.
MAX_INDEPENDENT_REFERENCES = 60

#: What a sensor's metre, and a trajectory's, are good for.
SENSOR_SCALE_SIGMA, TRAJECTORY_SCALE_SIGMA = 0.005, 0.02

#: Fewest references of a kind that say something of a frame, and fewest for shift and tilt.
MIN_SCALE_REFERENCES, MIN_SHAPE_REFERENCES = 8, 24

#: Pixels of a grid that count as one when a share is counted: a window.
SHARE_WINDOW_PIXELS = 81

#: Least share of a map's pixels that all stand exactly as far as its farthest; the least share of those of which
#: something is known that are wrong for standing too near, and how many times the share of all others that is: from
#: there on the map is cut, and what it gives is a bound.
MIN_PLATEAU_RATIO, MIN_CLIPPED_WRONG_RATIO, CLIPPED_RATE_FACTOR = 0.01, 0.1, 2.0


def validate_depth(
    depth_map: Tensor | None,  # (B, h, w) m, 0 or not finite = says nothing; None = the sensor's own
    reference: Frame,
    others: Frame | Sequence[Frame] | None = None,
    *,
    other_maps: Tensor | None = None,  # (V, B, h', w') m
    method: Method = AUTO,
    views: bool = True,
    source_views: int = 2,
    size: int = 320,
    tolerance: float = 0.025,
    seed: int | Tensor = 0,
    fit: PoseFit | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> DepthValidation:
    """Whether a depth map is right, by what the sensor and other views of the same scene say.

    Args:
        depth_map: over the field of the reference view's picture, of any size.
        reference: B views whose near returns fix the metre.
        others: as :class:`dhtorch.pipeline.method.Method` takes them; None = there is no other view, and near returns
            alone speak.
        other_maps: the same source's maps of the other views; of the sensor they are their own depth.
        method: the sparse method that gives answers and motions; it chooses among the views.
        views: ask the pictures of other views as well; False is the fast way, sparse evidence alone.
        source_views: views at most whose pictures are asked, those worth most.
        size: longer side of the grid that is judged, px.
        tolerance: relative error that nobody calls wrong; a third of what must be told is the least that helps.
        seed, fit, hint, trace: as :class:`dhtorch.pipeline.method.Method` takes them.

    Returns:
        Verdict (B, h, w) over the field of the reference view's picture. CONSISTENT only where evidence that would have
        told an error of a fifth tells none; WRONG where some speaks against the depth by three sigmas; where kinds of
        evidence contradict each other, or none speaks, CANNOT_KNOW. Where a map is cut (``clip_depth``: all that is
        farther is said to lie at one depth) the pixels at the cut are WRONG or unknown, since they say no more than
        that the depth is at least that.

    Raises:
        ValueError: wrong shapes, maps that are no real numbers or have fewer than 2×2 pixels, or an option out of
            range.

    Gradient: none; a verdict.
    Cost: that of the method, and with ``views`` eleven fits of every grid pixel for each source view.
    """
    limit = evidence.DETECTABLE_LOG_RATIO / REFUTING_EVIDENCE_SIGMAS
    if not 0 < tolerance < limit:
        raise ValueError(f"validate_depth: tolerance is {tolerance}, expected above 0 and below {limit:.3f}")
    if size < 16 or source_views < 1:
        raise ValueError(f"validate_depth: size is {size}, source views {source_views}, expected at least 16 and 1")
    check("validate_depth", image=(reference.image, "B C H W"), depth_map=(depth_map, "B h w"))
    check("validate_depth", depth=(reference.depth, "B y x"), depth_map=(depth_map, "B h w"))
    check("validate_depth", other_maps=(other_maps, "V B h w"))
    for name, given in (("depth_map", depth_map), ("other_maps", other_maps)):
        _check_metric(name, given)
    trace = {} if trace is None else trace
    with torch.no_grad():
        asked = (
            None if others is None else _estimate_views(method, reference, others, trace, seed=seed, fit=fit, hint=hint)
        )
        offered = trace["choice"].index if "choice" in trace else None
        options: dict[str, Any] = {"views": views, "source_views": source_views, "size": size, "tolerance": tolerance}
        return validate_against(depth_map, reference, asked, offered, other_maps=other_maps, method=method, **options)


@torch.no_grad()
def validate_against(
    depth_map: Tensor | None,  # (B, h, w) m, 0 or not finite = says nothing; None = the sensor's own
    reference: Frame,
    asked: dense.SelectedViews | None,
    offered: Tensor | None = None,  # (views, B) which of those offered were asked; None = all
    *,
    other_maps: Tensor | None = None,  # (V, B, h', w') m
    method: Method = AUTO,
    views: bool = True,
    source_views: int = 2,
    size: int = 320,
    tolerance: float = 0.025,
) -> DepthValidation:
    """The second half of :func:`validate_depth`: what was asked already says of a map; for several maps of one frame.

    Arguments, result, errors and cost as there. Gradient: none.
    """
    hw = dense.map_hw(reference.hw, size)
    # A depth is held against a depth of the same pixel: without a depth camera of its own no lens stands between them.
    straight = (
        reference if reference.depth_camera is not None else reference.replace(camera=cam.ideal(reference.camera))
    )
    returns = method.backproject(straight, dense.map_pixel_centres(reference, hw)).map(lambda x: x.unflatten(1, hw))
    own = depth_map is None
    grid = _usable(returns.depth if depth_map is None else _resized(depth_map.to(reference.camera.f), hw))
    samples = method.sample_depth(reference) if asked is None else asked.samples
    joined = Estimate.silent(samples, Gate.NO_TRACK, n_views=0) if asked is None else asked.joined
    found = evidence.validation_references(samples, joined, near=not own)
    loose = torch.zeros_like(grid) if depth_map is None else evidence.resolution_sigma(depth_map.to(grid), hw)
    found = evidence.inflate_sigma(found, loose, reference.hw)
    allowed = (loose.square() + tolerance**2).sqrt()
    answers = evidence.sparse_evidence(grid, reference.hw, found, allowed, None if own else returns)
    kinds = [answers]
    if asked is not None and views:
        number = offered if offered is not None else torch.arange(len(asked.fits.code))[:, None].expand(-1, len(grid))
        source = None if own else other_maps
        of = _ValidatedMap(grid, reference, asked, number.to(grid.device), own)
        kinds += _view_evidences(of, source, source_views, allowed)
    none = torch.full((len(grid), 3), torch.nan).to(grid)
    scale_vs_trajectory = none if asked is None else _scale_vs_trajectory(reference, asked)
    return _joined(grid, kinds, _of_frame(grid, reference, found, own), scale_vs_trajectory, own)


class _ValidatedMap(NamedTuple):
    """A map on its grid, and the views that may speak of it."""

    grid: Tensor  # (B, h, w) m
    reference: Frame
    asked: dense.SelectedViews
    number: Tensor  # (views, B) of those asked, among those offered
    own: bool  # the sensor's own map


def _estimate_views(
    method: Method, reference: Frame, others: Frame | Sequence[Frame], trace: Trace, **told: Any
) -> dense.SelectedViews:
    """What the method says of the reference view; it chooses where it is offered more than it looks at."""
    others = others if isinstance(others, Frame) else pytree.stack(others)
    several = others.image.dim() == 5
    method = with_view_selection(method) if several and len(others.image) > method.views else method
    joined = method(reference, others, trace=trace, **told)
    return dense.selected_views(joined, others, trace)


def _view_evidences(
    of: _ValidatedMap, other_maps: Tensor | None, source_views: int, tolerance: Tensor
) -> tuple[Evidence, Evidence]:
    """What pictures and maps of the views say that are worth most; a view's number is its place among those offered."""
    grid, asked = of.grid, of.asked
    base = plane_sweep.make_reference_view(*dense.downscale_grey(of.reference, max(grid.shape[-2:])))
    index, wanted = dense.top_views(asked, source_views)
    wanted = asked.fits.ok.gather(0, index) & (wanted | _moved(asked).gather(0, index))
    chosen = [
        dense.source_view_of(asked, k, max(base.hw), use, base.image) for k, use in zip(index, wanted, strict=True)
    ]
    pictures = evidence.photometric_evidence(grid, base, chosen, tolerance)
    batch = torch.arange(len(grid), device=grid.device)
    number = of.number.gather(0, index)
    maps = evidence.no_evidence(grid)
    if of.own or other_maps is not None:
        if of.own:
            depths = [_of_sensor(asked.frames[k, batch], base.hw) for k in index]
        else:
            assert other_maps is not None
            depths = [_surfaces(other_maps.to(grid)[n, batch], base.hw) for n in number]
        maps = evidence.depth_consistency_evidence(grid, base, chosen, [_usable(depth) for depth in depths], tolerance)
    return _numbered(pictures, number), _numbered(maps, number)


def _moved(asked: dense.SelectedViews) -> Tensor:
    """Whether a view stands significantly elsewhere, (V, B)."""
    return asked.fits.t_snr > 5


def _numbered(said: Evidence, number: Tensor) -> Evidence:
    """Views by their place among those offered."""
    batch = torch.arange(number.shape[1], device=number.device)[:, None, None]
    place = number[said.view.clamp_min(0).long(), batch].to(torch.int32)
    return said._replace(view=torch.where(said.view >= 0, place, said.view))


# -------------------------------------------------------------------------------------------------- maps on one grid


def _usable(depth: Tensor) -> Tensor:
    depth = depth.nan_to_num(0.0, 0.0, 0.0)
    return torch.where(depth > 0, depth, 0.0)


def _check_metric(name: str, maps: Tensor | None) -> None:
    """Refuse what is no map of metres."""
    if maps is None:
        return
    if maps.dtype == torch.bool or maps.is_complex():
        raise ValueError(
            f"validate_depth: {name} is of {str(maps.dtype).removeprefix('torch.')}, expected real numbers, m"
        )
    if min(maps.shape[-2:]) < 2:
        raise ValueError(f"validate_depth: {name} has shape {tuple(maps.shape)}, expected at least 2×2 pixels")


def _resized(depth_map: Tensor, hw: tuple[int, int]) -> Tensor:
    rows, columns = (
        evidence.pixel_centres(n, m, depth_map.device).floor().long().clamp_max(n - 1)
        for n, m in zip(depth_map.shape[-2:], hw, strict=True)
    )
    return depth_map[..., rows[:, None], columns]


def _surfaces(depth_map: Tensor, hw: tuple[int, int]) -> Tensor:
    """What a map shows on a grid: where it is coarser, the nearest of its pixels around, since an outline lies anywhere
    between two."""
    if evidence.is_coarser(depth_map, hw):
        known = _usable(depth_map)
        depth_map = torch.where(known > 0, evidence.nearest_surface(known), 0.0)
    return _resized(depth_map, hw)


def _of_sensor(frame: Frame, hw: tuple[int, int]) -> Tensor:
    """A view's own depth at the pixels of a grid over its picture."""
    uv = dense.map_pixel_centres(frame, hw).expand(len(frame.camera.f), -1, -1)
    own = frame.depth.shape[-2], frame.depth.shape[-1]
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, own, uv)
    depth, inside = sample_nearest(frame.depth.to(uv), place)
    return torch.where(inside, depth, 0.0).unflatten(1, hw)


# ------------------------------------------------------------------------------------------------------------ verdicts


def _joined(
    grid: Tensor, kinds: Sequence[Evidence], numbers: FrameNumbers, scale_vs_trajectory: Tensor, own: bool
) -> DepthValidation:
    """What answers say and, where they were asked, pictures and maps of other views."""
    state, said, view = combine_evidence(*kinds)
    clip_depth, at_clip_depth = clipped_depth(grid, state, said)
    state = torch.where(at_clip_depth & (state != State.WRONG), State.CANNOT_KNOW, state).to(torch.int32)
    answers, pictures, maps = list(kinds) + [evidence.no_evidence(grid)] * (3 - len(kinds))
    none = torch.full_like(scale_vs_trajectory, torch.nan)
    n_wrong, n_known = (
        (m.sum((1, 2)) / SHARE_WINDOW_PIXELS) for m in (state == State.WRONG, state != State.CANNOT_KNOW)
    )
    return DepthValidation(
        depth=grid,
        state=state,
        evidence=said,
        view=view,
        sparse_evidence=answers.misfit,
        photometric_evidence=pictures.misfit,
        consistency_evidence=maps.misfit,
        scale=scale_vs_trajectory if own else numbers.scale,
        scale_near=numbers.near,
        scale_far=none if own else numbers.far,
        scale_vs_trajectory=scale_vs_trajectory,
        shift=numbers.shift,
        tilt=numbers.tilt,
        wrong=share_interval(n_wrong.to(grid), n_known.to(grid)),
        clip_depth=clip_depth,
    )


def clipped_depth(grid: Tensor, state: Tensor, said: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (B,) at which a map is cut, NaN where it is not, and the pixels (B, h, w) that stand there.

    A surface that is said to stand exactly as far as the farthest of a map may be a wall in front of the camera: it is
    a cut where evidence tells that much of it stands too near. Windows that straddle its outline show what is before
    it, and answers at the outline lie on a "surface" that the cut has made of two: both speak for pixels that are off.

    Gradient: none.
    """
    farthest = grid.amax((1, 2))
    there = (grid > 0) & (grid >= farthest[:, None, None])
    n = (grid > 0).sum((1, 2)).clamp_min(1)
    near, known = (state == State.WRONG) & (said < 0), state != State.CANNOT_KNOW
    here, elsewhere = (
        (near & m).sum((1, 2)) / (known & m).sum((1, 2)).clamp_min(1) for m in (there, (grid > 0) & ~there)
    )
    ends = (
        (there.sum((1, 2)) >= MIN_PLATEAU_RATIO * n)
        & (here >= MIN_CLIPPED_WRONG_RATIO)
        & (here > CLIPPED_RATE_FACTOR * elsewhere)
    )
    return torch.where(ends, farthest, torch.nan), there & ends[:, None, None]


def combine_evidence(*kinds: Evidence) -> tuple[Tensor, Tensor, Tensor]:
    """State, evidence and view (B, h, w) of what all kinds of evidence say: answers, pictures, maps.

    What speaks against a pixel counts unless another kind, that would have told, speaks for it. Gradient: none.
    """
    against = torch.stack([k.misfit.abs() > REFUTING_EVIDENCE_SIGMAS for k in kinds])
    speaks_for = torch.stack([k.sure & (k.misfit.abs() < SUPPORTING_EVIDENCE_SIGMAS) for k in kinds])
    wrong, fine = against.any(0), speaks_for.any(0)
    state = torch.where(wrong, State.WRONG, torch.where(fine, State.CONSISTENT, State.CANNOT_KNOW))
    state = torch.where(wrong & fine, State.CANNOT_KNOW, state).to(torch.int32)
    misfit = torch.stack([k.misfit for k in kinds])
    size = misfit.abs().nan_to_num(-1.0)
    most = torch.where(against, size, -1.0).argmax(0)
    least = torch.where(speaks_for, size, torch.inf).argmin(0)
    any_said = size.argmax(0)
    pick = torch.where(wrong, most, torch.where(fine, least, any_said))[None]
    view = torch.stack([k.view for k in kinds]).gather(0, pick)[0]
    said = misfit.gather(0, pick)[0]
    return state, said, torch.where(said.isnan(), -2, view).to(torch.int32)


def share_interval(part: Tensor, whole: Tensor) -> Tensor:
    """Share (B, 3) of counts (B,) with its interval of 95 %; NaN of none. Gradient: none.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    n, z = whole.clamp_min(1e-6), 1.96
    p = part / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * (p * (1 - p) / n + z * z / (4 * n * n)).sqrt()
    out = torch.stack([p, (middle - half).clamp_min(0), (middle + half).clamp_max(1)], -1)
    return torch.where((whole > 0)[:, None], out, torch.nan)


class FrameNumbers(NamedTuple):
    """What is said of a frame as a whole, (B, 3) each: value, low, high."""

    scale: Tensor
    near: Tensor
    far: Tensor
    shift: Tensor
    tilt: Tensor


def _of_frame(grid: Tensor, reference: Frame, found: ValidationReferences, own: bool) -> FrameNumbers:
    h, w = grid.shape[-2:]
    at, inside = sample_nearest(grid, cam.resize_pixels(found.uv, reference.hw, (h, w)))
    used = found.used & inside & (at > 0)
    ratio = torch.where(used, at / found.depth, 1.0)
    log = ratio.log()
    own_sigma = (found.sigma.square() - found.shared.square()).clamp_min(1e-6).sqrt()
    kinds = []
    for kind, metre in ((found.near, SENSOR_SCALE_SIGMA), (~found.near, 0.0)):
        common = masked_median(found.shared, used & kind)[:, 0].nan_to_num()
        kinds.append(_location(log, own_sigma, used & kind, (common.square() + metre**2).sqrt()))
    near, far = kinds
    both = _weighed(near, far)
    if own:
        near = both = (torch.full_like(near[0], torch.nan), near[1])
    shift, tilt = _shape(ratio, found, used, own_sigma, reference.hw)
    return FrameNumbers(_as_factor(*both), _as_factor(*near), _as_factor(*far), shift, tilt)


def _location(x: Tensor, sigma: Tensor, used: Tensor, common: Tensor) -> tuple[Tensor, Tensor]:
    """Robust mean (B,) of x (B, N) and its standard deviation, the common part included; NaN of too few."""
    at = masked_median(x, used)
    spread = 1.483 * masked_median((x - at).abs(), used)
    n = used.sum(-1)
    for _ in range(5):
        width = (sigma.square() + spread.square()).sqrt().clamp_min(1e-4)
        t = (x - at) / (3.0 * width)
        weight = torch.where(used & (t.abs() < 1), (1 - t.square()).square() / width.square(), 0.0)
        at = ((weight * x).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-12)).where(
            weight.sum(-1, keepdim=True) > 0, at
        )
    effective = n.clamp(1, MAX_INDEPENDENT_REFERENCES).to(x)
    own = (spread[:, 0].square() + masked_median(sigma, used)[:, 0].square()).sqrt() / effective.sqrt()
    sd = (own.square() * 1.5 + common.square()).sqrt()
    few = n < MIN_SCALE_REFERENCES
    return torch.where(few, torch.nan, at[:, 0]), torch.where(few, torch.inf, sd)


def _weighed(*parts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Mean of what is defined, by inverse variance; the interval widens where the parts contradict each other."""
    value = torch.stack([v for v, _ in parts])
    weight = torch.stack([torch.where(v.isfinite(), 1 / s.square().clamp_min(1e-12), 0.0) for v, s in parts])
    total = weight.sum(0)
    mean = (weight * value.nan_to_num()).sum(0) / total.clamp_min(1e-12)
    chi = (weight * (value.nan_to_num() - mean).square()).sum(0)
    sd = (chi.clamp_min(1.0) / total.clamp_min(1e-12)).sqrt()
    return torch.where(total > 0, mean, torch.nan), sd


def _as_factor(log: Tensor, sd: Tensor) -> Tensor:
    """(B, 3): value and interval of 95 % of a factor whose logarithm is known."""
    return torch.stack([log, log - 1.96 * sd, log + 1.96 * sd], -1).exp().where(log.isfinite()[:, None], torch.nan)


def _shape(
    ratio: Tensor, found: ValidationReferences, used: Tensor, sigma: Tensor, hw: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Shift in m and tilt, (B, 3) each, of map / reference = scale + shift / reference + tilt · place."""
    size = torch.tensor([hw[1], hw[0]]).to(ratio)
    place = (found.uv + 0.5) / size - 0.5
    inverse = torch.where(used, 1 / found.depth, 0.0)
    X = torch.cat([torch.ones_like(inverse)[..., None], inverse[..., None], place], -1).double()
    y = ratio.double()
    at = masked_median(ratio, used).double()
    spread = 1.483 * masked_median((ratio - at.to(ratio)).abs(), used).double()
    width = (sigma.double().square() + spread.square()).sqrt().clamp_min(1e-4)
    residual = y - at
    eye = 1e-9 * torch.eye(4).to(X)
    for _ in range(6):
        t = residual / (3.0 * width)
        weight = torch.where(used & (t.abs() < 1), (1 - t.square()).square() / width.square(), 0.0)
        normal = (X * weight[..., None]).mT @ X + eye
        beta = torch.linalg.solve(normal, ((X * weight[..., None]).mT @ y[..., None]))[..., 0]
        residual = y - (X @ beta[..., None])[..., 0]
    n = used.sum(-1).clamp_min(1)
    inflation = (n / n.clamp_max(MAX_INDEPENDENT_REFERENCES)).double()[:, None, None]
    cov = torch.linalg.inv(normal) * inflation * 1.5
    few = (n < MIN_SHAPE_REFERENCES)[:, None]
    sd = cov.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    shift = torch.stack([beta[:, 1], beta[:, 1] - 1.96 * sd[:, 1], beta[:, 1] + 1.96 * sd[:, 1]], -1)
    gradient = beta[:, 2:]
    size_of = gradient.norm(dim=-1)
    along = gradient / size_of.clamp_min(1e-12)[:, None]
    sd_tilt = ((along[:, None] @ cov[:, 2:, 2:] @ along[..., None])[:, 0, 0]).clamp_min(0).sqrt()
    tilt = torch.stack([size_of, (size_of - 1.96 * sd_tilt).clamp_min(0), size_of + 1.96 * sd_tilt], -1)
    return tuple(torch.where(few, torch.nan, x.to(ratio)) for x in (shift, tilt))  # type: ignore[return-value]


def _scale_vs_trajectory(reference: Frame, asked: dense.SelectedViews) -> Tensor:
    """The sensor's metre over the trajectory's, (B, 3), by the ways between the views; NaN without a trajectory."""
    none = torch.full((len(reference.camera.f), 3), torch.nan).to(reference.camera.f)
    if reference.T_world_from_cam is None or asked.frames.T_world_from_cam is None:
        return none
    V = len(asked.fits.t_snr)
    here = reference.T_world_from_cam.map(lambda x: x.expand(V, *x.shape))
    way = torch.stack([se3.relative(here[k], asked.frames.T_world_from_cam[k]).t.norm(dim=-1) for k in range(V)]).to(
        none
    )
    length = asked.fits.T_1_from_0.t.norm(dim=-1)
    used = asked.fits.ok & (asked.fits.t_snr > 10) & (way > 0.01) & length.isfinite()
    log = torch.where(used, length / way.clamp_min(1e-6), 1.0).clamp_min(1e-6).log().T
    n = used.sum(0)
    at = masked_median(log, used.T)
    spread = 1.483 * masked_median((log - at).abs(), used.T)[:, 0].where(n > 2, 0.0)
    noise = masked_median(1 / asked.fits.t_snr.clamp_min(1).T, used.T)[:, 0].where(n > 0, 1.0)
    sd = (spread.square() + noise.square() + TRAJECTORY_SCALE_SIGMA**2).sqrt()
    return _as_factor(torch.where(n > 0, at[:, 0], torch.nan), sd)
