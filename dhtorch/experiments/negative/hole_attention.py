"""Question: does looking at the holes fill them?

The idea: a hole is a place the sampler looked at too rarely, so the gaze moves onto the largest cluster of holes and
the frame is sampled again (``attention``). Beside it stand the gaze as it was (``centre``), a gaze that moves anywhere
(``random``) and samples spread evenly (``even``), whose hole rate is the share of the picture that has no return.

Expectation (written before the run): no; the hole rate rises (the paper: 0.67 to 0.78), because holes are regions
where the sensor has no return, and a sample taken there is one more hole. What holes are good for is routing: their
classes say which may be triangulated, which need another exposure, which a head turn.
What would refute it: on half of the scenes the hole rate does not rise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dhtorch.codes import Hole
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.negative.clusters import Cluster, largest_cluster
from dhtorch.experiments.paper.hole_census import classify_frame, count_holes
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row
from dhtorch.experiments.screening import ScreenedItem, paired_metric, screen_scenes
from dhtorch.metrics import bootstrap
from dhtorch.records import Samples
from dhtorch.stages.sample import vogel_spiral

QUESTION = "Does looking at the holes fill them?"
EXPECTATION = "No: the hole rate rises; the classes of the holes say what could fill them."

VARIANTS = ("centre", "attention", "random", "even")
_TRUTH = "sensor"


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    stride: int = 1,
    neighbours: int = 6,
    progress: Progress = no_progress,
) -> Outcome:
    """Sample every frame four times and count the holes; nothing is hidden and no second view is read.

    Rows, per frame (``pair`` is [i, i]) and per scene: what :mod:`dhtorch.experiments.paper.hole_census` counts
    (``hole_rate``, ``hole_share.<class>``, ``route_share.<route>``), ``rise`` of the hole rate over ``centre``,
    ``cluster_share`` (of the holes, in the largest cluster), ``gaze_way_px`` (from the picture's middle), and
    ``n_in_cluster`` and ``cluster_returns``: samples that fall into the cluster, and the share of them that found a
    return.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; seats 1 to 3 of the first are asked. Its sampler must have a ``gaze``.
        pairs: not used.
        stride: every how many frames.
        neighbours: samples around one that count as next to it.

    Raises:
        ValueError: a sampler without a gaze, or a stride below 1.

    Source: paper, "What Does Not Work", attention-to-holes resampling.
    """
    method = next(iter(methods.values()))
    try:
        _with_gaze(method, torch.full((2,), 50.0)).sample((100, 100), 1)
    except TypeError as error:
        raise ValueError(f"hole_attention: expected a sampler with an option gaze in method.sample: {error}") from error
    if stride < 1:
        raise ValueError(f"hole_attention: stride is {stride}, expected at least 1")

    def items(scene: Scene) -> list[ScreenedItem]:
        return [(i, i) for i in range(0, len(scene.recording), stride)]

    def ask(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        frame = scene.recording[item[0]].to(settings.dtype).to(settings.device)
        before = classify_frame(method, frame)
        hole = before.hole != Hole.NONE
        cluster = largest_cluster(before.uv, hole, neighbours=neighbours)
        looked = {
            "centre": before,
            "random": classify_frame(_with_gaze(method, _random_gaze(frame.hw, settings.seed, item[0])), frame),
        }
        looked["even"] = classify_frame(method.replace(sample=vogel_spiral), frame)
        if bool(hole.any()):
            looked["attention"] = classify_frame(_with_gaze(method, cluster.gaze[0]), frame)
        return {v: _count_holes(looked[v], before, cluster, frame.hw) for v in VARIANTS if v in looked}

    outcome = screen_scenes(scenes_of(scenes), items, ask, VARIANTS, truth=_TRUTH, progress=progress)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome))


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Does the hole rate rise on more than half of the scenes, and where do the holes' classes point?"""
    both = paired_metric(outcome, _TRUTH, "centre", "attention", "hole_rate")
    if not both:
        return None, "no scene with holes"
    before, after = (bootstrap.interval_over_scenes([pair[k] for pair in both]).value for k in (0, 1))
    more = sum(a > b for b, a in both)
    route = {k: outcome.summary[f"centre.route_share.{k}"]["value"] for k in ("triangulate", "change_exposure")}
    turn = outcome.summary["centre.route_share.turn_head"]["value"]
    why = (
        f"hole rate {before:.2f} before, {after:.2f} after (medians of {len(both)} scenes; paper: 0.67, 0.78), more on"
        f" {more}; routes of the holes: triangulate {route['triangulate']:.0%}, change exposure"
        f" {route['change_exposure']:.0%}, turn the head {turn:.0%}"
    )
    return more > len(both) / 2, why


def _with_gaze(method: Method, gaze: Tensor) -> Method:
    """The method with its sampler looking at a pixel."""
    u, v = gaze.tolist()
    return method.replace(sample={"gaze": (u, v)})


def _random_gaze(hw: tuple[int, int], seed: int, i: int) -> Tensor:
    """A pixel (2,) in the middle nine tenths of a picture."""
    generator = torch.Generator().manual_seed(seed + 1000 * (i + 1))
    share = 0.05 + 0.9 * torch.rand(2, generator=generator)
    return share * torch.tensor([hw[1] - 1.0, hw[0] - 1.0])


def _count_holes(samples: Samples, before: Samples, cluster: Cluster, hw: tuple[int, int]) -> Row:
    """Holes of one sampling, and what it found inside the cluster that the first one saw."""
    row = count_holes(samples)
    first = float((before.hole != Hole.NONE).float().mean())
    nearest = torch.cdist(samples.uv, before.uv).argmin(-1)
    inside = cluster.member.gather(1, nearest)
    found = inside & (samples.hole == Hole.NONE)
    n = int(inside.sum())
    n_holes = int((before.hole != Hole.NONE).sum())
    middle = torch.tensor([(hw[1] - 1) / 2, (hw[0] - 1) / 2]).to(cluster.gaze)
    way = float((cluster.gaze[0] - middle).norm())
    return row | {
        "rise": row["hole_rate"] - first,
        "cluster_share": int(cluster.n[0]) / n_holes if n_holes else None,
        "gaze_way_px": way if n_holes else None,
        "n_in_cluster": n,
        "cluster_returns": int(found.sum()) / n if n else None,
    }
