"""A method is a record: any function with a stage's signature can be that stage, wherever a method is used."""

import pickle
from dataclasses import fields
from functools import partial

import pytest
import torch
from support.rooms import room as rendered

import dhtorch
from dhtorch import AUTO, KORNIA, MAP, PAPER, TrackHint, pytree
from dhtorch.cli.option_checks import list_choices
from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.experiments import pair as pairs
from dhtorch.experiments import protocol
from dhtorch.experiments.baselines.opencv import OPENCV
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import GONE_METHODS, get_method
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.holes import classify
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import confidence
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.triangulate import two_view

N = 512


def sample(hw, n, *, device=None, dtype=torch.float32):
    """Stage 1, and so on: plain functions with nothing but what the stage is called with."""
    return spiral(hw, n, device=device, dtype=dtype)


def look(frame, uv):
    return backproject(frame, uv)


def sort(frame, samples):
    return classify(frame, samples)


def track(image_0, image_1, uv_0, *, hint):
    return lucas_kanade(image_0, image_1, uv_0, hint=hint)


def pose(samples, tracks, camera_0, camera_1, draws):
    return pnp_ransac(samples, tracks, camera_0, camera_1, draws)


def triangulate(samples, tracks, fit, camera_0, camera_1):
    return two_view(samples, tracks, fit, camera_0, camera_1)


def score(estimate, samples, tracks, fit):
    return confidence(estimate, samples, tracks, fit)


def fuse(estimates):
    return inverse_variance(estimates)


STAGES = {"sample": sample, "backproject": look, "classify": sort, "track": track, "pose": pose}
STAGES |= {"triangulate": triangulate, "score": score, "fuse": fuse}
PLAIN, USUAL = PAPER.replace(**STAGES, n=N), PAPER.replace(n=N)


@pytest.fixture(scope="module")
def room():
    return rendered(hw=(192, 256), n_frames=7)


def alike(a, b):
    return all(
        torch.equal(getattr(a, f).nan_to_num(), getattr(b, f).nan_to_num()) for f in ("uv", "depth", "gate", "score")
    )


@pytest.mark.slow
def test_a_plain_function_in_every_stage_answers_as_the_stage_itself(room):
    assert alike(PLAIN(room[0], room[3]), USUAL(room[0], room[3]))
    others = pytree.stack([room[k] for k in (1, 2, 3)])
    assert alike(PLAIN(room[0], others, views=3), USUAL(room[0], others, views=3))
    assert alike(PLAIN(room[0], [room[k] for k in (1, 2, 3)], views=2), USUAL(room[0], others, views=2))


@pytest.mark.parametrize("views", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_it_runs_in_the_protocol_with_the_levels_of_the_scene(room, views):
    scene = Scene(room, near=2.0, levels=2)
    # A score of one's own may be made of sigma, so that sigma is evaluated: not so with the paper's function itself.
    methods = {"plain": PLAIN.replace(views=views), "usual": USUAL.replace(views=views, score=score)}
    outcome = pairs.run([scene], methods, partial(by_gap, gap=3), protocol.Settings(between=0))
    plain, usual = (
        {k: v for k, v in outcome.scenes(m)["synthetic_room"].items() if k not in ("ms", "method")} for m in methods
    )
    assert plain == usual and plain["n_kept"] > 20
    direct = PLAIN(protocol.holdout.range_split(room[0], 2.0), room[3], hint=TrackHint(levels=2))
    other = PLAIN(protocol.holdout.range_split(room[0], 2.0), room[3])
    assert not alike(direct, other), "two levels of a pyramid see less far than four"


def test_a_method_is_a_frozen_record_that_travels():
    assert isinstance(PAPER, Method) and dhtorch.extend is PAPER and MAP.views == 1
    with pytest.raises(AttributeError):
        PAPER.n = 3
    several = MAP.replace(views=5)
    assert all(getattr(several, f.name) is getattr(MAP, f.name) for f in fields(Method) if f.name != "views")
    with pytest.raises(ImportError, match=r"use dhtorch\.MAP\.replace\(views=5\)"):
        dhtorch.WINDOW  # noqa: B018
    again = pickle.loads(pickle.dumps(MAP))
    assert again.track.keywords == MAP.track.keywords and again.pose is MAP.pose


def test_replace_changes_a_stage_or_its_options_and_nothing_else():
    changed = MAP.replace(n=64, track={"levels": 6}, score=len)
    assert (changed.n, changed.score) == (64, len) and changed.track.keywords == {"levels": 6}
    kept = [f.name for f in fields(Method) if f.name not in ("n", "track", "score")]
    assert all(getattr(changed, k) is getattr(MAP, k) for k in kept) and MAP.track.keywords == {"levels": 5}
    for wrong in ({"trak": len}, {"seed": 1}):
        with pytest.raises(TypeError, match=f"found {next(iter(wrong))}, expected stages and options among sample, "):
            PAPER.replace(**wrong)


def test_a_hint_is_cut_with_its_pairs_and_may_be_ignored(room):
    seen = []

    def blind(image_0, image_1, uv_0, *, hint):
        seen.append(hint)
        return lucas_kanade(image_0, image_1, uv_0)

    many = [pytree.collate([room[k]] * 10) for k in (0, 3)]
    start = torch.arange(10.0).view(10, 1, 1).expand(10, N, 2)
    found = PAPER(*many, n=N, track=blind, hint=TrackHint(start, levels=3))
    assert [len(h.start) for h in seen] == [8, 2] and torch.equal(seen[1].start, start[8:])
    assert all(h.levels == 3 for h in seen) and alike(found[9:], USUAL(room[0], room[3]))


def test_several_views_must_be_some(room):
    with pytest.raises(ValueError, match="found no other view"):
        PAPER(room[0], [])


@pytest.mark.parametrize("name", GONE_METHODS)
def test_a_method_that_is_gone_is_named_with_its_replacement(name):
    for call in (partial(get_method, name), partial(list_choices, [f"method={name}"], config_dir())):
        with pytest.raises(ValueError, match=rf"method {name} is gone .*, use (MAP|AUTO|PAPER)\.replace"):
            call()


def test_a_method_states_a_sigma_with_a_score_made_of_it_or_with_fitted_noise():
    """The paper's score orders answers; OpenCV's and kornia's stages change nothing about that."""
    silent = (PAPER, KORNIA, OPENCV, PAPER.replace(n=512, score={"half_parallax_deg": 1.0}))
    assert not any(each.states_sigma for each in silent)
    parts = (PAPER.replace(score=MAP.score), MAP.replace(score=PAPER.score), PAPER.replace(score=lambda e, *_: e))
    assert all(each.states_sigma for each in (MAP, AUTO, *parts))
    assert not MAP.replace(score=PAPER.score, triangulate={"fitted_noise": False}).states_sigma
