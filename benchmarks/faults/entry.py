"""The transform inside a loader, whole data sets, result files."""

TESTS: dict[str, list[str]] = {
    "transform": ["tests/test_transform.py"],
    "transform.views": ["tests/test_transform.py"],
    "transform.leaves": ["tests/test_transform.py", "tests/test_transform_adapters.py"],
    "transform.adapters": ["tests/test_transform_adapters.py"],
    "transform.tokens": ["tests/test_transform.py"],
    "transform.problems": ["tests/test_transform.py"],
    "transform.extend_depth": ["tests/test_transform.py"],
    "archive": ["tests/test_archive.py", "tests/test_resume.py"],
    "extract": ["tests/test_extract.py"],
    "extract.columns": ["tests/test_extract.py"],
    "extract.engines": ["tests/test_extract.py"],
    "extract.features": ["tests/test_extract.py"],
    "extract.plan": ["tests/test_extract.py"],
    "extract.rows": ["tests/test_extract.py"],
    "extract.shards": ["tests/test_extract.py"],
}

FAULTS: dict[str, list[tuple[str, ...]]] = {}
