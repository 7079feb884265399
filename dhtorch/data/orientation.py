"""Orientation of pictures and depth maps: what files state, sizes and coinciding edges → one orientation for both.

A *symmetry* ``k`` in 0…7 is one of the eight of a rectangle: mirrored left to right if k ≥ 4, then turned by k mod 4
quarter turns clockwise. ``SYMMETRY_NAMES`` has their names.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.data.convert import rot90_camera, rot90_image
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import SAME_ORIENTATION, StoredSizes, describe_mismatch
from dhtorch.geometry import filters
from dhtorch.geometry.no_depth import clear_no_depth
from dhtorch.records import Frame
from dhtorch.runtime.safe_open import FormatError, restrict_links

#: What is done to a stored map, by symmetry.
SYMMETRY_NAMES: Final = (
    "as stored",
    "turned by 90 degrees",
    "turned by 180 degrees",
    "turned by 270 degrees",
    "mirrored left to right",
    "mirrored and turned by 90 degrees",
    "mirrored upside down",
    "mirrored and turned by 270 degrees",
)

#: Value of option ``depth_turn`` → symmetry of the stored depth; degrees are counter-clockwise.
DEPTH_TURNS: Final = {"90": 3, "180": 2, "270": 1, "left_right": 4, "upside_down": 6}

#: Longer side of the grid on which edges are compared, px; limits the sharpness of edges, about that of LiDAR maps.
#: Source: chosen on the captures of tests/data/test_orientation.py (80 and 320 were no better).
_GRID_PX = 160
#: Standard deviation of the blur before the gradients, px of the grid: tolerance of colour beside depth.
#: Source: chosen on the same captures; between 0.7 and 2.5 the share of right answers varies by 3 %.
_BLUR_PX = 1.0
#: Edge strength up to which a pixel counts, in mean strengths: one silhouette must not decide alone.
#: Source: as :data:`_BLUR_PX`.
_MAX_EDGE_STRENGTH = 3.0
#: Least lead of the best symmetry's mean score over the second one's for a decision.
#: Source: chosen on the same captures: no wrong decision on three or more of their frames.
MIN_ORIENTATION_LEAD = 0.04


def apply_symmetry(x: Tensor, k: int) -> Tensor:
    """Map or picture (…, h, w) under symmetry ``k`` → (…, h, w) or (…, w, h)."""
    return rot90_image(x.flip(-1) if k >= 4 else x, k % 4)


def orientation_scores(
    image: Tensor,  # (C, H, W), C 1 or 3; float in [0, 1] or uint8
    depth: Tensor,  # (h, w) m, 0 = no return; any size
    symmetries: Sequence[int] = range(8),
) -> Tensor:
    """Agreement (8,) in [−1, 1] of the picture's edges with the edges of the depth map under each of the symmetries.

    Both are resampled to one grid over the whole field of view. An edge is a vector (strength, strength · cos 2a,
    strength · sin 2a) with the direction a of its gradient; the score is the correlation coefficient of these vectors
    over pixels with returns. A map of another aspect ratio is stretched. One frame decides rarely against the truth
    (8 of 93), several nearly never: average the scores of a few frames.
    """
    picture = picture_edges(image, grid_px=_GRID_PX)
    hw = picture.shape[-2], picture.shape[-1]
    smooth = smooth_log_depth(depth, hw), smooth_log_depth(depth, (hw[1], hw[0]))
    scores = []
    for k in symmetries:
        log_depth, covered = (apply_symmetry(x, k) for x in smooth[k % 2])
        scores.append(edge_correlation(picture, *log_depth_edges(log_depth, covered)))
    return torch.tensor(scores, dtype=torch.float64)


def picture_edges(image: Tensor, *, grid_px: int) -> Tensor:
    """Edge vectors (3, h, w) of a picture (C, H, W) on a grid whose longer side is ``grid_px``."""
    grey = image.float().mean(0) * (1.0 if image.dtype == torch.uint8 else 255.0)
    scale = grid_px / max(grey.shape)
    hw = max(2, round(grey.shape[0] * scale)), max(2, round(grey.shape[1] * scale))
    # Grey value, of 255, added before the logarithm: noise of dark pixels makes no edges.
    return _edge_vectors(_blur((_resample(grey, hw) + 16.0).log()), torch.ones(hw, dtype=torch.bool))


def depth_edges(depth: Tensor, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Edge vectors (3, h, w) of a depth map resampled to a grid, and the mask (h, w) where it has returns."""
    return log_depth_edges(*smooth_log_depth(depth, hw))


def smooth_log_depth(depth: Tensor, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Logarithm (h, w) of the mean inverse depth of the returns near each grid pixel, and the mask of covered ones."""
    has_return = depth > 0
    inverse = torch.where(has_return, 1 / torch.where(has_return, depth, 1.0), 0.0)
    total, coverage = _blur(_resample(inverse, hw)), _blur(_resample(has_return, hw))
    # Fraction of a grid pixel's neighbourhood that must have returns.
    covered = coverage > 0.5
    return torch.where(covered, total / coverage.clamp_min(1e-6), 1.0).clamp_min(1e-9).log(), covered


def log_depth_edges(log_depth: Tensor, covered: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithm (h, w) of depth and its mask -> edge vectors (3, h, w), and the mask without pixels beside a gap."""
    inner = -F.max_pool2d(-covered.float()[None], 3, 1, 1)[0] > 0  # gradients do not touch gaps
    return _edge_vectors(log_depth, inner), inner


def select_symmetry(
    frames: Iterable[tuple[Tensor, Tensor]],  # image and depth of a few frames, as orientation_scores
    candidates: Sequence[int] = range(8),
) -> tuple[int | None, Tensor]:
    """(symmetry of the depth that the edges support clearly best, None = undecided; mean scores (8,) of the frames)."""
    scores = torch.stack([orientation_scores(image, depth) for image, depth in frames]).mean(0)
    first, second = sorted(candidates, key=lambda k: -float(scores[k]))[:2]
    return (first if scores[first] - scores[second] >= MIN_ORIENTATION_LEAD else None), scores


def orient_recording(recording: Recording, turn: int | None = None) -> Recording:
    """The recording with pictures and depth in one orientation, that of its K and poses.

    ``recording.stored`` has the sizes and what the files state. Sizes decide where they can; else the edges of a few
    frames do (:func:`select_symmetry`). If K lies as depth does, the picture is turned, else depth is: K and poses
    never change. Nothing is decoded where sizes agree and no file states a turn.

    Args:
        recording: as its reader reads it.
        turn: symmetry of the depth by an option, instead of a decision.

    Raises:
        FormatError: the orientations contradict each other, or cannot be decided.
    """
    stored = recording.stored
    if turn is None and (stored is None or (stored.display == 0 and _is_alike(stored, 0))):
        return recording
    if stored is None:
        frame = _load(recording, 0)
        stored = StoredSizes(frame.hw, (frame.depth.shape[-2], frame.depth.shape[-1]))
    if turn is not None:
        k, remark = turn, ""
    elif stored.depth_hw is None:
        k, remark = -1, ""  # no depth: K decides
    else:
        k, remark = _decide_symmetry(recording, stored)
    by_display = k == _inverse(stored.display) and stored.display != 0
    turn_picture = _lies_turned(recording, stored, k, by_display)
    if k < 0:
        picture, depth = (stored.display if turn_picture else 0), 0
        done = (
            f"pictures are {SYMMETRY_NAMES[picture]}, as K lies"
            if picture
            else "pictures are read as stored, as K lies"
        )
        remark = f"orientation: {stored.source}: {done}"
    else:
        picture, depth = (_inverse(k), 0) if turn_picture else (0, k)
        what, applied = ("pictures are", picture) if turn_picture else ("depth is", depth)
        remark = remark.replace("{done}", f"{what} {SYMMETRY_NAMES[applied]}")
    load = recording.load if picture == depth == 0 else _Turned(recording.load, picture, depth)
    return replace(recording, load=load, stored=None, report=recording.report + ((remark,) if remark else ()))


@dataclass(frozen=True)
class _Turned:
    """Position → frame with picture and depth (and confidence) under a symmetry each; K is that of the result."""

    load: Callable[[int], Frame]
    picture: int
    depth: int

    def __call__(self, i: int) -> Frame:
        frame = self.load(i)
        depth_camera = frame.depth_camera
        if depth_camera is not None and self.depth < 4:
            depth_camera = rot90_camera(depth_camera, (frame.depth.shape[-2], frame.depth.shape[-1]), self.depth)
        return frame.replace(
            depth_camera=depth_camera,
            image=apply_symmetry(frame.image, self.picture).contiguous(),
            depth=apply_symmetry(frame.depth, self.depth),
            conf=None if frame.conf is None else apply_symmetry(frame.conf, self.depth),
        )


def _decide_symmetry(recording: Recording, stored: StoredSizes) -> tuple[int, str]:
    """(symmetry that takes stored depth to the stored picture, remark with the place of what is done)."""
    upright = _inverse(stored.display)
    possible = [k for k in dict.fromkeys((0, upright)) if _is_alike(stored, k)]
    if possible == [0]:
        return 0, f"orientation: {stored.source}: pictures are read as stored, as depth lies"
    if not possible:
        k = _select(recording, range(1, 8, 2))
        if k is None:
            mismatch = describe_mismatch(stored.depth_hw or stored.hw, stored.hw)
            raise FormatError(
                recording.root or recording.name,
                "orientation",
                f"{mismatch}, and their edges do not show how it is turned",
                f"{SAME_ORIENTATION}, or data.depth_turn=90 or 270",
            )
        stating = f", against {stored.source}" if stored.display else ""
        mismatch = describe_mismatch(stored.depth_hw or stored.hw, stored.hw)
        return k, f"orientation: {mismatch}: {{done}}, as their edges coincide{stating}"
    if len(possible) == 1:
        k = _select(recording, range(1, 8, 2))
        if k not in (None, upright):
            contradiction = (
                f"{stored.source}, but edges of depth and pictures coincide where depth is {SYMMETRY_NAMES[k]}"
            )
            expected = "pictures that state how depth lies (data.depth_turn overrides)"
            raise FormatError(recording.root or recording.name, "orientation", contradiction, expected)
        return upright, f"orientation: {stored.source}: {{done}}, as depth lies"
    k = _select(recording, possible)
    if k is None:
        return 0, f"orientation: {stored.source} may apply to depth or not: pictures are read as stored, unchecked"
    if k == 0:
        return 0, f"orientation: {stored.source}: pictures are read as stored, as edges of depth lie"
    return k, f"orientation: {stored.source}: {{done}}, as edges of depth lie"


def _select(recording: Recording, candidates: Sequence[int]) -> int | None:
    """The candidate that the edges of a few frames support; None = undecided."""
    # Frames of a recording that are decoded for a decision by edges. Source: chosen on the captures of
    # tests/data/test_orientation.py, where three to five frames decide 422 of 499 times.
    places = sorted(set(torch.linspace(0, len(recording) - 1, 5).round().int().tolist()))
    frames = []
    for place in places:
        try:
            frame = _load(recording, place)
        except FormatError:
            continue
        frames.append((frame.image[0], clear_no_depth(frame.depth)[0]))
    return select_symmetry(frames, candidates)[0] if frames else None


def _load(recording: Recording, place: int) -> Frame:
    with restrict_links(recording.bounds):
        return recording.load(place)


def _lies_turned(recording: Recording, stored: StoredSizes, k: int, by_display: bool) -> bool:
    """Whether K lies as stored depth does, or as the displayed picture does if there is none, not as the stored one."""
    if k == 0:
        return False
    if (k if k >= 0 else stored.display) % 2 == 0:
        return by_display  # a half turn or a mirror shows hardly in K: whoever turned depth turned K
    (x, y), (h, w) = _load(recording, 0).camera.c[0].tolist(), stored.hw
    misfit, turned_misfit = (max(abs(x - (b - 1) / 2) / b, abs(y - (a - 1) / 2) / a) for a, b in ((h, w), (w, h)))
    # Difference of the offsets of K's principal point from the centres of the stored and the turned picture, in image
    # sizes, below which K does not show how it lies. Source: derived: offsets of real cameras are within 0.05.
    if abs(misfit - turned_misfit) < 0.05:
        return by_display
    return turned_misfit < misfit


def _is_alike(stored: StoredSizes, k: int) -> bool:
    """Whether depth under a symmetry lies as the stored picture does."""
    if stored.depth_hw is None:
        return True
    h, w = stored.depth_hw
    return describe_mismatch((w, h) if k % 2 else (h, w), stored.hw) is None


def _inverse(k: int) -> int:
    """The symmetry that undoes symmetry ``k``."""
    return k if k >= 4 else -k % 4


def _resample(x: Tensor, hw: tuple[int, int]) -> Tensor:
    """Map (h, w) averaged or interpolated to the size ``hw``."""
    return F.interpolate(x.float()[None, None], hw, mode="bilinear", antialias=True)[0, 0]


def _blur(x: Tensor) -> Tensor:
    return filters.gaussian_blur(x[None, None], _BLUR_PX)[0, 0]


def _edge_vectors(x: Tensor, mask: Tensor) -> Tensor:
    """(3, h, w) capped strength of the gradient times (1, cos 2a, sin 2a); 0 outside the mask."""
    gy, gx = torch.gradient(x)
    strength = torch.where(mask, torch.hypot(gx, gy), 0.0)
    mean = strength[mask].mean() if bool(mask.any()) else torch.zeros(())
    square = (gx * gx + gy * gy).clamp_min(1e-18)
    direction = torch.stack((torch.ones_like(gx), (gx * gx - gy * gy) / square, 2 * gx * gy / square))
    return strength.clamp_max(_MAX_EDGE_STRENGTH * mean) * direction


def edge_correlations(a: Tensor, b: Tensor, masks: Tensor) -> Tensor:
    """Vector fields (n, 3, h, w) and (m, 3, h, w) → correlation coefficients (n, m), float64, of each with each.

    Each is taken over the mask (m, h, w) of the second field; 0 where one of them is constant. All are products of
    matrices. Gradient: none.
    """
    weight = masks.to(a.dtype).flatten(1)
    count = weight.sum(1).double().clamp_min(1)
    a, b = a.flatten(2), b.flatten(2) * weight[:, None]
    sum_a, sum_b = torch.einsum("ncp,mp->nmc", a, weight).double(), b.sum(2).double()
    square_a, square_b = (a.square().sum(1) @ weight.T).double(), b.square().sum((1, 2)).double()
    return correlation_of_sums(count, sum_a, sum_b, square_a, square_b, (a.flatten(1) @ b.flatten(1).T).double())


def correlation_of_sums(
    count: Tensor, sum_a: Tensor, sum_b: Tensor, square_a: Tensor, square_b: Tensor, product: Tensor
) -> Tensor:
    """Sums over ``count`` places of two vector fields (..., 3), of squares and products (...) -> correlation (...).

    0 where one of the fields is constant. Gradient: none.
    """
    square_a = square_a - sum_a.square().sum(-1) / count
    square_b = square_b - sum_b.square().sum(-1) / count
    product = product - (sum_a * sum_b).sum(-1) / count
    return product / (square_a * square_b).clamp_min(0).sqrt().clamp_min(1e-12)


def edge_correlation(a: Tensor, b: Tensor, mask: Tensor) -> float:
    """Correlation coefficient of two vector fields (3, h, w) over a mask; 0 where one of them is constant."""
    return float(edge_correlations(a[None], b[None], mask[None]))
