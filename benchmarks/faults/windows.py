"""Reading of pictures; search and registration of windows."""

TESTS: dict[str, list[str]] = {
    "geometry.affine": ["tests/test_affine_by_hand.py", "tests/test_affine.py", "tests/test_contract.py"],
    "geometry.lucas_kanade": ["tests/test_lucas_kanade.py", "tests/test_track.py", "tests/test_contract.py"],
    "stages.track": ["tests/test_affine_by_hand.py", "tests/test_lucas_kanade.py", "tests/test_track.py", "tests/test_contract.py"],
    "geometry.lookup": ["tests/test_lookup.py", "tests/test_contract.py"],
    "geometry.pyramid": ["tests/test_pyramid.py", "tests/test_contract.py"],
    "geometry.filters": ["tests/test_filters.py", "tests/test_contract.py"],
    "geometry.thin_lens": ["tests/test_thin_lens.py", "tests/test_contract.py"],
    "geometry.cells": ["tests/test_cells.py", "tests/test_contract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
