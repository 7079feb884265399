"""Main job: methods on every pair of every scene, evaluated on the returns that were held back.

It has no question (question, expectation and verdict are null), unlike the other experiments.
"""

from collections.abc import Mapping, Sequence

from dhtorch.data.scene import SceneLike
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
    run_protocol,
)


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = no_progress,
) -> Outcome:
    """Run every method on every pair of every recording, for every truth test of ``settings``.

    Args and errors: as :func:`dhtorch.experiments.protocol.run`; ``methods`` is name → method.
    """
    variants = {name: Variant(method) for name, method in methods.items()}
    return run_protocol(scenes, Protocol(variants), pairs, settings, progress=progress)
