"""Experiments, one question per file; each ``run(...)`` returns rows, a summary and a verdict.

``protocol`` is the evaluation loop of all of them. ``paper`` has the experiments of the paper, ``compare`` comparisons
of methods, ``negative`` and ``focal`` ideas that were refuted, ``probes`` evaluations of features; ``baselines`` has
stages by other libraries and networks, ``report`` figures and tables of results.
"""
