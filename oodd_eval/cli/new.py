"""``oodd-eval new``: a plug-in project that works before anything in it is edited."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from oodd_eval.cli.discovery import discovered
from oodd_eval.errors import UsageError
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.template import Project, write_project


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval new``.

    Raises
    ------
    UsageError
        When the name is none, or taken.
    OutputError
        When the directory is in use.
    """
    project = Project(options.name)
    _refuse_taken(project, discovered(options.plugins))
    directory = Path(options.output or project.distribution)
    written = write_project(project, directory)
    if options.verbosity >= 0:
        print(f"wrote {directory}:")  # noqa: T201  the program's voice
        for file in written:
            print(f"  {file.relative_to(directory)}")  # noqa: T201
        print("\nnext:")  # noqa: T201
        for line in next_commands(project, directory):
            print(f"  {line}")  # noqa: T201
    return 0


def next_commands(project: Project, directory: Path) -> list[str]:
    """Return the commands that lead from the project to an entry of the leaderboard."""
    # Without the dot, pip would look for a distribution of that name.
    place = directory if directory.is_absolute() else f"./{directory}"
    return [
        f'pip install -e "{place}[test]"',
        f"oodd-eval check {project.name}",
        f"oodd-eval run --detector {project.name} --env all",
        f"oodd-eval leaderboard submit oodd-results --detector {project.name}",
    ]


def _refuse_taken(project: Project, plugins: Plugins) -> None:
    """Raise when the detector, its plug-in or its module would collide with another."""
    if offer := plugins.offers.get(project.name):
        taken = f"there is a detector {project.name!r} already, of {offer.origin}"
    elif plugins.manager.has_plugin(project.name):
        taken = f"there is a plug-in {project.name!r} already"
    elif find_spec(project.module):
        taken = f"there is a module {project.module!r} already"
    else:
        return
    raise UsageError(f"{taken}: choose another name, such as 'my-{project.name}'")
