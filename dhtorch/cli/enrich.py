"""``dhtorch enrich SRC DST``: data set -> data set with depth, sigma and camera columns for every image.

Depth maps are computed in shards, as in ``dhtorch extract``; once all shards of an episode exist, the episode is
written and its shards are removed. Complete episodes are kept: a second run writes the missing ones, byte for byte as
one run would have.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from dhtorch.cli import enrich_page
from dhtorch.cli.option_checks import validate_choices
from dhtorch.codes import words
from dhtorch.data.io.decode import import_optional
from dhtorch.data.rig import Rig
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.extract import columns, cut, engines, plan, shards
from dhtorch.extract.enriched import MAP_FILES, NO_ANSWER_REASONS, DatasetCamera, MapRowDataset, camera_key, map_columns
from dhtorch.extract.nerf_target import NerfstudioTarget
from dhtorch.extract.origin import DEFAULT_FPS, METADATA_FILE, DatasetSource, LeRobotSource, frame_rate, has_frame_rate
from dhtorch.extract.policy_columns import POLICY_COLUMNS
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.step_set import RldsSource
from dhtorch.extract.targets import DatasetTarget
from dhtorch.ops import loader
from dhtorch.pipeline import dense
from dhtorch.pipeline.presets import with_sensor
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, OutputFolder, open_output_folder
from dhtorch.transforms import poses

Row = dict[str, Any]

#: Version of the file format; increased when older readers would misread the files.
_FORMAT_VERSION = 1

#: Output format → LeRobot version, None = no LeRobot format.
_OUTPUT_FORMATS: dict[str, int | None] = {"lerobot": 3, "v3.0": 3, "lerobot_v2.1": 2, "v2.1": 2, "nerfstudio": None}

#: Options that determine what is written; they enter the key.
_KEY_OPTIONS = ("data", "method", "seed", "format", "dense", "causal", "gap", "cameras", "pose", "pose_sigma",
         "columns", "max_frames", "every", "maps", "step", "fps", "task", "on_error", "sensor")  # fmt: skip

#: Longer side of a depth map with dense=false (samples only), px.
_SAMPLED_MAP_SIDE_PX = 640

#: Unreadable frames listed by name in the printed summary.
_MAX_COMPLAINTS = 3

#: errno of a write that fails for lack of space.
_DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

#: Values of ``pose``: relative pose from near returns, from the device, or from the device as a start value.
_POSE_SOURCES = ("near", "device", "start")


#: Values of ``maps``: maps in LeRobot tables are arrays of numbers, or images.
_MAP_FORMS = ("numbers", "images")


@dataclass(frozen=True)
class EnrichJob:
    """One run: recordings, plan, output, and rows to compute."""

    out: Path
    scenes: Sequence[Scene]
    whole: plan.ExtractionPlan
    views: dict[str, DatasetCamera]
    target: DatasetTarget
    shared: Row
    rows: MapRowDataset
    notes: Sequence[str] = ()

    @property
    def waiting(self) -> Path:
        """The folder of the shards."""
        return self.out / PRIVATE_FOLDER / "shards"


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """``dhtorch enrich``: write the missing episodes of ``out``, then the metadata of the data set.

    Args:
        settings: the options of ``conf/enrich.yaml``, resolved, with ``choices``.
        parts: ``data`` and ``method``, as objects.
        progress: wraps the loop over frames: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data, an output folder with other files or inside the source, a
            full disk.
        KeyboardInterrupt: Ctrl-C; complete episodes are kept.
    """
    import_optional("pyarrow.parquet")
    _check_options(settings)
    work = _plan_job(settings, parts)
    rest = "complete episodes are kept; run the same command again for the rest"
    try:
        with open_output_folder(work.out, "out") as folder:
            before, owns, complaints = _write_missing_episodes(work, folder, settings, progress)
            if isinstance(work.target, LeRobotTarget):
                enrich_page.write_enrich_card(work.target, work.shared, owns)
            if settings["report"]:
                enrich_page.write_enrich_page(work.out / "meta", work.shared, owns)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"complete episodes in {work.out} are kept; run the same command again for the rest"
        ) from None
    except OSError as error:
        if error.errno not in _DISK_FULL_ERRNOS:
            raise
        raise OSError(error.errno, f"{error.strerror}: {error.filename or work.out}; {rest}") from None
    print("\n".join(_format_summary(work, owns, before, complaints)))
    return 0


def _write_missing_episodes(
    work: EnrichJob, folder: OutputFolder, settings: Mapping[str, Any], progress: Progress
) -> tuple[int, list[Row], list[str]]:
    """Write the missing episodes -> number of episodes complete before, statistics of all, unreadable frames."""
    of_episode = _group_by_episode(work.whole)
    owns = [work.target.own(k) for k in range(len(of_episode))]
    before = sum(own is not None for own in owns)
    every = work.whole.shards(settings["shard_rows"], apart=True)
    # Prepare the output folder for the episodes ``missing``
    missing = [k for k, own in enumerate(owns) if own is None]
    metadata_file = work.out / "meta" / METADATA_FILE
    result_files.check_same_run(work.out, metadata_file, work.shared, "enrich")
    if folder.is_unlisted and metadata_file.is_file():  # of an older version
        folder.adopt(work.out.rglob("*"))
    folder.check_folders([work.waiting])
    card = [work.out / enrich_page.CARD] if isinstance(work.target, LeRobotTarget) else []
    folder.check([*work.target.planned_files(missing), *card, *enrich_page.page_files(work.out / "meta")])
    if not metadata_file.is_file():
        storage.write_json(metadata_file, work.shared)
    work.waiting.mkdir(exist_ok=True)
    done = shards.find_finished_shards(work.waiting, work.shared)
    todo = {k: _group_shards(every, work.whole, of_episode[k]) for k, own in enumerate(owns) if own is None}
    pieces = [piece for each in todo.values() for files in each.values() for piece in files if piece.name not in done]
    positions = [position for piece in pieces for position in piece.rows]
    complaints: list[str] = []
    engine = engines.run_engine(
        settings["engine"], work.rows, positions, workers=settings["workers"], address=settings["address"]
    )
    with closing(progress(engine, format_count(len(work.whole), "frame"), len(positions))) as answers:  # type: ignore[type-var]
        for k, each in todo.items():
            for piece in (piece for files in each.values() for piece in files if piece.name not in done):
                answered = islice(answers, len(piece.rows))
                kept = engines.filter_rows(answered, settings["on_error"], work.rows, complaints, "on_error=flag")
                shards.write_shard(work.waiting, piece, kept, work.rows.wanted, work.shared)
            files = {
                camera_key(work.scenes[work.whole.order[n]].recording): [work.waiting / p.name for p in own_pieces]
                for n, own_pieces in each.items()
            }
            owns[k] = work.target.assemble(k, [own for own in owns[:k] if own is not None], files)
            for path in (path for paths in files.values() for path in paths):
                path.unlink(missing_ok=True)
    every_own = [own for own in owns if own is not None]
    work.target.finish(every_own)
    shutil.rmtree(work.waiting, ignore_errors=True)
    return before, every_own, complaints


def _plan_job(settings: Mapping[str, Any], parts: Mapping[str, Any]) -> EnrichJob:
    scenes = scenes_of(parts["data"])
    if settings["every"] > 1 and scenes[0].recording.format in ("lerobot", "rlds"):
        kept = f"with a {scenes[0].recording.format} set, all of whose rows are kept"
        raise ValueError(f"every: found {settings['every']} {kept}; expected 1 (max_frames=N limits them)")
    scenes = cut.subsample_scenes(scenes, settings["every"], settings["max_frames"])
    method = with_sensor(parts["method"], settings["sensor"])
    whole = plan.make_plan(scenes, settings["gap"], method.views, rigs=True)
    out = Path(str(settings["out"])).expanduser()
    for root in whole.roots:
        if out.resolve().is_relative_to(root.resolve()) or (root.is_file() and out.resolve() == root.resolve()):
            raise ValueError(
                f"out: found {out} inside the source {root}, which is never written to; expected another folder"
            )
    sweep_options = dense.dense_options(settings["dense"], "dense")
    first = [scenes[whole.order[n]] for n in _group_by_episode(whole)[0]]
    size = _SAMPLED_MAP_SIDE_PX if sweep_options is None else sweep_options["size"]
    views = {v.key: v for v in (DatasetCamera.of(scene, size) for scene in first)}
    _check_views(settings, first, views)
    format = _resolve_format(settings["format"], first)
    inputs = scenes, whole, views
    origin = None if _OUTPUT_FORMATS[format] is None else _open_origin(settings, inputs)
    wanted = map_columns(pictures=origin is None, n=method.n)
    shared = _build_metadata(settings, whole, wanted)
    shared["data"]["notes"] = list(dict.fromkeys(line for scene in first for line in scene.recording.report))
    rows = MapRowDataset(
        scenes,
        whole,
        wanted,
        method=method,
        gap=settings["gap"],
        past=settings["causal"],
        beside=settings["cameras"],
        step=settings["step"],
        views=views,
        seed=settings["seed"],
        dense=settings["dense"],
        budget="cause" in settings["columns"],
        **_pose_options(settings),
    )
    target = _open_target(settings, inputs, out, format, shared["key"], origin, n=method.n)
    notes = []
    if _OUTPUT_FORMATS[format] is not None and settings["fps"] is None and not has_frame_rate(first[0].recording):
        notes.append(f"frame rate unknown: time stamps assume {DEFAULT_FPS:g} frames per second (set fps=N)")
    return EnrichJob(
        out=out, scenes=scenes, whole=whole, views=views, target=target, shared=shared, rows=rows, notes=notes
    )


def _check_views(settings: Mapping[str, Any], first: Sequence[Scene], views: Mapping[str, DatasetCamera]) -> None:
    """Validate the cameras of an episode against the options; raises ValueError."""
    names = ", ".join(scene.name for scene in first)
    if len(views) < len(first):
        raise ValueError(f"data: found several recordings of one camera in one episode ({names}), expected one each")
    if any(isinstance(scene.recording, Rig) for scene in first):
        raise ValueError(
            f"data: found a rig ({names}), expected its cameras as separate recordings (cameras=true combines them)"
        )
    sizes = {view.hw for view in views.values()}
    if settings["cameras"] and (len(views) < 2 or len(sizes) > 1 or settings["gap"] != plan.AUTO_GAP):
        seen = " and ".join(f"{w}x{h}" for h, w in sorted(sizes))
        actual = f"{len(views)} of {seen} pixels, gap={settings['gap']}"
        raise ValueError(
            f"cameras: found {actual}, expected two or more cameras of one image size in an episode, and gap=auto"
        )
    unposed = [view.name for view in views.values() if not view.posed]
    if settings["pose"] != "near" and unposed:
        raise ValueError(f"pose: found no poses of {', '.join(unposed)}, expected a recording with poses, or pose=near")


def _pose_options(settings: Mapping[str, Any]) -> Row:
    """The pose options of :class:`dhtorch.transforms.ExtendDepth`."""
    if settings["pose"] == "near":
        return {}
    return {"pose": "pose", "pose_cov": settings["pose_sigma"], "refine": settings["pose"] == "start"}


def _open_origin(
    settings: Mapping[str, Any], inputs: tuple[Sequence[Scene], plan.ExtractionPlan, dict[str, DatasetCamera]]
) -> DatasetSource | None:
    """The source data set of the recordings where it has columns to copy (LeRobot, RLDS), else None."""
    scenes, whole, _ = inputs
    groups = _group_by_episode(whole)
    recording, numbers = scenes[whole.order[0]].recording, [whole.episodes[group[0]] for group in groups]
    if recording.format == "lerobot" and recording.root is not None:
        return LeRobotSource.open(recording.root, numbers, limit=settings["max_frames"], bounds=recording.bounds)
    if recording.format == "rlds":
        each = cut.SelectedRecordings(scenes, tuple(whole.order[group[0]] for group in groups))
        return RldsSource(each, numbers, settings["fps"] or frame_rate(recording), settings["max_frames"])
    return None


def _open_target(
    settings: Mapping[str, Any],
    inputs: tuple[Sequence[Scene], plan.ExtractionPlan, dict[str, DatasetCamera]],
    out: Path,
    format: str,
    key: str,
    origin: DatasetSource | None,
    *,
    n: int,
) -> DatasetTarget:
    scenes, whole, views = inputs
    version, of_episode = _OUTPUT_FORMATS[format], _group_by_episode(whole)
    if version is None:
        unposed = [v.name for v in views.values() if not v.posed]
        if unposed:
            raise ValueError(
                f"format=nerfstudio: found no poses of {', '.join(unposed)}, expected a recording with poses"
            )
        return NerfstudioTarget(out, views, _name_folders(scenes, whole, of_episode), key)
    recording = scenes[whole.order[0]].recording
    fps = frame_rate(recording) if origin is None else origin.fps
    return LeRobotTarget(
        out,
        version,
        views,
        origin=origin,
        numbers=[whole.episodes[group[0]] for group in of_episode],
        step=settings["step"],
        maps=settings["columns"],
        as_images=settings["maps"] == "images",
        fps=settings["fps"] or fps,
        task=settings["task"],
        key=key,
        n=n,
        cut=settings["max_frames"] is not None,
    )


def _name_folders(
    scenes: Sequence[Scene], whole: plan.ExtractionPlan, groups: Sequence[Sequence[int]]
) -> list[dict[str, str]]:
    """Folder name of each recording, by episode and then by camera; empty for a single recording."""
    names_by_episode: list[dict[str, str]] = []
    seen: set[str] = set()
    for group in groups:
        names = {}
        for n in group:
            scene = scenes[whole.order[n]]
            parts = [part for part in PurePosixPath(f"/{scene.name}").parts[1:] if part != ".."]
            names[camera_key(scene.recording)] = name = "" if len(whole.order) == 1 else "/".join(parts)
            if name in seen:
                raise ValueError(f"data: found two recordings called {name}, expected different names")
            seen.add(name)
        names_by_episode.append(names)
    return names_by_episode


def _resolve_format(requested: str, first: Sequence[Scene]) -> str:
    """The output format; ``same`` is resolved to that of the source.

    Raises:
        ValueError: ``same`` with a source format that cannot be written.
    """
    if requested != "same":
        return requested
    kind, root = first[0].recording.format, first[0].root
    if kind == "nerfstudio":
        return kind
    if kind != "lerobot" or root is None:
        raise ValueError(
            f"format=same: found {kind}, which dhtorch cannot write; expected {', '.join(_OUTPUT_FORMATS)}"
        )
    return "v2.1" if LeRobotSource.open(root, [first[0].recording.episode or 0]).meta.version == 2 else "lerobot"


def _build_metadata(
    settings: Mapping[str, Any], whole: plan.ExtractionPlan, wanted: Mapping[str, columns.Column]
) -> Row:
    """Metadata shared by all files of the data set, with their key."""
    config = {k: settings[k] for k in _KEY_OPTIONS}
    files: dict[str, Path | str] = {
        **result_files.list_files_below(whole.roots.items()),
        **result_files.list_files_named({k: settings[k] for k in ("data", "method")}),
    }
    digest = result_files.compute_data_digest(files)
    run_metadata = result_files.collect_run_metadata(
        device="cpu", dtype="float32", threads=1, seed=settings["seed"], operators=loader.describe_operators()
    )
    name = settings["choices"]["data"]
    source = next((root.resolve().name for root in whole.roots), name)
    metadata: Row = storage.to_strict_json(
        {
            "format": _FORMAT_VERSION,
            "version": run_metadata["versions"]["dhtorch"],
            "git": run_metadata["git"],
            "operators": run_metadata["operators"],
            "key": result_files.compute_result_key(
                {**config, "name": name, "files": _FORMAT_VERSION}, digest, roots=[MapRowDataset.__module__]
            ),
            "config": result_files.make_portable(config),
            "method": settings["choices"]["method"],
            "data": {"name": name, "source": source, "digest": digest, "frames": len(whole)},
            "step_m": settings["step"],
            "columns": {k: c._asdict() for k, c in wanted.items()},
            "codes": {
                **columns.code_tables(),
                "no_answer": NO_ANSWER_REASONS,
            },
        }
    )
    return metadata


def _group_by_episode(whole: plan.ExtractionPlan) -> list[list[int]]:
    """Positions of the recordings in the plan, grouped by episode."""
    groups: dict[int, list[int]] = {}
    for n, number in enumerate(whole.episodes):
        groups.setdefault(number, []).append(n)
    return list(groups.values())


def _group_shards(
    every: Sequence[plan.ShardSpec], whole: plan.ExtractionPlan, group: Sequence[int]
) -> dict[int, list[plan.ShardSpec]]:
    """Position of a recording in the plan → its shards."""
    spans = whole.spans
    return {n: [p for p in every if spans[n].start <= p.rows.start < spans[n].stop] for n in group}


# ------------------------------------------------------------------------------------------------------------- summary


def _format_summary(work: EnrichJob, owns: Sequence[Row], n_untouched: int, complaints: Sequence[str]) -> list[str]:
    """The whole in words."""
    files = result_files.list_files_below([(work.out, work.out)]).values()
    size = sum(path.stat().st_size for path in files if isinstance(path, Path))
    frames = sum(own["length"] for own in owns)
    kept = f" ({n_untouched} left untouched)" if n_untouched else ""
    lines = [
        f"{work.out}: {format_count(len(owns), 'episode')}{kept}, {format_count(frames, 'frame')}, {size / 1e6:.1f} MB"
    ]
    for camera in enrich_page.summarise_cameras(owns):
        kinds = ", ".join(f"{words(kind)} {fraction}" for kind, fraction in camera.format_kinds().items())
        breakdown = ", ".join(f"{words(gate)} {share:.1%}" for gate, share in camera.reasons.items())
        lines.append(f"  {camera.name}: {kinds}" + (f" ({breakdown})" if breakdown else ""))
    lines += [f"  {line}" for line in (*enrich_page.describe_refuted_poses(owns), *work.notes)]
    lines += [f"  {complaint}" for complaint in complaints[:_MAX_COMPLAINTS]]
    lines += [f"  and {len(complaints) - _MAX_COMPLAINTS} more frames"] if len(complaints) > _MAX_COMPLAINTS else []
    return lines


def _check_options(settings: Mapping[str, Any]) -> None:
    """Validate options that would otherwise fail late."""
    choices_of = {
        "format": (*_OUTPUT_FORMATS, "same"),
        "engine": engines.ENGINES,
        "on_error": ("raise", "flag"),
        "pose": _POSE_SOURCES,
        "maps": _MAP_FORMS,
    }
    validate_choices(settings, choices_of)
    wanted = settings["columns"]
    known = (*MAP_FILES, *POLICY_COLUMNS)
    if not isinstance(wanted, Sequence) or isinstance(wanted, str) or not {"depth"} <= {*wanted} <= {*known}:
        raise ValueError(f"columns: found {wanted!r}, expected depth and any of {', '.join(known)}, as a list")
    if settings["format"] == "nerfstudio" and {*wanted} & {*POLICY_COLUMNS, "cause"}:
        more = ", ".join(name for name in (*POLICY_COLUMNS, "cause") if name in wanted)
        raise ValueError(f"columns: found {more} with format=nerfstudio, expected a LeRobot format")
    if settings["pose_sigma"] is not None and settings["pose"] == "near":
        raise ValueError(f"pose_sigma: found {settings['pose_sigma']} with pose=near, expected pose=device or start")
    poses.parse_pose_sigmas(settings["pose_sigma"], "pose_sigma")
