"""The paper's stages, one file each, in the order of the method. No stage imports another."""

from dhtorch.stages import (
    backproject,
    fuse,
    holes,
    misalignment,
    pose,
    pose_prior,
    sample,
    score,
    track,
    track_chain,
    triangulate,
)

__all__ = [
    "backproject",
    "fuse",
    "holes",
    "misalignment",
    "pose",
    "pose_prior",
    "sample",
    "score",
    "track",
    "track_chain",
    "triangulate",
]
