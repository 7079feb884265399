"""Pictures of the built-in rooms are rendered anew in the tests of the renderer."""

import pytest
from support import computed_once


@pytest.fixture(autouse=True)
def rendered_anew(monkeypatch):
    """The renderer itself, not what it returned before."""
    computed_once.render_anew(monkeypatch)
