"""An interrupted experiment keeps its finished scenes: the next run computes the others, and the result is the same."""

import json
import math
import shutil
import signal
from pathlib import Path

import pytest
import torch

from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.experiments import protocol
from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.outcome import Outcome
from dhtorch.experiments.paper import hole_census
from dhtorch.pipeline.presets import METHODS
from dhtorch.synthetic import recording

ROOMS = ["data=synthetic_seeds", "pairs=gap", "pairs.gap=2", "method=paper", "method.n=1024", "figures=false"]


@pytest.fixture(scope="module")
def scenes():
    """Three small rooms; the built-in ones of several seeds are larger."""
    small = {"hw": (120, 160), "n_frames": 3, "supersample": 1, "lidar": "exact"}
    rooms = [recording.SyntheticRoom(name=f"room/{k}", seed=k, **small) for k in range(3)]
    return [Scene(room, near=2.0, gap=2) for room in rooms]


@pytest.fixture(autouse=True)
def small_rooms(monkeypatch, scenes):
    """The command runs on the small rooms."""
    monkeypatch.setattr(recording, "open_rooms", lambda **_: scenes)


@pytest.fixture
def computed(monkeypatch):
    """Names of the scenes that the loops of pairs compute, and the number of those after which Ctrl-C is pressed."""
    real, state = protocol._run_scene, {"scenes": [], "stop": math.inf}

    def run(scene, *args):
        if len(state["scenes"]) == state["stop"]:
            signal.raise_signal(signal.SIGINT)
        state["scenes"].append(scene.name)
        return real(scene, *args)

    monkeypatch.setattr(protocol, "_run_scene", run)
    return state


def content(folder):
    """All files of a job but for times: the result without milliseconds, pictures and points as they are."""
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.glob("*") if p.is_file()}
    result = json.loads(files.pop("result.json"))

    def timeless(value):
        if isinstance(value, dict):
            return {k: timeless(v) for k, v in value.items() if k not in ("ms", "utc", "git") and "ms." not in k}
        return [timeless(v) for v in value] if isinstance(value, list) else value

    result["config"].pop("resume")
    return timeless(result), files


def interrupt(command, computed, folder, *options, after):
    computed["scenes"].clear()
    computed["stop"] = after
    code, _, err = command(*ROOMS, *options, f"output={folder}")
    assert code == 130 and "Finished scenes are kept" in err and "resume=true" in err, err
    assert not Path(folder, "result.json").exists()
    kept = list(Path(folder, ".dhtorch", "scenes").rglob("*.pt"))
    assert len(kept) == after, "one file for every scene that was finished"
    computed["scenes"].clear()
    computed["stop"] = math.inf
    return kept


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "loops"),
    [((), 1), pytest.param(("experiment=calibration",), 2, marks=pytest.mark.slow)],
    ids=["pair", "two loops"],
)
def test_the_rest_is_computed_and_the_result_is_that_of_an_uninterrupted_run(
    command, computed, tmp_path, options, loops
):
    assert command(*ROOMS, *options, "output=whole")[0] == 0
    assert any(row.get("median_rel") for row in content(tmp_path / "whole")[0]["rows"]), "there are answers to compare"
    assert len(computed["scenes"]) == 3 * loops
    done = 3 * loops - 1
    interrupt(command, computed, "cut", *options, after=done)
    code, _, err = command(*ROOMS, *options, "resume=true", "output=cut")
    assert code == 0 and len(computed["scenes"]) == 1, err
    assert content(tmp_path / "cut") == content(tmp_path / "whole")
    assert not (tmp_path / "cut" / ".dhtorch" / "scenes").exists(), "nothing is kept beside the result"
    assert command(*ROOMS, *options, "resume=true", "output=cut")[0] == 0 and len(computed["scenes"]) == 1


@pytest.mark.slow
def test_a_damaged_or_foreign_scene_other_settings_and_a_run_without_resume_use_nothing(command, computed):
    first, second = sorted(interrupt(command, computed, "a", after=2))
    shutil.copytree("a", "b")
    shutil.copytree("a", "c")
    first.write_bytes(first.read_bytes()[:-100])
    shutil.copy(first.parent / second.name, first.parent / "x.pt")
    stored = torch.load(second, weights_only=True)
    torch.save({**stored, "identity": (stored["identity"][0], "another scene")}, second)
    for words in (["resume=true", "output=a"], ["method.n=900", "resume=true", "output=b"], ["output=c"]):
        computed["scenes"].clear()
        assert command(*ROOMS, *words)[0] == 0 and len(computed["scenes"]) == 3


@pytest.mark.slow
def test_experiments_with_loops_of_their_own_keep_their_scenes(command, monkeypatch, tmp_path):
    """hole_census has a loop of its own, helix_correlation that of the protocol."""
    for experiment, module, name in (
        ("hole_census", hole_census, "_join_frames"),
        ("helix_correlation", protocol, "_join_rows"),
    ):
        options = [f"experiment={experiment}"]
        assert command(*ROOMS, *options, f"output={experiment}")[0] == 0
        real, calls = getattr(module, name), []

        def stop(*args, real=real, calls=calls):
            calls.append(1)
            if len(calls) == stop.at:
                raise ValueError("data: the disk is gone")
            return real(*args)

        per_scene = 1 if experiment == "hole_census" else 5
        stop.at = 2 * per_scene + 1
        monkeypatch.setattr(module, name, stop)
        code, _, err = command(*ROOMS, *options, f"output={experiment}_cut")
        assert code == 2 and "the disk is gone" in err
        calls.clear()
        stop.at = 0
        assert command(*ROOMS, *options, "resume=true", f"output={experiment}_cut")[0] == 0
        assert len(calls) == per_scene, "one of three scenes"
        assert content(tmp_path / f"{experiment}_cut") == content(tmp_path / experiment)


@pytest.mark.slow
def test_examples_for_figures_are_kept_with_their_method(scenes, tmp_path):
    variants = {"paper": protocol.Variant(METHODS["paper"].replace(n=512))}

    def run():
        settings = protocol.Settings(finished=FinishedScenes(tmp_path / "s", "k" * 64))
        return protocol.run(scenes[:1], protocol.Protocol(variants, min_candidates=0), by_gap, settings)

    (first,), (second,) = (run().examples for _ in range(2))
    assert second.call_options["method"] is variants["paper"].method and second.pair == first.pair
    assert torch.equal(first.frame.image, second.frame.image) and first.cutoff == second.cutoff
    ours, theirs = (
        [e.samples.uv, e.estimate.depth, e.truth.depth, e.call_options["others"].depth] for e in (first, second)
    )
    assert all(torch.equal(a, b) or a.isnan().equal(b.isnan()) for a, b in zip(ours, theirs, strict=True))
    assert first.call_options.keys() == second.call_options.keys()


def test_a_store_reads_no_code_and_follows_no_link(tmp_path):
    store = FinishedScenes(tmp_path / "s", "k" * 64)
    keep = store.loop()
    rows = [{"scene": "a/b", "pair": (0, 1), "method": "m", "x": math.nan, "flag": True, "none": None}]
    assert keep("a/b", lambda: Outcome(rows, n_pairs=2)).rows == rows
    (file,) = (tmp_path / "s").rglob("*.pt")
    again = FinishedScenes(tmp_path / "s", "k" * 64).loop()("a/b", lambda: pytest.fail("computed again"))
    assert repr(again.rows) == repr(rows) and again.n_pairs == 2
    file.write_bytes(b"\x80\x04\x8c\x05posix\x94\x8c\x06system\x94\x93\x94\x8c\x04true\x94\x85\x94R\x94.")
    assert FinishedScenes(tmp_path / "s", "k" * 64).loop()("a/b", lambda: Outcome(n_pairs=7)).n_pairs == 7
    FinishedScenes(tmp_path / "s", "other").loop()
    assert not file.exists(), "scenes of other settings are removed"
