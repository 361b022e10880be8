"""The restricted .npz reader: what NumPy writes is read, what else a pickle may name is refused, unexecuted."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib import format as npy

from mild_viz.data.npz import load_npz
from mild_viz.errors import UserError


class Call:
    """Pickles as a call of any function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.function, self.arguments


def write_object_array(path: Path, shape: tuple[int, ...], pickled: bytes) -> None:
    """An .npz whose one array 'train_data' is of objects, with a pickle of our choice behind its header."""
    content = io.BytesIO()
    npy.write_array_header_1_0(content, {"descr": "|O", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("train_data.npy", content.getvalue() + pickled)


def ragged() -> np.ndarray:
    trials = np.empty(2, dtype=object)
    trials[:] = [np.arange(6.0).reshape(3, 2), np.ones((2, 2), dtype=np.float32)]
    return trials


@pytest.mark.parametrize("compressed", [False, True])
def test_reads_what_numpy_writes(tmp_path: Path, compressed: bool) -> None:
    path = tmp_path / "file.npz"
    written = {
        "ragged": ragged(),
        "flat": np.arange(12.0).reshape(3, 4),
        "fortran": np.asfortranarray(np.arange(12).reshape(3, 4)),
        "names": np.array(["a", "longer"]),
        "scalar": np.float32(30.0),
        "empty": np.zeros((0, 3)),
    }
    (np.savez_compressed if compressed else np.savez)(path, **written)
    read = load_npz(path)
    assert set(read) == set(written)
    for name, array in read.items():
        expected = np.asarray(written[name])
        assert array.dtype == expected.dtype and array.shape == expected.shape
        for got, wanted in zip(array.flat, expected.flat, strict=True):
            np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_reads_every_protocol_that_numpy_has_written(tmp_path: Path, protocol: int) -> None:
    numbers = np.empty(2, dtype=object)
    numbers[:] = [np.float64(1.5), np.arange(3)]
    write_object_array(tmp_path / "file.npz", (2,), pickle.dumps(numbers, protocol=protocol))
    read = load_npz(tmp_path / "file.npz")["train_data"]
    assert read[0] == 1.5
    np.testing.assert_array_equal(read[1], np.arange(3))


def test_reads_the_names_of_numpy_1(tmp_path: Path) -> None:
    pickled = pickle.dumps(ragged(), protocol=2).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert b"numpy.core.multiarray" in pickled
    write_object_array(tmp_path / "file.npz", (2,), pickled)
    np.testing.assert_array_equal(load_npz(tmp_path / "file.npz")["train_data"][0], ragged()[0])


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.system, f"{os.system.__module__}.system"),
        (builtins.eval, "(__builtin__|builtins).eval"),
        (builtins.open, "_?io.open"),
        (getattr, "(__builtin__|builtins).getattr"),
        (np.load, r"numpy.*\.load"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_any_other_callable_is_refused_and_not_run(
    tmp_path: Path, function: Callable[..., Any], name: str, protocol: int
) -> None:
    trap, path = tmp_path / "trap", tmp_path / "crafted.npz"
    arguments = {
        os.system: (f"touch {trap}",),
        builtins.eval: (f"open({str(trap)!r}, 'w')",),
        builtins.open: (str(trap), "w"),
        getattr: ("text", "upper"),
        np.load: (str(trap),),
    }[function]
    # Inside an array, as a real attack would hide it: the pickle begins as NumPy's own does.
    array = np.empty(1, dtype=object)
    array[0] = Call(function, *arguments)
    write_object_array(path, (1,), pickle.dumps(array, protocol=protocol))
    with pytest.raises(UserError, match=f"crafted.npz.*'train_data'.*callable {name}.*nothing in it was run"):
        load_npz(path)
    assert not trap.exists()


def test_crafted_file_would_run_under_allow_pickle(tmp_path: Path) -> None:
    """The trap of the test above is a real one."""
    array = np.empty(1, dtype=object)
    array[0] = Call(os.mkdir, str(tmp_path / "trap"))
    write_object_array(tmp_path / "crafted.npz", (1,), pickle.dumps(array))
    with np.load(tmp_path / "crafted.npz", allow_pickle=True) as file:
        file["train_data"]
    assert (tmp_path / "trap").exists()


def test_a_reduced_submodule_of_numpy_is_not_enough(tmp_path: Path) -> None:
    # Protocol 4 resolves dotted names: 'numpy' + 'ndarray.tofile' must not pass as numpy.ndarray.
    pickled = b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93."
    write_object_array(tmp_path / "file.npz", (1,), pickled)
    with pytest.raises(UserError, match=r"callable numpy\.ndarray\.tofile"):
        load_npz(tmp_path / "file.npz")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ([1, 2], "holds a list; expected a NumPy array"),
        (np.array([{"a": 1}, None], dtype=object), "holds a dict; expected arrays or numbers"),
        (np.array([ragged(), 1.0], dtype=object), "holds arrays of objects"),
        (ragged()[:1], r"has shape \(1,\); its header says \(2,\)"),
    ],
)
def test_other_contents_are_refused(tmp_path: Path, content: Any, complaint: str) -> None:
    write_object_array(tmp_path / "file.npz", (2,), pickle.dumps(content, protocol=4))
    with pytest.raises(UserError, match=f"file.npz: array 'train_data' {complaint}"):
        load_npz(tmp_path / "file.npz")


def test_text_encoded_by_another_codec_is_refused(tmp_path: Path) -> None:
    pickled = b"c_codecs\nencode\n(Vx\nVrot13\ntR."
    write_object_array(tmp_path / "file.npz", (1,), pickled)
    with pytest.raises(UserError, match="encoded as 'rot13'"):
        load_npz(tmp_path / "file.npz")


def test_absent_empty_and_foreign_files_name_file_and_reason(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="absent.npz cannot be read: No such file"):
        load_npz(tmp_path / "absent.npz")
    with pytest.raises(UserError, match="cannot be read: Is a directory"):
        load_npz(tmp_path)
    (tmp_path / "empty.npz").touch()
    with pytest.raises(UserError, match=r"^\S*empty.npz is empty; expected an .npz archive$"):
        load_npz(tmp_path / "empty.npz")
    (tmp_path / "text.npz").write_text("<html>404</html>")
    with pytest.raises(UserError, match="text.npz is truncated or not an .npz archive"):
        load_npz(tmp_path / "text.npz")
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as archive:
        archive.writestr("readme.txt", "no array")
    with pytest.raises(UserError, match="zip.npz: array 'readme.txt' is not a NumPy array"):
        load_npz(tmp_path / "zip.npz")


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.npz", tmp_path / "cut.npz"
    np.savez_compressed(whole, train_data=ragged(), train_labels=np.arange(2.0))
    content = whole.read_bytes()
    for length in range(1, len(content), 23):
        cut.write_bytes(content[:length])
        with pytest.raises(UserError, match="cut.npz"):
            load_npz(cut)


def test_a_flipped_byte_is_refused_or_harmless(tmp_path: Path) -> None:
    whole, flipped = tmp_path / "whole.npz", tmp_path / "flipped.npz"
    np.savez_compressed(whole, train_data=ragged(), train_labels=np.arange(2.0))
    content = bytearray(whole.read_bytes())
    refused = 0
    for position in range(0, len(content), 3):
        content[position] ^= 0x55
        flipped.write_bytes(content)
        content[position] ^= 0x55
        try:
            load_npz(flipped)
        except UserError as error:
            assert "flipped.npz" in str(error)
            refused += 1
    assert refused > len(content) / 3 * 0.7  # the rest are dates and flags that nobody reads


def test_damaged_members_are_refused(tmp_path: Path) -> None:
    pickled = pickle.dumps(ragged(), protocol=4)
    write_object_array(tmp_path / "short.npz", (2,), pickled[: len(pickled) // 2])
    with pytest.raises(UserError, match="short.npz: array 'train_data' is damaged"):
        load_npz(tmp_path / "short.npz")
    content = io.BytesIO()
    npy.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": (1000,)})
    with zipfile.ZipFile(tmp_path / "few.npz", "w") as archive:
        archive.writestr("flat.npy", content.getvalue() + struct.pack("<d", 1.0))
    with pytest.raises(UserError, match="few.npz: array 'flat' holds 8 bytes; its header says 8000"):
        load_npz(tmp_path / "few.npz")


@pytest.mark.parametrize("shape", [(0, 2**62), (0, 2**70)])
def test_a_shape_that_no_array_has_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    content = io.BytesIO()
    npy.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "wide.npz", "w") as archive:
        archive.writestr("flat.npy", content.getvalue())
    with pytest.raises(UserError, match=r"wide.npz: array 'flat' has shape \(0, \d+\) of float64 in its header, which"):
        load_npz(tmp_path / "wide.npz")


def test_missing_arrays_are_named_beside_those_present(tmp_path: Path) -> None:
    np.savez(tmp_path / "file.npz", alpha=np.zeros(1), beta=np.zeros(1))
    with pytest.raises(UserError, match="no array train_data; it has: alpha, beta"):
        load_npz(tmp_path / "file.npz", ("alpha", "train_data"))


def test_an_archive_that_unpacks_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "file.npz", zeros=np.zeros(1000))
    monkeypatch.setattr("mild_viz.data.npz.MAX_BYTES", 4000)
    with pytest.raises(UserError, match="file.npz unpacks to more than"):
        load_npz(tmp_path / "file.npz")
