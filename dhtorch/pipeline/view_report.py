"""A method that is offered the frames around a reference view: how it is asked, which it chose, and why these."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_selection import select_views_by_preview

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewReport:
    """The frames of one reference view that were asked, as positions in the recording, and what spoke for them."""

    reference: int
    views: tuple[int, ...]  # rising; tracks and pose in a trace are those of the last
    n_offered: int
    gain: tuple[float, ...] | None = None  # what each added to those chosen before it; None = nobody said
    n_no_answer: int = 0  # offered frames that answered nothing: no pose or no baseline

    def row(self) -> dict[str, Any]:
        """Columns of a result's row."""
        gain = None if self.gain is None else [float(f"{w:.4g}") for w in self.gain]
        why = {"n_offered": self.n_offered, "gain": gain, "n_no_answer": self.n_no_answer}
        return {"views": list(self.views), "why": why}

    def __str__(self) -> str:
        names = ", ".join(map(str, self.views))
        said = f"frame {self.reference}: view{'s' * (len(self.views) > 1)} {names}"
        if len(self.views) == self.n_offered:
            return f"{said}, all that were offered"
        said += f", chosen of {self.n_offered}"
        if self.gain is None:
            return said
        gain = f"gain {', '.join(f'{w:.3g}' for w in self.gain)}"
        no_answer = f"; {self.n_no_answer} had no baseline or no pose" if self.n_no_answer else ""
        return f"{said} ({gain}{no_answer})"


def with_view_selection(method: Method) -> Method:
    """The method as it is asked with more frames than it looks at.

    One that does not choose for itself (``paper``, ``map``, ``window``) chooses by probes; and as the chosen views lie
    on both sides of the reference view, none says where the search in the next begins.
    """
    return (
        method if method.select_views is not None else method.replace(select_views=select_views_by_preview, chain=False)
    )


def report_selection(reference: int, offered: Sequence[int], trace: Mapping[str, Any], b: int = 0) -> ViewReport:
    """What became of the frames offered for one reference view; said in the log at level DEBUG.

    Args:
        reference: its position in the recording.
        offered: positions of the frames that the method was given, in that order.
        trace: of the call; a single frame is asked as a pair, and chosen without a choice.
        b: place of the reference view in the batch.
    """
    choice = trace.get("choice")
    if choice is None:
        found = ViewReport(reference, tuple(offered), len(offered))
    else:
        views = tuple(offered[k] for k in choice.index[:, b].tolist())
        gain = None if choice.gain is None else tuple(choice.gain[:, b].tolist())
        found = ViewReport(
            reference, views, len(offered), gain, 0 if choice.no_answer is None else int(choice.no_answer[:, b].sum())
        )
    _LOG.debug("%s", found)
    return found
