"""Record3D: its three layouts written from a known room and read back, a real one, live frames, and damaged ones."""

import colorsys
import json
import math
import os
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support import writers
from support.box_scene import disagreement, off_wall, own_camera, pose, render, turned_over, world_points
from support.capture_cases import Case, check_case, check_frames
from support.record3d_captures import DEPTH_HW, HW, camera_of, r3d_archive, rgbd_video, walk

from dhtorch import data
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import record3d
from dhtorch.data.readers.record3d_live import LiveFrames
from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.records import Frame

lzfse = pytest.importorskip("lzfse")
OpenEXR = pytest.importorskip("OpenEXR")
pytest.importorskip("av")

ROOT = os.environ.get("DHTORCH_DATA")


def same_scene(recording: data.Recording, frames: list[Frame], relative: float = 1e-6) -> None:
    """Depth to the format's rounding, times from the first frame on; two frames agree with each other."""
    check_frames(recording, frames, 8 * relative, up=ARKIT_UP)
    times = [float(f.time - frames[0].time) for f in frames]
    assert recording.times.tolist() == pytest.approx(times, abs=1e-9)
    assert disagreement(own_camera(recording[0]), own_camera(recording[1]))[0] < 0.04


def test_unpacked_archive(tmp_path: Path) -> None:
    archive = r3d_archive(tmp_path)
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "folder")
    same_scene(data.open(tmp_path / "folder"), walk())


Change = Callable[[dict[str, bytes]], None]


def write_r3d(
    root: Path,
    frames: list[Frame],
    *,
    table: dict[str, Any] | None = None,
    change: Change | None = None,
    **options: Any,
) -> None:
    """An archive with entries of its metadata replaced (None removes one) and its members changed."""
    file = root / "a.r3d"
    writers.write_r3d(file, frames, **options)
    with zipfile.ZipFile(file) as old:
        members = {name: old.read(name) for name in old.namelist()}
    meta = json.loads(members["metadata"]) | (table or {})
    members["metadata"] = json.dumps({k: v for k, v in meta.items() if v is not None}).encode()
    if change is not None:
        change(members)
    with zipfile.ZipFile(file, "w") as new:
        for name, content in members.items():
            new.writestr(name, content)


def r3d(name: str, n: int = 3, expect: Any = None, **more: Any) -> Case:
    frames = more.pop("frames", lambda: walk(n))
    options = {key: more.pop(key) for key in ("options", "error") if key in more}
    write = more.pop("write", write_r3d)
    return Case(name, write, frames, (), expect or {}, written=more, path="a.r3d", up=ARKIT_UP, **options)


def meaningless(members: dict[str, bytes]) -> None:
    members |= {"sound.m4a": b"1", "rgbd/.DS_Store": b"1", "rgbd/x.jpg": b"1", "__MACOSX/rgbd/._9.jpg": b"1"}


def lead_out(members: dict[str, bytes]) -> None:
    for part in ("jpg", "depth", "conf"):
        members[f"../rgbd/9.{part}"] = members[f"/rgbd/9.{part}"] = members[f"rgbd/0.{part}"]


def damage(members: dict[str, bytes]) -> None:
    for name in ("1.depth", "2.conf", "3.jpg", "3.depth", "3.conf"):
        del members[f"rgbd/{name}"]
    members["rgbd/4.jpg"] = members["rgbd/4.jpg"][:-500]
    members["rgbd/5.depth"] = members["rgbd/5.depth"][:-7]
    members["rgbd/6.conf"] = b""


def first_damaged(members: dict[str, bytes]) -> None:
    members["rgbd/0.jpg"] = b"\xff\xd8 no picture \xff\xd9"


def packed_depth(depth: np.ndarray, conf: int = 2, is_packed: bool = True) -> Change:
    """A change of the first depth map, packed or not, and of its confidence."""

    def change(members: dict[str, bytes]) -> None:
        members["rgbd/0.depth"] = lzfse.compress(depth.tobytes()) if is_packed else depth.tobytes()
        members["rgbd/0.conf"] = lzfse.compress(bytes([conf]) * math.prod(DEPTH_HW))

    return change


def arkit_poses(n: int) -> list[list[float]]:
    """The poses of the walk as the app writes them."""
    rows = []
    for frame in walk(n):
        T = turn_world(frame, ARKIT_UP).T_world_from_cam
        c2w = T.R[0].numpy() @ np.diag([1.0, -1.0, -1.0])
        rows.append([*Rotation.from_matrix(c2w).as_quat(), *T.t[0].tolist()])
    return rows


LOST = arkit_poses(6)
LOST[1], LOST[3] = [math.nan] * 7, [0.0] * 7
FRONT = {"frames": lambda: [f.replace(conf=None, T_world_from_cam=None) for f in walk()]}
HOLES = np.full(DEPTH_HW, 1.5, "<f4")
HOLES[0, :5] = [np.nan, np.inf, -np.inf, -1, 0]
ALL = {"same": ([0, 1, 2], 1e-5)}
NO_CLOCK = {"frameTimestamps": [5.0, 4.0, 6.0]}
F0, C0 = camera_of(0).f[0].tolist(), camera_of(0).c[0].tolist()
K_ROWS = [F0[0], 0, C0[0], 0, F0[1], C0[1], 0, 0, 1]


def unsized(size: tuple[int, int], portrait: bool) -> Case:
    """Old files do not state how large depth is."""
    hw, depth_hw = ((64, 48), size) if portrait else ((48, 64), size[::-1])
    depth = torch.linspace(0.5, 3, math.prod(size)).view(1, *depth_hw)
    frames = [f.replace(depth=depth, conf=None) for f in walk(1, hw, (8, 6) if portrait else (6, 8))]
    expect = {"depth hw": depth_hw, "median": pytest.approx(float(depth.median()))}
    return r3d(f"depth of {size}, portrait {portrait}", 1, expect, frames=lambda: frames, depth_size=False)


CASES = [
    *(Case(f"exr, {options}", writers.write_record3d_exr, 3, (),
           {"format": "record3d", "report": (), "conf": False, "same": ([0, 1, 2], step)}, written=options, path=path,
           up=ARKIT_UP)
      for options, step, path in (({"dtype": np.float16}, 2**-8, "."), ({"dtype": np.float32}, 1e-5, "EXR_RGBD"),
                                  ({"channel": "Z"}, 2**-8, "."))),
    Case("exr of another channel", writers.write_record3d_exr, 1, written={"channel": "Z"},
         options={"exr_channel": "far"}, error=r"0.exr: channels: found Z, expected far"),
    *(r3d(f"turn {turn}, compression {method}", 3,
          {"rate": 60, "times of": [0, 0.016667, 0.033333], "report": (), "hw": HW[::turn], "conf": True, **ALL},
          frames=lambda turn=turn: walk(3, HW[::turn], DEPTH_HW[::turn]), write=r3d_archive, compression=method)
      for turn in (1, -1) for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)),
    r3d("frames count as numbers", 12, {"number": list(range(12)), "same": (list(range(12)), 1e-5)}),
    r3d("what means nothing", 3, ALL | {"report": ()}, table={"initPose": [0.5, 0.5, 0.5, 0.5, 1, 2, 3]},
        change=meaningless),
    r3d("K by columns", 2, {"all f": [F0[0]] * 2, "c": C0}, per_frame=False),
    r3d("K by rows", 2, per_frame=False, table={"K": K_ROWS},
        error=r"a.r3d/metadata: K: found .*, expected fx 0 0 0 fy 0 cx cy 1"),
    r3d("intrinsics of each frame", 3, {"all f": [61.5, 62.5, 63.5]}),
    r3d("intrinsics of the first", 3, {"all f": [61.5] * 3}, options={"per_frame": False}),
    r3d("K of another size", 2, {"same": ([0, 1], 1e-5)}, declared_hw=(96, 128)),
    *(unsized(size, portrait) for size in ((256, 192), (640, 480), (960, 720)) for portrait in (False, True)),
    r3d("unknown size", 3, depth_size=False,
        error=r"0.depth: depth: found 3072 bytes, expected dw and dh in the metadata"),
    r3d("the front camera", 3, {"posed": False, "conf": False,
                                "report": ("every pose is the identity: no tracking",)}, **FRONT),
    r3d("the front camera, no poses wanted", 3, {"posed": False, "report": ()}, options={"poses": False}, **FRONT),
    r3d("a standing camera", 3, {"posed": True, "report": ()},
        frames=lambda: [f.replace(T_world_from_cam=pose(1)) for f in walk()]),
    r3d("lost tracking and short tables", 6,
        {"number": [0, 2, 4], "same": ([0, 2, 4], 1e-5), "report": (
            "frame 5: beyond the metadata's 5 rows: left out",
            "2 frames (1, 3): its pose is not usable (tracking lost): left out")}, table={"poses": LOST[:5]}),
    r3d("lost tracking, no poses wanted", 6, {"number": [0, 1, 2, 3, 4]}, table={"poses": LOST[:5]},
        options={"poses": False}),
    r3d("stamps that do not increase", 3,
        {"times": pytest.approx([0, 1 / 60, 2 / 60]),
         "report": ("time stamps do not increase: the frame rate is used instead",)}, table=NO_CLOCK),
    r3d("stamps that do not increase, no rate", 3,
        {"times": None, "report": ("time stamps do not increase: there are no times",)}, table=NO_CLOCK | {"fps": None}),
    r3d("stamps", 3, {"times": [0, 0.5, 2], "report": ()}, table={"frameTimestamps": [7.0, 7.5, 9.0]}),
    *(r3d(f"table {message}", 3, table=table, error=message) for table, message in (
        ({"w": None, "h": None}, r"metadata: w, h: found nothing, expected the size of the images"),
        ({"w": 1e9}, r"metadata: w: found 1000000000.0"),
        ({"dw": 0.5}, r"metadata: dw, dh: found 0.5x24, expected whole numbers"),
        ({"fps": math.inf}, r"metadata: fps: found inf"),
        ({"poses": [[1, 2, 3]] * 3}, r"metadata: poses: found .*, expected 7 numbers for each frame"),
        ({"perFrameIntrinsicCoeffs": [[math.nan] * 4] * 3}, r"perFrameIntrinsicCoeffs: found a number that is not"),
        ({"perFrameIntrinsicCoeffs": [[-1, 1, 1, 1]] * 3}, r"intrinsics of frame 0 focal length: found"),
        ({"perFrameIntrinsicCoeffs": None, "K": [1, 2]}, r"metadata: K: found \[1.0, 2.0\], expected 9 finite"),
        ({"poses": [[0, 0, 0, 1, 1e30, 0, 0]] * 3}, r"metadata: pose 0: found .*, expected at most 4e\+07 m"))),
    r3d("missing and damaged", 8,
        {"number": [0, 7], "same": ([0, 7], 1e-5), "report": (
            "frame 1: no depth: left out", "frame 2: no confidence: left out", "frame 3: no file: left out",
            "3 frames (4, 5, 6): damaged: left out")}, change=damage),
    r3d("the first damaged", 3, {"number": [1, 2]}, change=first_damaged, options={"verify": True}),
    *(r3d(f"holes, packed {is_packed}", 1, {"median": 1.5, "returns": DEPTH_HW[0] * DEPTH_HW[1] - 5},
          change=packed_depth(HOLES, is_packed=is_packed)) for is_packed in (True, False)),
    r3d("levels above 2", 1, change=packed_depth(HOLES, conf=3),
        error=r"0.conf: confidence: found 3, expected 0, 1 or 2"),
    r3d("names that lead out", 3, ALL | {"number": [0, 1, 2]}, change=lead_out),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)
    assert case.path != "a.r3d" or {file.name for file in tmp_path.rglob("*")} == {"capture", "a.r3d"}


def test_damage_inside_is_found_when_read_or_when_verified(tmp_path: Path) -> None:
    archive = r3d_archive(tmp_path, walk(4))
    with zipfile.ZipFile(archive) as packed:
        at = packed.getinfo("rgbd/2.depth").header_offset + 200
    whole = bytearray(archive.read_bytes())
    whole[at] ^= 0xFF
    archive.write_bytes(bytes(whole))
    recording = data.open(archive)
    assert len(recording) == 4 and len([recording[i] for i in (0, 1, 3)]) == 3
    with pytest.raises(FormatError, match=r"a.r3d/rgbd/2.depth: data: found .* checksum"):
        recording[2]
    verified = data.open(archive, verify=True)
    assert verified.number.tolist() == [0, 1, 3] and verified.report == ("frame 2: damaged: left out",)


@pytest.mark.parametrize("depth_range", [None, (0.0, 4.5), (0.15, 2.9)])
def test_mp4_gives_back_the_scene(tmp_path: Path, depth_range: tuple[float, float] | None) -> None:
    file, frames = rgbd_video(tmp_path, depth_range=depth_range)
    recording = data.open(file)
    assert data.recognise(file) == ("record3d", "an mp4 with an intrinsicMatrix at its end")
    assert recording.poses is None and recording.report == ("no poses in this layout",) and len(recording) == 3
    torch.testing.assert_close(recording.times, torch.arange(3).double() / 30)
    for got, want in zip(recording, frames, strict=True):
        assert torch.equal(got.camera.f, want.camera.f) and torch.equal(got.camera.c, want.camera.c)
        seen = got.depth > 0
        assert got.hw == (96, 128) and float(seen.double().mean()) > 0.7
        error = (got.depth - want.depth).abs()[seen]
        assert float(error.median()) < 0.006 and float(error.quantile(0.99)) < 0.05  # 2 mm, and the codec
        assert float((got.image.float() - want.image.float()).abs().mean()) < 8


def test_mp4_drops_both_red_ends_jumps_and_grey() -> None:
    hue = np.linspace(0, 3, 300, endpoint=False, dtype=np.float32)
    colours = [colorsys.hsv_to_rgb(h / 3, 1, 1) for h in hue.tolist()]
    rgb = np.tile((255 * np.array(colours)).round().astype(np.uint8), (5, 1, 1))
    depth = record3d.decode_hue_depth(rgb, 0, 3, 0.05)[2]
    kept = depth > 0
    np.testing.assert_allclose(depth[kept], hue[kept], atol=0.003)
    assert hue[kept].min() == pytest.approx(0.1, abs=0.011) and hue[kept].max() == pytest.approx(2.8, abs=0.011)
    assert kept.sum() >= 268
    step = np.concatenate((rgb[:, 60:100], rgb[:, 200:240]), 1)
    beside = record3d.decode_hue_depth(step, 0, 3, 0.05)[2] == 0
    assert np.flatnonzero(beside).tolist() == [39, 40]
    grey = np.full((3, 3, 3), 128, np.uint8)
    grey[..., 0] += 20
    assert not record3d.decode_hue_depth(grey, 0, 3, 0.05).any()


@pytest.mark.parametrize("stored", ["yuv420p", "yuv420p10le"])
def test_mp4_colours_are_not_blended_on_the_way(tmp_path: Path, stored: str) -> None:
    """Colour is stored at half the resolution; interpolated, it would bleed over more columns beside each edge."""
    depth = torch.ones(1, 64, 96)
    depth[..., 32:64] = 2
    frame = render(camera_of(0), pose(0), (64, 96)).replace(depth=depth)
    writers.write_record3d_mp4(tmp_path / "a.mp4", [frame] * 2, crf=1, stored=stored)
    got = data.open(tmp_path / "a.mp4")[0].depth[0, 4:-4]
    kept = (got > 0).all(0)
    assert torch.nonzero(~kept).flatten().tolist() == [31, 32, 63, 64]
    torch.testing.assert_close(got[:, kept], depth[0, 4:-4][:, kept], atol=0.02, rtol=0)


def test_mp4_intrinsics_beside_it_or_nowhere(tmp_path: Path) -> None:
    file, frames = rgbd_video(tmp_path, 2)
    whole = file.read_bytes()
    at = whole.rindex(b'{"intrinsicMatrix"')
    meta = json.loads(whole[at:-1])
    file.write_bytes(whole[: at - 8])
    with pytest.raises(FormatError, match=r"format: found a (\.mp4 file|video without depth)"):
        data.open(file)
    with pytest.raises(FormatError, match=r"a.mp4: intrinsicMatrix: found neither in the file nor"):
        data.open(file, "record3d")
    (tmp_path / "metadata.json").write_text(json.dumps(meta))
    assert torch.equal(data.open(file)[1].camera.c, frames[1].camera.c)
    assert float(data.open(file, depth_range=(0, 6))[0].depth.max()) > 3
    with pytest.raises(FormatError, match=r"rangeOfEncodedDepth: found 2.0 to 1.0 m"):
        data.open(file, depth_range=(2, 1))


class Phone:
    """What the library looks like: one set of buffers, overwritten by every frame, and a thread that calls back."""

    def __init__(self, frames: list[Frame], lidar: bool = True, wait: bool = True) -> None:
        self.frames, self.lidar, self.wait = frames, lidar, wait
        h, w = frames[0].hw
        self.rgb, self.depth = np.zeros((h, w, 3), np.uint8), np.zeros(DEPTH_HW, np.float32)
        self.conf = np.zeros(DEPTH_HW if lidar else (0, 0), np.uint8)
        self.taken = threading.Semaphore(0)  # the reader wants another one
        self.connected = False
        self.over = threading.Event()
        self.on_new_frame: Callable[[], None] = lambda: None
        self.on_stream_stopped: Callable[[], None] = lambda: None
        self.get_connected_devices: Callable[[], list[Any]] = lambda: [SimpleNamespace(product_id=1, udid="x")]
        self.get_rgb_frame, self.get_depth_frame = lambda: self.rgb, lambda: self.depth
        self.get_confidence_frame, self.get_device_type = lambda: self.conf, lambda: int(lidar)

    def connect(self, device: Any) -> bool:
        self.connected = device.udid == "x"
        threading.Thread(target=self.run, daemon=True).start()
        return self.connected

    def disconnect(self) -> None:
        self.connected = False
        self.taken.release()

    def run(self) -> None:
        for frame in self.frames:
            if self.wait:
                self.taken.acquire(timeout=5)
            if not self.connected:
                break
            self.now = frame
            self.rgb[:] = frame.image[0].permute(1, 2, 0).numpy()
            self.depth[:] = frame.depth[0].numpy()
            if self.lidar:
                self.conf[:] = frame.conf[0].numpy()
            self.on_new_frame()
            self.rgb[:], self.depth[:], self.conf[:] = 7, 7, 2  # gone as soon as the callback returns
        self.on_stream_stopped()
        self.over.set()

    def get_intrinsic_mat(self) -> Any:
        (fx, fy), (tx, ty) = self.now.camera.f[0].tolist(), self.now.camera.c[0].tolist()
        return SimpleNamespace(fx=fx, fy=fy, tx=tx, ty=ty)

    def get_camera_pose(self) -> Any:
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = self.now.T_world_from_cam.R[0], self.now.T_world_from_cam.t[0]
        c2w = c2w @ np.diag([1.0, -1.0, -1.0, 1.0])  # ARKit's axes
        row = [*Rotation.from_matrix(c2w[:3, :3]).as_quat(), *c2w[:3, 3]]
        return SimpleNamespace(**dict(zip(("qx", "qy", "qz", "qw", "tx", "ty", "tz"), row, strict=True)))


def test_live_frames_are_copies_with_our_axes() -> None:
    frames = walk(5)
    phone = Phone(frames)
    ticks = iter(range(10, 100))
    got = []
    with LiveFrames(phone, clock=lambda: next(ticks)) as live:
        phone.taken.release()
        for frame in live:
            got.append(frame)
            phone.taken.release()
        assert live.dropped == 0
    assert not phone.connected and len(got) == 5
    for frame, want in zip(got, frames, strict=True):
        for name in ("image", "depth", "conf"):
            assert torch.equal(getattr(frame, name), getattr(want, name))
        assert torch.equal(frame.camera.f, want.camera.f) and torch.equal(frame.camera.c, want.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-12, rtol=0)
        assert float(off_wall(world_points(own_camera(frame))).max()) < 1e-5
    assert [float(f.time) for f in got] == [0, 1, 2, 3, 4]


def test_live_front_camera_and_slow_reader() -> None:
    phone = Phone(walk(9), lidar=False, wait=False)
    live = LiveFrames(phone, ahead=2)
    with live:
        assert phone.over.wait(5)
        got = list(live)
    assert [float(f.camera.f[0, 0]) for f in got] == [68.5, 69.5] and live.dropped == 7
    assert got[0].conf is None and got[0].T_world_from_cam is None


def test_live_failures_reach_the_reader() -> None:
    phone = Phone(walk(2), wait=False)
    phone.get_intrinsic_mat = lambda: SimpleNamespace(fx=-1, fy=1, tx=1, ty=1)  # type: ignore[method-assign]
    with pytest.raises(FormatError, match="record3d:usb: intrinsics focal length"), LiveFrames(phone) as live:
        next(iter(live))
    phone = Phone(walk(1))
    with pytest.raises(FormatError, match=r"frames: found none within 0.05 s"), LiveFrames(phone, timeout=0.05) as live:
        next(iter(live))
    assert not phone.connected  # the block leaves the phone alone whatever happens
    phone.get_connected_devices = lambda: []
    with pytest.raises(FormatError, match="devices: found none"), LiveFrames(phone):
        pass
    phone.connect = lambda device: False  # type: ignore[method-assign]
    with pytest.raises(FormatError, match="connection: found refused"), LiveFrames(phone, device=1):
        pass


def test_live_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "record3d", None)
    with pytest.raises(ImportError, match=r"needs record3d.*pip install 'dhtorch\[live\]'"):
        LiveFrames()


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_real_export() -> None:
    root = Path(str(ROOT)) / "r3d_door"
    recording = data.open(root)
    assert (
        recording.format == "record3d" and recording.report == () and recording.number.tolist() == list(range(100, 131))
    )
    meta = json.loads((root / "EXR_RGBD" / "metadata.json").read_text())
    row = np.array(meta["poses"][100])  # the table keeps all 345 rows
    np.testing.assert_allclose(recording.poses.t[0], row[4:])
    assert float(recording.times[0]) == meta["frameTimestamps"][100]
    a, b = own_camera(recording[0]), own_camera(recording[30])
    assert a.hw == (1920, 1440) and a.depth.shape == (1, 256, 192)
    assert a.camera.f.tolist() == [[meta["K"][0], meta["K"][4]]] and a.camera.c.tolist() == [
        [meta["K"][6], meta["K"][7]]
    ]
    assert float(a.depth.min()) > 0.14 and float(a.depth.max()) < 0.43
    agree, count = disagreement(a, b)
    assert agree < 0.04 and count > 40_000
    assert disagreement(turned_over(a), turned_over(b))[0] > 0.15  # so the check above can tell


def test_mp4_times_are_the_stamps_of_its_frames(tmp_path: Path) -> None:
    """A phone's rate varies, and it may lose frames; a number over the nominal rate would shift what follows."""
    times = [0, 1 / 30, 2 / 30, 6 / 30, 7 / 30]
    file, _ = rgbd_video(tmp_path, 5, times=times)
    assert data.open(file).times.tolist() == pytest.approx(times, abs=1e-9)
