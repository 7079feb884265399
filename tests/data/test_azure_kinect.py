"""Azure Kinect videos: written with and without the factory's calibration, and read back."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.box_scene import CAMERA, render, walk
from support.capture_cases import Case, check_case
from support.writers.azure_kinect import write_azure_kinect

from dhtorch import data
from dhtorch.data.codecs import video
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import azure_kinect
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame

pytest.importorskip("av")

ROOT = os.environ.get("DHTORCH_DATA")
K = [61.5, 58.25, 33.5, 21.75]
LENS = torch.tensor([[0.4, -2.5, -1e-4, 2e-4, 1.4, 0.3, -2.3, 1.3]])  # as of a device, k1 k2 p1 p2 k3 … k6
COLOUR = Camera(torch.tensor([[152.0, 152.5]]), torch.tensor([[159.0, 91.0]]), LENS)
DEPTH = Camera(torch.tensor([[252.0, 252.25]]), torch.tensor([[161.5, 142.0]]))
T_COLOUR_FROM_DEPTH = se3.exp(torch.tensor([[0.1, -0.002, 0.002, -0.032, -0.002, 0.004]]).double())


def device_frames(n: int = 2) -> list[Frame]:
    """Frames of the device's two cameras: colour of 320x180, depth of the binned narrow mode."""
    frames = []
    for frame in walk(n, COLOUR, (180, 320)):
        seen = render(DEPTH, se3.compose(frame.T_world_from_cam, T_COLOUR_FROM_DEPTH), (288, 320))
        frames.append(frame.replace(depth=seen.depth, depth_camera=DEPTH))
    return frames


def write(root: Path, frames: list[Frame], **options: Any) -> None:
    write_azure_kinect(root / "a.mkv", frames, **options)


def mkv_case(name: str, frames: Any, expect: Any = None, **more: Any) -> Case:
    return Case(name, write, frames, (), expect or {}, path="a.mkv", **more)


CASES = [
    *(mkv_case(f"{codec}, {names}", 4, {
        "format": "azure_kinect", "report": ("no calibration.json: depth is taken as registered to colour",),
        "unit": (1e-3, None), "times": pytest.approx([0, 1 / 30, 2 / 30, 3 / 30], abs=1e-3), "f": CAMERA.f[0].tolist(),
        "same": ([0, 1, 2, 3], 1e-3)}, written={"depth_codec": codec, "names": names}, options={"K": K})
      for codec in ("rawvideo", "ffv1") for names in (("COLOR", "DEPTH"), ("colour", "depth map"))),
    mkv_case("no K", 4, error=r"no intrinsics, expected .*data.K=.* calibration.json"),
    mkv_case("an image without depth", 5, {"number": [0, 2, 3, 4], "same": ([0, 2, 3, 4], 1e-3), "report": [
        "^frame 1: no depth map within half a period: left out", ""]}, written={"lost_depth": [1]}, options={"K": K}),
    mkv_case("depth of another size", device_frames, options={"K": K},
             error=r"a depth track of 320x288 without calibration.json.*azure_kinect_mkv_reader"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


@pytest.mark.parametrize("rig", [None, [[0.2, -0.1, 0.3, 0.5, -0.2, 0.1]]])
def test_depth_is_registered_by_the_factorys_calibration(tmp_path: Path, rig: list[list[float]] | None) -> None:
    """Only the motion from the depth to the colour camera moves depth, in whatever frame their poses are stated."""
    frames = device_frames()
    T_rig = None if rig is None else se3.exp(torch.tensor(rig).double())
    poses = {"T_colour_from_depth": T_COLOUR_FROM_DEPTH, "T_depth_from_rig": T_rig}
    write_azure_kinect(tmp_path / "a.mkv", frames, **poses)
    recording = data.open(tmp_path / "a.mkv")
    assert recording.report == () and "calibration.json" in recording.depth_unit.source
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.camera.f, COLOUR.f, rtol=1e-6, atol=0)
        torch.testing.assert_close(got.camera.c, COLOUR.c, rtol=1e-6, atol=0)
        torch.testing.assert_close(got.camera.distortion, COLOUR.distortion)
        size = tuple(got.depth.shape[1:])
        exact = render(cameras.resize(COLOUR, (180, 320), size), want.T_world_from_cam, size).depth
        seen = got.depth > 0
        assert float(seen.float().mean()) > 0.5
        error = ((got.depth - exact).abs() / exact)[seen]
        assert float(error.median()) < 0.005


def test_a_calibration_that_is_none(tmp_path: Path) -> None:
    write_azure_kinect(tmp_path / "a.mkv", device_frames(), T_colour_from_depth=T_COLOUR_FROM_DEPTH)
    whole = (tmp_path / "a.mkv").read_bytes()
    for old, new, text in (
        (b"CALIBRATION_CameraLocationPV0", b"CALIBRATION_CameraLocationXX0", "Cameras: found"),
        (b"LensDistortionModelBrownConrady", b"LensDistortionModelFisheyeLens_", "ModelType: found"),
        (b'"CalibrationInformation"', b'"CalibrationInformatio_"', "CalibrationInformation.Cameras: found nothing"),
        (b'{"CalibrationInformation', b'["CalibrationInformation', "JSON"),
    ):
        assert len(old) == len(new) and old in whole
        (tmp_path / "b.mkv").write_bytes(whole.replace(old, new))
        with pytest.raises(FormatError, match=text) as caught:
            data.open(tmp_path / "b.mkv")
        assert "calibration.json" in str(caught.value)


def test_the_header_is_read_without_a_decoder(tmp_path: Path) -> None:
    write_azure_kinect(tmp_path / "a.mkv", device_frames(), T_colour_from_depth=T_COLOUR_FROM_DEPTH)
    colour, depth = video.list_video_tracks(tmp_path / "a.mkv")
    assert (colour.name, colour.codec, colour.hw) == ("COLOR", "mjpeg", (180, 320))
    assert (depth.name, depth.fourcc, depth.hw) == ("DEPTH", "b16g", (288, 320))
    text = video.read_attachment(tmp_path / "a.mkv", "calibration.json")
    assert np.shape(json.loads(text.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]) == (2,)
    assert video.read_attachment(tmp_path / "a.mkv", "other") is None


def test_a_plain_video_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "a.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + b"\x80")
    assert azure_kinect.recognise(tmp_path / "a.mkv") is None
    with pytest.raises(FormatError, match="a video that cannot be read"):
        data.open(tmp_path / "a.mkv")


@pytest.mark.skipif(not ROOT or not (Path(ROOT) / "field_cases").is_dir(), reason="needs DHTORCH_DATA")
def test_the_field_case() -> None:
    recording = data.open(Path(ROOT) / "field_cases/26-azure-kinect-mkv/capture.mkv", K=[525, 525, 319.5, 239.5])
    assert len(recording) == 5 and 0.9 < float(recording[0].depth[recording[0].depth > 0].min()) < 1.1
