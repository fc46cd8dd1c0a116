"""Sentences on a terminal."""

from rich.console import Console
from rich.text import Text


def print_prose(text: str, console: Console, style: str = "") -> None:
    """Print a sentence, wrapped between words; no line ends with a space."""
    for line in Text(text, style).wrap(console, console.width):
        line.rstrip()
        console.print(line)
