"""The state of an unfinished run, so that it can be killed at any point and go on."""

from __future__ import annotations

import fcntl
import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import torch

from mild_viz.errors import UserError
from mild_viz.files import write_atomically
from mild_viz.training.options import TrainingOptions


def state_folder(out: Path) -> Path:
    """Where the state of an unfinished run lies: beside its output."""
    return out.resolve().parent / f".{out.name}.training"


class HeldError(UserError):
    """The run's state is held by another process that is still at it."""


class RunState:
    """A folder beside the output with the run's options and one file of tensors a stage.

    One run at a time holds it, and an unfinished run is never thrown away unasked. `resume` None: go on with what is
    there, or start.
    """

    def __init__(self, out: Path, description: dict[str, Any], options: TrainingOptions, resume: bool | None) -> None:
        self.folder = state_folder(out)
        self._record = self.folder / "run.json"
        record = json.loads(json.dumps({**description, **asdict(options)}))
        if resume is False and self._record.exists():
            raise UserError(
                f"{self.folder} holds an unfinished run: go on with --resume, or remove that folder to start anew"
            )
        if resume and not self._record.is_file():
            raise UserError(f"nothing to resume: {self._record} does not exist")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"{self.folder} cannot be made: {error.strerror}; choose another place with --out"
            ) from None
        self._lock = self._hold()
        try:
            # Only who holds the folder can say whether there is something to go on with.
            if resume or (resume is None and self._record.is_file()):
                self._compare(record)
            else:
                write_atomically(self._record, lambda temporary: temporary.write_text(json.dumps(record, indent=2)))
        except UserError:
            self.release()
            raise

    def __enter__(self) -> RunState:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _hold(self) -> IO[bytes]:
        """Hold the folder until the process ends, however it ends."""
        lock = open(self.folder / "lock", "wb")  # noqa: SIM115 - held open on purpose
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            raise HeldError(f"{self.folder} is held by another run that is still going on") from None
        return lock

    def _compare(self, record: dict[str, Any]) -> None:
        try:
            before = json.loads(self._record.read_text())
            changed = [key for key in record if before.get(key) != record[key]]
        except (ValueError, AttributeError):
            raise UserError(f"{self._record} is damaged; remove {self.folder} to start anew") from None
        if changed:
            differences = "; ".join(f"{key} was {before.get(key)}, asked for is {record[key]}" for key in changed)
            raise UserError(
                f"{self.folder}: the run to resume differs: {differences}; give the same options, or remove that "
                "folder to start anew"
            )

    def load(self, stage: str) -> dict[str, Any] | None:
        """What was saved last for a stage, if anything."""
        file = self.folder / f"{stage}.pt"
        if not file.is_file():
            return None
        try:
            return torch.load(file, weights_only=True, map_location="cpu")
        except Exception:  # a damaged pickle leads torch into any of a dozen errors
            raise UserError(f"{file} is damaged; remove {self.folder} to start anew") from None

    def save(self, stage: str, content: dict[str, Any]) -> None:
        """Replace a stage's state, atomically."""

        def write(temporary: Path) -> None:
            try:
                torch.save(content, temporary)
            except RuntimeError as error:  # what torch makes of a full disk
                raise OSError(f"{str(error).splitlines()[0]}; is the disk full?") from None

        write_atomically(self.folder / f"{stage}.pt", write)

    def release(self) -> None:
        """Let another run have the folder; what was saved stays."""
        self._lock.close()

    def finish(self) -> None:
        """The result is written: the state is not needed any more."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.release()  # after that: another run could have begun in the folder


class Trainer:
    """Network, optimiser, one-cycle schedule and random numbers of one stage: what must survive a restart."""

    def __init__(
        self, net: torch.nn.Module, options: TrainingOptions, n_steps: int, clip: float, rng: torch.Generator
    ) -> None:
        self.net, self.rng, self._clip = net, rng, clip
        self._optimizer = torch.optim.AdamW(net.parameters(), lr=options.learning_rate)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, options.peak_learning_rate, total_steps=n_steps
        )

    def descend(self, loss: torch.Tensor) -> None:
        """One step along the gradient of `loss`."""
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), self._clip)
        self._optimizer.step()
        self._schedule.step()

    def state(self, epoch: int) -> dict[str, Any]:
        """Everything after `epoch` epochs."""
        return {
            "epoch": epoch,
            "net": self.net.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": {k: v for k, v in self._schedule.state_dict().items() if isinstance(v, (int, float, list))},
            "rng": self.rng.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> int:
        """Go back to a saved state; returns the number of epochs done."""
        self.net.load_state_dict(state["net"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.rng.set_state(state["rng"])
        return int(state["epoch"])
