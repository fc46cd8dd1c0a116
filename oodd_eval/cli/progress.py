"""Progress of a command whose work has parts: a bar, or a line now and then."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich.live import Live

from oodd_eval.cli.console import make_console
from oodd_eval.scoring.display import SILENCE, Pace


@contextmanager
def pace_shown(noun: str, *, quiet: bool) -> Iterator[Callable[[int, int, str], None]]:
    """Show how much is done and the time left: a bar on a terminal, else a line now and then.

    The block gets a function of the parts done, of all parts and of a word on the last one, which
    is empty where parts were done before.
    """
    console, latest = make_console(quiet=quiet), -SILENCE
    pace = Pace(0, time.perf_counter(), noun=noun)

    def show(done: int, total: int, part: str) -> None:
        nonlocal latest
        pace.total, now = total, time.perf_counter()
        while pace.done < done:
            pace.add(now, resumed=not part)
        if not console.is_terminal and now >= latest + SILENCE:
            latest = now
            console.print(f"{pace}  {part}".rstrip())

    live = Live(pace, console=console, transient=True, refresh_per_second=2)
    with live if console.is_terminal and not quiet else nullcontext():
        yield show
