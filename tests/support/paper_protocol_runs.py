"""For the paper's experiments: a configured method, a room of two pairs, outcomes of given rows, errors of probes."""

from functools import cache

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from dhtorch.cli.run import config_dir
from dhtorch.experiments.probes import probing
from dhtorch.experiments.protocol import Outcome
from support.rooms import room as rendered


@cache
def composed(name):
    """The configuration of a method with 1024 samples."""
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        return compose("run", [f"method={name}", "method.n=1024"]).method


def configured_method(name="paper"):
    """The method of this name with 1024 samples, built from ``conf``."""
    return instantiate(composed(name), _convert_="all")


def small_room(**options):
    """A synthetic room of 5 frames of 192 x 256 pixels: two pairs at a gap of 3."""
    return rendered(**{"hw": (192, 256), "n_frames": 5, **options})


def outcome_of_rows(*entries):
    """The outcome of an experiment with these rows: (scene, method, truth, measured values) each."""
    base = {"pair": None, "role": None}
    return Outcome(rows=[base | dict(zip(("scene", "method", "truth"), e[:3], strict=True)) | e[3] for e in entries])


def probe_errors(spread=0.0, groups=60, cohorts=("all", "moving"), **factors):
    """Errors of every arm as factors of a base that differs from group to group; ours scatter by ``spread``."""
    g = torch.Generator().manual_seed(1)
    base = 1 + torch.rand(groups, generator=g, dtype=torch.float64)
    scatter = 1 + spread * torch.randn(groups, generator=g, dtype=torch.float64)
    found = probing.ProbeErrors([str(k) for k in range(groups)])
    for cohort in cohorts:
        found.counts[cohort] = torch.ones(groups, dtype=torch.float64)
        found.squares |= {(arm, cohort): base * x * (scatter if arm == "dhtorch" else 1) for arm, x in factors.items()}
    return found
