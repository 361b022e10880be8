"""Read .npz files whose object arrays are pickles, without running what a pickle may name.

An object array inside an .npz file is a pickle, and a pickle can name any callable. The unpickler here
admits only what NumPy itself writes to rebuild its arrays, and refuses the file otherwise.
"""

from __future__ import annotations

import _codecs
import io
import pickle
import zipfile
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy._core import multiarray
from numpy.lib import format as npy

from mild_viz.errors import UserError

MAX_BYTES = 4 << 30
"""An archive that unpacks to more than this is refused before it is unpacked."""


def _encode_latin1(text: str, encoding: str) -> bytes:
    """What older pickles call to write bytes; any other codec than the one NumPy uses is refused."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes are encoded as '{encoding}', NumPy writes latin1")
    return _codecs.encode(text, "latin1")


def _scalar(dtype: np.dtype, data: Any = b"") -> Any:
    """A NumPy scalar; one of object type would hold something else."""
    if not isinstance(dtype, np.dtype) or dtype.hasobject:
        raise pickle.UnpicklingError("a scalar of object type")
    return multiarray.scalar(dtype, data)  # pyright: ignore[reportAttributeAccessIssue]


ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _encode_latin1,
    # NumPy 1 writes numpy.core, NumPy 2 writes numpy._core.
    **{
        (f"numpy.{core}.multiarray", name): value
        for core in ("core", "_core")
        for name, value in (("_reconstruct", multiarray._reconstruct), ("scalar", _scalar))  # pyright: ignore[reportAttributeAccessIssue]
    },
}
"""Every callable that a pickle may name."""


class _Refused(Exception):
    """The pickle names a callable that is not admitted."""


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return ADMITTED[module_name, global_name]
        except KeyError:
            raise _Refused(f"{module_name}.{global_name}") from None


def _read_member(path: Path, name: str, content: bytes) -> np.ndarray:
    """One .npy member."""
    stream = io.BytesIO(content)
    where = f"{path}: array '{name}'"
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"format version {version[0]}.{version[1]} is unknown; valid: 1.0, 2.0")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, dtype = read_header(stream)
    except Exception as error:
        raise UserError(f"{where} is not a NumPy array: {error}") from error
    if dtype.hasobject:
        array = _unpickle(where, stream)
        if array.shape != shape:
            raise UserError(f"{where} has shape {array.shape}; its header says {shape}")
        return array
    expected, got = prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if got != expected:
        raise UserError(f"{where} holds {got} bytes; its header says {expected}")
    try:
        array = np.frombuffer(content, dtype, count=prod(shape), offset=stream.tell())
        return array.reshape(shape, order="F" if fortran_order else "C").copy()
    except (ValueError, OverflowError) as error:  # a size of 0 hides any other, however large, from the count
        raise UserError(f"{where} has shape {shape} of {dtype} in its header, which no array has: {error}") from error


def _unpickle(where: str, stream: io.BytesIO) -> np.ndarray:
    """An object array whose elements are plain arrays or numbers."""
    try:
        array = _ArrayUnpickler(stream).load()
    except _Refused as error:
        raise UserError(
            f"{where} names the callable {error}, which rebuilding NumPy arrays does not need; "
            "the file is refused and nothing in it was run"
        ) from error
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise UserError(f"{where} is damaged: {type(error).__name__}: {error}") from error
    if not isinstance(array, np.ndarray):
        raise UserError(f"{where} holds a {type(array).__name__}; expected a NumPy array")
    for element in array.flat:
        if not isinstance(element, np.ndarray | np.generic | int | float | str):
            raise UserError(f"{where} holds a {type(element).__name__}; expected arrays or numbers")
        if isinstance(element, np.ndarray) and element.dtype.hasobject:
            raise UserError(f"{where} holds arrays of objects; expected arrays of numbers")
    return array


def load_npz(path: Path, required: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Every array of an .npz file by name. Nothing that the file names is executed.

    A `UserError` names the file and the reason: absent, empty, truncated, not an archive, a pickle that names
    another callable than NumPy's own, or one of `required` missing.
    """
    path = Path(path)
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{path} is empty; expected an .npz archive")
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise UserError(f"{path} unpacks to more than {MAX_BYTES >> 30} GiB; expected a smaller archive")
            contents = {entry.removesuffix(".npy"): archive.read(entry) for entry in archive.namelist()}
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, EOFError, ValueError, RuntimeError) as error:
        raise UserError(f"{path} is truncated or not an .npz archive: {error}") from error
    except Exception as error:  # zlib.error has no common base with the others
        raise UserError(f"{path} is damaged: {error}") from error
    missing = [name for name in required if name not in contents]
    if missing:
        raise UserError(f"{path} has no array {', '.join(missing)}; it has: {', '.join(contents) or 'none'}")
    return {name: _read_member(path, name, content) for name, content in contents.items()}
