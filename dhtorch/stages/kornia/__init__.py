"""The paper's method on kornia and torch: the stages of :data:`dhtorch.pipeline.presets.KORNIA`.

One file a stage: ``backproject`` (2), ``holes`` (3), ``track`` (4), ``pose`` (5), ``triangulate`` (6); samples (1) and
score (7) contain no geometry and are ``PAPER``'s, as are records, options, codes, gates. kornia lacks P3P and an exact
undistortion, which are dhtorch's. Choices (pixels, inliers, gates) carry no gradient, values do. A pair's answers
depend on its batch within rounding. ``torch.func`` and ``torch.compile`` cannot trace stages 4 and 5.
"""
