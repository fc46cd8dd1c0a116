"""A watchdog's readings in a terminal, as they come."""

import math
from collections import deque
from types import TracebackType
from typing import Final, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from oodd_eval.plugins.explanations import NAMED
from oodd_live.reading import Reading

BARS: Final = " ▁▂▃▄▅▆▇█"
HISTORY: Final = 60
"""Readings whose statistic is shown."""
SENSORS: Final = 5
WIDTH: Final = 24
REFRESH: Final = 8
"""Pictures a second, however fast readings come."""


class TerminalMonitor:
    """Statistic, threshold and sensors of a watchdog in a terminal; a context manager.

    Parameters
    ----------
    title
        Shown above.
    console
        Where to; default the terminal.

    Examples
    --------
    >>> with TerminalMonitor("hopper") as monitor:  # doctest: +SKIP
    ...     monitor.update(watchdog.update(observation, action))
    """

    def __init__(self, title: str = "watchdog", console: Console | None = None) -> None:
        self.title = title
        self._past: deque[float] = deque(maxlen=HISTORY)
        self._reading: Reading | None = None
        # It asks for the picture when it draws one, so that readings in between cost nothing.
        self._live = Live(console=console, refresh_per_second=REFRESH, get_renderable=self.picture)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def update(self, reading: Reading) -> None:
        """Show a reading.

        Parameters
        ----------
        reading
            The newest one.
        """
        self._past.append(reading.statistic / reading.threshold if reading.threshold > 0 else 0.0)
        self._reading = reading

    def picture(self) -> RenderableType:
        """Return what is shown: state, statistic against the threshold, sensors."""
        reading = self._reading
        if reading is None:
            return Panel("waiting for the first observation", title=self.title)
        style = "bold red" if reading.alarm else "green"
        past = "".join(_bar(share) for share in self._past)
        statistic = f"statistic {reading.statistic:.4g}, threshold {reading.threshold:.4g}"
        table = Table(box=None, show_header=False, padding=(0, 1))
        for name in list(dict.fromkeys([*reading.parts, *reading.sensors]))[:SENSORS]:
            share, p = reading.sensors.get(name, 0.0), reading.parts.get(name, 0.0)
            fault = reading.faults.get(name) or f"at fault {p:.0%}" * (p >= NAMED)
            table.add_row(name, f"{share:4.0%}", "█" * round(WIDTH * share), fault)
        picture = Group(Text(str(reading), style=style), Text(past), Text(statistic), table)
        return Panel(picture, title=self.title, border_style=style)


def _bar(share: float) -> str:
    """Return a character as high as the statistic's share of the threshold.

    >>> _bar(0.0), _bar(0.5), _bar(3.0), _bar(-math.inf)
    (' ', '▄', '█', ' ')
    """
    last = len(BARS) - 1
    return BARS[round(last * min(max(share, 0.0), 1.0)) if math.isfinite(share) else 0]
