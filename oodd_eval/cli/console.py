"""The console of commands: what they print is text that every terminal takes."""

import sys
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from oodd_eval.cli.streams import encodable, plain_text, raw


class _Console(Console):
    """Writes styles and moves of the cursor of its own, and of what it is to print `plain_text`."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            text = encodable(plain_text(segment.text), self.encoding)
            yield segment if segment.control else segment._replace(text=text)

    def on_broken_pipe(self) -> None:
        """Raise the error; rich would end the process with the exit code of a failure."""
        raise BrokenPipeError


def make_console(*, quiet: bool = False, stderr: bool = False) -> Console:
    """Return a console on a standard stream: coloured on a terminal, plain text in a pipe."""
    file = raw(sys.stderr if stderr else sys.stdout)
    console = _Console(file=file, highlight=False, markup=False, soft_wrap=True, quiet=quiet)
    if console.width < 1:  # COLUMNS=0, as of terminals that do not know their size
        console.width = 80
    return console
