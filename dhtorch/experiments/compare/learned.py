"""Question: how accurate are feed-forward networks on the same points, given the scale?

DUSt3R and VGGT estimate dense depth up to scale. For the comparison with our metric depth the scale is (a) an oracle's:
the median ratio to the truth over pixels of the reference view that no sample reads, one scale for each pair, as in the
paper; and (b), beyond the paper, the sensor's: the same ratio over the near returns that our method uses too. Only (b)
is metric. The inputs differ (the networks have no depth, ours has near depth), and so does coverage: ours leaves
candidates unanswered, so the networks are also evaluated on exactly the candidates that ours answered. The control
``constant`` predicts the same depth everywhere: its error is that of an oracle's scale without any network.

Expectation (written before the run): with the oracle's scale, VGGT has the smaller median error on most scenes, also on
the candidates that ours answered (the paper: 2.5 % against 6.7 %).
What would refute it: a larger median error of VGGT on half of the scenes or more. Without VGGT nothing is decided.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.data.scene import SceneLike
from dhtorch.experiments import memory, protocol
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.experiments.baselines.relative import RelativeDepth, sample_relative_depth, to_estimate
from dhtorch.experiments.outcome import Row, median_or_none, summarise_rows
from dhtorch.experiments.protocol import (
    Batch,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
)
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import round_half_up
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.spec import Trace
from dhtorch.pytree import Record, record
from dhtorch.records import Estimate, Frame, Pose

#: Source of a network's scale → whether its depth is then metric.
_SCALE_SOURCES = {"oracle": "no", "near": "yes"}

#: The network that the verdict is about.
_DECIDING_NETWORK = "vggt"

#: Fewest pixels that fix a scale.
_MIN_SCALE_PIXELS = 20

DepthNetwork = Callable[[Frame, Frame], RelativeDepth]


@record
class _NetworkScale(Record):
    """Metres per unit of a network."""

    factor: Tensor  # (B,); NaN where too few pixels determine it
    n_pixels: Tensor  # (B,) pixels that determine it


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    models: Mapping[str, Callable[..., DepthNetwork]] | None = None,
    scales: Sequence[str] = ("oracle", "near"),
    scale_pixels: int = 4096,
    progress: Progress = no_progress,
) -> Outcome:
    """Errors of a method and of depth networks on the same pairs, samples and candidates.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.pair.run`; the first of the
            methods is compared with the networks.
        models: name → builder of a network (``device=`` → pair of frames → :class:`RelativeDepth`). A partial whose
            option ``weights`` is None is left out; ``constant`` has none.
        scales: ``oracle``, ``near`` or both; a network's variants are called ``<name>_<scale>``.
        scale_pixels: pixels drawn to fix a scale; those without a return, or read by a sample, do not count.

    Returns:
        Outcome. Rows of networks have ``scale``, ``metric``, ``parameters``, ``device`` and, as all scene rows,
        ``seconds_per_video``; ``on_ours`` are their numbers on the candidates that ours answered. They have no
        ``pnp_ok``, as they use no pose of ours.

    Raises:
        ImportError: a package is missing; the message says what to install.
        ValueError: no network at all, or an unknown scale.
    """
    for scale in scales:
        if scale not in _SCALE_SOURCES:
            raise ValueError(f"experiment.scales: found {scale!r}, expected some of {', '.join(_SCALE_SOURCES)}")
    with_weights = {
        k: build
        for k, build in (models or {}).items()
        if getattr(build, "keywords", {}).get("weights", "no such option") is not None
    }
    if not with_weights:
        names = ", ".join(f"experiment.models.{k}.weights" for k in models or ())
        raise ValueError(f"experiment.models: found no weights, expected local files or folders in {names or 'it'}")
    networks = {k: build(device=settings.device) for k, build in with_weights.items()}
    ours, method = next(iter(chosen.items()))
    variants = {ours: Variant(method)}
    labels: dict[str, Row] = {ours: {"scale": "sensor", "metric": "yes", **memory.count_weights(method)}}
    for name, network in networks.items():
        cached = _CachedNetwork(network)
        for scale in scales:
            estimate = partial(_estimate_with_network, network=cached, scale_pixels=scale_pixels)
            scale_options = partial(_scale_reference, scale=scale, seed=settings.seed)
            variants[f"{name}_{scale}"] = Variant(method, estimate=estimate, call_options=scale_options)
            labels[f"{name}_{scale}"] = {
                "scale": scale,
                "metric": _SCALE_SOURCES[scale],
                **memory.count_weights(getattr(network, "network", network)),
            }

    def scale_columns(answer: protocol.Answer) -> Row:
        scale = answer.trace.get("scale")
        return (
            {} if scale is None else {"scale_factor": float(scale.factor[0]), "scale_pixels": float(scale.n_pixels[0])}
        )

    outcome = protocol.run(scenes, Protocol(variants, columns=scale_columns), pairs, settings, progress=progress)
    _complete_rows(outcome, ours, labels, settings.device)
    outcome.summary = summarise_rows(outcome.rows, list(variants), list(settings.truth))
    return outcome.decide(
        "How accurate are feed-forward networks on the same points, given the scale?",
        (
            "With an oracle's scale VGGT has a smaller median error than ours on most scenes, on the points "
            "ours answers."
        ),
        *verdict(outcome, ours, f"{_DECIDING_NETWORK}_oracle"),
    )


class _CachedNetwork:
    """Network with a cache of its last pair of images, for all scales; keeps the milliseconds of the forward pass."""

    def __init__(self, network: DepthNetwork) -> None:
        self.network = network
        self._images: tuple[Tensor, Tensor] | None = None
        self._answer: tuple[RelativeDepth, float] | None = None

    def __call__(self, frame_0: Frame, frame_1: Frame) -> tuple[RelativeDepth, float]:
        """(relative depth of the pair, milliseconds of the forward pass that computed it)."""
        images = self._images
        if self._answer is None or images is None or images[0] is not frame_0.image or images[1] is not frame_1.image:
            start = time.perf_counter()
            depth = self.network(frame_0, frame_1)
            self._answer = depth, 1e3 * (time.perf_counter() - start)
            self._images = frame_0.image, frame_1.image
        return self._answer


def _estimate_with_network(
    method: Method,
    near: Frame,
    other: Frame,
    *,
    network: _CachedNetwork,
    scale_pixels: int,
    known: Frame,
    seed: int,
    trace: Trace,
    **_options: Any,
) -> Estimate:
    """Estimate at the method's samples from a network's depth, scaled by the depth of ``known``."""
    like = near.camera.f
    samples = method.sample_depth(near)
    relative, ms = network(near, other)
    scale = fit_scale(relative, known, samples.uv, n_pixels=scale_pixels, seed=seed)
    no_pose = Pose(
        torch.full_like(like, torch.nan)[:, :1, None].expand(-1, 3, 3), like.new_full((len(like), 3), torch.nan)
    )
    trace.update(samples=samples, fit=known_pose_fit(no_pose, method.n), scale=scale, ms={"network": ms})
    return to_estimate(relative, samples.uv, scale.factor)


def fit_scale(relative: RelativeDepth, known: Frame, samples_uv: Tensor, *, n_pixels: int, seed: int) -> _NetworkScale:
    """Metres per unit: median ratio of known to relative depth over pixels that no sample reads.

    Image pixels are drawn from the seed, the same for all pairs. One whose pixel of the depth map lies within the
    reach of a sample's (that pixel itself; in a sparse map twice the radius in which a return is searched) is left out,
    so that no candidate's truth takes part.

    Args:
        relative: relative depth of B pairs.
        known: the reference views with the depth that determines the scale.
        samples_uv: (B, N, 2) px.
        n_pixels: pixels drawn.
        seed: of the pixels.
    """
    h, w = known.hw
    draws = torch.rand(n_pixels, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    uv = (draws * torch.tensor([w, h]) - 0.5).to(samples_uv).expand(samples_uv.shape[0], -1, -1)
    true_depth = holdout.sample_truth(known, uv, truth="raw").depth
    reach = uv.new_zeros(1, 1) if known.sparse is None else (holdout.SPARSE_CLOSE_WINDOW_PX - 1) * known.sparse[:, None]
    # Whether pixels (B, M) lie, in the depth map, within ``reach`` (B, 1) pixels of one that a sample reads
    size = (known.depth.shape[-2], known.depth.shape[-1])
    to_depth_map = partial(cam.depth_pixels, known.camera, known.hw, known.depth_camera, size)
    pixels, sample_pixels = (round_half_up(to_depth_map(x)) for x in (uv, samples_uv))
    distance = [
        torch.cdist(a[None], b[None], p=torch.inf)[0].amin(-1) for a, b in zip(pixels, sample_pixels, strict=True)
    ]
    near_sample = torch.stack(distance) <= reach
    depth, _ = sample_relative_depth(relative, uv)
    use = (true_depth > 0) & depth.isfinite() & ~near_sample
    ratio = torch.where(use, true_depth / torch.where(use, depth, torch.ones_like(depth)), torch.nan)
    count = use.sum(-1)
    factor = ratio.nanmedian(-1).values
    return _NetworkScale(torch.where(count >= _MIN_SCALE_PIXELS, factor, torch.full_like(factor, torch.nan)), count)


def verdict(outcome: Outcome, ours: str, theirs: str) -> tuple[bool | None, str]:
    """(the network has the smaller median error on the candidates ours answered, on most scenes; medians)."""
    our_rows, their_rows = outcome.scenes(ours), outcome.scenes(theirs)
    pairs = {}
    for scene in our_rows:
        row = their_rows.get(scene, {}).get("on_ours") or {}
        if our_rows[scene].get("median_rel") is not None and row.get("median_rel") is not None:
            pairs[scene] = (row["median_rel"], our_rows[scene]["median_rel"])
    if not pairs:
        return None, "no scene on which both answered" if their_rows else f"{theirs} was not run: give its weights"
    better = [scene for scene, (a, b) in pairs.items() if a < b]
    a, b = (median_or_none([pair[k] for pair in pairs.values()]) or 0.0 for k in (0, 1))
    why = (
        f"{theirs} is more accurate on {len(better)} of {len(pairs)} scenes, median of medians {a:.2%} against {b:.2%}"
    )
    return 2 * len(better) > len(pairs), why


def _scale_reference(batch: Batch, *, scale: str, seed: int) -> dict[str, Any]:
    """Reference view whose depth determines the scale: its truth, or the near returns that ours uses too."""
    reference = batch.exact if scale == "oracle" else holdout.range_split(batch.reference, batch.cutoff)
    return {"known": reference, "seed": seed}


def _complete_rows(outcome: Outcome, ours: str, labels: Mapping[str, Row], device: str) -> None:
    """Add labels, time of the whole video, and metrics on the candidates that ours answered to the protocol's rows."""
    for row in outcome.rows:
        name, scene = row["method"], row["scene"]
        row.update(labels[name], device=device)
        if name != ours:
            row.update({k: None for k in ("pnp_ok", "pnp_success", "n_inlier") if k in row})
        pair_rows = [r for r in outcome.rows if (r["scene"], r["method"]) == (scene, name) and r["pair"] is not None]
        if row["pair"] is not None or not pair_rows:
            continue
        row["seconds_per_video"] = sum(sum(r["ms"].values()) for r in pair_rows) / 1e3
        if name != ours:
            answered = outcome.points[scene, ours, row["truth"]].keep
            metrics = errors.measure_errors(outcome.points[scene, name, row["truth"]][answered])
            row["on_ours"] = {k: metrics[k] for k in ("n_kept", "coverage", "median_rel", "p90_rel", "corr")}
