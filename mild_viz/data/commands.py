"""What `mild-viz data list | fetch | check` print. Each returns the exit code: 0 if all is well, 1 if not."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mild_viz.data.checks import TRAJECTORY_ARRAYS, listed
from mild_viz.data.download import fetch as download
from mild_viz.data.load import DATASETS, data_root, load_dataset, missing_files
from mild_viz.data.npz import load_npz
from mild_viz.data.sources import SOURCES
from mild_viz.errors import UserError
from mild_viz.trial import ACTIONS, Trial

JUMP_SPEED = 6.0
"""A wrist that seems faster than this has been lost and found elsewhere [m/s]."""


def list_datasets(root: Path | None = None) -> int:
    """Print every dataset: whether it is present, where, its trials, or the command that fetches it."""
    root = root or data_root()
    table = Table(title=f"Datasets (data folder: {escape(str(root))})", title_justify="left")
    for heading in ("name", "present", "trials (train + test)", "actions", "where"):
        table.add_column(heading, overflow="fold")
    exit_code = 0
    for name in DATASETS:
        missing = missing_files(name, root)
        if missing:
            by_hand = " (says how to get it by hand)" if SOURCES[name].by_hand else ""
            table.add_row(name, "no", "", "", f"get it with: mild-viz data fetch {name}{by_hand}")
            continue
        try:
            dataset = load_dataset(name, root)
        except UserError as error:
            table.add_row(name, "unusable", "", "", escape(str(error)))
            exit_code = 1
            continue
        files = SOURCES[name].files
        where = str((root / files[0].path).parent) if files else "built in"
        trials = f"{len(dataset.train)} + {len(dataset.test)}"
        table.add_row(name, "yes", trials, ", ".join(dataset.actions), escape(where))
    Console().print(table)
    return exit_code


def fetch(name: str, root: Path | None = None, base_url: str | None = None) -> int:
    """Download dataset `name` and print what became of each of its files."""
    root = root or data_root()
    outcomes = download(name, root, base_url)
    console = Console()
    if not outcomes:
        console.print(f"dataset '{name}' is built in: there is nothing to fetch", highlight=False)
        return 0
    table = Table(title=f"{name} (data folder: {escape(str(root))})", title_justify="left")
    for heading in ("file", "outcome"):
        table.add_column(heading, overflow="fold")
    for file in outcomes:
        table.add_row(
            escape(str(file.path.relative_to(root))), file.outcome + (f": {escape(file.reason)}" if file.reason else "")
        )
    console.print(table)
    failed = [file for file in outcomes if file.outcome == "failed"]
    if failed:
        console.print(
            f"{name} can be used without the failed files; run the command again to get them", highlight=False
        )
    return 1 if failed else 0


def check(path: Path) -> int:
    """Read a data folder, or one recording, whole; print what is in it. A `UserError` says what is wrong with it."""
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path} does not exist; expected a data folder or one of its files")
    if path.is_dir():
        present = [name for name in DATASETS if SOURCES[name].files and not missing_files(name, path)]
        if not present:
            layout = ", ".join(str(file.path) for source in SOURCES.values() for file in source.files)
            raise UserError(f"{path} holds no dataset; a data folder is laid out like this: {layout}")
        for name in present:
            dataset = load_dataset(name, path)
            _print_trials(f"{dataset.title}, SHA-256 {dataset.checksum[:16]}…", dataset.train + dataset.test)
    elif path.suffix == ".npz":
        title, trials = _read_npz(path)
        _print_trials(f"{path}: {title}", trials)
    elif path.suffix == ".txt":
        _check_nuitrack(path)
    else:
        raise UserError(f"{path}: '{path.suffix}' files are unknown; valid: a data folder, .npz, .txt (raw Nuitrack)")
    return 0


def _read_npz(path: Path) -> tuple[str, Iterable[Trial]]:
    """The trials of a recording whose arrays show which dataset it is of."""
    from mild_viz.data import buetepage, handover, nuisi, yumi

    arrays = load_npz(path)
    if set(handover.ARRAYS) <= set(arrays):
        return "handovers", handover.read_file(path, path.stem if path.stem in ("train", "test") else "train")
    if not set(TRAJECTORY_ARRAYS) <= set(arrays):
        raise UserError(
            f"{path} has the arrays {', '.join(arrays) or 'none'}; expected {', '.join(TRAJECTORY_ARRAYS)} "
            f"(NuiSI, HRI-Yumi, Bütepage) or {', '.join(handover.ARRAYS)} (handovers)"
        )
    data = listed(path, "train_data", arrays["train_data"])
    columns = np.shape(data[0])[-1] if np.ndim(data[0]) == 2 else 0
    per_frame = np.ndim(listed(path, "train_labels", arrays["train_labels"])[0]) == 2
    readers = {
        (18, False): ("NuiSI", nuisi.read_file),
        (18, True): ("Bütepage human-human", buetepage.read_file),
        (16, True): ("HRI-Yumi", yumi.read_file),
    }
    if columns not in (16, 18):
        raise UserError(f"{path}: its trials have {columns} columns; valid: 18 (NuiSI, Bütepage), 16 (HRI-Yumi)")
    title, read_file = readers.get((columns, per_frame), readers[16, True])
    train, test = read_file(path)
    return title, train + test


def _check_nuitrack(path: Path) -> None:
    from mild_viz.data.nuitrack import ROCKET_RANGES, read_recording, read_trials

    recording = read_recording(path)
    lost = int(np.isnan(recording).all(axis=(1, 2)).sum())
    text = f"{path}: raw Nuitrack, {len(recording)} frames, tracking lost in {lost}"
    if len(recording) >= max(last for _, last in ROCKET_RANGES):
        text += f"; holds NuiSI's {len(read_trials(path))} rocket trials"
    Console().print(text, highlight=False, markup=False)


def _print_trials(title: str, trials: Iterable[Trial]) -> None:
    table = Table(title=escape(title), title_justify="left")
    for heading in ("action", "split", "trials", "frames (shortest-longest)", "rate", "missing frames", "jumps"):
        table.add_column(heading)
    trials = list(trials)
    for action in ACTIONS:
        for split in ("train", "test"):
            group = [trial for trial in trials if (trial.action, trial.split) == (action, split)]
            if not group:
                continue
            lengths = [trial.n_frames for trial in group]
            table.add_row(
                action,
                split,
                str(len(group)),
                f"{sum(lengths)} ({min(lengths)}-{max(lengths)})",
                f"{group[0].rate:g} Hz",
                str(sum(missing_frames(trial) for trial in group)),
                str(sum(tracking_jumps(trial) for trial in group)),
            )
    Console().print(table)


def missing_frames(trial: Trial) -> int:
    """Frames in which some joint of either partner's arm is missing."""
    observed = [array.reshape(trial.n_frames, -1) for array in _recorded(trial)]
    return int(np.isnan(np.concatenate(observed, axis=1)).any(axis=1).sum())


def tracking_jumps(trial: Trial) -> int:
    """Steps in which a wrist moves faster than `JUMP_SPEED`."""
    arms = [arm for arm in (trial.human_arm, trial.partner_arm) if arm is not None]
    steps = [np.linalg.norm(np.diff(arm[:, 2], axis=0), axis=1) * trial.rate for arm in arms]
    return int(sum((step > JUMP_SPEED).sum() for step in steps))


def _recorded(trial: Trial) -> list[np.ndarray]:
    return [array for array in (trial.human_arm, trial.partner_arm, trial.robot_joints) if array is not None]
