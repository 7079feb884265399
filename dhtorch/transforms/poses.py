"""Poses in samples: which key, which way round, which axes and unit; and what is said of one that is refuted.

Alphabet: B samples, T frames of a sample along time.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import PoseCode
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry import se3
from dhtorch.pytree import stack
from dhtorch.records import Pose, PoseFit, PosePrior
from dhtorch.stages import pose_prior
from dhtorch.transforms.sample_access import SampleError, SampleReader

#: What a pose in a sample maps.
POSE_KINDS = ("world_from_cam", "1_from_0")

#: A motion itself: 3x4 or 4x4 numbers.
PoseMatrix = Sequence[Sequence[float]]

#: How far a stored rotation may be from one.
_MAX_ROTATION_ERROR = 0.01


def pose_label(pose: str | PoseMatrix) -> str:
    """What messages call it."""
    return pose if isinstance(pose, str) else "pose"


def check_constant_pose(pose: PoseMatrix, kind: str) -> None:
    """A motion that is the same for all samples.

    Raises:
        ValueError: no 3x4 or 4x4 finite numbers, or poses in a world.
    """
    try:
        shape = np.asarray(pose, dtype=np.float64).shape
        fine = shape in ((3, 4), (4, 4)) and bool(np.isfinite(np.asarray(pose, dtype=np.float64)).all())
    except (TypeError, ValueError):
        fine = False
    if not fine or kind != "1_from_0":
        found = f"pose_kind {kind}" if fine else repr(pose)[:60]
        raise ValueError(f"pose: found {found}, expected a key, or with pose_kind='1_from_0' 3x4 or 4x4 finite numbers")


def parse_pose_sigmas(cov: str | Sequence[float] | None, name: str = "pose_cov") -> tuple[float, float] | None:
    """The standard deviations (rad, m) of a relative pose that are stated as two numbers; ``name`` of the option.

    Raises:
        ValueError: not two numbers of at least 0.
    """
    if cov is None or isinstance(cov, str):
        return None
    if len(cov) != 2 or not all(0 <= s < float("inf") for s in cov):
        raise ValueError(f"{name} is {cov!r}, expected a key, or two standard deviations of at least 0: rad and m")
    return float(cov[0]), float(cov[1])


def read_pose_priors(
    leaves: SampleReader,
    at: tuple[int, Sequence[int]],
    T: tuple[int, int],
    checks: list[Any],
    *,
    keys: tuple[str | PoseMatrix, str | None],
    cov: str | Sequence[float] | None,
    kind: str,
    axes: str,
    unit: float,
    refine: bool,
) -> PosePrior:
    """The motions (V, B) from the reference view to the other views, as samples state them.

    Args:
        leaves: the samples.
        at: the reference view's place along time, and those of the V other views.
        T: frames along time of the reference view's images and of the others'.
        checks: gets what contradicts that these are poses: mask, value and text.
        keys: of the pose, or the matrix of all; and of the other views' where it is another.
        cov, kind, axes, unit, refine: see :class:`dhtorch.transforms.SampleSpec`.

    Raises:
        SampleError: a missing key or a wrong shape.

    Gradient: to the poses.
    """
    M, name = conventions.STATED_AXES[axes], keys[0]
    options: dict[str, Any] = {"sigma": parse_pose_sigmas(cov), "refine": refine}
    found = []
    for place in at[1]:
        if kind == "1_from_0":
            T_1_from_0 = conventions.motion_from_axes(_read_pose(leaves, name, T[1], place, unit, checks), M)
            known = None if not isinstance(cov, str) else _read_covariance(leaves, cov, T[1], place)
            found.append(pose_prior.make_prior(T_1_from_0, cov=known, **options))
            continue
        world_0 = conventions.pose_from_axes(_read_pose(leaves, name, T[0], at[0], unit, checks), M)
        world_1 = conventions.pose_from_axes(_read_pose(leaves, keys[1] or name, T[1], place, unit, checks), M)
        known = None
        if isinstance(cov, str):
            both = _read_covariance(leaves, cov, T[0], at[0]), _read_covariance(leaves, cov, T[1], place)
            known = conventions.relative_covariance(world_1, *both)
        found.append(pose_prior.relative_prior(world_0, world_1, cov=known, **options))
    return stack(found).to(leaves.dtype)


def match_refuted_poses(fits: Sequence[PoseFit], paired: Tensor) -> Tensor:
    """(B,) int32: which of CONVENTIONS a given pose would fit that the near returns refute; 0 = none.

    Args:
        fits: of the source views; the first that is refuted and fits a convention counts.
        paired: (B,) whether a sample has another view.
    """
    matched = torch.zeros_like(paired, dtype=torch.int32)
    for fit in fits:
        if fit.matched_convention is not None:
            here = paired & (fit.code == PoseCode.REFUTED)
            matched = torch.where(here & (matched == 0), fit.matched_convention.to(matched.dtype), matched)
    return matched


def warn_refuted_poses(fits: Sequence[PoseFit], paired: Tensor, matched: Tensor, name: str) -> None:
    """Warn where a given pose is refuted, with the conventions that it would fit.

    Args:
        fits: of the source views.
        paired: (B,) whether a sample has another view.
        matched: (B,) of :func:`match_refuted_poses`.
        name: of the pose.
    """
    refuted = torch.zeros_like(paired)
    for fit in fits:
        refuted = refuted | (paired & (fit.code == PoseCode.REFUTED))
    if bool(refuted.any()):
        seen = [conventions.CONVENTIONS[i] for i in sorted(set(matched[refuted].tolist())) if i]
        like = f"; looks like {' or '.join(seen)}" if seen else ""
        warnings.warn(f"{name}: the near returns contradict the pose{like}", stacklevel=4)


def _read_matrix(
    leaves: SampleReader, key: str | PoseMatrix, T: int, at: int, tail: tuple[tuple[int, ...], int]
) -> Tensor:
    """(B, rows, columns) in float64 of one matrix per sample, or one per frame; or of one for all."""
    if not isinstance(key, str):
        assert leaves.like is not None
        one = torch.as_tensor(np.asarray(key), dtype=torch.float64, device=leaves.like.device)
        return one.expand(leaves.like.shape[0], *one.shape)
    x = leaves.get(key)
    rows, columns = tail
    shape = tuple(x.shape[1:])
    if x.ndim == 4 and x.shape[1] in (1, T):
        x = x[:, at if x.shape[1] > 1 else 0]
    if x.ndim != 3 or x.shape[1] not in rows or x.shape[2] != columns:
        wanted = " or ".join(f"{r}x{columns}" for r in rows)
        raise SampleError(f"{key}: found shape {shape}, expected {wanted}, with or without {T} in front")
    return x.double()


def _read_covariance(leaves: SampleReader, key: str, T: int, at: int) -> Tensor:
    return _read_matrix(leaves, key, T, at, ((6,), 6))


def _read_pose(leaves: SampleReader, source: str | PoseMatrix, T: int, at: int, unit: float, checks: list[Any]) -> Pose:
    key = pose_label(source)
    x = _read_matrix(leaves, source, T, at, ((3, 4), 4))
    R = x[:, :3, :3]
    with torch.no_grad():
        known = x.isfinite().flatten(1).all(1)  # a pose that is not known is no mistake: its pair is not answered
        eye = torch.eye(3, dtype=R.dtype, device=R.device)
        safe = torch.where(known[:, None, None], R, eye)
        det = (torch.linalg.cross(safe[:, 0], safe[:, 1]) * safe[:, 2]).sum(-1)
        off = (safe @ safe.mT - eye).abs().flatten(1).amax(1)
        checks.append((det < 0, det, f"{key}: the determinant is {{:.4g}}, a reflection: are the axes left-handed?"))
        checks.append(
            (off > _MAX_ROTATION_ERROR, det, f"{key}: found no rotation (determinant {{:.4g}}), expected one in 3x3")
        )
        if x.shape[1] == 4:
            last = (x[:, 3] - torch.tensor([0.0, 0, 0, 1]).to(x)).abs().amax(-1)
            text = f"{key}: the last row is off 0 0 0 1 by {{:.4g}}; is the matrix transposed?"
            checks.append((known & ~(last < 1e-6), last, text))
    return Pose(se3.orthonormal(R), x[:, :3, 3] * unit)
