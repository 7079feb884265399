"""Why pixels have no answer, in words for a person: what a gate's code means, and what would help."""

from dhtorch.codes import Gate, describe, words

#: Reasons that are no gates -> what they mean.
_OTHER_MEANINGS = {"unfit": "farther than the file format can store", "no_other_view": "there was no other view"}


def describe_gate(name: str) -> str:
    """What a reason means; ``name`` is a gate's, as code tables or files write it, or one that is no gate's."""
    entry = describe(Gate, name)
    return _OTHER_MEANINGS.get(name.lower(), words(name.upper())) if entry is None else entry.meaning


def suggest_remedy(name: str) -> str | None:
    """What a reason means and what would help; None where nothing would."""
    entry = describe(Gate, name)
    return f"{entry.meaning}; {entry.advice}" if entry is not None and entry.advice else None
