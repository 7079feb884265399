"""``dhtorch pin``: pictures, captures, live cameras and sets without depth; limits, exit codes, files."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support import stored_outputs
from support.rooms import moved_camera_capture

from dhtorch.cli import pin, run
from dhtorch.codes import PinVerdict
from dhtorch.data.io import decode
from dhtorch.export import encode_png


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture whose camera stands still and is moved between frames 3 and 4; and its frames."""
    return moved_camera_capture(tmp_path_factory.mktemp("pin") / "capture")


def pinned(out, *words):
    code = run.main(["pin", *map(str, words), f"output={out}", "ref_frames=1"])
    return code, json.loads((out / "pin.json").read_text())


def test_an_episode_has_its_change_point_and_exceeds_its_limit(tmp_path, capture, capsys):
    root, _ = capture
    code, found = pinned(tmp_path / "out", root, root, "max_frames=null", "fail_on=moved>2px")
    assert code == run.EXIT_SOME_FAILED and found["metric"]
    (episode,) = found["episodes"]
    assert episode["verdict"] == "moved" and [change["frame"] for change in episode["changes"]] == [4]
    assert [row["verdict"] for row in episode["pictures"][:4]] == ["not_moved"] * 4
    shown = capsys.readouterr().out
    stored_outputs.check("pin", root, printed=shown.replace(str(tmp_path), "ROOT"), folder=tmp_path / "out")
    assert "exceeded: moved is" in shown and "from frame 4 by" in shown
    page = (tmp_path / "out" / "pin.html").read_text()
    assert page.count("data:image/png") == 2 and page.count("data:image/svg+xml") == 1 and "moved" in page


def test_a_picture_within_the_limit_passes_and_the_guide_says_the_way(tmp_path, capture, capsys):
    root, frames = capture
    for name, k in (("still", 1), ("moved", 5)):
        (tmp_path / f"{name}.png").write_bytes(encode_png(frames[k].image[0].permute(1, 2, 0).numpy()))
    code, found = pinned(tmp_path / "a", root, tmp_path / "still.png", "fail_on=moved>2px,unknown>0.5")
    assert code == run.EXIT_DONE and found["exceeded"] == []
    code, found = pinned(tmp_path / "b", root, tmp_path / "moved.png", "guide=true", "fail_on=moved>2px")
    assert code == run.EXIT_SOME_FAILED and "mm" in capsys.readouterr().out
    code, found = pinned(tmp_path / "c", tmp_path / "still.png", tmp_path / "moved.png", "data.fov=60")
    assert code == run.EXIT_DONE and not found["metric"]
    assert "direction" in found["episodes"][0]["pictures"][0]


def test_another_zoom_is_cannot_know_and_counts_as_unknown(tmp_path, capture, capsys):
    root, frames = capture
    image = frames[1].image.float()
    scale = torch.tensor([[[1 / 1.04, 0.0, 0.0], [0.0, 1 / 1.04, 0.0]]])
    grid = torch.nn.functional.affine_grid(scale, image.shape, align_corners=False)
    zoomed = torch.nn.functional.grid_sample(image, grid, mode="bicubic", align_corners=False).clamp(0, 255).byte()
    (tmp_path / "zoomed.png").write_bytes(encode_png(zoomed[0].permute(1, 2, 0).numpy()))
    code, found = pinned(tmp_path / "a", root, tmp_path / "zoomed.png", "fail_on=moved>2px")
    (row,) = found["episodes"][0]["pictures"]
    assert code == run.EXIT_DONE and row["verdict"] == "cannot_know" and row["reason"] == "zoom"
    assert row["zoom"] == pytest.approx(1.04, abs=0.003) and 0 < row["zoom_sigma"] < 0.002
    assert "cannot know: zoom or focus changed" in capsys.readouterr().out
    assert "zoom or focus changed" in (tmp_path / "a" / "pin.html").read_text()
    code, found = pinned(tmp_path / "b", root, tmp_path / "zoomed.png", "fail_on=unknown>0.5")
    assert code == run.EXIT_SOME_FAILED


def test_a_live_camera_is_watched_until_its_end(tmp_path, capture, capsys, monkeypatch):
    root, frames = capture
    pictures = [np.ascontiguousarray(frame.image[0].permute(1, 2, 0).numpy()[..., ::-1]) for frame in frames[3:6]]

    class Capture:
        released = 0

        def __init__(self, index):
            assert index == 7
            self.left = list(pictures)

        def isOpened(self):
            return True

        def read(self):
            return (True, self.left.pop(0)) if self.left else (False, None)

        def release(self):
            Capture.released += 1

    monkeypatch.setattr(decode.cv2, "VideoCapture", Capture)
    code, found = pinned(tmp_path / "out", root, "7", "guide=true")
    assert code == run.EXIT_DONE and Capture.released == 1
    assert [row["verdict"] for row in found["episodes"][0]["pictures"]] == ["not_moved", "moved", "moved"]
    shown = capsys.readouterr().out
    assert "0: in place" in shown and "mm" in shown


def test_a_camera_that_does_not_open_and_bad_limits_are_one_line(tmp_path, capture, capsys):
    root, _ = capture
    assert run.main(["pin", str(root), "99", f"output={tmp_path}"]) == run.EXIT_FAILED
    assert run.main(["pin", str(root), str(root), "fail_on=moved<2", f"output={tmp_path}"]) == run.EXIT_FAILED
    assert run.main(["pin", str(root), str(root), "max_frames=0", f"output={tmp_path}"]) == run.EXIT_FAILED
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("dhtorch: ")]
    assert "camera" in lines[0] and "fail_on" in lines[1] and "max_frames" in lines[2]


def test_pictures_are_spread_evenly():
    assert pin._spread(10, 5) == [0, 2, 4, 6, 8] and pin._spread(3, 8) == [0, 1, 2] and pin._spread(9, 1) == [0]
    assert torch.equal(torch.tensor(pin._spread(4, None)), torch.arange(4))


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        ([PinVerdict.NOT_MOVED, *[PinVerdict.CANNOT_KNOW] * 5], PinVerdict.CANNOT_KNOW),
        ([PinVerdict.NOT_MOVED] * 3 + [PinVerdict.CANNOT_KNOW] * 3, PinVerdict.NOT_MOVED),
        ([PinVerdict.MOVED] * 3 + [PinVerdict.NOT_MOVED] + [PinVerdict.CANNOT_KNOW] * 2, PinVerdict.MOVED),
    ],
)
def test_the_verdict_of_an_episode_needs_half_of_its_pictures(verdicts, expected):
    result = SimpleNamespace(verdict=torch.tensor(verdicts))
    assert pin.Episode("e", list(range(len(verdicts))), result, torch.zeros(3, 4, 4)).verdict == expected


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("image", [torch.full((1, 4, 5), 51, dtype=torch.uint8), torch.full((1, 4, 5), 0.2)])
def test_pictures_are_drawn_in_three_channels_of_bytes(image, channels):
    drawn = pin._to_rgb(image.expand(channels, -1, -1))
    assert drawn.shape == (4, 5, 3) and drawn.dtype == np.uint8 and (drawn == 51).all()
