"""Many training runs, one a cell of a config, that can be killed at any point and go on: `mild-viz sweep`."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import joblib
import numpy as np
from rich.console import Console

from mild_viz.errors import UserError
from mild_viz.files import write_atomically
from mild_viz.training.state import state_folder
from mild_viz.training.sweep_config import Cell, read_sweep_config
from mild_viz.training.sweep_results import cell_rows, summary, write_results
from mild_viz.training.sweep_workers import Outcome, finished, on_cluster, on_this_machine

if TYPE_CHECKING:
    from distributed import Client

RESULTS = "results.csv"


def sweep(file: Path, jobs: int | None = None, scheduler: str | None = None) -> int:
    """Train every cell of a config that is not finished, gather results.csv, and print the summary.

    Returns 1 if a cell failed, else 0. Ctrl-C stops it, with what is done kept.

    Raises:
        UserError: on a config, a number of jobs or a scheduler that cannot be used, before anything is trained.
    """
    if jobs is not None and scheduler is not None:
        raise UserError("--jobs is for this machine; with --scheduler, the cluster's workers decide: leave out one")
    if jobs is not None and jobs < 1:
        raise UserError(f"--jobs is {jobs}; valid: 1 or more processes")
    config = read_sweep_config(file)
    out, cells = config.out.resolve(), config.cells()
    command = shlex.join(["mild-viz", "sweep", str(file)])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made: {error.strerror}; choose another place for out in {file}") from None
    _tell_strangers(cells, out, file)
    done = {cell: found for cell in cells if (found := finished(cell, out)) is not None}
    waiting = [cell for cell in cells if cell not in done]
    for cell in done:  # killed after its model was written: nothing is left to go on with
        shutil.rmtree(state_folder(out / cell.name), ignore_errors=True)
    _say(f"{file}: {len(cells)} cells, of which {len(done)} are finished; results go to {out}")
    rows = [row for cell, found in done.items() for row in cell_rows(cell, found)]
    failed, since = [], time.monotonic()
    try:
        with warnings.catch_warnings(), _outcomes(waiting, out, command, jobs, scheduler) as outcomes:
            warnings.filterwarnings("ignore", ".*still being processed", UserWarning)  # joblib's words on Ctrl-C
            for count, outcome in enumerate(outcomes, 1):
                found = _keep(outcome, out)
                made = [] if found is None else cell_rows(outcome.cell, found)
                if made:
                    rows += made
                    write_results(rows, out / RESULTS)
                else:
                    failed.append(outcome.cell)
                _say(_line(outcome, made, count, len(waiting), since))
    except KeyboardInterrupt:
        left = sum(finished(cell, out) is None for cell in cells)
        where = f" --jobs {jobs}" if jobs else f" --scheduler {scheduler}" if scheduler else ""
        print(f"interrupted with {left} of {len(cells)} cells to do. Go on with:\n  {command}{where}", file=sys.stderr)
        raise
    if rows:
        write_results(rows, out / RESULTS)
        Console(width=None if Console().is_terminal else 200).print(summary(rows))
        _say(f"{out / RESULTS}: {len(rows)} rows")
    for cell in failed:
        _say(f"failed: {cell.name}; its traceback is in {_error_file(cell, out)}")
    return 1 if failed else 0


def _say(line: str) -> None:
    print(line, flush=True)


def _error_file(cell: Cell, out: Path) -> Path:
    return out / f"{cell.name}.error.txt"


def _tell_strangers(cells: Sequence[Cell], out: Path, file: Path) -> None:
    """Name the folders of cells that the config no longer has; they stay."""
    ours = {path.name for cell in cells for path in (out / cell.name, state_folder(out / cell.name))}
    folders = sorted(path.name for path in out.iterdir() if path.is_dir() and path.name not in ours)
    strangers = [name for name in folders if not name.startswith(".") or name.endswith(".training")]
    if strangers:
        _say(f"{out}: not of {file}, and left as they are: {', '.join(strangers)}")


@contextmanager
def _outcomes(
    cells: Sequence[Cell], out: Path, command: str, jobs: int | None, scheduler: str | None
) -> Iterator[Iterator[Outcome]]:
    """The outcomes of cells, trained wherever the options say."""
    if not cells:
        yield iter(())
    elif scheduler is None:
        yield on_this_machine(cells, out, command, jobs or joblib.cpu_count())
    else:
        with _connect(scheduler) as client:
            yield on_cluster(cells, out, command, client)


def _connect(scheduler: str) -> Client:
    """A connection to a Dask scheduler, whose workers may still have to come."""
    try:
        from distributed import Client
    except ImportError:
        raise UserError("--scheduler needs Dask: pip install 'mild-viz[cluster]'") from None
    try:
        client = Client(scheduler, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"no Dask scheduler answers at {scheduler}: {error}; expected its address, such as tcp://login1:8786"
        ) from None
    if not client.scheduler_info()["workers"]:
        _say(f"{scheduler} has no worker yet: the cells wait for the first one")
    return client


def _keep(outcome: Outcome, out: Path) -> dict[str, Any] | None:
    """The config.json of a cell that was trained; for one that failed, None, and why in its error file."""
    found = None if outcome.failure else finished(outcome.cell, out)
    file = _error_file(outcome.cell, out)
    if found is not None:
        file.unlink(missing_ok=True)
        return found
    why = outcome.trace or f"its model is not in {out}: every worker must see this folder under this name\n"
    write_atomically(file, lambda temporary: temporary.write_text(why, encoding="utf-8"))
    return None


def _line(outcome: Outcome, rows: Sequence[dict[str, Any]], count: int, n_cells: int, since: float) -> str:
    """What a person reads of one cell, and about how long the rest will take."""
    if rows:
        result = f"held-out {np.mean([row['held_out_mse'] for row in rows]):.4f}, {outcome.seconds:.1f} s"
    else:
        result = f"failed: {outcome.failure or 'no model came of it'}"
    left = (time.monotonic() - since) / count * (n_cells - count)
    rest = f"; about {timedelta(seconds=round(left))} left" if count < n_cells else ""
    return f"[{count}/{n_cells}] {outcome.cell.name}: {result}{rest}"
