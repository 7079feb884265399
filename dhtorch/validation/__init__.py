"""Validation of depth maps against near returns, triangulated points and source views."""
