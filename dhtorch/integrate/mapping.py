"""The command ``dhtorch integrate``: one map per recording, its files, and a result with its coverage."""

import importlib.util
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import export, integrate
from dhtorch.codes import SOURCES_OF_KIND, Source, count_kinds, names, words
from dhtorch.data.pairs import Pair
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.integrate import recording as recordings
from dhtorch.integrate.colmap_model import IMAGE_FOLDER, MODEL_FILES, MODEL_FOLDER, write_colmap_workspace
from dhtorch.integrate.level import estimate_up
from dhtorch.integrate.picture import draw_map
from dhtorch.integrate.recording import PairEstimate, PlacedFrames
from dhtorch.integrate.scales import MAX_REACH_TRUNCATIONS, N_MAPS_FOR_VOXEL, choose_coarse_voxel, merge_surfaces
from dhtorch.integrate.sweeps import DenseSweep, StoredSweep, SweepStore
from dhtorch.metrics import bootstrap
from dhtorch.ops import loader
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import merge
from dhtorch.records import Frame
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.viz.plots import append_cutoff

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]
Row = dict[str, Any]
PairSelector = Callable[[Scene], Iterable[Pair]]

#: Option groups whose chosen names are stored in the result.
_CONFIG_GROUPS = ("method", "data", "pairs")


#: Files of a scene, below its folder.
_MAP_FILES = (
    "map.ply",
    "map.glb",
    "points.ply",
    "map.png",
    *(str(Path("colmap", MODEL_FOLDER, name)) for name in MODEL_FILES),
)

#: Axes of the written points and meshes.
MAP_AXES = ("y_up", "world")


@dataclass(frozen=True)
class MappedScene:
    """The map of one recording, with the estimates and poses it was fused from."""

    recording: Recording
    answers: Sequence[PairEstimate]
    places: PlacedFrames
    voxel: float  # m, of the grid that holds the sensor's depth
    surface: integrate.Surface
    row: Row


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Run ``dhtorch integrate``: writes a folder of files per scene, and ``result.json`` after the last one.

    Args:
        settings: the options of ``conf/integrate.yaml``, resolved, with ``choices``.
        parts: ``data``, ``method`` and ``pairs``, as objects.
        progress: wraps a loop: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data.
        KeyboardInterrupt: Ctrl-C; files of finished scenes are kept.
    """
    # What would otherwise fail only after minutes.
    file_from_world(settings["axes"], (0.0, 1.0, 0.0))
    DenseSweep.from_options(settings["dense"])
    if settings["mesh"] and not should_mesh(None):
        raise ImportError("mesh: found no scikit-image, expected it: pip install scikit-image")
    sources = scenes_of(parts["data"])
    folder = Path(settings["output"])
    with open_output_folder(folder, "output") as output:
        output.check([folder / "result.json", *(folder / each.name / name for each in sources for name in _MAP_FILES)])
        output.check_folders([folder / each.name / "colmap" / IMAGE_FOLDER for each in sources])
        began = time.perf_counter()
        scene_rows: list[Row] = []
        rows: list[Row] = []
        written: list[Path] = []
        try:
            for source in sources:
                mapped = map_scene(source, parts["method"], parts["pairs"], settings, progress=progress)
                written += write_mapped_scene(folder / source.name, mapped, settings)
                mapped.row["seconds"] = time.perf_counter() - began - sum(r["seconds"] for r in scene_rows)
                scene_rows.append(mapped.row)
                common = {k: mapped.row[k] for k in ("scene", "method", "truth")}
                rows += [
                    {**common, "pair": list(a.pair), "pnp_ok": int(a.fit.ok[0]), "n_kept": int(a.estimate.keep.sum())}
                    | {"n_recovered": int(a.recovered.sum()), "placed": int(a.pair[0] in mapped.places.poses)}
                    | ({} if a.swept is None else {**_count_swept([a.swept]), "map_hw": list(a.swept.hw)})
                    | ({} if a.picked is None else a.picked.row())
                    for a in mapped.answers
                ]
                rows.append(mapped.row)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{len(scene_rows)} of {format_count(len(sources), 'scene')} in {folder} are whole and stay"
            ) from None
        result = _build_result(settings, sources, rows, scene_rows)
        result_files.write_result(folder / "result.json", result)
        print("\n".join(_describe_scene(row, row["cell_m"]) for row in scene_rows))
        print("\n".join(["wrote", *(f"  {path}" for path in [folder / "result.json", *written])]))
        return 0


def map_scene(
    scene: Scene, method: Method, pairs: PairSelector, settings: Mapping[str, Any], *, progress: Progress
) -> MappedScene:
    """Map of one scene: estimate its pairs, place the frames, fuse the depth and measure the coverage.

    Raises:
        ValueError: as the readers, the method and the volume raise it, or if no frame could be placed.
    """
    recording, chosen = scene.recording, list(pairs(scene))
    settings = {**settings, "voxel": choose_voxel(recording) if settings["voxel"] is None else settings["voxel"]}
    if settings["poses"] == "auto":
        settings["poses"] = "anchored" if recording.poses is None else "device"
    sweep = DenseSweep.from_options(settings["dense"])
    options = {k: settings[k] for k in ("cutoff", "seed", "device")} | {"dtype": getattr(torch, settings["dtype"])}
    estimates = recordings.estimate_pairs(
        scene, method, chosen, sweep=sweep, shelf=SweepStore(Path(settings["output"])), **options
    )
    answers = list(progress(estimates, f"{recording.name}: pairs", len(chosen)))
    links: list[tuple[int, int]] = []
    if settings["poses"] == "anchored":
        tracked = [(a.pair[0], k) for a in answers for k in a.links]
        links = recordings.linking_pairs(tracked, chosen=any(a.picked is not None for a in answers))
    link_estimates = recordings.estimate_pairs(scene, method, links, **options)
    all_answers = [*answers, *progress(link_estimates, f"{recording.name}: links", len(links))]
    places = recordings.place_frames(recording, all_answers, poses=settings["poses"])
    if not places.poses:
        raise ValueError(f"{recording.name}: found no frame with a finite pose, expected one at least")
    volumes, points = _fuse_sources(recording, answers, places, settings, progress)
    *_, surface = points.values()
    if should_mesh(settings["mesh"]):
        surface = reduce(
            merge_surfaces, (integrate.extract_mesh(volume, min_weight=settings["min_weight"]) for volume in volumes)
        )
    row: Row = {"scene": recording.name, "pair": None, "method": _method_name(settings), "truth": settings["poses"]}
    row |= {"role": scene.role, "cutoff_m": settings["cutoff"], "n_pairs": len(chosen), "n_frames": len(places.poses)}
    row |= {"n_fragments": places.n_fragments, "n_unplaced": places.n_unplaced}
    row |= {"n_recovered": sum(int(answer.recovered.sum()) for answer in answers)}
    row |= {} if sweep is None else _count_swept([a.swept for a in answers if a.swept is not None])
    row |= _coverage_columns(points, volumes[-1].voxel)
    kinds = count_kinds(surface.source.bincount(minlength=len(names(Source))).tolist())
    row |= {f"n_points_{kind}": n for kind, n in kinds.items() if kind != "no_answer"}
    row |= {"recovered_sigma_rel": _median_sigma_rel(answers)}
    row |= {"n_points": len(surface.xyz), "n_triangles": None if surface.face is None else len(surface.face)}
    row |= {"volume_mib": sum(v.bytes for v in volumes) / 2**20}
    row |= {"voxel_m": settings["voxel"], "cell_m": volumes[-1].voxel}
    return MappedScene(recording, answers, places, settings["voxel"], surface, row)


def choose_voxel(recording: Recording, frames: Sequence[int] | None = None) -> float:
    """Edge of a voxel, m: twice the size of a depth pixel at the median return, from 5 mm to 20 cm, to two digits.

    Measured in the first, the middle and the last of ``frames``; None = of all frames.
    """
    sizes = []
    frames = range(len(recording)) if frames is None else sorted(frames)
    for k in sorted({frames[0], frames[len(frames) // 2], frames[-1]}):
        frame: Frame = recording[k]
        depth = frame.depth[frame.depth.isfinite() & (frame.depth > 0)]
        if depth.numel():
            depth_f = frame.depth_camera.f if frame.depth_camera is not None else None
            f = frame.camera.f * frame.depth.shape[-1] / frame.hw[1] if depth_f is None else depth_f
            sizes.append(float(depth.median() / f.mean()))
    voxel = 2 * sorted(sizes)[len(sizes) // 2] if sizes else 0.02
    return float(f"{min(max(voxel, 0.005), 0.2):.2g}")


def _fuse_sources(
    recording: Recording,
    answers: Sequence[PairEstimate],
    places: PlacedFrames,
    settings: Mapping[str, Any],
    progress: Progress,
) -> tuple[list[integrate.Volume], dict[str, integrate.Surface]]:
    """The fused volumes, finest first, and the surface points after each source.

    Keys of the points: ``sensor``; ``sparse``, with the recovered points; ``dense``, with the swept pixels as well.
    """
    stages = {Source.SENSOR: "sensor", Source.RECOVERED: "sparse"}
    stages |= {Source.SWEPT: "dense"} if any(a.swept is not None for a in answers) else {}
    points: dict[str, integrate.Surface] = {}
    maps = [swept.read() for swept in [a.swept for a in answers if a.swept is not None][:N_MAPS_FOR_VOXEL]]
    sigmas = [sigma[depth > 0] for depth, sigma, *_ in maps]
    sigmas = sigmas or [a.estimate.sigma[a.recovered] for a in answers] or [torch.zeros(0)]
    wide_voxel = choose_coarse_voxel(settings["voxel"], torch.cat(sigmas))

    def keep_points(source: int, volumes: list[integrate.Volume]) -> None:
        is_fine = source == Source.SENSOR or wide_voxel is None
        surface = integrate.extract_points(volumes[0 if is_fine else -1], min_weight=settings["min_weight"])
        points[stages[source]] = surface if is_fine else merge_surfaces(points["sensor"], surface)

    options = {k: settings[k] for k in ("cutoff", "min_conf", "min_maps", "weight")} | {"progress": progress}
    options |= {name: settings[f"sensor_{name}"] for name in ("sigma_m", "sigma_rel")}
    options |= {"max_reach": MAX_REACH_TRUNCATIONS}
    empty = [integrate.make_volume(settings["voxel"], truncation=settings["truncation"])]
    empty += [] if wide_voxel is None else [integrate.make_volume(wide_voxel)]
    volumes = recordings.fuse_recording_grids(
        recording, empty, answers, places, sources=list(stages), after=keep_points, **options
    )
    return volumes, points


def _median_sigma_rel(answers: Sequence[PairEstimate]) -> float | None:
    """Median sigma / depth of the recovered pixels of the first maps; without maps, of the recovered points."""
    maps = [swept.read() for swept in [a.swept for a in answers if a.swept is not None][:N_MAPS_FOR_VOXEL]]
    ratios = [(sigma / depth)[source == Source.SWEPT] for depth, sigma, _, source in maps]
    ratios = ratios or [(a.estimate.sigma / a.estimate.depth)[a.recovered] for a in answers]
    ratio = torch.cat([torch.zeros(0), *ratios])
    return float(ratio.median()) if len(ratio) else None


def _coverage_columns(points: Mapping[str, integrate.Surface], voxel: float) -> Row:
    """Coverage of the last surface, of the earlier ones under their names, and the ratio of covered voxels to each."""
    coverage = {name: recordings.measure_coverage(surface.xyz, voxel) for name, surface in points.items()}
    *earlier, last = coverage
    row: Row = coverage[last]
    for name in earlier:
        row |= {f"{k}_{name}": v for k, v in coverage[name].items()}
        n = row[f"n_voxels_{name}"]
        row[f"voxels_vs_{name}"] = row["n_voxels"] / n if n else None
    return row


def write_mapped_scene(folder: Path, scene: MappedScene, settings: Mapping[str, Any]) -> list[Path]:
    """Write the files of one scene into ``folder``; returns their paths."""
    surface, poses = scene.surface, list(scene.places.poses.values())
    up = estimate_up(scene.recording, poses, surface.xyz, 2 * scene.voxel, surface.normal)
    turn = file_from_world(settings["axes"], up)
    comments = write_surface(folder / "map.ply", surface, f"{scene.recording.name}'s world", up, turn)
    cloud = _collect_samples(scene)
    export.write_glb(folder / "map.glb", _map_shapes(scene, cloud, turn), up=(0.0, 1.0, 0.0))
    columns = {k: cloud[k] for k in ("sigma", "score", "hole", "source")}
    export.write_ply(folder / "points.ply", cloud["xyz"].double() @ turn.T, cloud["rgb"], comments=comments, **columns)
    counts = write_colmap_workspace(folder / "colmap", scene.recording, scene.answers, scene.places.poses)
    scene.row.update({f"colmap_{name}": n for name, n in counts._asdict().items()})
    title = append_cutoff(scene.recording.name, scene.row["cutoff_m"])
    draw_map(folder / "map.png", surface, poses, up, voxel=scene.voxel, title=title)
    return [*(folder / name for name in _MAP_FILES), folder / "colmap" / IMAGE_FOLDER]


def _map_shapes(scene: MappedScene, cloud: Mapping[str, Tensor], turn: Tensor) -> list[export.Shape]:
    """The surface, the recovered points as squares of one voxel, and the swept part of the surface."""
    surface, recovered = scene.surface, cloud["source"] == Source.RECOVERED
    xyz, normal = (cloud[k][recovered].double() @ turn.T for k in ("xyz", "normal"))
    columns = {"values": {"sigma": cloud["sigma"][recovered]}, "square": scene.row["cell_m"]}
    shapes = [
        surface_shape("surface", surface, turn, scene.voxel),
        export.Shape("recovered", xyz, cloud["rgb"][recovered], normal, **columns),
    ]
    swept = surface.source == Source.SWEPT
    if bool(swept.any()):
        face = None if surface.face is None else (swept.cumsum(0) - 1)[surface.face[swept[surface.face].all(1)]]
        shapes.append(
            surface_shape("swept", surface.replace(face=None)[swept].replace(face=face), turn, scene.row["cell_m"])
        )
    return shapes


def surface_shape(
    name: str,
    surface: integrate.Surface,  # in the world
    turn: Tensor,  # (3, 3) from the world to the axes of the file
    square: float,
) -> export.Shape:
    """A surface for a GLB file: its triangles, or a square of side ``square`` (m) for each point if it has none."""
    xyz, normal = (x.double() @ turn.T for x in (surface.xyz, surface.normal))
    values = {"sigma": surface.sigma, "source": surface.source}
    return export.Shape(name, xyz, surface.features[:, :3], normal, surface.face, values=values, square=square)


def file_from_world(
    axes: str,
    up: Sequence[float],  # in the world
) -> Tensor:
    """Rotation (3, 3) from the world to the axes of the files: ``y_up``, as in glTF, or ``world``, none.

    Raises:
        ValueError: other axes.
    """
    if axes not in MAP_AXES:
        raise ValueError(f"axes: found {axes!r}, expected one of {', '.join(MAP_AXES)}")
    return se3.turn_between(up, (0.0, 1.0, 0.0)) if axes == "y_up" else torch.eye(3, dtype=torch.float64)


def write_surface(
    path: Path,
    surface: integrate.Surface,  # in the world
    world: str,
    up: Sequence[float],  # in the world
    turn: Tensor,  # (3, 3) from the world to the axes of the file
) -> list[str]:
    """Write a surface as PLY; returns its comments, for other files of the same map. ``world`` names its world."""
    rgb, score = surface.features[:, :3], surface.features[:, 3]
    codes = ", ".join(f"{code} {words(name)}" for code, name in names(Source).items())
    turned_up = turn @ torch.tensor(list(up), dtype=torch.float64)
    comments = [f"metres; up and world_from_file (row by row) relate these axes to those of {world}"]
    comments += [f"up {_format_numbers(turned_up)}", f"world_from_file {_format_numbers(turn.T)}", f"source: {codes}"]
    columns = {"sigma": surface.sigma, "score": score, "source": surface.source}
    xyz, normal = (x.double() @ turn.T for x in (surface.xyz, surface.normal))
    export.write_ply(path, xyz, rgb, normal=normal, face=surface.face, comments=comments, **columns)
    return comments


def _format_numbers(values: Tensor) -> str:
    return " ".join(f"{v:.9f}" for v in (values.flatten() + 0.0).tolist())


def _collect_samples(scene: MappedScene) -> dict[str, Tensor]:
    """All samples with sensor or recovered depth of the placed reference views, as points in the world with columns.

    ``normal`` is the vector from the point to the camera.
    """
    parts: dict[str, list[Tensor]] = {k: [] for k in ("xyz", "rgb", "normal", "sigma", "score", "hole", "source")}
    for answer in scene.answers:
        if answer.pair[0] in scene.places.poses:
            merged = merge(answer.samples, answer.estimate)
            has_depth = merged.source[0] != Source.NONE
            xyz = cameras.unproject(answer.camera, merged.uv, merged.depth)
            T = scene.places.poses[answer.pair[0]]
            world = se3.apply(T, xyz.double())
            values = {
                "xyz": world,
                "normal": T.t[:, None] - world,
                "rgb": answer.rgb,
                "sigma": merged.sigma,
                "score": merged.score,
            }
            for name, value in {**values, "hole": answer.samples.hole, "source": merged.source}.items():
                parts[name].append(value[0][has_depth])
    empty = dict.fromkeys(("xyz", "rgb", "normal"), torch.zeros(0, 3))
    return {k: torch.cat(v) if v else empty.get(k, torch.zeros(0)) for k, v in parts.items()}


def _describe_scene(row: Row, cell: float) -> str:
    """One line of text on a scene: frames, fragments, coverage and size of its map."""
    frames = format_count(row["n_frames"] + row["n_unplaced"], "frame")
    placed = f"{row['n_frames']} of {frames} placed by {row['truth']} poses"
    fragments = format_count(row["n_fragments"], "fragment")
    if not row["n_voxels"]:
        return f"{row['scene']}: {placed}, {fragments}; no surface"
    ratio = f", {row['voxels_vs_sensor']:.3g} times the sensor's" if row["voxels_vs_sensor"] else ""
    ratio += f" and {row['voxels_vs_sparse']:.3g} times those without a sweep" if row.get("voxels_vs_sparse") else ""
    islands = f"{format_count(row['n_islands'], 'island')}, the largest {row['largest_island']:.0%}"
    kinds = {kind: f"{kind} {row[f'n_points_{kind}']:,}" for kind in SOURCES_OF_KIND if kind != "no_answer"}
    if row["recovered_sigma_rel"] is not None:
        kinds["recovered"] += f" (median sigma {row['recovered_sigma_rel']:.1%} of the depth)"
    size = f"{row['n_points']:,} points: {', '.join(kinds.values())}"
    size += f"; {row['n_triangles']:,} triangles" if row["n_triangles"] else ""
    return (
        f"{row['scene']}: {placed}, {fragments};"
        f" {format_count(row['n_voxels'], 'voxel')} of {100 * cell:g} cm{ratio}, {islands};"
        f" {size}, {row['volume_mib']:.1f} MiB, {row['seconds']:.1f} s"
    )


def _count_swept(maps: Sequence[StoredSweep]) -> Row:
    """Numbers of pixels of dense maps from other views, and interpolated."""
    return {"n_swept": sum(each.n - each.n_filled for each in maps), "n_filled": sum(each.n_filled for each in maps)}


def _build_result(settings: Mapping[str, Any], sources: Sequence[Scene], rows: list[Row], scenes: list[Row]) -> Row:
    choices = {group: settings["choices"][group] for group in _CONFIG_GROUPS}
    config = {k: v for k, v in settings.items() if k != "choices"}
    named = result_files.list_files_named({k: config[k] for k in _CONFIG_GROUPS})
    recorded = result_files.list_files_below((scene.root, scene.recording.bounds) for scene in sources)
    digest = result_files.compute_data_digest({**recorded, **named})
    metrics = ["n_voxels", "n_voxels_sensor", "voxels_vs_sensor", "n_fragments", "n_islands"]
    metrics += ["n_voxels_sparse", "voxels_vs_sparse"] if DenseSweep.from_options(settings["dense"]) is not None else []
    summary = {}
    for metric in metrics:
        values = sorted(row[metric] for row in scenes if row[metric] is not None and row["role"] is None)
        middle = float(torch.tensor(values, dtype=torch.float64).quantile(0.5)) if values else None
        summary[f"{_method_name(settings)}.{metric}"] = bootstrap.without_interval(middle, len(values), "")
    threads = torch.get_num_threads()
    return result_files.build_result(
        experiment="integrate",
        key=result_files.compute_result_key({**config, "choices": choices}, digest, roots=[__name__]),
        meta=result_files.collect_run_metadata(
            device=settings["device"],
            dtype=settings["dtype"],
            threads=threads,
            seed=settings["seed"],
            operators=loader.describe_operators(),
        ),
        config=config,
        data={
            "name": choices["data"],
            "scenes": [row["scene"] for row in scenes],
            "n_pairs": sum(row["n_pairs"] for row in scenes),
            "digest": digest,
        },
        summary=summary,
        rows=rows,
    )


def _method_name(settings: Mapping[str, Any]) -> str:
    return str(settings["choices"]["method"])


def should_mesh(wanted: bool | None) -> bool:
    """Whether to extract a mesh: the option ``mesh``, or if it is None whether scikit-image is installed."""
    return importlib.util.find_spec("skimage") is not None if wanted is None else wanted
