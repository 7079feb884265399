"""Numbers from estimates and truth: no files, no method."""
