"""Baselines: stages of a method and dense depth by other libraries and networks."""
