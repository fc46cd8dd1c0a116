"""Scans for the viewers that people have open: Rerun and whatever reads MCAP."""

import json
import math
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlencode

import numpy as np
from oodd_live.reading import as_nanoseconds

from oodd_eval.data.bounded import without_nan
from oodd_eval.data.files import replacing
from oodd_eval.errors import MissingExtraError
from oodd_logs.scanning.scan import Scan, ScannedEpisode

_EXTRA: Final = "pip install 'oodd-eval[viewers]'"
_AROUND: Final = 100  # rows before and after the odd one that a tab of Rerun shows
_CURVES: Final = [["statistic"], ["threshold"]]
_NUMBER: Final = {"type": ["number", "null"]}
_VERDICT: Final = {
    "score": _NUMBER,
    "statistic": _NUMBER,
    "threshold": _NUMBER,
    "alarm": {"type": "boolean"},
    "suspects": {"type": "array", "items": {"type": "string"}},
}


def foxglove_link(scanned: ScannedEpisode, address: str) -> str:
    """Return a link that opens a served MCAP file in Foxglove, at an episode's first odd row.

    The form is that of https://docs.foxglove.dev/docs/visualization/shareable-links. There is none
    for files that are not served.

    Parameters
    ----------
    scanned
        The episode.
    address
        Of the file, http or https. Its server has to allow byte ranges and other origins.
    """
    moment = np.datetime64(_stamp(scanned, scanned.first or 0), "ns")
    parameters = {"ds": "remote-file", "ds.url": address, "time": f"{moment}Z"}
    return f"foxglove://open?{urlencode(parameters, quote_via=quote, safe='')}"


def write_rerun(scan: Scan, path: Path, first: int = 10) -> None:
    """Write a scan as a recording of Rerun, which no viewer is started for.

    Each episode is an entity ``/NAME`` with ``sensors/SENSOR``, ``score``, ``statistic``,
    ``threshold`` and ``alarm`` over the timelines ``row`` and, where there are stamps, ``time``,
    and a text ``suspects`` at its first odd row. It opens with a tab for each of the first
    episodes: the suspects and the statistic about that row.

    Parameters
    ----------
    scan
        What to write.
    path
        The file, ``.rrd``.
    first
        Number of tabs.

    Raises
    ------
    MissingExtraError
        Without rerun-sdk.
    """
    try:
        import rerun as rr  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError(f"a recording for Rerun needs rerun-sdk: {_EXTRA}") from None
    names = _names(scan)
    tabs = [_tab(scanned, names[scanned.position]) for scanned in scan.ranked[:first]]
    with replacing(path) as temporary:
        recording = rr.RecordingStream("oodd-eval scan")
        recording.save(temporary, rr.blueprint.Blueprint(rr.blueprint.Tabs(*tabs)))
        for scanned in scan.episodes:
            name, time = names[scanned.position], scanned.episode.time

            def send(entity: tuple[str, ...], rows: Any, columns: Any) -> None:
                timelines = [rr.TimeColumn("row", sequence=rows)]
                if time is not None:  # noqa: B023  called in this turn
                    timelines.append(rr.TimeColumn("time", duration=time[rows]))  # noqa: B023
                path = rr.new_entity_path([name, *entity])  # noqa: B023
                recording.send_columns(path, timelines, columns)

            usable = np.arange(len(scanned.scores))
            if time is not None:
                usable = usable[np.isfinite(time)]
            for entity, values in _series(scanned, scan).items():
                rows = usable[np.isfinite(values[usable])]
                send(entity, rows, rr.Scalars.columns(scalars=values[rows]))
            if (row := scanned.first) is not None and row in usable:
                text = [", ".join(scanned.suspects)]
                send(("suspects",), np.array([row]), rr.TextLog.columns(text=text))
        recording.flush()
        recording.disconnect()


def _tab(scanned: ScannedEpisode, name: str) -> Any:
    """Return curves of the suspects and the statistic of an episode, about its first odd row."""
    import rerun as rr  # noqa: PLC0415

    row, last, time = scanned.first, len(scanned.scores) - 1, scanned.episode.time
    ends = [0, last] if row is None else [max(0, row - _AROUND), min(last, row + _AROUND)]
    spans = {"row": ("seq", ends)}
    if time is not None and np.isfinite(time[ends]).all():
        spans["time"] = ("seconds", time[ends].tolist())
    edge: Any = rr.TimeRangeBoundary.absolute
    ranges = [
        rr.VisibleTimeRange(timeline, start=edge(**{unit: start}), end=edge(**{unit: stop}))
        for timeline, (unit, (start, stop)) in spans.items()
    ]
    suspects = [["sensors", sensor] for sensor in scanned.suspects or scanned.sensors]
    views = [
        rr.blueprint.TimeSeriesView(
            contents=[rr.new_entity_path([name, *entity]) for entity in entities],
            name=title,
            time_ranges=ranges,
        )
        for title, entities in {"suspects": suspects, "verdict": _CURVES}.items()
    ]
    return rr.blueprint.Vertical(*views, name=name)


def write_mcap(scan: Scan, path: Path) -> None:
    """Write a scan as MCAP with messages in JSON, two topics an episode.

    ``/NAME/sensors`` has the readings by sensor, ``/NAME/oodd`` score, statistic, threshold, alarm
    and suspects, both with a JSON schema. Without time stamps rows are a second apart.

    Parameters
    ----------
    scan
        What to write.
    path
        The file, ``.mcap``.

    Raises
    ------
    MissingExtraError
        Without mcap.
    """
    try:
        from mcap.writer import Writer  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError(f"MCAP needs the library mcap: {_EXTRA}") from None
    readings, names = dict.fromkeys(scan.sensors, _NUMBER), _names(scan)
    with replacing(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="oodd-eval")
        schemas = {}
        for kind, properties in (("sensors", readings), ("oodd", _VERDICT)):
            schema = json.dumps({"type": "object", "properties": properties}).encode()
            schemas[kind] = writer.register_schema(f"oodd.{kind}", "jsonschema", schema)
        for scanned in scan.episodes:
            channels = {
                kind: writer.register_channel(f"/{names[scanned.position]}/{kind}", "json", schema)
                for kind, schema in schemas.items()
            }
            for t, alarm in enumerate(scanned.alarms.tolist()):
                message, stamp = _message(scanned, scan, t, alarm=alarm), _stamp(scanned, t)
                for kind, channel in channels.items():
                    content = json.dumps(without_nan(message[kind])).encode()
                    writer.add_message(channel, stamp, content, stamp, t)
        finish: Any = writer.finish  # without types in the library
        finish()


def _stamp(scanned: ScannedEpisode, row: int) -> int:
    """Return the nanoseconds of a row; without time stamps rows are a second apart."""
    time = scanned.episode.time
    seconds = float(row if time is None else time[row])
    return max(0, as_nanoseconds(seconds)) if math.isfinite(seconds) else 0


def _names(scan: Scan) -> dict[int, str]:
    """Return the names of episodes by place, with their number where a name occurs twice."""
    names = [scanned.episode.name for scanned in scan.episodes]
    return {
        scanned.position: name if names.count(name) == 1 else f"{name} ({i})"
        for i, (name, scanned) in enumerate(zip(names, scan.episodes, strict=True))
    }


def _series(scanned: ScannedEpisode, scan: Scan) -> dict[tuple[str, ...], Any]:
    columns = scanned.episode.observations.T
    readings = {("sensors", name): c for name, c in zip(scan.sensors, columns, strict=True)}
    return readings | {
        ("score",): scanned.scores,
        ("statistic",): scanned.statistic,
        ("threshold",): np.full(len(scanned.scores), scanned.threshold),
        ("alarm",): scanned.alarms.astype(np.float64),
    }


def _message(scanned: ScannedEpisode, scan: Scan, t: int, *, alarm: bool) -> dict[str, Any]:
    """Return the content of both topics at a row."""
    verdict = {
        "score": float(scanned.scores[t]),
        "statistic": float(scanned.statistic[t]),
        "threshold": scanned.threshold,
        "alarm": alarm,
        "suspects": scanned.suspects if alarm else [],
    }
    readings = scanned.episode.observations[t].tolist()
    return {"sensors": dict(zip(scan.sensors, readings, strict=True)), "oodd": verdict}
