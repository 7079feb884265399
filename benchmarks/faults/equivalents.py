"""Changes that the rules of ``mutants.py --sweep`` draw and that change no answer, with the reason."""

#: (module, function, text, text that takes its place) → reason.
EQUIVALENT: dict[tuple[str, str, str, str], str] = {}
