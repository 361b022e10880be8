"""The state of an unfinished run, so that it can be killed at any point and go on."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from mild_viz.errors import UserError
from mild_viz.training.options import TrainingOptions


class RunState:
    """A folder beside the output with the run's options and one file of tensors a stage."""

    def __init__(self, out: Path, description: dict[str, Any], options: TrainingOptions, resume: bool) -> None:
        self.folder = out.resolve().parent / f".{out.name}.training"
        record = json.loads(json.dumps({**description, "options": asdict(options)}))
        file = self.folder / "run.json"
        if resume and file.is_file():
            before = json.loads(file.read_text())
            changed = [key for key in record if before.get(key) != record[key]]
            if changed:
                was, asked = [before.get(key) for key in changed], [record[key] for key in changed]
                raise UserError(
                    f"{file}: the run to resume differs in {', '.join(changed)}: it was {was}, asked for is {asked}; "
                    "give the same options, or start anew without --resume"
                )
            return
        if resume:
            raise UserError(f"nothing to resume: {file} does not exist")
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        file.write_text(json.dumps(record, indent=2))

    def load(self, stage: str) -> dict[str, Any] | None:
        """What was saved last for a stage, if anything."""
        file = self.folder / f"{stage}.pt"
        return torch.load(file, weights_only=True) if file.is_file() else None

    def save(self, stage: str, content: dict[str, Any]) -> None:
        """Replace a stage's state, atomically."""
        temporary = self.folder / f".{stage}.{os.getpid()}.tmp"
        torch.save(content, temporary)
        os.replace(temporary, self.folder / f"{stage}.pt")

    def finish(self) -> None:
        """The result is written: the state is not needed any more."""
        shutil.rmtree(self.folder, ignore_errors=True)


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
