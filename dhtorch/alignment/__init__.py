"""Alignment of depth maps to metric references."""

from dhtorch.alignment.align import ALIGNMENT_KINDS, align_depth
from dhtorch.alignment.options import AlignmentOptions
from dhtorch.alignment.references import MetricReferences, collect_references

__all__ = ["ALIGNMENT_KINDS", "AlignmentOptions", "MetricReferences", "align_depth", "collect_references"]
