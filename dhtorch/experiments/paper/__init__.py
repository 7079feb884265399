"""Experiments of the paper: its protocols and tables."""
