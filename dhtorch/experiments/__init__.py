"""The laboratory: one question per file; each ``run(...)`` returns rows, a summary and a verdict.

``protocol`` is the loop behind all of them, ``paper`` asks what the paper asks, ``compare`` holds methods against each
other, ``negative`` and ``focal`` keep what did not survive its test, ``probes`` asks what features are good for;
``baselines`` fill seats with other libraries and networks, ``report`` shows results.
"""
