"""Sensitivity of the results to tuning constants: each at half and at twice its value on the shared scenes.

    python benchmarks/sensitivity.py --json benchmarks/results/sensitivity.json      all constants
    python benchmarks/sensitivity.py --only fuse                                     those whose name contains the text

For each constant: coverage (answered fraction of the candidates) and median relative error at half and at twice the
value, and their differences to the value as it is. One reference view of each scene of ``data=shared_scenes`` with a
baseline; numbers are medians over scenes. Four measurements: ``sparse`` and ``dense`` extend a frame whose returns
beyond the scene's cutoff are hidden, which are then the truth; ``align`` aligns that frame's own depth map, distorted
as a depth network distorts it; ``validate`` validates the same map scaled by 1.1, coverage being the fraction of pixels
with a state and the error the fraction of these called consistent.

Rows that the JSON file already has are kept, so that an interrupted run continues.

A constant whose change moves neither number by more than ``--epsilon`` is marked: a candidate for removal.
"""

import argparse
import dataclasses
import json
import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from torch import Tensor

import dhtorch
from dhtorch import data
from dhtorch.alignment import AlignmentOptions
from dhtorch.codes import State
from dhtorch.data.pairs import candidate_frames
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline import dense
from dhtorch.pipeline.dense_options import DenseOptions
from dhtorch.pipeline.method import Method
from dhtorch.pytree import stack
from dhtorch.records import Frame
from dhtorch.synthetic.depth_faults import apply_fault
from dhtorch.validation import ValidationOptions

CONF = Path(__file__).resolve().parents[1] / "conf"

#: Options of the stages of ``auto``: stage → options.
STAGES: dict[str, tuple[str, ...]] = {
    "backproject": ("edge_rel", "highlight", "dark"),
    "track": ("window", "max_shift_px", "iterations"),
    "pose": ("far_weight", "max_rise", "isotropic", "shutter_sigma", "shutter_gain", "translation_gain", "bend"),
    "triangulate": (
        *("max_residual_px", "max_sigma_rel", "min_t_snr", "max_mismatch_px", "max_far_noise", "max_in_reach"),
        *("mismatch_px", "residual_px", "round_trip_px"),
    ),
    "fuse": ("max_chi2", "max_conflict_ratio", "sure_rel", "sure_rel_each", "max_sigma_rel", "max_static_ratio"),
    "select_views": ("good_sigma_rel",),
}

#: Fields of the options records that are varied; integers of a size or a count stay as they are.
RECORDS: dict[str, type] = {"dense": DenseOptions, "align": AlignmentOptions, "validate": ValidationOptions}

#: Most constants of one record, in the order of its fields.
MAX_PER_RECORD = 12


class Case(NamedTuple):
    """A reference view with its source views and what is hidden from the method."""

    scene: str
    near: Frame  # returns beyond the cutoff hidden
    whole: Frame
    others: Frame  # (V, 1)
    hint: dhtorch.TrackHint


class Constant(NamedTuple):
    """A number that is varied, and the measurement as a function of it."""

    name: str
    value: float
    measure: Callable[[Case, float], tuple[float, float]]  # -> coverage, median error


def settings(name: str) -> dict[str, Any]:
    """A file of ``conf/``."""
    return dict(yaml.safe_load((CONF / f"{name}.yaml").read_text(encoding="utf-8")))


def cases() -> Iterator[Case]:
    """One reference view of each shared scene with a baseline."""
    root = Path(os.environ["DHTORCH_DATA"])
    notes = settings("data/shared_scenes")["scenes"]
    for scene in data.open_scenes(root=root, scenes=notes):
        if scene.role is not None:
            continue
        recording = scene.recording
        i = len(recording) // 2
        whole = recording[i]
        others = stack([recording[k] for k in candidate_frames(recording, i)])
        yield Case(scene.name, holdout.range_split(whole, scene.near), whole, others, scene.hint)


def evaluate(case: Case, depth: Tensor, uv: Tensor, keep: Tensor, sigma: Tensor) -> tuple[float, float]:
    """Coverage and median relative error of depths (1, N) at pixels (1, N, 2) on the hidden returns."""
    samples = dhtorch.AUTO.sample_depth_at(case.whole, uv)
    near = dhtorch.AUTO.sample_depth_at(case.near, uv)
    truth = holdout.select_candidates(samples, holdout.sample_truth(case.whole, uv), 0.0)
    points = errors.make_points(depth, truth.depth, sigma=sigma, keep=keep, candidate=truth.ok & ~near.usable)
    numbers = errors.measure_errors(points)
    return numbers["coverage"] or 0.0, numbers["median_rel"] if numbers["median_rel"] is not None else float("nan")


def sparse(case: Case, method: Method) -> tuple[float, float]:
    """Coverage and median error of the sparse method."""
    estimate = method(case.near, case.others, hint=case.hint)
    return evaluate(case, estimate.depth, estimate.uv, estimate.keep, estimate.sigma)


def of_map(case: Case, depth_map: dhtorch.records.DepthMap) -> tuple[float, float]:
    """The same of a map, at every fourth pixel along both axes."""
    hw = (depth_map.depth.shape[-2], depth_map.depth.shape[-1])
    place = torch.zeros(hw, dtype=torch.bool)
    place[::4, ::4] = True
    uv = dense.map_pixel_centres(case.near, hw)[place.flatten()][None]
    pick = lambda x: x[:, place]  # noqa: E731
    return evaluate(case, pick(depth_map.depth), uv, pick(depth_map.keep), pick(depth_map.sigma))


def complete(case: Case, options: DenseOptions) -> tuple[float, float]:
    """Coverage and median error of dense completion."""
    named = {name: getattr(options, name) for name in dense.DENSE_RANGES}
    return of_map(case, dhtorch.complete_depth(case.near, case.others, hint=case.hint, options=options, **named))


def distorted(case: Case) -> Tensor:
    """The frame's own depth map (1, h, w) with the errors of a simulated depth network; 0 without a return."""
    return apply_fault("simulated", case.whole.depth)[0]


def align(case: Case, options: AlignmentOptions) -> tuple[float, float]:
    """Coverage and median error of an aligned map."""
    trace: dict[str, Any] = {}
    estimate = dhtorch.AUTO(case.near, case.others, hint=case.hint, trace=trace)
    value = distorted(case)
    value = torch.where(value > 0, value, torch.nan)
    return of_map(case, dhtorch.align_depth(value, [trace["samples"], estimate], hw=case.near.hw, options=options))


def validate(case: Case, options: ValidationOptions) -> tuple[float, float]:
    """Fraction of the pixels with a state, and of these called consistent, of a map that is a tenth too long."""
    validation = dhtorch.validate_depth(1.1 * case.whole.depth, case.near, case.others, hint=case.hint, options=options)
    has_state = validation.state != State.CANNOT_KNOW
    consistent = validation.state == State.CONSISTENT
    return float(has_state.double().mean()), float(consistent.sum() / has_state.sum().clamp_min(1))


def constants() -> Iterator[Constant]:
    """Everything that is varied."""
    for stage, options in STAGES.items():
        for option in options:
            value = settings("method/auto")[stage].get(option)
            if isinstance(value, int | float) and value:
                kind = type(value)

                def with_value(
                    case: Case, x: float, stage: str = stage, option: str = option, kind: type = kind
                ) -> Any:
                    return sparse(case, dhtorch.AUTO.replace(**{stage: {option: odd(x) if kind is int else x}}))

                yield Constant(f"{stage}.{option}", float(value), with_value)
    measures: Mapping[str, Callable[[Case, Any], tuple[float, float]]] = {
        "dense": complete,
        "align": align,
        "validate": validate,
    }
    for name, record in RECORDS.items():
        floats = [f for f in dataclasses.fields(record) if isinstance(f.default, float) and f.default]
        for field in floats[:MAX_PER_RECORD]:

            def of_record(case: Case, x: float, name: str = name, record: type = record, field: Any = field) -> Any:
                return measures[name](case, dataclasses.replace(record(), **{field.name: x}))

            yield Constant(f"{record.__name__}.{field.name}", float(field.default), of_record)


def odd(x: float) -> int:
    """The nearest odd number, at least 3: sizes of windows, and counts of steps."""
    return max(3, 2 * round((x - 1) / 2) + 1)


def medians(constant: Constant, value: float, of: list[Case]) -> dict[str, float]:
    """Medians over scenes of coverage and error at a value; ``n_scenes`` that could be measured."""
    pairs = [constant.measure(case, value) for case in of]
    known = [error for _, error in pairs if error == error]
    middle = statistics.median(known) if known else float("nan")
    return {"coverage": statistics.median(c for c, _ in pairs), "median_rel": middle, "n_scenes": len(known)}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="constants whose name contains this")
    parser.add_argument("--epsilon", type=float, default=0.002, help="difference that counts as none")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    of, as_is = list(cases()), {}
    rows = json.loads(options.json.read_text()) if options.json and options.json.is_file() else []
    measured = {row["name"] for row in rows}
    print(f"{'constant':44} {'value':>9}  {'coverage':>20}  {'median error':>24}")
    for constant in constants():
        if options.only not in constant.name or constant.name in measured:
            continue
        kind = constant.name.split(".")[0]
        kind = kind if kind in {r.__name__ for r in RECORDS.values()} else "sparse"
        if kind not in as_is:  # the same whatever the constant
            as_is[kind] = medians(constant, constant.value, of)
        row: dict[str, Any] = {"name": constant.name, "value": constant.value, "as_is": as_is[kind]}
        for factor, key in ((0.5, "half"), (2.0, "twice")):
            try:
                row[key] = medians(constant, factor * constant.value, of)
            except (ValueError, RuntimeError) as error:  # out of the option's range
                row[key] = {"error": str(error)}
        changes = [abs(row[k][n] - row["as_is"][n]) for k in ("half", "twice") if "coverage" in row[k] for n in NUMBERS]
        row["candidate_for_removal"] = bool(changes) and max(changes) <= options.epsilon
        rows.append(row)
        shown = [" ".join(f"{row[k].get(n, float('nan')):.3f}" for k in ("half", "as_is", "twice")) for n in NUMBERS]
        mark = " changes nothing" * row["candidate_for_removal"]
        print(f"{constant.name:44} {constant.value:9.4g}  {shown[0]:>20}  {shown[1]:>24}{mark}", flush=True)
        if options.json:  # after each constant: a run takes most of an hour
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


NUMBERS = ("coverage", "median_rel")


if __name__ == "__main__":
    main()
