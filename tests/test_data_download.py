"""`fetch` against a web server on the loopback interface, well and badly behaved."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from conftest import unavailable

from mild_viz.data import commands, download
from mild_viz.data.download import fetch
from mild_viz.data.load import load_dataset
from mild_viz.data.sources import SOURCES, DataFile, Source
from mild_viz.errors import UserError

FILE = Path("buetepage_hr/traj_data.npz")
CONTENT = np.random.default_rng(0).bytes(300_000)


class Mirror:
    """A web server that is laid out like the data folder. `fault` makes it misbehave."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.fault: dict[str, str] = {}
        self.requests: list[str] = []
        self.resume = threading.Event()
        mirror = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                name = self.path.lstrip("/")
                mirror.requests.append(name)
                fault, content = mirror.fault.get(name, ""), mirror.files.get(name)
                if content is None or fault == "absent":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                half = len(content) // 2
                if fault == "truncated":
                    self.wfile.write(content[:half])
                    self.close_connection = True
                elif fault == "stalled":
                    self.wfile.write(content[:half])
                    self.wfile.flush()
                    mirror.resume.wait(20.0)
                elif fault == "tampered":
                    self.wfile.write(content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :])
                else:
                    self.wfile.write(content)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.05,), daemon=True)
        self.thread.start()

    def close(self) -> None:
        self.resume.set()
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture
def mirror(monkeypatch: pytest.MonkeyPatch) -> Iterator[Mirror]:
    """A mirror that holds one needed file of 'yumi', whose pinned checksum is set to that file's."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setitem(SOURCES, "yumi", Source((DataFile(FILE, "http://x", hashlib.sha256(CONTENT).hexdigest()),)))
    server = Mirror()
    server.files[FILE.as_posix()] = CONTENT
    yield server
    server.close()


def entries(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def test_fetched_files_are_laid_out_like_the_data_folder(mirror: Mirror, tmp_path: Path) -> None:
    (outcome,) = fetch("yumi", tmp_path / "new" / "folder", mirror.url)
    assert outcome.outcome == "fetched"
    assert outcome.path == tmp_path / "new" / "folder" / FILE
    assert outcome.path.read_bytes() == CONTENT
    assert entries(tmp_path / "new" / "folder") == [FILE.as_posix()]


def test_a_file_that_is_there_is_not_loaded_again(mirror: Mirror, tmp_path: Path) -> None:
    fetch("yumi", tmp_path, mirror.url)
    (again,) = fetch("yumi", tmp_path, mirror.url)
    assert again.outcome == "present"
    assert len(mirror.requests) == 1


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("truncated", "the connection broke before the end"),
        ("tampered", "its SHA-256 is not the pinned one"),
        ("absent", "the server answers 404 Not Found"),
    ],
)
def test_a_bad_download_leaves_nothing_and_a_rerun_succeeds(
    mirror: Mirror, tmp_path: Path, fault: str, reason: str
) -> None:
    mirror.fault[FILE.as_posix()] = fault
    with pytest.raises(UserError, match=f"traj_data.npz was not fetched from {mirror.url}.*{reason}.*run the same"):
        fetch("yumi", tmp_path, mirror.url)
    assert entries(tmp_path) == []
    mirror.fault.clear()
    fetch("yumi", tmp_path, mirror.url)
    assert (tmp_path / FILE).read_bytes() == CONTENT
    assert entries(tmp_path) == [FILE.as_posix()]


def test_a_bad_download_does_not_touch_the_file_that_it_should_replace(mirror: Mirror, tmp_path: Path) -> None:
    (tmp_path / FILE).parent.mkdir(parents=True)
    (tmp_path / FILE).write_bytes(CONTENT[:1000])
    mirror.fault[FILE.as_posix()] = "tampered"
    with pytest.raises(UserError, match="SHA-256"):
        fetch("yumi", tmp_path, mirror.url)
    assert (tmp_path / FILE).read_bytes() == CONTENT[:1000]
    mirror.fault.clear()
    (outcome,) = fetch("yumi", tmp_path, mirror.url)
    assert outcome.outcome == "fetched"
    assert (tmp_path / FILE).read_bytes() == CONTENT


def test_control_c_leaves_nothing(mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(bar: object, n_bytes: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(download._Bar, "update", interrupt)
        with pytest.raises(KeyboardInterrupt):
            fetch("yumi", tmp_path, mirror.url)
    assert entries(tmp_path) == []
    fetch("yumi", tmp_path, mirror.url)
    assert (tmp_path / FILE).read_bytes() == CONTENT


def test_a_killed_download_leaves_no_half_file_under_the_final_name(mirror: Mirror, tmp_path: Path) -> None:
    mirror.fault[FILE.as_posix()] = "stalled"
    # The child does not have this process's pin, but it never comes to compare.
    code = (
        "from pathlib import Path; from mild_viz.data.download import fetch; "
        f"fetch('yumi', Path({str(tmp_path)!r}), {mirror.url!r})"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60.0
        while not any(path.stat().st_size > 0 for path in tmp_path.rglob("*") if path.is_file()):
            assert time.monotonic() < deadline, "the child never began to write"
            time.sleep(0.02)
    finally:
        child.kill()
        child.wait()
    assert not (tmp_path / FILE).exists()
    mirror.resume.set()
    mirror.fault.clear()
    fetch("yumi", tmp_path, mirror.url)
    assert (tmp_path / FILE).read_bytes() == CONTENT


def test_no_server(tmp_path: Path, mirror: Mirror) -> None:
    mirror.close()
    with pytest.raises(UserError, match=r"traj_data.npz was not fetched from .*no connection"):
        fetch("yumi", tmp_path, mirror.url)
    assert entries(tmp_path) == []


def test_an_optional_file_may_fail(
    mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    digest = hashlib.sha256(CONTENT).hexdigest()
    needed, extra = Path("nuisi/traj_data.npz"), Path("nuisi/raw/Rocket_p1.txt")
    files = (DataFile(needed, "http://x", digest), DataFile(extra, "http://x", digest, optional=True))
    monkeypatch.setitem(SOURCES, "nuisi", Source(files))
    mirror.files[needed.as_posix()] = CONTENT
    assert commands.fetch("nuisi", tmp_path, mirror.url) == 1
    printed = capsys.readouterr().out
    assert "404 Not Found" in printed and "can be used without the failed files" in printed
    assert entries(tmp_path) == [needed.as_posix()]
    mirror.files[extra.as_posix()] = CONTENT
    assert commands.fetch("nuisi", tmp_path, mirror.url) == 0
    assert entries(tmp_path) == sorted([needed.as_posix(), extra.as_posix()])


def test_a_data_folder_that_cannot_be_written_is_named_before_any_download(
    mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=f"data folder {tmp_path}/file/data cannot be written.*MILD_VIZ_DATA"):
        fetch("yumi", tmp_path / "file" / "data", mirror.url)

    # Tests may run as root, for whom no folder is read-only: let the system say so itself.
    def refuse(*arguments: object, **keywords: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.NamedTemporaryFile", refuse)
    with pytest.raises(UserError, match="cannot be written .*Permission denied.*set MILD_VIZ_DATA"):
        fetch("yumi", tmp_path, mirror.url)
    assert mirror.requests == []


def test_a_folder_that_becomes_unwritable_meanwhile(
    mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.move", refuse)
    with pytest.raises(UserError, match="it cannot be written: No space left on device"):
        fetch("yumi", tmp_path, mirror.url)
    assert entries(tmp_path) == []


def test_what_cannot_be_fetched_says_why(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="'nusi' is unknown; valid: demo, nuisi, yumi, handover"):
        fetch("nusi", tmp_path)
    with pytest.raises(UserError, match="'handover' cannot be fetched.*dynamic_handover_dataset.*handover/train.npz"):
        fetch("handover", tmp_path)
    assert fetch("demo", tmp_path) == []


def test_every_file_with_an_address_is_pinned_to_a_commit_and_a_checksum() -> None:
    for source in SOURCES.values():
        for file in source.files:
            assert (file.url is None) == (file.sha256 is None) == bool(source.by_hand)
            if file.url is not None and file.sha256 is not None:
                assert file.url.startswith("https://raw.githubusercontent.com/souljaboy764/")
                assert len(file.url.split("/")[5]) == 40 and len(file.sha256) == 64


@pytest.mark.parametrize("name", ["nuisi", "yumi"])
def test_real_recordings_match_the_pins_and_load(
    name: str, data_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    server = Mirror()
    try:
        for file in SOURCES[name].files:
            path = data_root / file.path
            if not path.is_file():
                unavailable(f"{path} is missing; run: mild-viz data fetch {name}")
            server.files[file.path.as_posix()] = path.read_bytes()
        assert {outcome.outcome for outcome in fetch(name, tmp_path, server.url)} == {"fetched"}
    finally:
        server.close()
    assert load_dataset(name, tmp_path).checksum == SOURCES[name].files[0].sha256
