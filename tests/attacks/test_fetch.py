"""Servers and archives of strangers: a fetch ends, says why, and keeps nothing doubtful."""

import http.server
import io
import shutil
import tarfile
import threading
import zipfile

import pytest
from helpers_split import edit_manifest, make_split

from oodd_eval.cli.main import main
from oodd_eval.data import fetch as fetching
from oodd_eval.data.fetch import fetch
from oodd_eval.data.split import Split
from oodd_eval.errors import OoddError, SplitError


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    place = tmp_path_factory.mktemp("fetched") / "tiny"
    return make_split(place, ("cartpole",), train=2, calibration=2, test=2)


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def serve():
    """Start servers on loopback that answer with what a function writes to the connection."""
    servers = []

    def start(answer):
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                answer(self.wfile.write)

            def log_message(self, *_):
                pass

        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_address[1]}"

    yield start
    for server, thread in servers:
        server.shutdown()
        server.server_close()
        thread.join()


ADDRESSES = ["http://[::1", "http://[::1]x/", "http://h:99999999/x", "http:///x",
             "http://127.0.0.1:1/\u00fc", "http://127.0.0.1:1/\x1b[2J",
             "http://" + "x" * 300 + "/"]  # fmt: skip
ANSWERS = {
    "a status": b"HTTP/1.1 500 \x1b[2Jgone\x07\r\n\r\n",
    "no status": b"\x1b[31mred\r\n\r\n",
    "no number": b"HTTP/1.1 \x1b[2J OK\r\n\r\n",
    "a redirect": b"HTTP/1.1 302 x\r\nLocation: ftp://h/\x1b[2J\r\n\r\n",
    "nothing": b"",
    "too many headers": b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 200 + b"\r\n",
    "a long header": b"HTTP/1.1 200 OK\r\na: " + b"b" * 70_000 + b"\r\n\r\n",
    "a wrong length": b"HTTP/1.1 200 OK\r\nContent-Length: x\r\n\r\n{",
    "a wrong chunk": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n\x1b[2J\r\n",
}  # fmt: skip


@pytest.mark.parametrize("said", [*ADDRESSES, *ANSWERS])
def test_no_address_and_no_answer_steers_the_terminal(serve, capsys, said):
    address = serve(lambda write: write(ANSWERS[said])) if said in ANSWERS else said
    assert main(["data", "fetch", address]) == 4
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.parametrize("target", ["ftp://127.0.0.1/x", "file:///etc/passwd"])
def test_a_redirect_to_another_scheme_is_refused(serve, target):
    address = serve(lambda write: write(f"HTTP/1.1 302 x\r\nLocation: {target}\r\n\r\n".encode()))
    with pytest.raises(SplitError, match=r"leads to .*refused|answers 302"):
        fetch(address)


def test_a_redirect_from_https_to_http_is_refused():
    request = fetching.urllib.request.Request("https://example.org/x")
    with pytest.raises(SplitError, match=r"leads to http://.*expected https: refused"):
        fetching._Redirects().redirect_request(request, None, 302, "x", {}, "http://h/x")


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_a_file_that_ended_its_check_is_not_kept(small, home, monkeypatch, error):
    def end(*_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(Split, "environment", end)
        with pytest.raises(error):
            fetch(str(small))
    assert not list(home.rglob("*.h5"))
    assert fetch(str(small)).split.path == home / "tiny"


def test_a_check_that_ended_the_process_is_done_anew(small, home, monkeypatch):
    """What a killed process leaves is there when the next one begins."""
    with monkeypatch.context() as patch:
        patch.setattr(Split, "environment", lambda *_: 1 / 0)
        patch.setattr(fetching.shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(ZeroDivisionError):
            fetch(str(small))
    assert list(home.rglob(".doubtful.*/*.h5"))
    assert fetch(str(small)).split.path == home / "tiny"


def zipped(directory, archive):
    with zipfile.ZipFile(archive, "w") as packed:
        for file in directory.iterdir():
            packed.write(file, file.name)


def broken_directory(directory, archive):
    zipped(directory, archive)
    content = bytearray(archive.read_bytes())
    content[-30] ^= 0xFF
    archive.write_bytes(content)


def unknown_method(directory, archive):
    zipped(directory, archive)
    first, *rest = archive.read_bytes().split(b"PK\x01\x02")
    archive.write_bytes(b"PK\x01\x02".join([first, *(r[:6] + b"\x63" + r[7:] for r in rest)]))


def encrypted(directory, archive):
    zipped(directory, archive)
    content = archive.read_bytes()
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        parts = content.split(mark)
        content = mark.join([parts[0], *(p[: flags - 4] + b"\x01" + p[flags - 3 :]
                                         for p in parts[1:])])  # fmt: skip
    archive.write_bytes(content)


def long_member(kind):
    """Say that a header is a gigabyte."""

    def attack(_directory, archive):
        info = tarfile.TarInfo("x")
        info.type, info.size = kind, 2**30
        archive.write_bytes(info.tobuf() + bytes(2**16))

    return attack


def broken_xz(directory, archive):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:xz") as packed:
        for file in directory.iterdir():
            packed.add(file, file.name)
    content = bytearray(buffer.getvalue())
    content[len(content) // 2] ^= 0xFF
    archive.write_bytes(content)


ARCHIVES = {
    "an encrypted zip": encrypted,
    "a zip of an unknown method": unknown_method,
    "a zip whose directory is broken": broken_directory,
    "a broken xz": broken_xz,
    "a header of a gigabyte": long_member(tarfile.XHDTYPE),
    "a name of a gigabyte": long_member(tarfile.GNUTYPE_LONGNAME),
    "no archive": lambda _, archive: archive.write_bytes(bytes(range(256))),
}  # fmt: skip


@pytest.mark.parametrize("attack", ARCHIVES)
def test_an_archive_that_cannot_be_read_is_told(small, home, tmp_path, attack):
    archive = tmp_path / "x.archive"
    ARCHIVES[attack](small, archive)
    with pytest.raises(OoddError, match=r"x\.archive"):
        fetch(str(archive))
    assert not list(home.glob("*/manifest.json"))


def test_an_archive_of_a_split_among_many_files_is_refused(small, home, tmp_path):
    archive = tmp_path / "x.tar.gz"
    with tarfile.open(archive, "w:gz") as packed:
        for file in small.iterdir():
            packed.add(file, file.name)
        for i in range(10_000):
            packed.addfile(tarfile.TarInfo(f"other/{i}"))
    with pytest.raises(SplitError, match=r"x\.tar\.gz holds more than 10000 files"):
        fetch(str(archive))
    assert not list(home.glob("*/manifest.json"))


@pytest.mark.parametrize("name", ["\x1b[2J", "a/b", "..", "con\u202etrol", ""])
def test_a_name_that_is_none_is_refused(small, home, tmp_path, name):
    copy = shutil.copytree(small, tmp_path / "copy")
    edit_manifest(copy, lambda manifest: manifest.update(name=name))
    with pytest.raises(SplitError, match=r"which is no name|String should match"):
        fetch(str(copy))
    assert not list(home.glob("*/manifest.json"))
