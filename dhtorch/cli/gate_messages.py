"""Why pixels are silent, in words for a person: what a gate's code means, and what would help."""

from __future__ import annotations

from dhtorch.codes import Gate, names, words

#: Reason of silence → what it means and what would help; of others nothing would.
_MEANING_AND_REMEDY = {
    Gate.NO_BASELINE: (
        "the camera only turned or stood still",
        "moving it sideways by a tenth of the distance would help",
    ),
    Gate.NO_POSE: ("too few returns could be tracked", "slower motion, more light and texture would help"),
    Gate.NO_TRACK: (
        "what has no return could not be found in other views",
        "texture and a view from the side would help",
    ),
    Gate.UNCERTAIN: ("the views lie too close together for what is far", "moving sideways would help"),
    Gate.POSE_REFUTED: ("the poses given contradict the near returns", "see their axes, direction and unit"),
    Gate.CONTRADICTED: ("what the sensor sees moves, or contradicts the pictures", "a still scene would help"),
}

#: Reason of silence that no help belongs to → what it means.
_MEANINGS = {
    Gate.NO_TEXTURE: "blank surfaces, on which nothing can be followed",
    Gate.BEHIND: "what would lie behind a camera",
    Gate.PARALLAX: "seen from nearly the same direction in all views",
    Gate.RESIDUAL: "the views do not meet in one point",
    Gate.INCONSISTENT: "the views do not agree",
    Gate.LOW_SCORE: "answers that are not sure enough",
}

#: What no gate says → what it means.
_OTHER_MEANINGS = {"unfit": "farther than the files can say", "no_other_view": "there was no other view"}

_GATE_CODES = {name.lower(): code for code, name in names(Gate).items()}


def describe_gate(name: str) -> str:
    """What a reason means; ``name`` is a gate's, as code tables or files write it, or of what no gate says."""
    code = _GATE_CODES.get(name.lower())
    if code is None:
        return _OTHER_MEANINGS.get(name.lower(), words(name.upper()))
    return _MEANING_AND_REMEDY[code][0] if code in _MEANING_AND_REMEDY else _MEANINGS.get(code, words(name.upper()))


def suggest_remedy(name: str) -> str | None:
    """What a reason means and what would help; None where nothing would."""
    code = _GATE_CODES.get(name.lower())
    return "; ".join(_MEANING_AND_REMEDY[code]) if code in _MEANING_AND_REMEDY else None
