"""The authors' published file: read without trust, and the oracle of the whole numeric chain."""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import model_rows
from mild_viz.published import import_published, read_pth, variant_of

PUBLISHED = "checkpoints/mild_v3_2_pepper_nuisi.pth"

MSE = {
    "wave": (0.0461, 0.0591),
    "handshake": (0.0221, 0.0168),
    "rocket": (0.0785, 0.0788),
    "parachute": (0.0253, 0.0283),
}
"""Measured with the authors' code (design.md, section 3); the paper's v3.1 row to its three digits."""


@pytest.fixture(scope="module")
def published(shared: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    return import_published(shared(PUBLISHED), tmp_path_factory.mktemp("published") / "model")


def test_says_which_variant_it_really_is(published: Checkpoint) -> None:
    assert published.variants == ("v3.1",)  # its name says v3.2; its arguments say no covariance
    assert "v3.1" in (published.path / "README.md").read_text()
    assert json.loads((published.path / "config.json").read_text())["training"]["arguments"]["cov_cond"] is False
    assert variant_of({"variant": 2, "cov_cond": True}, "file") == "v2.2"
    assert variant_of({"variant": 1, "cov_cond": False}, "file") == "v1"


@pytest.mark.parametrize(("number", "covariance"), [(7, False), (0, True), ("3", False), (10**40, False), (3, None)])
def test_an_unknown_variant_is_named(number: Any, covariance: Any) -> None:
    with pytest.raises(UserError, match="file: variant is .* and cov_cond is .*; valid: 1, 2 or 3"):
        variant_of({"variant": number, "cov_cond": covariance}, "file")


def test_gives_the_published_errors_on_nuisi(published: Checkpoint, dataset: Callable[[str], Any]) -> None:
    rows = {row.action: row for row in model_rows(published, dataset("nuisi").test)}
    for action, (mean, std) in MSE.items():
        assert rows[action].mse_mean == pytest.approx(mean, abs=5e-4)
        assert rows[action].mse_std == pytest.approx(std, abs=5e-4)


def test_reads_back_as_our_own_checkpoint(published: Checkpoint) -> None:
    again = load_checkpoint(published.path)
    assert again.actions == ("wave", "handshake", "rocket", "parachute")
    assert again.robot is not None and again.robot.joint_names[0] == "RShoulderPitch"
    assert sorted(p.name for p in published.path.iterdir()) == ["README.md", "config.json", "weights.safetensors"]


class Payload:
    """Would create a file when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.target}",)


def write_archive(file: Path, content: Any) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("model/data.pkl", pickle.dumps(content))


def test_refuses_and_does_not_execute_anything_else(tmp_path: Path) -> None:
    file, trace = tmp_path / "evil.pth", tmp_path / "trace"
    write_archive(file, {"model_h": Payload(trace)})
    with pytest.raises(UserError, match=r"evil\.pth names posix\.system"):
        import_published(file, tmp_path / "out")
    assert not trace.exists() and not (tmp_path / "out").exists()


class Global:
    """Pickles as a name of a module, such as torch.FloatStorage, without importing it."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class Tensor:
    """Pickles as PyTorch writes a tensor."""

    def __init__(self, kind: Any, offset: Any, size: tuple[Any, ...], stride: tuple[Any, ...]) -> None:
        self.storage, self.rest = ("storage", kind, "0", "cpu", 4), (offset, size, stride, False, None)


PurePickler: Any = pickle._Pickler  # the one in C saves no name that cannot be imported


class Writer(PurePickler):
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, Global):
            self.write(f"c{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, Tensor):
            self.save(Global("torch._utils", "_rebuild_tensor_v2"))
            self.write(pickle.MARK)
            self.save(obj.storage)
            self.write(pickle.BINPERSID)
            for part in obj.rest:
                self.save(part)
            self.write(pickle.TUPLE + pickle.REDUCE)
        else:
            super().save(obj, save_persistent_id)


def write_model(file: Path, storage: bytes, **content: Any) -> None:
    """An archive with the entries of a published model, and one tensor storage."""
    stream = io.BytesIO()
    Writer(stream, 2).dump(dict.fromkeys(("model_h", "model_r", "ssm", "args_r", "args_h")) | content)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data.pkl", stream.getvalue())
        archive.writestr("model/data/0", storage)


def test_reads_every_kind_of_number(tmp_path: Path) -> None:
    values = np.array([[1.5, -2.0], [0.25, 3e8]], dtype="<f4")
    halves = (values.view("<u4") >> 16).astype("<u2")  # bfloat16: the upper half of a float32
    for name, data in (("FloatStorage", values), ("BFloat16Storage", halves), ("DoubleStorage", values.astype("<f8"))):
        write_model(tmp_path / "a.pth", data.tobytes(), model_h=Tensor(Global("torch", name), 0, (2, 2), (1, 2)))
        got = read_pth(tmp_path / "a.pth")["model_h"]
        assert got.dtype.kind == "f"
        np.testing.assert_allclose(got, values.T, rtol=2**-7)


@pytest.mark.parametrize("core", ["core", "_core"])
def test_numpy_names_of_both_generations_are_read(tmp_path: Path, core: str) -> None:
    write_model(tmp_path / "a.pth", b"", ssm=Global(f"numpy.{core}.multiarray", "_reconstruct"))
    assert read_pth(tmp_path / "a.pth")["ssm"].__name__ == "_reconstruct"


FLOATS = Global("torch", "FloatStorage")


@pytest.mark.parametrize(
    ("tensor", "message"),
    [
        (Tensor(FLOATS, 0, (99,), (1,)), "storage 0 is shorter than its tensor"),
        (Tensor(FLOATS, 2, (3,), (1,)), "storage 0 is shorter than its tensor"),
        (Tensor(FLOATS, 0, (10**12,), (0,)), "storage 0 is shorter than its tensor"),
        (Tensor(FLOATS, 0, (2,), (10**30,)), "storage 0 is shorter than its tensor"),
        (Tensor(FLOATS, 0, (0,), (10**30,)), "not a readable PyTorch archive"),
        (Tensor(FLOATS, -1, (2,), (1,)), "negative offset, size or stride"),
        (Tensor(FLOATS, 0, (-2, -2), (1, 1)), "negative offset, size or stride"),
        (Tensor(FLOATS, 0, ("2",), (1,)), "not a readable PyTorch archive"),
        (Tensor("FloatStorage", 0, (2,), (1,)), "storage 0 is of type 'FloatStorage'; valid: FloatStorage"),
    ],
)
def test_a_tensor_that_cannot_be_is_named(tmp_path: Path, tensor: Tensor, message: str) -> None:
    write_model(tmp_path / "odd.pth", bytes(16), model_h=tensor)
    with pytest.raises(UserError, match=rf"odd\.pth.*{message}"):
        read_pth(tmp_path / "odd.pth")


def test_damaged_compression_is_named(tmp_path: Path) -> None:
    file = tmp_path / "damaged.pth"
    write_model(file, bytes(16))
    content = bytearray(file.read_bytes())
    start = content.index(b"data.pkl") + len("data.pkl")
    content[start : start + 8] = b"\xff" * 8
    file.write_bytes(content)
    with pytest.raises(UserError, match=r"damaged\.pth is not a readable PyTorch archive: error: Error -3"):
        read_pth(file)


def test_an_index_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.pth", "w") as archive:
        archive.writestr("model/data.pkl", b"\x80\x02}r\xff\xff\xff\xff.")
    with pytest.raises(UserError, match=r"a\.pth .*memo index 4294967295 is out of range"):
        read_pth(tmp_path / "a.pth")


def test_entries_of_another_kind_are_named(tmp_path: Path) -> None:
    write_model(tmp_path / "odd.pth", b"")
    with pytest.raises(UserError, match=r"odd\.pth is not a published MILD checkpoint: AttributeError"):
        import_published(tmp_path / "odd.pth", tmp_path / "out")
    with pytest.raises(UserError, match="cannot be read|does not exist"):
        import_published(tmp_path / ("x" * 300), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"not a zip", None])
def test_broken_files_are_named(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "broken.pth"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError, match=r"broken\.pth"):
        import_published(file, tmp_path / "out")


def test_a_truncated_file_leaves_nothing(shared: Callable[[str], Path], tmp_path: Path) -> None:
    file = tmp_path / "cut.pth"
    file.write_bytes(shared(PUBLISHED).read_bytes()[:400_000])
    with pytest.raises(UserError, match=r"cut\.pth"):
        import_published(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_another_archive_is_not_taken_for_a_model(tmp_path: Path) -> None:
    file = tmp_path / "other.pth"
    buffer = io.BytesIO(pickle.dumps({"weights": 1}))
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("model/data.pkl", buffer.getvalue())
    with pytest.raises(UserError, match="expected the entries"):
        import_published(file, tmp_path / "out")


def test_an_unrelated_folder_is_not_overwritten(shared: Callable[[str], Path], tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match=r"not a checkpoint folder.*thesis\.txt"):
        import_published(shared(PUBLISHED), tmp_path)
    (tmp_path / "config.json").write_text('{"schema_version": 1}')
    with pytest.raises(UserError, match=r"holds thesis\.txt"):
        import_published(shared(PUBLISHED), tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "precious"
