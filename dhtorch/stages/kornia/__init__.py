"""The paper's method written on kornia and torch alone: the stages of :data:`dhtorch.pipeline.presets.KORNIA`.

One file a stage: ``backproject`` (2), ``holes`` (3), ``track`` (4), ``pose`` (5), ``triangulate`` (6). Stages 1 (sample
pixels) and 7 (score) contain no geometry and are those of ``PAPER``, whose records, options, codes and gates are used.
Choices (pixels, inliers, gates) carry no gradient, all values do. The answers of a pair do not depend on the other
pairs of its batch beyond rounding. ``torch.func`` and ``torch.compile`` cannot trace stages 4 and 5, which
differentiate inside.
"""
