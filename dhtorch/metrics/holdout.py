"""Hold-out splits: far returns are hidden from the method, and the reliable ones among them are the ground truth.

Most apparent error at a depth edge is wrong truth: a patch locks onto the foreground side, and a depth map that is not
registered to the pixel shows the background. A held-back return therefore counts only where the map around it is
smooth, and every rejected return is counted under the rule that rejected it.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from dhtorch.codes import Flag, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import extract_patches, round_half_up, sample_nearest
from dhtorch.pytree import Record, record
from dhtorch.records import MIN_TRACKABILITY, Frame, Samples

#: Side of the close window of a sparse map, px.
SPARSE_CLOSE_WINDOW_PX = 7


class TruthCode:
    """Codes of ``Truth.code``: why a sample is not compared with a held-back return; the first reason applies."""

    CANDIDATE = 0  #: evaluated
    NO_RETURN = 1  #: no return to compare with
    NEAR = 2  #: the return was not held back
    CLOSE = 3  #: a step, or a dense map's missing pixel, right beside it
    WIDE = 4  #: a step within the reach of a track's patch
    EXCLUDED = 5  #: excluded by the caller (a mirror, a window)
    TEXTURE = 6  #: not trackable by any method
    REAL_HOLE = 7  #: the sensor has no return there: nothing was held back


@record
class Truth(Record):
    """True depth of each sample, or the reason why the sample is not evaluated."""

    depth: Tensor  # (B, N) m; 0 = no return
    code: Tensor  # (B, N) int32, TruthCode

    @property
    def ok(self) -> Tensor:
        """(B, N) bool: the sample is a candidate."""
        return self.code == TruthCode.CANDIDATE

    def dropped(self) -> dict[str, int]:
        """Number of held-back returns rejected by each rule: the metric ``n_dropped``."""
        rules = {"close": TruthCode.CLOSE, "wide": TruthCode.WIDE}
        rules |= {"excluded": TruthCode.EXCLUDED, "texture": TruthCode.TEXTURE}
        return {name: int((self.code == code).sum()) for name, code in rules.items()}

    @property
    def n_real_holes(self) -> int:
        """Number of samples with truth at which the sensor has no return: they are in no range-split cohort."""
        return int((self.code == TruthCode.REAL_HOLE).sum())


def truth_kept_ratio(n_candidates: int, n_dropped: Mapping[str, int]) -> float | None:
    """Fraction of the held-back returns that pass the truth test, from ``n_candidates`` and ``n_dropped`` of a row.

    Excluded and textureless samples have passed it. None without a held-back return.
    """
    n_rejected = n_dropped["close"] + n_dropped["wide"]
    n = n_candidates + sum(n_dropped.values())
    return 1 - n_rejected / n if n else None


def range_split(frame: Frame, cutoff: float | None) -> Frame:
    """The frame without its returns beyond ``cutoff`` (m, z-depth): the input of the method.

    The truth is the depth of the original frame. None or infinity removes nothing.

    Raises:
        ValueError: the cutoff is not a positive number.

    Gradient: to the depth that remains.
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
    min_trackability: float = MIN_TRACKABILITY,
) -> tuple[Tensor, Tensor]:
    """Sets A and B, (B, N) bool each: the trackable samples with a usable return, split at random.

    A is for the pose, B for the comparison with the estimates; no sample is in both. The split depends only on the seed
    and the sample's index: not on batch mates, device or method.

    Args:
        samples: of whole frames, classified.
        seed: of the split.
        share: expected fraction of the samples in A.
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
    """The samples without the returns of the ``hidden`` (B, N) ones, as if the sensor had none there.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the returns that remain.
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
    """The return at every sample as true depth, and whether the depth around it is smooth enough to be reliable.

    Dense map: the return of the nearest pixel; the 5×5 pixels around it must all have one and spread by less than
    5 % (CLOSE), and those that have one in the wide window by less than 15 % (WIDE). Where the map is marked as sparse
    (projected LiDAR): the nearest return within 7×7 pixels, spread there less than 5 %, within 15×15 less
    than 15 %.

    Args:
        frame: the views with their full depth, before the hold-out. For truth from elsewhere replace ``depth`` (and
            ``depth_camera``, where the map has intrinsics of its own).
        uv: sample pixels.
        truth: ``full`` applies both tests, ``5x5`` only the close one, ``raw`` none.
        window: side of a dense map's wide window, px of the image: the LK window and two pixels around it.

    Returns:
        Truth with code CANDIDATE, NO_RETURN, CLOSE or WIDE. Windows are stated in pixels of the image; in a map of
        another width they shrink or grow with it, to an odd side of at least 3. A dense window that reaches over the
        edge of the map lacks returns there. Non-finite and non-positive depth counts as no return.

    Raises:
        ValueError: wrong shapes, or another value of ``truth``.

    Gradient: ``depth`` to the depth map; the choice of the pixel and codes carry none.
    Cost: reads window² depth pixels per sample, whatever the image size.
    """
    sizes = check("sample_truth", image=(frame.image, "B C H W"), depth=(frame.depth, "B h w"), uv=(uv, "B N 2"))
    if truth not in ("raw", "5x5", "full"):
        raise ValueError(f"holdout.truth: found {truth!r}, expected one of raw, 5x5, full")
    scale = sizes["w"] / sizes["W"]
    pixel = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (sizes["h"], sizes["w"]), uv)
    dense = _test_truth(frame.depth, pixel, truth, scale, window)
    if frame.sparse is None:
        return Truth(*dense)
    sparse = _test_truth(frame.depth, pixel, truth, scale, None)
    depth, code = (torch.where(frame.sparse[:, None], a, b) for a, b in zip(sparse, dense, strict=True))
    return Truth(depth, code)


def _test_truth(depth: Tensor, place: Tensor, truth: str, scale: float, window: int | None) -> tuple[Tensor, Tensor]:
    """The return (B, N) and its code at pixels ``place`` of maps (B, h, w); ``window`` None: the maps are sparse."""
    # Odd sides, at least 3, of windows stated in image pixels, in a map ``scale`` times as wide as the image
    sizes = (SPARSE_CLOSE_WINDOW_PX, 15) if window is None else (5, window)
    sides = [max(3, 2 * int(size * scale / 2) + 1) for size in sizes]
    close, u, v = _window_returns(depth, place, sides[0])
    if window is None:
        du, dv = u - place[..., 0, None].detach(), v - place[..., 1, None].detach()
        distance = ((du * du)[..., None, :] + (dv * dv)[..., :, None]).flatten(-2)
        returns = close.flatten(-2)
        far = torch.where(returns > 0, distance, torch.full_like(distance, torch.inf))
        returned = returns.gather(-1, far.argmin(-1, keepdim=True))[..., 0]
    else:
        returned = _nearest_pixel(depth, place)
    fails_close, fails_wide = torch.zeros_like(returned, dtype=torch.bool), torch.zeros_like(returned, dtype=torch.bool)
    if truth != "raw":
        fails_close = _is_spread(close, 0.05)
        if window is not None:
            fails_close = fails_close | (close <= 0).flatten(-2).any(-1)
    if truth == "full":
        fails_wide = _is_spread(_window_returns(depth, place, sides[1])[0], 0.15)
    code = first_reason(
        (returned <= 0, TruthCode.NO_RETURN), (fails_close, TruthCode.CLOSE), (fails_wide, TruthCode.WIDE)
    )
    return returned, code


def select_candidates(
    samples: Samples,
    truth: Truth,
    cutoff: float | None,
    *,
    excluded: Tensor | None = None,  # (B, N) bool
    min_texture: float = 0.2,
) -> Truth:
    """The samples on which every method is evaluated: those with a reliable held-back return and texture.

    Independent of the method, so a pair whose pose fails keeps its candidates.

    Args:
        samples: of the frame, with trackability.
        truth: from :func:`sample_truth`, at the same samples.
        cutoff: m; a return beyond it was held back. None: none was, and nothing is a candidate.
        excluded: samples to be counted separately, under EXCLUDED.
        min_texture: least trackability, as a fraction of the median over the frame's samples.

    Returns:
        Truth whose code is CANDIDATE or the reason.

    Raises:
        ValueError: wrong shapes.
    """
    check(
        "candidates", trackability=(samples.trackability, "B N"), depth=(truth.depth, "B N"), excluded=(excluded, "B N")
    )
    near = truth.depth <= (math.inf if cutoff is None else cutoff)
    textureless = samples.trackability < min_texture * _median(samples.trackability)
    code = first_reason(
        (truth.code == TruthCode.NO_RETURN, TruthCode.NO_RETURN),
        (near, TruthCode.NEAR),
        (truth.code == TruthCode.CLOSE, TruthCode.CLOSE),
        (truth.code == TruthCode.WIDE, TruthCode.WIDE),
        (torch.zeros_like(near) if excluded is None else excluded, TruthCode.EXCLUDED),
        (textureless, TruthCode.TEXTURE),
    )
    return truth.replace(code=code)


def require_masked(truth: Truth, frame: Frame, uv: Tensor, cutoff: float) -> Truth:
    """Candidates of the range split → those at which ``cutoff`` masked a return of the sensor, and only a far one.

    Truth of another instrument has depth also where the sensor has no return (a real hole), and in a sparse map a near
    return may remain within the reach of the sample whose nearest return was masked.

    Args:
        truth: from :func:`select_candidates`, at the samples.
        frame: the views with the sensor's full depth.
        uv: (B, N, 2) px, the samples.
        cutoff: m, of :func:`range_split`.

    Returns:
        Truth whose codes of held-back returns became REAL_HOLE where the sensor has no return, and NEAR where the
        masked map still has one. EXCLUDED samples, which are evaluated separately, keep their code.

    Raises:
        ValueError: wrong shapes.
    """
    check("require_masked", depth=(truth.depth, "B N"), uv=(uv, "B N 2"))
    full, masked = (sample_truth(view, uv, truth="raw").depth for view in (frame, range_split(frame, cutoff)))
    fixed = (TruthCode.NO_RETURN, TruthCode.NEAR, TruthCode.EXCLUDED)
    counted = ~torch.isin(truth.code, torch.tensor(fixed, dtype=truth.code.dtype, device=truth.code.device))
    code = torch.where(counted & (full <= 0), TruthCode.REAL_HOLE, truth.code)
    return truth.replace(code=torch.where(counted & (masked > 0), TruthCode.NEAR, code).to(truth.code.dtype))


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
    """The sensor's real holes at which an independent instrument has reliable depth.

    A sample is a candidate if the sensor map has no return at the nearest pixel, the independent truth exists and
    passed its test, and the sensor's returns around the hole agree with that truth, so that the two are registered and
    the hole is not the shadow of a nearer edge.

    Args:
        frame: the views with the sensor's full depth.
        samples: of these frames.
        truth: the independent depth at the samples, from :func:`sample_truth`.
        window: side of the window of neighbours in the sensor map, px of that map.
        min_returns: fewest returns in it.
        agreement: relative difference allowed between their median and the truth.
        min_texture: least trackability, as a fraction of the median over the frame's samples.

    Returns:
        Truth whose code is CANDIDATE or the reason: NO_RETURN (no independent depth), NEAR (the sensor has a return
        there), CLOSE, WIDE, EXCLUDED (neighbours missing or contradicting), TEXTURE.

    Raises:
        ValueError: wrong shapes.

    Source: paper, "Real holes are harder than masked ones"; its filter is not published, this one is stated above.
    """
    sizes = check(
        "select_real_holes", depth=(frame.depth, "B h w"), uv=(samples.uv, "B N 2"), truth=(truth.depth, "B N")
    )
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (sizes["h"], sizes["w"]), samples.uv)
    has_return = _nearest_pixel(frame.depth, place) > 0
    around = _window_returns(frame.depth, place, window)[0].flatten(-2)
    count = (around > 0).sum(-1)
    ordered = torch.where(around > 0, around, torch.full_like(around, torch.inf)).sort(-1).values
    median = ordered.gather(-1, ((count - 1).clamp_min(0) // 2)[..., None])[..., 0]
    agrees = (count >= min_returns) & ((median - truth.depth).abs() <= agreement * truth.depth)
    textureless = samples.trackability < min_texture * _median(samples.trackability)
    code = first_reason(
        (truth.code == TruthCode.NO_RETURN, TruthCode.NO_RETURN),
        (has_return, TruthCode.NEAR),
        (truth.code == TruthCode.CLOSE, TruthCode.CLOSE),
        (truth.code == TruthCode.WIDE, TruthCode.WIDE),
        (~agrees, TruthCode.EXCLUDED),
        (textureless, TruthCode.TEXTURE),
    )
    return truth.replace(code=code)


def _window_returns(depth: Tensor, place: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns (B, N, size, size) around depth pixels ``place`` (B, N, 2), 0 = none, and the u and v (B, N, size) of
    the window's columns and rows.

    Pixels outside the map have no return.
    """
    h, w = depth.shape[-2:]
    size = min(size, h, w)
    centre = round_half_up(place.nan_to_num(-1e6)).clamp(-1e6, 1e6)
    corner = centre.long() - size // 2
    value = extract_patches(depth[:, None], corner, size)[:, :, 0]  # clamped to the map at its edge
    steps = torch.arange(size, device=depth.device)
    u = corner[..., 0, None].clamp(0, w - size) + steps
    v = corner[..., 1, None].clamp(0, h - size) + steps
    valid_u = (u - centre[..., 0, None]).abs() <= size // 2
    valid_v = (v - centre[..., 1, None]).abs() <= size // 2
    valid = valid_u[..., None, :] & valid_v[..., :, None] & value.isfinite() & (value > 0)
    return torch.where(valid, value, torch.zeros_like(value)), u, v


def _nearest_pixel(depth: Tensor, place: Tensor) -> Tensor:
    value, inside = sample_nearest(depth, place)
    return torch.where(inside & value.isfinite() & (value > 0), value, torch.zeros_like(value))


def _is_spread(window: Tensor, limit: float) -> Tensor:
    """Whether the returns of a window (B, N, s, s) spread by ``limit`` or more; False without returns."""
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
