"""Images between the two of a pair: which frames reach the tracker."""

from functools import partial

import pytest
import torch
from support.numbered_frames import MAP, frame, scene, track
from support.rooms import room

from dhtorch.data.pairs import Pair, by_choice
from dhtorch.data.rig import join_cameras
from dhtorch.experiments import protocol
from dhtorch.experiments.loading import images_between
from dhtorch.experiments.protocol import Protocol, Settings, SharedTracks, Variant
from dhtorch.pipeline.presets import PAPER, PAPER_DIRECT
from dhtorch.records import TrackHint
from dhtorch.stages.track_chain import track_chain

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def listening(seen):
    """A method whose tracker notes (image 0, image 1, the images between) of every call."""

    def note(image_0, image_1, uv_0, *, hint):
        number = lambda image: image[:, 0, 0, 0].int().tolist()  # noqa: E731
        seen.append((number(image_0), number(image_1), [number(image) for image in hint.between or ()]))
        return track(image_0, image_1, uv_0, hint=hint)

    return MAP.replace(track=note)


def run(seen, pairs, *, wanted=3, method=None, **settings):
    """The protocol with that method, beside one that uses up to ``wanted`` images."""
    chain = MAP.replace(track=partial(track_chain, track=track, between=wanted))
    variants = {"listening": Variant(method or listening(seen)), "chain": Variant(chain)}
    protocol.run([scene()], Protocol(variants), lambda _scene: pairs, Settings(**settings))
    return seen


def test_a_pair_has_the_images_between_that_a_tracker_uses():
    assert run([], [(0, 8), (5, 9)]) == [([0], [8], [[2], [4], [6]]), ([5], [9], [[6], [7], [8]])]
    assert run([], [(8, 0)]) == [([8], [0], [[6], [4], [2]])]
    assert run([], [(2, 4), (4, 5)]) == [([2], [4], [[3]]), ([4], [5], [])]


def test_settings_limit_them():
    assert run([], [(0, 8)], between=1) == [([0], [8], [[4]])]
    assert run([], [(0, 8)], between=0) == run([], [(0, 8)], wanted=0) == [([0], [8], [])]
    assert run([], [(0, 8)], between=7)[0][2] == [[k] for k in range(1, 8)]


def test_pairs_of_a_batch_have_their_own_images():
    assert run([], [(0, 4), (3, 7)], batch=2) == [([0, 3], [4, 7], [[1, 4], [2, 5], [3, 6]])]
    uneven = run([], [(0, 3), (3, 7)], batch=2)
    assert [call[0] for call in uneven] == [[0], [3]], "pairs with other numbers of images are not joined"
    assert run([], [(0, 3), (3, 7)], batch=2, between=2)[0][0] == [0, 3]


def test_candidates_and_several_views_have_none():
    assert all(not call[2] for call in run([], by_choice(scene(), steps=(1, 2), stride=4), wanted=3))
    seen = []
    assert all(not call[2] for call in run(seen, [(0, 8)], method=listening(seen).replace(views=2)))
    assert len(seen) == 2
    with torch.no_grad():
        seen.clear()
        listening(seen)(frame(0), [frame(3), frame(6)], views=2, hint=TrackHint(between=(frame(1).image,)))
    assert all(not call[2] for call in seen)


def test_a_rig_has_none():
    rig = join_cameras([scene(name).recording for name in ("left", "right")])
    assert images_between(Pair(0, 9), rig, 4) == [] and images_between(Pair(0, 9), scene().recording, 4) != []


def test_shared_tracks_tell_images_between_apart():
    calls = []

    def count(*args, hint):
        calls.append(hint.between)
        return track(*args, hint=hint)

    shared = SharedTracks().shared_tracker(count)
    uv, images = torch.zeros(1, 4, 2), [frame(k).image for k in range(4)]
    for between in ((images[1],), (images[2],), None, (images[1], images[2]), (images[1].clone(),)):
        shared(images[0], images[3], uv, hint=TrackHint(between=between))
    assert len(calls) == 4, "the last has the images of the first"


def test_the_paper_method_goes_through_them_and_its_direct_form_does_not():
    recording = room(hw=(120, 160), n_frames=5)
    between = tuple(recording[k].image for k in (1, 2, 3))
    direct, chain = (
        method(recording[0], recording[4], n=256, hint=TrackHint(between=between)) for method in (PAPER_DIRECT, PAPER)
    )
    plain, pair = (method(recording[0], recording[4], n=256) for method in (PAPER_DIRECT, PAPER))
    same = lambda a, b: torch.equal(a.depth.nan_to_num(), b.depth.nan_to_num())  # noqa: E731
    assert same(direct, plain) and same(pair, plain) and not same(chain, plain)
