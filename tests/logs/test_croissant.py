"""Metadata of splits: mlcroissant reads them, and they are true of the files; the licence."""

import dataclasses
import hashlib
import json
import tomllib
import warnings
from pathlib import Path

import h5py
import pytest
import yaml
from helpers_logs import UNPAIRED, make_log_split

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import croissant, layout
from oodd_eval.data.facts import LICENCE, SPLITS
from oodd_eval.data.info import describe
from oodd_eval.data.split import SHIPPED

ROOT = Path(__file__).parents[2]


def exported(split, directory, *further):
    export = ["data", "export", str(split), "--format", "croissant", "--output", str(directory)]
    assert main([*export, *further]) == 0
    return json.loads((directory / "croissant.json").read_text())


def references(node, key="@id"):
    """All references in a document: objects with an identifier and nothing else."""
    if isinstance(node, dict):
        if set(node) == {key}:
            yield node[key]
        for value in node.values():
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def identifiers(node):
    if isinstance(node, dict):
        if "@id" in node and "@type" in node:
            yield node["@id"]
        for key, value in node.items():
            if key != "@context":
                yield from identifiers(value)
    elif isinstance(node, list):
        for value in node:
            yield from identifiers(value)


def test_mlcroissant_reads_the_metadata_of_mini(tmp_path):
    """The library that searches for data sets read with finds no problem, and the same records."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of its dependencies
        library = pytest.importorskip(
            "mlcroissant", reason="it is among the dependencies of development (extra dev)"
        )
        dataset = library.Dataset(str(SHIPPED / "mini" / "croissant.json"))
        assert dataset.metadata.ctx.issues.report() == ""
        parts = [*dataset.records("manifest/parts")]
    metadata, split = dataset.metadata, load_split("mini")
    assert metadata.license == ["https://spdx.org/licenses/MIT.html"]
    assert [person.name for person in metadata.creators] == ["The oodd-eval developers"]
    files = {file.id: file.sha256 for file in metadata.file_objects}
    names = {"manifest.json", *(f"{e}.h5" for e in split.environments)}
    assert files == {
        name: hashlib.sha256((SHIPPED / "mini" / name).read_bytes()).hexdigest() for name in names
    }
    sizes = {
        tuple(row[f"manifest/parts/{key}"] for key in ("environment", "part", "trajectories"))
        for row in parts
    }
    assert sizes == {
        (name, part, group["trajectories"])
        for name, entry in split.manifest["environments"].items()
        for part, group in entry["groups"].items()
    }
    assert metadata.data_limitations
    assert metadata.personal_sensitive_information


def test_committed_metadata_are_those_of_the_committed_split():
    """`oodd-eval data export mini --format croissant --output FOLDER` writes them, of today."""
    committed = json.loads((SHIPPED / "mini" / "croissant.json").read_text())
    split = load_split(SHIPPED / "mini")
    assert committed == croissant.describe(split, day=committed["datePublished"])


def test_fields_are_the_datasets_of_the_files(tiny_split, tmp_path):
    described = exported(tiny_split, tmp_path)
    split = load_split(tiny_split)
    records = {record["@id"]: record for record in described["recordSet"]}
    kinds = {"cr:Float32": "f4", "cr:Int64": "i8", "cr:UInt8": "u1", "sc:Text": "S"}
    for environment in split.environments:
        fields = {field["name"]: field for field in records[environment]["field"]}
        with h5py.File(tiny_split / f"{environment}.h5") as file:
            for part in ("train", "calibration", "test/nominal", "test/iid"):
                assert set(file[part]) <= set(fields)
                for name, stored in file[part].items():
                    field = fields[name]
                    assert stored.dtype.str[1:].startswith(kinds[field["dataType"]])
                    shape = [int(size) for size in field["arrayShape"].split(",")]
                    assert shape == [-1, *stored.shape[1:]]
                    assert field["source"]["extract"] == {"column": name}
            assert set(file["test/iid"]) == set(fields)


def test_every_reference_leads_to_one_object(tiny_split, tmp_path):
    described = exported(tiny_split, tmp_path)
    ids = [*identifiers(described)]
    assert len(ids) == len(set(ids))
    assert set(references(described)) == {f"{e}.h5" for e in load_split(tiny_split).environments}
    # As the specification's vocabulary has it, each term is in the context or of schema.org.
    assert {"recordSet", "field", "source", "citeAs"} < set(described["@context"])


def test_addresses_are_relative_or_below_the_one_that_is_named(tiny_split, tmp_path, capsys):
    files = exported(tiny_split, tmp_path)["distribution"]
    assert all(file["contentUrl"] == file["name"] for file in files)
    said = capsys.readouterr().err
    assert "creator, license, url; before publishing name the address with --url and" in said
    described = exported(tiny_split, tmp_path, "--url", "https://example.org/tiny/")
    assert described["url"] == "https://example.org/tiny/"
    assert {file["contentUrl"] for file in described["distribution"]} == {
        f"https://example.org/tiny/{file['name']}" for file in files
    }


def test_nothing_is_stated_of_splits_of_others(tiny_split, tmp_path):
    """Licence and creator of a split of one's own are not the project's to name."""
    described = exported(tiny_split, tmp_path)
    assert not {"license", "creator", "citeAs"} & set(described)
    assert "licence" not in load_split(tiny_split).manifest
    assert all(value for value in described.values() if not isinstance(value, bool))


def test_logs_have_the_licence_and_citation_of_their_recipe(tmp_path):
    facts = dataclasses.replace(
        UNPAIRED, source="https://example.org/arm", licence="CC BY 4.0", citation="Someone, 2024"
    )
    split = make_log_split(tmp_path / "arm", facts)
    described = exported(split, tmp_path / "metadata")
    assert described["license"] == ["https://spdx.org/licenses/CC-BY-4.0.html"]
    assert described["citeAs"] == "Someone, 2024"
    assert described["url"] == "https://example.org/arm"
    assert "rai:dataCollection" not in described


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "croissant"], "name a folder for others with --output"),
        (["--format", "croissant", "--env", "hopper"], "metadata are of a whole split"),
        (["--format", "minari"], "needs --output"),
        (["--format", "minari", "--output", "x", "--url", "y"], "has no --url"),
    ],
)
def test_options_of_the_other_format_are_refused(arguments, message, capsys):
    assert main(["data", "export", "mini", *arguments]) == 4
    assert message in capsys.readouterr().err


def test_licence_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == LICENCE
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["license"] == LICENCE
    assert (ROOT / "LICENSE").read_text().startswith(f"{LICENCE} License")
    split = load_split("mini")
    assert split.manifest["licence"] == LICENCE
    assert f"\nlicence {LICENCE}\n" in describe(split)


def test_the_licence_of_a_published_split_is_in_its_manifest_and_not_in_its_digest(tmp_path):
    entries = load_split("mini").manifest["environments"]
    layout.write_manifest(tmp_path, SPLITS["mini"], entries, 2, {})
    manifest = layout.read_manifest(tmp_path)
    assert manifest["licence"] == LICENCE
    assert manifest["digest"] == load_split("mini").digest
    older = {key: value for key, value in manifest.items() if key != "licence"}
    (tmp_path / "manifest.json").write_text(json.dumps(older))
    assert layout.read_manifest(tmp_path)["digest"] == manifest["digest"]
