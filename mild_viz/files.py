"""Writing files whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from mild_viz.errors import UserError

Result = TypeVar("Result")


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it there.

    Whatever happens, `path` holds its old content or the whole new one, and no temporary file stays.

    Raises:
        UserError: if the place cannot be written, naming it and the reason.
    """
    temporary = path.with_name(f".{path.name[:100]}.{os.getpid()}.tmp")
    try:
        try:
            write(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}; choose another place") from None


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a compressed .npz file by `write_atomically`."""

    def write(temporary: Path) -> None:
        import numpy as np

        with open(temporary, "wb") as file:  # given a path, numpy would add .npz to its name
            np.savez_compressed(file, **arrays)

    write_atomically(path, write)


def replace_folder(path: Path, fill: Callable[[Path], Result]) -> Result:
    """Let `fill` fill a new folder beside `path`, then move it there whole, in place of what is there.

    Returns what `fill` returns. Whatever it raises, `path` is as it was, and nothing stays beside it.

    Raises:
        UserError: if the place cannot be written, naming it and the reason.
    """
    try:
        target = path.resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{target.name[:50]}.", dir=target.parent))
        built, old = work / "new", work / "old"
        try:
            built.mkdir()
            result = fill(built)
            try:
                if target.exists():
                    os.replace(target, old)
                os.replace(built, target)
            except BaseException:  # Ctrl-C between the two would lose the old one with the work folder
                if old.exists() and not target.exists():
                    os.replace(old, target)
                raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}; choose another place") from None
    return result
