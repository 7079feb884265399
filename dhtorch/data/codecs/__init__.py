"""File formats without a meaning of their own: what a container holds, never what a data set says with it."""
