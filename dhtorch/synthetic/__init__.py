"""The built-in world: rooms whose every point is known, a phone and a robot in them, and what goes wrong."""

from dhtorch.synthetic.recording import SyntheticRoom, open_room

__all__ = ["SyntheticRoom", "open_room"]
