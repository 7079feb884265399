"""Synthetic data with exact ground truth: a furnished room, phone and robot recordings, depth faults and stresses."""

from dhtorch.synthetic.recording import SyntheticRoom, open_room

__all__ = ["SyntheticRoom", "open_room"]
