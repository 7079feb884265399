"""The ``dhtorch`` command: arguments -> Hydra settings -> library functions; exit code.

If the first argument names a sub-command, its module parses the other arguments or receives the composed settings of
that name; otherwise all arguments are Hydra overrides of an experiment. Each job has its own folder, named by its
overrides in a sweep, and returns its state instead of raising, so that a failing job stops no other, with any launcher.
"""

import contextlib
import functools
import hashlib
import importlib
import logging
import multiprocessing
import os
import re
import shlex
import signal
import sys
import threading
import traceback
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import dhtorch
from dhtorch.cli import commands
from dhtorch.cli import option_checks as words
from dhtorch.cli.option_checks import quote_value
from dhtorch.runtime import console, parent_watch
from dhtorch.runtime.allocator import disable_malloc_trim
from dhtorch.runtime.output_folder import open_output_folder

#: Sub-command with its own settings ``conf/<name>.yaml`` → module with ``run(settings, parts, *, progress)`` -> exit
#: code; ``settings`` are all options as plain values, ``parts`` the instantiated options that name a function.
_CONFIGURED_COMMANDS = {
    "align": "dhtorch.cli.align",
    "complete": "dhtorch.cli.complete",
    "demo": "dhtorch.cli.process_capture",
    "enrich": "dhtorch.cli.enrich",
    "extract": "dhtorch.extract",
    "fetch": "dhtorch.cli.fetch",
    "inspect": "dhtorch.cli.inspect",
    "integrate": "dhtorch.integrate.mapping",
    "pin": "dhtorch.cli.pin",
    "recover": "dhtorch.cli.process_capture",
    "report": "dhtorch.experiments.report",
    "scale": "dhtorch.cli.scale",
    "stream": "dhtorch.cli.stream",
    "validate": "dhtorch.cli.validate",
    "view": "dhtorch.cli.view",
}

#: Sub-command → the options set by its positional arguments.
_POSITIONAL_OPTIONS = {
    "inspect": ("path",),
    "report": ("result",),
    **dict.fromkeys(("align", "complete", "extract", "integrate", "run", "stream", "validate"), ("data.root",)),
    "enrich": ("data.root", "out"),
    "fetch": ("set",),
    "pin": ("ref", "source"),
    "recover": ("path",),
    "scale": ("model", "data.root"),
    "view": ("result",),
}

#: Sub-commands whose recordings are subsampled by ``every`` and ``max_frames`` before they run → whether by the latter.
_SUBSAMPLED_COMMANDS = {"extract": True, "integrate": True, "scale": False, "stream": True, "view": False}

#: Sub-commands whose result is empty without sensor depth.
_DEPTH_COMMANDS = ("align", "complete", "enrich", "integrate", "scale", "stream")

#: Experiments that hide sensor depth and recover it.
_DEPTH_EXPERIMENTS = ("pair", "range_split", "method_comparison")

#: Sub-commands that compute in data-loader processes, on the CPU.
_CPU_COMMANDS = ("enrich", "extract")

EXIT_DONE, EXIT_SOME_FAILED, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 0, 1, 2, 130, 141
EXIT_SIGHUP, EXIT_SIGTERM = 129, 143

#: Exit codes, as ``dhtorch --help`` lists them.
EXIT_CODES = {
    EXIT_DONE: "all done or left untouched",
    EXIT_SOME_FAILED: "some jobs of a sweep failed, a limit of fail_on is exceeded, or a model is refused",
    EXIT_FAILED: "bad option, bad data or failed job",
    EXIT_INTERRUPTED: "interrupted",
    EXIT_SIGHUP: "ended by SIGHUP, e.g. a closed terminal",
    EXIT_SIGTERM: "ended by SIGTERM",
    EXIT_BROKEN_PIPE: "output pipe closed",
}

_LOG = logging.getLogger("dhtorch.cli.run")

#: Option of a single choice of the group ``pairs`` → that choice, which the option implies.
_IMPLIED_CHOICES = {"pairs.gap": "pairs=gap", "pairs.seconds": "pairs=time", "pairs.metres": "pairs=baseline"}

#: What Hydra's deletion of the group ``holdout`` stands for: every other group is needed.
_NO_HOLDOUT = "holdout=none"

#: Hydra flags that print information and run no job.
_HYDRA_INFO_FLAGS = {"--hydra-help", "-sc", "--shell-completion", *commands.HYDRA_VALUE_FLAGS}
_HELP_FLAGS = {"-h", "--help", "--help-all"}
_SWEEP_FLAGS = {"-m", "--multirun"}

#: Final state of a job → printed text.
_JOB_STATES = {"finished": "finished", "untouched": "left untouched", "failed": "failed"}

#: Default ``output`` with ``resume=true``.
_RESUMED_FOLDER = Path("outputs/resumed")

#: Captures below a path that a message names.
_MAX_CAPTURES_SHOWN = 4

_SEPARATORS = "/\\"

#: The option that shows tracebacks, as typed.
_TRACEBACK_OPTION = re.compile(r"(--)?traceback(=true)?")

#: End of a word that is the name of a file.
_FILE_END = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,4}$")

#: Groups of settings that become objects.
_OBJECT_GROUPS = ("data", "method", "pairs", "experiment")

#: Characters beyond which a folder name is cut and completed by a hash.
_MAX_NAME_LENGTH = 120


def main(argv: list[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    flags = [a for a in argv if a in console.VERBOSITY_FLAGS]
    argv = [a for a in argv if a not in flags]
    with console.escape_output(), console.set_verbosity(flags), console.show_warnings_in_a_line():
        with _catch_termination() as received:
            code = _run_guarded(argv)
        return 128 + received[0] if received else code  # as a shell reports it


def _run_guarded(argv: list[str]) -> int:
    """Run the command -> exit code; errors are printed in one line."""
    try:
        code = _dispatch(argv)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # as of `dhtorch report … | head`
        console.discard_broken_pipe()
        return EXIT_BROKEN_PIPE
    except Exception as error:
        if not (isinstance(error, USER_ERRORS) or _is_settings_error(error)):
            raise
        return _report_failure(unwrap_cause(error), show=any(_TRACEBACK_OPTION.fullmatch(a) for a in argv))
    except KeyboardInterrupt as stop:  # a sub-command may add how to continue
        print(": ".join(["dhtorch: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return EXIT_INTERRUPTED


def _dispatch(argv: list[str]) -> int:
    if argv == ["--version"]:
        warnings.simplefilter("ignore", ImportWarning)  # of operators that are not compiled: the line has it
        operators = importlib.import_module("dhtorch.ops.loader").describe_operators(advice=True)
        print(f"dhtorch {dhtorch.__version__}, operators: {operators}")
        return EXIT_DONE
    if argv[:1] == ["help"]:
        argv = ["--help", *argv[1:]]
    help_flags = _HELP_FLAGS & {*argv}
    argv = [a for a in argv if a not in _HELP_FLAGS]
    if not argv:
        print(commands.format_overview(EXIT_CODES))
        return EXIT_DONE
    named = argv[0] in commands.COMMANDS
    name = (
        argv[0]
        if named
        else "recover"
        if (bool(argv) and not _is_flag_or_deletion(argv[0]) and Path(argv[0]).expanduser().exists())
        else "run"
    )
    if not named and name == "run":
        _reject_missing_path(argv[0])
        words.validate_words(argv[:1], ["PATH", *commands.COMMANDS])
    typed = argv[1:] if named else argv
    if help_flags:
        # Print the help of a command; ``everything`` also lists the groups and the composed settings
        everything = "--help-all" in help_flags
        print(commands.format_command_help(name, config_dir()))
        if everything:
            overrides = [a for a in typed if "=" in a]
            print("\nGroups (choose with group=name):")
            for folder in sorted(p for p in config_dir().iterdir() if p.is_dir()):
                print(f"{folder.name}: {', '.join(sorted(p.stem for p in folder.glob('*.yaml')))}")
            print("\nOptions (set with key=value), with their present values:\n")
            _show_hydra_info(name, [*overrides, "--cfg", "job"])
        return EXIT_DONE
    flags = _SWEEP_FLAGS | _HYDRA_INFO_FLAGS if name == "run" else _HYDRA_INFO_FLAGS
    known = commands.list_options(name, config_dir())
    argv = commands.to_overrides(name, typed, known, flags, console.suggest_name)
    if named:
        _reject_missing_input(name, argv)
    if name == "run":
        argv = _add_implied_choice(_name_positionals(name, argv) if named else argv)
        argv = [_NO_HOLDOUT if a.partition("=")[0] == "~holdout" else a for a in argv]
        words.validate_words(argv, ())
        return _run_hydra(argv)
    return _run_configured(name, _add_implied_choice(argv))


def _reject_missing_path(word: str) -> None:
    """Raise an error for a first argument that is a path and does not exist.

    A path is what has a separator, begins with ``~`` or ends as a file's name does (``.r3d``), and a word that is near
    an existing name and near no command.
    """
    if _is_flag_or_deletion(word):
        return
    path = Path(word).expanduser()
    is_path = bool({*_SEPARATORS} & {*word}) or word.startswith("~") or bool(_FILE_END.search(word))
    is_option = word.startswith("hydra/") or ("=" in word and not word.startswith((*_SEPARATORS, "~", ".")))
    if is_option or path.exists():
        return
    near = console.suggest_path(path)
    if is_path or (near and not console.suggest_name(word, commands.COMMANDS)):
        raise ValueError(f"{word}: no such file or folder{near}, expected a capture or a command (dhtorch --help)")


def _reject_missing_input(name: str, argv: Sequence[str]) -> None:
    """Raise an error for a positional argument that a command reads and that does not exist, before torch is loaded.

    Every such argument is a path, but for ``pin``'s number of a live camera.
    """
    if _HYDRA_INFO_FLAGS & {a.split("=")[0] for a in argv}:
        return
    typed = [word for word in argv if _is_positional(word)]
    for option, word in zip(_POSITIONAL_OPTIONS.get(name, ()), typed, strict=False):
        path = Path(word).expanduser()
        if option not in ("out", "set") and not path.exists() and not (option == "source" and word.isdigit()):
            expected = f"one that exists (dhtorch {name} {commands.COMMANDS[name].usage})"
            raise ValueError(f"{word}: no such file or folder{console.suggest_path(path)}, expected {expected}")


def _add_implied_choice(argv: list[str]) -> list[str]:
    """The arguments with the choice of ``pairs`` that one of their options implies, unless ``pairs`` is set."""
    names = [a.split("=")[0] for a in argv]
    implied = [_IMPLIED_CHOICES[name] for name in names if name in _IMPLIED_CHOICES]
    return argv if "pairs" in names else [*argv, *implied[:1]]


def config_dir() -> Path:
    """The settings folder: inside the installed package, else beside it in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise FileNotFoundError(f"settings folder: found neither {here / 'conf'} nor {here.parent / 'conf'}")


def job_name(overrides: str) -> str:
    """Folder name of a job from its overrides.

    Characters that file systems or shells may reject are removed and long names are cut; a hash of the whole text then
    keeps the names of different jobs distinct. Paths below the environment variable DHTORCH_DATA become relative to it.
    """
    base = os.environ.get("DHTORCH_DATA")
    text = overrides.replace(base.rstrip(_SEPARATORS) + os.sep, "") if base else overrides
    plain = re.sub(r"[^\w.,=+~@-]", "", re.sub(r"[/\\]", "-", text), flags=re.ASCII).rstrip(".")
    if plain == text and len(plain) <= _MAX_NAME_LENGTH:
        return plain or "defaults"
    return f"{plain[: _MAX_NAME_LENGTH - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _run_configured(word: str, argv: list[str]) -> int:
    """Run a sub-command with Hydra overrides as one job in this process."""
    typed = sorted(argv, key=lambda each: not _is_positional(each))
    argv = _name_positionals(word, argv)
    if _HYDRA_INFO_FLAGS & {a.split("=")[0] for a in argv}:
        return _show_hydra_info(word, argv)
    _check_flags(argv, _HYDRA_INFO_FLAGS)
    words.validate_words(argv, ())
    settings, parts, groups = compose_settings(word, words.quote_words(argv))
    module = importlib.import_module(_CONFIGURED_COMMANDS[word])
    _LOG.debug("%s: %s", word, ", ".join(f"{k}={v}" for k, v in groups.items()))
    disable_malloc_trim()
    # Set the threads of torch and OpenCV; None keeps their defaults. Beside other work more than one thread
    # spins
    threads = settings.get("threads", 1)
    import torch  # noqa: PLC0415

    from dhtorch.data.io.decode import set_opencv_threads  # noqa: PLC0415

    if threads is not None:
        torch.set_num_threads(threads)
        set_opencv_threads(threads)
    data = parts.get("data")
    if data is not None:
        from dhtorch.cli.capture_checks import check_data, require_depth  # noqa: PLC0415
        from dhtorch.data.scene import scenes_of  # noqa: PLC0415
        from dhtorch.extract.cut import subsample_scenes  # noqa: PLC0415

        if word in _SUBSAMPLED_COMMANDS:
            max_frames = settings["max_frames"] if _SUBSAMPLED_COMMANDS[word] else None
            data = subsample_scenes(scenes_of(data), settings["every"], max_frames)
        data = check_data(data)
        if word in _DEPTH_COMMANDS and settings.get("pose", "near") == "near" and not settings.get("without_depth"):
            remedy = "without_depth=true writes empty maps" if word == "enrich" else None
            require_depth(scenes_of(data), remedy=remedy)
        parts["data"] = data
    settings |= {"choices": groups} | ({"typed": typed} if word in ("demo", "recover") else {})
    with console.mute_if_quiet():
        return int(module.run(settings, parts, progress=console.progress) or EXIT_DONE)


def compose_settings(word: str, argv: list[str]) -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
    """Settings of a sub-command -> resolved options, the objects of their groups, and the choice in each group.

    Raises:
        ValueError, OSError, KeyError, ImportError: unknown or wrong options.
        HydraException, OmegaConfBaseException, YAMLError: settings that cannot be read, composed, resolved or made into
            objects.
    """
    import hydra  # noqa: PLC0415
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        defaults, argv = _check_overrides(word, argv)
        cfg = hydra.compose(word, argv, return_hydra_config=True)
        HydraConfig.instance().set_config(cfg)  # for settings that refer to Hydra's own, e.g. the folder name
        groups = {k: v for k, v in cfg.hydra.runtime.choices.items() if k.isidentifier()}
    OmegaConf.set_struct(cfg, False)
    del cfg["hydra"]
    settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    words.validate_values(settings, defaults)
    if word in ("inspect", "scale", "view") and settings["max_frames"] is None:
        raise ValueError("max_frames: found None, expected a whole number of at least 1")
    _check_objects(settings, groups)
    _check_device(word, settings.get("device", "cpu"))
    function_options = [k for k, v in settings.items() if isinstance(v, dict) and "_target_" in v]
    return settings, _instantiate_parts(cfg, function_options), groups


def _check_device(name: str, device: str) -> None:
    """Raise an error for a device that a command, or torch on this machine, cannot use."""
    if device == "cpu":
        return
    import torch  # noqa: PLC0415

    if name in _CPU_COMMANDS:
        raise ValueError(
            f"device: found {device!r}, expected cpu: {name} computes in data-loader processes (workers=N)"
        )
    try:
        torch.empty(0, device=device)
    except Exception as error:  # of other types for each kind of device
        reason = f"torch {torch.__version__} cannot use it on this machine"
        raise ValueError(
            f"device: found {device!r}, expected cpu or another device of this machine: {reason}"
        ) from error


def _check_overrides(name: str, argv: Sequence[str]) -> tuple[Any, list[str]]:
    """Reject choices and options that the settings ``name`` do not have.

    Returns:
        The settings composed from the choices alone, and the arguments for Hydra: while the format is unknown, options
        of any reader are added to the settings.
    """
    import hydra  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    folder = config_dir()
    groups = [p.name for p in folder.iterdir() if p.is_dir()]
    chosen = words.list_choices(argv, folder)
    first = [f"{group}={names[0]}" for group, names in chosen.items()]
    composed: Any = OmegaConf.to_container(hydra.compose(name, first))
    swept_names = [
        f"{group}.{option}"
        for group, names in chosen.items()
        for other in names[1:]
        for option in words.iter_option_names(_load_settings(folder / group / f"{other}.yaml"))
    ]
    readers = _reader_options(folder) if any(a.startswith("data.") for a in argv) else ()
    words.validate_option_names(
        argv, composed, groups, [*swept_names, *words.list_reader_options(composed, readers)], _IMPLIED_CHOICES
    )
    return composed, words.add_reader_options(argv, composed, readers)


@functools.cache
def _reader_options(folder: Path) -> tuple[str, ...]:
    """Option names of the capture readers, without those common to all readers."""
    data_settings = [_load_settings(path) for path in sorted((folder / "data").glob("*.yaml"))]
    reader_settings = [
        settings for settings in data_settings if str(settings.get("_target_", "")).endswith(".open_capture")
    ]
    common = set.intersection(*map(set, reader_settings))
    return tuple(dict.fromkeys(name for settings in reader_settings for name in settings if name not in common))


def _load_settings(path: Path) -> Any:
    from omegaconf import OmegaConf  # noqa: PLC0415

    return OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}


def _name_positionals(name: str, argv: Sequence[str]) -> list[str]:
    """The arguments with the option names of the positional ones added, first; a path chooses ``data=auto``."""
    options = _POSITIONAL_OPTIONS.get(name, ())
    places = [k for k, word in enumerate(argv) if _is_positional(word)]
    if name == "report" and places:
        results = ",".join(quote_value(argv[k]) for k in places)
        return [f"result=[{results}]", *(word for k, word in enumerate(argv) if k not in places)]
    places = places[: len(options)]
    if name == "view" and places:
        place = Path(argv[places[0]])
        has_result = any(place.glob("result.json")) or any(place.glob("*/result.json"))
        if place.exists() and place.suffix not in (".json", ".ply") and not has_result:
            options = ("data.root",)
    named = [f"{option}={quote_value(argv[k])}" for k, option in zip(places, options, strict=False)]
    rest = [word for k, word in enumerate(argv) if k not in places]
    if places and options[0] == "data.root" and not any(a.startswith("data=") for a in argv):
        named.insert(0, "data=auto")
    return [*named, *rest]


def _is_positional(word: str) -> bool:
    """Whether an argument is a path and neither an option nor a flag."""
    return not _is_flag_or_deletion(word) and ("=" not in word or Path(word).exists())


def _is_flag_or_deletion(word: str) -> bool:
    """Whether an argument is a flag, an addition or a deletion (``~group``; ``~/`` is a path)."""
    return word.startswith(("-", "+")) or (word.startswith("~") and not word.startswith("~/"))


def _show_hydra_info(name: str, argv: list[str]) -> int:
    """Run Hydra's own flags: composed settings, information, shell completion."""
    import hydra  # noqa: PLC0415

    # Hydra expects the options side by side, before or behind its own flags with their values.
    argv = sorted(argv, key=lambda word: word.startswith("-") or not ("=" in word or word[:1] in ("~", "+")))
    sys.argv = [sys.argv[0], *argv]
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        hydra.main(config_path=str(config_dir()), config_name=name, version_base="1.3")(_run_hydra_job)()
    finally:  # Hydra's handlers hold today's stdout
        root.handlers[:] = handlers
        root.setLevel(level)
    return EXIT_DONE


def _check_flags(argv: Iterable[str], known: set[str]) -> None:
    for flag in (a for a in argv if a.startswith("-") and a not in known):
        near = console.suggest_name(flag, {*known, *console.VERBOSITY_FLAGS, "--version"})
        raise ValueError(f"{flag}: found an unknown flag{near}, expected {', '.join(sorted(known))}")


def _run_hydra(argv: list[str]) -> int:
    import hydra  # noqa: PLC0415  (a sub-command must not pay for it)
    from hydra.core.global_hydra import GlobalHydra  # noqa: PLC0415
    from hydra.types import RunMode  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    if _HYDRA_INFO_FLAGS & {a.split("=")[0] for a in argv}:
        return _show_hydra_info("run", argv)
    _check_flags(argv, _SWEEP_FLAGS | _HYDRA_INFO_FLAGS)
    sweep = bool({*_SWEEP_FLAGS, "hydra.mode=MULTIRUN"} & set(argv))
    overrides = words.quote_words([a for a in argv if a not in _SWEEP_FLAGS], sweep)
    if console.get_verbosity() == "quiet":
        overrides.append("hydra/hydra_logging=disabled")  # the launcher's messages
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        engine: Any = GlobalHydra.instance().hydra
        mode = RunMode.MULTIRUN if sweep else RunMode.RUN
        # Misspelt names and invalid values fail here, in one line, before anything runs.
        defaults, overrides = _check_overrides("run", overrides)
        cfg = engine.compose_config("run", overrides, run_mode=mode, with_log_configuration=False)
        settings_cfg: Any = OmegaConf.masked_copy(cfg, [k for k in cfg if k not in ("hydra", "output")])
        plain: Any = OmegaConf.to_container(settings_cfg)
        words.validate_values(plain, defaults)
        # Absolute folder of the job or the sweep (workers may have another working directory)
        folder = Path(str(cfg.output)).absolute()
        if cfg.resume and not any(o.startswith("output=") for o in overrides):
            own = "" if sweep else job_name(cfg.hydra.job.override_dirname)
            folder = (_RESUMED_FOLDER / own).absolute()
        overrides = [o for o in overrides if not o.startswith("output=")] + [f"output={quote_value(str(folder))}"]
        resume_command = _format_resume_command(argv, folder)
        with open_output_folder(folder, "output") as output:
            if sweep:
                table, picture, launched = (folder / name for name in ("sweep.csv", "sweep.png", "multirun.yaml"))
                if output.is_unlisted and any(folder.glob("*/result.json")):
                    output.adopt([table, launched])  # of an older version, without a manifest
                output.check([table, picture, launched])
                output.record(launched, None)  # written by Hydra
                return _run_sweep(engine, overrides, folder, resume_command, show_traceback=cfg.traceback)
            try:
                status = engine.run("run", _run_hydra_job, overrides).return_value
            except KeyboardInterrupt:
                go_on = "Finished scenes are kept. To run the rest:"
                print(f"dhtorch: interrupted, no result written. {go_on}\n  {resume_command}", file=sys.stderr)
                return EXIT_INTERRUPTED
            return EXIT_FAILED if status.state == "failed" else EXIT_DONE


def _run_sweep(engine: Any, overrides: Sequence[str], folder: Path, resume_command: str, show_traceback: bool) -> int:
    """Run all jobs of a sweep, print their states, return the exit code."""
    go_on = f"Finished jobs are kept. To run the rest:\n  {resume_command}"
    try:
        batches = engine.multirun("run", _run_hydra_job, list(overrides))
    except KeyboardInterrupt:
        print(f"\ndhtorch: interrupted. {go_on}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:  # the launcher broke, as when a worker process is killed
        if type(error).__module__.startswith("hydra."):
            raise
        _report_failure(error, show_traceback)
        print(go_on, file=sys.stderr)
        return EXIT_SOME_FAILED
    jobs = [job for batch in batches for job in batch]
    counts = Counter(job.return_value.state for job in jobs)
    shares = ", ".join(f"{counts[state]} {words}" for state, words in _JOB_STATES.items())
    with console.mute_if_quiet():
        # Print and write the table that compares the jobs of a sweep
        folders = [Path(j.return_value.folder) for j in jobs if j.return_value.state != "failed"]
        from dhtorch.experiments import report  # noqa: PLC0415
        from dhtorch.runtime import results as result_files  # noqa: PLC0415

        report.print_sweep([result_files.read_result(each / "result.json") for each in folders], folder)
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


def _run_hydra_job(cfg: Any) -> Any:
    """Run one job in the process of any launcher. Never raises."""
    if multiprocessing.current_process().name != "MainProcess":  # of a launcher
        parent_watch.exit_with_parent()
    disable_malloc_trim()  # every frame allocates the same sizes
    with console.escape_output(), console.show_warnings_in_a_line():
        from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
        from omegaconf import OmegaConf  # noqa: PLC0415

        console.configure_logging()
        from dhtorch.cli import job  # noqa: PLC0415
        from dhtorch.data.scene import scenes_of  # noqa: PLC0415

        runtime = HydraConfig.get().runtime
        swept = not OmegaConf.is_missing(HydraConfig.get().job, "num")  # only jobs of a sweep are numbered
        try:
            settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
            words.validate_values(settings)
            _check_objects(settings, runtime.choices)
            _check_device("run", settings["device"])
            parts = _instantiate_parts(cfg, _OBJECT_GROUPS)
            if runtime.choices["experiment"] in _DEPTH_EXPERIMENTS:
                from dhtorch.cli.capture_checks import require_depth  # noqa: PLC0415

                require_depth(scenes_of(parts["data"]))
            _LOG.debug("job in %s: %s", runtime.output_dir, HydraConfig.get().job.override_dirname or "defaults")
            with console.mute_if_quiet():
                status = job.run(
                    settings,
                    parts,
                    dict(runtime.choices),
                    Path(runtime.output_dir),
                    progress=console.progress,
                    swept=swept,
                )
            if console.get_verbosity() == "quiet":
                print(Path(status.folder) / "result.json", flush=True)
            return status
        except Exception as error:
            cause = unwrap_cause(error)
            expected = isinstance(cause, USER_ERRORS) or _is_settings_error(cause)
            _report_failure(cause, show=cfg.traceback or not expected)
            with contextlib.suppress(OSError):
                Path(runtime.output_dir).rmdir()  # only if empty
            return job.JobStatus(runtime.output_dir, "failed", format_error(cause))


def _check_objects(settings: Mapping[str, Any], choices: Mapping[str, Any]) -> None:
    """Raise ValueError for a chosen group of objects whose settings name none."""
    for name in (name for name in _OBJECT_GROUPS if name in choices):
        value = settings.get(name)
        if not (isinstance(value, dict) and "_target_" in value):
            problem = f"settings of {name}={choices[name]} without _target_"
            raise ValueError(f"{name}: found {problem}, expected the name of what makes the {name}")


def _instantiate_parts(cfg: Any, names: Iterable[str]) -> dict[str, Any]:
    """Settings groups -> instantiated objects."""
    from hydra.utils import instantiate  # noqa: PLC0415

    try:
        return {name: instantiate(cfg[name], _convert_="all") for name in names}
    except TypeError as error:  # of a flag like _partial_; those of a constructor are an InstantiationException
        raise ValueError(" ".join(str(error).split())) from error
    except Exception as error:
        cause = unwrap_cause(error)
        root = cfg.data.get("root")
        below = _find_capture_below(cause, root)
        if below is None:
            raise
    cfg.data.root = below
    return {name: instantiate(cfg[name], _convert_="all") for name in names}


def _find_capture_below(error: BaseException, root: Any) -> str | None:
    """The only recording below a path that is none itself; None without one, or for another error.

    Raises:
        ValueError: several, or captures of other kinds: focal stacks, which are no recording, images without depth.
        FormatError: a folder below that lacks a part of its layout.
    """
    from dhtorch.cli.process_capture import find_recording_captures  # noqa: PLC0415
    from dhtorch.data.io.decode import FormatError  # noqa: PLC0415
    from dhtorch.experiments.focal.formats import recognise_stacks  # noqa: PLC0415

    if not isinstance(error, FormatError) or error.args[:2] != (str(root), "format"):
        return None
    with contextlib.suppress(FormatError):
        actual = f"data: {root} holds focal stacks ({recognise_stacks(root)[0]}), images of one view"
        expected = "a recording of a moving camera; for focal stacks use experiment=focus_stack data=stacks"
        raise ValueError(f"{actual}, expected {expected}") from error
    try:
        captures = [str(each.path) for each in find_recording_captures(Path(str(root)))]
    except FormatError as lack:
        if lack.args[0] != str(root):
            raise
        return None
    if len(captures) > 1:
        names = ", ".join(captures[:_MAX_CAPTURES_SHOWN]) + (", …" if len(captures) > _MAX_CAPTURES_SHOWN else "")
        raise ValueError(f"{root}: found {len(captures)} captures below, expected one of {names}") from error
    return captures[0] if captures else None


def _format_resume_command(argv: Iterable[str], folder: Path) -> str:
    """The command line that resumes this run."""
    words = [a for a in argv if not a.startswith(("resume=", "output="))]
    has_hydra_dir = any(a.startswith(("hydra.run.dir=", "hydra.sweep.dir=")) for a in words)
    output = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
    return shlex.join(
        ["dhtorch", *words, "resume=true", *([] if has_hydra_dir else [f"output={quote_value(str(output))}"])]
    )


def _report_failure(error: BaseException, show: bool = False) -> int:
    if show:
        traceback.print_exception(error)
    print(f"dhtorch: {format_error(error)}", file=sys.stderr)
    return EXIT_FAILED


# ------------------------------------------------------------------------------------------------- errors and signals


#: Exceptions raised by bad input: reported in one line, without a traceback.
USER_ERRORS = (ValueError, OSError, KeyError, ImportError)


def unwrap_cause(error: BaseException) -> BaseException:
    """The exception inside Hydra's InstantiationException; other exceptions unchanged."""
    is_wrapper = type(error).__name__ == "InstantiationException"
    return error.__cause__ if is_wrapper and error.__cause__ else error


def format_error(error: BaseException) -> str:
    """Exception -> message in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    # A data-loader worker's message contains its whole traceback
    lines = lines[-1:] if any("Original Traceback" in line for line in lines) else lines
    message = " ".join(" ".join(lines).split())
    if type(error).__name__ == "MissingMandatoryValue":
        return f"{getattr(error, 'full_key', '')}: found no value, expected {getattr(error, 'full_key', '')}=VALUE"
    if "hydra/launcher/" in message:
        message += " (launchers are optional extras: pip install 'dhtorch[scale]', for Ray 'dhtorch[ray-launcher]')"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, KeyError) and len(error.args) == 1:
        return str(error.args[0])
    return (
        message if isinstance(error, USER_ERRORS) or _is_settings_error(error) else f"{type(error).__name__}: {message}"
    )


def _is_settings_error(error: BaseException) -> bool:
    """Whether the error is Hydra's, OmegaConf's or YAML's, whose messages name the option or the file."""
    return type(error).__module__.startswith(("hydra.", "omegaconf.", "yaml."))


#: Signals that end the command with clean-up.
_TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextlib.contextmanager
def _catch_termination() -> Iterator[list[int]]:
    """Context in which the first SIGTERM or SIGHUP raises KeyboardInterrupt -> numbers of the received signals.

    Later ones do not interrupt the clean-up. A killed process cannot end its workers: a worker watches its parent, see
    :mod:`dhtorch.runtime.parent_watch`.
    Signals that are ignored stay ignored (``nohup``); outside the main thread no handler is installed.
    """
    received: list[int] = []

    def handle(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:
            raise KeyboardInterrupt

    old_handlers = {}
    if threading.current_thread() is threading.main_thread():
        old_handlers = {
            n: signal.signal(n, handle) for n in _TERMINATION_SIGNALS if signal.getsignal(n) is not signal.SIG_IGN
        }
    try:
        yield received
    finally:
        if received:
            # End the worker processes of joblib's launcher, if any: they outlive a call
            pool = sys.modules.get("joblib.externals.loky.reusable_executor")
            executor = getattr(pool, "_executor", None)
            if executor is not None:
                executor.shutdown(wait=True, kill_workers=True)
        for number, handler in old_handlers.items():
            signal.signal(number, handler)
