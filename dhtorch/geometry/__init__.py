"""Geometry: value types beside their functions. Knows no phones, no data sets and no paper."""
