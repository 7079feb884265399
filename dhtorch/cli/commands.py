"""The commands of ``dhtorch``: summary, description, examples and the options that ``--help`` shows.

Defaults and descriptions of options are read from the comments of ``conf/NAME.yaml``, so that each is written once.
"""

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

#: Columns of a help text. Source: terminals are at least this wide.
_HELP_WIDTH = 110

#: Columns of the names in a list of commands or options.
_NAME_WIDTH = 22

_EXIT_LINE = "Exit code: 0 done, 2 bad option or bad data, 130 interrupted."
_LIMIT_EXIT_LINE = "Exit code: 0 done, 1 a limit is exceeded, 2 bad option or bad data, 130 interrupted."


@dataclass(frozen=True)
class Command:
    """Help of one command."""

    group: str
    summary: str  # in the list of commands
    usage: str  # arguments after the command's name
    text: str
    examples: tuple[tuple[str, str], ...]  # (arguments, effect)
    options: tuple[str, ...]  # names shown by --help
    config: str = ""  # file of conf/ whose options the command has as well
    exit_line: str = _EXIT_LINE
    words: str = ""  # what is typed; empty: the command's own name


class _OptionNote(NamedTuple):
    """Default value and description of an option, as its settings file has them."""

    default: str
    note: str

    @property
    def is_switch(self) -> bool:
        """Whether the option is true or false, so that ``--option`` alone sets it."""
        return self.default in ("true", "false") or self.note.startswith("true | false")


#: (unknown name, known names) → text with the nearest known name.
Suggest = Callable[[str, Iterable[str]], str]

#: Values that may follow a switch.
_SWITCH_VALUES = ("true", "false", "null", "all")

_YOURS, _SETS, _CHECKS, _STUDIES = "Your capture", "Data sets", "Depth from elsewhere", "Experiments"

#: Name → command, in the order of the list.
COMMANDS: dict[str, Command] = {
    "recover": Command(
        _YOURS,
        "depth beyond the sensor's range: completed maps, a 3D map, a page",
        "PATH",
        "Recovers depth beyond the sensor's range from a capture of your own and prints how to continue. Frames "
        "are processed in an order that covers the capture at any time, until the time limit. Writes depth/, "
        "sigma/, source/, meta/ and previews/ of every frame, overview.png (picture, sensor, completed), "
        "preview.mp4, map.ply, map.glb and view.html (3D, in any browser).",
        (
            ("PATH", "recover depth, print a summary and the next step"),
            ("PATH --minutes null", "every frame, without a time limit"),
            ("PATH --out DIR --size 320 --max-frames 10", "another folder, smaller maps, ten frames"),
        ),
        (
            "out",
            "minutes",
            "max_frames",
            "every",
            "method",
            "device",
            "size",
            "format",
            "fov",
            "K",
            "depth_unit",
            "recordings",
            "cutoff",
            "mesh",
        ),
        words="dhtorch",
    ),
    "inspect": Command(
        _YOURS,
        "frames, rates, depth and poses of a capture, what will not work, a contact sheet",
        "PATH",
        "Prints the content of a capture, warnings with their remedies, and writes a contact sheet. Captures "
        "are searched for at PATH and up to two folders below it.",
        (
            ("PATH", "everything that is found"),
            ("PATH --max-frames 3", "decode three frames instead of eight"),
            ("PATH --fov 69 --out DIR", "a capture without intrinsics; folder of the contact sheet"),
        ),
        ("out", "format", "max_frames", "follow_links", "fov", "K", "depth_unit", "camera", "traceback"),
    ),
    "view": Command(
        _YOURS,
        "a capture, a result or a PLY file in 3D, as a page or in Rerun",
        "PATH | RESULT | FILE.ply",
        "Shows a capture, a result of the run command or points in 3D. Without html and save Rerun's viewer "
        "opens (pip install 'dhtorch[view]'); without a screen view.rrd is written, without Rerun view.html. "
        "A result is computed again with its own settings.",
        (
            ("PATH --html view.html --max-frames 6", "six reference views of a capture, as a page"),
            ("PATH --dense --max-frames 3", "with depth for every pixel; takes seconds a view"),
            ("outputs/2026-01-31/12-00-00 --html view.html", "a result of the run command"),
        ),
        ("html", "save", "out", "max_frames", "every", "method", "device", "dense", "scene", "root", "seed"),
    ),
    "demo": Command(
        _YOURS,
        "the built-in room through the whole way of `dhtorch PATH`; opens the page",
        "",
        "Writes a small capture of the built-in synthetic room, whose sensor ends at 2.5 m, completes it as "
        "`dhtorch PATH` does, and opens the page in a browser where there is a screen.",
        (
            ("", "capture and result in dhtorch_out/demo"),
            ("--out DIR", "another folder"),
            ("--max-frames 3 --no-browser", "three frames; only print where the page is"),
        ),
        ("out", "max_frames", "every", "method", "device", "size", "minutes", "browser"),
        config="recover",
    ),
    "complete": Command(
        _SETS,
        "depth and sigma for every pixel of every frame, as PNG files",
        "PATH --out DIR",
        "Completes the depth of every frame from the sensor and other views. Writes depth/, sigma/ and "
        "source/ (0 none, 1 sensor, 2 and 3 recovered, 5 filled) as PNG, meta/ as JSON (units, camera, source views, "
        "reasons for no answer). 0 is no depth. DIR is a recording again where the capture's format, or "
        "numbered frames, can hold it.",
        (
            ("PATH --out DIR", "any recording in a known format"),
            ("PATH --out DIR --max-frames 20 --every 10 --points", "twenty frames; the first as PLY and GLB"),
            ("PATH --out DIR --cutoff 2.0 --size 320", "as if the sensor ended at 2 m; smaller maps"),
        ),
        (
            "out",
            "max_frames",
            "every",
            "method",
            "device",
            "size",
            "cutoff",
            "format",
            "unit",
            "arrays",
            "budget",
            "sensor",
            "points",
            "figures",
            "fov",
        ),
    ),
    "enrich": Command(
        _SETS,
        "a LeRobot or nerfstudio data set with depth, sigma and camera columns",
        "SRC DST",
        "Writes a data set with depth, sigma and camera of every image. SRC is never written to; its columns "
        "are copied unchanged, its videos byte for byte.",
        (
            ("SRC DST", "any recording or data set in a known format, as LeRobot v3"),
            ("SRC DST --max-frames 10 --fov 69", "a trial; a robot data set without intrinsics"),
            ("SRC DST --format nerfstudio", "transforms.json with depth and confidence; needs poses"),
        ),
        (
            "format",
            "max_frames",
            "every",
            "method",
            "device",
            "dense",
            "workers",
            "fov",
            "K",
            "camera",
            "episode",
            "columns",
            "maps",
            "on_error",
        ),
    ),
    "extract": Command(
        _SETS,
        "features and tokens of every frame of a data set, as Parquet shards",
        "PATH --out DIR",
        "Writes the features of a whole data set, one row per frame, in Parquet shards; "
        "dhtorch.extract.FeatureTable reads them.",
        (
            ("PATH --out features --workers 8", "any recording or data set"),
            ("PATH --out features --gap 20 --columns tokens,tokens_valid", "only tokens, 20 frames apart"),
            ("PATH --out maps --dense '{size: 224}' --half", "and maps of depth and sigma"),
        ),
        (
            "out",
            "max_frames",
            "every",
            "method",
            "device",
            "gap",
            "tokens_hw",
            "fit",
            "dense",
            "columns",
            "half",
            "workers",
            "engine",
            "on_error",
            "fov",
        ),
    ),
    "integrate": Command(
        _SETS,
        "one map of a recording: PLY, GLB, COLMAP",
        "PATH",
        "Fuses sensor depth and recovered depth into one map, weighted by their sigma. Writes map.ply, "
        "map.glb, points.ply, colmap/ (for trainers of splats), map.png and result.json (voxels covered with "
        "and without recovered depth).",
        (
            ("PATH --voxel 0.01", "a recording with its own trajectory, voxels of 1 cm"),
            ("PATH --poses anchored", "without a trajectory: poses from the method, chained"),
            ("PATH --dense --max-frames 20", "every pixel: surfaces instead of patches, seconds a frame"),
        ),
        (
            "out",
            "max_frames",
            "every",
            "method",
            "device",
            "poses",
            "voxel",
            "cutoff",
            "dense",
            "mesh",
            "axes",
            "min_conf",
            "min_maps",
        ),
    ),
    "stream": Command(
        _SETS,
        "a recording frame by frame, each from the frames before it: speed and coverage",
        "PATH",
        "Processes a recording frame by frame, each from the frames before it. Prints frames per second and "
        "the recovered fraction, and writes stream.json, one row per frame.",
        (
            ("PATH", "any recording in a known format"),
            ("PATH --max-frames 50 --method.n 1024", "its first fifty frames, 1024 samples each"),
            ("--data synthetic --method map", "the built-in room, one source view"),
        ),
        ("out", "max_frames", "every", "method", "device", "cutoff", "steps", "seed", "fov"),
    ),
    "validate": Command(
        _CHECKS,
        "is this depth right? Per-pixel verdict, likely causes of errors",
        "PATH [--depth DIR]",
        "Compares depth with other views and, for maps of a network, with the sensor. Every pixel is "
        "consistent, wrong or unknown (no baseline, no texture, occluded). Writes validate.json and "
        "validate.html, worst first.",
        (
            ("PATH", "the sensor's own depth"),
            ("PATH --depth DIR", "maps of a network, with the sensor as reference"),
            ("PATH --depth DIR --fail-on 'wrong>0.05,scale>0.1'", "exit code 1 where a limit is exceeded"),
        ),
        (
            "depth",
            "depth_unit",
            "fail_on",
            "out",
            "max_frames",
            "every",
            "method",
            "device",
            "views",
            "window",
            "size",
            "tolerance",
            "fov",
        ),
        exit_line=_LIMIT_EXIT_LINE,
    ),
    "align": Command(
        _CHECKS,
        "depth maps of a network in metres, with a sigma for every pixel",
        "PATH --depth DIR --out DIR",
        "Aligns depth maps to the recording's near returns and, beyond them, to depth from other views; a map "
        "that they do not contradict stays unchanged. Writes depth/, sigma/, source/ and meta/ as complete "
        "does, align.json and align.html, worst first.",
        (
            ("PATH --depth DIR --out DIR", "maps in metres, correct or not"),
            ("PATH --depth DIR --out DIR --kind inverse", "disparity up to a scale and a shift"),
            ("PATH --depth DIR --out DIR --fail-on 'scale>0.1'", "exit code 1 where a limit is exceeded"),
        ),
        (
            "depth",
            "kind",
            "depth_unit",
            "out",
            "max_frames",
            "every",
            "method",
            "device",
            "fail_on",
            "format",
            "cutoff",
            "max_sigma_rel",
            "fov",
        ),
        exit_line=_LIMIT_EXIT_LINE,
    ),
    "scale": Command(
        _CHECKS,
        "a reconstruction (COLMAP, nerfstudio, VGGT, splats) in metres, or where it is bent",
        "MODEL CAPTURE",
        "Measures the size of a reconstruction with the near returns of an RGB-D capture of the same scene, and "
        "writes the model in metres in its own format, scale.json and scale.html (scale by frame, picture region "
        "and range). A model whose parts, or whose camera path and depths, have different scales is refused, with "
        "where and how much.",
        (
            ("MODEL CAPTURE", "a COLMAP folder, transforms.json, npz files or a splat's PLY"),
            ("MODEL CAPTURE --sensor iphone_lidar", "with the accuracy of the capture's sensor"),
            ("MODEL CAPTURE --frame capture --out DIR", "also turned and moved to the capture's poses"),
        ),
        ("out", "images", "sensor", "cutoff", "frame", "max_frames", "tolerance", "fov", "depth_unit"),
        exit_line="Exit code: 0 done, 1 the model is refused, 2 bad option or bad data, 130 interrupted.",
    ),
    "pin": Command(
        _CHECKS,
        "was a camera moved, when and by how much? A reference against pictures or episodes",
        "REF SOURCE",
        "Compares pictures with a reference view of a fixed camera: offset in mm and degrees with sigma, shift in "
        "px, and moved, not moved or cannot know at a stated rate of false alarms. Robots and objects that move or "
        "hide the scene are left out; only REF needs depth. Writes pin.json and pin.html, worst first.",
        (
            ("REF SET", "the first recording of REF against every episode of a data set"),
            ("REF picture.png --fail-on 'moved>2px'", "exit code 1 where the camera moved"),
            ("REF 0 --guide", "a live camera: which way to push the mount"),
        ),
        (
            "fail_on",
            "guide",
            "out",
            "max_frames",
            "every",
            "ref_frames",
            "false_alarm_rate",
            "device",
            "fov",
            "K",
            "camera",
        ),
        exit_line=_LIMIT_EXIT_LINE,
    ),
    "run": Command(
        _STUDIES,
        "an experiment with hidden depth as ground truth, or a sweep",
        "[PATH] [GROUP=NAME ...]",
        "Hides the sensor's returns beyond a cutoff, recovers them and reports the error, or runs another "
        "experiment. All of Hydra's grammar works: groups (method, data, pairs, holdout, experiment, launch), "
        "key=value, --multirun. Without PATH and data= it uses the built-in synthetic room. Every job writes "
        "one result.json.",
        (
            ("PATH --cutoff 2.0", "returns beyond 2 m hidden"),
            ("--multirun method=paper,map,auto seed=0,1,2", "a sweep: nine jobs"),
            ("-m launch=joblib resume=true output=DIR method=map,paper", "on all cores, resumable"),
        ),
        (
            "method",
            "data",
            "pairs",
            "holdout",
            "experiment",
            "launch",
            "cutoff",
            "gap",
            "out",
            "device",
            "seed",
            "threads",
            "resume",
            "figures",
        ),
        exit_line="Exit code: 0 done, 1 some jobs of a sweep failed, 2 bad option or bad data, 130 interrupted.",
    ),
    "report": Command(
        _STUDIES,
        "tables and a page from result.json files",
        "RESULT ...",
        "Prints the tables of results, or writes one page with tables and figures. RESULT is a result.json or "
        "a folder with one or many below it.",
        (
            ("outputs", "all results below a folder"),
            ("outputs --html report.html", "one page with tables and figures"),
            ("RESULT --markdown", "tables as Markdown"),
        ),
        ("html", "markdown", "traceback"),
    ),
    "fetch": Command(
        _STUDIES,
        "the public scenes behind the tables of the docs, licences shown first",
        "SET",
        "Downloads the scenes of data=SET from their public addresses: what is there with the right digest stays, an "
        "interrupted download goes on. Licences and sources are printed first; without --yes they must be accepted at "
        "the terminal. SET is shared_scenes; data=shared_scenes reads them from the folder that DHTORCH_DATA names.",
        (
            ("shared_scenes", "print the licences, ask, download into DHTORCH_DATA"),
            ("shared_scenes --yes --out DIR", "accept them; another folder"),
            ("shared_scenes --table FILE.json", "from the addresses of another table, as of a mirror"),
        ),
        ("out", "yes", "table", "traceback"),
    ),
}

#: Option that no settings file describes → its default and description.
_SHARED_NOTES = {
    "quiet": _OptionNote("", "-q: print only results and errors; -v also logs inputs and steps"),
    "data": _OptionNote("", "a reader or a built-in scene: auto, synthetic, tum, … (see --help-all)"),
    "method": _OptionNote("", "paper, map, auto or fused, see docs/methods.md"),
    "pairs": _OptionNote("", "source views: auto (selected by the method), gap, time or baseline"),
    "holdout": _OptionNote("", "range (returns beyond the cutoff are hidden) or none"),
    "experiment": _OptionNote("", "pair, range_split, ablation, method_comparison, … (see --help-all)"),
    "launch": _OptionNote("", "jobs of a sweep: basic (one by one), joblib, ray, submitit_local, submitit_slurm"),
    "holdout.cutoff": _OptionNote("null", "m; returns beyond it are hidden and serve as ground truth"),
    "pairs.gap": _OptionNote("null", "frames between the two of a pair (pairs=gap)"),
}

#: Options of readers, of which every command that reads a capture has ``--NAME`` beside ``data.NAME=VALUE``.
READER_NOTES = {
    "fov": _OptionNote("null", "horizontal field of view, degrees, of a capture without intrinsics"),
    "K": _OptionNote("null", "fx,fy,cx,cy, px, of a capture without intrinsics"),
    "intrinsics": _OptionNote("null", "a feature's name, fx,fy,cx,cy or the horizontal field of view"),
    "depth_unit": _OptionNote("null", "m, cm, mm, inch or metres of one step; null = as stated, else assumed"),
    "depth_lag": _OptionNote("null", "frames by which the depth comes late"),
    "depth_turn": _OptionNote("null", "rotation of the depth: 90, 180, 270, left_right, upside_down"),
    "pose_convention": _OptionNote("null", "of the stated poses: opengl, world_to_camera, wxyz, mm, joined by +"),
    "camera": _OptionNote("null", "of several: one or a list"),
    "episode": _OptionNote("null", "of several: one or a list"),
    "follow_links": _OptionNote("false", "follow links that lead out of the capture"),
}

#: Short name → dotted name, in commands with that group.
_SHORT_NAMES = {"run": {"cutoff": "holdout.cutoff", "gap": "pairs.gap", "out": "output"}}

_OPTION_LINE = re.compile(r"(?P<indent> *)\"?(?P<name>\w+)\"?:(?P<default>.*?)(?: +# (?P<note>.*))?$")


def read_option_notes(file: Path) -> dict[str, _OptionNote]:
    """Options of a settings file with their defaults and comments; those below a node have dotted names.

    Groups are taken from the list of defaults.
    """
    notes: dict[str, _OptionNote] = {}
    node = ""
    for line in file.read_text(encoding="utf-8").splitlines():
        if match := re.match(r"  - (\w+): (\w+)", line):
            notes[match[1]] = _OptionNote(match[2], _SHARED_NOTES.get(match[1], _OptionNote("", "")).note)
            continue
        match = _OPTION_LINE.match(line)
        if not match or match["name"] in ("defaults", "_target_"):
            continue
        if match["name"] == "hydra" and not match["indent"]:
            break
        if not match["indent"]:
            node = "" if match["default"].strip() else f"{match['name']}."
        name = f"{node}{match['name']}" if match["indent"] else match["name"]
        notes[name] = _OptionNote(match["default"].strip(), match["note"] or "")
    return notes


def list_options(name: str, conf: Path) -> dict[str, _OptionNote]:
    """All options of a command by dotted name, those of readers as ``data.NAME``."""
    own = {
        k: note
        for file in filter(None, (COMMANDS[name].config, name))
        for k, note in read_option_notes(conf / f"{file}.yaml").items()
    }
    if name == "run":
        own |= {k: _SHARED_NOTES[k] for k in ("holdout.cutoff", "pairs.gap")}
    if name in ("report", "fetch", "demo"):
        return own
    return {**{f"data.{option}": note for option, note in READER_NOTES.items()}, **own}


def _resolve_option(name: str, option: str, known: Mapping[str, _OptionNote]) -> str | None:
    """Dotted name of an option that is typed without the node above it; None where the command has no such option."""
    plain = option.replace("-", "_")
    plain = _SHORT_NAMES.get(name, {}).get(plain, plain)
    if plain in ("out", "output"):
        plain = next((own for own in ("out", "output") if own in known), plain)
    return next((full for full in (plain, f"{name}.{plain}", f"data.{plain}") if full in known), None)


# ---------------------------------------------------------------------------------------------------------- help texts


def format_overview(exit_codes: Mapping[int, str]) -> str:
    """Text of ``dhtorch --help``: commands in groups, one line each."""
    lines = ["dhtorch: metric depth beyond the sensor's range from RGB-D views, with a sigma for every pixel.", ""]
    lines += ["  dhtorch COMMAND PATH [--option value | option=value ...]"]
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += [f"{group}:"]
        for name, command in COMMANDS.items():
            if command.group == group:
                lines.append(f"  {'PATH' if name == 'recover' else name:<12}{command.summary}")
    lines += [
        "",
        "dhtorch help COMMAND or COMMAND --help: its options; --help-all: every option; --cfg job: composed settings.",
    ]
    lines += ["-q, --quiet: print only results and errors. -v, --verbose: log inputs and steps. --version."]
    lines += textwrap.wrap(
        "Exit code: " + ", ".join(f"{k} {text}" for k, text in exit_codes.items()) + ".", _HELP_WIDTH
    )
    lines += ['Shell completion: eval "$(dhtorch -sc install=bash)"']
    return "\n".join(lines)


def format_command_help(name: str, conf: Path) -> str:
    """Text of ``dhtorch NAME --help``: what it does, examples, its main options."""
    command, known = COMMANDS[name], list_options(name, conf)
    typed = command.words or f"dhtorch {name}"
    lines = [f"{typed} {command.usage} [--option value | option=value ...]".replace("  ", " "), ""]
    lines += [*textwrap.wrap(command.text, _HELP_WIDTH), "", "Examples:"]
    width = max(len(f"{typed} {arguments}".rstrip()) for arguments, _ in command.examples) + 2
    lines += [f"  {f'{typed} {arguments}'.rstrip():<{width}}{effect}" for arguments, effect in command.examples]
    lines += ["", "Options, with their defaults:"]
    for option in command.options:
        full = _resolve_option(name, option, known)
        assert full is not None, (name, option)
        lines += _format_option(option, known[full])
    lines += _format_option("quiet", _SHARED_NOTES["quiet"])
    more = "--help-all: every option. --cfg job: the settings as composed."
    return "\n".join([*lines, "", more, command.exit_line])


def _format_option(option: str, note: _OptionNote) -> list[str]:
    """Lines of one option: name, default, description."""
    default = {"???": "(required)", "null": "-"}.get(note.default, note.default)
    default = "outputs/DATE/TIME" if "${now" in default else default
    head = f"  --{option.replace('_', '-'):<{_NAME_WIDTH - 4}}{default:<12} "
    indent = " " * (_NAME_WIDTH + 13)
    lines = textwrap.wrap(note.note, _HELP_WIDTH, initial_indent=indent, subsequent_indent=indent) or [""]
    if len(head) > len(indent):
        return [head.rstrip(), *lines]
    return [f"{head}{lines[0].lstrip()}".rstrip(), *lines[1:]]


# ----------------------------------------------------------------------------------------------------------- arguments


#: Flags of Hydra with a value → their long form, in which the value stays beside its flag.
HYDRA_VALUE_FLAGS = {"-c": "--cfg", "-i": "--info", "-p": "--package"}
HYDRA_VALUE_FLAGS |= {long: long for long in HYDRA_VALUE_FLAGS.values()}


def to_overrides(
    name: str, argv: Sequence[str], known: Mapping[str, _OptionNote], flags: Iterable[str], suggest: Suggest
) -> list[str]:
    """``--option value``, ``--option=value``, ``--switch`` and ``--no-switch`` -> ``option=value``; the rest unchanged.

    Args:
        name: the command.
        argv: its arguments.
        known: its options by dotted name.
        flags: flags that stay, as of Hydra.
        suggest: (unknown name, known names) → text with the nearest.

    Raises:
        ValueError: an unknown option, or an option without its value.
    """
    words, out = list(argv), []
    while words:
        word = words.pop(0)
        flag, sign, value = word.partition("=")
        full = None
        if flag.startswith("--") and flag != "--" and flag not in flags:
            option = flag.removeprefix("--")
            full = option if "." in option else _resolve_option(name, option, known)
            if full is None and option.startswith("no-") and not sign:
                full, value = _resolve_option(name, option.removeprefix("no-"), known), "false"
                sign = "=" if full is not None and known[full].is_switch else ""
                full = full if sign else None
            if full is None:
                names = [each.rpartition(".")[2].replace("_", "-") for each in known]
                long_flags = sorted(each for each in flags if each.startswith("--"))
                near = suggest(option, [*(each[2:] for each in long_flags), *names]).replace("mean ", "mean --")
                expected = ", ".join(["one listed by --help", *long_flags])
                raise ValueError(f"{flag}: found an unknown option{near}, expected {expected}")
            if not sign:
                is_switch = full in known and known[full].is_switch
                is_value = bool(words) and not words[0].startswith("--")
                has_value = is_value and (not is_switch or words[0] in _SWITCH_VALUES or words[0].startswith("{"))
                if not has_value and not is_switch:
                    raise ValueError(f"{flag}: found no value, expected {flag} VALUE")
                value = words.pop(0) if has_value else "true"
        elif word in HYDRA_VALUE_FLAGS and words and words[0][:1] != "-" and "=" not in words[0]:
            word = f"{HYDRA_VALUE_FLAGS[word]}={words.pop(0)}"
        elif sign and re.fullmatch(r"\w[\w.-]*", flag):
            full = _resolve_option(name, flag, known)
        # With the option's dotted name, and in brackets where the default is a list
        default, note = known.get(full or "", _OptionNote("", ""))
        is_list = default.startswith("[") or note.startswith("list ")
        value = f"[{value}]" if is_list and not value.startswith(("[", "null")) else value
        out.append(word if full is None else f"{full}={value}")
    return out
