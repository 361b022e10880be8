"""Training configs in TOML: what `mild-viz train --config FILE` runs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.toml_config import check_keys, converted, read_toml
from mild_viz.training.options import TrainingOptions
from mild_viz.training.run import train

OPTIONS: dict[str, Any] = get_type_hints(TrainingOptions)
"""Every field of the options and its type."""
TRAIN: dict[str, Any] = {
    name: hint
    for name, hint in get_type_hints(train).items()
    if name not in ("options", "command", "quiet", "resume", "tensorboard", "return")  # a caller says these
} | {"epochs": int}
"""Every other key of a training config and its type: the parameters of `train`."""


def make_options(values: Mapping[str, Any], where: str) -> TrainingOptions:
    """Options from converted values; an error in their range names the file."""
    try:
        return TrainingOptions(**values)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def read_train_config(file: Path) -> dict[str, Any]:
    """The keyword arguments of `train` that a flat TOML file stands for; what it leaves out has `train`'s default.

    Raises:
        UserError: naming the file and the key, what was found and what would be valid.
    """
    table = read_toml(file)
    check_keys(table, TRAIN.keys() | OPTIONS.keys(), str(file))
    if "dataset" not in table:
        raise UserError(f'{file}: dataset is missing; for example: dataset = "nuisi"')
    values = {key: converted(value, (OPTIONS | TRAIN)[key], f"{file}: {key}") for key, value in table.items()}
    epochs = values.pop("epochs", None)
    stages = dict.fromkeys(("human_epochs", "robot_epochs", "joint_epochs"), epochs) if epochs is not None else {}
    if both := sorted(stages.keys() & values.keys()):
        raise UserError(f"{file}: epochs stands for all stages; leave out {', '.join(both)}, or epochs")
    options = {key: values.pop(key) for key in OPTIONS if key in values}
    return {**values, "options": make_options(options | stages, str(file))}


def train_from_config(
    file: Path, out: Path | None = None, resume: bool = False, tensorboard: Path | None = None
) -> Checkpoint:
    """What `mild-viz train --config FILE` does; `out` stands for the folder that the file names."""
    values = read_train_config(file)
    words = ["mild-viz", "train", "--config", str(file), *(["--out", str(out)] if out else [])]
    folder = out or values.pop("out", None) or Path("runs") / file.stem
    return train(**{**values, "out": folder}, resume=resume, tensorboard=tensorboard, command=shlex.join(words))
