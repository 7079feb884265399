"""Scenes, samples, captures, stubs and reference implementations that several test modules use."""
