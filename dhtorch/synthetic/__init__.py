"""The built-in world: rooms whose every point is known, a phone and a robot in them, and what goes wrong."""

from dhtorch.synthetic.recording import SyntheticRoom

__all__ = ["SyntheticRoom"]
