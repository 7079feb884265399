"""Alignment of depth maps to metric references."""
