"""Compiled operators: torch functions with an optional C++ kernel, behind one dispatch."""
