"""``dhtorch PATH``: a capture of one's own, or one sentence that says why nothing comes of it."""

import base64
import json
import shlex
import shutil

import av
import numpy as np
import pytest
from PIL import Image
from support import stored_outputs, writers

from dhtorch.cli.completed_folder import count_pixels
from dhtorch.cli.run import main
from dhtorch.metrics.holdout import range_split
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz.plots import colours

SMALL = ["method=map", "method.n=256", "planes=32", "steps=[1]", "mesh=false", "threads=1"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three views of the room, a sensor that ends at two metres."""
    whole = SyntheticRoom(hw=(120, 160), n_frames=22, lidar="exact", supersample=1, image_noise=0.0)
    path = tmp_path_factory.mktemp("captures") / "kitchen"
    writers.write_counted_frames(path, [range_split(whole[k], 2.0) for k in (0, 7, 14)])
    return path


@pytest.fixture(scope="module")
def made(capture, tmp_path_factory):
    """What the command makes of it."""
    out = tmp_path_factory.mktemp("out") / "room"
    assert main([str(capture), f"out={out}", *SMALL]) == 0
    return out


def test_one_word_makes_maps_a_map_a_page_and_a_picture(made):
    assert {
        "depth",
        "sigma",
        "source",
        "meta",
        "previews",
        "overview.png",
        "preview.mp4",
        "map.ply",
        "map.glb",
        "view.html",
    } <= {p.name for p in made.iterdir()}
    rows = [json.loads(p.read_text()) for p in (made / "meta").iterdir()]
    assert len(rows) == 3 and all(row["pixels"]["swept"] > 1000 for row in rows)
    assert b"comment up " in (made / "map.ply").read_bytes()[:2000]
    width, height = Image.open(made / "overview.png").size
    assert width >= 1600 and height > 600, "a row for each of three frames"


def test_what_the_command_writes_is_stored(made):
    stored_outputs.check("recover", made.parent, folder=made)


def test_every_frame_has_a_preview_and_all_frames_are_in_the_video(made):
    names = sorted(p.stem for p in (made / "meta").iterdir())
    previews = sorted((made / "previews").iterdir())
    assert [p.name for p in previews] == [f"{name}.jpg" for name in names]
    for path in previews:
        pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
        assert pixels.shape[1] > 900
        assert (pixels.max(-1) - pixels.min(-1) > 100).mean() > 0.1, "coloured depth"
    with av.open(str(made / "preview.mp4")) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(shown) == 3 and shown[0].shape[1] > 3 * 160
    thirds = np.array_split(shown[1][80:180], 3, axis=1)
    blank = np.array(colours.parse_rgb(colours.PICTURE))
    sensor, completed = ((np.abs(third - blank).max(-1) < 12).mean() for third in thirds[1:])
    assert completed < sensor - 0.05, "blank where the sensor has no depth, less where it is completed"


def test_the_page_begins_with_the_numbers_and_the_picture(made):
    page = (made / "view.html").read_text(encoding="utf-8")
    rows = [json.loads(p.read_text()) for p in (made / "meta").iterdir()]
    pixels = sum(count_pixels(row)["recovered"] for row in rows) / len(rows)
    opening = page[page.index('<section id="opening"') : page.index("<main>")]
    assert f"<dd>{pixels:,.0f}</dd>" in opening and "Recovered, median sigma / depth" in opening
    poster = page[page.index('<section id="poster"') :]
    assert page.index("</main>") < page.index('<section id="poster"'), "the map comes first"
    assert base64.b64encode((made / "overview.png").read_bytes()).decode() in poster
    assert "Recovered " in opening and "Most frequent reasons for no answer: " in opening and "no_track" not in opening
    assert "Kitchen, frames 0, 1, 2: picture, sensor depth" in poster and "<h1>Kitchen · dhtorch</h1>" in page


@pytest.mark.slow
def test_it_says_what_it_is_what_was_recovered_and_what_to_do_next(capture, made, tmp_path, capsys):
    before = {p: p.stat().st_mtime_ns for p in (made / "meta").iterdir()}
    assert main(["recover", str(capture), f"out={made}", *SMALL]) == 0
    what, found, then, wrote = capsys.readouterr().out.strip().splitlines()
    assert what.startswith("kitchen: a frames_dir capture, 3 frames of 160x120; the sensor has depth at")
    assert found.startswith("Recovered ") and " pixels per frame from other views, at " in found
    assert then.startswith("Next: ") and str(made) in wrote
    assert {p: p.stat().st_mtime_ns for p in (made / "meta").iterdir()} == before, "complete frames are kept"
    command = then.partition("on your capture: dhtorch ")[2].rstrip(".")
    assert main([*command.split(), "method=map", "method.n=64", f"hydra.run.dir={tmp_path / 'job'}"]) == 0, "as printed"


@pytest.mark.slow
def test_the_beginning_is_made_where_time_is_short_and_said_again_it_goes_on(capture, tmp_path, capsys):
    words = [str(capture), f"out={tmp_path / 'x'}", *SMALL]
    assert main([*words, "minutes=1e-6"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("Next: "))
    assert "; 2 of 3 frames left at the time limit, to complete them: dhtorch " in line
    assert [p.stem for p in (tmp_path / "x/meta").iterdir()] == ["000001"], "the middle comes first"
    assert main([*words, "minutes=1e-6"]) == 0
    assert main(shlex.split(line.rpartition(": dhtorch ")[2])) == 0, "as printed"
    assert len(list((tmp_path / "x/meta").iterdir())) == len(list((tmp_path / "x/previews").iterdir())) == 3


@pytest.mark.slow
def test_frames_in_another_order_are_the_same_bits(capture, made, tmp_path):
    """Interrupted after each frame and resumed, or in one go: the same files."""
    words = [str(capture), f"out={tmp_path / 'x'}", *SMALL]
    for _ in range(3):
        assert main([*words, "minutes=1e-6"]) == 0
    for name in ("depth", "sigma", "source", "previews"):
        for path in (made / name).iterdir():
            assert (tmp_path / "x" / name / path.name).read_bytes() == path.read_bytes(), path.name
    for name in ("overview.png", "preview.mp4"):
        assert (tmp_path / "x" / name).read_bytes() == (made / name).read_bytes(), name


def test_a_frame_that_cannot_be_read_is_left_out_and_named(capture, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(capture, broken)
    picture = broken / "images/00001.png"
    picture.write_bytes(picture.read_bytes()[:100])
    assert main([str(broken), f"out={tmp_path / 'out'}", *SMALL, "steps=[1,2]"]) == 0
    said = capsys.readouterr().out
    assert "1 frame of broken could not be read" in said and picture.name in said
    assert len(list((tmp_path / "out/meta").iterdir())) == 2


@pytest.mark.slow
def test_one_capture_that_cannot_be_opened_does_not_stop_the_others(capture, tmp_path, capsys):
    room = SyntheticRoom(hw=(48, 64), n_frames=3)
    writers.write_stray(tmp_path / "both" / "alone", list(room), video=False)
    shutil.copytree(capture, tmp_path / "both" / "kitchen")
    assert main([str(tmp_path / "both"), f"out={tmp_path / 'out'}", "minutes=0.01", *SMALL]) == 0
    said = capsys.readouterr().out
    assert "kitchen" in said and "alone: depth without images" in said and (tmp_path / "out/overview.png").is_file()
