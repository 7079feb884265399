"""Frame after frame: the newest from the past alone, with a bounded memory, whatever the way the frames came."""

import json
import pickle

import pytest
import torch

from dhtorch import MAP, PAPER
from dhtorch.cli.run import main
from dhtorch.codes import Gate
from dhtorch.pipeline.stream import Stream, is_scene_cut
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.pytree import stack
from dhtorch.records import Frame
from dhtorch.synthetic import open_room

FAST = MAP.replace(n=256, views=2, select_views=select_views_by_preview)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    room = open_room(seed=1, n_frames=6, hw=(192, 256), step_m=0.05).recording
    return [room[k] for k in range(6)]


@pytest.fixture(scope="module")
def elsewhere(frames: list[Frame]) -> Frame:
    """Another place: the room on its head, inside out."""
    return frames[2].replace(image=1 - frames[2].image.flip(-2).roll(90, -1))


def same(a, b) -> bool:
    return all(torch.equal(getattr(a, k).nan_to_num(), getattr(b, k).nan_to_num()) for k in ("depth", "sigma", "gate"))


def test_the_newest_frame_is_answered_from_those_before_it(frames: list[Frame]) -> None:
    stream = Stream(FAST, steps=(1, 2, 4))
    first = stream.push(frames[0])
    assert bool((first.gate == Gate.NO_BASELINE).all()) and first.depth.isnan().all() and first.uv.shape == (1, 256, 2)
    second = stream.push(frames[1])
    assert same(second, FAST(frames[1], frames[0]))
    for k in (2, 3):
        stream.push(frames[k])
    trace: dict = {}
    found = stream.push(frames[4], trace=trace)
    assert same(found, FAST(frames[4], stack([frames[0], frames[2], frames[3]])))
    back = [(4, 2, 1)[k] for k in trace["choice"].index[:, 0].tolist()]  # the frames in the order of capture
    assert int(found.keep.sum()) > 30 and trace["back"][:, 0].tolist() == back
    assert stream.pushed == 5 and stream.cuts == []


@pytest.mark.slow
def test_memory_is_the_last_frames_and_no_more(frames: list[Frame]) -> None:
    stream = Stream(PAPER.replace(n=32), steps=(1, 3))
    sizes = []
    for frame in frames:
        stream.push(frame)
        sizes.append(stream.nbytes)
    one = sizes[0]
    assert one == sum(x.numel() * x.element_size() for x in leaves(frames[0])) and sizes == [one, 2 * one] + 4 * [
        3 * one
    ]


def leaves(frame: Frame) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []
    frame.map(lambda x: found.append(x) or x)
    return found


def test_a_stream_pickles_with_its_memory(frames: list[Frame]) -> None:
    one, two = Stream(FAST, steps=(1, 2)), Stream(FAST, steps=(1, 2))
    for k in range(3):
        one.push(frames[k])
        two = pickle.loads(pickle.dumps(two))
        two.push(frames[k])
    assert same(one.push(frames[3]), two.push(frames[3])) and two.pushed == 4


def test_a_cut_is_noticed_and_the_past_forgotten(frames: list[Frame], elsewhere: Frame) -> None:
    stream = Stream(FAST, steps=(1, 2))
    for frame in (frames[0], frames[1], elsewhere):
        last = stream.push(frame)
    assert stream.cuts == [2] and len(stream.past) == 1 and bool((last.gate == Gate.NO_BASELINE).all())
    assert not is_scene_cut(frames[0], frames[1]) and is_scene_cut(frames[1], elsewhere)
    dark = frames[1].replace(image=torch.zeros_like(frames[1].image))
    assert not is_scene_cut(frames[0], dark) and not is_scene_cut(dark, frames[1]), "nothing is told by a black picture"


@pytest.mark.slow
def test_the_command_streams_a_recording(tmp_path, capsys) -> None:
    options = ["data=synthetic", "data.n_frames=4", "data.hw=[192,256]", "method.n=256", "method.views=2"]
    assert main(["stream", *options, "max_frames=3", "cutoff=2.0", f"output={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert "3 frames" in said and "frames/s" in said
    (scene,) = json.loads((tmp_path / "stream.json").read_text())["scenes"]
    assert scene["n_frames"] == 3 and [row["frame"] for row in scene["frames"]] == [0, 1, 2]
    assert scene["frames"][0]["n_recovered"] == 0 < scene["frames"][0]["n_holes"]
    assert scene["frames"][2]["n_recovered"] > 0 and not scene["cuts"]
    assert main(["stream", *options, "max_frames=0", f"output={tmp_path}"]) == 2
    assert "max_frames: found 0" in capsys.readouterr().err


def test_wrong_frames_and_steps_are_refused(frames: list[Frame]) -> None:
    both = frames[0].map(lambda x: torch.cat((x, x)))
    with pytest.raises(ValueError, match="2 views in one frame"):
        Stream(FAST).push(both)
    with pytest.raises(ValueError, match="steps"):
        Stream(FAST, steps=(0, 1))
