"""Frame after frame: the newest is answered from those before it, with a bounded memory.

push(frame) ─ remember ─┬─ a cut? forget what came before
                        └─ past frames at a few steps ─ choose ─ the method ─ Estimate of the newest
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from dhtorch.codes import Gate
from dhtorch.data.pairs import CANDIDATE_STEPS
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO
from dhtorch.pipeline.spec import Trace
from dhtorch.records import NO_HINT, Estimate, Frame, TrackHint

#: Mean support of the coarse motion below which two frames in a row show different things. Real frames in a row reach
#: 0.65 and more, pictures of different rooms 0.07 to 0.33 (``data=shared_scenes``); built-in rooms of different seeds,
#: which share their layout, 0.37 to 0.43: no cut is seen between those.
MIN_CUT_SUPPORT = 0.3

#: Standard deviation of grey values below which a picture is too flat to tell a cut by.
FLAT_IMAGE_SIGMA = 0.02


class Stream:
    """A method asked for the newest frame of a sequence, from past frames only.

    What it answers depends on the frames that were pushed since the last cut or :meth:`reset`, and on nothing else: not
    on how they came, nor on the process that held the stream (it pickles, with its memory).

    Args:
        method: of one other view or several; it chooses among past frames (``method.select_views``, else by samples).
        steps: how many frames back the other views may lie.
        seed: of the pose search, the same for every frame.
        hint: what is known of the motion.

    Memory: the last ``max(steps)`` frames as they were pushed; :attr:`nbytes` says how much that is now.
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
        self.cuts: list[int] = []  # numbers of the frames with which something new began, the first apart

    @property
    def nbytes(self) -> int:
        """Bytes of the remembered frames."""
        return sum(x.nbytes for x in pytree.tree_leaves(list(self.past)))

    def reset(self) -> None:
        """Forget all past frames: what comes next is seen for the first time."""
        self.past.clear()

    def push(self, frame: Frame, *, trace: Trace | None = None) -> Estimate:
        """Depth along the samples of ``frame`` (B = 1), by the parallax to past frames.

        The first frame, and the first after a cut, has no other view and is silent (gate NO_BASELINE). A cut is a
        picture in which hardly a part of the one before is found again (:func:`is_scene_cut`); the past is then
        forgotten and the frame's number noted in :attr:`cuts`.

        Args:
            frame: one view, on the device of those before it.
            trace: as :class:`dhtorch.pipeline.method.Method`; ``back`` (views, 1) says how many frames back the views
                asked lie.

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
            others = [self.past[-s] for s in reversed(steps)]  # in the order in which the camera took them
            if others:
                told = others if len(others) > 1 else others[0]
                estimate = self.method(frame, told, seed=self.seed, hint=self.hint, trace=trace)
                if trace is not None and "choice" in trace:
                    index = trace["choice"].index
                    trace["back"] = torch.tensor(list(reversed(steps)), device=index.device)[index]
            else:
                estimate = Estimate.silent(self.method.sample_depth(frame), Gate.NO_BASELINE, n_views=1)
            self.past.append(frame)
            self.pushed += 1
        return estimate


def is_scene_cut(before: Frame, after: Frame) -> bool:
    """Whether hardly a part of one picture is found again in the next; flat pictures tell nothing and are no cut."""
    if min(float(_contrast(frame.image)) for frame in (before, after)) < FLAT_IMAGE_SIGMA:
        return False
    return float(coarse_flow(before.image, after.image).support.mean()) < MIN_CUT_SUPPORT


def _contrast(image: Tensor) -> Tensor:
    grey = image[..., ::4, ::4].float()
    return (grey / 255 if image.dtype == torch.uint8 else grey).std()
