"""Panel -> inline SVG for a page: small, deterministic, without ids that could collide.

Text stays text in the font of the page, and the page's own colours become CSS variables, for light and dark themes.
"""

from __future__ import annotations

import html
import io
import re
import warnings
from collections.abc import Callable, Sequence

from dhtorch.viz.plots.canvas import Canvas, to_plain_line
from dhtorch.viz.plots.colours import to_css_colour
from dhtorch.viz.plots.panel import Panel
from dhtorch.viz.plots.pictures import LayeredPicture

_HEX_COLOUR = re.compile(r"#[0-9a-f]{6}\b")
_DECIMAL = re.compile(r"-?\d+\.\d+(?:e-\d+)?")
_COORDINATES = re.compile(r'\b(d|x|y|transform)="([^"]*)"')


def render_inline_svg(panel: Panel | LayeredPicture) -> str:
    """Panel -> SVG element for a page."""
    canvas = Canvas(panel.width, panel.height, dpi=72)
    canvas.figure.patch.set_visible(False)
    panel.draw(canvas)
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Glyph"
        )  # glyphs missing in matplotlib's font; the page's font has them
        body = _strip_svg(_render_svg(canvas), canvas.tooltips)
    box, label = f"0 0 {panel.width:g} {panel.height:g}", html.escape(to_plain_line(panel.words))
    return f'<svg viewBox="{box}" role="img" aria-label="{label}" style="--width: {panel.width:g}px">{body}</svg>'


def _strip_svg(svg: str, tooltips: Sequence[str] = ()) -> str:
    """matplotlib SVG -> its content without metadata, ids and redundant styles.

    Args:
        svg: from ``savefig`` with text as text.
        tooltips: tooltips of the groups named tooltip-0, tooltip-1, …
    """
    body = svg[svg.index(">", svg.index("<svg")) + 1 : svg.rindex("</svg>")]
    body = re.sub(r"<metadata>.*?</metadata>|<defs>\s*<style.*?</style>\s*</defs>|<!--.*?-->", "", body, flags=re.S)
    body = re.sub(
        r'<g id="tooltip-(\d+)">\s*(<(?:path|text)[^>]*?)(?:/>|>([^<]*)</text>)', _make_title_writer(tooltips), body
    )
    body = re.sub(r"</?g\b[^>]*>|<defs/>", "", body)
    body = _COORDINATES.sub(lambda m: f'{m[1]}="{_round_coordinates(m[2])}"', body)
    body = re.sub(r' transform="rotate\(-?0 [^"]*\)"', "", body)
    body = re.sub(r'\bstyle="([^"]*)"', lambda m: f'style="{_reduce_style(m[1])}"', body)
    return re.sub(r">\s+<", "><", body).strip()


def _render_svg(canvas: Canvas) -> str:
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # noqa: PLC0415

    out = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "dhtorch"}):
        FigureCanvasSVG(canvas.figure).print_svg(out, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return out.getvalue()


def _make_title_writer(tooltips: Sequence[str]) -> Callable[[re.Match[str]], str]:
    def write(m: re.Match[str]) -> str:
        title = f"<title>{html.escape(tooltips[int(m[1])])}</title>"
        return f"{m[2]}>{m[3]}{title}</text>" if m[3] is not None else f"{m[2]}>{title}</path>"

    return write


def _reduce_style(style: str) -> str:
    """Style attribute without rules that the page already has, with its colour variables."""
    rules = [rule.strip().replace(": ", ":") for rule in style.split(";")]
    kept = [r for r in rules if not r.startswith(("font-family", "stroke-linejoin", "text-anchor:start"))]
    return _HEX_COLOUR.sub(lambda m: to_css_colour(m[0]), ";".join(kept))


def _round_coordinates(places: str) -> str:
    """Round coordinates to one decimal, and shorten zero-length lines."""
    places = " ".join(_DECIMAL.sub(lambda m: f"{float(m[0]):.1f}".removesuffix(".0"), places).split())
    places = re.sub(r"M (\S+ \S+) L \1(?= M|$)", r"M\1h0", places)
    return re.sub(r" ?([MLz]) ?", r"\1", places).replace("-0 ", "0 ")
