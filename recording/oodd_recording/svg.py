"""SVG pictures: a white ground of their own, so that dark pages show them, too, and plain texts."""

from collections.abc import Iterable, Iterator
from html import escape
from typing import Final, NamedTuple

INK: Final = "#222222"
"""The colour of texts."""

WIDTH: Final = 480
"""Pixels of a plot."""

LEFT, RIGHT, TOP, BOTTOM = 60, 472, 44, 152  # of a plot's axes
_LINE: Final = "#bbbbbb"


class Axes(NamedTuple):
    """The axes of a plot: first and last step from left to right, lowest and highest value."""

    first: float
    last: float
    low: float
    high: float

    def x(self, step: float) -> float:
        """Return where a step is, in pixels from the left."""
        return LEFT + (RIGHT - LEFT) * (step - self.first) / (self.last - self.first)

    def y(self, value: float) -> float:
        """Return where a value is, in pixels from the top."""
        return BOTTOM - (BOTTOM - TOP) * (value - self.low) / ((self.high - self.low) or 1)

    def ends(self) -> Iterator[str]:
        """Yield the elements that show the ends of both axes."""
        for value in (self.low, self.high):
            yield label(LEFT - 6, self.y(value) + 4, _number(value, self.high - self.low), "end")
            yield f'<path d="M{LEFT} {self.y(value):.1f}H{RIGHT}" stroke="{_LINE}"/>'
        for step, anchor in ((self.first, "start"), (self.last, "end")):
            yield label(self.x(step), BOTTOM + 16, f"{step}", anchor)

    def line(self, points: Iterable[tuple[float, float]], look: str) -> str:
        """Return a line through points of step and value; a look is attributes of the element."""
        corners = " ".join(f"{self.x(step):.1f},{self.y(value):.1f}" for step, value in points)
        return f'<polyline points="{corners}" {look}/>'

    def mark(self, step: float, look: str) -> str:
        """Return an upright line at a step."""
        return f'<path d="M{self.x(step):.1f} {TOP}V{BOTTOM + 6}" {look}/>'


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


def _number(value: float, size: float) -> str:
    """Return a number with as few digits as its axis, of a size, can do with."""
    texts = (f"{float(f'{value:.{digits}g}') + 0:g}" for digits in range(2, 7))
    near = (text for text in texts if abs(float(text) - value) <= size / 4)
    return next(near, f"{value:g}")  # neither 1.2e+02 nor -0
