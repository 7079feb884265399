"""Corrections of what a reader assumes, as options of every format: unit, lag and turn of depth, pose convention.

Files may mean something else than their layout suggests, which a capture check detects; each correction is the option
that its warning names. Orientation and rate of every recording are checked here too, since all of them pass.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from dhtorch.data.clocks import describe_rate
from dhtorch.data.orientation import DEPTH_TURNS, orient_recording
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit, parse_unit
from dhtorch.records import Frame
from dhtorch.runtime.console import format_count


@dataclass(frozen=True)
class Corrections:
    """Options of every format; None = as the reader reads it."""

    depth_unit: str | float | None = None  # m, cm, mm, inch, 1/5000, or metres of one step
    pose_convention: str | float | None = None  # see parse_pose_convention
    depth_lag: int | None = None  # frames by which depth comes late; negative: early
    depth_turn: str | int | None = None  # a key of DEPTH_TURNS: how the stored depth is to be turned, counter-clockwise

    @classmethod
    def names(cls) -> list[str]:
        """Names of the options."""
        return [each.name for each in fields(cls)]

    @classmethod
    def from_options(cls, options: Mapping[str, object]) -> "Corrections":
        """The corrections among the options of a capture."""
        return cls(**{name: options[name] for name in cls.names() if name in options})  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        if self.depth_unit is not None:
            parse_unit(self.depth_unit)
        if self.pose_convention is not None:
            parse_pose_convention(self.pose_convention)
        if self.depth_turn is not None and str(self.depth_turn) not in DEPTH_TURNS:
            raise ValueError(f"depth_turn: found {self.depth_turn!r}, expected {', '.join(DEPTH_TURNS)}")
        lag = self.depth_lag
        if lag is not None and (not isinstance(lag, int) or isinstance(lag, bool)):
            raise ValueError(f"depth_lag: found {lag!r}, expected a whole number of frames")

    def apply(self, recording: Recording) -> Recording:
        """The recording with these corrections.

        Raises:
            FormatError: pictures and depth of different orientations, none of which explains the other.
            ValueError: a lag that leaves no frame.
        """
        turn = None if self.depth_turn is None else DEPTH_TURNS[str(self.depth_turn)]
        recording = orient_recording(recording, turn)
        if self.depth_unit is not None:
            metres = parse_unit(self.depth_unit)
            read_as = 1.0 if recording.depth_unit is None else recording.depth_unit.metres
            load = partial(_scale_depth, recording.load, metres / read_as) if metres != read_as else recording.load
            recording = replace(recording, load=load, depth_unit=DepthUnit(metres, "option depth_unit"))
        if lag := self.depth_lag:  # frames without depth of their own are left out
            n, first = len(recording) - abs(lag), max(-lag, 0)
            if n < 1:
                raise ValueError(f"depth_lag: found {lag} for {len(recording)} frames, expected less")
            kept = slice(first, first + n)
            remark = f"depth is that of {format_count(abs(lag), 'frame')} {'later' if lag > 0 else 'earlier'}"
            recording = replace(
                recording,
                load=partial(_lag_depth, recording.load, lag, first),
                number=recording.number[kept],
                times=None if recording.times is None else recording.times[kept],
                poses=None if recording.poses is None else recording.poses[kept],
                report=(*recording.report, remark),
            )
        if self.pose_convention is not None and recording.poses is not None:
            convention = parse_pose_convention(self.pose_convention)
            recording = replace(recording, poses=convention.apply(recording.poses))
        # The recording with a remark where its time stamps have no plausible rate, which no option corrects
        if recording.times is None or len(recording) < 2:
            return recording
        times, nominal = recording.times.numpy(), recording.rate_hz
        # Relative difference up to which a recording's rate is that of its own stamps. Source: derived: rounding.
        if nominal is not None and abs(nominal * float(np.median(np.diff(times))) - 1) < 1e-3:
            nominal = None  # a rate that was measured by the same stamps
        doubt = describe_rate(times, nominal)
        return recording if doubt is None else replace(recording, report=(*recording.report, doubt))


def _scale_depth(load: Callable[[int], Frame], factor: float, i: int) -> Frame:
    """Frame at a position with its depth times a factor."""
    frame = load(i)
    return frame.replace(depth=frame.depth * factor)


def _lag_depth(load: Callable[[int], Frame], lag: int, first: int, i: int) -> Frame:
    """Frame at a position with the depth of another position: that of ``lag`` frames later."""
    frame, later = load(i + first), load(i + first + lag)
    return frame.replace(depth=later.depth, conf=later.conf, depth_camera=later.depth_camera)
