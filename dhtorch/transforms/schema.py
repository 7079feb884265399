"""The columns that :class:`dhtorch.transforms.ExtendDepth` adds to a sample, in one table.

A column is one row of :data:`COLUMNS` with its function. The keys of a sample, the blank values of an unreadable
sample, the Parquet columns of ``dhtorch extract``, the features of ``dhtorch enrich`` and the table of keys in
the documentation are derived from it.

Alphabet: B samples; of each N points, P patches of its token grid, H × W pixels of its dense map.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter as _of
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Cause, CodeTable, Flag, Gate, Hole, PoseCode, Source, code
from dhtorch.records import DepthMap, Estimate, MergedDepth, PoseFit, Samples
from dhtorch.transforms.poses import match_refuted_poses
from dhtorch.transforms.tokens import TOKEN_CHANNELS


class SampleProblem(CodeTable):
    """Codes of ``problem``: the worst problem of a sample."""

    NONE: Final = code(0, "none")
    NO_SECOND_VIEW: Final = code(1, "front end only: one frame, or the source view only pads the episode")
    NO_DEPTH: Final = code(2, "the sensor has no return at all")
    UNREADABLE: Final = code(3, "left out; all added numbers are 0")


@dataclass(frozen=True, eq=False)
class SampleResults:
    """Results of the method for B samples: the input of every column's function."""

    samples: Samples  # the front end, in the reference view
    merged: MergedDepth  # sensor and recovered depth
    xyz: Tensor  # (B, N, 3) m in camera 0, of the merged depth; any value without a depth
    estimate: Estimate | None  # None = no sample has a source view
    fits: Sequence[PoseFit]  # of the source views, the overall one last; empty without a source view
    paired: Tensor  # (B,) bool: the sample has a source view
    tokens: tuple[Tensor, Tensor]  # (B, P, channels) and (B, P) bool, of patch_tokens
    dense: DepthMap | None  # None = dense maps were not requested
    problem: Tensor  # (B,) int32, codes.SampleProblem


class ColumnSpec(NamedTuple):
    """One column."""

    key: str  # without the prefix
    shape: tuple[str | int, ...]  # of one sample: letters of the alphabet, or numbers
    dtype: str  # bool, int32, or float32 = the floating dtype of the sample's camera
    unit: str
    meaning: str
    compute: Callable[[SampleResults], Tensor]  # results of B samples -> (B, *shape)
    codes: type | None = None  # code table of its values
    option: str | None = None  # of ExtendDepth that adds the column; None = always present
    half: bool = False  # float16 is exact enough to store it
    enrich: str | None = None  # file type of a map, or "numbers", in an enriched data set; None = not in it
    unreadable: int = 0  # value in an unreadable sample


# ------------------------------------------------------------------------------------------------ one function each


def _xyz(results: SampleResults) -> Tensor:
    return torch.where(_valid(results)[..., None], results.xyz, 0.0)


def _valid(results: SampleResults) -> Tensor:
    return results.merged.source != Source.NONE


def _gate(results: SampleResults) -> Tensor:
    if results.estimate is None:
        return torch.full_like(results.samples.hole, Gate.NO_TRACK)
    return results.estimate.gate


def _T_1_from_0(results: SampleResults) -> Tensor:
    if not results.fits:
        return results.merged.depth.new_zeros(len(results.paired), 4, 4)
    T = results.fits[-1].T_1_from_0
    top = torch.cat((T.R, T.t[..., None]), -1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=top.dtype, device=top.device).expand(len(top), 1, 4)
    return torch.where(_pose_ok(results)[:, None, None], torch.cat((top, last), 1), 0.0)


def _pose_cov(results: SampleResults) -> Tensor:
    if not results.fits:
        return results.merged.depth.new_zeros(len(results.paired), 6, 6)
    return torch.where(_pose_ok(results)[:, None, None], results.fits[-1].cov, 0.0)


def _pose_ok(results: SampleResults) -> Tensor:
    return results.fits[-1].ok & results.paired if results.fits else torch.zeros_like(results.paired)


def _pose_code(results: SampleResults) -> Tensor:
    if not results.fits:
        return torch.zeros_like(results.paired, dtype=torch.int32)
    last = results.fits[-1].code
    return torch.where(results.paired, last, torch.zeros_like(last))


def _answered(results: SampleResults, name: str) -> Tensor:
    """Values (B, h, w) of a map, 0 where it has no depth."""
    assert results.dense is not None  # only columns of the option "dense" use it
    return torch.where(results.dense.keep, getattr(results.dense, name), 0.0)


# ------------------------------------------------------------------------------------------------------- the table

_N, _P, _MAP, _F = ("N",), ("P",), ("H", "W"), "float32"
_ZERO = "0 = none, where a DepthMap has NaN"

COLUMNS: tuple[ColumnSpec, ...] = (
    ColumnSpec(
        "uv",
        ("N", 2),
        _F,
        "px",
        "where the samples are: x right, y down, whole numbers are pixel centres",
        _of("merged.uv"),
    ),
    ColumnSpec(
        "xyz", ("N", 3), _F, "m", "points in the camera of the frame: x right, y down, z forward", _xyz, half=True
    ),
    ColumnSpec(
        "depth",
        _N,
        _F,
        "m",
        "z of the points, by sensor or triangulation; 0 = none",
        _of("merged.depth"),
        half=True,
    ),
    ColumnSpec("sigma", _N, _F, "m", "standard deviation of depth; 0 = none", _of("merged.sigma"), half=True),
    ColumnSpec(
        "score",
        _N,
        _F,
        "1",
        "confidence of the sensor, or score of the recovered depth, in [0, 1]",
        _of("merged.score"),
        half=True,
    ),
    ColumnSpec("valid", _N, "bool", "1", "there is a depth", _valid),
    ColumnSpec("source", _N, "int32", "code", "where the depth comes from", _of("merged.source"), codes=Source),
    ColumnSpec("flag", _N, "int32", "bits", "what is wrong with the sensor's return", _of("samples.flag"), codes=Flag),
    ColumnSpec("hole", _N, "int32", "code", "why the sensor gave no usable return", _of("samples.hole"), codes=Hole),
    ColumnSpec("gate", _N, "int32", "code", "why no depth was recovered", _gate, codes=Gate),
    ColumnSpec(
        "T_1_from_0",
        (4, 4),
        _F,
        "1, m",
        "pose of the other view: its points from those of the frame; 0 = none",
        _T_1_from_0,
    ),
    ColumnSpec(
        "pose_cov",
        (6, 6),
        _F,
        "rad², rad m, m²",
        "covariance of that pose, rotation first, left perturbation",
        _pose_cov,
    ),
    ColumnSpec("pose_ok", (), "bool", "1", "there is a pose", _pose_ok),
    ColumnSpec("pose_code", (), "int32", "code", "how the search for the pose ended", _pose_code, codes=PoseCode),
    ColumnSpec(
        "tokens",
        ("P", len(TOKEN_CHANNELS)),
        _F,
        "1/m, 1/m, share",
        "depth tokens of the patches, row by row",
        lambda results: results.tokens[0],
        half=True,
    ),
    ColumnSpec("tokens_valid", _P, "bool", "1", "a sample of the patch has a depth", lambda results: results.tokens[1]),
    ColumnSpec(
        "pose_convention",
        (),
        "int32",
        "index",
        "which of geometry.pose_conventions.CONVENTIONS a given pose would fit that the near returns refute; 0 = none",
        lambda results: match_refuted_poses(results.fits, results.paired),
        option="pose",
    ),
    ColumnSpec(
        "depth_map",
        _MAP,
        _F,
        "m",
        f"z of every pixel, by sensor or sweep; {_ZERO}",
        lambda results: _answered(results, "depth"),
        option="dense",
        half=True,
        enrich="tiff",
    ),
    ColumnSpec(
        "sigma_map",
        _MAP,
        _F,
        "m",
        f"standard deviation of depth_map; {_ZERO}",
        lambda results: _answered(results, "sigma"),
        option="dense",
        half=True,
        enrich="tiff",
    ),
    ColumnSpec(
        "score_map",
        _MAP,
        _F,
        "1",
        "confidence of the sensor, or score of the swept depth, in [0, 1]",
        _of("dense.score"),
        option="dense",
        half=True,
    ),
    ColumnSpec(
        "source_map",
        _MAP,
        "int32",
        "code",
        "where the depth of a pixel comes from",
        _of("dense.source"),
        codes=Source,
        option="dense",
        enrich="png",
    ),
    ColumnSpec(
        "cause_map",
        _MAP,
        "int32",
        "code",
        "largest cause of a pixel's sigma",
        _of("dense.budget.dominating"),
        codes=Cause,
        option="budget",
        enrich="png",
    ),
    ColumnSpec(
        "gate_map",
        _MAP,
        "int32",
        "code",
        "why a pixel has no depth",
        _of("dense.gate"),
        codes=Gate,
        option="dense",
    ),
    ColumnSpec(
        "problem",
        (),
        "int32",
        "code",
        "what was wrong with the frame",
        _of("problem"),
        codes=SampleProblem,
        unreadable=SampleProblem.UNREADABLE,
    ),
)


def columns_of_options(options: Collection[str]) -> list[ColumnSpec]:
    """Active options of ExtendDepth (``pose``, ``dense``) -> columns, in order."""
    return [column for column in COLUMNS if column.option is None or column.option in options]


def blank_columns(sizes: Mapping[str, int], options: Collection[str]) -> dict[str, Tensor]:
    """Sizes and options -> key → values (1, …) of an unreadable sample; ``sizes``: letter of the alphabet → number."""
    return {
        c.key: torch.full((1, *resolve_shape(c.shape, sizes)), c.unreadable, dtype=getattr(torch, c.dtype))
        for c in columns_of_options(options)
    }


def resolve_shape(shape: Sequence[str | int], sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Shape with letters -> shape in numbers; ``sizes``: letter of the alphabet → number."""
    return tuple(sizes[size] if isinstance(size, str) else size for size in shape)
