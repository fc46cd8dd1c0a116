"""Scans for the viewers that people have open: Rerun and whatever reads MCAP."""

import json
import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from oodd_live.reading import as_nanoseconds

from oodd_eval.data.bounded import without_nan
from oodd_eval.data.files import replacing
from oodd_eval.errors import MissingExtraError
from oodd_logs.scanning.scan import Scan, ScannedEpisode

_EXTRA: Final = "pip install 'oodd-eval[viewers]'"
_NUMBER: Final = {"type": ["number", "null"]}
_VERDICT: Final = {
    "score": _NUMBER,
    "statistic": _NUMBER,
    "threshold": _NUMBER,
    "alarm": {"type": "boolean"},
    "suspects": {"type": "array", "items": {"type": "string"}},
}


def write_rerun(scan: Scan, path: Path) -> None:
    """Write a scan as a recording of Rerun, which no viewer is started for.

    Each episode is an entity ``/NAME`` with ``sensors/SENSOR``, ``score``, ``statistic``,
    ``threshold`` and ``alarm`` over the timelines ``row`` and, where there are stamps, ``time``,
    and a text ``suspects`` at its first odd row.

    Parameters
    ----------
    scan
        What to write.
    path
        The file, ``.rrd``.

    Raises
    ------
    MissingExtraError
        Without rerun-sdk.
    """
    try:
        import rerun as rr  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError(f"a recording for Rerun needs rerun-sdk: {_EXTRA}") from None
    with replacing(path) as temporary:
        recording = rr.RecordingStream("oodd-eval scan")
        recording.save(temporary)
        for name, scanned in _named(scan):

            def send(entity: tuple[str, ...], rows: Any, columns: Any) -> None:
                timelines = [rr.TimeColumn("row", sequence=rows)]
                if (time := scanned.episode.time) is not None:  # noqa: B023  called in this turn
                    timelines.append(rr.TimeColumn("time", duration=time[rows]))
                path = rr.new_entity_path([name, *entity])  # noqa: B023
                recording.send_columns(path, timelines, columns)

            usable = np.arange(len(scanned.scores))
            if scanned.episode.time is not None:
                usable = usable[np.isfinite(scanned.episode.time)]
            for entity, values in _series(scanned, scan).items():
                rows = usable[np.isfinite(values[usable])]
                send(entity, rows, rr.Scalars.columns(scalars=values[rows]))
            if (first := scanned.first) is not None and first in usable:
                text = [", ".join(scanned.suspects)]
                send(("suspects",), np.array([first]), rr.TextLog.columns(text=text))
        recording.flush()
        recording.disconnect()


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
    readings = dict.fromkeys(scan.sensors, _NUMBER)
    with replacing(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="oodd-eval")
        schemas = {}
        for kind, properties in (("sensors", readings), ("oodd", _VERDICT)):
            schema = json.dumps({"type": "object", "properties": properties}).encode()
            schemas[kind] = writer.register_schema(f"oodd.{kind}", "jsonschema", schema)
        for name, scanned in _named(scan):
            channels = {
                kind: writer.register_channel(f"/{name}/{kind}", "json", schema)
                for kind, schema in schemas.items()
            }
            for t, alarm in enumerate(scanned.alarms.tolist()):
                time, message = scanned.episode.time, _message(scanned, scan, t, alarm=alarm)
                seconds = float(t if time is None else time[t])
                stamp = max(0, as_nanoseconds(seconds)) if math.isfinite(seconds) else 0
                for kind, channel in channels.items():
                    content = json.dumps(without_nan(message[kind])).encode()
                    writer.add_message(channel, stamp, content, stamp, t)
        finish: Any = writer.finish  # without types in the library
        finish()


def _named(scan: Scan) -> list[tuple[str, ScannedEpisode]]:
    """Return the episodes by name, with their number where a name occurs twice."""
    names = [scanned.episode.name for scanned in scan.episodes]
    return [
        (name if names.count(name) == 1 else f"{name} ({i})", scanned)
        for i, (name, scanned) in enumerate(zip(names, scan.episodes, strict=True))
    ]


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
