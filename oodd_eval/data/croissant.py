"""Metadata of a split in Croissant 1.1, the JSON-LD that searches for data sets read.

https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html has the format, and
https://docs.mlcommons.org/croissant/docs/croissant-rai-spec.html what is said under ``rai:``.
"""

import hashlib
import json
import tomllib
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from oodd_eval._version import repository
from oodd_eval.data import layout
from oodd_eval.data.facts import LICENCE, PROTOCOL, title_of
from oodd_eval.data.files import write_text
from oodd_eval.data.split import Split, published_digests
from oodd_eval.errors import OutputError

CROISSANT: Final = "croissant.json"

_TERMS: Final = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileObject fileProperty "
    "fileSet format includes isArray isLiveDataset jsonPath key md5 parentField path recordSet "
    "references regex repeated replace samplingRate separator source subField transform"
)
_CONTEXT: Final[dict[str, Any]] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    **{term: f"cr:{term}" for term in _TERMS.split()},
    **{term: {"@container": "@language"} for term in ("name", "description")},
    **{term: {"@id": f"cr:{term}", "@type": "@json"} for term in ("data", "examples")},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
}
_TYPES: Final = {"<f4": "cr:Float32", "<i8": "cr:Int64", "|u1": "cr:UInt8", "|S": "sc:Text"}
_TEXTS: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_SOFTWARE: Final = (
    "@software{oodd_eval, author = {{The oodd-eval developers}}, title = {oodd-eval: evaluation of "
    "detectors of out-of-distribution dynamics}, version = {%s}, year = {%s}, "
    "note = {Split %s, digest %s, protocol %s}}"
)
_REQUIRED: Final = ("creator", "license", "url")
_SPDX: Final = {"MIT", "Apache-2.0", "BSD-3-Clause", "GPL-3.0", "CC-BY-4.0", "CC0-1.0"}


class WrittenMetadata(NamedTuple):
    """The file with a split's metadata, and what the format requires that is not known."""

    path: Path
    lacking: list[str]


def write(split: Split, directory: Path | None = None, *, url: str = "") -> WrittenMetadata:
    """Write a split's metadata as ``croissant.json``.

    Parameters
    ----------
    split
        The split, whose files are read for their digests.
    directory
        Where to write; by default beside the manifest, to which addresses in it are relative.
    url
        Address of the directory with the split's files, for those who fetch them.

    Returns
    -------
    WrittenMetadata

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    described = describe(split, day=datetime.now(UTC).date().isoformat(), url=url)
    path = (directory or split.path) / CROISSANT
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(described, indent=1, ensure_ascii=False) + "\n")
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
    return WrittenMetadata(path, [key for key in _REQUIRED if key not in described])


def describe(split: Split, *, day: str, url: str = "") -> dict[str, Any]:
    """Return a split's metadata; `day` is the date of publication, in ISO 8601.

    Creator, licence and address are left out where they are not known.
    """
    manifest, environments = split.manifest, split.manifest["environments"]
    logs = [facts for entry in environments.values() if (facts := layout.log_facts(entry))]
    ours = split.digest == published_digests().get(manifest["name"]) or "licence" in manifest
    licences = [manifest.get("licence", LICENCE)] if ours else [facts.licence for facts in logs]
    sources = [facts.source for facts in logs if facts.source.startswith(("http:", "https:"))]
    citation = " ".join(dict.fromkeys(facts.citation for facts in logs if facts.citation))
    cited = citation or (
        _SOFTWARE
        % (manifest["versions"]["oodd-eval"], day[:4], split.name, split.digest[:12], PROTOCOL)
        if ours
        else ""
    )
    kinds = ", ".join(split.groups) or "none"
    described = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        "name": f"oodd-eval-{manifest['name']}",
        "description": f"Split {split.name} of oodd-eval, for detectors of out-of-distribution "
        f"dynamics: sensor rows and actions of {', '.join(map(title_of, split.environments))}. "
        "Training and calibration parts are nominal, test parts nominal and anomalous. "
        f"Anomalies: {kinds}. SHA-256 of all content: {split.digest}.",
        "url": url or (repository() if ours else next(iter(sources), "")),
        "license": [_licence(name) for name in dict.fromkeys(filter(None, licences))],
        "creator": {"@type": "sc:Organization", "name": "The oodd-eval developers"} if ours else "",
        "citeAs": cited,
        "datePublished": day,
        "version": f"{PROTOCOL}.0.0",
        "keywords": ["anomaly detection", "out-of-distribution dynamics", "time series"],
        "isLiveDataset": False,
        **({} if logs else _TEXTS["recorded"]),
        "distribution": [*_files(split, url)],
        "recordSet": [*_tables(environments), *(_episodes(split, e) for e in split.environments)],
    }
    return {key: value for key, value in described.items() if value not in ("", [])}


def _licence(name: str) -> str:
    """Return the address of a licence that SPDX lists, else its name."""
    identifier = name.replace(" ", "-")
    return f"https://spdx.org/licenses/{identifier}.html" if identifier in _SPDX else name


def _files(split: Split, url: str) -> Iterator[dict[str, Any]]:
    entries = split.manifest["environments"]
    hdf5 = {entries[e]["file"]: "application/x-hdf5" for e in split.environments}
    for name, form in {layout.MANIFEST: "application/json", **hdf5}.items():
        with (split.path / name).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        yield {
            "@type": "cr:FileObject",
            "@id": name,
            "name": name,
            "contentUrl": f"{url.rstrip('/')}/{name}" if url else name,
            "contentSize": f"{(split.path / name).stat().st_size} B",
            "encodingFormat": form,
            "sha256": digest,
        }


def _tables(environments: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the parts of all environments and their columns, as records that are data here."""
    parts = [
        {"environment": name, "part": part, **group}
        for name, entry in environments.items()
        for part, group in entry["groups"].items()
    ]
    columns = [
        {"environment": name, "kind": kind, "position": i, "name": row["name"], "unit": row["unit"]}
        for name, entry in environments.items()
        for kind in ("sensors", "actions")
        for i, row in enumerate(entry[kind])
    ]
    text = "Parts of each environment: episodes, transitions and the digest of their content"
    yield _table("manifest/parts", text, parts)
    text = "Names and units of the columns of observations (sensors) and of actions"
    yield _table("manifest/columns", text, columns)


def _table(name: str, description: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    types = {str: "sc:Text", int: "sc:Integer"}
    fields = [
        {"@type": "cr:Field", "@id": f"{name}/{key}", "name": key, "dataType": types[type(value)]}
        for key, value in rows[0].items()
    ]
    data = [{f"{name}/{key}": value for key, value in row.items()} for row in rows]
    head = {"@type": "cr:RecordSet", "@id": name, "name": name, "description": description}
    return head | {"field": fields, "data": data}


def _episodes(split: Split, environment: str) -> dict[str, Any]:
    """Return the record set of an environment's file, a record for each of its parts."""
    entry = split.manifest["environments"][environment]
    paired = layout.is_paired(entry)
    dtypes = layout.dtypes_of("train", paired=paired)
    if split.conditions(environment):
        dtypes |= layout.dtypes_of("test", paired=paired)
    widths = {"observations": len(entry["sensors"]), "actions": len(entry["actions"]),
              "intervals": 2}  # fmt: skip
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"{environment}/{name}",
            "name": name,
            "description": _TEXTS["datasets"][name],
            "dataType": _TYPES[dtype],
            "isArray": True,
            "arrayShape": f"-1,{widths[name]}" if name in widths else "-1",
            "source": {"fileObject": {"@id": entry["file"]}, "extract": {"column": name}},
        }
        for name, dtype in dtypes.items()
    ]
    return {
        "@type": "cr:RecordSet",
        "@id": environment,
        "name": environment,
        "description": f"{title_of(environment)}: a record for each part, which is a group of "
        f"{entry['file']} named in manifest/parts; a field is the data set of that name in it",
        "field": fields,
    }
