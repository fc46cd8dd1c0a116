r"""Write what docs/interventions.md is made from: the records of studies, and a plot.

``python docs/figures/interventions.py DIR…``, the output directories of ``oodd-eval intervene``:

    rows=panel,panel-a,mewma-a,riqn,mahalanobis
    oodd-eval intervene --detector $rows --env all --base 687 --output study-mini
    oodd-eval data build worlds
    oodd-eval intervene --detector $rows --env all --base 687 --split worlds \
        --kind '*@loss25' --output study-worlds
"""

import json
import lzma
import sys
from collections.abc import Sequence
from pathlib import Path

from oodd_interventions.columns import records_of
from oodd_interventions.page import plot

HERE = Path(__file__).parent
PLOTTED = "hopper", "panel-a", "iid--mask"


def main(directories: Sequence[str]) -> None:
    """Read the raw cells of studies; write their records and the plot of one."""
    files = [file for directory in directories for file in Path(directory).glob("cells/*/*/*.json")]
    cells = [json.loads(file.read_text("utf-8")) for file in sorted(files)]
    lines = [json.dumps(record, sort_keys=True) + "\n" for record in records_of(cells)]
    packed = lzma.compress("".join(lines).encode(), preset=9)
    (HERE / "interventions.jsonl.xz").write_bytes(packed)
    environment, detector, name = PLOTTED
    (file,) = (f for f in files if f.parts[-3:] == (environment, detector, f"{name}.json"))
    picture, words = plot(json.loads(file.read_text("utf-8")))
    (HERE / "intervention.svg").write_text(picture, "utf-8")
    print(f"{len(cells)} cells, {len(lines)} records; {words}")


if __name__ == "__main__":
    main(sys.argv[1:])
