"""Small figures as inline SVG: axes, lines, dots and bars, coloured by the page's style sheet.

Alphabet: x, y are data; u, v are picture units inside the panel, v down. Colours are classes (``s0`` … ``s7`` for
series), so that a figure reads in light and in dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dhtorch.studies.report.markup import Markup, join, tag

Numbers = Sequence[float | None]

#: Number of series colours; later series repeat them, dashed.
COLOURS = 8


@dataclass(frozen=True)
class Axis:
    """A range of data and how it is written."""

    low: float
    high: float
    label: str = ""
    log: bool = False
    percent: bool = False

    def place(self, x: float) -> float:
        """Place in [0, 1]; beyond the range at its end."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        at = math.log(max(x, self.low)) if self.log else x
        return min(1.0, max(0.0, (at - low) / (high - low)))

    def ticks(self, most: int = 5) -> list[float]:
        """Round numbers within the range, about as many as asked for."""
        if self.log and len(self._in_decades(range(1, 10))) > 1:
            sets = (range(1, 10), (1, 2, 3, 5), (1, 2, 5), (1, 3), (1,))
            found = next((t for steps in sets if len(t := self._in_decades(steps)) <= most + 1), self._in_decades((1,)))
            return found[:: math.ceil(len(found) / (most + 1))]
        raw = (self.high - self.low) / most
        size = 10.0 ** math.floor(math.log10(raw))
        step = next(size * s for s in (1, 2, 5, 10) if size * s >= raw * 0.999)
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]

    def _in_decades(self, steps: Sequence[int]) -> list[float]:
        """Multiples of the powers of ten within the range."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        found = (s * 10.0**d for d in decades for s in steps)
        return [t for t in found if self.low * 0.999 <= t <= self.high * 1.001]

    def write(self, tick: float) -> str:
        """A tick as text."""
        return f"{100 * tick:.4g}" if self.percent else f"{tick:.4g}"


def spanning(values: Numbers, label: str, *, log: bool = False, percent: bool = False, **ends: float) -> Axis:
    """An axis that holds all values; ``low`` and ``high`` fix an end, ``floor`` and ``cap`` bound it."""
    known = [v for v in values if v is not None and (not log or v > 0)]
    low, high = (min(known), max(known)) if known else (0.1 if log else 0.0, 1.0)
    low, high = max(low, ends.get("floor", low)), min(high, ends.get("cap", high))
    pad = 1.15 if log else 0.06 * (high - low)
    low, high = (low / pad, high * pad) if log else (low - pad, high + pad)
    low, high = ends.get("low", low), ends.get("high", high)
    if not high > low or (log and high < 1.5 * low):
        low, high = (low / 1.5, low * 2) if log else (low - 0.5, low + 0.5)
    return Axis(low, high, label, log, percent)


class Panel:
    """One pair of axes; draw, then :meth:`render`."""

    def __init__(
        self,
        title: str,
        x: Axis,
        y: Axis | None,  # None = named rows, see ``rows``
        *,
        size: tuple[float, float] = (300, 216),
        rows: Sequence[str] = (),
    ) -> None:
        self.title, self.x, self.y, self.rows = title, x, y, list(rows)
        longest = max((len(r) for r in rows), default=0)
        self.width, self.height = size
        self.left = min(0.4 * size[0], 12 + 6.1 * longest) if rows else 46.0
        self.right, self.top, self.bottom = 12.0, 26.0 if title else 10.0, 40.0 if x.label else 22.0
        self.parts: list[Markup] = []

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Picture place of a point; in a panel of named rows y is the row's number."""
        u = self.left + self.x.place(x) * (self.width - self.left - self.right)
        inner = self.height - self.top - self.bottom
        part = 1 - (y + 0.5) / len(self.rows) if self.y is None else self.y.place(y)
        return round(u, 1), round(self.top + (1 - part) * inner, 1)

    def line(self, xs: Numbers, ys: Numbers, style: str) -> None:
        """A line, broken where a value is missing; a value that stands alone becomes a dot."""
        run: list[tuple[float, float]] = []
        for x, y in [*zip(xs, ys, strict=True), (None, None)]:
            if x is not None and y is not None:
                run.append(self.at(x, y))
                continue
            if len(run) == 1:
                self.parts.append(tag("circle", cx=run[0][0], cy=run[0][1], r=2.2, class_=f"dot {style}"))
            elif run:
                self.parts.append(tag("polyline", points=" ".join(f"{u},{v}" for u, v in run), class_=f"line {style}"))
            run = []

    def dot(self, x: float, y: float, style: str, said: str = "", r: float = 3.4) -> None:
        """A dot with a text that shows when pointed at."""
        u, v = self.at(x, y)
        self.parts.append(tag("circle", *_hover(said), cx=u, cy=v, r=r, class_=f"dot {style}"))

    def diamond(self, x: float, y: float, said: str = "") -> None:
        """The paper's mark."""
        (u, v), r = self.at(x, y), 5
        corners = f"{u},{v - r} {u + r},{v} {u},{v + r} {u - r},{v}"
        self.parts.append(tag("polygon", *_hover(said), points=corners, class_="theirs"))

    def bar(self, x_0: float, x_1: float, y_0: float, y_1: float, style: str) -> None:
        """A filled rectangle."""
        (u_0, v_0), (u_1, v_1) = self.at(x_0, y_0), self.at(x_1, y_1)
        width, height = round(max(u_1 - u_0, 0.5), 1), round(v_0 - v_1, 1)
        self.parts.append(tag("rect", x=u_0, y=v_1, width=width, height=height, class_=style))

    def render(self) -> Markup:
        """The panel as an SVG element."""
        frame = [self._text(self.title, 2, 14, "title")]
        inner_right, base = self.width - self.right, self.height - self.bottom
        for tick in self.x.ticks():
            u = self.at(tick, 0 if self.y is None else self.y.low)[0]
            frame.append(tag("line", x1=u, y1=self.top, x2=u, y2=base, class_="grid"))
            frame.append(self._text(self.x.write(tick), u, base + 14, "tick middle"))
        frame.append(self._text(self.x.label, (self.left + inner_right) / 2, self.height - 8, "label middle"))
        for k, name in enumerate(self.rows):
            v = self.at(self.x.low, k)[1]
            frame.append(tag("line", x1=self.left, y1=v, x2=inner_right, y2=v, class_="grid"))
            frame.append(self._text(_cut(name, self.left / 6.1), self.left - 8, v + 3.5, "tick end", name))
        for tick in self.y.ticks() if self.y else ():
            v = self.at(self.x.low, tick)[1]
            frame.append(tag("line", x1=self.left, y1=v, x2=inner_right, y2=v, class_="grid"))
            frame.append(self._text(self.y.write(tick) if self.y else "", self.left - 5, v + 3.5, "tick end"))
        if self.y:
            middle = (self.top + base) / 2
            turn = f"rotate(-90 10 {middle:g})"
            frame.append(tag("text", self.y.label, x=10, y=middle, transform=turn, class_="label middle"))
        box, size = f"0 0 {self.width:g} {self.height:g}", f"--width: {self.width:g}px"
        said = self.title or f"{self.y.label if self.y else ', '.join(self.rows)} against {self.x.label}"
        return tag("svg", *frame, *self.parts, viewBox=box, role="img", aria_label=said, style=size)

    @staticmethod
    def _text(text: str, u: float, v: float, style: str, said: str = "") -> Markup:
        more = _hover(said) if said and said != text else ()
        return tag("text", text, *more, x=round(u, 1), y=round(v, 1), class_=style)


def picture(title: str, hw: Sequence[float], layers: Sequence[tuple[str, Sequence[float], Sequence[float]]]) -> Markup:
    """Dots over an empty picture of size ``hw``: (class, u, v) layers, each one path."""
    height, width = hw
    dots = [
        tag(
            "path", d="".join(f"M{u:g} {v:g}h0" for u, v in zip(us, vs, strict=True) if None not in (u, v)), class_=name
        )
        for name, us, vs in layers
    ]
    ground = tag("rect", width=f"{width:g}", height=f"{height:g}", class_="ground")
    size = f"--dot: {max(width, height) / 62:.3g}"
    body = join((ground, *dots))
    return tag(
        "svg", body, viewBox=f"0 0 {width:g} {height:g}", role="img", aria_label=title, class_="overlay", style=size
    )


def _hover(said: str) -> tuple[Markup, ...]:
    return (tag("title", said),) if said else ()


def _cut(text: str, most: float) -> str:
    return text if len(text) <= most else text[: int(most) - 1] + "…"
