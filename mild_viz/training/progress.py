"""What a person sees of a training run: progress bars with losses and time left, and a log for TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import window_errors
from mild_viz.latent.interaction import InteractionModel
from mild_viz.pairs import Windows

Progress = Callable[[str, int, int, dict[str, float]], None]
"""Called as progress(stage, epoch, n_epochs, values) after every epoch."""


class HeldOut:
    """The error on trials that are held out of a training, to be watched while it goes on."""

    def __init__(self, data: Windows, human_human: bool, rate: float) -> None:
        self._data, self._human_human, self._rate = data, human_human, rate

    def error(self, models: Sequence[InteractionModel], posterior_covariance: Sequence[bool] | None = None) -> float:
        """Mean squared error over models and actions [rad^2; m^2 x 100 between humans]."""
        flags = posterior_covariance or [False] * len(models)
        return float(np.mean([self._of(model, flag) for model, flag in zip(models, flags, strict=True)]))

    def _of(self, model: InteractionModel, posterior_covariance: bool) -> float:
        data, by_action = self._data, {}
        for trial, action in enumerate(data.actions):
            rows = data.rows(trial)
            said, _ = model.advance(action, data.human[rows], model.start(), self._rate, posterior_covariance)
            errors = window_errors(said.decoded, data.partner[rows], self._human_human)
            by_action.setdefault(action, []).append(errors[data.complete[rows]])
        return float(np.mean([np.concatenate(errors).mean() for errors in by_action.values()]))


@contextmanager
def shown(stages: Mapping[str, int], quiet: bool, tensorboard: Path | None) -> Iterator[Progress]:
    """A `Progress` that draws one bar for every stage (name: epochs), and writes scalars to a TensorBoard folder."""
    writer = None if tensorboard is None else _summary_writer(tensorboard)
    columns = (
        TextColumn("{task.description:>6}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[values]}"),
    )  # fmt: skip
    try:
        with Bars(*columns, console=Console(stderr=True), disable=quiet) as bars:
            tasks = {name: bars.add_task(name, total=total, values="") for name, total in stages.items()}
            last: dict[str, dict[str, float]] = {name: {} for name in stages}

            def progress(name: str, epoch: int, _: int, values: dict[str, float]) -> None:
                if writer is not None:
                    for key, value in values.items():
                        writer.add_scalar(f"{name}/{key}", value, epoch)
                last[name] |= values  # the error on held-out trials is not taken after every epoch
                text = "  ".join(f"{key.replace('_', '-')} {value:.4g}" for key, value in last[name].items())
                bars.update(tasks[name], completed=epoch, values=text)

            yield progress
    finally:
        if writer is not None:
            writer.close()


def _summary_writer(folder: Path):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise UserError(
            "--tensorboard needs the package tensorboard; install it with: pip install tensorboard"
        ) from None
    try:
        return SummaryWriter(str(folder))
    except OSError as error:
        raise UserError(
            f"{folder} cannot be written: {error.strerror or error}; choose another --tensorboard"
        ) from None
