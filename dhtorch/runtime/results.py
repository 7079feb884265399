"""Result files: one strict JSON per job, written atomically, with a key that identifies finished jobs.

A result holds the input (``experiment``, ``config``, ``data``), the output (``summary``, ``rows``, ``verdict``) and
``key``, a hash of settings, code and data: a job with an equal key need not run again.
"""

import contextlib
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dhtorch.runtime import code_dependencies
from dhtorch.runtime.output_folder import is_private
from dhtorch.runtime.safe_open import is_inside
from dhtorch.runtime.storage import (
    compute_file_digest,
    dump_strict_json,
    has_files,
    parse_strict_json,
    read_utf8,
    replace_file,
    to_strict_json,
)

_RESULT_SCHEMA = 1

_VERDICTS = ("supported", "refuted", "undecided")

#: Jobs without a research question: the main job, and the map of a recording.
_JOBS_WITHOUT_QUESTION = ("pair", "integrate")

#: Options that do not change the result: locations of files, additional output, device.
_NON_KEY_OPTIONS = frozenset(
    {"root", "folder", "cache", "output", "figures", "device", "resume", "traceback", "workers", "hydra"}
)

#: Options left out of a stored result.
_LOCAL_OPTIONS = ("hydra", "output")

#: x86 processor flag → name of the vector extension, widest first.
_VECTOR_FLAGS = {"amx_tile": "AVX-512 and AMX", "avx512f": "AVX-512", "avx2": "AVX2"}

_PACKAGES = ("dhtorch", "torch", "kornia", "numpy", "opencv-python-headless", "hydra-core")

#: Fields of a result and their types: several in a tuple, None = null; a list holds items of one kind; fields with
#: ``?`` were added later, or are no longer written; ``*`` stands for all other fields.
_TEXT_OR_NULL, _NUMBER_OR_NULL = (str, None), (float, None)
_SCHEMA: dict[str, Any] = {
    "schema": int,
    "experiment": str,
    "question": _TEXT_OR_NULL,
    "expectation": _TEXT_OR_NULL,
    "verdict": _TEXT_OR_NULL,
    "why": _TEXT_OR_NULL,
    "key": str,
    "meta": {
        "utc": str,
        "git": _TEXT_OR_NULL,
        "versions": dict,
        "device": str,
        "dtype": str,
        "threads": int,
        "seed": int,
        "processor?": str,
        "operators?": str,
        "code?": str,
    },
    "config": dict,
    "data": {"name": str, "scenes": list, "n_pairs": int, "digest": str},
    "summary": {
        "*": {"value": _NUMBER_OR_NULL, "low": _NUMBER_OR_NULL, "high": _NUMBER_OR_NULL, "n": int, "unit": str}
    },
    "rows": [
        {
            "scene": str,
            "pair": (list, None),
            "method": str,
            **dict.fromkeys(("truth?", "role?", "note?"), _TEXT_OR_NULL),
            "*": Any,
        }
    ],
    "seal?": str,
    "metrics?": [{"name": str, "larger_is_better": (bool, None), "with_interval": bool}],
}


def build_result(
    *,
    experiment: str,
    key: str,
    meta: Mapping[str, Any],
    config: Mapping[str, Any],
    data: Mapping[str, Any],
    summary: Mapping[str, Any],
    rows: list[Any],
    question: str | None = None,
    expectation: str | None = None,
    verdict: str | None = None,
    why: str | None = None,
    metrics: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Fields -> valid result in strict JSON: non-finite numbers become null, tuples and tensors lists.

    Args:
        experiment: its name; ``pair`` for the main job, which has no question.
        key: from :func:`compute_result_key`.
        meta: from :func:`collect_run_metadata`.
        config: resolved settings; file names are shortened as by :func:`make_portable`.
        data: ``{name, scenes, n_pairs, digest}``.
        summary: metric → ``{value, low, high, n, unit}``.
        rows: one per pair and, with pair null, one per scene.
        question, expectation, verdict, why: of an experiment with a question.
        metrics: by which jobs of this experiment are compared, ``{name, larger_is_better, with_interval}`` each; None =
            none is named.

    Raises:
        ValueError: a field is missing, unknown or of the wrong type; the message names it.
    """
    fields = {"question": question, "expectation": expectation, "verdict": verdict, "why": why, "key": key}
    parts: dict[str, Any] = {} if metrics is None else {"metrics": list(metrics)}
    parts |= {"meta": meta, "config": make_portable(config), "data": data, "summary": summary, "rows": rows}
    result = to_strict_json({"schema": _RESULT_SCHEMA, "experiment": experiment, **fields, **parts})
    validate_result(result)
    return dict(result)


def validate_result(result: Any, where: str = "result") -> None:
    """Check a result against schema 1.

    Raises:
        ValueError: names the first field that is missing, unknown, of the wrong type or out of range.
    """
    _check_kind(result, _SCHEMA, where)
    _expect(result["schema"] == _RESULT_SCHEMA, f"{where}.schema", result["schema"], str(_RESULT_SCHEMA))
    has_question = result["experiment"] not in _JOBS_WITHOUT_QUESTION
    for name in ("question", "expectation", "verdict", "why"):
        expected = "a text" if has_question else "null for this experiment"
        _expect(bool(result[name]) if has_question else result[name] is None, f"{where}.{name}", result[name], expected)
    verdicts = _VERDICTS if has_question else (None,)
    _expect(result["verdict"] in verdicts, f"{where}.verdict", result["verdict"], ", ".join(_VERDICTS))
    key = result["key"]
    _expect(len(key) == 64 and set(key) <= set("0123456789abcdef"), f"{where}.key", key, "64 hexadecimal digits")
    for k, row in enumerate(result["rows"]):
        pair = row["pair"]
        is_pair = pair is None or (len(pair) == 2 and all(_is_of_kind(v, int) for v in pair))
        _expect(is_pair, f"{where}.rows.{k}.pair", pair, "[i, j] or null")
    _check_finite(result, where)


def write_result(path: str | Path, result: Mapping[str, Any]) -> Path:
    """Write a result atomically: ``path`` holds either the old file or all of the new one.

    Raises:
        ValueError: the result is not valid; nothing is written.
    """
    validate_result(result, str(path))
    # Result -> JSON text with one line per summary entry and row: compact, and suited to diff
    lines = []
    for name, value in result.items():
        if name == "rows":
            body = "[\n" + ",\n".join(f"  {dump_strict_json(row)}" for row in value) + "\n ]" if value else "[]"
        elif isinstance(value, Mapping) and name != "config":
            body = (
                "{\n" + ",\n".join(f"  {dump_strict_json(k)}: {dump_strict_json(v)}" for k, v in value.items()) + "\n }"
                if value
                else "{}"
            )
        else:
            body = dump_strict_json(value)
        lines.append(f" {dump_strict_json(name)}: {body}")
    return replace_file(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode("utf-8"))


def read_result(path: str | Path) -> dict[str, Any]:
    """Read and validate a result; a folder means its ``result.json``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no regular file, too large, not strict JSON, or no valid result; the message names file and field.
    """
    path = Path(path)
    path = path / "result.json" if path.is_dir() else path
    if not path.exists():
        raise FileNotFoundError(f"{path}: found no file, expected a result.json or a folder with one")
    text = read_utf8(path)
    try:
        result = parse_strict_json(text)
    except ValueError as error:
        raise ValueError(f"{path}: found no strict JSON ({error}), expected a result") from error
    validate_result(result, str(path))
    return result


def is_finished(path: str | Path, key: str) -> bool:
    """Whether ``path`` holds a valid result of this key, so that the job need not run again."""
    try:
        return bool(read_result(path)["key"] == key)
    except (OSError, ValueError):
        return False


def compute_result_key(
    config: Mapping[str, Any],
    digest: str,
    *,
    roots: Iterable[str] = (),
    code_dir: str | Path | None = None,
    code: str | None = None,
) -> str:
    """SHA-256 over everything that determines a result: settings, reachable code, data digest.

    Args:
        config: resolved settings, without ``_NON_KEY_OPTIONS`` at every depth; absolute file names are shortened by
            :func:`make_portable`.
        digest: of the data, from :func:`compute_data_digest`.
        roots: further modules that take part, beside those named in the settings.
        code_dir: folder of this package; None = the installed one.
        code: digest from :func:`dhtorch.runtime.code_dependencies.compute_code_digest`; None = the bytes of all files
            that are reached, which are not parsed.
    """
    settings = json.dumps(_drop_non_key_options(make_portable(config)), sort_keys=True, default=str)
    total = hashlib.sha256()
    for text in (settings, digest, *(() if code is None else (code,))):
        _update_digest(total, text.encode())
    targets = [*code_dependencies.iter_targets(config), *roots]
    files = code_dependencies.find_reachable_modules(targets, code_dir) if code is None else {}
    for name, file in files.items():
        _update_digest(total, name.encode())
        _update_digest(total, file.read_bytes())
    return total.hexdigest()


def list_files_below(roots: Iterable[tuple[Path | None, Path | None]]) -> dict[str, Path | str]:
    """Name → path of all files below folders (or single files); names are independent of the folders' locations.

    Args:
        roots: (folder or file, the folder that links must not leave or a file in it; None = links are followed). A link
            that leaves it, or that leads to a folder listed before, is a text: where it leads.
    """
    files: dict[str, Path | str] = {}
    for k, (root, bounds) in enumerate((root, bounds) for root, bounds in dict(roots).items() if root is not None):
        if root.is_dir():
            files |= {f"{k}/{path.relative_to(root).as_posix()}": entry for path, entry in _iter_files(root, bounds)}
        else:
            files[f"{k}/{root.name}"] = root
    return files


def _iter_files(root: Path, bounds: Path | None) -> Iterator[tuple[Path, Path | str]]:
    """Path of every file and link below a folder, and what :func:`list_files_below` lists for it; folders that cannot
    be read are left out."""
    starts, listed = [root], set[str]()
    for start in starts:  # grows by linked folders
        if os.path.realpath(start) in listed:
            yield start, f"link to {start.readlink()}"
            continue
        for place, folders, names in os.walk(start):
            folders.sort()
            if (real := os.path.realpath(place)) in listed:
                folders.clear()
                continue
            listed.add(real)
            for path in (Path(place, name) for name in sorted((*folders, *names))):
                if is_private(path.relative_to(root)):
                    continue
                if path.is_symlink() and bounds is not None and not is_inside(path, bounds):
                    yield path, f"link to {path.readlink()}"
                elif path.is_symlink() and path.is_dir():
                    starts.append(path)
                elif path.is_file():
                    yield path, path


def list_files_named(settings: Mapping[str, Any]) -> dict[str, Path]:
    """Option → path of the existing file it names, e.g. weights: its content, not its path, enters the key."""
    return {f"settings/{name}": path for name, path in _iter_paths("", settings) if path.is_file()}


def compute_data_digest(files: Mapping[str, Path | str]) -> str:
    """SHA-256 over data files: their names and the SHA-256 of their content; no files for synthetic data.

    Args:
        files: relative name → path, which itself does not enter, or a text, which does.
    """
    total = hashlib.sha256()
    for name in sorted(files):
        entry = files[name]
        _update_digest(total, name.encode())
        _update_digest(total, entry.encode() if isinstance(entry, str) else bytes.fromhex(compute_file_digest(entry)))
    return total.hexdigest()


def check_same_run(folder: Path, file: Path, here: Mapping[str, Any], writer: str) -> None:
    """Check that an output folder is empty, or that its metadata are those of this run.

    Args:
        folder: the output folder.
        file: JSON in it that an earlier run wrote.
        here: metadata of this run, with ``key``.
        writer: the command that writes such files, for the message.

    Raises:
        FileExistsError: other files, a damaged file, or one of other settings, data or code.
    """
    if not file.is_file():
        if has_files(folder):
            expected = "expected an empty folder, or one that this command wrote"
            raise FileExistsError(f"out: {folder} holds other files, {expected}")
        return
    try:
        there = parse_strict_json(read_utf8(file))
        difference = "" if there["key"] == here["key"] else describe_difference(there, here)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"{type(error).__name__} {error}"
        raise FileExistsError(
            f"{file}: found {problem}, expected a file written by dhtorch {writer}; remove the folder or set out=DIR"
        ) from None
    if difference:
        raise FileExistsError(
            f"{file}: found files of another run ({difference}), expected the same settings or another out=DIR"
        )


def describe_difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Text of the first difference between the metadata of two runs (``config``, ``data``, ``git``, ``version``)."""
    here_values, there_values = _flatten("", here["config"]), _flatten("", there["config"])
    for name in sorted(here_values.keys() | there_values.keys()):
        if here_values.get(name) != there_values.get(name):
            return f"{name} {there_values.get(name)} there, {here_values.get(name)} here"
    if there["data"]["digest"] != here["data"]["digest"]:
        return "other data"
    versions = [meta.get("git") or meta.get("version") for meta in (there, here)]
    return "other code" + (f": {versions[0]} there, {versions[1]} here" if versions[0] != versions[1] else "")


def collect_run_metadata(*, device: str, dtype: str, threads: int, seed: int, operators: str) -> dict[str, Any]:
    """Time, code version, package versions, hardware and seed of a job.

    ``operators`` is what computes those with compiled kernels: :func:`dhtorch.ops.loader.describe_operators`.
    """
    versions: dict[str, str | None] = {"python": platform.python_version(), **dict.fromkeys(_PACKAGES)}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "git": read_git_revision(Path(__file__).parents[1]),
        "versions": versions,
        "processor": describe_processor(),
        "operators": operators,
        "device": str(device),
        "dtype": str(dtype).removeprefix("torch."),
        "threads": threads,
        "seed": seed,
    }


def describe_processor(info: str | Path = "/proc/cpuinfo") -> str:
    """Processor name, family, model and widest vector extension, on which speed depends.

    A narrower extension set by ATEN_CPU_CAPABILITY is added.

    Args:
        info: Linux' description; on other systems the name from :mod:`platform` is used.
    """
    capability = os.environ.get("ATEN_CPU_CAPABILITY", "").upper()
    try:
        lines = Path(info).read_text(encoding="utf-8", errors="replace").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields = {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
    flags = fields.get("flags", "").split()
    vectors = next((word for flag, word in _VECTOR_FLAGS.items() if flag in flags), platform.machine())
    model = f"family {fields['cpu family']} model {fields['model']}" if {"cpu family", "model"} <= set(fields) else ""
    vectors = f"{vectors} held to {capability}" if capability and vectors != capability else vectors
    return ", ".join(word for word in (fields.get("model name", ""), model, vectors) if word)


def make_portable(config: Mapping[str, Any], base: str | Path | None = None) -> dict[str, Any]:
    """Settings without machine-specific paths.

    An absolute file name, and any ``root``, becomes relative to ``base`` (None: the environment variable DHTORCH_DATA)
    if below it, else its last component; ``hydra`` and ``output`` are left out.
    """
    base = os.environ.get("DHTORCH_DATA") if base is None else base

    def shorten(name: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(k): shorten(str(k), v) for k, v in value.items() if k not in _LOCAL_OPTIONS}
        if isinstance(value, list | tuple):
            return [shorten(name, v) for v in value]
        if not (isinstance(value, str | Path) and str(value) and (name == "root" or Path(value).is_absolute())):
            return value
        resolved = Path(value).expanduser().resolve()
        within = None if base is None else Path(base).expanduser().resolve()
        if within is not None and resolved != within and resolved.is_relative_to(within):
            return resolved.relative_to(within).as_posix()
        return resolved.name

    return {str(k): shorten(str(k), v) for k, v in config.items() if k not in _LOCAL_OPTIONS}


def _check_kind(value: Any, kind: Any, where: str) -> None:
    """Check a value against a kind of :data:`_SCHEMA`."""
    if isinstance(kind, dict):
        _expect(isinstance(value, dict), where, value, "an object")
        known = {name.rstrip("?"): name for name in kind if name != "*"}
        for name, field in known.items():
            if name in value:
                _check_kind(value[name], kind[field], f"{where}.{name}")
            elif name == field:
                raise ValueError(f"{where}.{name}: found nothing, expected {_describe_kind(kind[field])}")
        for name in sorted(value.keys() - known):
            if "*" not in kind:
                expected = ", ".join(name for name, field in known.items() if name == field or name in value)
                raise ValueError(f"{where}.{name}: found an unknown field, expected {expected}")
            _check_kind(value[name], kind["*"], f"{where}.{name}")
    elif kind is not Any:
        allowed = kind if isinstance(kind, tuple) else (type(kind) if isinstance(kind, list) else kind,)
        _expect(any(_is_of_kind(value, k) for k in allowed), where, value, _describe_kind(kind))
        for k, item in enumerate(value if isinstance(kind, list) else ()):
            _check_kind(item, kind[0], f"{where}.{k}")


def _is_of_kind(value: Any, kind: Any) -> bool:
    if kind is None:
        return value is None
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, int | float) if kind is float else isinstance(value, kind)


def _describe_kind(kind: Any) -> str:
    kind_names = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "a text",
        dict: "an object",
        list: "a list",
        None: "null",
    }
    kinds = kind if isinstance(kind, tuple) else (type(kind) if isinstance(kind, dict | list) else kind,)
    return " or ".join(kind_names[k] for k in kinds)


def _expect(condition: bool, where: str, value: Any, expected: str) -> None:
    if not condition:
        shown = repr(value)
        raise ValueError(f"{where}: found {shown if len(shown) <= 60 else shown[:57] + '...'}, expected {expected}")


def _check_finite(value: Any, where: str) -> None:
    if isinstance(value, dict):
        for k, v in value.items():
            _check_finite(v, f"{where}.{k}")
    elif isinstance(value, list):
        for k, v in enumerate(value):
            _check_finite(v, f"{where}.{k}")
    elif isinstance(value, float):
        _expect(math.isfinite(value), where, value, "a finite number or null")


def _update_digest(total: Any, part: bytes) -> None:
    """Add a part with its length, so that different sequences of parts differ."""
    total.update(len(part).to_bytes(8, "big"))
    total.update(part)


def _drop_non_key_options(config: Any) -> Any:
    if isinstance(config, Mapping):
        return {str(k): _drop_non_key_options(v) for k, v in config.items() if str(k) not in _NON_KEY_OPTIONS}
    return [_drop_non_key_options(v) for v in config] if isinstance(config, list | tuple) else config


def _flatten(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        return {name: value}
    return {k: v for key, inner in value.items() for k, v in _flatten(f"{name}.{key}".lstrip("."), inner).items()}


def _iter_paths(name: str, value: Any) -> Iterator[tuple[str, Path]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _iter_paths(f"{name}.{key}", inner)
    elif isinstance(value, list | tuple):
        for k, inner in enumerate(value):
            yield from _iter_paths(f"{name}.{k}", inner)
    elif isinstance(value, str) and (os.sep in value or Path(value).suffix):
        yield name, Path(value).expanduser()


def read_git_revision(folder: Path) -> str | None:
    """Output of ``git describe`` for ``folder``, None without version control."""

    def run_git(*words: str) -> str | None:
        try:
            command = ["git", "-C", str(folder), *words]
            completed = subprocess.run(command, check=False, capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.SubprocessError):
            return None
        return completed.stdout.strip() if completed.returncode == 0 else None

    if run_git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    return run_git("describe", "--always", "--dirty", "--tags") or None
