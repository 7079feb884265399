"""Metrics from estimates and ground truth: no files, no method."""

from dhtorch.metrics import bootstrap, control, correlation, curves, detection, errors, holdout, reliability, risk

__all__ = ["bootstrap", "control", "correlation", "curves", "detection", "errors", "holdout", "reliability", "risk"]
