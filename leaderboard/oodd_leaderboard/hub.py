"""Results of an entry as hubs of models read them: files for the repository of each detector.

``.eval_results/*.yaml`` is of https://huggingface.co/docs/hub/eval-results, the ``model-index`` in
the head of a model card of https://github.com/huggingface/hub-docs/blob/main/modelcard.md.
"""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.files import write_text
from oodd_eval.errors import OutputError, UsageError
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import Board, boards
from oodd_eval.results.identity import Setting
from oodd_leaderboard.reported import SubmittedEntry
from oodd_leaderboard.standings import primary_settings

_TASK: Final = {"type": "anomaly-detection", "name": "Detection of out-of-distribution dynamics"}


def check_dataset(name: str) -> str:
    """Return the id of a data set on a hub; `UsageError` unless it is OWNER/NAME."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name, re.ASCII):
        raise UsageError(f"--hub is {name!r}, expected a data set's id on the hub: OWNER/NAME")
    return name


def write(entry: SubmittedEntry, directory: Path, dataset: str) -> list[Path]:
    """Write the files of each detector's primary row, and return them.

    Parameters
    ----------
    entry
        The entry.
    directory
        Where each detector gets a directory, which is laid out as its repository.
    dataset
        The hub's id of the data set with the entry's split.

    Raises
    ------
    OutputError
        When a file cannot be written.
    """
    (board,) = boards(entry.records)
    rows = {row.detector: row for row in primary_settings(entry.records)}
    declared = [Setting.parse(text) for text in entry.meta.primary]
    rows |= {row.detector: row for row in declared}
    written = []
    for detector, row in sorted(rows.items()):
        target = directory / re.sub(r"[^\w.-]", "-", detector)
        name = re.sub(r"[^\w.-]", "-", f"oodd-eval-{board.split}")
        results = [*eval_results(entry, board, row, dataset)]
        head = {"model-index": model_index(board, row, dataset)}
        texts = {
            target / ".eval_results" / f"{name}.yaml": "\n".join(_yaml(results)),
            target / "README.md": "\n".join(
                ["---", *_yaml(head), "---", "", f"# {detector}", "", _sentence(entry, board, row)]
            ),
        }
        for path, text in texts.items() if results else ():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_text(path, text + "\n")
            except OSError as error:
                raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
            written.append(path)
    return written


def eval_results(
    entry: SubmittedEntry, board: Board, row: Setting, dataset: str
) -> Iterator[dict[str, Any]]:
    """Yield a row's results over all environments, a task for each metric that boards rank by."""
    url, name = entry.meta.url, f"Entry {entry.meta.id} of the oodd-eval leaderboard"
    source = {"source": {"url": url, "name": name}} if url.startswith(("http:", "https:")) else {}
    for metric, value in _values(board, row, board.environments).items():
        yield {
            "dataset": {"id": dataset, "task_id": metric},
            "value": value,
            "date": entry.meta.created,
            **source,
            "notes": _sentence(entry, board, row),
        }


def model_index(board: Board, row: Setting, dataset: str) -> list[dict[str, Any]]:
    """Return a row's results over all environments, and in each of several."""
    parts = {"all": board.environments}
    if len(board.environments) > 1:
        parts |= {environment: [environment] for environment in board.environments}
    data = {"type": dataset, "name": f"oodd-eval {board.split}"}
    versions = {"digest": board.digest, "protocol": board.protocol}
    results = [
        {
            "task": _TASK,
            "dataset": data | {"config": part, "split": "test", "args": versions},
            "metrics": [
                {"type": metric, "value": value, "name": _title(metric)}
                for metric, value in values.items()
            ],
        }
        for part, environments in parts.items()
        if (values := _values(board, row, environments))
    ]
    return [{"name": row.detector, "results": results}]


def _values(board: Board, row: Setting, environments: list[str]) -> dict[str, float]:
    """Return the means of a row by metric, as tables print them; none of a row that lacks cells."""
    values = {}
    for metric in (board.ranking, board.alarm_ranking, f"false_episodes_{board.level}"):
        mean = board.mean(row, environments, board.anomalies, metric)
        if not mean.partial and not math.isnan(mean.value):
            values[metric] = round(mean.value * (100 if _is_share(metric) else 1), 2)
    return values


def _is_share(metric: str) -> bool:
    return metric_info(metric).unit == "percent"


def _title(metric: str) -> str:
    return metric_info(metric).title + (" (%)" if _is_share(metric) else "")


def _sentence(entry: SubmittedEntry, board: Board, row: Setting) -> str:
    return (
        f"{row} on split {board.split} of oodd-eval (digest {board.digest[:12]}, protocol "
        f"{board.protocol}), entry {entry.meta.id}, reported by its author."
    )


def _yaml(value: dict[str, Any] | list[Any]) -> Iterator[str]:
    """Yield the lines of mappings and lists in block style; scalars are JSON, which YAML reads."""
    if isinstance(value, list):
        for item in value:
            first, *rest = _yaml(item)
            yield f"- {first}"
            yield from (f"  {line}" for line in rest)
        return
    for key, inner in value.items():
        if isinstance(inner, dict | list):
            yield f"{key}:"
            yield from (f"  {line}" for line in _yaml(inner))
        else:
            yield f"{key}: {json.dumps(inner, ensure_ascii=False)}"
