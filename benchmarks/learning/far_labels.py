"""Far labels for a network: a small depth network trained on near returns alone, then with far answers as labels too.

    python benchmarks/learning/far_labels.py                    the built-in rooms, one seed
    python benchmarks/learning/far_labels.py --data rooms holo redkitchen --seeds 0 1 2 --json FILE

Returns beyond the near limit are hidden, as in the paper's protocol. From every training frame the network learns

- ``near``: the near returns alone, as a robot that has nothing but its sensor would;
- ``far``: the near returns and the answers of a method beyond them, each weighted by 1 / sigma², silence as a mask;
- ``unweighted``: the same labels, all with the same relative sigma;
- ``truth``: the near returns and the hidden ones, the most that far labels could gain.

``constant`` is not a network: one depth, the median of the far labels, for every far pixel. Measured is the relative
error beyond the near limit on held-out frames of the same rooms: blocks of consecutive frames that are neither trained
on nor source views of any label. The real captures need DHTORCH_DATA.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dhtorch import AUTO, MAP, Method, data, merge
from dhtorch.codes import Source
from dhtorch.data.pairs import CANDIDATE_STEPS
from dhtorch.data.scene import Scene
from dhtorch.functional import sigma_weighted_depth_loss
from dhtorch.metrics import bootstrap, holdout
from dhtorch.pytree import Record, collate, record
from dhtorch.records import Frame
from dhtorch.runtime import storage
from dhtorch.stages.sample import regular_grid
from dhtorch.synthetic import open_room

VARIANTS = ("near", "far", "unweighted", "truth")

#: Height of the pictures that the network gets, px. Labels and truth have the resolution of the capture.
HEIGHT = 96

#: Relative error of the network itself, added to the sigma of each label: otherwise a return of 5 mm would have the
#: weight of a thousand answers of 20 cm, and the far pixels would be learnt last.
NETWORK_ERROR = 0.05

#: Fewest far pixels of a held-out frame that is evaluated.
FEWEST = 20


@dataclass(frozen=True)
class Study:
    """Recordings of like rooms that train one network, and how they are labelled."""

    scenes: Sequence[Scene]
    method: Method
    block: int  # consecutive frames that are held out, or trained on, together
    stride: int = 1  # step between labelled frames


@record
class Labels(Record):
    """Depth labels and truth at the samples of B frames."""

    image: Tensor  # (B, 3, H, W) in [0, 1], as the network gets it
    xy: Tensor  # (B, N, 2) position of the samples, -1 to 1 between the outer edges of the picture
    depth: Tensor  # (B, N) m, near return or far answer; 0 = none
    sigma: Tensor  # (B, N) m
    recovered: Tensor  # (B, N) bool, an answer and no return
    truth: Tensor  # (B, N) m, exact depth or hidden return; 0 = none
    far: Tensor  # (B, N) bool, truth beyond the near limit


def open_study(name: str) -> Study:
    """The built-in rooms, or a real capture below DHTORCH_DATA."""
    if name == "rooms":
        options: dict[str, Any] = {"n_frames": 24, "hw": (240, 320), "step_m": 0.06, "gap": 2}
        return Study([open_room(seed=seed, name=f"room_{seed}", **options) for seed in range(3)], MAP, block=4)
    if name == "holo":
        scenes = [{"path": "holo_stream", "near": 2.5}]
        return Study(list(data.open_scenes(None, scenes)), AUTO, block=5)
    scenes = [{"path": f"7s_redkitchen_stream_{part}", "near": 2.0} for part in ("000", "200")]
    return Study(list(data.open_scenes(None, scenes)), AUTO, block=10, stride=3)


def split_frames(n: int, block: int) -> tuple[list[int], list[int]]:
    """Positions of ``n`` frames for training and held out: every fourth block of ``block`` frames is held out."""
    held_out = [i for i in range(n) if i // block % 4 == 2]
    return [i for i in range(n) if i not in held_out], held_out


def label_scene(study: Study, scene: Scene, n: int = 1536) -> tuple[list[Labels], list[Labels]]:
    """Labels of the training frames of a scene, and of its held-out frames, which have returns alone."""
    training, held_out = split_frames(len(scene.recording), study.block)
    method = study.method.replace(sample=regular_grid, n=n)
    lessons = []
    for i in training[:: study.stride]:
        trace: dict[str, Any] = {}
        sources = [near_frame(scene, k) for k in source_views(scene, method, i, training)]
        views = sources if len(sources) > 1 else sources[0]
        estimate = method(near_frame(scene, i), views, hint=scene.hint, trace=trace)
        merged = merge(trace["samples"], estimate)
        recovered = merged.source == Source.RECOVERED
        lessons.append(make_labels(scene, i, merged.uv, merged.depth, merged.sigma, recovered))
    tests = []
    for i in held_out[:: study.stride]:
        samples = method.sample_depth(near_frame(scene, i))
        depth = torch.where(samples.usable, samples.depth, 0)
        tests.append(make_labels(scene, i, samples.uv, depth, samples.sigma, torch.zeros_like(samples.usable)))
    return lessons, tests


def near_frame(scene: Scene, i: int) -> Frame:
    """Frame ``i`` without the returns beyond the near limit."""
    return holdout.range_split(scene.recording[i], scene.near)


def source_views(scene: Scene, method: Method, i: int, allowed: Sequence[int]) -> list[int]:
    """Source views of frame ``i`` among allowed frames: several for a method that selects, else one at the gap."""
    others = [k for k in allowed if k != i]
    if method.select_views is not None:
        return [k for k in others if abs(k - i) in CANDIDATE_STEPS]
    return [min(others, key=lambda k: abs(abs(k - i) - (scene.gap or 1)))]


def make_labels(scene: Scene, i: int, uv: Tensor, depth: Tensor, sigma: Tensor, recovered: Tensor) -> Labels:
    """Labels at pixels ``uv`` (1, N, 2) of frame ``i`` with the picture and the truth."""
    frame = scene.recording[i]
    image = frame.image.float() / 255 if frame.image.dtype == torch.uint8 else frame.image
    hw = (HEIGHT, round(HEIGHT * frame.hw[1] / frame.hw[0]))
    image = nn.functional.interpolate(image.expand(-1, 3, -1, -1), size=hw, mode="area")
    xy = (2 * uv + 1) / torch.tensor([frame.hw[1], frame.hw[0]]).to(uv) - 1
    truth = true_depth(scene, i, uv)
    return Labels(image, xy, depth, sigma, recovered, truth, truth > (scene.near or 0))


def true_depth(scene: Scene, i: int, uv: Tensor) -> Tensor:
    """Depth (1, N) m: exact outside mirrors and windows of a synthetic room, else returns that pass the truth test."""
    frame, recording = scene.recording[i], scene.recording
    if not hasattr(recording, "truth"):
        truth = holdout.sample_truth(frame, uv)
        return torch.where(truth.ok, truth.depth, 0)
    exact = recording.truth(i)
    odd = [code for code, kind in recording.surfaces.items() if kind in recording.odd_surfaces]
    depth = torch.where(torch.isin(exact["surface"], torch.tensor(odd)), 0, exact["depth"])
    return holdout.sample_truth(frame.replace(depth=depth, depth_camera=frame.camera), uv, truth="raw").depth


class DepthNetwork(nn.Module):
    """Picture (B, 3, H, W) -> depth (B, N) m at positions of the picture: a U-Net of half a million parameters."""

    def __init__(self, widths: Sequence[int] = (16, 32, 64, 128)) -> None:
        super().__init__()
        self.down = nn.ModuleList(_convolutions(a, b, 2) for a, b in zip((3, *widths), widths, strict=False))
        self.up = nn.ModuleList(_convolutions(a + b, b) for b, a in pairwise(widths))
        self.log_depth = nn.Conv2d(widths[0], 1, 1)

    def forward(self, image: Tensor, xy: Tensor) -> Tensor:
        """Depth at positions ``xy`` (B, N, 2)."""
        x, levels = (image - 0.5).contiguous(memory_format=torch.channels_last), []
        for stage in self.down:
            x = stage(x)
            levels.append(x)
        for stage, finer in zip(reversed(self.up), levels[-2::-1], strict=True):
            x = nn.functional.interpolate(x, size=finer.shape[-2:], mode="bilinear")
            x = stage(torch.cat((x, finer), 1))
        at = nn.functional.grid_sample(self.log_depth(x), xy[:, None], padding_mode="border", align_corners=False)
        return at[:, 0, 0].exp()


def _convolutions(n_in: int, n_out: int, stride: int = 1) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, step in ((n_in, stride), (n_out, 1)):
        layers += [nn.Conv2d(a, n_out, 3, step, 1, bias=False), nn.BatchNorm2d(n_out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def targets(labels: Labels, variant: str) -> tuple[Tensor, Tensor]:
    """Target depth (B, N) m, 0 = none, and its sigma for one variant."""
    depth, sigma = labels.depth, labels.sigma
    if variant in ("near", "truth"):
        depth = torch.where(labels.recovered, 0, depth)
    if variant == "truth":
        depth, sigma = (torch.where(labels.far, x, y) for x, y in ((labels.truth, depth), (0 * labels.truth, sigma)))
    if variant == "unweighted":
        sigma = torch.zeros_like(sigma)
    return depth, torch.hypot(sigma, NETWORK_ERROR * depth)


def train(lessons: Sequence[Labels], variant: str, seed: int, *, steps: int = 250, batch: int = 6) -> DepthNetwork:
    """A network trained on the labels of one variant."""
    torch.manual_seed(seed)
    network = DepthNetwork().to(memory_format=torch.channels_last)
    everything = targets(collate(lessons), variant)[0]
    nn.init.constant_(network.log_depth.bias, float(everything[everything > 0].log().mean()))
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    for _ in range(steps):
        labels = collate([lessons[k] for k in torch.randint(len(lessons), (batch,)).tolist()])
        image = labels.image * (0.8 + 0.4 * torch.rand(batch, 3, 1, 1))
        mirror = torch.randint(2, ()) * 2 - 1
        image = image if mirror > 0 else image.flip(-1)
        depth, sigma = targets(labels, variant)
        prediction = network(image, labels.xy * torch.stack((mirror, torch.ones_like(mirror))))
        loss = sigma_weighted_depth_loss(prediction, depth, sigma, kernel="huber")
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval()


@torch.no_grad()
def frame_errors(network: DepthNetwork | None, tests: Sequence[Labels], constant: float = 0.0) -> list[list[float]]:
    """Mean relative error of each held-out frame beyond and within the near limit; without a network of a constant."""
    rows = []
    for labels in tests:
        depth = torch.full_like(labels.truth, constant) if network is None else network(labels.image, labels.xy)
        error = (depth - labels.truth).abs() / labels.truth
        rows.append([float(error[labels.far].mean()), float(error[(labels.truth > 0) & ~labels.far].mean())])
    return rows


def _set_threads() -> None:
    torch.set_num_threads(1)


def _train_and_measure(job: tuple[Sequence[Labels], Sequence[Labels], str, int, int]) -> list[list[float]]:
    lessons, tests, variant, seed, steps = job
    return frame_errors(train(lessons, variant, seed, steps=steps), tests)


def label_quality(lessons: Sequence[Labels]) -> dict[str, float]:
    """Share of the far truth of the training frames that is answered, and the error of these answers."""
    labels = collate(lessons)
    answered = labels.far & labels.recovered
    error = ((labels.depth - labels.truth).abs() / labels.truth)[answered]
    return {
        "training_frames": len(lessons),
        "answered": float(answered.sum() / labels.far.sum()),
        "median_rel": float(error.median()),
        "mean_rel": float(error.mean()),
    }


def compare(errors: dict[str, Tensor]) -> dict[str, Any]:
    """Errors by variant (seeds, frames, 2) -> each mean and its ratio to ``near`` with intervals over frames."""
    near = errors["near"].mean(0)
    summary: dict[str, Any] = {}
    for variant, by_seed in errors.items():
        own = by_seed.mean(0)
        for k, part in enumerate(("far", "near")):
            a, b = own[:, k], near[:, k]
            mean = bootstrap.interval_of_statistic(lambda k, a=a: a[k].mean(-1), len(a))
            ratio = bootstrap.interval_of_statistic(lambda k, a=a, b=b: a[k].mean(-1) / b[k].mean(-1), len(a))
            summary[f"{variant}.{part}_error"] = mean.entry()
            summary[f"{variant}.{part}_ratio"] = ratio.entry()
        of_seeds = by_seed[..., 0].mean(1) / errors["near"][..., 0].mean(1)
        summary[f"{variant}.far_ratio_of_seeds"] = of_seeds.tolist()
    return summary


def run(
    studies: Mapping[str, Study], seeds: Sequence[int], *, steps: int, workers: int, variants: Sequence[str] = VARIANTS
) -> Iterator[dict[str, Any]]:
    """A row for each study: quality of the labels and errors of every variant on held-out frames."""
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_set_threads) as pool:
        labelled = {name: [pool.submit(label_scene, s, scene) for scene in s.scenes] for name, s in studies.items()}
        for name, futures in labelled.items():
            parts = [future.result() for future in futures]
            lessons = [labels for part, _ in parts for labels in part]
            tests = [labels for _, part in parts for labels in part if int(labels.far.sum()) >= FEWEST]
            jobs = [(lessons, tests, variant, seed, steps) for variant in variants for seed in seeds]
            measured = torch.tensor(list(pool.map(_train_and_measure, jobs))).unflatten(0, (len(variants), len(seeds)))
            answers = torch.cat([labels.depth[labels.recovered & (labels.depth > 0)] for labels in lessons])
            constant = torch.tensor([frame_errors(None, tests, float(answers.median()))])
            errors = dict(zip((*variants, "constant"), (*measured, constant), strict=True))
            yield {"data": name, "held_out_frames": len(tests), **label_quality(lessons), **compare(errors)}


def describe(row: Mapping[str, Any]) -> str:
    """Lines of a table: far and near error of every variant, and the far error's ratio to near labels alone."""
    lines = []
    for variant in (*VARIANTS, "constant"):
        if f"{variant}.far_error" in row:
            far, near, ratio = (row[f"{variant}.{key}"] for key in ("far_error", "near_error", "far_ratio"))
            interval = f"{ratio['value']:.2f} ({ratio['low']:.2f}–{ratio['high']:.2f})"
            lines.append(f"{row['data']:12} {variant:10}  far {far['value']:.3f}  near {near['value']:.3f}  {interval}")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", nargs="+", choices=("rooms", "holo", "redkitchen"), default=["rooms"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of weights and batches")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--workers", type=int, default=2, help="processes of one thread")
    parser.add_argument("--json", type=Path, help="result file")
    args = parser.parse_args()
    parameters = sum(p.numel() for p in DepthNetwork().parameters())
    shared = {"seeds": args.seeds, "steps": args.steps, "parameters": parameters}
    rows: list[dict[str, Any]] = []
    studies = {name: open_study(name) for name in args.data}
    for row in run(studies, args.seeds, steps=args.steps, workers=args.workers):
        print(describe(row), flush=True)
        rows.append(row | shared)
        if args.json is not None:
            storage.write_json(args.json, rows)


if __name__ == "__main__":
    main()
