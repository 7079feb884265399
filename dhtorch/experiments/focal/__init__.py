"""Depth from focus and from defocus of a single view: readers of focal stacks, methods and experiments."""
