"""Comparisons of methods with each other, with OpenCV and with networks."""
