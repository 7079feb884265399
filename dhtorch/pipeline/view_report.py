"""Report of view selection: the source views that a method selected for a reference view, and their gain."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_selection import select_views_by_preview

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewReport:
    """The source views of one reference view, as positions in the recording, and the gain of each."""

    reference: int
    views: tuple[int, ...]  # ascending; tracks and pose in a trace are those of the last
    n_offered: int
    gain: tuple[float, ...] | None = None  # of each over those selected before it; None = not computed
    n_no_answer: int = 0  # candidates without any answer: no pose or no baseline

    def row(self) -> dict[str, Any]:
        """Columns of a result's row."""
        gain = None if self.gain is None else [float(f"{w:.4g}") for w in self.gain]
        columns = {"n_offered": self.n_offered, "gain": gain, "n_no_answer": self.n_no_answer}
        return {"views": list(self.views), "why": columns}

    def __str__(self) -> str:
        views = ", ".join(map(str, self.views))
        line = f"frame {self.reference}: view{'s' * (len(self.views) > 1)} {views}"
        if len(self.views) == self.n_offered:
            return f"{line}, all that were offered"
        line += f", chosen of {self.n_offered}"
        if self.gain is None:
            return line
        gain = f"gain {', '.join(f'{w:.3g}' for w in self.gain)}"
        no_answer = f"; {self.n_no_answer} had no baseline or no pose" if self.n_no_answer else ""
        return f"{line} ({gain}{no_answer})"


def with_view_selection(method: Method) -> Method:
    """The method with a ``select_views`` stage, for more candidate views than it uses.

    A method without one (``paper``, ``map``, ``window``) selects by previews, and without ``chain``: selected views lie
    on both sides of the reference view, so that tracks are not extrapolated from one to the next.
    """
    return (
        method if method.select_views is not None else method.replace(select_views=select_views_by_preview, chain=False)
    )


def report_selection(reference: int, offered: Sequence[int], trace: Mapping[str, Any], b: int = 0) -> ViewReport:
    """The view selection of one reference view, from the trace of the method's call; logged at level DEBUG.

    Args:
        reference: its position in the recording.
        offered: positions of the candidate frames, in the order in which the method got them.
        trace: of the call; it has no ``choice`` for a single candidate, which is a pair.
        b: index of the reference view in the batch.
    """
    choice = trace.get("choice")
    if choice is None:
        report = ViewReport(reference, tuple(offered), len(offered))
    else:
        views = tuple(offered[k] for k in choice.index[:, b].tolist())
        gain = None if choice.gain is None else tuple(choice.gain[:, b].tolist())
        report = ViewReport(
            reference, views, len(offered), gain, 0 if choice.no_answer is None else int(choice.no_answer[:, b].sum())
        )
    _LOG.debug("%s", report)
    return report
