"""Question: does fusing recovered points into one map extend it, and do they connect its fragments?

Returns beyond the scene's cutoff are hidden. The remaining returns alone, and together with recovered points, are each
fused into a signed distance field along the recording's own poses (``device``) and along chained poses of the method
(``anchored``). Lengths are in units of the median depth of the scene's first frame, as in ``icp``; a map covers the
voxels that its surface passes through; an island is a connected component of covered voxels.

Expectation (written before the run): wider, but not stitched, as the paper says of its maps: recovered points are
sparse and lie where the sensor sees nothing, so that they make new islands. Without a device's trajectory frames fall
into fragments besides.
What would refute it: along the device's poses the fused map covers no more voxels than the sensor's on half of the
scenes, or has fewer islands on more than half of them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from dhtorch import integrate
from dhtorch.codes import Source
from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import MainMetric, Row
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    ScenePairs,
    ScreenedItem,
    Settings,
    no_progress,
    paired_metric,
    screen_scenes,
)
from dhtorch.geometry import sparse_grid
from dhtorch.integrate.recording import (
    POSE_SOURCES,
    PairEstimate,
    PlacedFrames,
    estimate_pairs,
    fuse_recording,
    linking_pairs,
    measure_coverage,
    place_frames,
)
from dhtorch.metrics import bootstrap

MAP_TRUTH = "whole sensor"
VARIANTS = tuple(f"{what} {poses}" for poses in POSE_SOURCES for what in ("sensor", "fused"))


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    n: int = 2048,
    voxel: float = 0.02,
    weight: str = "variance",
    progress: Progress = no_progress,
) -> Outcome:
    """Voxels and islands of four maps per recording: with or without recovered points, device or chained poses.

    Rows of pairs: ``pnp_ok``, ``n_kept``, ``n_recovered``. Rows of scenes: ``n_voxels`` covered, ``n_islands`` and
    ``largest_island`` (fraction), ``voxels_vs_sensor``, ``n_fragments``: connected groups of frames, ``placed_share``:
    fraction of frames with a pose, ``right_share``: fraction of voxels within one step of the map of the sensor without
    a cutoff along the same poses; voxels where that map has none count as wrong.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; the first is used.
        pairs: reference views and their source views; further links for ``anchored`` come from
            :func:`dhtorch.integrate.recording.linking_pairs`.
        n: samples of a pair.
        voxel: side of a voxel, in median depths.
        weight: of :func:`dhtorch.integrate.fuse_views`: ``variance`` or, as the paper's text has it, ``confidence``.

    Source: paper, "Global integration (scope note)" and the limitation "map fragmentation".
    """
    method = next(iter(methods.values())).replace(n=n)
    estimates: dict[str, dict[ScreenedItem, PairEstimate]] = {}

    def items(scene: Scene) -> list[ScreenedItem]:
        chosen = to_fixed_pairs(pairs(scene))
        return [*chosen, *linking_pairs(chosen)]

    def evaluate(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        options: dict[str, Any] = {"seed": settings.seed, "device": settings.device, "dtype": settings.dtype}
        cutoff = settings.cutoff_of(scene)
        (answer,) = estimate_pairs(scene, method, [item], cutoff=cutoff, **options)
        estimates.setdefault(scene.name, {})[item] = answer
        row: Row = {"pnp_ok": int(answer.fit.ok[0]), "n_kept": int(answer.estimate.keep.sum())}
        row["n_recovered"] = int(answer.recovered.sum())
        is_pair = item in set(pairs(scene))  # else it only links frames
        rows: dict[str, Row] = {"sensor anchored": {}, "fused anchored": row}
        return rows | (
            {"sensor device": {}, "fused device": row} if is_pair and scene.recording.poses is not None else {}
        )

    def whole(scene: Scene, _results: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
        recording, of_item = scene.recording, estimates.pop(scene.name, {})
        answers = [of_item[p] for p in to_fixed_pairs(pairs(scene))]
        maps = _Maps(recording, answers, settings.cutoff_of(scene), voxel, weight)
        rows: dict[str, Row] = {}
        for poses in POSE_SOURCES:
            if poses == "anchored" or recording.poses is not None:
                links = list(of_item.values()) if poses == "anchored" else maps.answers
                rows |= maps.rows(place_frames(recording, links, poses=poses), poses)
        return rows

    outcome = screen_scenes(
        scenes_of(scenes),
        items,
        evaluate,
        VARIANTS,
        truth=MAP_TRUTH,
        whole=whole,
        metrics=(
            MainMetric("n_voxels", larger_is_better=True),
            MainMetric("right_share", larger_is_better=True),
            MainMetric("n_islands", larger_is_better=False),
            MainMetric("n_fragments", larger_is_better=False),
        ),
        finished=settings.finished,
        progress=progress,
    )
    return outcome.decide(
        "Does fusing recovered points into one map extend it, and do they connect its fragments?",
        "Wider, but not stitched: the fused map covers more voxels than the sensor's and has no fewer islands.",
        *verdict(outcome),
    )


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """(more voxels, and no fewer islands, along the device's poses on more than half of the scenes; counts)."""
    voxels = paired_metric(outcome, MAP_TRUTH, "fused device", "sensor device", "n_voxels")
    islands = paired_metric(outcome, MAP_TRUTH, "fused device", "sensor device", "n_islands")
    if not voxels:
        return None, "no scene with a trajectory"
    wider, stitched = sum(a > b for a, b in voxels), sum(a < b for a, b in islands)
    ratio = bootstrap.interval_over_scenes([a / max(b, 1) for a, b in voxels])
    low, high = (ratio.value if bound is None else bound for bound in (ratio.low, ratio.high))
    anchored = [r["n_fragments"] for r in outcome.scenes("fused anchored", MAP_TRUTH).values() if r.get("n_fragments")]
    n_whole = sum(n == 1 for n in anchored)
    why = (
        f"the fused map covers more voxels on {wider} of {len(voxels)} scenes, {ratio.value:.2f} times as many in the"
        f" median ({low:.2f} to {high:.2f}), and has fewer islands on {stitched}; along anchored poses the frames stay"
        f" in one piece on {n_whole} of {len(anchored)}"
    )
    return wider > len(voxels) / 2 and stitched <= len(islands) / 2, why


class _Maps:
    """Builder and metrics of the maps of one recording."""

    def __init__(
        self, recording: Recording, answers: list[PairEstimate], cutoff: float | None, voxel: float, weight: str
    ) -> None:
        self.recording, self.answers, self.cutoff, self.weight = recording, answers, cutoff, weight
        depth = recording[0].depth
        valid = depth[depth.isfinite() & (depth > 0)]
        self.voxel = voxel * (float(valid.median()) if len(valid) else 1.0)

    def rows(self, places: PlacedFrames, poses: str) -> dict[str, Row]:
        """Poses → rows of the sensor's map and of the fused map along them."""
        sensor_voxels = self.covered(self.fused(places, [Source.SENSOR], None))
        near = self.fused(places, [Source.SENSOR], self.cutoff)
        recovered = {"sources": [Source.RECOVERED], "weight": self.weight}
        fused = fuse_recording(self.recording, near, self.answers, places, **recovered)
        total = len(places.poses) + places.n_unplaced
        common: Row = {"n_fragments": places.n_fragments, "placed_share": len(places.poses) / max(total, 1)}
        rows = {}
        for map_name, volume in (("sensor", near), ("fused", fused)):
            voxels = self.covered(volume)
            row = common | measure_coverage(integrate.extract_points(volume).xyz, self.voxel)
            row["right_share"] = (
                float(sparse_grid.touches_cells(voxels, sensor_voxels).double().mean()) if len(voxels) else None
            )
            row["voxel_m"] = self.voxel
            rows[f"{map_name} {poses}"] = row
        n_sensor = rows[f"sensor {poses}"]["n_voxels"]
        rows[f"fused {poses}"]["voxels_vs_sensor"] = rows[f"fused {poses}"]["n_voxels"] / n_sensor if n_sensor else None
        return rows

    def fused(self, places: PlacedFrames, sources: Sequence[int], cutoff: float | None) -> integrate.Volume:
        """New map along ``places``, of the given sources of depth."""
        empty = integrate.make_volume(self.voxel)
        options: dict[str, Any] = {"sources": sources, "cutoff": cutoff, "weight": self.weight}
        return fuse_recording(self.recording, empty, self.answers, places, **options)

    def covered(self, volume: integrate.Volume) -> Tensor:
        """Indices of the voxels that the map's surface passes through."""
        return sparse_grid.occupied_cells(integrate.extract_points(volume).xyz, self.voxel)
