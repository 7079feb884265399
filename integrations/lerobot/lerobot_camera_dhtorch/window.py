"""The last frames of a running episode, joined to the newest as LeRobot's ``delta_timestamps`` joins them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import torch
from torch import Tensor


class FrameWindow:
    """The frames since the start of an episode, at most ``gap`` of them.

    A window holds the frame ``gap`` places back and the newest. Before there are so many frames, the first of the
    episode stands for the earlier one and is marked as padding, as in LeRobot's data sets.
    """

    def __init__(self, gap: int) -> None:
        if gap < 1:
            raise ValueError(f"gap is {gap}, expected at least 1 frame")
        self.past: deque[tuple[Tensor, Tensor]] = deque(maxlen=gap)

    def push(self, image: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Picture and depth map of the newest frame -> pictures (2, …), maps (2, …), whether they are padding (2,)."""
        image, depth = image.detach().clone(), depth.detach().clone()  # a camera may fill its buffer anew
        early = len(self.past) < self.past.maxlen
        then = self.past[0] if self.past else (image, depth)
        self.past.append((image, depth))
        images, depths = (torch.stack([a.to(b), b]) for a, b in zip(then, (image, depth), strict=True))
        return images, depths, torch.tensor([early, False])

    def reset(self) -> None:
        """The next frame is the first of an episode."""
        self.past.clear()

    def state_dict(self) -> dict[str, Tensor]:
        """Past frames as two tensors (k, …); empty if there are none."""
        if not self.past:
            return {}
        return {key: torch.stack([frame[i] for frame in self.past]) for i, key in enumerate(("image", "depth"))}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Past frames of a :meth:`state_dict`; without them an episode starts."""
        self.past.clear()
        self.past.extend(zip(state.get("image", ()), state.get("depth", ()), strict=True))
