"""Rows of an extraction and the frames of each, on recordings of a few pixels with a stub method."""

import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from support.stub_recordings import Load, P, frame, recording, rows
from support.stub_samples import FixedEstimate, H, N, Stub, W

from dhtorch import extract
from dhtorch.extract import columns, plan
from dhtorch.extract.dataset import RowDataset, common_map_hw
from dhtorch.records import Camera, Frame
from dhtorch.transforms import DenseMaps


class Seen:
    """A stub method that records the two views of every call."""

    calls: ClassVar[list] = []

    def __call__(self, reference, other, *, n=N, seed=0, trace=None):
        Seen.calls.append((reference, other, seed))
        return FixedEstimate()(reference, other, n=n, seed=seed, trace=trace)


@pytest.fixture(autouse=True)
def forgotten():
    Seen.calls = []


# ---------------------------------------------------------------------------------------------------- the plan


def test_positions_places_and_shards():
    whole = plan.ExtractionPlan(order=(2, 0, 1), episodes=(0, 4, 9), ends=(3, 4, 8), roots={})
    places = [*((2, 0, i) for i in range(3)), (0, 4, 0), *((1, 9, i) for i in range(4))]
    assert len(whole) == 8 and [whole.place(i) for i in range(8)] == places
    for size, pieces in ((3, [3, 3, 2]), (4, [4, 4]), (8, [8]), (9, [8]), (1, [1] * 8)):
        shards = whole.shards(size)
        assert [len(s.rows) for s in shards] == pieces and [i for s in shards for i in s.rows] == list(range(8))
        assert [(s.number, s.of) for s in shards] == [(k, len(pieces)) for k in range(len(pieces))]
    assert [len(s.rows) for s in whole.shards(3, apart=True)] == [3, 1, 3, 1]
    assert [s.name for s in whole.shards(3)] == [f"shard-0000{k}.parquet" for k in range(3)]
    assert plan.ShardSpec(123, 200, range(1)).name == "shard-00123.parquet"


def test_the_plan_is_sorted_by_episode_and_names_its_folders_once():
    given = [(2, "c", 5, "/b"), (3, "a", 1, None), (4, "b", 0, "/a"), (1, "d", 7, "/b")]
    made = plan.make_plan([recording(n, name=x, episode=e, root=r and Path(r)) for n, x, e, r in given], 1, 1)
    assert (made.order, made.episodes, made.ends) == ((2, 1, 0, 3), (0, 1, 5, 7), (4, 7, 9, 10))
    assert [*made.roots.items()] == [(Path("/b"), None), (Path("/a"), None)]
    unnumbered = plan.make_plan([recording(2), recording(3, name="two")], 0, 1)
    assert (unnumbered.order, unnumbered.episodes, unnumbered.ends) == ((0, 1), (0, 1), (2, 5))
    with pytest.raises(ValueError, match="data: left and right are one episode, expected one camera of it"):
        plan.make_plan([recording(name=x, episode=e) for x, e in (("left", 3), ("x", None), ("right", 3))], 0, 1)


@pytest.mark.parametrize(
    ("own", "gap", "views", "steps"),
    [
        (7, 3, 1, [3]),
        (7, None, 1, [7]),
        (7, 0, 1, []),
        (None, 0, 3, []),
        (7, 6, 3, [2, 4, 6]),
        (7, None, 2, [4, 7]),
        (None, None, 1, None),
    ],
)
def test_steps_go_back_by_the_gap_evenly_for_many_views(own, gap, views, steps):
    scene = SimpleNamespace(name="r", gap=own)
    if steps is None:
        with pytest.raises(
            ValueError, match=r"extract\.gap: r has no gap of its own, expected a number.*0 = front end"
        ):
            plan.view_offsets(scene, gap, views)
        with pytest.raises(ValueError, match="views: found 4"):
            plan.make_plan([recording(gap=3)], None, 4)
        return
    assert plan.view_offsets(scene, gap, views) == steps


# ---------------------------------------------------------------------------------------------------- rows


def test_a_row_looks_back_by_frame_number_inside_its_episode():
    first = recording(numbers=[0, 1, 2, 5, 6, 7], load=Load(10), episode=3)
    second = recording(3, name="two", load=Load(50), episode=1)
    made = rows([first, second], 2, Seen())
    pairs = {}
    for position in range(len(made)):
        Seen.calls = []
        answer = made[position]
        where = answer.place["episode_index"], answer.place["frame_index"]
        assert answer.features["problem"] == (0 if Seen.calls else 1)
        for reference, other, _ in Seen.calls:
            pairs[where] = [
                next(s for s in range(60) if torch.equal(frame(s).image, x.image)) for x in (other, reference)
            ]
    assert pairs == {(1, 2): [50, 52], (3, 2): [10, 12], (3, 7): [13, 15]}


def test_a_method_is_given_what_the_frames_know():
    one = recording(load=Load(20, confidence=True, bent=True, own=True))
    answer = rows([one], 2, Seen(), seed=9)[3]
    ((reference, other, seed),) = Seen.calls
    before, now = frame(21, True, True, True), frame(23, True, True, True)
    assert seed == 9 and answer.features["problem"] == 0
    for mine, theirs in ((reference, now), (other, before)):
        assert torch.equal(mine.image, theirs.image) and torch.equal(mine.camera.f, theirs.camera.f)
        assert torch.equal(mine.camera.c, theirs.camera.c)
        assert torch.allclose(mine.camera.distortion, theirs.camera.distortion)
    assert torch.equal(reference.depth, now.depth) and torch.equal(reference.conf, now.conf)
    assert torch.equal(reference.depth_camera.f, now.depth_camera.f)
    mixed = recording(load=lambda i: frame(i, bent=i == 3))
    rows([mixed], 1, Seen())[3]
    reference, other, _ = Seen.calls[-1]
    assert (
        torch.allclose(reference.camera.distortion, torch.tensor([[0.03, 0, 0, 0]]))
        and not other.camera.distortion.any()
    )


def test_what_readers_give_is_trusted():
    """Metres and intrinsics are the readers' own: no depth is too far, no principal point too far off, no field too wide."""
    camera = Camera(torch.tensor([[30.0, 30]]), torch.tensor([[400.0, -300]]))
    far = Frame(frame(1).image, 5000 + frame(1).depth, camera)
    wide = far.replace(camera=camera.replace(f=torch.full((1, 2), 0.02)))
    for odd in (far, far.replace(depth=far.depth * 1e-8), wide):
        assert rows([recording(load=lambda i, odd=odd: odd)], 0)[0].features is not None


def test_a_frame_that_cannot_be_read_says_so_and_is_no_other_view():
    made = rows([recording(5, load=Load(bad={2}), numbers=[10, 11, 12, 13, 14])], 1)
    bad = made[2]
    assert bad.features is None and bad.complaint == "one, frame 12: position 2 is damaged"
    assert [int(made[i].features["problem"]) for i in (0, 1, 3, 4)] == [1, 0, 1, 0]
    short = rows([recording(load=Load(bad={1}, error=MemoryError))], 1)
    for position in (1, 2):
        with pytest.raises(MemoryError):
            short[position]
    with pytest.raises(torch.OutOfMemoryError):
        rows([recording(load=Load(bad={1}, error=torch.OutOfMemoryError))], 0)[1]


def test_many_views_are_the_nearest_first_and_the_reference_pads():
    method = Stub(answer=Seen(), n=N, views=2)
    one = recording(6)
    made = RowDataset(
        [one], plan.make_plan([one], 4, 2), columns.feature_columns(N, P), method=method, gap=4, tokens_hw=(H, W)
    )
    for position, views in ((5, (3, 1)), (3, (1, 3))):
        made[position]
        _, other, _ = Seen.calls[-1]
        assert other.image.shape == (2, 1, 3, H, W)
        assert all(torch.equal(other.image[k], frame(v).image) for k, v in enumerate(views))
    assert len(Seen.calls) == 2 and made[1].features["problem"] == 1 and len(Seen.calls) == 2


def test_a_row_chooses_among_the_earlier_frames_that_can_be_read():
    first, alone = recording(5, load=Load(bad={1})), recording(1, name="alone", load=Load(30))
    method = Stub(answer=Seen(), n=N)
    made = RowDataset([first, alone], plan.make_plan([first, alone], "auto", 5), columns.feature_columns(N, P), method=method, gap="auto",
                tokens_hw=(H, W))  # fmt: skip
    asked = {}
    for position in (0, 2, 3, 4, 5):
        Seen.calls = []
        answer = made[position]
        assert answer.features["problem"] == (0 if Seen.calls else 1)
        for _, other, _ in Seen.calls:
            views = other.image if other.image.dim() == 5 else other.image[None]
            asked[position] = [next(s for s in range(9) if torch.equal(frame(s).image, x)) for x in views]
    assert asked == {2: [0], 3: [0, 2], 4: [2, 3]}, "steps 1, 2, 3, 5 back; frame 1 is damaged, the first has none"


def test_rows_are_the_same_in_any_order_and_after_a_pickle():
    both = [recording(3, load=Load(0)), recording(3, name="two", load=Load(30))]
    made = rows(both, 1)
    forth = [made[i] for i in range(6)]
    twin = pickle.loads(pickle.dumps(made))
    for i in (5, 0, 4, 1, 3, 2):
        assert twin[i].place["recording"] == forth[i].place["recording"]
        assert all(np.array_equal(v, twin[i].features[k]) for k, v in forth[i].features.items())


# ---------------------------------------------------------------------------------------------------- options, the run


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("engine", "dask", "found 'dask', expected one of local, ray"),
        ("on_error", "ignore", "found 'ignore', expected one of raise, skip, flag"),
        ("fit", "squash", "found 'squash', expected one of stretch, pad, crop"),
        *(("gap", x, f"found {x!r}, expected a whole number of at least 0") for x in (-1, 1.5, "car")),
        *(
            (name, x, f"found {x}, expected a whole number of at least 1")
            for name in ("patch", "shard_rows")
            for x in (0, None)
        ),
        *(("tokens_hw", x, r"found .*, expected height and width") for x in (None, (1, 2, 3), 224)),
        ("dense", {"sise": 48}, "found 'sise', expected some of source_views"),
    ],
)
def test_options_of_an_extraction_are_checked(option, value, message):
    with pytest.raises(ValueError, match=f"extract.{option}: {message}"):
        extract.ExtractOptions(**{option: value})
    assert extract.ExtractOptions(gap=0, patch=1, shard_rows=1, dense=True).gap == 0
    assert extract.ExtractOptions(gap=None).gap is None


class OtherSize(Load):
    """Frames whose image is wider from a position on."""

    def __init__(self, first_wide, **options):
        super().__init__(**options)
        self.first_wide = first_wide

    def __call__(self, i):
        one = super().__call__(i)
        if i < self.first_wide:
            return one
        return one.replace(image=one.image.repeat(1, 1, 1, 2), depth=one.depth.repeat(1, 1, 2))


def test_maps_have_one_size_in_all_recordings_and_frames():
    """Refused before the work, or a frame that cannot be read."""
    small, wide = recording(2, load=Load(bad={0})), recording(2, name="two", load=OtherSize(0))
    assert common_map_hw([small, recording(3)], DenseMaps.from_options({"size": 21})) == (14, 21)
    words = "extract.dense: two has pictures of 28x84 and maps of 11x32, expected maps of 21x32 as of one; extract them"
    with pytest.raises(ValueError, match=words):
        common_map_hw([small, wide], DenseMaps.from_options({"size": 32}))
    with pytest.raises(ValueError, match="found no frame that can be read"):
        common_map_hw([recording(2, load=Load(bad={0, 1}))], DenseMaps.from_options(True))
    wanted = columns.feature_columns(6, 6, map_hw=(14, 21))
    made = rows([recording(2, load=OtherSize(1))], 0, wanted=wanted, dense={"size": 21})
    assert made[0].features["depth_map"].shape == (14, 21) and made[1].features is None
    assert "one, frame 1: depth_map: found 7x21, expected 14x21 as of the first frame" in made[1].complaint
