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
    assert variant_of({"variant": 2, "cov_cond": True}) == "v2.2"
    assert variant_of({"variant": 1, "cov_cond": False}) == "v1"


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


def test_refuses_a_tensor_that_reaches_beyond_its_storage(tmp_path: Path) -> None:
    file = tmp_path / "short.pth"
    text = (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
        b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQK\x00K\x63\x85K\x01\x85\x89NtR."
    )
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("model/data.pkl", text)
        archive.writestr("model/data/0", bytes(16))
    with pytest.raises(UserError, match="shorter than its tensor"):
        read_pth(file)


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
