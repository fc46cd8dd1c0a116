"""Fetching takes over nothing that is not as the manifest says; exports are what Minari opens."""

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import http.server
import io
import json
import os
import shutil
import tarfile
import threading
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers_split import edit_manifest, make_split
from oodd_logs import minari_files

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import fetch as fetching
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.fetch import fetch
from oodd_eval.data.parts import parts_of
from oodd_eval.data.split import SHIPPED, split_directories
from oodd_eval.errors import DigestError, OutputError, SplitError, SplitNotFoundError, UsageError


@pytest.fixture
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def copy(tiny_split, tmp_path):
    """A copy of the tiny split that a test may damage."""
    return Path(shutil.copytree(tiny_split, tmp_path / "copy"))


def pack(directory, archive, folder="tiny/"):
    """Write a tar or zip archive of a split's directory."""
    files = sorted(directory.iterdir())
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive, "w") as packed:
            for file in files:
                packed.write(file, folder + file.name)
    else:
        mode = "w:gz" if archive.name.endswith("gz") else "w"
        with tarfile.open(archive, mode) as packed:
            for file in files:
                packed.add(file, folder + file.name)
    return archive


def is_installed(home, tiny_split):
    split = load_split("tiny")
    return (
        split.path == home / "tiny"
        and split.digest == load_split(tiny_split).digest
        and all(check.ok for check in split.verify())
        and sorted(p.name for p in home.iterdir()) == ["tiny"]
        and len(list((home / "tiny").iterdir())) == 3
    )


# Where from


@pytest.mark.parametrize(
    ("archive", "scheme", "folder"),
    [("", "", ""), ("", "file://", ""), ("x.tar", "", "tiny/"), ("x.tar", "", ""),
     ("x.tgz", "file://", "tiny/"), ("x.zip", "", "tiny/"), ("no-suffix", "", "tiny/")],
)  # fmt: skip
def test_a_split_is_fetched_from_a_directory_or_an_archive(
    tiny_split, home, tmp_path, archive, scheme, folder
):
    source = pack(tiny_split, tmp_path / archive, folder) if archive else tiny_split
    assert not fetch(f"{scheme}{source}").already
    assert is_installed(home, tiny_split)


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves files, with ranges; may break off, and writes down what it was asked for."""

    def do_GET(self):
        server = self.server
        begin = self.headers.get("Range")
        server.asked.append((self.path, begin))
        try:
            content = Path(self.translate_path(self.path)).read_bytes()
        except OSError:
            self.send_error(404)
            return
        if begin and server.ranges:
            start = int(begin.removeprefix("bytes=").removesuffix("-"))
            if start >= len(content):
                self.send_error(416)
                return
            content = content[start:]
            self.send_response(206)
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        most = server.breaks.pop(0) if server.breaks and not self.path.endswith("json") else None
        self.wfile.write(content[:most])

    def log_message(self, *_):
        pass


@pytest.fixture
def web(tmp_path):
    """A web server on loopback whose root is ``tmp_path/www``."""
    (tmp_path / "www").mkdir()
    handler = functools.partial(Handler, directory=str(tmp_path / "www"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.asked, server.breaks, server.ranges = [], [], True
        server.root = tmp_path / "www"
        server.address = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("kind", ["directory", "archive"])
def test_a_download_that_broke_off_goes_on(tiny_split, home, web, ranges, kind):
    web.ranges = ranges
    if kind == "archive":
        size = pack(tiny_split, web.root / "tiny.tar").stat().st_size
        place, web.breaks = f"{web.address}/tiny.tar", [size - 5000]
    else:
        shutil.copytree(tiny_split, web.root / "tiny")
        size = (tiny_split / "cartpole.h5").stat().st_size
        place, web.breaks = f"{web.address}/tiny", [size - 5000]
    with pytest.raises(SplitError, match=r"broke off .*run the same command again"):
        fetch(place)
    assert split_directories().keys() == {"mini"}
    fetch(place)
    assert is_installed(home, tiny_split)
    assert f"bytes={size - 5000}-" in {begin for _, begin in web.asked}


def test_files_that_are_there_and_whole_are_not_fetched_again(tiny_split, home, web):
    shutil.copytree(tiny_split, web.root / "tiny")
    web.breaks = [None, 100]
    with pytest.raises(SplitError, match="broke off"):
        fetch(f"{web.address}/tiny/")
    web.asked.clear()
    fetch(f"{web.address}/tiny/")
    assert [path for path, _ in web.asked] == ["/tiny/manifest.json", "/tiny/hopper.h5"]
    assert is_installed(home, tiny_split)


@pytest.mark.parametrize(
    ("address", "error"),
    [("{web}/none", SplitNotFoundError), ("http://127.0.0.1:9/x.tar", SplitError),
     ("ftp://h/x.tar", UsageError), ("s3://b/x", UsageError), ("/no/such", SplitNotFoundError)],
)  # fmt: skip
def test_where_nothing_can_be_fetched_the_address_is_named(home, web, address, error):
    address = address.format(web=web.address)
    with pytest.raises(error, match=address):
        fetch(address)
    assert not list(home.iterdir())


# What is refused; after each of these nothing is installed.


def lead_out(copy):
    edit_manifest(copy, lambda m: m["environments"]["hopper"].update(file="../../hopper.h5"))


def change_content(copy):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        file["train/observations"][5, 5] += 1


def make_long(copy):
    with (copy / "hopper.h5").open("ab") as file:
        file.truncate(10**9)  # a sparse file takes no room here


def remove(copy):
    (copy / "hopper.h5").unlink()


def pipe(copy):
    remove(copy)
    os.mkfifo(copy / "hopper.h5")


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lead_out, SplitError, "expected 'hopper.h5'"),
        (change_content, DigestError, r"hopper.h5, group train: .*expected \w{64}, found"),
        (make_long, SplitError, r"hopper\.h5 has more than the \d{8} bytes that"),
        (remove, SplitNotFoundError, r"hopper\.h5"),
        (pipe, SplitNotFoundError, r"hopper\.h5"),
    ],
)
def test_what_is_not_as_its_manifest_says_is_refused(copy, home, spoil, error, message):
    spoil(copy)
    with pytest.raises(error, match=message):
        fetch(str(copy))
    assert split_directories().keys() == {"mini"}
    assert not list(home.glob("*/manifest.json"))


def test_another_digest_than_the_expected_one_is_refused(tiny_split, home, monkeypatch):
    with pytest.raises(DigestError, match=r"has the digest \w{64}, expected 0000"):
        fetch(str(tiny_split), digest="0" * 64)
    assert not list(home.iterdir())
    fetch(str(tiny_split), digest=load_split(tiny_split).digest)
    assert is_installed(home, tiny_split)
    monkeypatch.setenv("OODD_EVAL_DATA", str(home / "tiny" / "manifest.json" / "home"))
    with pytest.raises(OutputError, match="home' cannot be written to"):
        fetch(str(tiny_split))


def zip_link(name):
    link = zipfile.ZipInfo(name)
    link.external_attr = 0o120777 << 16
    return link


def member(name, *, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.size = kind, link, 0 if link else 1
    return info


@pytest.mark.parametrize(
    "info",
    [
        member("../../escaped"),
        member("/etc/escaped"),
        member("tiny/..\\escaped"),
        member("tiny/x", kind=tarfile.SYMTYPE, link="/etc/passwd"),
        member("tiny/x", kind=tarfile.LNKTYPE, link="tiny/hopper.h5"),
        member("tiny/x", kind=tarfile.CHRTYPE, link="x"),
        member("tiny/hopper.h5"),
        member("other/manifest.json"),
        zipfile.ZipInfo("../escaped"),
        zip_link("tiny/link"),
    ],
    ids=lambda info: getattr(info, "name", "zip"),
)
def test_an_archive_with_tricks_is_refused(tiny_split, home, tmp_path, info):
    if isinstance(info, zipfile.ZipInfo):
        archive = pack(tiny_split, tmp_path / "x.zip")
        with zipfile.ZipFile(archive, "a") as packed:
            packed.writestr(info, "/etc/passwd")
    else:
        archive = pack(tiny_split, tmp_path / "x.tar")
        with tarfile.open(archive, "a") as packed:
            packed.addfile(info, io.BytesIO(b"x"))
    with pytest.raises(SplitError, match=r"refused|expected one"):
        fetch(str(archive))
    assert not list(home.iterdir())
    assert not list(tmp_path.rglob("escaped"))


def bomb(tmp_path, name):
    """Write an archive that announces more than an archive may have, and holds next to nothing."""
    path = tmp_path / name
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr("tiny/zeros", bytes(10**6))
        return path
    with tarfile.open(path, "w:gz") as packed:
        info = tarfile.TarInfo("tiny/zeros")
        info.size = 10**6
        packed.addfile(info, io.BytesIO(bytes(10**6)))
    return path


@pytest.mark.parametrize("name", ["x.tar.gz", "x.zip"])
def test_an_archive_that_unpacks_without_end_is_refused(home, tmp_path, monkeypatch, name):
    monkeypatch.setattr(fetching, "ARCHIVE_BYTES", 10**6 - 1)
    path = bomb(tmp_path, name)
    with pytest.raises(SplitError, match=f"{name} unpacks to more than 999999 bytes: refused"):
        fetch(str(path))
    assert not list(home.iterdir())


def test_a_download_without_end_is_given_up(tiny_split, home, web, monkeypatch):
    pack(tiny_split, web.root / "tiny.tar")
    monkeypatch.setattr(fetching, "ARCHIVE_BYTES", 1000)
    with pytest.raises(SplitError, match="has more than the 1000 bytes that it may have: refused"):
        fetch(f"{web.address}/tiny.tar")
    assert not list(home.rglob("archive"))


def test_a_fetch_leaves_some_of_the_disk_free(tiny_split, home, web, monkeypatch):
    """Not even the begin of a download stays, which a later call would go on with."""
    free = shutil.disk_usage(tiny_split).free
    monkeypatch.setattr(fetching, "SPARE_BYTES", 2 * free)
    pack(tiny_split, web.root / "tiny.tar")
    for source in (str(tiny_split), f"{web.address}/tiny.tar"):
        with pytest.raises(OutputError, match=r"would leave less than \d+ bytes of disk free"):
            fetch(source)
        assert not list(home.rglob("*.h5*"))
        assert not list(home.rglob("archive"))


@pytest.mark.parametrize("name", ["x.tar", "x.tar.gz", "x.zip"])
@pytest.mark.parametrize("share", [0.0, 0.9])
def test_a_cut_off_archive_is_refused(tiny_split, home, tmp_path, name, share):
    archive = pack(tiny_split, tmp_path / name)
    content = archive.read_bytes()
    archive.write_bytes(content[: int(share * len(content))])
    with pytest.raises(SplitError) as refused:
        fetch(str(archive))
    assert "\n" not in str(refused.value)
    assert not list(home.glob("*/manifest.json"))


# What is there already


def test_a_damaged_copy_is_replaced_and_another_split_is_not(tiny_split, home, tmp_path):
    fetch(str(tiny_split))
    assert fetch(str(tiny_split)).already
    damaged = home / "tiny" / "hopper.h5"
    damaged.write_bytes(damaged.read_bytes()[:200])
    fetch(str(tiny_split))
    assert is_installed(home, tiny_split)
    shutil.rmtree(home / "tiny")
    make_split(home / "tiny", ["hopper"], seed_base=8)
    kept = load_split("tiny").digest
    with pytest.raises(UsageError, match="exists and is not this split: remove it, or name"):
        fetch(str(tiny_split))
    assert load_split("tiny").digest == kept
    fetch(str(tiny_split), output=tmp_path / "beside" / "tiny")
    assert load_split(tmp_path / "beside" / "tiny").digest == load_split(tiny_split).digest
    (home / "tiny" / "manifest.json").write_bytes(b"{")
    with pytest.raises(UsageError, match="exists and is not this split"):
        fetch(str(tiny_split))


def test_a_shipped_split_is_there_already_and_its_name_taken(home, tmp_path):
    found = fetch(str(SHIPPED / "mini"))
    assert (found.already, found.split.path) == (True, SHIPPED / "mini")
    other = make_split(tmp_path / "mini", ["hopper"], name="mini")
    with pytest.raises(UsageError, match="comes with the package"):
        fetch(str(other))


def test_two_fetches_of_the_same_do_not_meet(tiny_split, home):
    staging = home / ".fetch" / hashlib.sha256(str(tiny_split).encode()).hexdigest()[:16]
    staging.mkdir(parents=True)
    descriptor = os.open(staging, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        with pytest.raises(OutputError, match="another process is fetching the same"):
            fetch(str(tiny_split))
    finally:
        os.close(descriptor)


def test_the_command_line_fetches_and_says_where(tiny_split, home, capsys):
    assert main(["data", "fetch", str(tiny_split)]) == 0
    assert main(["data", "fetch", "-q", str(tiny_split)]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "cartpole.h5 verified hopper.h5 verified split tiny, digest " in output
    assert "is already in" in output
    assert main(["data", "fetch", "/no/such"]) == 4


# Minari


@pytest.mark.parametrize("environment", ["cartpole", "hopper"])
def test_minari_reads_every_part_of_the_split(tiny_split, tmp_path, monkeypatch, environment):
    export = ["data", "export", str(tiny_split), "--format", "minari", "--env", environment]
    assert main([*export, "--output", str(tmp_path)]) == 0
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    info, onehot = ENVIRONMENTS[environment], environment == "cartpole"
    columns = [[dataclasses.asdict(q) for q in kind] for kind in (info.sensors, info.actions)]
    with contextlib.closing(load_split(tiny_split).environment(environment)) as data:
        parts = {"train": data.train, **parts_of(data, data.anomalies)}
        named = {f"oodd/tiny/{environment}/{n.replace('/', '-')}-v0": n for n in parts}
        assert set(library.list_local_datasets()) == set(named)
        for name, part in ((name, parts[part]) for name, part in named.items()):
            dataset = library.load_dataset(name)
            space = "Discrete(2)" if onehot else "Box(-1.0, 1.0, (3,), float32)"
            assert repr(dataset.action_space) == space
            assert [dataset.storage.metadata[kind] for kind in ("sensors", "actions")] == columns
            assert dataset.total_steps == part.lengths.sum()
            for i, (read, x) in enumerate(zip(dataset.iterate_episodes(), part, strict=True)):
                actions = x.actions.argmax(axis=1) if onehot else x.actions
                assert all(row in dataset.observation_space for row in read.observations)
                assert all(row in dataset.action_space for row in read.actions)
                np.testing.assert_array_equal(read.observations, x.observations)
                np.testing.assert_array_equal(read.actions, actions)
                np.testing.assert_array_equal(read.rewards, part.rewards(i))
                # The synthetic split ends by its cap alone.
                assert (read.terminations.sum(), read.truncations.sum()) == (0, 1)
            stored = [*dataset.storage.get_episode_metadata(dataset.episode_indices)]
            assert [m["seed"] for m in stored] == part.seeds.tolist()
            if "test-gravity" in name:
                assert [m["onset"] for m in stored] == part.onsets.tolist()
                assert [m["effect"] for m in stored] == part.effects.tolist()
                assert [json.loads(m["parameters"]) for m in stored] == part.parameters
    assert main([*export, "--output", str(tmp_path)]) == 4  # it does not overwrite


def test_an_ended_episode_is_terminated_and_a_capped_one_truncated(tmp_path):
    split = make_split(tmp_path / "s", ["cartpole"])

    class Ended(type(load_split(split).environment("cartpole").train)):
        terminated = property(lambda self: np.arange(len(self)) % 2 == 0)

    data = load_split(split).environment("cartpole")
    part = Ended(data._parts, "train")
    minari_files._write(tmp_path / "d", "x-v0", data, part, load_split(split))
    with h5py.File(tmp_path / "d" / "x-v0" / "data" / "main_data.hdf5") as file:
        for i in range(len(part)):
            episode, last = file[f"episode_{i}"], int(part.lengths[i]) - 1
            assert np.flatnonzero(episode["terminations"]).tolist() == [last] * (i % 2 == 0)
            assert np.flatnonzero(episode["truncations"]).tolist() == [last] * (i % 2)
    data.close()


def test_a_failed_export_leaves_no_half_dataset(tiny_split, tmp_path, monkeypatch):
    def fail(group, i, *_, **__):
        if i == 3:
            raise OSError("disk full")

    monkeypatch.setattr(minari_files, "_episode", fail)
    with pytest.raises(OutputError, match="cannot be written to: disk full"):
        minari_files.export(load_split(tiny_split), tmp_path, environments=["hopper"])
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not list((tmp_path / "oodd" / "tiny" / "hopper").iterdir())
