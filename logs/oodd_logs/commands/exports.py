"""``oodd-eval data export``: a split in another project's format."""

import click

from oodd_eval.cli import OUTPUT_DIRECTORY, Names, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.cli.data import split_argument
from oodd_eval.data.split import load_split
from oodd_eval.names import counted
from oodd_logs.minari_files import export as export_split


@command("data export mini --format minari --output datasets")
@split_argument
@click.option(
    "--format", required=True, type=click.Choice(["minari"]), help="minari: one dataset a part"
)
@click.option("--output", required=True, type=OUTPUT_DIRECTORY, help="root of the datasets")
@click.option("--env", default="all", type=Names("envs"), help="only these environments")
def export(options: Options) -> int:
    """Write a split in another project's format."""
    split = load_split(options.name)
    environments = split.select_environments(options.env)
    notes = make_console(quiet=options.verbosity < 0)
    written = export_split(split, options.output, environments=environments, progress=notes.print)
    hint = f"Minari finds them with MINARI_DATASETS_PATH={options.output}"
    make_console().print(f"{counted(len(written), 'dataset(s)')} in {options.output}: {hint}")
    return 0
