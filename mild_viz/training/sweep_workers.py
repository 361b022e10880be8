"""Where the cells of a sweep are trained: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError

from mild_viz.checkpoint.config import read_json
from mild_viz.checkpoint.folder import CONFIG
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.training.run import train
from mild_viz.training.state import HeldError
from mild_viz.training.sweep_config import Cell

if TYPE_CHECKING:
    from distributed import Client

POLL = 1.0
"""Between two looks at a cell that another process is training [s]."""


@dataclass(frozen=True)
class Outcome:
    """What became of a cell."""

    cell: Cell
    seconds: float
    failure: str = ""
    """One line that says why there is no result; empty where there is one."""
    trace: str = ""
    """The traceback of the failure."""

    @classmethod
    def failed(cls, cell: Cell, error: BaseException, seconds: float = 0.0) -> Outcome:
        """The outcome of a cell that ended with an error."""
        root = error
        while root.__cause__ is not None:
            root = root.__cause__
        line = "".join(traceback.format_exception_only(root)).splitlines()[0]
        return cls(cell, seconds, line, "".join(traceback.format_exception(error)))


def checksum(dataset: str) -> str | None:
    """The recordings' checksum; None where they are not at hand."""
    try:
        return load_dataset(dataset).checksum
    except UserError:
        return None


def finished(cell: Cell, out: Path) -> dict[str, Any] | None:
    """The config.json that the cell left in its folder below `out`, if it was made by this training on these data."""
    try:
        config = read_json(out / cell.name / CONFIG)
        training = config["training"]
        found = {**training["run"], "options": training["options"]}
    except (UserError, KeyError, TypeError):  # absent, or not ours
        return None
    known = checksum(cell.dataset)
    expected = {**asdict(cell), "variants": list(cell.variants), "checksum": known or found.get("checksum")}
    expected["options"] = {k: list(v) if isinstance(v, tuple) else v for k, v in expected["options"].items()}
    return config if all(found.get(key) == value for key, value in expected.items()) else None


def run_cell(cell: Cell, out: Path, command: str) -> Outcome:
    """Train one cell into its folder below `out`, from its saved state where there is one. Never raises an error.

    A cell that another process is at, such as a worker that outlived a killed sweep, is waited for.
    """
    started = time.monotonic()
    try:
        while finished(cell, out) is None:
            try:
                train(
                    cell.dataset, cell.stage, cell.variants, out=out / cell.name, options=cell.options,
                    resume=None, command=command, quiet=True,
                )  # fmt: skip
                break
            except HeldError:
                time.sleep(POLL)
    except Exception as error:
        return Outcome.failed(cell, error, time.monotonic() - started)
    return Outcome(cell, time.monotonic() - started)


def on_this_machine(cells: Sequence[Cell], out: Path, command: str, jobs: int) -> Iterator[Outcome]:
    """Train cells in `jobs` processes; yields outcomes as they come.

    A process that dies (out of memory, say) takes its neighbours with it. Those that were at work are then tried
    again one at a time, so that the one to blame shows, and does not stop the rest.
    """
    remaining = dict.fromkeys(cells)
    while remaining:
        given: list[Cell] = []

        def tasks(given: list[Cell] = given) -> Iterator[Any]:
            for cell in list(remaining):
                given.append(cell)
                yield delayed(run_cell)(cell, out, command)

        try:
            # Of one job, joblib would make none but this process.
            for outcome in _parallel(tasks(), n_jobs=max(jobs, 2), pre_dispatch=jobs, backend="loky"):
                del remaining[outcome.cell]
                yield outcome
        except TerminatedWorkerError as error:
            lost = [cell for cell in given if cell in remaining]
            for cell in lost:
                del remaining[cell]
            if len(lost) > 1:
                for cell in lost:
                    yield from on_this_machine([cell], out, command, 1)
            else:
                yield from (Outcome.failed(cell, error) for cell in lost)


def on_cluster(cells: Sequence[Cell], out: Path, command: str, client: Client) -> Iterator[Outcome]:
    """Train cells on the workers of a Dask cluster, which see the folder `out`; yields outcomes as they come.

    Dask gives the cells of a worker that died to others, up to the scheduler's `allowed-failures` times.
    """
    from distributed.client import FutureCancelledError
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):
        """joblib's (1.6), mended for clusters whose workers come and go."""

        def effective_n_jobs(self, n_jobs: int) -> int:
            return 2  # of one worker joblib would make none but this process, and of none yet an error

        # Without this, joblib would wait for ever for a task of which Dask has given up.
        def submit(self, func: Any, callback: Any = None) -> Any:
            ((_, (cell, *_), _),) = func.items
            job = super().submit(func, callback)

            def tell(done: Any) -> None:
                if (error := done.exception()) is not None:
                    callback([Outcome.failed(cell, error)])

            job.add_done_callback(tell)
            return job

    calls = (delayed(run_cell)(cell, out, command) for cell in cells)
    try:
        with parallel_config(backend=Backend(client=client)):
            # All at once: workers that come later than the first find cells waiting for them.
            yield from _parallel(calls, n_jobs=-1, pre_dispatch="all")
    except FutureCancelledError as error:
        raise UserError(f"the Dask scheduler is gone ({error}); what is done is kept: start the sweep again") from None


def _parallel(calls: Iterator[Any], **options: Any) -> Iterator[Outcome]:
    options |= {"batch_size": 1, "return_as": "generator_unordered"}
    yield from cast(Iterator[Outcome], Parallel(**options)(calls))
