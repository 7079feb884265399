"""Fixtures of the tests of compiled operators."""

import shutil

import pytest

from dhtorch.ops import builder, loader


@pytest.fixture(autouse=True)
def unused(monkeypatch, tmp_path):
    """Every test begins and ends without compiled code, and with none installed."""
    monkeypatch.setenv("DHTORCH_OPS", "0")
    monkeypatch.setattr(loader, "_loaded", [])
    monkeypatch.setattr(loader, "_tried", [])
    monkeypatch.setattr(loader, "INSTALLED", tmp_path / "installed")


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """A folder with the compiled file; one of a process, in which operations are registered once. The library of the
    user's cache, named after the sources, is linked where it is sound, so that other tests of the process may load it
    too, and compiled otherwise."""
    if not any(map(shutil.which, ("c++", "g++", "clang++"))):
        pytest.skip("no C++ compiler here")
    folder = tmp_path_factory.mktemp("cache")
    built = loader.library().resolve()
    if built.is_file() and loader.problem(built) is None:
        for path in (built, loader.manifest(built)):
            (folder / path.name).symlink_to(path)
        return folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DHTORCH_CACHE", str(folder))
        builder.build()
    return folder


@pytest.fixture
def loaded(cache, monkeypatch):
    """The library is in use."""
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    loader.load()
