"""The ``dhtorch`` command: Hydra turns names into functions, everything else happens in the library.

A first word that names a sub-command goes to that module, which reads its own arguments or is handed what the settings
of that name compose to; anything else is a list of Hydra overrides for experiments. Each of their jobs has a folder of
its own, named by its overrides inside a sweep, and reports how it ended instead of raising: one failing job stops no
other, whichever launcher runs them.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import logging
import math
import multiprocessing
import os
import re
import shlex
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import dhtorch
from dhtorch.cli import errors, signals
from dhtorch.cli import option_checks as words
from dhtorch.cli import sweep_state as together
from dhtorch.cli.option_checks import quote_value
from dhtorch.runtime import console, file_lock, parent_watch
from dhtorch.runtime.allocator import disable_malloc_trim

#: Sub-command → module with ``main(argv) -> int``.
_COMMANDS = {"inspect": "dhtorch.cli.inspect", "report": "dhtorch.experiments.report"}

#: Sub-command with settings of its own, ``conf/<word>.yaml`` → module with ``run(settings, parts, *, progress)``, which
#: is given all options as plain values, and as objects those that name a function. It returns the exit code.
_CONFIGURED_COMMANDS = {
    "anchor": "dhtorch.cli.align",
    "complete": "dhtorch.cli.complete",
    "enrich": "dhtorch.cli.enrich",
    "extract": "dhtorch.extract",
    "integrate": "dhtorch.integrate.mapping",
    "judge": "dhtorch.cli.validate",
    "recover": "dhtorch.cli.process_capture",
    "stream": "dhtorch.cli.stream",
    "view": "dhtorch.cli.view",
}

#: Sub-command → the options that its first words without a name set.
_POSITIONAL_OPTIONS = {
    "anchor": ("data.root",),
    "complete": ("data.root",),
    "enrich": ("data.root", "out"),
    "judge": ("data.root",),
    "recover": ("path",),
    "stream": ("data.root",),
    "view": ("result",),
}

EXIT_DONE, EXIT_SOME_FAILED, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 0, 1, 2, 130, 141
EXIT_SIGHUP, EXIT_SIGTERM = 129, 143

#: Exit codes, as ``dhtorch --help`` lists them.
EXIT_CODES = {
    EXIT_DONE: "all done or left untouched",
    EXIT_SOME_FAILED: "some jobs of a sweep failed, or a judged or anchored depth exceeds fail_on",
    EXIT_FAILED: "bad option, bad data or failed job",
    EXIT_INTERRUPTED: "interrupted",
    EXIT_SIGHUP: "told to end by SIGHUP, as when a terminal is closed",
    EXIT_SIGTERM: "told to end by SIGTERM",
    EXIT_BROKEN_PIPE: "nobody reads the output any more",
}

_LOG = logging.getLogger("dhtorch.cli.run")

#: Options that only one choice of the group ``pairs`` has: said alone they choose it.
_IMPLIED_CHOICES = {"pairs.gap": "pairs=gap", "pairs.seconds": "pairs=time", "pairs.metres": "pairs=baseline"}

#: Flags of Hydra that show something and run nothing.
_HYDRA_INFO_FLAGS = {"-h", "--help", "--hydra-help", "-i", "--info", "-sc", "--shell-completion", "-c", "--cfg"}
_SWEEP_FLAGS = {"-m", "--multirun"}

#: How a job may end, and in words.
_JOB_STATES = {"finished": "finished", "untouched": "left untouched", "failed": "failed"}

#: Where results lie that are to be resumed, when no ``output`` is given.
_RESUMED_FOLDER = Path("outputs/resumed")

_SEPARATORS = "/\\"

#: A longer folder name is cut and told apart by a hash.
_MAX_NAME_LENGTH = 120


def main(argv: list[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    flags, argv = (
        [a for a in argv if a in console.VERBOSITY_FLAGS],
        [a for a in argv if a not in console.VERBOSITY_FLAGS],
    )
    with console.escape_output(), console.set_verbosity(flags), console.show_warnings_in_a_line():
        with signals.catch_termination() as told:
            code = _run_guarded(argv)
        return told.code(code)


def _run_guarded(argv: list[str]) -> int:
    """The exit code, with whatever went wrong said in a line."""
    try:
        code = _dispatch(argv)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # as of `dhtorch report … | head`
        console.discard_broken_pipe()
        return EXIT_BROKEN_PIPE
    except errors.USER_ERRORS as error:
        return _report_failure(error, show="--traceback" in argv)
    except KeyboardInterrupt as stop:  # a sub-command may say how to go on
        print(": ".join(["dhtorch: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return EXIT_INTERRUPTED


def _dispatch(argv: list[str]) -> int:
    if argv == ["--version"]:
        print(f"dhtorch {dhtorch.__version__}")
        return EXIT_DONE
    if argv and argv[0] in _COMMANDS:
        return int(importlib.import_module(_COMMANDS[argv[0]]).main(argv[1:]) or 0)
    if argv[:1] == ["run"]:
        argv = argv[1:]
    elif _is_capture(argv):
        argv = ["recover", *argv]
    argv = _add_implied_choice(argv)
    if argv and argv[0] in _CONFIGURED_COMMANDS:
        return _run_configured(argv[0], argv[1:])
    words.validate_words(argv, ["run", *_COMMANDS, *_CONFIGURED_COMMANDS])
    return _run_hydra(argv)


def _is_capture(argv: Sequence[str]) -> bool:
    """Whether the first word is a place and no word of the command."""
    return bool(argv) and argv[0] not in _CONFIGURED_COMMANDS and argv[0][:1] not in "-~+" and Path(argv[0]).exists()


def _add_implied_choice(argv: list[str]) -> list[str]:
    """The words with the choice of pairs that an option of theirs implies, where none is said."""
    names = [a.split("=")[0] for a in argv]
    implied = [_IMPLIED_CHOICES[name] for name in names if name in _IMPLIED_CHOICES]
    return argv if "pairs" in names else [*argv, *implied[:1]]


def config_dir() -> Path:
    """The settings folder: inside an installed package, else beside the package in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise FileNotFoundError(f"settings folder: found neither {here / 'conf'} nor {here.parent / 'conf'}")


def job_name(overrides: str) -> str:
    """Folder name of a job: its overrides, where they are short and every file system takes them.

    What a file system or a shell would trip over is left out, what is too long is cut; a hash of the whole text then
    keeps different jobs apart. Data below the environment variable DHTORCH_DATA is named relative to it.
    """
    base = os.environ.get("DHTORCH_DATA")
    text = overrides.replace(base.rstrip(_SEPARATORS) + os.sep, "") if base else overrides
    plain = re.sub(r"[^\w.,=+~@-]", "", re.sub(r"[/\\]", "-", text), flags=re.ASCII).rstrip(".")
    if plain == text and len(plain) <= _MAX_NAME_LENGTH:
        return plain or "defaults"
    return f"{plain[: _MAX_NAME_LENGTH - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _run_configured(word: str, argv: list[str]) -> int:
    """A sub-command that takes Hydra overrides: one job, in this process."""
    import hydra  # noqa: PLC0415
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    if _HYDRA_INFO_FLAGS & {a.split("=")[0] for a in argv}:
        return _show_hydra_info(word, argv)
    _check_flags(argv, _HYDRA_INFO_FLAGS)
    if word == "view" and _lacks_result(argv[:1]):
        argv = [
            f"data.root={quote_value(argv[0])}",
            *(argv[1:] if _is_chosen(argv, "data") else ["data=auto", *argv[1:]]),
        ]
    argv = _name_output_folder(word, _name_positionals(argv, _POSITIONAL_OPTIONS.get(word, ())))
    words.validate_words(argv, ())
    argv = words.quote_words(argv)
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
            usual, argv = _check_overrides(word, argv)
            cfg = hydra.compose(word, argv, return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)  # for what the settings take from Hydra, as the folder's name
            groups = {k: v for k, v in cfg.hydra.runtime.choices.items() if k.isidentifier()}
        OmegaConf.set_struct(cfg, False)
        del cfg["hydra"]
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        words.validate_values(settings, usual)
        named = [k for k, v in settings.items() if isinstance(v, dict) and "_target_" in v]
        parts = _instantiate_parts(cfg, named)
    except (HydraException, OmegaConfBaseException) as error:
        return _report_failure(errors.unwrap_cause(error), show="traceback=true" in argv)
    module = importlib.import_module(_CONFIGURED_COMMANDS[word])
    _LOG.debug("%s: %s", word, ", ".join(f"{k}={v}" for k, v in groups.items()))
    disable_malloc_trim()
    try:
        with console.mute_if_quiet():
            return int(module.run({**settings, "choices": groups}, parts, progress=console.progress) or EXIT_DONE)
    except errors.USER_ERRORS as error:
        return _report_failure(error, show=settings.get("traceback", False))


def _check_overrides(name: str, argv: Sequence[str]) -> tuple[Any, list[str]]:
    """Refuse choices and options that the settings ``name`` do not have.

    Returns:
        What the choices alone compose to, and the words as Hydra takes them: with a format that is yet to be
        recognised, options of its reader are added to the settings.
    """
    import hydra  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    folder = config_dir()
    groups = [p.name for p in folder.iterdir() if p.is_dir()]
    words.validate_choices(argv, folder)
    chosen = [a for a in argv if a.partition("=")[0] in groups]
    first = [a.partition(",")[0] if "[" not in a else a for a in chosen]
    composed: Any = OmegaConf.to_container(hydra.compose(name, first))
    swept = [(group, choice) for group, _, some in (a.partition("=") for a in chosen) for choice in some.split(",")[1:]]
    more = [
        f"{g}.{k}" for g, c in swept for k in words.iter_option_names(_load_settings(folder / g / f"{c.strip()}.yaml"))
    ]
    readers = _reader_options(folder) if any(a.startswith("data.") for a in argv) else []
    words.validate_option_names(
        argv, composed, groups, [*more, *words.list_reader_options(composed, readers)], _IMPLIED_CHOICES
    )
    return composed, words.add_reader_options(argv, composed, readers)


def _reader_options(folder: Path) -> list[str]:
    """Names of all options that readers of captures have, by the settings of each; those of all are no reader's."""
    every = [_load_settings(path) for path in sorted((folder / "data").glob("*.yaml"))]
    reading = [each for each in every if str(each.get("_target_", "")).endswith(".open_capture")]
    common = set.intersection(*map(set, reading))
    return list(dict.fromkeys(name for each in reading for name in each if name not in common))


def _load_settings(path: Path) -> Any:
    from omegaconf import OmegaConf  # noqa: PLC0415

    return OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}


def _name_positionals(argv: list[str], options: Sequence[str]) -> list[str]:
    """The words with the names of the options that the first of them set."""
    for k, option in enumerate(options[: len(argv)]):
        if "=" in argv[k] and not Path(argv[k]).exists():
            break
        argv = [*argv[:k], f"{option}={quote_value(argv[k])}", *argv[k + 1 :]]
    return argv


def _lacks_result(first: Sequence[str]) -> bool:
    """Whether a first word, if there is one, is a place that holds no result."""
    place = Path(first[0]) if first and not first[0].startswith("-") else None
    if place is None or not place.exists() or place.suffix in (".json", ".ply"):
        return False
    return not any(place.glob("result.json")) and not any(place.glob("*/result.json"))


def _is_chosen(argv: Sequence[str], group: str) -> bool:
    return any(a.startswith(f"{group}=") for a in argv)


def _name_output_folder(name: str, argv: Iterable[str]) -> list[str]:
    """The words with the settings' own name of the folder of what is made, ``out`` or ``output``."""
    own = "out" if "out" in _load_settings(config_dir() / f"{name}.yaml") else "output"
    return [f"{own}={a.partition('=')[2]}" if a.startswith(("out=", "output=")) else a for a in argv]


def _show_hydra_info(name: str, argv: list[str]) -> int:
    """Hydra's own flags: help, the composed settings, shell completion."""
    import hydra  # noqa: PLC0415

    sys.argv = [sys.argv[0], *argv]
    hydra.main(config_path=str(config_dir()), config_name=name, version_base="1.3")(_run_hydra_job)()
    return EXIT_DONE


def _check_flags(argv: Iterable[str], known: set[str]) -> None:
    for flag in (a for a in argv if a.startswith("-") and a not in known):
        near = console.suggest_name(flag, {*known, *console.VERBOSITY_FLAGS, "--version"})
        raise ValueError(f"{flag}: found an unknown flag{near}, expected {', '.join(sorted(known))}")


def _run_hydra(argv: list[str]) -> int:
    import hydra  # noqa: PLC0415  (a sub-command must not pay for it)
    from hydra.core.global_hydra import GlobalHydra  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from hydra.types import RunMode  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    if _HYDRA_INFO_FLAGS & {a.split("=")[0] for a in argv}:
        return _show_hydra_info("run", argv)
    _check_flags(argv, _SWEEP_FLAGS | _HYDRA_INFO_FLAGS)
    sweep = bool({*_SWEEP_FLAGS, "hydra.mode=MULTIRUN"} & set(argv))
    overrides = words.quote_words(_name_output_folder("run", [a for a in argv if a not in _SWEEP_FLAGS]), sweep)
    if console.get_verbosity() == "quiet":
        overrides.append("hydra/hydra_logging=disabled")  # what a launcher says of its jobs
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
            engine: Any = GlobalHydra.instance().hydra
            mode = RunMode.MULTIRUN if sweep else RunMode.RUN
            # What is misspelt, or cannot be, fails here, in one line, before anything is run.
            usual, overrides = _check_overrides("run", overrides)
            cfg = engine.compose_config("run", overrides, run_mode=mode, with_log_configuration=False)
            own: Any = OmegaConf.masked_copy(cfg, [k for k in cfg if k not in ("hydra", "output")])
            plain: Any = OmegaConf.to_container(own)
            words.validate_values(plain, usual)
            folder = _resolve_output_folder(cfg, overrides, sweep)
            overrides = [o for o in overrides if not o.startswith("output=")] + [f"output={quote_value(str(folder))}"]
            again = _format_resume_command(argv, folder)
            with file_lock.acquire_file_lock(folder.parent / f".{folder.name}.lock", f"output: {folder}"):
                if sweep:
                    return _run_sweep(engine, overrides, folder, again, show=cfg.traceback)
                return _run_single(engine, overrides, again)
    except (HydraException, OmegaConfBaseException) as error:
        return _report_failure(error)


def _run_single(engine: Any, overrides: Sequence[str], again: str) -> int:
    try:
        ended = engine.run("run", _run_hydra_job, list(overrides)).return_value
    except KeyboardInterrupt:
        print(f"dhtorch: interrupted, no result written. Once more:\n  {again}", file=sys.stderr)
        return EXIT_INTERRUPTED
    return EXIT_FAILED if ended.state == "failed" else EXIT_DONE


def _run_sweep(engine: Any, overrides: Sequence[str], folder: Path, again: str, show: bool) -> int:
    """Run all jobs, then say how they ended."""
    from hydra.errors import HydraException  # noqa: PLC0415

    go_on = f"What is finished stays. To do the rest:\n  {again}"
    try:
        with together.show_sweep_progress(folder, _count_jobs(overrides)):
            batches = engine.multirun("run", _run_hydra_job, list(overrides))
    except KeyboardInterrupt:
        print(f"\ndhtorch: interrupted. {go_on}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except HydraException:
        raise
    except Exception as error:  # the launcher broke, as when a worker process is killed
        _report_failure(error, show)
        print(go_on, file=sys.stderr)
        return EXIT_SOME_FAILED
    jobs = [job for batch in batches for job in batch]
    counts = Counter(job.return_value.state for job in jobs)
    shares = ", ".join(f"{counts[state]} {words}" for state, words in _JOB_STATES.items())
    with console.mute_if_quiet():
        _print_comparison([Path(j.return_value.folder) for j in jobs if j.return_value.state != "failed"], folder)
        print(f"{console.format_count(len(jobs), 'job')}: {shares}", flush=True)
    if not counts["failed"]:
        return EXIT_DONE
    common = set.intersection(*(set(job.overrides) for job in jobs))
    for job in jobs:
        if job.return_value.state == "failed":
            name = " ".join(o for o in job.overrides if o not in common) or Path(job.return_value.folder).name
            print(f"failed: {name}: {job.return_value.error}", file=sys.stderr)
    print(go_on, file=sys.stderr)
    return EXIT_SOME_FAILED


def _count_jobs(overrides: Sequence[str]) -> int:
    """Jobs of a sweep: every combination."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415

    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return math.prod(len(list(o.sweep_string_iterator())) for o in parsed if o.is_sweep_override())


def _print_comparison(folders: Sequence[Path], sweep: Path) -> None:
    """The table of a sweep's jobs, and its file."""
    from dhtorch.experiments import report  # noqa: PLC0415
    from dhtorch.runtime import results as result_files  # noqa: PLC0415

    report.print_sweep([result_files.read_result(each / "result.json") for each in folders], sweep)


def _run_hydra_job(cfg: Any) -> Any:
    """One job, in whatever process a launcher runs it: build what the settings name and run it. Never raises."""
    if multiprocessing.current_process().name != "MainProcess":  # of a launcher
        parent_watch.exit_with_parent()
    disable_malloc_trim()  # frame after frame asks for the same memory
    with console.escape_output():
        return _run_job(cfg)


def _run_job(cfg: Any) -> Any:
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from hydra.errors import InstantiationException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    console.ignore_foreign_warnings()
    console.configure_logging()
    from dhtorch.cli import job  # noqa: PLC0415

    runtime = HydraConfig.get().runtime
    swept = not OmegaConf.is_missing(HydraConfig.get().job, "num")  # only jobs of a sweep are numbered
    sweep, name = Path(runtime.output_dir).parent, Path(runtime.output_dir).name
    try:
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        words.validate_values(settings)
        parts = _instantiate_parts(cfg, ("data", "method", "pairs", "experiment"))
        scenes = len(parts["data"]) if isinstance(parts["data"], Sequence) else 1
        progress = together.record_progress(sweep, name, scenes) if swept else console.progress
        _LOG.debug("job in %s: %s", runtime.output_dir, HydraConfig.get().job.override_dirname or "defaults")
        with console.mute_if_quiet():
            ended = job.run(
                settings, parts, dict(runtime.choices), Path(runtime.output_dir), progress=progress, swept=swept
            )
        if console.get_verbosity() == "quiet":
            print(Path(ended.folder) / "result.json", flush=True)
        return ended
    except Exception as error:
        cause = errors.unwrap_cause(error)
        expected = isinstance(cause, (*errors.USER_ERRORS, OmegaConfBaseException, InstantiationException))
        _report_failure(cause, show=cfg.traceback or not expected)
        with contextlib.suppress(OSError):
            Path(runtime.output_dir).rmdir()  # where nothing is in it
        return job.JobStatus(runtime.output_dir, "failed", errors.format_error(cause))
    finally:
        if swept:
            together.mark_finished(sweep, name)


def _instantiate_parts(cfg: Any, names: Iterable[str]) -> dict[str, Any]:
    """What groups of the settings name, built."""
    from hydra.utils import instantiate  # noqa: PLC0415

    try:
        return {name: instantiate(cfg[name], _convert_="all") for name in names}
    except Exception as error:
        _reject_stacks(errors.unwrap_cause(error), cfg.data.get("root"))
        raise


def _reject_stacks(error: BaseException, root: Any) -> None:
    """Focal stacks given as a recording: say what they are, and who reads them."""
    from dhtorch.data.io.decode import FormatError  # noqa: PLC0415
    from dhtorch.experiments.focal.formats import recognise_stacks  # noqa: PLC0415

    if not isinstance(error, FormatError) or error.args[:2] != (str(root), "format"):
        return
    with contextlib.suppress(FormatError):
        found = f"data: {root} holds focal stacks ({recognise_stacks(root)[0]}), pictures of one view"
        expected = "a recording whose camera moves; experiment=focus_stack data=stacks reads them"
        raise ValueError(f"{found}, expected {expected}") from error


def _resolve_output_folder(cfg: Any, overrides: Iterable[str], sweep: bool) -> Path:
    """Folder of the job, or of the sweep, as an absolute name: workers may start elsewhere."""
    if not cfg.resume or any(o.startswith("output=") for o in overrides):
        return Path(str(cfg.output)).absolute()
    return (_RESUMED_FOLDER if sweep else _RESUMED_FOLDER / job_name(cfg.hydra.job.override_dirname)).absolute()


def _format_resume_command(argv: Iterable[str], folder: Path) -> str:
    """The command that goes on where this one ended."""
    words = [a for a in argv if not a.startswith(("resume=", "output="))]
    own = any(a.startswith(("hydra.run.dir=", "hydra.sweep.dir=")) for a in words)
    place = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
    return shlex.join(["dhtorch", *words, "resume=true", *([] if own else [f"output={quote_value(str(place))}"])])


def _report_failure(error: BaseException, show: bool = False) -> int:
    if show:
        traceback.print_exception(error)
    print(f"dhtorch: {errors.format_error(error)}", file=sys.stderr)
    return EXIT_FAILED
