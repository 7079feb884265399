"""A method that is offered the frames around an anchor: how it is asked, which it chose, and why these."""

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
    """The frames of one anchor that were asked, as positions in the recording, and what spoke for them."""

    anchor: int
    views: tuple[int, ...]  # rising; tracks and pose in a trace are those of the last
    n_offered: int
    worth: tuple[float, ...] | None = None  # what each added to those chosen before it; None = nobody said
    n_mute: int = 0  # offered frames that answered nothing: no pose or no baseline

    def row(self) -> dict[str, Any]:
        """Columns of a result's row."""
        worth = None if self.worth is None else [float(f"{w:.4g}") for w in self.worth]
        why = {"n_offered": self.n_offered, "worth": worth, "n_mute": self.n_mute}
        return {"views": list(self.views), "why": why}

    def __str__(self) -> str:
        names = ", ".join(map(str, self.views))
        said = f"frame {self.anchor}: view{'s' * (len(self.views) > 1)} {names}"
        if len(self.views) == self.n_offered:
            return f"{said}, all that were offered"
        said += f", chosen of {self.n_offered}"
        if self.worth is None:
            return said
        worth = f"worth {', '.join(f'{w:.3g}' for w in self.worth)}"
        mute = f"; {self.n_mute} had no baseline or no pose" if self.n_mute else ""
        return f"{said} ({worth}{mute})"


def with_view_selection(method: Method) -> Method:
    """The method as it is asked with more frames than it looks at.

    One that does not choose for itself (``paper``, ``map``, ``window``) chooses by probes; and as the chosen views lie
    on both sides of the anchor, none says where the search in the next begins.
    """
    return method if method.choose is not None else method.replace(choose=select_views_by_preview, chain=False)


def report_selection(anchor: int, offered: Sequence[int], trace: Mapping[str, Any], b: int = 0) -> ViewReport:
    """What became of the frames offered for one anchor; said in the log at level DEBUG.

    Args:
        anchor: its position in the recording.
        offered: positions of the frames that the method was given, in that order.
        trace: of the call; a single frame is asked as a pair, and chosen without a choice.
        b: place of the anchor in the batch.
    """
    choice = trace.get("choice")
    if choice is None:
        found = ViewReport(anchor, tuple(offered), len(offered))
    else:
        views = tuple(offered[k] for k in choice.index[:, b].tolist())
        worth = None if choice.worth is None else tuple(choice.worth[:, b].tolist())
        found = ViewReport(
            anchor, views, len(offered), worth, 0 if choice.mute is None else int(choice.mute[:, b].sum())
        )
    _LOG.debug("%s", found)
    return found
