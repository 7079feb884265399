"""Examples in docstrings run, and say what they say: those of what other packages do not have."""

import doctest
import importlib

import pytest

#: Functions that show themselves at work.
SHOWN = ("stages.track.lucas_kanade", "stages.pose.pnp_ransac", "stages.pose.map_pose", "geometry.p3p.p3p")


@pytest.mark.parametrize("name", SHOWN)
def test_an_example_runs_as_it_is_written(name):
    place, _, function = name.rpartition(".")
    fn = getattr(importlib.import_module(f"dhtorch.{place}"), function)
    (found,) = doctest.DocTestFinder(recurse=False).find(fn, name, globs={})
    runner, said = doctest.DocTestRunner(), []
    result = runner.run(found, out=said.append)
    assert result.attempted > 3 and result.failed == 0, "".join(said)
