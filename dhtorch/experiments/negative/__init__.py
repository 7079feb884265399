"""Estimators that did not survive their screening tests, each as good as its idea allows, kept runnable."""
