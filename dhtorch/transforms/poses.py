"""Poses in samples → pose priors: key, direction, axes and unit; warnings for poses that near returns refute.

Alphabet: B samples, T frames of a sample along time.
"""

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
from dhtorch.transforms.sample_access import SampleError, SampleReader, get_value, is_kornia_camera

#: Accepted ``pose_kind``: the mapping that a pose in a sample represents.
POSE_KINDS = ("world_from_cam", "1_from_0")

#: A constant relative pose: 3x4 or 4x4 numbers.
PoseMatrix = Sequence[Sequence[float]]


def check_constant_pose(pose: PoseMatrix, kind: str) -> None:
    """Check a relative pose that is the same for all samples.

    Raises:
        ValueError: no 3x4 or 4x4 finite numbers, or ``kind`` is not ``1_from_0``.
    """
    try:
        shape = np.asarray(pose, dtype=np.float64).shape
        is_valid = shape in ((3, 4), (4, 4)) and bool(np.isfinite(np.asarray(pose, dtype=np.float64)).all())
    except (TypeError, ValueError):
        is_valid = False
    if not is_valid or kind != "1_from_0":
        actual = f"pose_kind {kind}" if is_valid else repr(pose)[:60]
        raise ValueError(
            f"pose: found {actual}, expected a key, or with pose_kind='1_from_0' 3x4 or 4x4 finite numbers"
        )


def parse_pose_sigmas(cov: str | Sequence[float] | None, name: str = "pose_cov") -> tuple[float, float] | None:
    """Option ``pose_cov`` -> standard deviations (rad, m) of a relative pose, None if it is unset or a key.

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
    """Poses in samples -> priors (V, B) of the motions from the reference view to the V source views.

    Args:
        leaves: the samples.
        at: index of the reference view along time, and those of the V source views.
        T: frames along time of the reference view's images and of the source views'.
        checks: failed checks of the poses are appended: mask, value and message.
        keys: key of the pose, or a constant matrix; and key of the source views' pose if it is another.
        cov, kind, axes, unit, refine: see :class:`dhtorch.transforms.SampleSpec`.

    Raises:
        SampleError: a missing key or a wrong shape.

    Gradient: to the poses.
    """
    M, name = conventions.STATED_AXES[axes], keys[0]
    options: dict[str, Any] = {"sigma": parse_pose_sigmas(cov), "refine": refine}
    priors = []
    for place in at[1]:
        if kind == "1_from_0":
            T_1_from_0 = conventions.motion_from_axes(_read_pose(leaves, name, T[1], place, unit, checks), M)
            pose_cov = None if not isinstance(cov, str) else _read_matrix(leaves, cov, T[1], place, ((6,), 6))
            priors.append(pose_prior.make_prior(T_1_from_0, cov=pose_cov, **options))
            continue
        world_0 = conventions.pose_from_axes(_read_pose(leaves, name, T[0], at[0], unit, checks), M)
        world_1 = conventions.pose_from_axes(_read_pose(leaves, keys[1] or name, T[1], place, unit, checks), M)
        pose_cov = None
        if isinstance(cov, str):
            covs = (_read_matrix(leaves, cov, *row, ((6,), 6)) for row in ((T[0], at[0]), (T[1], place)))
            pose_cov = conventions.relative_covariance(world_1, *covs)
        priors.append(pose_prior.relative_prior(world_0, world_1, cov=pose_cov, **options))
    return stack(priors).to(leaves.dtype)


def match_refuted_poses(fits: Sequence[PoseFit], paired: Tensor) -> Tensor:
    """Pose fits -> (B,) int32 index into CONVENTIONS that a refuted pose prior would match; 0 = none.

    Args:
        fits: of the source views; the first that is refuted and matches a convention counts.
        paired: (B,) whether a sample has a source view.
    """
    matched = torch.zeros_like(paired, dtype=torch.int32)
    for fit in fits:
        if fit.matched_convention is not None:
            refuted = paired & (fit.code == PoseCode.REFUTED)
            matched = torch.where(refuted & (matched == 0), fit.matched_convention.to(matched.dtype), matched)
    return matched


def warn_refuted_poses(fits: Sequence[PoseFit], paired: Tensor, matched: Tensor, name: str) -> None:
    """Warn of refuted pose priors, with the conventions that they would match.

    Args:
        fits: of the source views.
        paired: (B,) whether a sample has a source view.
        matched: (B,) from :func:`match_refuted_poses`.
        name: of the pose in the message.
    """
    refuted = paired & torch.stack([fit.code == PoseCode.REFUTED for fit in fits]).any(0) if fits else paired & False
    if bool(refuted.any()):
        conventions_seen = [conventions.CONVENTIONS[i] for i in sorted(set(matched[refuted].tolist())) if i]
        guess = f"; looks like {' or '.join(conventions_seen)}" if conventions_seen else ""
        warnings.warn(f"{name}: the near returns contradict the pose{guess}", stacklevel=5)


def _read_matrix(
    leaves: SampleReader, key: str | PoseMatrix, T: int, at: int, tail: tuple[tuple[int, ...], int]
) -> Tensor:
    """Matrix per sample, per frame, or constant -> (B, rows, columns) float64; ``tail``: accepted rows, and columns."""
    if not isinstance(key, str):
        assert leaves.like is not None
        matrix = torch.as_tensor(np.asarray(key), dtype=torch.float64, device=leaves.like.device)
        return matrix.expand(leaves.like.shape[0], *matrix.shape)
    value = get_value(leaves.sample, key)
    if not is_kornia_camera(value):
        x = leaves.get(key)
    elif not hasattr(value, "extrinsics"):
        raise SampleError(f"{key}: found {type(value).__name__}, expected a pose or a PinholeCamera")
    else:  # its extrinsics map the world into the camera
        x = leaves.per_sample(se3.to_matrix(se3.invert(Pose.from_kornia(value))))
    rows, columns = tail
    shape = tuple(x.shape[1:])
    if x.ndim == 4 and x.shape[1] in (1, T):
        x = x[:, at if x.shape[1] > 1 else 0]
    if x.ndim != 3 or x.shape[1] not in rows or x.shape[2] != columns:
        expected = " or ".join(f"{r}x{columns}" for r in rows)
        raise SampleError(f"{key}: found shape {shape}, expected {expected}, with or without {T} in front")
    return x.double()


def _read_pose(leaves: SampleReader, source: str | PoseMatrix, T: int, at: int, unit: float, checks: list[Any]) -> Pose:
    key = source if isinstance(source, str) else "pose"
    x = _read_matrix(leaves, source, T, at, ((3, 4), 4))
    R = x[:, :3, :3]
    with torch.no_grad():
        is_known = x.isfinite().flatten(1).all(1)  # an unknown pose is no error: its pair stays unanswered
        eye = torch.eye(3, dtype=R.dtype, device=R.device)
        safe = torch.where(is_known[:, None, None], R, eye)
        det = (torch.linalg.cross(safe[:, 0], safe[:, 1]) * safe[:, 2]).sum(-1)
        error = (safe @ safe.mT - eye).abs().flatten(1).amax(1)
        checks.append((det < 0, det, f"{key}: the determinant is {{:.4g}}, a reflection: are the axes left-handed?"))
        checks.append((error > 0.01, det, f"{key}: found no rotation (determinant {{:.4g}}), expected one in 3x3"))
        if x.shape[1] == 4:
            last = (x[:, 3] - torch.tensor([0.0, 0, 0, 1]).to(x)).abs().amax(-1)
            text = f"{key}: the last row is off 0 0 0 1 by {{:.4g}}; is the matrix transposed?"
            checks.append((is_known & ~(last < 1e-6), last, text))
    return Pose(se3.orthonormal(R), x[:, :3, 3] * unit)
