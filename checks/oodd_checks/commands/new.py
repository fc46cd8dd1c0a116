"""``oodd-eval new``: a plug-in project that works before anything in it is edited."""

from importlib.util import find_spec
from pathlib import Path
from typing import Final

import click

from oodd_checks.template import Project, write_project
from oodd_eval.cli import OUTPUT_DIRECTORY, Options, command
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.errors import UsageError
from oodd_eval.plugins.discovery import Plugins, discover

COMMANDS: Final = """
next:
  pip install -e "{path}[test]"
  oodd-eval check {name}
  oodd-eval run --detector {name} --env all
  oodd-eval leaderboard place oodd-results
  pip wheel --no-deps --wheel-dir dist "{path}"
  oodd-eval leaderboard submit oodd-results --detector {name} --wheel dist/{project.wheel}"""

ENVIRONMENT_COMMANDS: Final = """
next:
  pip install -e "{path}[test]"
  pytest "{path}"
  oodd-eval data build {name}-dev --env {name} --train 30 --calibration 40 --test 10 \\
    --seed-base 42 --strength weak-motor=0.5 --strength position-offset=0.1
  oodd-eval run --detector mewma,persistence --env {name} --split {name}-dev
  oodd-eval data calibrate --env {name} --anomaly weak-motor,position-offset \\
    --output "{path}/src/{project.module}/ladder.json"
  oodd-eval data build {name}-ladder --base {name}-dev --suite ladder --env {name}
  oodd-eval run --detector mewma,persistence --env {name} --split {name}-ladder"""


@command("new my-detector", "new my-robot --environment", plugins=True)
@click.argument("name", help="of the detector: lower-case letters, digits, hyphens")
@click.option(
    "--environment",
    is_flag=True,
    help="a project with an environment, a policy and two kinds of anomalies, not a detector",
)
@click.option("--output", type=OUTPUT_DIRECTORY, help="where to write it (default: oodd-NAME)")
def new(options: Options) -> int:
    """Write a plug-in project that works before anything in it is edited.

    A name is refused when its project would collide with what is installed.
    """
    project = Project(options.name, options.environment)
    if taken := _taken(project, discover(options.disabled)):
        raise UsageError(f"there is {taken}: choose another name, such as 'my-{project.name}'")
    directory = options.output or Path(project.distribution)
    written = write_project(project, directory)
    if options.verbosity >= 0:
        # Without the dot, pip would look for a distribution of that name.
        path = directory if directory.is_absolute() else f"./{directory}"
        print(f"wrote {directory}:")
        for file in written:
            print(f"  {file.relative_to(directory)}")
        commands = ENVIRONMENT_COMMANDS if project.environment else COMMANDS
        print(commands.format(path=path, name=project.name, project=project))
    return 0


def _taken(project: Project, plugins: Plugins) -> str:
    """Return what has the project's name already; empty if nothing has."""
    if offer := plugins.offers.get(project.name):
        return f"a detector {project.name!r} already, of {offer.origin}"
    if project.name in plugins.names:
        return f"a plug-in {project.name!r} already"
    if find_spec(project.module):
        return f"a module {project.module!r} already"
    named = {*ENVIRONMENTS, *(spec.name for spec in plugins.custom_specs.specs)}
    if project.environment and project.name in named:
        return f"an environment or kind of anomaly {project.name!r} already"
    return ""
