"""Scenes, samples, stubs and reference implementations that several tests use."""
