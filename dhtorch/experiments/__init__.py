"""One question per file; each ``run(...)`` returns rows, a summary and a verdict."""
