"""The range split: far returns are kept from the method, and those that can be trusted are what it is held against.

Most of what looks like error at a depth edge is wrong truth: a patch locks onto the foreground side, and a depth map
that is not registered to the pixel shows the background. So a held-back return counts only where the map around it is
smooth, and every return that is turned away is counted under the rule that did it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.codes import Flag, first_reason, names
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import extract_patches, round_half_up, sample_nearest
from dhtorch.pytree import Record, record
from dhtorch.records import Frame, Samples

#: How much of the truth test is asked, from nothing to everything.
_TRUTH_TESTS = ("raw", "5x5", "full")

#: Side of the close window of a dense map, px; sparse returns: side of the close and of the wide one.
_CLOSE_WINDOW_PX, SPARSE_CLOSE_WINDOW_PX, _SPARSE_WIDE_WINDOW_PX = 5, 7, 15

#: Spread (max / min − 1) of the returns from which the close and the wide window fail.
_MAX_CLOSE_SPREAD, _MAX_WIDE_SPREAD = 0.05, 0.15


class TruthCode:
    """Codes of ``Truth.code``: why a sample is not held against a held-back return; the first reason wins."""

    CANDIDATE = 0  #: counts
    NO_RETURN = 1  #: nothing to hold it against
    NEAR = 2  #: the return was not held back
    CLOSE = 3  #: a step, or a dense map's missing pixel, right beside it
    WIDE = 4  #: a step within the reach of a track's patch
    EXCLUDED = 5  #: turned away by the caller (a mirror, a window)
    TEXTURE = 6  #: not trackable by any method


@record
class Truth(Record):
    """What each sample is held against, or why it is not."""

    depth: Tensor  # (B, N) m; 0 = no return
    code: Tensor  # (B, N) int32, Rule

    @property
    def ok(self) -> Tensor:
        """(B, N) bool: the sample counts."""
        return self.code == TruthCode.CANDIDATE

    def dropped(self) -> dict[str, int]:
        """Held-back returns that do not count, by rule: the metric ``n_dropped``."""
        rules = {code: name for code, name in names(TruthCode).items() if code > TruthCode.NEAR}
        return {name.lower(): int((self.code == code).sum()) for code, name in rules.items()}


def range_split(frame: Frame, cutoff: float | None) -> Frame:
    """The frame without its returns beyond ``cutoff`` (m, z-depth): what the method may see.

    The truth is the depth of the frame that went in. None or infinity takes nothing away.

    Raises:
        ValueError: the cutoff is not a positive number.

    Gradient: to the depth that stays.
    """
    if cutoff is None:
        return frame
    if math.isnan(cutoff) or cutoff <= 0:
        raise ValueError(f"holdout.cutoff: found {cutoff}, expected a positive number of metres, or null for none")
    return frame.replace(depth=torch.where(frame.depth > cutoff, torch.zeros_like(frame.depth), frame.depth))


def split_half(
    samples: Samples,
    seed: int,
    *,
    share: float = 0.5,
    min_trackability: float = 1e-5,
) -> tuple[Tensor, Tensor]:
    """Sets A and B, (B, N) bool each: the trackable samples with a usable return, split at random.

    A may fix the pose, B is what answers are held against; no sample is in both. The split depends on the seed and
    the sample's place alone: not on batch mates, device or method.

    Args:
        samples: of whole frames, classified.
        seed: of the split.
        share: of the samples that A receives, in expectation.
        min_trackability: samples below it are in neither set.

    Raises:
        ValueError: wrong shapes, or a share outside (0, 1).

    Source: paper, "Held-out triangulation on in-house captures".
    """
    sizes = check("split_half", xyz=(samples.xyz, "B N 3"), trackability=(samples.trackability, "B N"))
    if not 0 < share < 1:
        raise ValueError(f"holdout.share: found {share}, expected a number between 0 and 1")
    draw = torch.rand(sizes["N"], generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    first = (draw < share).to(samples.xyz.device)
    usable = samples.usable & (samples.trackability >= min_trackability)
    return usable & first, usable & ~first


def hide_returns(samples: Samples, hidden: Tensor) -> Samples:
    """The samples as if the sensor had been silent at the ``hidden`` (B, N) ones: no stage can see those returns.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the returns that stay.
    """
    check("hide_returns", xyz=(samples.xyz, "B N 3"), hidden=(hidden, "B N"))
    zero = torch.zeros_like(samples.depth)
    return samples.replace(
        depth=torch.where(hidden, zero, samples.depth),
        sigma=torch.where(hidden, zero, samples.sigma),
        xyz=torch.where(hidden[..., None], torch.full_like(samples.xyz, torch.nan), samples.xyz),
        confidence=torch.where(hidden, torch.zeros_like(samples.confidence), samples.confidence),
        flag=torch.where(hidden, samples.flag | Flag.NO_DEPTH, samples.flag),
    )


def sample_truth(
    frame: Frame,
    uv: Tensor,  # (B, N, 2) px
    *,
    truth: str = "full",
    window: int = 25,
) -> Truth:
    """The return at every sample, and whether the depth around it is smooth enough to be held against an answer.

    Dense map: the return of the nearest pixel; the 5×5 pixels around it must all have one and spread by less than
    5 % (CLOSE), and those that have one in the wide window by less than 15 % (WIDE). Where the frame says that its map
    is sparse (projected LiDAR): the nearest return within 7×7 pixels, spread there less than 5 %, within 15×15 less
    than 15 %.

    Args:
        frame: the views with their full depth, before the hold-out. For truth from elsewhere replace ``depth`` (and
            ``depth_camera``, where the map has intrinsics of its own).
        uv: sample pixels.
        truth: ``full`` asks both tests, ``5x5`` the close one only, ``raw`` none.
        window: side of a dense map's wide window, px of the image: the LK window and two pixels around it.

    Returns:
        Truth with code CANDIDATE, NO_RETURN, CLOSE or WIDE. Windows are stated in pixels of the image; in a map of
        another width they shrink or grow with it, to an odd side of at least 3. A dense window that reaches over the
        edge of the map lacks returns there. Non-finite and non-positive depth counts as no return.

    Raises:
        ValueError: wrong shapes, or another word for ``truth``.

    Gradient: ``depth`` to the depth map; the choice of the pixel and codes carry none.
    Cost: reads window² depth pixels per sample, whatever the image size.
    """
    sizes = check("sample_truth", image=(frame.image, "B C H W"), depth=(frame.depth, "B h w"), uv=(uv, "B N 2"))
    if truth not in _TRUTH_TESTS:
        raise ValueError(f"holdout.truth: found {truth!r}, expected one of {', '.join(_TRUTH_TESTS)}")
    scale = sizes["w"] / sizes["W"]
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (sizes["h"], sizes["w"]), uv)
    dense = _test_truth(frame.depth, place, truth, scale, window)
    if frame.sparse is None:
        return Truth(*dense)
    sparse = _test_truth(frame.depth, place, truth, scale, None)
    depth, code = (torch.where(frame.sparse[:, None], a, b) for a, b in zip(sparse, dense, strict=True))
    return Truth(depth, code)


def _test_truth(depth: Tensor, place: Tensor, truth: str, scale: float, window: int | None) -> tuple[Tensor, Tensor]:
    """The return (B, N) of each place in maps (B, h, w), and its code; ``window`` None: the maps are sparse."""
    close, u, v = _window_returns(
        depth, place, _window_side(SPARSE_CLOSE_WINDOW_PX if window is None else _CLOSE_WINDOW_PX, scale)
    )
    found = _nearest_return(close, u, v, place) if window is None else _nearest_pixel(depth, place)
    fails_close, fails_wide = torch.zeros_like(found, dtype=torch.bool), torch.zeros_like(found, dtype=torch.bool)
    if truth != "raw":
        fails_close = _is_spread(close, _MAX_CLOSE_SPREAD)
        if window is not None:
            fails_close = fails_close | (close <= 0).flatten(-2).any(-1)
    if truth == "full":
        wide, _, _ = _window_returns(
            depth, place, _window_side(_SPARSE_WIDE_WINDOW_PX if window is None else window, scale)
        )
        fails_wide = _is_spread(wide, _MAX_WIDE_SPREAD)
    code = first_reason((found <= 0, TruthCode.NO_RETURN), (fails_close, TruthCode.CLOSE), (fails_wide, TruthCode.WIDE))
    return found, code


def select_candidates(
    samples: Samples,
    truth: Truth,
    cutoff: float | None,
    *,
    excluded: Tensor | None = None,  # (B, N) bool
    min_texture: float = 0.2,
) -> Truth:
    """The samples that every method is counted on: a held-back return that can be trusted, and texture.

    Known before any method runs, so a pair whose pose fails keeps its candidates.

    Args:
        samples: of the frame, with trackability.
        truth: from :func:`sample_truth`, at the same samples.
        cutoff: m; a return beyond it was held back. None: none was, and nothing is a candidate.
        excluded: samples to be counted apart, under EXCLUDED.
        min_texture: trackability asked, as a share of the median over the frame's samples.

    Returns:
        Truth whose code is CANDIDATE, or why not.

    Raises:
        ValueError: wrong shapes.
    """
    check(
        "candidates", trackability=(samples.trackability, "B N"), depth=(truth.depth, "B N"), excluded=(excluded, "B N")
    )
    near = truth.depth <= (math.inf if cutoff is None else cutoff)
    plain = samples.trackability < min_texture * _median(samples.trackability)
    code = first_reason(
        (truth.code == TruthCode.NO_RETURN, TruthCode.NO_RETURN),
        (near, TruthCode.NEAR),
        (truth.code == TruthCode.CLOSE, TruthCode.CLOSE),
        (truth.code == TruthCode.WIDE, TruthCode.WIDE),
        (torch.zeros_like(near) if excluded is None else excluded, TruthCode.EXCLUDED),
        (plain, TruthCode.TEXTURE),
    )
    return truth.replace(code=code)


def select_real_holes(
    frame: Frame,
    samples: Samples,
    truth: Truth,
    *,
    window: int = 7,
    min_returns: int = 3,
    agreement: float = 0.1,
    min_texture: float = 0.2,
) -> Truth:
    """The sensor's own holes whose depth another instrument knows for sure: the cohort of real holes.

    A sample is one where the sensor map has no return at the nearest pixel, the independent truth is there and passed
    its test, and the sensor's returns right around the hole agree with that truth, so that the two are registered and
    the hole is not the shadow of a nearer edge.

    Args:
        frame: the views with the sensor's full depth.
        samples: of these frames.
        truth: the independent depth at the samples, from :func:`sample_truth`.
        window: side of the window in the sensor map that is asked for neighbours, px of that map.
        min_returns: fewest returns in it.
        agreement: relative difference allowed between their median and the truth.
        min_texture: trackability asked, as a share of the median over the frame's samples.

    Returns:
        Truth whose code is CANDIDATE, or why not: NO_RETURN (no independent depth), NEAR (the sensor answered there),
        CLOSE, WIDE, EXCLUDED (neighbours missing or contradicting), TEXTURE.

    Raises:
        ValueError: wrong shapes.

    Source: paper, "Real holes are harder than masked ones"; its filter is not published, this one is stated above.
    """
    sizes = check(
        "select_real_holes", depth=(frame.depth, "B h w"), uv=(samples.uv, "B N 2"), truth=(truth.depth, "B N")
    )
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (sizes["h"], sizes["w"]), samples.uv)
    answered = _nearest_pixel(frame.depth, place) > 0
    around = _window_returns(frame.depth, place, window)[0].flatten(-2)
    count = (around > 0).sum(-1)
    ordered = torch.where(around > 0, around, torch.full_like(around, torch.inf)).sort(-1).values
    middle = ordered.gather(-1, ((count - 1).clamp_min(0) // 2)[..., None])[..., 0]
    agrees = (count >= min_returns) & ((middle - truth.depth).abs() <= agreement * truth.depth)
    plain = samples.trackability < min_texture * _median(samples.trackability)
    code = first_reason(
        (truth.code == TruthCode.NO_RETURN, TruthCode.NO_RETURN),
        (answered, TruthCode.NEAR),
        (truth.code == TruthCode.CLOSE, TruthCode.CLOSE),
        (truth.code == TruthCode.WIDE, TruthCode.WIDE),
        (~agrees, TruthCode.EXCLUDED),
        (plain, TruthCode.TEXTURE),
    )
    return truth.replace(code=code)


def _window_side(size: int, scale: float) -> int:
    """Odd side, at least 3, of a window of ``size`` image pixels in a map ``scale`` times as wide as the image."""
    return max(3, 2 * int(size * scale / 2) + 1)


def _window_returns(depth: Tensor, place: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns (B, N, size, size) around depth pixels ``place`` (B, N, 2), 0 = none, and the u and v (B, N, size) of
    the window's columns and rows.

    Pixels that do not exist are no returns.
    """
    h, w = depth.shape[-2:]
    size = min(size, h, w)
    centre = round_half_up(place.nan_to_num(-1e6)).clamp(-1e6, 1e6)
    corner = centre.long() - size // 2
    value = extract_patches(depth[:, None], corner, size)[:, :, 0]  # moved inside at the edge of the map
    steps = torch.arange(size, device=depth.device)
    u = corner[..., 0, None].clamp(0, w - size) + steps
    v = corner[..., 1, None].clamp(0, h - size) + steps
    wanted_u = (u - centre[..., 0, None]).abs() <= size // 2
    wanted_v = (v - centre[..., 1, None]).abs() <= size // 2
    wanted = wanted_u[..., None, :] & wanted_v[..., :, None] & value.isfinite() & (value > 0)
    return torch.where(wanted, value, torch.zeros_like(value)), u, v


def _nearest_pixel(depth: Tensor, place: Tensor) -> Tensor:
    value, inside = sample_nearest(depth, place)
    return torch.where(inside & value.isfinite() & (value > 0), value, torch.zeros_like(value))


def _nearest_return(window: Tensor, u: Tensor, v: Tensor, place: Tensor) -> Tensor:
    """The return (B, N) of a window that lies nearest to ``place``, 0 where there is none."""
    du, dv = u - place[..., 0, None].detach(), v - place[..., 1, None].detach()
    distance = ((du * du)[..., None, :] + (dv * dv)[..., :, None]).flatten(-2)
    returns = window.flatten(-2)
    far = torch.where(returns > 0, distance, torch.full_like(distance, torch.inf))
    return returns.gather(-1, far.argmin(-1, keepdim=True))[..., 0]


def _is_spread(window: Tensor, limit: float) -> Tensor:
    """Whether the returns of a window (B, N, s, s) spread by ``limit`` or more; no return does not."""
    high = window.amax((-2, -1))
    low = torch.where(window > 0, window, torch.full_like(window, torch.inf)).amin((-2, -1))
    return (high > 0) & (high >= low * (1 + limit))


def _median(x: Tensor) -> Tensor:
    """Median (B, 1) over the samples, the mean of the middle two where their number is even; 0 of none."""
    n = x.shape[-1]
    if n == 0:
        return x.new_zeros((*x.shape[:-1], 1))
    ordered = x.detach().sort(-1).values
    return (ordered[..., (n - 1) // 2] + ordered[..., n // 2])[..., None] / 2
