"""The file ``curves.json``: made from stored scores, written, and read with every field checked.

`_layout` has its fields; `oodd_leaderboard.curves` computes them and says what they mean.
"""

import functools
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, conlist, create_model

from oodd_eval.data import files
from oodd_eval.data.condition import NOMINAL
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, NAME_PATTERN
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import AlarmRule
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import cell_scores, must_be_of, stored_scores
from oodd_eval.results.record import Record
from oodd_leaderboard.curves import Sweep, cell_curves, thresholds

SCHEMA: Final = 1  # version of the layout; a reader refuses others
LONGEST: Final = 1000  # most numbers in any list: a page that embeds them has to stay small
LARGEST: Final = 1e15  # no number is larger


def make_curves(
    records: Iterable[Record], results: ResultsDirectory, split: Split
) -> dict[str, Any]:
    """Compute the content of ``curves.json`` from the stored scores of all evaluated cells."""
    units = []
    fitted: dict[str, tuple[Sweep, AlarmRule]] = {}
    with split.opened() as environment:
        for record in (r for r in records if r.ok):
            must_be_of(split, record)
            data = environment(record.environment)
            scores = stored_scores([record], results, data).parts
            if record.condition == NOMINAL or not scores[TWINS]:
                continue  # there is nothing to find, or nothing to compare with
            if record.scores not in fitted:
                rule = AlarmRule(Standardization.fit(scores[CALIBRATION]))
                at = thresholds(scores[TWINS], rule)
                fitted[record.scores] = Sweep.over(scores[TWINS], rule, at), rule
            sweep, rule = fitted[record.scores]
            curves = cell_curves(cell_scores(record, scores, data), sweep, rule)
            units.append({"cell": str(record.cell), **identity(record), **curves})
    return {"schema": SCHEMA, "units": units}


def identity(record: Record) -> dict[str, Any]:
    """Return the fields of a cell's curves that its record has, too."""
    names = ["detector", "horizon", "seed", "overrides", "environment", "anomaly"]
    names += ["paired"] * (not record.paired)
    return {name: getattr(record, name) for name in names}


def write_curves(curves: Mapping[str, Any], path: Path) -> None:
    """Write curves as JSON without spaces, one cell a line."""
    units = [json.dumps(u, separators=(",", ":"), allow_nan=False) for u in curves["units"]]
    lines = ",\n".join(units)
    files.write_text(path, f'{{"schema":{SCHEMA},"units":[\n{lines}\n]}}\n')


def read_curves(path: Path | str) -> dict[str, Any]:
    """Read ``curves.json``; ResultsError names the field that is not as the layout has it."""
    path = Path(path)
    text = files.read_text(path)
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ResultsError(f"{str(path)!r} cannot be read: {error}") from None
    return check_curves(plain, path.name)


def check_curves(plain: Any, where: str) -> dict[str, Any]:
    """Return a JSON value if it is the content of ``curves.json``; see `read_curves`."""
    layout, of_twins, of_logs = _layouts()
    _hold_to(layout, plain, where)
    for i, unit in enumerate(plain["units"]):
        unpaired = isinstance(unit, dict) and unit.get("paired") is False
        _hold_to(of_logs if unpaired else of_twins, unit, where, f"units[{i}]")
    content: dict[str, Any] = plain
    if content["schema"] != SCHEMA:
        problem = f"expected {SCHEMA}: it was written by another version of oodd-eval"
        raise _wrong(f"{where}: schema", content["schema"], problem)
    seen: set[str] = set()
    for i, unit in enumerate(content["units"]):
        name = f"{where}: units[{i}]"
        if unit["cell"] in seen:
            raise _wrong(f"{name}.cell", unit["cell"], "a cell that occurs before")
        seen.add(unit["cell"])
        for part in ("roc", "delay_far"):
            (first_name, first), *other_columns = unit[part].items()
            for other, values in other_columns:
                _check_length(values, first, f"{name}.{part}.{other}")
            for k, (before, value) in enumerate(itertools.pairwise(first), start=1):
                if value < before:
                    field = f"{name}.{part}.{first_name}[{k}]"
                    raise _wrong(field, value, f"below {before} before it")
        _check_example(unit["example"], f"{name}.example")
    return content


def _hold_to(layout: TypeAdapter[Any], plain: Any, file: str, at: str = "") -> None:
    """Raise `ResultsError` for the first field of a value that is not as a layout has it."""
    try:
        layout.validate_python(plain)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        # A field that does not belong there may have any name.
        path = at + "".join(
            f"[{p}]" if isinstance(p, int) else f".{ascii(p)[1:-1]:.60}" for p in first["loc"]
        )
        raise _wrong(f"{file}: {path.removeprefix('.')}", first["input"], first["msg"]) from None


def strict_model(**types: Any) -> Any:
    """Return a model of JSON objects that have these fields, no others, and only finite numbers.

    A type in a pair with a default may be missing.
    """
    strict = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    fields: dict[str, Any] = {
        name: kind if isinstance(kind, tuple) else (kind, ...) for name, kind in types.items()
    }
    return create_model("Part", __config__=strict, **fields)


@functools.cache
def _layouts() -> tuple[TypeAdapter[Any], TypeAdapter[Any], TypeAdapter[Any]]:
    """Return readers of the file, of a cell with twins, and of one without."""
    # They know fields, types and ranges of single values.

    def numbers(item: Any) -> Any:
        return conlist(item, max_length=LONGEST)

    row = Annotated[int, Field(ge=0, le=10**9)]
    rate = Annotated[float, Field(ge=0, le=1)]
    rates = numbers(rate)
    amounts = numbers(Annotated[float, Field(ge=0, le=LARGEST)])
    scores = numbers(Annotated[float, Field(ge=-LARGEST, le=LARGEST)] | None)
    # fmt: off
    common = {
        "cell": str, "detector": str, "horizon": int, "seed": int, "overrides": dict[str, Any],
        "roc": strict_model(fpr=rates, tpr=rates),
    }
    example = {"index": row, "length": row, "start": row, "scores": scores, "cusum": amounts,
        "alarms": numbers(row)}
    unit = strict_model(
        **common, environment=Literal[*ENVIRONMENTS], anomaly=Literal[*ANOMALIES],
        delay_far=strict_model(threshold=amounts, far=rates, delay_censored=amounts, missed=rates,
            null_censored=amounts),
        example=strict_model(**example, auc_matched=rate | None, onset=row, twin=scores,
            twin_cusum=amounts, twin_alarms=numbers(row)),
    )
    name = Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
    end: Any = Annotated[int, Field(ge=-1, le=10**9)]
    interval = conlist(end, min_length=2, max_length=2)
    unpaired = strict_model(
        **common, paired=Literal[False], environment=name, anomaly=name,
        delay_far=strict_model(threshold=amounts, far=rates, delay_censored=amounts, missed=rates),
        example=strict_model(**example, auc_pool=rate | None, intervals=numbers(interval)),
    )
    # fmt: on
    # `schema` is a name that pydantic's models have taken.
    version = Annotated[int, Field(alias="schema")]
    layout = strict_model(version=version, units=list[Any])
    return TypeAdapter(layout), TypeAdapter(unit), TypeAdapter(unpaired)


def _check_example(example: Mapping[str, Any], name: str) -> None:
    """Check how the numbers of an example fit one another; one without a twin has intervals."""
    start, length = example["start"], example["length"]
    if (onset := example.get("onset", start)) >= length:
        raise _wrong(f"{name}.onset", onset, f"expected less than length, {length}")
    if start > onset:
        raise _wrong(f"{name}.start", start, f"expected at most onset, {onset}")
    for prefix, scores in (("", "scores"), ("twin_", "twin")):
        if scores not in example:
            continue
        rows = range(start, start + len(example[f"{prefix}cusum"]))
        _check_length(example[scores], rows, f"{name}.{scores}")
        for i, row in enumerate(example[f"{prefix}alarms"]):
            if row not in rows:
                problem = f"no row in {start} ... {rows.stop - 1}"
                raise _wrong(f"{name}.{prefix}alarms[{i}]", row, problem)
    if len(example["scores"]) > length - start:
        actual = f"{len(example['scores'])} numbers"
        problem = f"expected at most length - start, {length - start}"
        raise _wrong(f"{name}.scores", actual, problem)
    for i, (first, stop) in enumerate(example.get("intervals", ())):
        if not first < stop <= length:
            problem = f"expected a first row before the end, of at most {length}"
            raise _wrong(f"{name}.intervals[{i}]", [first, stop], problem)


def _check_length(values: Sequence[Any], like: Sequence[Any], field: str) -> None:
    if len(values) != len(like):
        raise _wrong(field, f"{len(values)} numbers", f"expected {len(like)}")


def _wrong(field: str, value: Any, problem: str) -> ResultsError:
    return ResultsError(f"{field} is {value!r:.80}: {problem}")
