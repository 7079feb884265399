"""Streaming estimation: depth of the newest frame of a sequence from past frames, with bounded memory.

push(frame) ─┬─ scene cut: past frames are dropped
             └─ past frames at a few steps ─ selection ─ method ─ Estimate of the newest
"""

from collections import deque
from collections.abc import Sequence

import torch
from torch.utils import _pytree as pytree

from dhtorch.codes import Gate
from dhtorch.data.pairs import CANDIDATE_STEPS
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO
from dhtorch.pipeline.spec import Trace
from dhtorch.records import NO_HINT, Estimate, Frame, TrackHint
from dhtorch.runtime.numerics import standard_numerics


class Stream:
    """A method applied to the newest frame of a sequence, with past frames as source views.

    An estimate depends only on the frames pushed since the last cut or :meth:`reset`: not on their timing, nor on the
    process that has the stream (it can be pickled, past frames included).

    Args:
        method: of one other view or several; it selects among past frames (``method.select_views``, else by samples).
        steps: how many frames back the other views may lie.
        seed: of the pose search, the same for every frame.
        hint: prior knowledge of the motion, for the tracker.

    Memory: the last ``max(steps)`` frames as they were pushed; :attr:`nbytes` is their present size.
    """

    def __init__(
        self,
        method: Method = AUTO,
        *,
        steps: Sequence[int] = CANDIDATE_STEPS,
        seed: int = 0,
        hint: TrackHint = NO_HINT,
    ) -> None:
        if not steps or min(steps) < 1:
            raise ValueError(f"stream: steps is {tuple(steps)}, expected whole numbers of at least 1")
        self.method, self.steps, self.seed, self.hint = method, tuple(sorted(set(steps))), seed, hint
        self.past: deque[Frame] = deque(maxlen=self.steps[-1])
        self.pushed = 0  # frames since the stream was made
        self.cuts: list[int] = []  # numbers of the frames after a cut; the first frame is not among them

    @property
    def nbytes(self) -> int:
        """Bytes of the past frames."""
        return sum(x.nbytes for x in pytree.tree_leaves(list(self.past)))

    def reset(self) -> None:
        """Drop all past frames: the next frame has no source view."""
        self.past.clear()

    @standard_numerics
    def push(self, frame: Frame, *, trace: Trace | None = None) -> Estimate:
        """Depth at the samples of ``frame`` (B = 1), triangulated from past frames.

        The first frame, and the first after a cut, has no source view and is unanswered (gate NO_BASELINE). A cut is
        an image with hardly any correspondence to the one before (:func:`is_scene_cut`); past frames are then dropped
        and the frame's number is appended to :attr:`cuts`.

        Args:
            frame: one view, on the device of those before it.
            trace: as :class:`dhtorch.pipeline.method.Method`; ``back`` (views, 1) is the number of frames from each
                selected view to ``frame``.

        Raises:
            ValueError: more than one view in the frame; else as the method.

        Gradient: none; past frames carry no graph.
        """
        if frame.image.shape[0] != 1:
            raise ValueError(f"stream: found {frame.image.shape[0]} views in one frame, expected 1")
        with torch.no_grad():
            frame = frame.detach()
            if self.past and is_scene_cut(self.past[-1], frame):
                self.cuts.append(self.pushed)
                self.reset()
            steps = [s for s in self.steps if s <= len(self.past)]
            others = [self.past[-s] for s in reversed(steps)]  # in the order of capture
            if others:
                views = others if len(others) > 1 else others[0]
                estimate = self.method(frame, views, seed=self.seed, hint=self.hint, trace=trace)
                if trace is not None and "choice" in trace:
                    index = trace["choice"].index
                    trace["back"] = torch.tensor(list(reversed(steps)), device=index.device)[index]
            else:
                estimate = Estimate.unanswered(self.method.sample_depth(frame), Gate.NO_BASELINE, n_views=1)
            self.past.append(frame)
            self.pushed += 1
        return estimate


def is_scene_cut(before: Frame, after: Frame) -> bool:
    """Whether two frames have hardly any correspondence, by the support of their coarse flow; False for flat images."""
    # Flatter images show no cut.
    sparse = [frame.image[..., ::4, ::4] for frame in (before, after)]
    if min(float((x / 255 if x.dtype == torch.uint8 else x.float()).std()) for x in sparse) < 0.02:
        return False
    # Consecutive real frames reach 0.65 and more, images of different rooms 0.07 to 0.33 (``data=shared_scenes``);
    # built-in rooms of different seeds, which share their layout, 0.37 to 0.43: such a cut is not detected.
    return float(coarse_flow(before.image, after.image).support.mean()) < 0.3
