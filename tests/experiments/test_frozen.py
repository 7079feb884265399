"""Earlier releases are written out: no default of a stage can change them, and today's ``map`` and ``window`` answer as the first did."""

import inspect
import math
from dataclasses import fields
from functools import partial

import pytest
import torch

from dhtorch.experiments.baselines.frozen import AUTO_2, MAP_1, WINDOW_1
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import MAP, WINDOW
from dhtorch.synthetic import SyntheticRoom

#: Said by the caller at run time.
AT_RUN_TIME = {"hint", "device", "dtype", "linear", "fit"}


def left_open(stage, path):
    """Options of a function, and of the functions among them, that would follow a default."""
    function, given = (stage.func, stage.keywords) if isinstance(stage, partial) else (stage, {})
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is not parameter.KEYWORD_ONLY or name in AT_RUN_TIME:
            continue
        if name not in given:
            yield f"{path}.{name}"
        elif callable(given[name]):
            yield from left_open(given[name], f"{path}.{name}")


@pytest.mark.parametrize("method", [MAP_1, WINDOW_1, AUTO_2])
def test_every_option_is_written_out(method):
    stages = {f.name: getattr(method, f.name) for f in fields(Method) if callable(getattr(method, f.name))}
    assert len(stages) >= 8
    assert not [name for stage, f in stages.items() for name in left_open(f, stage)]


def test_an_option_that_follows_a_default_would_be_seen():
    assert [*left_open(partial(MAP_1.track.func, levels=5), "track")]


@pytest.mark.parametrize(
    ("first", "today", "views"), [(MAP_1, MAP, 1), pytest.param(WINDOW_1, WINDOW, 3, marks=pytest.mark.slow)]
)
def test_today_s_method_of_that_name_answers_bit_for_bit_as_it_did(first, today, views):
    room = SyntheticRoom(n_frames=7, hw=(240, 320))
    others = [room[2 * k + 2] for k in range(views)]
    a, b = (m(room[0], others if views > 1 else others[0], n=512) for m in (first, today))
    assert int(a.keep.sum()) > 20
    for field in ("depth", "sigma", "score", "gate"):
        assert torch.equal(getattr(a, field).nan_to_num(-math.pi), getattr(b, field).nan_to_num(-math.pi)), field
