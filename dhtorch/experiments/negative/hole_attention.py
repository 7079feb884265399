"""Question: does denser sampling at the holes fill them?

Hypothesis: holes are sampled too sparsely, so the gaze moves onto the largest cluster of holes and the frame is sampled
again (``attention``). It is compared with the original gaze (``centre``), a random gaze (``random``) and evenly spread
samples (``even``), whose hole rate is the fraction of the image without a return.

Expectation (written before the run): no; the hole rate rises (the paper: 0.67 to 0.78), because holes are regions
where the sensor has no return, and a sample taken there is one more hole. What holes are good for is routing: their
classes say which may be triangulated, which need another exposure, which a head turn.
What would refute it: on half of the scenes the hole rate does not rise.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dhtorch.codes import Hole
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import MainMetric, Row
from dhtorch.experiments.paper.hole_census import classify_frame, count_holes
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
from dhtorch.geometry.checks import check
from dhtorch.metrics import bootstrap
from dhtorch.pytree import Record, record
from dhtorch.records import Samples
from dhtorch.stages.sample import vogel_spiral

# Largest connected cluster of holes among the samples of a view, and a gaze point in it.
#
# Samples are foveated, so distance and area cannot be counted in samples: two samples are neighbours if one is among
# the nearest few of the other, and every sample is weighted by the image area that it covers.


@record
class Cluster(Record):
    """The largest connected set of holes among the samples of each view."""

    member: Tensor  # (B, N) bool; all False without a hole
    gaze: Tensor  # (B, 2) px: the member nearest to the cluster's centroid; NaN without a hole
    area_px: Tensor  # (B,) image area of the members
    n: Tensor  # (B,) int64 number of members


def largest_cluster(
    uv: Tensor,  # (B, N, 2) px
    hole: Tensor,  # (B, N) bool
    *,
    neighbours: int = 6,
) -> Cluster:
    """Connected cluster of holes with the largest image area, and a gaze point in it.

    Holes are connected if one is among the nearest ``neighbours`` samples of the other. Labels propagate by the minimum
    over neighbours and pointer jumping; the fixed number of rounds (twice the logarithm of N) suffices for samples in
    general position, which is tested against a search along every edge (``oracle`` of
    ``tests/experiments/test_hole_attention.py``).

    Args:
        uv: all samples, holes and others.
        hole: which of them are holes.
        neighbours: number of nearest samples that count as neighbours.

    Returns:
        Cluster. The gaze is a member rather than the centroid, which may lie outside, as for a ring. Ties go to the
        cluster with the first sample.

    Raises:
        ValueError: wrong shapes, fewer than one neighbour, or no more samples than neighbours.

    Gradient: none.
    Source: paper, "What Does Not Work", attention-to-holes resampling; the connectivity is ours.
    """
    sizes = check("largest_cluster", uv=(uv, "B N 2"), hole=(hole, "B N"))
    N = sizes["N"]
    if not 1 <= neighbours < N:
        raise ValueError(
            f"largest_cluster: found {N} samples, expected more than neighbours = {neighbours}, at least 1"
        )
    with torch.no_grad():
        nearest_samples = torch.cdist(uv, uv, compute_mode="donot_use_mm_for_euclid_dist").topk(
            neighbours + 1, -1, largest=False
        )
        area = math.pi * nearest_samples.values[..., -1].square() / (neighbours + 1)  # (B, N) px² of each sample
        label = _label_clusters(nearest_samples.indices, hole)
        covered = torch.zeros_like(area).scatter_add(1, label, torch.where(hole, area, 0.0))
        largest = covered.argmax(-1, keepdim=True)
        member = hole & (label == largest)
        weight = torch.where(member, area, 0.0)[..., None]
        centroid = (uv * weight).sum(1) / weight.sum(1).clamp_min(1e-12)
        squared_distance = (uv - centroid[:, None]).square().sum(-1)
        nearest = torch.where(member, squared_distance, torch.inf).argmin(-1)
        gaze = uv.gather(1, nearest[:, None, None].expand(-1, 1, 2))[:, 0]
        has_hole = member.any(-1)
    return Cluster(
        member=member,
        gaze=torch.where(has_hole[:, None], gaze, torch.nan),
        area_px=torch.where(has_hole, covered.gather(1, largest)[:, 0], 0.0),
        n=member.sum(-1),
    )


def _label_clusters(nearest: Tensor, hole: Tensor) -> Tensor:
    """Cluster labels (B, N): smallest index of the cluster for a hole, own index for other samples."""
    B, N, K = nearest.shape
    indices = torch.arange(N, device=hole.device).expand(B, N)
    start = indices[..., None].expand(B, N, K).flatten(1)
    end = nearest.flatten(1)
    connected = hole.gather(1, start) & hole.gather(1, end)
    end = torch.where(connected, end, start)
    label = indices
    for _ in range(2 * max(N, 2).bit_length()):
        first, second = label.gather(1, start), label.gather(1, end)
        least = torch.minimum(first, second)
        # Both ends of an edge and their roots take the smaller label.
        for index in (start, end, first, second):
            label = label.scatter_reduce(1, index, least, "amin")
        label = label.gather(1, label)
    return label


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
    """Run the experiment: sample every frame with four gazes and count the holes; single frames with all returns.

    Rows, per frame (``pair`` is [i, i]) and per scene: the counts of :mod:`dhtorch.experiments.paper.hole_census`
    (``hole_rate``, ``hole_share.<class>``, ``route_share.<route>``), ``rise`` of the hole rate over ``centre``,
    ``cluster_share`` (fraction of the holes in the largest cluster), ``gaze_way_px`` (distance from the image centre),
    ``n_in_cluster`` and ``cluster_returns``: number of samples in the cluster, and the fraction of them with a return.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; stages 1 to 3 of the first are run. Its sampler must have a ``gaze``.
        pairs: not used.
        stride: frames from one evaluated frame to the next.
        neighbours: number of nearest samples that count as neighbours.

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

    def evaluate_item(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        frame = scene.recording[item[0]].to(settings.dtype).to(settings.device)
        before = classify_frame(method, frame)
        hole = before.hole != Hole.NONE
        cluster = largest_cluster(before.uv, hole, neighbours=neighbours)
        # a random pixel in the central nine tenths of the image
        generator = torch.Generator().manual_seed(settings.seed + 1000 * (item[0] + 1))
        relative = 0.05 + 0.9 * torch.rand(2, generator=generator)
        random_gaze = relative * torch.tensor([frame.hw[1] - 1.0, frame.hw[0] - 1.0])
        samples = {
            "centre": before,
            "random": classify_frame(_with_gaze(method, random_gaze), frame),
            "even": classify_frame(method.replace(sample=vogel_spiral), frame),
        }
        if bool(hole.any()):
            samples["attention"] = classify_frame(_with_gaze(method, cluster.gaze[0]), frame)
        return {v: _count_holes(samples[v], before, cluster, frame.hw) for v in VARIANTS if v in samples}

    outcome = screen_scenes(
        scenes_of(scenes),
        items,
        evaluate_item,
        VARIANTS,
        truth=_TRUTH,
        metrics=(
            MainMetric("hole_rate", larger_is_better=None),
            MainMetric("cluster_share", larger_is_better=True),
            MainMetric("cluster_returns", larger_is_better=True),
            MainMetric("rise", larger_is_better=True),
        ),
        finished=settings.finished,
        progress=progress,
    )
    return outcome.decide(
        "Does denser sampling at the holes fill them?",
        "No: the hole rate rises; the classes of the holes say what could fill them.",
        *verdict(outcome),
    )


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Verdict and text: the hole rate rises on more than half of the scenes; routes of the holes."""
    rate_pairs = paired_metric(outcome, _TRUTH, "centre", "attention", "hole_rate")
    if not rate_pairs:
        return None, "no scene with holes"
    before, after = (bootstrap.interval_over_scenes([pair[k] for pair in rate_pairs]).value for k in (0, 1))
    n_rises = sum(a > b for b, a in rate_pairs)
    routes = {k: outcome.summary[f"centre.route_share.{k}"]["value"] for k in ("triangulate", "change_exposure")}
    turn = outcome.summary["centre.route_share.turn_head"]["value"]
    why = (
        f"hole rate {before:.2f} before, {after:.2f} after (medians of {len(rate_pairs)} scenes; paper: 0.67, 0.78),"
        f" more on {n_rises}; routes of the holes: triangulate {routes['triangulate']:.0%}, change exposure"
        f" {routes['change_exposure']:.0%}, turn the head {turn:.0%}"
    )
    return n_rises > len(rate_pairs) / 2, why


def _with_gaze(method: Method, gaze: Tensor) -> Method:
    """Method whose sampler has its gaze at a pixel."""
    return method.replace(sample={"gaze": tuple(gaze.tolist())})


def _count_holes(samples: Samples, before: Samples, cluster: Cluster, hw: tuple[int, int]) -> Row:
    """Row of one sampling: hole counts, and its returns inside the cluster of the first sampling."""
    row, was_hole = count_holes(samples), before.hole != Hole.NONE
    inside = cluster.member.gather(1, torch.cdist(samples.uv, before.uv).argmin(-1))
    returned = inside & (samples.hole == Hole.NONE)
    n, n_holes = int(inside.sum()), int(was_hole.sum())
    centre = torch.tensor([(hw[1] - 1) / 2, (hw[0] - 1) / 2]).to(cluster.gaze)
    distance = float((cluster.gaze[0] - centre).norm())
    return row | {
        "rise": row["hole_rate"] - float(was_hole.float().mean()),
        "cluster_share": int(cluster.n[0]) / n_holes if n_holes else None,
        "gaze_way_px": distance if n_holes else None,
        "n_in_cluster": n,
        "cluster_returns": int(returned.sum()) / n if n else None,
    }
