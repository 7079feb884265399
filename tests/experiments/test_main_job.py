"""The main job and the method comparison, on the exact room and on the real scenes."""

import os
from functools import cache, partial
from pathlib import Path

import hydra
import pytest
import torch
from hydra.utils import instantiate
from support.rooms import room as rendered
from support.rooms import room_scene

from dhtorch import data
from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import by_gap
from dhtorch.experiments import pair, protocol
from dhtorch.stages.track import lucas_kanade
from dhtorch.synthetic.recording import SyntheticRoom

ROOT = os.environ.get("DHTORCH_DATA")


@cache
def composed(name):
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        return hydra.compose("run", [f"method={name}"]).method


def method(name):
    return instantiate(composed(name), _convert_="all")


def scene_row(outcome, **wanted):
    (row,) = (r for r in outcome.rows if r["pair"] is None and all(r[k] == v for k, v in wanted.items()))
    return row


@pytest.mark.slow
def test_exact_room_without_sensor_noise():
    """Median error of recovered far depth < 1 %, silently wrong < 0.5 %; mirror and window are counted apart."""
    room = rendered(lidar="exact", image_noise=0.0, hw=(240, 320), n_frames=8, supersample=2)
    row = scene_row(pair.run([room_scene(room)], {"paper": method("paper")}, by_gap, pair.Settings()))
    assert row["n_pairs"] == 2 and row["n_candidates"] > 400
    assert row["median_rel"] < 0.01 and row["wrong_share"] < 0.005 and row["coverage"] > 0.93, row
    assert set(row["apart"]) == {"mirror", "window"} and row["apart"]["mirror"]["n_candidates"] > 100
    assert row["apart"]["mirror"]["wrong_share"] > 0.25, "what is seen in a mirror lies behind it"
    assert row["n_dropped"]["excluded"] == sum(row["apart"][k]["n_candidates"] for k in ("mirror", "window"))


#: What the median error of the built-in room stays below, exact depth and no noise: 1 % does not hold for every seed.
BOUNDS = {0: 0.02, 1: 0.01, 2: 0.01, 3: 0.011, 4: 0.02}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_rooms_of_all_seeds_keep_their_bounds():
    """Wrong answers are a dozen of 2,500 in a room, and another processor rounds to others: all rooms are counted."""
    n_wrong = n_kept = 0
    for seed, bound in BOUNDS.items():
        room = SyntheticRoom(seed=seed, lidar="exact", image_noise=0.0)
        row = scene_row(pair.run([room_scene(room)], {"paper": method("paper")}, by_gap, pair.Settings()))
        assert row["median_rel"] < bound and row["coverage"] > 0.9, row
        n_kept += row["coverage"] * row["n_candidates"]
        n_wrong += row["wrong_share"] * row["coverage"] * row["n_candidates"]
    assert n_wrong < 0.005 * n_kept


def small(**options):
    return rendered(hw=(120, 160), n_frames=4, **options)


def test_variants_share_tracks_and_pay_for_them():
    asked = []

    def track(*args, hint):
        asked.append(args)
        return lucas_kanade(*args, hint=hint)

    base = method("paper")
    variants = {
        "gated": protocol.Variant(base.replace(track=track)),
        "other_seed": protocol.Variant(base.replace(track=track), seed=7),
        "own": protocol.Variant(base),
    }
    outcome = protocol.run(
        [room_scene(small())], protocol.Protocol(variants), partial(by_gap, gap=3), protocol.Settings(between=0)
    )
    assert len(asked) == outcome.n_pairs == 1
    rows = [scene_row(outcome, method=name) for name in variants]
    assert rows[0]["ms"]["track"] == pytest.approx(rows[1]["ms"]["track"], rel=0.5)
    same = [{k: r[k] for k in ("coverage", "median_rel", "n_candidates")} for r in rows]
    assert same[0] == same[2]
    assert set(outcome.points) == {("synthetic_room", name, "full") for name in variants}


def test_views_of_a_window_are_shared_too():
    asked = []

    def track(image_0, image_1, uv_0, *, hint):
        asked.append(hint.start)
        return lucas_kanade(image_0, image_1, uv_0, hint=hint)

    base = method("map").replace(track=track, views=3)
    variants = {name: protocol.Variant(base, seed=k) for k, name in enumerate(("first", "second"))}
    outcome = protocol.run(
        [room_scene(small())], protocol.Protocol(variants), partial(by_gap, gap=3), protocol.Settings()
    )
    assert len(asked) == 3 and asked[0] is None and asked[2] is not None, "one search for each view, not for each seed"
    first, second = (scene_row(outcome, method=name) for name in variants)
    assert first["ms"]["track"] == pytest.approx(second["ms"]["track"], rel=0.5)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize(
    ("name", "near", "gap", "coverage", "median"),
    [
        ("holo_a", 2.5, 3, 0.12, 0.08),
        ("tum_fr1_desk9", 1.0, 4, 0.5, 0.12),
        ("middlebury_motorcycle", 2.8, 1, 0.6, 0.05),
    ],
)
def test_real_scenes_give_far_depth(name, near, gap, coverage, median):
    (scene,) = data.open_capture(Path(ROOT) / name, near=near, gap=gap)
    stride = 8 if len(scene.recording) > 20 else 1
    row = scene_row(pair.run([scene], {"paper": method("paper")}, partial(by_gap, stride=stride), pair.Settings()))
    assert row["coverage"] > coverage and row["median_rel"] < median and row["pnp_success"] > 0.7, row


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_alone_or_in_a_batch_the_rows_of_a_real_scene_are_equal():
    torch.set_num_threads(1)
    (scene,) = data.open_capture(Path(ROOT) / "tum_fr1_desk9", near=1.0, gap=4)
    rows = []
    for batch, workers in ((1, 0), (5, 2)):
        settings = pair.Settings(batch=batch, workers=workers)
        outcome = pair.run([scene], {"paper": method("paper")}, by_gap, settings)
        assert outcome.n_pairs == 5
        rows.append([{k: v for k, v in r.items() if k != "ms"} for r in outcome.rows])
    assert rows[0] == rows[1]
