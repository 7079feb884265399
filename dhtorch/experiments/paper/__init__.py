"""The protocols and tables of the paper."""
