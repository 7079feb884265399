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
from dhtorch.cli.option_checks import quote
from dhtorch.runtime import console
from dhtorch.runtime import file_lock as lock
from dhtorch.runtime import parent_watch as leash
from dhtorch.runtime.allocator import keep_freed

#: Sub-command → module with ``main(argv) -> int``.
COMMANDS = {"inspect": "dhtorch.cli.inspect", "report": "dhtorch.experiments.report"}

#: Sub-command with settings of its own, ``conf/<word>.yaml`` → module with ``run(settings, parts, *, progress)``, which
#: is given all options as plain values, and as objects those that name a function. It returns the exit code.
CONFIGURED = {
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
FIRST_WORDS = {
    "anchor": ("data.root",),
    "complete": ("data.root",),
    "enrich": ("data.root", "out"),
    "judge": ("data.root",),
    "recover": ("path",),
    "stream": ("data.root",),
    "view": ("result",),
}

DONE, SOME_FAILED, FAILED, INTERRUPTED, UNHEARD = 0, 1, 2, 130, 141
HUNG_UP, TERMINATED = 129, 143

#: Exit codes, as ``dhtorch --help`` lists them.
EXIT_CODES = {
    DONE: "all done or left untouched",
    SOME_FAILED: "some jobs of a sweep failed, or a judged or anchored depth exceeds fail_on",
    FAILED: "bad option, bad data or failed job",
    INTERRUPTED: "interrupted",
    HUNG_UP: "told to end by SIGHUP, as when a terminal is closed",
    TERMINATED: "told to end by SIGTERM",
    UNHEARD: "nobody reads the output any more",
}

_LOG = logging.getLogger("dhtorch.cli.run")

#: Options that only one choice of the group ``pairs`` has: said alone they choose it.
IMPLIED = {"pairs.gap": "pairs=gap", "pairs.seconds": "pairs=time", "pairs.metres": "pairs=baseline"}

#: Flags of Hydra that show something and run nothing.
SHOW = {"-h", "--help", "--hydra-help", "-i", "--info", "-sc", "--shell-completion", "-c", "--cfg"}
SWEEP = {"-m", "--multirun"}

#: How a job may end, and in words.
STATES = {"finished": "finished", "untouched": "left untouched", "failed": "failed"}

#: Where results lie that are to be resumed, when no ``output`` is given.
RESUMED = Path("outputs/resumed")

_SEPARATORS = "/\\"

#: A longer folder name is cut and told apart by a hash.
LONGEST_NAME = 120


def main(argv: list[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    flags, argv = [a for a in argv if a in console.FLAGS], [a for a in argv if a not in console.FLAGS]
    with console.neutral(), console.speaking(flags), console.hushed():
        with signals.ending() as told:
            code = _outcome(argv)
        return told.code(code)


def _outcome(argv: list[str]) -> int:
    """The exit code, with whatever went wrong said in a line."""
    try:
        code = _run(argv)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # as of `dhtorch report … | head`
        console.leave_the_pipe()
        return UNHEARD
    except errors.USER_ERRORS as error:
        return _fail(error, show="--traceback" in argv)
    except KeyboardInterrupt as stop:  # a sub-command may say how to go on
        print(": ".join(["dhtorch: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return INTERRUPTED


def _run(argv: list[str]) -> int:
    if argv == ["--version"]:
        print(f"dhtorch {dhtorch.__version__}")
        return DONE
    if argv and argv[0] in COMMANDS:
        return int(importlib.import_module(COMMANDS[argv[0]]).main(argv[1:]) or 0)
    if argv[:1] == ["run"]:
        argv = argv[1:]
    elif _is_capture(argv):
        argv = ["recover", *argv]
    argv = _with_pairs(argv)
    if argv and argv[0] in CONFIGURED:
        return _run_configured(argv[0], argv[1:])
    words.refuse_words(argv, ["run", *COMMANDS, *CONFIGURED])
    return _run_hydra(argv)


def _is_capture(argv: Sequence[str]) -> bool:
    """Whether the first word is a place and no word of the command."""
    return bool(argv) and argv[0] not in CONFIGURED and argv[0][:1] not in "-~+" and Path(argv[0]).exists()


def _with_pairs(argv: list[str]) -> list[str]:
    """The words with the choice of pairs that an option of theirs implies, where none is said."""
    names = [a.split("=")[0] for a in argv]
    implied = [IMPLIED[name] for name in names if name in IMPLIED]
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
    if plain == text and len(plain) <= LONGEST_NAME:
        return plain or "defaults"
    return f"{plain[: LONGEST_NAME - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _run_configured(word: str, argv: list[str]) -> int:
    """A sub-command that takes Hydra overrides: one job, in this process."""
    import hydra  # noqa: PLC0415
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    if SHOW & {a.split("=")[0] for a in argv}:
        return _show(word, argv)
    _refuse_flags(argv, SHOW)
    if word == "view" and _without_result(argv[:1]):
        argv = [f"data.root={quote(argv[0])}", *(argv[1:] if _chosen(argv, "data") else ["data=auto", *argv[1:]])]
    argv = _placed(word, _named(argv, FIRST_WORDS.get(word, ())))
    words.refuse_words(argv, ())
    argv = words.quoted(argv)
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
            usual, argv = _looked_over(word, argv)
            cfg = hydra.compose(word, argv, return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)  # for what the settings take from Hydra, as the folder's name
            groups = {k: v for k, v in cfg.hydra.runtime.choices.items() if k.isidentifier()}
        OmegaConf.set_struct(cfg, False)
        del cfg["hydra"]
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        words.refuse_values(settings, usual)
        named = [k for k, v in settings.items() if isinstance(v, dict) and "_target_" in v]
        parts = _parts(cfg, named)
    except (HydraException, OmegaConfBaseException) as error:
        return _fail(errors.cause(error), show="traceback=true" in argv)
    module = importlib.import_module(CONFIGURED[word])
    _LOG.debug("%s: %s", word, ", ".join(f"{k}={v}" for k, v in groups.items()))
    keep_freed()
    try:
        with console.unsaid():
            return int(module.run({**settings, "choices": groups}, parts, progress=console.progress) or DONE)
    except errors.USER_ERRORS as error:
        return _fail(error, show=settings.get("traceback", False))


def _looked_over(name: str, argv: Sequence[str]) -> tuple[Any, list[str]]:
    """Refuse choices and options that the settings ``name`` do not have.

    Returns:
        What the choices alone compose to, and the words as Hydra takes them: with a format that is yet to be
        recognised, options of its reader are added to the settings.
    """
    import hydra  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    folder = config_dir()
    groups = [p.name for p in folder.iterdir() if p.is_dir()]
    words.refuse_choices(argv, folder)
    chosen = [a for a in argv if a.partition("=")[0] in groups]
    first = [a.partition(",")[0] if "[" not in a else a for a in chosen]
    composed: Any = OmegaConf.to_container(hydra.compose(name, first))
    swept = [(group, choice) for group, _, some in (a.partition("=") for a in chosen) for choice in some.split(",")[1:]]
    more = [f"{g}.{k}" for g, c in swept for k in words.names(_settings(folder / g / f"{c.strip()}.yaml"))]
    readers = _reader_options(folder) if any(a.startswith("data.") for a in argv) else []
    words.refuse_keys(argv, composed, groups, [*more, *words.reader_names(composed, readers)], IMPLIED)
    return composed, words.for_reader(argv, composed, readers)


def _reader_options(folder: Path) -> list[str]:
    """Names of all options that readers of captures have, by the settings of each; those of all are no reader's."""
    every = [_settings(path) for path in sorted((folder / "data").glob("*.yaml"))]
    reading = [each for each in every if str(each.get("_target_", "")).endswith(".open_capture")]
    common = set.intersection(*map(set, reading))
    return list(dict.fromkeys(name for each in reading for name in each if name not in common))


def _settings(path: Path) -> Any:
    from omegaconf import OmegaConf  # noqa: PLC0415

    return OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}


def _named(argv: list[str], options: Sequence[str]) -> list[str]:
    """The words with the names of the options that the first of them set."""
    for k, option in enumerate(options[: len(argv)]):
        if "=" in argv[k] and not Path(argv[k]).exists():
            break
        argv = [*argv[:k], f"{option}={quote(argv[k])}", *argv[k + 1 :]]
    return argv


def _without_result(first: Sequence[str]) -> bool:
    """Whether a first word, if there is one, is a place that holds no result."""
    place = Path(first[0]) if first and not first[0].startswith("-") else None
    if place is None or not place.exists() or place.suffix in (".json", ".ply"):
        return False
    return not any(place.glob("result.json")) and not any(place.glob("*/result.json"))


def _chosen(argv: Sequence[str], group: str) -> bool:
    return any(a.startswith(f"{group}=") for a in argv)


def _placed(name: str, argv: Iterable[str]) -> list[str]:
    """The words with the settings' own name of the folder of what is made, ``out`` or ``output``."""
    own = "out" if "out" in _settings(config_dir() / f"{name}.yaml") else "output"
    return [f"{own}={a.partition('=')[2]}" if a.startswith(("out=", "output=")) else a for a in argv]


def _show(name: str, argv: list[str]) -> int:
    """Hydra's own flags: help, the composed settings, shell completion."""
    import hydra  # noqa: PLC0415

    sys.argv = [sys.argv[0], *argv]
    hydra.main(config_path=str(config_dir()), config_name=name, version_base="1.3")(_job)()
    return DONE


def _refuse_flags(argv: Iterable[str], known: set[str]) -> None:
    for flag in (a for a in argv if a.startswith("-") and a not in known):
        near = console.suggestion(flag, {*known, *console.FLAGS, "--version"})
        raise ValueError(f"{flag}: found an unknown flag{near}, expected {', '.join(sorted(known))}")


def _run_hydra(argv: list[str]) -> int:
    import hydra  # noqa: PLC0415  (a sub-command must not pay for it)
    from hydra.core.global_hydra import GlobalHydra  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from hydra.types import RunMode  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    if SHOW & {a.split("=")[0] for a in argv}:
        return _show("run", argv)
    _refuse_flags(argv, SWEEP | SHOW)
    sweep = bool({*SWEEP, "hydra.mode=MULTIRUN"} & set(argv))
    overrides = words.quoted(_placed("run", [a for a in argv if a not in SWEEP]), sweep)
    if console.verbosity() == "quiet":
        overrides.append("hydra/hydra_logging=disabled")  # what a launcher says of its jobs
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
            engine: Any = GlobalHydra.instance().hydra
            mode = RunMode.MULTIRUN if sweep else RunMode.RUN
            # What is misspelt, or cannot be, fails here, in one line, before anything is run.
            usual, overrides = _looked_over("run", overrides)
            cfg = engine.compose_config("run", overrides, run_mode=mode, with_log_configuration=False)
            own: Any = OmegaConf.masked_copy(cfg, [k for k in cfg if k not in ("hydra", "output")])
            plain: Any = OmegaConf.to_container(own)
            words.refuse_values(plain, usual)
            folder = _output(cfg, overrides, sweep)
            overrides = [o for o in overrides if not o.startswith("output=")] + [f"output={quote(str(folder))}"]
            again = _again(argv, folder)
            with lock.held(folder.parent / f".{folder.name}.lock", f"output: {folder}"):
                if sweep:
                    return _sweep(engine, overrides, folder, again, show=cfg.traceback)
                return _single(engine, overrides, again)
    except (HydraException, OmegaConfBaseException) as error:
        return _fail(error)


def _single(engine: Any, overrides: Sequence[str], again: str) -> int:
    try:
        ended = engine.run("run", _job, list(overrides)).return_value
    except KeyboardInterrupt:
        print(f"dhtorch: interrupted, no result written. Once more:\n  {again}", file=sys.stderr)
        return INTERRUPTED
    return FAILED if ended.state == "failed" else DONE


def _sweep(engine: Any, overrides: Sequence[str], folder: Path, again: str, show: bool) -> int:
    """Run all jobs, then say how they ended."""
    from hydra.errors import HydraException  # noqa: PLC0415

    go_on = f"What is finished stays. To do the rest:\n  {again}"
    try:
        with together.watched(folder, _n_jobs(overrides)):
            batches = engine.multirun("run", _job, list(overrides))
    except KeyboardInterrupt:
        print(f"\ndhtorch: interrupted. {go_on}", file=sys.stderr)
        return INTERRUPTED
    except HydraException:
        raise
    except Exception as error:  # the launcher broke, as when a worker process is killed
        _fail(error, show)
        print(go_on, file=sys.stderr)
        return SOME_FAILED
    jobs = [job for batch in batches for job in batch]
    counts = Counter(job.return_value.state for job in jobs)
    shares = ", ".join(f"{counts[state]} {words}" for state, words in STATES.items())
    with console.unsaid():
        _compare([Path(j.return_value.folder) for j in jobs if j.return_value.state != "failed"], folder)
        print(f"{console.many(len(jobs), 'job')}: {shares}", flush=True)
    if not counts["failed"]:
        return DONE
    common = set.intersection(*(set(job.overrides) for job in jobs))
    for job in jobs:
        if job.return_value.state == "failed":
            name = " ".join(o for o in job.overrides if o not in common) or Path(job.return_value.folder).name
            print(f"failed: {name}: {job.return_value.error}", file=sys.stderr)
    print(go_on, file=sys.stderr)
    return SOME_FAILED


def _n_jobs(overrides: Sequence[str]) -> int:
    """Jobs of a sweep: every combination."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415

    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return math.prod(len(list(o.sweep_string_iterator())) for o in parsed if o.is_sweep_override())


def _compare(folders: Sequence[Path], sweep: Path) -> None:
    """The table of a sweep's jobs, and its file."""
    from dhtorch.experiments import report  # noqa: PLC0415
    from dhtorch.runtime import results as archive  # noqa: PLC0415

    report.print_sweep([archive.read(each / "result.json") for each in folders], sweep)


def _job(cfg: Any) -> Any:
    """One job, in whatever process a launcher runs it: build what the settings name and run it. Never raises."""
    if multiprocessing.current_process().name != "MainProcess":  # of a launcher
        leash.follow_parent()
    keep_freed()  # frame after frame asks for the same memory
    with console.neutral():
        return _run_job(cfg)


def _run_job(cfg: Any) -> Any:
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from hydra.errors import InstantiationException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    console.hush()
    console.listen()
    from dhtorch.cli import job  # noqa: PLC0415

    runtime = HydraConfig.get().runtime
    swept = not OmegaConf.is_missing(HydraConfig.get().job, "num")  # only jobs of a sweep are numbered
    sweep, name = Path(runtime.output_dir).parent, Path(runtime.output_dir).name
    try:
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        words.refuse_values(settings)
        parts = _parts(cfg, ("data", "method", "pairs", "experiment"))
        scenes = len(parts["data"]) if isinstance(parts["data"], Sequence) else 1
        progress = together.noting(sweep, name, scenes) if swept else console.progress
        _LOG.debug("job in %s: %s", runtime.output_dir, HydraConfig.get().job.override_dirname or "defaults")
        with console.unsaid():
            ended = job.run(
                settings, parts, dict(runtime.choices), Path(runtime.output_dir), progress=progress, swept=swept
            )
        if console.verbosity() == "quiet":
            print(Path(ended.folder) / "result.json", flush=True)
        return ended
    except Exception as error:
        cause = errors.cause(error)
        expected = isinstance(cause, (*errors.USER_ERRORS, OmegaConfBaseException, InstantiationException))
        _fail(cause, show=cfg.traceback or not expected)
        with contextlib.suppress(OSError):
            Path(runtime.output_dir).rmdir()  # where nothing is in it
        return job.Ended(runtime.output_dir, "failed", errors.line(cause))
    finally:
        if swept:
            together.finished(sweep, name)


def _parts(cfg: Any, names: Iterable[str]) -> dict[str, Any]:
    """What groups of the settings name, built."""
    from hydra.utils import instantiate  # noqa: PLC0415

    try:
        return {name: instantiate(cfg[name], _convert_="all") for name in names}
    except Exception as error:
        _refuse_stacks(errors.cause(error), cfg.data.get("root"))
        raise


def _refuse_stacks(error: BaseException, root: Any) -> None:
    """Focal stacks given as a recording: say what they are, and who reads them."""
    from dhtorch.data.io.decode import FormatError  # noqa: PLC0415
    from dhtorch.experiments.focal.formats import recognise_stacks  # noqa: PLC0415

    if not isinstance(error, FormatError) or error.args[:2] != (str(root), "format"):
        return
    with contextlib.suppress(FormatError):
        found = f"data: {root} holds focal stacks ({recognise_stacks(root)[0]}), pictures of one view"
        expected = "a recording whose camera moves; experiment=focus_stack data=stacks reads them"
        raise ValueError(f"{found}, expected {expected}") from error


def _output(cfg: Any, overrides: Iterable[str], sweep: bool) -> Path:
    """Folder of the job, or of the sweep, as an absolute name: workers may start elsewhere."""
    if not cfg.resume or any(o.startswith("output=") for o in overrides):
        return Path(str(cfg.output)).absolute()
    return (RESUMED if sweep else RESUMED / job_name(cfg.hydra.job.override_dirname)).absolute()


def _again(argv: Iterable[str], folder: Path) -> str:
    """The command that goes on where this one ended."""
    words = [a for a in argv if not a.startswith(("resume=", "output="))]
    own = any(a.startswith(("hydra.run.dir=", "hydra.sweep.dir=")) for a in words)
    place = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
    return shlex.join(["dhtorch", *words, "resume=true", *([] if own else [f"output={quote(str(place))}"])])


def _fail(error: BaseException, show: bool = False) -> int:
    if show:
        traceback.print_exception(error)
    print(f"dhtorch: {errors.line(error)}", file=sys.stderr)
    return FAILED
