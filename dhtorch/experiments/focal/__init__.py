"""Depth from focus and defocus, from one view: what is known of it and what it is worth here."""
