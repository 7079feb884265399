"""Tree of coordinate frames of a robot's recording: fixed transforms, and poses along a moving chain."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from dhtorch.data import convert
from dhtorch.data.clocks import interpolate_poses

_MAX_DEPTH: Final = 64  # frames of a chain; a longer one is a circle
_MAX_TRANSFORMS: Final = 500_000  # kept in memory; about two hours of a robot of 7 joints at 10 Hz
#: Roots that stand still by their convention (REP 105).
WORLD_FRAMES: Final = ("map", "odom", "world", "earth")


class Transform(NamedTuple):
    """Pose of a child frame in its parent's."""

    stamp_ns: int
    parent: str
    child: str
    t: Sequence[float]  # m
    q: Sequence[float]  # x y z w


@dataclass
class TransformTree:
    """Transforms by child frame; each child has one parent."""

    entries: dict[str, list[Transform]] = field(default_factory=dict)
    count: int = 0

    def add(self, transforms: Sequence[Transform]) -> None:
        """Add transforms; beyond ``_MAX_TRANSFORMS`` none are kept and :attr:`is_whole` is false."""
        for transform in transforms:
            if self.count < _MAX_TRANSFORMS:
                child = transform.child.lstrip("/")
                self.entries.setdefault(child, []).append(transform._replace(parent=transform.parent.lstrip("/")))
            self.count += 1

    @property
    def is_whole(self) -> bool:
        """Whether all transforms were kept."""
        return self.count <= _MAX_TRANSFORMS

    def fixed_transform(self, target: str, source: str) -> np.ndarray | None:
        """T_target_from_source (4, 4) along fixed transforms; None where none joins the two."""
        to_root = [self._fixed_ancestors(name.lstrip("/")) for name in (target, source)]
        common = next((name for name in to_root[0] if name in to_root[1]), None)
        if common is None:
            return None
        return np.linalg.inv(to_root[0][common]) @ to_root[1][common]

    def poses(self, frame: str, times_ns: np.ndarray, file: Path) -> tuple[np.ndarray, np.ndarray, str] | None:
        """Poses (n, 4, 4) of a frame in the root of its chain, the mask (n,) of times with a pose, and the root's name.

        None where no transform of the chain moves, or a frame has several parents.
        """
        name = frame.lstrip("/")
        c2w = np.tile(np.eye(4), (len(times_ns), 1, 1))
        covered = np.ones(len(times_ns), bool)
        moves = False
        for _ in range(_MAX_DEPTH):
            entries = self.entries.get(name)
            if not entries:
                return (c2w, covered, name) if moves else None
            if len({entry.parent for entry in entries}) > 1:
                return None
            if (fixed := self._fixed(name, file)) is not None:
                c2w = fixed @ c2w
            else:
                T, has_pose = _interpolate(entries, times_ns, file)
                c2w, covered, moves = T @ c2w, covered & has_pose, True
            name = entries[0].parent
        return None

    def _fixed_ancestors(self, name: str) -> dict[str, np.ndarray]:
        """Ancestor → T_ancestor_from_name, along fixed transforms."""
        T = np.eye(4)
        ancestors = {name: T}
        for _ in range(_MAX_DEPTH):
            fixed = self._fixed(name, Path(name))
            if fixed is None:
                break
            name = self.entries[name][0].parent
            T = fixed @ T
            ancestors.setdefault(name, T)
        return ancestors

    def _fixed(self, child: str, file: Path) -> np.ndarray | None:
        """T_parent_from_child of a transform that never changes; None where there is none or it does."""
        entries = self.entries.get(child)
        if not entries or len({entry.parent for entry in entries}) > 1:
            return None
        values = np.array([(*entry.t, *entry.q) for entry in entries])
        # Largest difference of a repeated transform that is taken as fixed.
        if not np.abs(values - values[0]).max() <= 1e-9:
            return None
        fixed: np.ndarray = convert.to_c2w(values[:1, 3:], values[:1, :3], file, f"transform of {child}")[0]
        return fixed


def _interpolate(entries: list[Transform], times_ns: np.ndarray, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Transforms (n, 4, 4) at the times, and the mask (n,) of times with one."""
    stamps, first = np.unique([entry.stamp_ns for entry in entries], return_index=True)
    values = np.array([(*entries[i].t, *entries[i].q) for i in first])
    origin = stamps[0]
    q = values[:, 3:] / np.maximum(np.linalg.norm(values[:, 3:], axis=-1, keepdims=True), 1e-12)
    # Across gaps of more than half a second tracking was lost; equal stamps may differ by the rounding of seconds since
    # 1970 in double precision.
    q, t, covered = interpolate_poses(
        (times_ns - origin) / 1e9,
        (stamps - origin) / 1e9,
        q,
        values[:, :3],
        same=1e-6,
        max_difference=0.05,
        max_gap=0.5,
    )
    q = np.where(covered[:, None], q, [0.0, 0, 0, 1])
    return convert.to_c2w(q, t, file, f"transform of {entries[0].child}"), covered
