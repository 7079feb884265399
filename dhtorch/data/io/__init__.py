"""data/io."""
