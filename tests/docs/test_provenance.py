"""No constant or calibration was chosen on the scenes that the README's numbers are of."""

import re
from pathlib import Path

import dhtorch

ROOT = Path(dhtorch.__file__).parent


def test_no_constant_was_chosen_on_the_untouched_scenes():
    """README's numbers are of ``data=untouched``: whatever cites one of its scenes as an origin would be tuned to it."""
    scenes = re.compile(r"untouched|middlebury_2005|slambook|seeds? 100\d", re.I)
    cited = [
        f"{path.relative_to(ROOT)}: {comment}"
        for path in sorted(ROOT.rglob("*.py"))
        for comment in re.findall(r"Source:[^\n]*(?:\n\s*#:?[^\n]*)*", path.read_text(encoding="utf-8"))
        if scenes.search(comment.split("Source:")[1]) and "vision.middlebury.edu" not in comment
    ]
    files = [p for p in sorted(ROOT.rglob("*.json")) if p.parent.name != "cli"]  # there: what `dhtorch fetch` loads
    calibrations = [p.name for p in files if scenes.search(p.read_text(encoding="utf-8"))]
    assert files
    assert cited == [] and calibrations == []
