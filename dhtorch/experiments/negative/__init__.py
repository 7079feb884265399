"""Estimators that failed their screening experiments, and these experiments."""
