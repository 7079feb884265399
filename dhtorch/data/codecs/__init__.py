"""Codecs of general file formats: container -> arrays, without any knowledge of data sets."""
