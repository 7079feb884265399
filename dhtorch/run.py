"""The ``dhtorch`` command: Hydra turns names into functions, everything else happens in the library.

A first word that names a sub-command goes to that module; anything else is a list of Hydra overrides.
"""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

#: Sub-command → module with ``main(argv) -> int``.
COMMANDS = {"inspect": "dhtorch.capture", "report": "dhtorch.report"}

#: What bad input raises: reported in one line, without a traceback.
USER_ERRORS = (ValueError, OSError, KeyError, ImportError)

#: Flags of Hydra that do something else than run one job.
NOT_ONE_JOB = {
    "-m",
    "--multirun",
    "-h",
    "--help",
    "--hydra-help",
    "-i",
    "--info",
    "-sc",
    "--shell-completion",
    "-c",
    "--cfg",
}


def main(argv: list[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] in COMMANDS:
        try:
            return int(importlib.import_module(COMMANDS[argv[0]]).main(argv[1:]) or 0)
        except USER_ERRORS as error:
            return _fail(error, show="--traceback" in argv)
    return _run_hydra(argv)


def config_dir() -> Path:
    """The settings folder: inside an installed package, else beside the package in a checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise FileNotFoundError(f"settings folder: found neither {here / 'conf'} nor {here.parent / 'conf'}")


def _run_hydra(argv: list[str]) -> int:
    import hydra  # noqa: PLC0415  (a sub-command must not pay for it)
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    words = {a.split("=")[0] for a in argv}
    single = not (NOT_ONE_JOB & words)
    if single:
        try:  # a misspelt option fails here, in one line, before anything is imported or run
            with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
                hydra.compose("run", [a for a in argv if not a.startswith("-")])
        except (HydraException, OmegaConfBaseException) as error:
            return _fail(error)
    codes: list[int] = []

    def job(cfg: Any) -> int:
        code = _job(cfg)
        codes.append(code)
        if code and not single:
            raise SystemExit(code)  # the launcher of a sweep reports which job failed
        return code

    sys.argv = [sys.argv[0], *argv]
    hydra.main(config_path=str(config_dir()), config_name="run", version_base="1.3")(job)()
    return max(codes, default=0)


def _job(cfg: Any) -> int:
    """One job: build what the settings name, run the experiment, write and show the result. Returns the exit code."""
    from hydra.core.hydra_config import HydraConfig  # noqa: PLC0415
    from hydra.errors import InstantiationException  # noqa: PLC0415
    from hydra.utils import instantiate  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    try:
        runtime = HydraConfig.get().runtime
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        parts = {k: instantiate(cfg[k], _convert_="all") for k in ("data", "method", "pairs", "experiment")}
        _execute(settings, parts, dict(runtime.choices), Path(runtime.output_dir))
    except InstantiationException as error:
        return _fail(error.__cause__ or error, show=cfg.traceback)
    except (*USER_ERRORS, OmegaConfBaseException) as error:
        return _fail(error, show=cfg.traceback)
    return 0


def _execute(settings: dict[str, Any], parts: dict[str, Any], choices: Mapping[str, str], folder: Path) -> None:
    import torch  # noqa: PLC0415

    from dhtorch import archive, report  # noqa: PLC0415
    from dhtorch.data import files as data_files  # noqa: PLC0415
    from dhtorch.experiments.protocol import MIN_CANDIDATES  # noqa: PLC0415

    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        data_files.set_opencv_threads(settings["threads"])
    recordings = _recordings(parts["data"])
    digest = archive.data_digest(_files(recordings))
    key = archive.result_key(settings | {"choices": dict(choices)}, digest)
    target = folder / "result.json"
    if settings["resume"] and archive.finished(target, key):
        print(f"{target}: finished and valid, left untouched")
        return
    outcome = parts["experiment"](
        recordings, {choices["method"]: parts["method"]}, parts["pairs"], _common(settings), progress=_progress
    )
    meta = archive.meta(
        device=settings["device"], dtype=settings["dtype"], threads=torch.get_num_threads(), seed=settings["seed"]
    )
    scenes = [r.name for r in recordings]
    result = archive.build(
        experiment=choices["experiment"],
        key=key,
        meta=meta,
        config=settings,
        data={
            "name": choices["data"],
            "scenes": scenes,
            "n_pairs": outcome.n_pairs,
            "digest": digest,
        },
        summary=outcome.summary,
        rows=outcome.rows,
        question=outcome.question,
        expectation=outcome.expectation,
        verdict=outcome.verdict,
        why=outcome.why,
    )
    archive.write(target, result)
    report.print_tables(result)
    few = {r["scene"]: r["n_few"] for r in outcome.rows if r["pair"] is None and r["n_few"]}
    for scene, n in few.items():
        print(f"{scene}: {n} pair{'s' * (n > 1)} dropped, fewer than {MIN_CANDIDATES} candidates each")
    written = [target, *(_draw(outcome.examples, folder) if settings["figures"] else ())]
    if outcome.verdict:
        print(f"{outcome.verdict}: {outcome.why}")
    print("\n".join(["wrote", *(f"  {path}" for path in written)]))


def _common(settings: Mapping[str, Any]) -> Any:
    """The options that every pair of the job shares."""
    import torch  # noqa: PLC0415

    from dhtorch.experiments.protocol import Settings  # noqa: PLC0415

    dtype = getattr(torch, str(settings["dtype"]), None)
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype: found {settings['dtype']!r}, expected float32 or float64")
    holdout = settings["holdout"]
    for name, low in (("batch", 1), ("workers", 0)):
        if not isinstance(settings[name], int) or settings[name] < low:
            raise ValueError(f"{name}: found {settings[name]!r}, expected a whole number of at least {low}")
    return Settings(
        cutoff=holdout["cutoff"],
        truth=(holdout["truth"],),
        seed=settings["seed"],
        device=settings["device"],
        dtype=dtype,
        batch=settings["batch"],
        workers=settings["workers"],
    )


def _recordings(data: Any) -> list[Any]:
    """A data set is one recording or a list of them."""
    return data if isinstance(data, list) else [data]


def _files(recordings: Iterable[Any]) -> dict[str, Path]:
    """Relative name → file of everything below the recordings' folders."""
    files: dict[str, Path] = {}
    for root in {r.root for r in recordings if r.root is not None}:
        below = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
        files |= {f"{root.name}/{p.relative_to(root)}" if p != root else root.name: p for p in below}
    return files


def _progress(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
    """A progress bar on a terminal, nothing elsewhere."""
    from rich.progress import track  # noqa: PLC0415

    yield from track(items, description=f"{text:24}", total=total, disable=not sys.stderr.isatty(), transient=True)


def _draw(examples: Iterable[Any], folder: Path) -> list[Path]:
    """Figures and the point cloud of the first pair of every scene."""
    from dhtorch import figures  # noqa: PLC0415
    from dhtorch.codes import Source  # noqa: PLC0415
    from dhtorch.evaluate import errors, risk  # noqa: PLC0415
    from dhtorch.geometry.camera import unproject  # noqa: PLC0415
    from dhtorch.pair import merge  # noqa: PLC0415

    written = []
    for example in examples:
        e, here = example.cpu(), folder / example.scene
        here.mkdir(parents=True, exist_ok=True)
        whole, image, uv = merge(e.samples, e.estimate), e.frame.image[0], e.samples.uv[0]
        figures.draw_samples(here / "samples.png", image, uv, whole.source[0], e.estimate.gate[0])
        figures.draw_holes(here / "holes.png", image, uv, e.samples.hole[0])
        pooled = errors.select(e.estimate, e.truth)
        if pooled.keep.any():
            figures.draw_depth(here / "depth.png", pooled.true_depth, pooled.depth, pooled.score)
            curves = {e.method: risk.risk_coverage(pooled)}
            figures.draw_risk_coverage(
                here / "risk_coverage.png", curves, oracle=risk.risk_coverage(pooled, oracle=True)
            )
        filled = whole.source[0] != Source.NONE
        xyz = unproject(e.frame.camera, whole.uv, whole.depth)[0][filled]
        columns = {name: getattr(whole, name)[0][filled] for name in ("source", "sigma", "score")}
        figures.write_ply(here / "points.ply", xyz, **columns)
        written += sorted(here.iterdir())
    return written


def _fail(error: BaseException, show: bool = False) -> int:
    if show:
        traceback.print_exception(error)
    lines = [line for line in str(error).splitlines() if line.strip()]
    if any("Original Traceback" in line for line in lines):  # a data-loader worker sends its whole traceback along
        lines = lines[-1:]
    message = " ".join(" ".join(lines).split())
    print(f"dhtorch: {type(error).__name__}: {message}", file=sys.stderr)
    return 2
