"""Fetch public recordings into the data folder: checked before they get their name, or not at all."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mild_viz.data.checks import file_checksum
from mild_viz.data.load import check_name, data_root
from mild_viz.data.sources import SOURCES, DataFile
from mild_viz.errors import UserError

if TYPE_CHECKING:
    from rich.progress import Progress

TIMEOUT = 30.0
"""How long a server may stay silent [s]."""


@dataclass(frozen=True)
class Fetched:
    """What became of one file."""

    path: Path
    outcome: str
    """'present' (was there, with the right checksum), 'fetched' or 'failed' (an optional file)."""
    reason: str = ""
    """Why it failed."""


class _Bar:
    """What pooch expects of a progress bar, drawn by rich."""

    def __init__(self, progress: Progress, label: str) -> None:
        self._progress = progress
        self._task = progress.add_task(label, total=None)

    @property
    def total(self) -> float | None:
        return self._progress.tasks[self._task].total

    @total.setter
    def total(self, n_bytes: int) -> None:
        self._progress.update(self._task, total=n_bytes or None)

    def update(self, n_bytes: int) -> None:
        self._progress.advance(self._task, n_bytes)

    def reset(self) -> None:
        self._progress.update(self._task, completed=0)

    def close(self) -> None:
        self._progress.stop_task(self._task)


def fetch(name: str, root: Path | None = None, base_url: str | None = None) -> list[Fetched]:
    """Download the files of dataset `name` to `root` (default: `data_root()`), and say what became of each.

    A file that is there with the right checksum is left alone. A download goes to a temporary file beside its
    place, and gets its name only once its SHA-256 is the pinned one; so an interrupted or tampered download
    leaves nothing under that name, and a rerun starts that file afresh and skips the finished ones.
    `base_url` is a mirror that is laid out like the data folder. Raises a `UserError` for a dataset that
    nobody publishes in this form, a needed file that cannot be had, and a folder that cannot be written.
    """
    check_name(name)
    root = root or data_root()
    source = SOURCES[name]
    if source.by_hand:
        places = " and ".join(str(root / file.path) for file in source.files)
        raise UserError(f"dataset '{name}' cannot be fetched. {source.by_hand} {places}.")
    wanted = [file for file in source.files if not _is_right(root, file)]
    for file in wanted:
        _check_writable(root, (root / file.path).parent)
    outcomes = {file.path: Fetched(root / file.path, "present") for file in source.files}
    with _progress() as progress:
        for file in wanted:
            outcomes[file.path] = _fetch_file(root, file, base_url, progress)
    return list(outcomes.values())


def _is_right(root: Path, file: DataFile) -> bool:
    path = root / file.path
    try:
        return path.is_file() and file_checksum(path) == file.sha256
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error


def _check_writable(root: Path, folder: Path) -> None:
    """Find out before the download, not after it, whether its result can be kept."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(
            f"the data folder {root} cannot be written ({folder}: {error.strerror or error}); "
            "set MILD_VIZ_DATA to a folder that can"
        ) from error


def _progress() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    return Progress(*columns, console=Console(stderr=True))


def _fetch_file(root: Path, file: DataFile, base_url: str | None, progress: Progress) -> Fetched:
    import pooch
    import requests  # pooch's own means of download

    path = root / file.path
    url = f"{base_url.rstrip('/')}/{file.path.as_posix()}" if base_url else file.url
    if url is None or file.sha256 is None:
        raise UserError(f"{file.path} has no address and checksum to fetch it by")
    pooch.get_logger().setLevel("WARNING")
    bar: Any = _Bar(progress, file.path.name)  # pooch documents such an object, and annotates a bool
    downloader: Any = pooch.HTTPDownloader(progressbar=bar, timeout=TIMEOUT)
    try:
        pooch.retrieve(
            url,
            known_hash=f"sha256:{file.sha256}",
            fname=path.name,
            path=path.parent,
            downloader=downloader,
        )
        os.chmod(path, 0o644)  # pooch's temporary file is the user's alone
    except ValueError as error:  # which requests' own errors for broken addresses are, too
        reason = "its SHA-256 is not the pinned one" if "hash" in str(error) else str(error)
        return _failed(path, file, url, reason, error)
    except requests.RequestException as error:
        return _failed(path, file, url, _in_words(error), error)
    except OSError as error:
        return _failed(path, file, url, f"it cannot be written: {error.strerror or error}", error)
    return Fetched(path, "fetched")


def _in_words(error: Exception) -> str:
    """A network error without the addresses of Python objects."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answers {response.status_code} {response.reason}"
    words = {
        "ChunkedEncodingError": "the connection broke before the end",
        "ConnectionError": "no connection",
        "ProxyError": "the proxy gives no connection",
        "ConnectTimeout": "no connection in time",
        "ReadTimeout": "the server fell silent",
        "SSLError": "no trusted connection",
    }
    return words.get(type(error).__name__, str(error))


def _failed(path: Path, file: DataFile, url: str, reason: str, error: Exception) -> Fetched:
    """An optional file may fail; for any other, stop."""
    if file.optional:
        return Fetched(path, "failed", f"{url}: {reason}")
    raise UserError(
        f"{file.path} was not fetched from {url}: {reason}. Nothing was written to {path}; "
        "run the same command again, or place the file there by hand"
    ) from error
