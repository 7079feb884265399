"""Settings name functions and repeat their options: every key exists, every option is listed, defaults are equal."""

import functools
import importlib
import inspect
import math
import runpy
from pathlib import Path

import hydra
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dhtorch.cli import option_checks as words
from dhtorch.cli.run import config_dir
from dhtorch.data import FORMATS
from dhtorch.data.corrections import Corrections
from dhtorch.data.pairs import by_choice, by_gap, by_time
from dhtorch.synthetic import SyntheticRoom

CONF = config_dir()
REPO = Path(__file__).parents[1]
#: Options that a caller passes at run time, never a setting.
AT_RUN_TIME = {
    "n",
    "seed",
    "fit",
    "trace",
    "device",
    "dtype",
    "hint",
    "linear",
    "format",
    "progress",
    "example",
    "settings",
}
GROUPS = {
    g: sorted(p.stem for p in (CONF / g).glob("*.yaml")) for g in ("method", "data", "pairs", "holdout", "experiment")
}


@functools.cache
def compose(*overrides):
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose("run", list(overrides))


def target(name):
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def nodes(cfg, path=""):
    """(path, node) of everything with a _target_."""
    if isinstance(cfg, dict):
        if "_target_" in cfg:
            yield path, cfg
        for key, value in cfg.items():
            yield from nodes(value, f"{path}.{key}")


def options(fn):
    signature = inspect.signature(fn.__init__ if inspect.isclass(fn) else fn)
    return {
        k: p
        for k, p in signature.parameters.items()
        if k != "self" and p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)
    }


def same(a, b):
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b or (isinstance(a, float) and isinstance(b, int | float) and math.isclose(a, b))


CHOICES = [f"{g}={name}" for g, names in GROUPS.items() for name in names]


@pytest.mark.parametrize("choice", CHOICES)
def test_every_setting_composes_and_names_real_options(choice):
    cfg = compose(choice)
    group = choice.split("=")[0]
    part = OmegaConf.to_container(cfg[group], resolve=True)
    for path, node in nodes(part):
        known = options(target(node["_target_"]))
        if node.get("format", "auto") != "auto":  # open_all hands further options to the reader of that name
            known |= options(FORMATS[node["format"]].read)
        elif "format" in node:  # or of the one that recognises the files, which may lack a camera
            known |= dict.fromkeys(("intrinsics", "K", "fov"))
        if node["_target_"].endswith(".open_capture"):  # and corrections, which every format has
            known |= dict.fromkeys(Corrections.names())
        if node["_target_"].endswith(".open_room"):  # hands further options to the room
            known |= options(SyntheticRoom)
        keys = {k for k in node if not k.startswith("_")}
        assert keys <= set(known), f"{choice}{path}: {keys - set(known)} are no options of {node['_target_']}"


@pytest.mark.parametrize("choice", CHOICES)
def test_every_setting_that_ships_is_one_that_the_command_takes(choice):
    plain = OmegaConf.to_container(compose(choice), resolve=False)
    group = choice.partition("=")[0]
    words.validate_values(plain[group], plain[group], f"{group}.")


@pytest.mark.parametrize("choice", [c for c in CHOICES if c.startswith(("method=", "pairs=", "data=synthetic"))])
def test_settings_list_every_option(choice):
    cfg = compose(choice)
    group = choice.split("=")[0]
    for path, node in nodes(OmegaConf.to_container(cfg[group], resolve=True)):
        fn = target(node["_target_"])
        wanted = {k for k, p in options(fn).items() if p.default is not p.empty} - AT_RUN_TIME
        assert wanted <= set(node), f"{choice}{path}: {wanted - set(node)} of {node['_target_']} are not listed"


@pytest.mark.parametrize("choice", ["method=paper", "method=opencv", "data=synthetic", "pairs=gap", "pairs=auto"])
def test_values_equal_the_signatures_defaults(choice):
    cfg = compose(choice)
    group = choice.split("=")[0]
    for path, node in nodes(OmegaConf.to_container(cfg[group], resolve=True)):
        for key, parameter in options(target(node["_target_"])).items():
            value = node.get(key)
            if key in node and not isinstance(value, dict) and parameter.default is not parameter.empty:
                assert same(value, parameter.default), f"{choice}{path}.{key}: {value} against {parameter.default}"


def test_the_files_of_the_methods_are_those_of_their_records():
    """``make conf`` writes them, for Hydra to know every option without asking a function."""
    writer = runpy.run_path(str(REPO / "docs/settings.py"))
    assert set(writer["WRITTEN"]) == set(GROUPS["method"])
    for name, method in writer["WRITTEN"].items():
        composed = instantiate(compose(f"method={name}").method, _convert_="all")
        for each in (method, composed):
            assert (CONF / "method" / f"{name}.yaml").read_text() == writer["document"](name, each), "run: make conf"


def test_experiments_keep_the_gap_of_a_scene_and_the_main_job_chooses():
    """Their questions and their archived numbers are about pairs of two frames; another word says otherwise."""
    chosen = {name: target(compose(f"experiment={name}").pairs._target_) for name in GROUPS["experiment"]}
    assert chosen.pop("pair") is by_choice and set(chosen.values()) == {by_gap}
    assert target(compose("experiment=heldout", "pairs=time").pairs._target_) is by_time
