"""``dhtorch enrich SRC DST``: data set -> data set with depth, sigma and camera columns for every image.

Depth maps are computed in shards, as in ``dhtorch extract``; once all shards of an episode exist, the episode is
written and its shards are removed. Complete episodes are kept: a second run writes the missing ones, byte for byte as
one run would have.

A report (pixels by camera, over time and by episode) and the card of a LeRobot set are written with it: ``README.md``
with the tags of the Hugging Face hub, the cameras with their intrinsics, where their depth comes from and how exact it
is, versions, the licence of the source, and how the set is loaded and trained on. The source's own card is kept as
``README.source.md``.
"""

import errno
import math
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from operator import add
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from dhtorch.cli.gate_messages import describe_gate
from dhtorch.cli.option_checks import validate_choices
from dhtorch.codes import SOURCES_OF_KIND, Gate, Source, count_kinds, names, words
from dhtorch.data.io import decode as data_files
from dhtorch.data.io.decode import import_optional
from dhtorch.data.rig import Rig
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.experiments.report.figures import Figure
from dhtorch.experiments.report.page import PAGE_CSS, figures_markup, table_markup
from dhtorch.experiments.report.tables import ReportTable
from dhtorch.export.lerobot import LogHistogram
from dhtorch.extract import columns, cut, engines, plan, shards
from dhtorch.extract.enriched import (
    MAP_FILES,
    NO_ANSWER_REASONS,
    NO_OTHER_VIEW,
    DatasetCamera,
    MapRowDataset,
    camera_key,
    map_columns,
)
from dhtorch.extract.nerf_target import NerfstudioTarget
from dhtorch.extract.origin import (
    DEFAULT_FPS,
    METADATA_FILE,
    REPORT_FILES,
    SOURCE_CARD,
    DatasetSource,
    LeRobotSource,
    frame_rate,
    has_frame_rate,
)
from dhtorch.extract.policy_columns import N_POINTS, POLICY_COLUMNS
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.step_set import RldsSource
from dhtorch.extract.targets import UNKNOWN_CONVENTION, DatasetTarget
from dhtorch.ops import loader
from dhtorch.pipeline import dense
from dhtorch.pipeline.presets import with_sensor
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, OutputFolder, open_output_folder
from dhtorch.transforms import poses
from dhtorch.viz.plots import add_legend, make_figure, set_axis, set_title
from dhtorch.viz.plots.colours import FILLED, GATE_COLOURS, RECOVERED, SENSOR, SOFT, UNANSWERED
from dhtorch.viz.plots.markup import build_document, make_tag

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
class _EnrichJob:
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
                _write_enrich_card(work.target, work.shared, owns)
            if settings["report"]:
                _write_enrich_page(work.out / "meta", work.shared, owns)
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
    work: _EnrichJob, folder: OutputFolder, settings: Mapping[str, Any], progress: Progress
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
    card = [work.out / CARD] if isinstance(work.target, LeRobotTarget) else []
    folder.check([*work.target.planned_files(missing), *card, *_page_files(work.out / "meta")])
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


def _plan_job(settings: Mapping[str, Any], parts: Mapping[str, Any]) -> _EnrichJob:
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
    return _EnrichJob(
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


def _format_summary(work: _EnrichJob, owns: Sequence[Row], n_untouched: int, complaints: Sequence[str]) -> list[str]:
    """The whole in words."""
    files = result_files.list_files_below([(work.out, work.out)]).values()
    size = sum(path.stat().st_size for path in files if isinstance(path, Path))
    frames = sum(own["length"] for own in owns)
    kept = f" ({n_untouched} left untouched)" if n_untouched else ""
    lines = [
        f"{work.out}: {format_count(len(owns), 'episode')}{kept}, {format_count(frames, 'frame')}, {size / 1e6:.1f} MB"
    ]
    for camera in _summarise_cameras(owns):
        kinds = ", ".join(f"{words(kind)} {fraction}" for kind, fraction in camera.format_kinds().items())
        breakdown = ", ".join(f"{words(gate)} {share:.1%}" for gate, share in camera.reasons.items())
        lines.append(f"  {camera.name}: {kinds}" + (f" ({breakdown})" if breakdown else ""))
    lines += [f"  {line}" for line in (*describe_refuted_poses(owns), *work.notes)]
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


# ------------------------------------------------------------------------------------------------------- report

#: Episodes listed, those with least depth first.
_MAX_LISTED_EPISODES = 10

#: Reasons for missing answers drawn in the figure, the most frequent first.
_MAX_DRAWN_REASONS = 4

#: Smallest fraction of the pixels of a reason that is listed.
_MIN_REASON_SHARE = 5e-4

_REASON_COLOURS = {**GATE_COLOURS, NO_OTHER_VIEW: SOFT}
_KIND_COLOURS = {"recovered": RECOVERED, "filled": FILLED, "sensor": SENSOR, "no_answer": UNANSWERED}


class _CameraSummary(NamedTuple):
    """Outcome of the pixels of one camera."""

    name: str
    kinds: dict[str, float]  # fractions of the pixels by kind, see codes.SOURCES_OF_KIND
    reasons: dict[str, float]  # fractions of the pixels without an answer by gate, the largest first
    sigma_rel: float  # median sigma / depth of the recovered pixels; NaN = none

    def format_kinds(self) -> dict[str, str]:
        """The fractions as text, with the median sigma of the recovered pixels."""
        shown = {kind: f"{fraction:.1%}" for kind, fraction in self.kinds.items()}
        if self.kinds["recovered"] and math.isfinite(self.sigma_rel):
            shown["recovered"] += f" (median sigma {self.sigma_rel:.1%} of the depth)"
        return shown


def _summarise_cameras(owns: Sequence[Row]) -> list[_CameraSummary]:
    """Outcome of the pixels per camera."""
    summaries = []
    for name in _list_cameras(owns):
        rows = [own["cameras"][name] for own in owns if name in own["cameras"]]
        bins = [LogHistogram.parse(row["recovered_sigma_rel_bins"]) for row in rows]
        summaries.append(_CameraSummary(name, *_pixel_shares(rows), reduce(add, bins).quantile(0.5)))
    return summaries


def describe_refuted_poses(owns: Sequence[Row]) -> list[str]:
    """One sentence per camera whose input poses contradict the near returns: number of frames, likely convention."""
    sentences = []
    for name in _list_cameras(owns):
        cameras = [own["cameras"][name] for own in owns if name in own["cameras"]]
        refuted = sum((Counter(camera["refuted"]) for camera in cameras), Counter())
        if refuted:
            frames = f"{refuted.total()} of {format_count(sum(camera['frames'] for camera in cameras), 'frame')}"
            known = {reading: n for reading, n in refuted.items() if reading != UNKNOWN_CONVENTION}
            fits = " or ".join(f"{reading} ({n})" if len(refuted) > 1 else reading for reading, n in known.items())
            end = f"they fit as {fits}" if known else "no known convention fits"
            sentences.append(f"{name}: the input poses contradict the near returns in {frames}; {end}")
    return sentences


def _page_files(folder: Path) -> tuple[Path, Path]:
    """The files that :func:`_write_enrich_page` writes: numbers and page."""
    numbers, page = REPORT_FILES
    return folder / numbers, folder / page


def _write_enrich_page(folder: Path, about: Row, owns: Sequence[Row]) -> Path:
    """Write the page and its numbers as JSON; returns the path of the page."""
    listed = [{k: own[k] for k in ("number", "length", "cameras")} for own in owns]
    codes = {"pixels": names(Source), "no_answer": NO_ANSWER_REASONS}
    numbers, page = _page_files(folder)
    storage.write_json(numbers, {"data": about["data"], "codes": codes, "episodes": listed})
    # The page as HTML
    title = f"{about['data']['source']}: outcome of its pixels"
    frames = sum(own["length"] for own in owns)
    step = f"depth in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "depth not quantised"
    episodes = f"{format_count(len(owns), 'episode')}, {format_count(frames, 'frame')}"
    lead = f"{episodes}; {step}; dhtorch {about['version']}, method {about['method']}"
    rows = []
    for camera in _summarise_cameras(owns):
        breakdown = "; ".join(f"{describe_gate(gate)} {share:.1%}" for gate, share in camera.reasons.items())
        rows.append([camera.name, breakdown or "—", *camera.format_kinds().values()])
    head = ["camera", "no answer because", *map(words, SOURCES_OF_KIND)]
    tables = (
        ReportTable("Pixels by camera", head, rows, n_label=2),
        _build_refuted_table(owns),
        _build_worst_table(owns),
    )
    parts = [
        *(table_markup(table) for table in tables if table.rows),
        figures_markup([f for f in (_build_time_figure(owns), _build_reason_figure(owns)) if f is not None]),
    ]
    top = make_tag("header", make_tag("h1", title), make_tag("p", lead, class_="lead"))
    return storage.replace_file(
        page, build_document(title, top, make_tag("main", *parts), own=PAGE_CSS).encode("utf-8")
    )


def _pixel_shares(cameras: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    readable = [c for c in cameras if c["pixels"]]
    if not readable:
        return dict.fromkeys(SOURCES_OF_KIND, 0.0) | {"no_answer": 1.0}, {}
    pixels = np.sum([np.array(c["pixels"], float) for c in readable], 0)
    no_answer = np.sum([np.array(c["no_answer"], float) for c in readable], 0)
    total = max(1.0, float(np.sum(pixels)))
    kinds = {kind: float(n) / total for kind, n in count_kinds(pixels).items()}
    gates = {name: float(no_answer[code]) / total for code, name in NO_ANSWER_REASONS.items() if code != Gate.ANSWER}
    return kinds, {
        name: share for name, share in sorted(gates.items(), key=lambda x: -x[1]) if share >= _MIN_REASON_SHARE
    }


def _list_cameras(owns: Sequence[Row]) -> list[str]:
    """Names of all cameras, in order of appearance."""
    return list(dict.fromkeys(name for own in owns for name in own["cameras"]))


def _build_refuted_table(owns: Sequence[Row]) -> ReportTable:
    """Table of episodes and cameras whose input poses contradict the near returns."""
    rows = [
        [
            str(own["number"]),
            name,
            "; ".join(camera["refuted"]),
            f"{sum(camera['refuted'].values())}",
            f"{camera['frames']}",
        ]
        for own in owns
        for name, camera in own["cameras"].items()
        if camera["refuted"]
    ]
    rows = sorted(rows, key=lambda row: -int(row[3]) / int(row[4]))[:_MAX_LISTED_EPISODES]
    note = "Check the axes, the direction (camera to world or back) and the unit of the poses." if rows else ""
    head = ["episode", "camera", "they fit as", "frames", "of"]
    return ReportTable("Input poses that contradict the near returns", head, rows, n_label=3, note=note)


def _build_worst_table(owns: Sequence[Row]) -> ReportTable:
    cameras_by_episode = []
    for own in owns:
        for name, camera in own["cameras"].items():
            kinds, reasons = _pixel_shares([camera])
            cameras_by_episode.append((kinds["no_answer"], own["number"], name, kinds, reasons, camera["unread"]))
    rows = []
    for _, number, name, kinds, reasons, unread in sorted(cameras_by_episode, key=lambda x: (-x[0], x[1], x[2]))[
        :_MAX_LISTED_EPISODES
    ]:
        reason = next((describe_gate(gate) for gate in reasons), "—")
        rows.append([str(number), name, reason, *(f"{share:.1%}" for share in kinds.values()), str(unread)])
    head = ["episode", "camera", "most frequent reason for no answer", *map(words, SOURCES_OF_KIND), "frames not read"]
    return ReportTable("Episodes with least depth first", head, rows, n_label=3)


def _build_time_figure(owns: Sequence[Row]) -> Figure | None:
    """Fractions of pixels by kind over episode time, averaged over the episodes."""
    kinds = {name: count_kinds(mean) for name, mean in _average_over_episodes(owns, "over_time")}
    curves = {name: {words(kind): values for kind, values in of.items()} for name, of in kinds.items()}
    colours = {words(kind): colour for kind, colour in _KIND_COLOURS.items()}
    return _draw_over_time("Over time", "Mean over the episodes, by camera.", curves, colours)


def _build_reason_figure(owns: Sequence[Row]) -> Figure | None:
    """Most frequent reasons for missing answers over episode time."""
    averages = _average_over_episodes(owns, "no_answer_over_time")
    gates = [gate for gate in _REASON_COLOURS if any(mean[gate].max() > 0 for _, mean in averages)]
    gates = sorted(gates, key=lambda gate: -max(float(mean[gate].mean()) for _, mean in averages))[:_MAX_DRAWN_REASONS]
    reasons = {gate: describe_gate(NO_ANSWER_REASONS[gate]) for gate in gates}
    curves = {name: {reasons[gate]: mean[gate] for gate in gates} for name, mean in averages if gates}
    colours = {reasons[gate]: _REASON_COLOURS[gate] for gate in gates}
    return _draw_over_time("Reasons for no answer over time", "Fraction of all pixels, by camera.", curves, colours)


def _draw_over_time(
    title: str, caption: str, curves: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]
) -> Figure | None:
    """Figure of fractions of the pixels over episode time: camera → name → values; None without cameras."""
    if not curves:
        return None
    figure, panels = make_figure(len(curves))
    for axes, (camera, of_camera) in zip(panels, curves.items(), strict=True):
        for name, values in of_camera.items():
            axes.plot(np.linspace(0, 1, len(values)), values, color=colours[name], linewidth=1.8)
        for axis, label in (("x", "time in the episode, %"), ("y", "pixels, %")):
            set_axis(axes, axis, label, percent=True, limits=(0.0, 1.0))
        set_title(axes, camera)
    add_legend(figure, {name: {"color": colour, "linewidth": 1.8} for name, colour in colours.items()})
    return Figure(title, caption, figure)


def _average_over_episodes(owns: Sequence[Row], column: str) -> list[tuple[str, np.ndarray]]:
    """Per camera: name and a column over time (parts, codes), averaged over the episodes; needs at least two parts."""
    averages = []
    for name in _list_cameras(owns):
        shares = [np.array(own["cameras"][name][column]) for own in owns if name in own["cameras"]]
        longest = max((len(x) for x in shares if len(x)), default=0)
        if longest < 2:
            continue
        times = np.linspace(0, 1, longest)
        resampled = [
            [np.interp(times, np.linspace(0, 1, len(x)), x[:, c]) for c in range(x.shape[1])] for x in shares if len(x)
        ]
        averages.append((name, np.mean(resampled, 0)))
    return averages


# ------------------------------------------------------------------------------------------------------ data set card

#: Name of the card.
CARD = "README.md"

#: ``license:`` in the head of a card, as the hub writes identifiers of licences.
_LICENCE = re.compile(r"\A---\n(?:.*\n)*?license:[ \t]*[\"']?([A-Za-z0-9][A-Za-z0-9.\-]{0,40})[\"']?[ \t]*\n")


def _write_enrich_card(target: LeRobotTarget, about: Mapping[str, Any], owns: Sequence[Row]) -> Path:
    """Write the card of a complete set; ``about``: metadata of all files, ``owns``: summaries of all episodes."""
    info, stats = (data_files.read_json(target.root / "meta" / name) for name in ("info.json", "stats.json"))
    card = target.root / SOURCE_CARD
    stated = _LICENCE.match(data_files.read_text(card).replace("\r\n", "\n")) if card.is_file() else None
    licence = None if stated is None else stated[1]
    source, name = (re.sub(r"[\s|`<>]+", " ", str(about["data"][key])).strip() for key in ("source", "name"))
    size = f"{format_count(info['total_episodes'], 'episode')}, {format_count(info['total_frames'], 'frame')}"
    size += f" at {info['fps']:g} per second"
    writer = f"dhtorch {about['version']} (`dhtorch enrich`, method {about['method']})"
    known = f"`{licence}`, by its card (`{SOURCE_CARD}`)" if licence else "not stated by the source"
    columns = [
        "camera",
        "picture",
        "map",
        "fx, fy, cx, cy (px)",
        *map(words, SOURCES_OF_KIND),
        "depth (m)",
        "sigma (m)",
    ]
    rows = []
    cameras = {camera.name: camera for camera in _summarise_cameras(owns)}
    parquet = import_optional("pyarrow.parquet")
    present = set(parquet.read_schema(target.file(0)).names)
    for key, view in target.views.items():
        # fx, fy, cx, cy of the first row that has them
        lens, column = "unknown", f"observation.{view.name}.intrinsics"
        if column in present:
            K = np.array(parquet.read_table(target.file(0), columns=[column]).column(column).to_pylist(), np.float64)
            valid = K[np.isfinite(K).all(1)] if K.ndim == 2 and K.shape[1] == 9 else K[:0]
            lens = ", ".join(f"{x:.1f}" for x in valid[0][[0, 4, 2, 5]]) if len(valid) else lens
        camera = cameras.get(view.name)
        percent = ["0.0%"] * len(SOURCES_OF_KIND) if camera is None else camera.format_kinds().values()
        depth, sigma = (stats.get(target.keys[key].get(name, "")) for name in ("depth", "sigma"))
        span = typical = "–"
        if camera is not None and camera.kinds["no_answer"] != 1 and depth is not None:
            span = "–".join(f"{float(np.ravel(depth[quantile])[0]):.2f}" for quantile in ("q01", "q99"))
            typical = "–" if sigma is None else f"{float(np.ravel(sigma['q50'])[0]):.4f}"
        rows.append([f"`{key}`", *(f"{w}×{h}" for h, w in (view.hw, view.map_hw)), lens, *percent, span, typical])
    head, *table = (f"| {' | '.join(row)} |" for row in (columns, *rows))
    keys = target.keys[next(iter(target.views))]
    lines = ["---", *([f"license: {licence}"] if licence else []), "task_categories:", "- robotics", "tags:"]
    lines += ["- LeRobot", "- depth", "- dhtorch", "configs:", "- config_name: default"]
    lines += ["  data_files: data/*/*.parquet", "---", "", f"# {name} with depth", ""]
    lines += [f"LeRobot {info['codebase_version']} set, written from `{source}` by {writer}: {size}.", ""]
    lines += ["## Cameras", "", head, "|---" * len(columns) + "|", *table, ""]
    lines += [*_describe_maps(target, keys, about, info), "", "## Licence", ""]
    lines += [f"Pictures, states and actions are the source's: {known}.", "", "## Loading", "", "```python"]
    lines += ["from lerobot.datasets.lerobot_dataset import LeRobotDataset", ""]
    lines += ['dataset = LeRobotDataset("local/set", root="THIS_FOLDER")']
    lines += [f'depth = dataset[0]["{keys["depth"]}"]  # (1, h, w)', "```"]
    if {"action", "observation.state"} <= info["features"].keys() and not target.as_images:
        train = "lerobot-train --dataset.repo_id=local/set --dataset.root=THIS_FOLDER --policy.type=act"
        lines += ["", "```bash", f"{train} --policy.push_to_hub=false", "```"]
    return storage.replace_file(target.root / CARD, "\n".join([*lines, ""]).encode("utf-8"))


def _describe_maps(
    target: LeRobotTarget, keys: Mapping[str, str], about: Mapping[str, Any], info: Mapping[str, Any]
) -> list[str]:
    """Sentences on the columns of a camera."""
    step = f"in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "not quantised"
    form = "32-bit TIFF" if target.as_images else "an array of numbers (1, h, w)"
    codes = ", ".join(f"{code} {name.lower()}" for code, name in names(Source).items())
    stated = info["features"].get(keys.get("geometry_image"), {}).get("info", {})
    video = f"{stated.get('video.codec')}, {stated.get('video.pix_fmt')}"
    decoding = stated.get("geometry_image") or dict.fromkeys(("depth_m", "sigma_m", "source", "function"))
    texts = {
        "depth": f"""is {form} in metres, {step}; **0 = no depth**, which is no distance: mask it
before depth is normalised. Statistics in `meta/stats.json` are over answered pixels, their range holds the
values from the 1 % to the 99 % quantile, as the depths of the table do; its sigma is the median.""",
        "sigma": "is the standard deviation of the depth, in metres.",
        "source": f"is where a depth comes from: {codes}.",
        "geometry_image": f"""is a video without loss ({video}) of bytes that decode as
`depth_m = {decoding["depth_m"]}`,
`sigma_m = {decoding["sigma_m"]}`,
`source = {decoding["source"]}` (`{decoding["function"]}`);
encoded again with loss, its depth is no longer exact to half a code.""",
        "point_cloud": f"""is {N_POINTS} points (x right, y down, z forward) in metres
of the camera, by pixels with a depth in a fixed order; they repeat where there are fewer, and are
all 0 in a frame without depth. Its first points are a smaller cloud of the whole picture.""",
        "K": "is K of the picture by rows; pixel centres are whole numbers.",
    }
    return [f"`{keys[key]}` {text}" for key, text in texts.items() if key in keys]
