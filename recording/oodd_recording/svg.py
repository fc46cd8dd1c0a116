"""SVG pictures: a white ground of their own, so that dark pages show them, too, and plain texts."""

from collections.abc import Iterable
from html import escape
from typing import Final

INK: Final = "#222222"
"""The colour of texts."""


def svg(width: int, height: int, shapes: Iterable[str]) -> str:
    """Return an SVG picture of some elements on a white ground, sizes in pixels."""
    size = f'width="{width}" height="{height}"'
    font = 'font-family="sans-serif" font-size="12"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {size} {font}'
    ground = f'<rect {size} fill="white"/>'
    return "\n".join([f'{head} fill="none">', ground, *shapes, "</svg>\n"])


def label(x: float, y: float, text: str, anchor: str = "middle", weight: str = "normal") -> str:
    """Return an SVG element with a text at a position in pixels."""
    anchoring = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-weight="{weight}"'
    return f'<text {anchoring} fill="{INK}">{escape(text)}</text>'
