"""What `mild-viz data list` and `check` print, and how they leave."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import unavailable

from mild_viz.data import commands
from mild_viz.data.commands import missing_frames, tracking_jumps
from mild_viz.data.load import data_root as default_root
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.trial import Trial


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "250")


def small_nuisi(path: Path) -> Path:
    """A NuiSI file of one training and one test trial, with a gap and a jump in the first."""
    rng = np.random.default_rng(0)
    train, test = np.empty(1, dtype=object), np.empty(1, dtype=object)
    train[0], test[0] = (np.cumsum(rng.normal(size=(40, 18)) * 1e-3, axis=0) for _ in range(2))
    train[0][10:13, 4] = np.nan
    train[0][20:, 15] += 1.0
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, train_data=train, train_labels=np.array([1.0]), test_data=test, test_labels=np.array([3.0]))
    return path


def test_list_says_what_is_absent_and_how_to_get_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.list_datasets(tmp_path) == 0
    printed = capsys.readouterr().out
    for name in ("nuisi", "yumi", "handover"):
        assert f"mild-viz data fetch {name}" in printed
    assert str(tmp_path) in printed and "built in" in printed


def test_list_counts_what_is_present(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_nuisi(tmp_path / "nuisi" / "traj_data.npz")
    assert commands.list_datasets(tmp_path) == 0
    assert "1 + 1" in capsys.readouterr().out


def test_list_shows_an_unusable_dataset_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "nuisi").mkdir()
    (tmp_path / "nuisi" / "traj_data.npz").write_bytes(b"")
    assert commands.list_datasets(tmp_path) == 1
    printed = capsys.readouterr().out
    assert "unusable" in printed and "is empty" in printed and "data fetch yumi" in printed


def test_check_reports_gaps_and_jumps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small_nuisi(tmp_path / "nuisi" / "traj_data.npz")
    for target in (path, tmp_path):
        assert commands.check(target) == 0
        lines = [line for line in capsys.readouterr().out.splitlines() if "handshake" in line]
        assert [cell.strip() for cell in lines[0].split("│")[1:-1]] == [
            "handshake", "train", "1", "40 (40-40)", "30 Hz", "3", "1",
        ]  # fmt: skip


def test_check_refuses_what_it_cannot_use(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="absent does not exist"):
        commands.check(tmp_path / "absent")
    with pytest.raises(UserError, match="holds no dataset; a data folder is laid out like this: nuisi/traj_data.npz"):
        commands.check(tmp_path)
    (tmp_path / "notes.docx").touch()
    with pytest.raises(UserError, match="'.docx' files are unknown"):
        commands.check(tmp_path / "notes.docx")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(UserError, match="has the arrays weights; expected train_data"):
        commands.check(tmp_path / "other.npz")
    trial = np.empty(1, dtype=object)
    trial[0] = np.zeros((20, 7))
    np.savez(tmp_path / "wide.npz", train_data=trial, train_labels=[0], test_data=trial, test_labels=[0])
    with pytest.raises(UserError, match=r"7 columns; valid: 18 \(NuiSI, Bütepage\), 16 \(HRI-Yumi\)"):
        commands.check(tmp_path / "wide.npz")


def test_check_of_the_real_recordings(data_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = data_root / "nuisi" / "raw" / "Rocket_p1.txt"
    if not raw.is_file():
        unavailable(f"{raw} is missing; run: mild-viz data fetch nuisi")
    assert commands.check(raw) == 0
    assert "2552 frames, tracking lost in 9; holds NuiSI's 12 rocket trials" in capsys.readouterr().out


def test_jumps_and_gaps_count_both_partners() -> None:
    human, partner = np.zeros((20, 3, 3)), np.zeros((20, 3, 3))
    human[5:, 2, 0] = 1.0
    partner[7, 2, 0] = 1.0
    partner[12, 0, 0] = np.nan
    trial = Trial("demo", "train", 0, "wave", 30.0, human, partner)
    assert tracking_jumps(trial) == 3
    assert missing_frames(trial) == 1


def test_data_folder_is_the_environments_else_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MILD_VIZ_DATA", str(tmp_path))
    assert default_root() == tmp_path
    monkeypatch.delenv("MILD_VIZ_DATA")
    assert default_root().name == "mild_viz"


def test_loading_refuses_unknown_and_absent_datasets_and_trials(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="dataset 'yummy' is unknown; valid: demo, nuisi, yumi, handover"):
        load_dataset("yummy", tmp_path)
    with pytest.raises(UserError, match="'yumi' is not present: .*traj_data.npz does not exist.*data fetch yumi"):
        load_dataset("yumi", tmp_path)
    small_nuisi(tmp_path / "nuisi" / "traj_data.npz")
    dataset = load_dataset("nuisi", tmp_path)  # an absence is not remembered
    assert load_dataset("nuisi", tmp_path) is dataset
    with pytest.raises(UserError, match="nuisi/test has no trial 1; valid: 0 to 0"):
        dataset.trial("test", 1)
    with pytest.raises(UserError, match="split 'validation' is unknown"):
        dataset.trial("validation", 0)
