"""``oodd-eval new``: a plug-in project that works before anything in it is edited."""

from importlib.util import find_spec
from pathlib import Path

import click

from oodd_checks.template import Project, write_project
from oodd_eval.cli import OUTPUT_DIRECTORY, Options, command
from oodd_eval.errors import UsageError
from oodd_eval.plugins.discovery import discover


@command("new my-detector", plugins=True)
@click.argument("name", help="name of the detector: lower-case letters, digits, hyphens")
@click.option("--output", type=OUTPUT_DIRECTORY, help="where to write it (default: oodd-NAME)")
def new(options: Options) -> int:
    """Write a plug-in project that works before anything in it is edited.

    A name is refused when its project would collide with what is installed.
    """
    project = Project(options.name)
    plugins = discover(options.disabled)
    taken = ""
    if offer := plugins.offers.get(project.name):
        taken = f"detector {project.name!r} already, of {offer.origin}"
    elif project.name in plugins.names:
        taken = f"plug-in {project.name!r} already"
    elif find_spec(project.module):
        taken = f"module {project.module!r} already"
    if taken:
        raise UsageError(f"there is a {taken}: choose another name, such as 'my-{project.name}'")
    directory = options.output or Path(project.distribution)
    written = write_project(project, directory)
    if options.verbosity >= 0:
        # Without the dot, pip would look for a distribution of that name.
        path = directory if directory.is_absolute() else f"./{directory}"
        print(f"wrote {directory}:")
        for file in written:
            print(f"  {file.relative_to(directory)}")
        print(
            f'\nnext:\n  pip install -e "{path}[test]"\n  oodd-eval check {project.name}\n'
            f"  oodd-eval run --detector {project.name} --env all\n"
            "  oodd-eval leaderboard place oodd-results\n"
            f'  pip wheel --no-deps --wheel-dir dist "{path}"\n'
            f"  oodd-eval leaderboard submit oodd-results --detector {project.name} "
            f"--wheel dist/{project.wheel}"
        )
    return 0
