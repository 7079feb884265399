"""What is typed, with which files, and what is printed: one way to type every command, and one line for every slip."""

import logging
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support import box_scene, writers
from support.tiny_runs import TINY

import dhtorch
from dhtorch.cli import job, run
from dhtorch.cli.commands import (
    COMMANDS,
    _resolve_option,
    format_overview,
    list_options,
    read_option_notes,
    to_overrides,
)
from dhtorch.cli.option_checks import quote_words
from dhtorch.ops import loader
from dhtorch.runtime import console

# -------------------------------------------------------------------------------------------------------- files given


def walk(n=2, hw=(24, 32)):
    return box_scene.walk(n, hw=hw)


def folders(*names):
    """Folders, with empty files where a name has an ending."""

    def make(root):
        for name in names:
            place = root / name
            (place.parent if place.suffix else place).mkdir(parents=True, exist_ok=True)
            if place.suffix:
                place.write_bytes(b"x")

    return make


def images(*names):
    """Noise as RGB images, depth maps of 16 bits where a name has ``depth`` in it, other files else."""

    def make(root):
        for name in names:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            is_depth = "depth" in name
            noise = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
            if name.endswith((".hdf5", "broken.png")):
                (root / name).write_bytes(b"no image")
            else:
                Image.fromarray(np.full((24, 32), 900, np.uint16) if is_depth else noise).save(root / name)

    return make


def capture(layout="counted", removed="", place="scan", n=2, **changes):
    """A capture of a layout below ``place``, without the files of a pattern and the folders that are then empty."""

    def make(root):
        write = writers.write_counted_frames if layout == "counted" else writers.CAPTURE_WRITERS[layout].write
        write(root / place, [frame.replace(**changes) for frame in walk(n)])
        for path in root.glob(f"{place}/{removed}") if removed else ():
            path.unlink()
            if not any(path.parent.iterdir()):
                path.parent.rmdir()

    return make


def r3d(*kept):
    """A .r3d file with the entries that begin with one of ``kept``."""

    def make(root):
        conf = torch.full((1, 24, 32), 2, dtype=torch.uint8)
        writers.write_r3d(root / "whole.r3d", [frame.replace(conf=conf) for frame in walk()])
        with zipfile.ZipFile(root / "whole.r3d") as whole, zipfile.ZipFile(root / "scan.r3d", "w") as lacking:
            for name in (name for name in whole.namelist() if name.startswith(kept)):
                lacking.writestr(name, whole.read(name))

    return make


def link(root):
    """A capture whose files are links to those of another folder."""
    capture(place="elsewhere/scan")(root)
    (root / "room").mkdir()
    for file in (root / "elsewhere/scan").iterdir():
        (root / "room" / file.name).symlink_to(file)


def several(*makers):
    """What several of these write."""
    return lambda root: [make(root) for make in makers]


def blind(root):
    """A TUM sequence whose depth maps are all 0."""
    writers.write_tum(root / "blind", [frame.replace(depth=0 * frame.depth) for frame in walk(4)])


def alone(root):
    """Depth of a Stray Scanner capture without its video."""
    writers.write_stray(root / "alone", walk(3), video=False)


def maps(root):
    """A map of the built-in room, as a network gives it."""
    (root / "maps").mkdir()
    for k in range(3):
        np.save(root / "maps" / f"{k}.npy", np.ones((6, 8)))


# ---------------------------------------------------------------------------------------------- the table of one line

NO_DEPTH = "blind: 4 frames, none of the 4 examined has depth; sensor depth"
LACKS = "content: found"
ROOM = "data=synthetic data.hw=[48,64] data.depth_hw=[48,64] data.supersample=1 data.n_frames=3"
PHONE_APPS = "Record3D|Stray Scanner|Polycam's raw data|Scaniverse"
KITCHEN = folders("captures/kitchn")

#: Command line, what writes the files given, and the parts of the one line that is printed, joined by ``|``; the exit
#: code is 2. A part that begins with ``!`` is not in it.
REFUSED = [
    # Commands, options and paths that are misspelt
    ("complete x --size", None, "--size: found no value|expected --size VALUE"),
    ("complete x --max-frame 3", None, "--max-frame|(did you mean --max-frames?)"),
    ("complete x --no-size", None, "--no-size|unknown option"),
    ("/nope/room.r3d", None, "/nope/room.r3d: no such file or folder"),
    ("./captures/kitchen", KITCHEN, "./captures/kitchen: no such file or folder|did you mean captures/kitchn?"),
    ("kitchn.r3d", KITCHEN, "kitchn.r3d: no such file or folder"),
    ("capturs", KITCHEN, "capturs: no such file or folder (did you mean captures?)"),
    ("inspec captures", KITCHEN, "inspec: found an unknown argument (did you mean inspect?)"),
    ("compleet --help", None, "compleet: found an unknown argument (did you mean complete?)"),
    ("help recovr", None, "recovr: found an unknown argument (did you mean recover?)"),
    ("inspect captures --cgf job", KITCHEN, "--cgf: found an unknown option (did you mean --cfg?)"),
    ("inspect captures fow=63", KITCHEN, "fow: found an unknown option (did you mean fov?)"),
    ("inspect captures data.fow=63", KITCHEN, "data.fow: found an unknown option (did you mean data.fov?)"),
    ("inspect captures max_frame=3", KITCHEN, "max_frame: found an unknown option (did you mean max_frames?)"),
    ("inspect captures -x", KITCHEN, "-x: found an unknown flag"),
    ("inspect scan data.registr=false", capture(), "did you mean data.register?"),
    ("report captures htlm=x.html", KITCHEN, "htlm: found an unknown option (did you mean html?)"),
    ("inspct x", None, "dhtorch: inspct: |inspect"),
    ("version", None, "dhtorch: version: |--version"),
    ("nonsense", None, "dhtorch: nonsense: |complete"),
    ("pair.gap=3", None, "dhtorch: pair.gap: |pairs.gap"),
    ("+pair.gap=3", None, "dhtorch: pair.gap: |pairs.gap"),
    ("++sede=3", None, "dhtorch: sede: |seed"),
    ("sede=1", None, "sede"),
    ("method=mop", None, "dhtorch: method: |map"),
    ("method=papr", None, "papr|paper"),
    ("method.track.windw=3", None, "dhtorch: method.track.windw: |method.track.window"),
    (shlex.join([*TINY, "+method.nothing=1"]), None, "method.nothing: found an unknown option"),
    ("data=auto data.root=x data.camra=front", None, "dhtorch: data.camra: |data.camera"),
    ("data=tum data.root=x data.registr=false", None, "dhtorch: data.registr: |an unknown option"),
    ("data.camera=front", None, "dhtorch: data.camera: |an unknown option"),
    ("recover . data.format=tum", None, "dhtorch: data.format: |format"),
    ("--multrun", None, "dhtorch: --multrun: |--multirun"),
    ("--config-name=other", None, "--config-name|--multirun"),
    ("integrate vxel=1", None, "dhtorch: vxel: |voxel"),
    ("-m seed=0,1 pairs.gp=3", None, "dhtorch: pairs.gp: |pairs.gap"),
    ("-m method=choice(paper,mop)", None, "dhtorch: method: |map"),
    ("-m method=glob(zz*)", None, "dhtorch: method: |one of auto"),
    ("-m method=paper,opencvv", None, "opencvv"),
    ("-m hydra/launcher=nowhere seed=0,1", None, "dhtorch[scale]"),
    # Values
    ("seed=x", None, "dhtorch: seed: |whole number"),
    ("seed=1.5", None, "dhtorch: seed: |whole number"),
    ("method.n=0", None, "dhtorch: method.n: |at least 1"),
    ("method.n=nan", None, "dhtorch: method.n: |whole number"),
    ("method.pose.far_weight=a", None, "dhtorch: method.pose.far_weight: |number"),
    ("method.sample.foveation=-1", None, "foveation"),
    ("pairs.gap=abc", None, "dhtorch: pairs.gap: |whole number"),
    ("data.hw=60", None, "dhtorch: data.hw: |list"),
    ("data.lidar=radar", None, "radar|phone"),
    ("holdout.cutoff=far", None, "dhtorch: holdout.cutoff: |positive"),
    ("holdout.cutoff=-1", None, "holdout.cutoff|-1"),
    ("holdout.truth=best", None, "holdout.truth|best"),
    ("figures=maybe", None, "dhtorch: figures: |true"),
    ("threads=0", None, "dhtorch: threads: |at least 1"),
    ("dtype=int8", None, "dtype|int8"),
    ("batch=0", None, "batch|0"),
    ("workers=-1", None, "workers: found -1, expected a whole number of at least 0"),
    ("device=gpu", None, "device|gpu"),
    ("integrate voxel=abc", None, "dhtorch: voxel: |positive"),
    ("integrate voxel=-1", None, "voxel|-1"),
    ("complete . siez=3 out=o", capture(place="."), "siez: found an unknown option|size"),
    ("complete . planes=1 out=o", capture(place="."), "planes: found 1, expected a whole number of at least 2"),
    ("complete . unit=0.2 out=o", capture(place="."), "unit: found 0.2, expected a number above 1e-06, at most 0.1"),
    ("complete . format=jpg out=o", capture(place="."), "format: found 'jpg', expected one of auto, frames, tum"),
    ("complete . figures=some out=o", capture(place="."), "figures: found 'some', expected true or false or all"),
    ("complete . format=tum out=o", capture(place="."), "format=tum: |has no time stamps"),
    ("complete . format=stray out=o", capture(place="."), "is a frames_dir recording, not a Stray"),
    ("complete . unit=0 out=o", capture(place="."), "unit: found 0"),
    ("complete . steps=[] out=o", capture(place="."), "steps: found none"),
    ("complete . source_views=0 out=o", capture(place="."), "source_views: found 0"),
    ("complete . sensor=kinect out=o", capture(place="."), "sensor: found 'kinect', expected one of"),
    ("scan minutes=-1", capture(), "dhtorch: minutes: found -1, expected"),
    ("scan axes=sideways", capture(), "axes"),
    ("scan --out scan/out", capture(), "is inside the capture, which is never written to"),
    ("enrich scan scan/out", capture(), "inside the source scan, which is never written to"),
    ("enrich scan o columns=7", capture(), "columns"),
    ("enrich scan o columns=[sigma]", capture(), "columns: found ['sigma'], expected depth and any of"),
    ("enrich scan o columns=[depth,cause] format=nerfstudio", capture(), "columns: found cause with format=nerfstudio"),
    ("enrich scan o format=zarr", capture(), "format: found 'zarr', expected one of lerobot, v3.0"),
    ("enrich scan o engine=spark", capture(), "engine: found 'spark', expected one of local, ray"),
    ("enrich scan o on_error=skip", capture(), "on_error: found 'skip', expected one of raise, flag"),
    ("enrich scan o pose=none", capture(), "pose: found 'none', expected one of near, device, start"),
    ("enrich scan o maps=text", capture(), "maps: found 'text', expected one of numbers, images"),
    ("enrich scan o pose_sigma=[1,1]", capture(), "pose_sigma: found [1, 1] with pose=near"),
    ("enrich scan o causal=maybe", capture(), "causal: found 'maybe', expected true or false"),
    ("enrich scan o shard_rows=0", capture(), "shard_rows: found 0, expected a whole number of at least 1"),
    ("enrich scan o gap=-1", capture(), "gap: found -1, expected a whole number of at least 0"),
    ("enrich scan o step=2", capture(), "step: found 2, expected a number from 0 to 1"),
    ("enrich scan o fps=0", capture(), "fps: found 0, expected a number from 0.0001 to 10000"),
    ("enrich scan o cameras=true", capture(), "cameras: found 1 of 32x24 pixels, gap=auto, expected two or more"),
    ("enrich scan o format=same", capture(), "format=same: found frames_dir, which dhtorch cannot write"),
    (f"validate {ROOM} fail_on=wrong", None, "fail_on: found 'wrong', expected NAME>NUMBER, separated by commas"),
    (f"validate {ROOM} fail_on='colour>1'", None, "fail_on: found 'colour>1'"),
    (f"validate {ROOM} depth=/nowhere", None, "no folder"),
    (f"validate {ROOM} window=1", None, "window: found 1, expected 0 or at least 2 frames"),
    (f"validate {ROOM} window=-1", None, "window: found -1"),
    (f"validate {ROOM} size=8", None, "size: found 8, expected a whole number of at least 16"),
    (f"validate {ROOM} every=0", None, "every: found 0"),
    (f"validate {ROOM} tolerance=0.5", None, "tolerance"),
    (f"align {ROOM} depth=maps out=o kind=wrong", maps, "kind: found 'wrong', expected one of metric"),
    (f"align {ROOM} depth=maps out=o fail_on='colour>1'", maps, "fail_on"),
    (f"align {ROOM} depth=maps out=o kind=inverse fail_on='scale>0.1'", maps, "expected kind=metric"),
    (f"align {ROOM} depth=/nowhere out=o", None, "no folder"),
    (f"align {ROOM} depth=maps out=o every=0", maps, "every: found 0"),
    (f"align {ROOM} depth=maps out=o pictures=-1", maps, "pictures: found -1, expected a whole number of at least 0"),
    ("pin scan 99", capture(), "camera"),
    ("pin scan scan fail_on=moved<2", capture(), "fail_on"),
    ("pin scan scan max_frames=0", capture(), "max_frames: found 0"),
    ("pin scan scan ref_frames=0", capture(), "ref_frames: found 0"),
    ("scale . scan --sensor sonar", capture(), "sensor: found 'sonar', expected one of iphone_lidar"),
    ("scale . scan --frame sky", capture(), "frame: found 'sky'"),
    ("scale . scan --out .", capture(), "out: found the model's own folder"),
    ("scale . scan --tolerance -1", capture(), "tolerance: found -1"),
    ("scale . scan max_frames=null", capture(), "max_frames: found None, expected a whole number of at least 1"),
    ("view data=synthetic max_frames=0", None, "max_frames: found 0"),
    ("view data=synthetic max_frames=null html=a.html", None, "max_frames: found None"),
    ("inspect scan max_frames=null", capture(), "max_frames: found None"),
    ("fetch scenes", None, "set: found 'scenes', expected one of shared_scenes"),
    ("report", None, "result: found no value"),
    ("view data=synthetic scene=7 html=a.html", None, "scene: found 7, expected a number below 1 or one of"),
    ("view html=a.txt", None, "a.txt: expected a file name that ends in .html"),
    ("demo --browser=maybe", None, "browser: found 'maybe', expected true or false"),
    ("demo --out mine", folders("mine/notes.txt"), "has other content, expected a new or empty folder"),
    ("fetch shared_scenes --table t.json", folders("t.json"), "t.json: found no table of scenes"),
    ("report nowhere", None, "nowhere"),
    *(
        (f"{words} --device cuda:7", make, "dhtorch: device: found 'cuda:7', expected cpu")
        for words, make in {
            **{f"{name} data=synthetic": None for name in ("stream", "validate", "view", "integrate")},
            **{"extract data=synthetic out=o": None, "align data=synthetic depth=maps out=o": maps},
            **{f"{words} scan": capture() for words in ("recover", "complete out=o", "pin scan", "scale scan", "run")},
            **{"enrich scan o": capture(), "demo --no-browser --max-frames 1 --out d": None, shlex.join(TINY): None},
        }.items()
    ),
    # Values that are missing
    ("data=auto", None, "dhtorch: data.root: |data.root=VALUE"),
    ("complete .", None, "dhtorch: out: |out=VALUE"),
    ("data=shared_scenes", None, "DHTORCH_DATA"),
    ("extract", None, "out=VALUE"),
    # Captures that lack something
    *(
        (words, blind, NO_DEPTH)
        for words in ("blind", "complete blind --out o", "integrate blind", "stream blind", "run blind --cutoff 2")
    ),
    ("enrich blind o", blind, f"{NO_DEPTH}|without_depth=true writes empty maps"),
    *(
        (words, capture(layout, removed), f"{said}|!focal stack|!no known format")
        for words in ("scan",)
        for layout, removed, said in [
            ("stray", "odometry.csv", "a Stray Scanner capture without odometry.csv, expected the whole folder"),
            ("stray", "camera_matrix.csv", "a Stray Scanner capture without camera_matrix.csv, expected the whole"),
            ("stray", "*.csv", "a Stray Scanner capture without odometry.csv, camera_matrix.csv, expected the whole"),
            ("stray", "depth/*", "a Stray Scanner capture without depth/, expected the whole folder"),
            ("stray", "rgb.mp4", "requires: a Stray Scanner capture without rgb.mp4, expected the whole folder of"),
            ("record3d_exr", "EXR_RGBD/metadata.json", "EXR + RGB export of Record3D without metadata.json, expected"),
            ("record3d_exr", "EXR_RGBD/depth/*", "an EXR + RGB export of Record3D without depth/*.exr, expected"),
            ("record3d_exr", "EXR_RGBD/rgb/*", "an EXR + RGB export of Record3D without rgb/*.jpg, expected the whole"),
            ("polycam", "keyframes/depth/*", "Polycam's raw data without depth/, expected all folders of keyframes/"),
            ("polycam", "keyframes/*cameras/*", "Polycam's raw data without cameras/*.json, expected all folders"),
            ("polycam", "keyframes/*images/*", "Polycam's raw data without images/, expected all folders"),
            ("tum", "depth/*", "a TUM RGB-D sequence without depth/, expected both folders"),
            ("tum", "rgb/*", "a TUM RGB-D sequence without rgb/, expected both folders"),
            ("scannet", "color/*", "a ScanNet export without color/, expected the folders of SensReader"),
            ("bop", "rgb/*", "a BOP scene without rgb/, expected the whole folder"),
            ("colmap", "images/*", "a COLMAP model without images/, expected its images"),
            ("named_frames", "*.color.png", "found none complete among 2, expected frame-XXXXXX.color.{jpg,png}"),
            ("named_frames", "*.depth.png", ".pose.txt; frame 0: no depth: left out"),
            ("arkitscenes", "41048190/lowres_depth/*", "an ARKitScenes capture without lowres_depth/, expected these"),
        ]
    ),
    *(
        (words, capture("stray", "odometry.csv", "above/scan"), f"scan: {LACKS} a Stray Scanner capture without odome")
        for words in ("above", "inspect above", "stream above", "run above --cutoff 2")
    ),
    ("scan.r3d", r3d("rgbd/"), "metadata: found none among 6 files, expected a whole export of Record3D: metadata"),
    ("scan.r3d", r3d("metadata"), "frames: found none, expected a whole export of Record3D: metadata with rgbd/"),
    ("scan.r3d", r3d("metadata", "rgbd/0.jpg"), "found frame 0: no depth: left out|share it from the app again"),
    *(
        (path, folders(f"scans/{name}"), f"{PHONE_APPS}|!rectified")
        for name in ("scan.usdz", "scan.obj", "scan.mp4")
        for path in ("scans", f"scans/{name}")
    ),
    ("posed", capture(removed="depth/*", place="posed", n=3), "3 pictures without depth|poses.txt|!still camera"),
    ("stream posed", capture(removed="depth/*", place="posed", n=3), "3 pictures without depth"),
    ("photos", images("photos/a.jpg"), "1 picture without depth|Record3D"),
    ("one", images("one/a.png", "one/depth.png"), "one frame"),
    ("alone", alone, "depth without images"),
    ("empty", folders("empty"), f"{LACKS} an empty folder"),
    ("complete empty output=o", folders("empty"), "empty: format|!out:"),
    ("validate empty out=o", folders("empty"), "empty: format"),
    (
        "x",
        images("x/1.jpg", "x/2.jpg", "x/depth.png"),
        "2 pictures and 1 depth map of no known format (2 .jpg, depth.pn",
    ),
    (
        "x",
        images("x/depth/1.png", "x/depth/2.png"),
        "x: 2 depth maps of no known format (depth/ (2 .png)); a layout of",
    ),
    ("x", images("x/1.jpg", "x/2.jpg", "x/1.hdf5"), "2 pictures of no known format (1.hdf5, 2 .jpg); a layout of docs"),
    ("x", images("x/a/1.jpg", "x/b/2.jpg"), "x: 2 pictures without depth; sensor depth"),
    ("x", images("x/broken.png"), "x: no readable image (broken.png)"),
    ("x", images("x/focus_stack_1.png", "x/focus_stack_2.png"), "focal stacks (images) of a still camera"),
    ("inspect x", folders("x/notes.txt"), f"{LACKS} no capture here or up to two folders below"),
    ("inspect x", folders("x/room.zip"), "room.zip: an archive, unpack it first"),
    ("inspect x", folders("x/clip.mp4"), "clip.mp4: a video without depth"),
    ("inspect x", folders("x/a/b/c/d.png"), "no capture here or up to two folders below: a/b/c/ (|from a phone: "),
    ("inspect x --format frame_dir", folders("x"), "format: found frame_dir, expected auto, record3d"),
    ("inspect x --max-frames 0", folders("x"), "max_frames: found 0, expected a whole number of at least 1"),
    ("inspect scan --K 1,2,3", capture(), "option K: found [1.0, 2.0, 3.0], expected 4 finite numbers"),
    ("inspect scan follow_links=maybe", capture(), "data.follow_links: found 'maybe', expected true or false"),
    ("inspect scan data.camera=front", capture(), "format frames_dir has no option 'camera', expected one of intrins"),
    (
        "stream above",
        several(capture(place="above/a"), capture(place="above/b")),
        "found 2 captures below, expe",
    ),
]


@pytest.mark.parametrize(("typed", "make", "words"), REFUSED, ids=[f"{k}: {row[0]}" for k, row in enumerate(REFUSED)])
def test_what_cannot_be_done_is_one_line_before_any_work(command, monkeypatch, tmp_path, typed, make, words):
    monkeypatch.setattr(job, "run", lambda *_, **__: pytest.fail("work was begun"))
    if make is not None:
        make(tmp_path)
    before = {*tmp_path.rglob("*")}
    code, out, err = command(*shlex.split(typed))
    *notes, line = err.strip().splitlines()
    assert (
        code == 2
        and (not out.strip() or typed.startswith("pin "))
        and line.startswith("dhtorch: ")
        and "Traceback" not in err
    ), (out, err)
    assert all("depth unit assumed" in note or "a guess" in note for note in notes), err
    for word in words.split("|"):
        assert (word.removeprefix("!") in line) != word.startswith("!"), (word, line)
    written = [path for path in {*tmp_path.rglob("*")} - before if path.is_file() and "d/room" not in str(path)]
    assert not written, "nothing is left"


@pytest.mark.parametrize(
    ("typed", "make", "words"),
    [
        ("complete --help-all", None, "min_correlation: 0.75|method: auto, |_target_"),
        ("complete x --cfg job --out d --size 96", None, "root: x|size: 96"),
        ("~holdout --cfg job", None, "cutoff: .inf"),
        ("help complete", None, "dhtorch complete PATH|Exit code: 0 done"),
        ("-sc install=bash", None, "complete |hydra_bash_completion"),
        ("inspect scan data.register=false --out o", capture(), "scan.png"),
        ("inspect room follow_links=true --out o", link, "frames_dir ("),
        ("inspect 'room [1]' --format frames_dir", capture(place="room [1]"), "room [1]|wrote outputs/|/room_1_.png"),
        ("inspect up", several(capture(place="up/a"), capture(place="up/b")), "up/a|up/b|up_a.png|up_b.png"),
        (
            "inspect x",
            several(capture("tum", place="x/a/s"), images("x/1.jpg", "x/a/1.jpg", "x/a/2.jpg")),
            "tum (|x_a_s.png",
        ),
        ("inspect scan --fov 63 --depth-unit=mm data.depth_lag=1", capture(removed="K.txt", n=3), "field of view 63°"),
        ("inspect x --fov 63 --out o", images("x/0.png"), "not a recording: data.fov not used"),
        ("inspect x --out o", images("x/1.jpg", "x/2.jpg"), "x: 2 pictures without depth; sensor depth of near surf"),
        ("stream above --max-frames 1 --method.n 64", capture("tum", place="above/one", n=3), "one: 1 frame"),
        (shlex.join([*TINY, "+data.name=kitchen", "out=a=b"]), None, "wrote "),
        (shlex.join([*TINY, "method.n=64"]), None, "1 pair skipped: fewer than 20 candidate samples"),
        ("fetch shared_scenes --help", None, "--yes"),
        ("enrich blind o dense=false method.n=64 without_depth=true report=false", blind, "o: 1 episode, 4 frames"),
    ],
)
def test_what_is_typed_is_done(command, tmp_path, typed, make, words):
    if make is not None:
        make(tmp_path)
    code, out, err = command(*shlex.split(typed))
    assert code == 0, err
    for word in words.split("|"):
        assert word in " ".join(out.split()), (word, out)


@pytest.mark.slow
def test_a_process_ends_with_the_code_of_the_call(tmp_path):
    """The command as a shell starts it: nothing but its words on stderr, and the exit code."""
    for typed, make, code, words in [
        ("inspect scan --out o", capture(n=3), 0, "frames_dir"),
        ("report nowhere", None, 2, "nowhere"),
        ("--version", None, 0, dhtorch.__version__),
    ]:
        if make is not None:
            make(tmp_path)
        command = [sys.executable, "-m", "dhtorch", *typed.split()]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == code and words in (done.stderr if code else done.stdout), done.stderr


# ----------------------------------------------------------------------------------------------------- one way to type


@pytest.fixture
def called(monkeypatch):
    """Settings with which the module of a command is called; it does nothing."""
    seen = []
    record = SimpleNamespace(run=lambda settings, *_, **__: seen.append(settings))
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: record))
    monkeypatch.setattr(run, "_instantiate_parts", lambda *_: {})
    return seen


@pytest.mark.parametrize(
    ("name", "typed", "expected"),
    [
        ("complete", "x --out d --max-frames 3", "x out=d max_frames=3"),
        ("complete", "x --out=d max-frames=3", "x out=d max_frames=3"),
        ("stream", "x --out d", "x output=d"),
        ("complete", "--points --no-figures x", "points=true figures=false x"),
        ("complete", "--points x --arrays false", "points=true x arrays=false"),
        ("complete", "--fov 69 --K 1,2,3,4 x", "data.fov=69 data.K=1,2,3,4 x"),
        ("extract", "x --gap 5 --columns a,b --tokens-hw 56,56", "x extract.gap=5 extract.columns=[a,b] extract.tokens_hw=[56,56]"),
        ("extract", "--dense --half", "extract.dense=true extract.half=true"),
        ("run", "x --cutoff 2.0 --method.n 512", "x holdout.cutoff=2.0 method.n=512"),
        ("run", "--multirun method=map,paper --cfg job", "--multirun method=map,paper --cfg=job"),
        ("recover", "x --mesh --minutes null", "x mesh=true minutes=null"),
    ],
)  # fmt: skip
def test_options_and_overrides_are_the_same(name, typed, expected):
    known = list_options(name, run.config_dir())
    assert to_overrides(name, typed.split(), known, {"--multirun", "--cfg"}, console.suggest_name) == expected.split()


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("inspect x --fov 63 --max-frames 3", {"path": "x", "max_frames": 3, "data": {"fov": 63}}),
        ("inspect --fov=63 x max_frames=3", {"path": "x", "max_frames": 3, "data": {"fov": 63}}),
        ("inspect fov=63 K=1,2,3,4 x", {"path": "x", "data": {"fov": 63, "K": [1, 2, 3, 4]}}),
        ("inspect data.fov=63 x --data.fps 30 --depth-lag -1", {"data": {"fov": 63, "fps": 30, "depth_lag": -1}}),
        ("inspect x --follow-links --camera a,b", {"data": {"follow_links": True, "camera": ["a", "b"]}}),
        ("inspect x format=tum --no-traceback depth_unit=mm", {"format": "tum", "data": {"depth_unit": "mm"}}),
        ("report x html=-a.html", {"result": ["x"], "html": "-a.html"}),
        ("report x x --markdown", {"result": ["x", "x"], "markdown": True}),
        ("fetch shared_scenes --yes --out d", {"set": "shared_scenes", "yes": True, "out": "d"}),
    ],
)
def test_what_is_typed_becomes_settings(command, called, typed, expected):
    Path("x").mkdir()
    assert command(*typed.split()) == (0, "", "")
    (settings,) = called
    given = settings | {"data": {k: v for k, v in settings.get("data", {}).items() if v not in (None, False)}}
    assert {k: given[k] for k in expected} == expected


def test_every_option_that_a_message_of_inspect_names_can_be_typed(command, called):
    """Options of readers in the texts of all modules that read, check or show a capture."""
    root = Path(dhtorch.__file__).parent
    files = [*(root / "data").rglob("*.py"), *(root / "validation").rglob("*.py"), root / "cli/inspect.py"]
    names = {name for file in files for name in re.findall(r"\bdata\.(\w+)=", file.read_text())} - {"NAME"}
    assert {"K", "fov", "K_depth", "depth_unit", "depth_turn", "pose_convention", "camera", "trajectory"} <= names
    typed = [f"data.{name}=1" for name in sorted(names - {"follow_links", "K", "K_depth"})]
    assert command("inspect", ".", *typed) == (0, "", "") and all(called[0]["data"][name[5:-2]] == 1 for name in typed)


@pytest.mark.parametrize(
    ("name", "arguments"), [(name, example) for name, each in COMMANDS.items() for example, _ in each.examples]
)
def test_examples_of_the_help_are_accepted(command, called, monkeypatch, tmp_path, name, arguments):
    """Every example is parsed, composed and checked as printed; its computation is replaced by a record of the call."""
    status = SimpleNamespace(return_value=SimpleNamespace(state="finished"))
    monkeypatch.setattr("hydra._internal.hydra.Hydra.run", lambda *_: called.append(name) or status)
    monkeypatch.setattr(run, "_run_sweep", lambda *_, **__: called.append(name) or 0)
    names = ["PATH", "SRC", "MODEL", "CAPTURE", "REF", "SET", "picture.png", "RESULT", "outputs/2026-01-31/12-00-00"]
    for folder in names:
        (tmp_path / folder).mkdir(parents=True)
    code, _, err = command(name, *shlex.split(arguments))
    assert code == 0 and len(called) == 1, err


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_its_options_and_every_command_has_the_common_ones(command, name):
    known = list_options(name, run.config_dir())
    code, out, _ = command(name, "--help")
    shown = [f"--{option.replace('_', '-')}" for option in COMMANDS[name].options]
    assert code == 0 and all(option in out for option in shown) and "Exit code: 0 done" in out
    assert f"  {'PATH' if name == 'recover' else name} " in format_overview(run.EXIT_CODES)
    if name not in ("inspect", "report", "fetch", "run"):
        common = ["max_frames", "every", *(["method"] if name not in ("pin", "scale") else []), "device", "out"]
        assert all(_resolve_option(name, option, known) for option in common)


@pytest.mark.parametrize("words", [[], ["help"], ["--help"], ["-q"]])
def test_the_bare_command_prints_help(command, words):
    assert command(*words)[:2] == (0, format_overview(run.EXIT_CODES) + "\n")


@pytest.mark.parametrize(
    ("switch", "loaded", "operators"),
    [
        ("", [Path("library.so")], f"compiled {loader.level()}"),
        ("0", [], "torch (DHTORCH_OPS=0)"),
        (
            "",
            [],
            "torch, 3 to 9 times slower on the CPU than compiled ones; to compile them: python -m dhtorch.ops (nee",
        ),
    ],
)
def test_version_is_ours_and_says_what_computes(command, monkeypatch, tmp_path, switch, loaded, operators):
    monkeypatch.setenv("DHTORCH_OPS", switch)
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    for name, value in {"_loaded": loaded, "_tried": [], "INSTALLED": tmp_path}.items():
        monkeypatch.setattr(loader, name, value)
    code, out, err = command("--version")
    assert (code, err) == (0, "") and out.startswith(f"dhtorch {dhtorch.__version__}, operators: {operators}")
    assert len(out.splitlines()) == 1


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("dhtorch meth", {"method=", "method."}),
        ("dhtorch method=", {f"method={p.stem}" for p in (run.config_dir() / "method").glob("*.yaml")}),
        ("dhtorch method=map experiment=ran", {"experiment=range_split"}),
        ("dhtorch method.track.lev", {"method.track.levels="}),
    ],
)
def test_the_shell_completes_groups_choices_and_options(command, monkeypatch, line, expected):
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    code, out, _ = command("-sc", "query=bash")
    assert code == 0 and set(out.split()) == expected


def test_a_path_that_does_not_exist_is_one_line_before_torch_is_loaded(tmp_path):
    """Every positional argument that is read, of every command; `source` of pin may be a camera's number."""
    read = dict.fromkeys({*COMMANDS} - {"demo", "fetch"}, 1) | {"": 1, "scale": 2, "pin": 2}
    lines = [[*filter(None, [name]), *["."] * k, "no/such.r3d"] for name, n in read.items() for k in range(n)]
    code = f"import sys\nfrom dhtorch.cli import run\nprint([run.main(words) for words in {lines}], 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split("]") == [str([2] * len(lines))[:-1], " False\n"]
    said = done.stderr.splitlines()
    assert len(said) == len(lines) and all(s.startswith("dhtorch: no/such.r3d: no such file or folder") for s in said)


# -------------------------------------------------------------------------------------------------- settings and hydra


def test_a_settings_file_is_read_with_its_comments(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text("defaults:\n  - method: map\na: 1 # one\nb:\n  c: [1, 2] # two\nd: null\nhydra:\n  e: 3\n")
    notes = read_option_notes(file)
    assert notes["a"] == ("1", "one") and notes["b.c"] == ("[1, 2]", "two") and notes["d"] == ("null", "")
    assert notes["method"].default == "map" and not any("e" in name.split(".") for name in notes)


@pytest.mark.parametrize(
    ("words", "sweep", "quoted"),
    [
        (["output=a=b,c=1/x"], False, ["output='a=b,c=1/x'"]),
        (["out=/tmp/a=b (1)/c"], False, ["out='/tmp/a=b (1)/c'"]),
        (["seed=0,1", "extract.columns=[a,b]"], True, ["seed=0,1", "extract.columns=[a,b]"]),
        (["data.K=1,2,3,4", "data.camera=[a,b]"], False, ["data.K=[1,2,3,4]", "data.camera=[a,b]"]),
        (["data.K=1,2"], True, ["data.K=1,2"]),
    ],
)
def test_paths_are_one_text_and_lists_need_no_brackets(words, sweep, quoted):
    assert quote_words(words, sweep) == quoted


@pytest.mark.parametrize("words", [["~method@experiment.methods.kornia"], ["+seed=1"], ["-m", "seed=1"]])
def test_deletions_and_additions_of_hydra_are_no_paths(words):
    assert run._name_positionals("run", words) == words
    assert run._name_positionals("run", ["~/room.r3d", *words]) == ["data=auto", "data.root='~/room.r3d'", *words]


@pytest.mark.slow
@pytest.mark.parametrize("flags", [["--cfg", "job"], ["-c", "job"], ["--info", "defaults-tree"]])
def test_hydra_s_own_flags_go_with_deletions(command, flags):
    argv = ["experiment=method_comparison", "~method@experiment.methods.kornia", *flags, "experiment.seeds=1"]
    handlers = list(logging.getLogger().handlers)
    code, out, err = command("run", *argv)
    assert code == 0, err
    assert logging.getLogger().handlers == handlers, "a later job of the process would write to a closed stream"
    assert not re.search(r"^ +kornia:", out, re.M)


@pytest.fixture
def asked(monkeypatch):
    """(settings, choices) of the jobs of a run; none is done."""
    seen = []

    def record(settings, _parts, choices, folder, **_):
        seen.append((settings, choices))
        return job.JobStatus(str(folder), "failed", "not run")

    monkeypatch.setattr(job, "run", record)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "methods"),
    [
        ("method=choice(paper,map)", ["paper", "map"]),
        ("method=glob([pap*,opencv],exclude=paper_*)", ["opencv", "paper"]),
    ],
)
def test_the_sweeps_of_hydra_choose_groups(command, asked, typed, methods):
    _, out, _ = command("-m", typed, "method.n=64", "output=o")
    assert sorted(c["method"] for _, c in asked) == sorted(methods) and f"{len(methods)} jobs" in out


@pytest.mark.slow
def test_deleting_the_holdout_is_no_holdout(command, asked):
    for typed in ("~holdout", "~holdout=range", "holdout=none"):
        command(typed, "output=o")
    holdouts = [(settings["holdout"], choices["holdout"]) for settings, choices in asked]
    assert holdouts[0] == holdouts[1] == holdouts[2] and holdouts[0][0]["cutoff"] == float("inf")


@pytest.mark.slow
def test_the_first_word_of_view_may_be_a_capture(command, called, tmp_path):
    for name in ("capture", "view", "job", "sweep/1"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("job", "sweep/1"):
        (tmp_path / name / "result.json").write_text("{}")
    for words in (["capture"], ["view"], ["view", "data=tum"], ["job"], ["sweep"], ["."]):
        assert command("view", *words)[0] == 0
    assert [s["result"] for s in called] == [None, None, None, "job", "sweep", "."]
    assert [s["choices"]["data"] for s in called] == ["auto", "auto", "tum", *["synthetic"] * 3]
    assert [s["data"]["root"] for s in called[:3]] == ["capture", "view", "view"]


@pytest.mark.parametrize(
    "first",
    [
        "enrich scan o",
        "validate scan depth=d",
        "extract data=auto data.root=scan out=o",
        "scan",
        "run data=auto data.root=scan",
        *(pytest.param(words, marks=pytest.mark.slow) for words in ("align scan depth=d out=o", "complete scan out=o")),
    ],
)
def test_options_of_the_reader_that_is_recognised_are_options(command, monkeypatch, tmp_path, first, asked):
    """``data=auto`` lists none of them: those of the capture's own format are taken, of another refused."""
    capture()(tmp_path)
    seen = []

    def record(settings, parts, *_, **__):
        seen.append((settings["data"]["register"], len(parts.get("data", "."))))
        raise ValueError("seen")

    is_job = first.startswith("run")
    modules = run._CONFIGURED_COMMANDS | {"scan": "dhtorch.cli.process_capture"}
    target = "dhtorch.cli.job" if is_job else modules[first.split()[0]]
    with monkeypatch.context() as patch:
        patch.setattr(f"{target}.run", record)
        code, _, err = command(*first.split(), "data.register=false")
    assert code == 2 and "seen" in err and seen == [(False, 1)]
    code, _, err = command(*first.split(), "data.camera=front")
    assert code == 2 and "format frames_dir has no option 'camera', expected one of intrinsics" in err


@pytest.mark.parametrize(
    "content",
    [
        "_target_: dhtorch.pipeline.method.Method\n_partial_: x",
        "n: [1, 2",
        "a: b: c",
        "\tn: 1",
        "n: 1\n  m: 2",
        "&a [*b]",
        "- 1\n- 2",
        "3",
        "",
        "%",
        "\x00",
    ],
)
@pytest.mark.parametrize("words", ["complete out=out", "run"])
def test_settings_of_a_user_that_are_no_settings_are_one_line(tmp_path, monkeypatch, command, content, words):
    (tmp_path / "conf" / "method").mkdir(parents=True)
    for place in run.config_dir().iterdir():
        if place.name != "method":
            (tmp_path / "conf" / place.name).symlink_to(place)
    for place in (run.config_dir() / "method").iterdir():
        (tmp_path / "conf" / "method" / place.name).symlink_to(place)
    (tmp_path / "conf" / "method" / "mine.yaml").write_text(content)
    monkeypatch.setattr(run, "config_dir", lambda: tmp_path / "conf")
    code, _, err = command(*words.split(), "data=synthetic", "data.n_frames=2", "method=mine")
    assert code == 2 and err.count("\n") == 1 and "Traceback" not in err
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_every_command_computes_with_the_threads_of_its_settings(command, monkeypatch):
    """Commands without the option have one: beside other work torch's further threads spin."""
    seen, before = [], torch.get_num_threads()
    record = SimpleNamespace(run=lambda *_, **__: seen.append(torch.get_num_threads()))
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: record))
    try:
        for words in ("inspect .", "report .", "stream data=synthetic", "demo --no-browser", "stream threads=2"):
            torch.set_num_threads(2)
            assert command(*words.split(), *["data=synthetic"] * words.startswith("stream"))[0] == 0
        assert seen == [1, 1, 1, 1, 2]
    finally:
        torch.set_num_threads(before)


def test_a_traceback_is_shown_where_it_is_wanted(command):
    for words in (["traceback=true"], ["--traceback"]):
        code, _, err = command(*TINY, "pairs.gap=99", *words)
        assert code == 2 and "Traceback" in err and "pairs.gap" in err
    code, _, err = command("stream", "data=synthetic", "steps=[]", "--traceback")
    assert code == 2 and "Traceback" in err
    code, _, err = command(*TINY, "pairs.gap=99")
    assert code == 2 and err.count("\n") == 1
