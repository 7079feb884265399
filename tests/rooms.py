"""Built-in rooms that several tests look at: each is rendered once in a process. Nobody changes them."""

from functools import cache

from dhtorch.synthetic.recording import SyntheticRoom


@cache
def room(**options) -> SyntheticRoom:
    """A room of these options; without antialiasing, which costs four times as much, where they do not ask for it."""
    return SyntheticRoom(**{"supersample": 1, **options})
