"""Sweeps for real: processes and a Dask cluster, killed in the middle; what is kept, redone, reported and ranked."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from mild_viz.errors import UserError
from mild_viz.training import sweep_workers
from mild_viz.training.options import TrainingOptions
from mild_viz.training.state import HeldError, RunState, state_folder
from mild_viz.training.sweep import sweep
from mild_viz.training.sweep_config import Cell, read_sweep_config
from mild_viz.training.sweep_results import summary
from mild_viz.training.sweep_workers import Outcome, finished, on_cluster, on_this_machine, run_cell
from tests.test_sweep_config import PROGRAM, REPOSITORY

QUICK = TrainingOptions(seeds=1, human_epochs=2, robot_epochs=2, em_iterations=2, final_em_iterations=2)
CONFIG = """
out = "{out}"
datasets = [{datasets}]
variants = ["v3.1"]
seeds = {seeds}
options = {{ seeds = 1, human_epochs = {epochs}, robot_epochs = {epochs}, em_iterations = 2, final_em_iterations = 2 }}
"""


def write(folder: Path, seeds: list[int], epochs: int, datasets: str = '"demo"') -> Path:
    file = folder / "sweep.toml"
    file.write_text(CONFIG.format(out=folder / "out", seeds=seeds, epochs=epochs, datasets=datasets))
    return file


def start(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    """`mild-viz sweep` in a process group of its own."""
    return subprocess.Popen(
        [*PROGRAM, "sweep", *arguments], cwd=REPOSITORY, env={**os.environ, **environment}, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def ended(program: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and all that was said."""
    said, _ = program.communicate(timeout=180)
    return program.returncode, said


def wait_until(condition: Callable[[], Any], program: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert program.poll() is None, ended(program)
        assert time.monotonic() < deadline
        time.sleep(0.02)


def models(out: Path) -> dict[str, int]:
    """Finished cells and when they were made."""
    return {file.parent.name: file.stat().st_mtime_ns for file in out.glob("*/config.json")}


def test_killed_interrupted_and_started_again_it_redoes_only_what_is_unfinished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = write(tmp_path, [0, 1, 2], 6), tmp_path / "out"
    program = start(str(file), "--jobs", "2")
    wait_until(lambda: list(out.glob(".*.training/human.pt")), program)
    os.killpg(program.pid, signal.SIGINT)
    status, said = ended(program)
    assert status == 130 and "Traceback" not in said
    assert f"Go on with:\n  mild-viz sweep {file} --jobs 2" in said

    program = start(str(file), "--jobs", "2")
    wait_until(lambda: models(out), program)
    os.killpg(program.pid, signal.SIGKILL)
    ended(program)
    before = models(out)
    assert 1 <= len(before) < 3

    # Now also a dataset that is not there, in the middle of the others.
    write(tmp_path, [0, 1, 2], 6, '"nuisi", "demo"')
    (tmp_path / "empty").mkdir()
    status, said = ended(start(str(file), MILD_VIZ_DATA=str(tmp_path / "empty")))
    assert status == 1
    assert f"6 cells, of which {len(before)} are finished" in said
    after = models(out)
    assert len(after) == 3 and {name: after[name] for name in before} == before
    traces = list(out.glob("*.error.txt"))
    assert len(traces) == 3
    for trace in traces:
        assert "Traceback" in trace.read_text() and "mild-viz data fetch nuisi" in trace.read_text()
        assert f"traceback is in {trace}" in said
    assert not list(out.glob(".*"))
    table = pd.read_csv(out / "results.csv")
    assert len(table) == 3 * 4 and set(table.cell) == set(after) and table.held_out_mse.notna().all()

    # A narrower config: what still belongs is kept, what does not is named and stays.
    write(tmp_path, [0], 6)
    assert sweep(file) == 0
    said = capsys.readouterr().out
    assert "1 cells, of which 1 are finished" in said
    assert models(out) == after
    strangers = sorted(name for name in after if "seed0" not in name)
    assert f"left as they are: {', '.join(strangers)}" in said


def cell(seed: int) -> Cell:
    return Cell("demo", "hri", ("v3.1",), replace(QUICK, seed=seed))


def run_or_die(of: Cell, out: Path, command: str) -> Outcome:
    """Stands for `run_cell` where a training uses up the memory: seed 1 is killed, whenever it is tried."""
    (out / f"tried-{of.options.seed}-{os.getpid()}").touch()
    time.sleep(0.3)
    if of.options.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(of, 0.0)


def test_a_process_that_dies_does_not_stop_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_workers, "run_cell", run_or_die)
    outcomes = {o.cell.options.seed: o for o in on_this_machine([cell(n) for n in range(4)], tmp_path, "", jobs=2)}
    assert outcomes.keys() == {0, 1, 2, 3}
    assert "TerminatedWorkerError" in outcomes.pop(1).failure
    assert not any(o.failure for o in outcomes.values())
    assert len(list(tmp_path.glob("tried-1-*"))) == 2  # beside another, and alone
    assert str(os.getpid()) not in {path.name.split("-")[-1] for path in tmp_path.iterdir()}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from distributed import LocalCluster

    quiet: dict[str, Any] = {"dashboard_address": None, "silence_logs": 50}
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster:
        yield cluster


def test_a_dask_worker_that_dies_does_not_cost_a_cell(cluster: Any, tmp_path: Path) -> None:
    from distributed import Client

    file, out = write(tmp_path, [0, 1, 2, 3], 8), tmp_path / "out"
    with Client(cluster, set_as_default=False) as client:
        workers: Any = client.run(os.getpid)
        assert len(set(workers.values()) - {os.getpid()}) == 2
        program = start(str(file), "--scheduler", cluster.scheduler_address)
        wait_until(lambda: len(list(out.glob(".*.training/human.pt"))) == 2, program)
        os.kill(next(iter(workers.values())), signal.SIGKILL)
        begun = {path.parent.name for path in out.glob(".*.training/human.pt")}
        status, said = ended(program)
        assert status == 0 and len(begun) == 2
        assert len(models(out)) == 4 and "failed" not in said
        assert set(pd.read_csv(out / "results.csv").seed) == {0, 1, 2, 3}
        assert not list(out.glob(".*")) and not list(out.glob("*.error.txt"))
        after: Any = client.run(os.getpid)
        assert set(after.values()) != set(workers.values())


def test_a_cell_that_kills_dask_workers_is_reported(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import Client

    monkeypatch.setattr(sweep_workers, "run_cell", run_or_die)
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 1)
    with Client(cluster, set_as_default=False) as client:
        outcomes = list(on_cluster([cell(1)], tmp_path, "", client))
    assert "KilledWorker" in outcomes[0].failure and len(list(tmp_path.glob("tried-1-*"))) == 2


def test_no_scheduler_is_said(tmp_path: Path) -> None:
    file = write(tmp_path, [0], 1)
    with pytest.raises(UserError, match="no Dask scheduler answers at nonsense://x"):
        sweep(file, scheduler="nonsense://x")


def test_a_cell_is_finished_only_by_its_own_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = cell(0)
    assert run_cell(first, tmp_path, "mild-viz sweep x.toml").failure == ""
    config = finished(first, tmp_path)
    assert config is not None and config["training"]["command"] == "mild-viz sweep x.toml"
    made = models(tmp_path)
    assert run_cell(first, tmp_path, "") and models(tmp_path) == made
    (tmp_path / first.name).rename(tmp_path / cell(1).name)
    assert finished(cell(1), tmp_path) is None and finished(first, tmp_path) is None
    (tmp_path / cell(1).name).rename(tmp_path / first.name)
    monkeypatch.setattr(sweep_workers, "checksum", lambda _: "recordings that have changed")
    assert finished(first, tmp_path) is None


def test_a_cell_in_other_hands_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of = cell(0)
    description = {"dataset": "demo", "checksum": "", "stage": "hri", "variants": ["v3.1"]}
    state = RunState(tmp_path / of.name, description, of.options, resume=None)
    with pytest.raises(HeldError, match="held by another run"):
        RunState(tmp_path / of.name, description, of.options, resume=None)

    def let_go(_: float) -> None:
        state.finish()

    monkeypatch.setattr(time, "sleep", let_go)
    assert run_cell(of, tmp_path, "").failure == "" and finished(of, tmp_path)
    assert not state_folder(tmp_path / of.name).exists()


def test_a_folder_that_is_not_shared_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write(tmp_path, [0], 1)
    monkeypatch.setattr("mild_viz.training.sweep.on_this_machine", lambda cells, *_: (Outcome(c, 1.0) for c in cells))
    assert sweep(file) == 1
    (of,) = read_sweep_config(file).cells()
    assert "every worker must see this folder" in (tmp_path / "out" / f"{of.name}.error.txt").read_text()
    assert "no model came of it" in capsys.readouterr().out


def test_settings_are_ranked_by_held_out_error_never_by_the_test_split() -> None:
    nan = float("nan")

    def rows(beta: float, held_out: list[float], test: list[float]) -> list[dict[str, Any]]:
        shared = {"dataset": "demo", "variant": "v3.1", "beta": beta}
        return [
            {
                **shared,
                "cell": f"{beta}-{seed}",
                "seed": seed,
                "fold": -seed,
                "action": action,
                "held_out_mse": one,
                "test_mse": two,
            }
            for seed, (one, two) in enumerate(zip(held_out, test, strict=True))
            for action in ("wave", "handshake")
        ]

    table = summary(
        rows(0.1, [3, 3, 9], [1, 1, 1]) + rows(0.2, [1, 2, nan], [0, 0, 0]) + rows(0.3, [2, 2, 5], [9, 9, 9])
    )
    columns = {str(column.header): list(column.cells) for column in table.columns}
    assert list(columns) == [
        "dataset", "variant", "beta", "runs", "held-out mean", "held-out median",
    ]  # fmt: skip
    assert columns["beta"] == ["0.3", "0.1", "0.2"]  # an error that is no number is never best, and shows
    assert columns["held-out mean"] == ["3.0000", "5.0000", "nan"]
    assert columns["held-out median"] == ["2.0000", "3.0000", "nan"]
    assert columns["runs"] == ["3", "3", "3"]
