"""``oodd-eval data export``: a split in another project's format."""

import click

from oodd_eval.cli import DIRECTORY, Names, Options, command, say
from oodd_eval.cli.console import make_console
from oodd_eval.cli.data import split_argument
from oodd_eval.data import croissant
from oodd_eval.data.split import SHIPPED, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import counted, select
from oodd_logs.readers.minari import export as export_split


@command(
    "data export mini --format minari --output datasets",
    "data export mini --format croissant --output metadata",
)
@split_argument
@click.option(
    "--format",
    required=True,
    type=click.Choice(["minari", "croissant"]),
    help="minari: one dataset a part; croissant: metadata for searches of data sets",
)
@click.option("--output", type=DIRECTORY, help="root of the datasets; folder of the metadata")
@click.option("--env", default="all", type=Names("envs"), help="environments, for minari")
@click.option("--url", default="", help="where the split can be had, for croissant")
def export(options: Options) -> int:
    """Write a split, or what it is, in another project's format.

    Metadata are written beside the manifest unless --output names a folder.
    """
    split = load_split(options.name)
    if options.format == "croissant":
        if options.env != "all":
            raise UsageError("--env is for --format minari: metadata are of a whole split")
        if options.output is None and split.path.parent == SHIPPED:
            raise UsageError(
                f"split {split.name} is in the installed package, which has its metadata already: "
                "name a folder for others with --output"
            )
        metadata = croissant.write(split, options.output, url=options.url)
        if lacking := metadata.lacking:
            advice = ["name the address with --url"] if "url" in lacking else []
            if {*lacking} - {"url"}:
                advice.append("write the others into the file" if advice else "write into the file")
            say(
                f"not known, and required by searches for data sets: {', '.join(lacking)}; before "
                f"publishing {' and '.join(advice)}"
            )
        make_console().print(f"metadata of split {split.name} are in {metadata.path}")
        return 0
    if options.output is None or options.url:
        raise UsageError("--format minari needs --output, and has no --url")
    environments = select("environment", options.env, split.environments)
    notes = make_console(quiet=options.verbosity < 0)
    written = export_split(split, options.output, environments=environments, progress=notes.print)
    hint = f"Minari finds them with MINARI_DATASETS_PATH={options.output}"
    make_console().print(f"{counted(len(written), 'dataset(s)')} in {options.output}: {hint}")
    return 0
