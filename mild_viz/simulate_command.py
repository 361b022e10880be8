"""The command of `mild-viz` that simulates how the arm gives way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mild_viz.errors import UserError
from mild_viz.run_options import OptionalPath, OptionalStates, RunOptions, check_output, documented

if TYPE_CHECKING:
    from mild_viz.simulation.compare import Comparison

COLUMNS = ("force_peak", "force_rms", "displacement_peak", "human_displacement_peak")
"""What the table tells of every run, as `simulation.motion.Summary` names it."""

HEADS = ("force peak [N]", "force rms [N]", "robot's hand [cm]", "human's hand [cm]")


@documented
@dataclass(frozen=True)
class SimulateOptions(RunOptions):
    trial: Annotated[int, tyro.conf.Suppress] = 0


def simulate(
    run: SimulateOptions,
    action: str = "handshake",
    trials: OptionalStates = None,
    human_stiffness: float = 300.0,
    saturation: float = 0.1,
    gravity_compensation: bool = True,
    out: OptionalPath = None,
    csv: OptionalPath = None,
) -> None:
    """Simulate how the arm gives way to the human's hand, with full stiffness and with the schedule.

    Joint impedance control of the commands in MuJoCo (pip install "mild-viz[sim]"), the human's hand on the robot's by
    a spring and a damper while they touch. Two scenarios: the robot is commanded as it was ("commanded"); or its
    command stands still while the hands hold each other, so that the human alone shakes ("human-led"). The table has
    the peak and the root mean square of the force between the hands, and the largest distance of the robot's hand from
    its command and of the human's from where it was recorded. Masses and stiffnesses are estimates: compare figures
    with each other, not with a force sensor. Example: mild-viz simulate --dataset nuisi --csv compliance.csv

    Args:
        run: What to run.
        action: Interaction whose trials are simulated. Example: --action rocket
        trials: Trials of the split, from 0. Default: all of the action. Example: --trials 3 4
        human_stiffness: Stiffness of the human's arm, felt at the hand [N/m]. Example: --human-stiffness 150
        saturation: Deviation at which a joint of full stiffness gives its whole torque [rad]; half of it doubles the
            robot's stiffness. Example: --saturation 0.05
        gravity_compensation: Let the motors carry the arm's weight.
        out: Folder for the motions, one .npz file for each trial and scenario; it is created. Example: --out motions
        csv: File for the table, one row for each trial, scenario and stiffness. Example: --csv compliance.csv
    """
    if csv is not None:
        check_output(csv, ".csv")
    if out is not None:
        _make_folder(out)
    from mild_viz.data.load import load_dataset
    from mild_viz.settings import choose
    from mild_viz.simulation.compare import SCENARIOS, compare
    from mild_viz.simulation.settings import HumanHand, Impedance

    impedance = Impedance(saturation=saturation, gravity_compensation=gravity_compensation)
    hand = HumanHand(stiffness=human_stiffness)
    dataset = load_dataset(run.dataset)
    choose(f"{dataset.name}: action", action, dataset.actions)
    numbers = trials or [trial.index for trial in dataset.split(run.split) if trial.action == action]
    if not numbers:
        raise UserError(f"{dataset.name}/{run.split} has no {action}; its actions: {', '.join(dataset.actions)}")
    found: list[tuple[int, Comparison]] = []
    variant = controller = ""
    for number in numbers:
        rollout, robot = replace(run, trial=number).run()
        variant, controller = rollout.inference.variant, rollout.controller
        for scenario in SCENARIOS:
            comparison = compare(robot, rollout, scenario, impedance, hand)
            found.append((number, comparison))
            if out is not None:
                comparison.save(out / f"{run.split}-{number}-{scenario}.npz")
    _print(f"{run.dataset}/{run.split}, {variant}, {controller}: full stiffness → schedule", found)
    if out is not None:
        print(f"{out}: {len(found)} motions")
    if csv is not None:
        _write_csv(csv, found)
        print(f"{csv}: {2 * len(found)} rows")


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made: {error.strerror}; name a folder for the motions") from error


def _row(comparison: Comparison) -> list[list[float]]:
    """For each of `COLUMNS`: full stiffness, schedule [N and cm]."""
    summaries = [comparison.motions[name].summary() for name in ("fixed", "schedule")]
    return [
        [getattr(summary, column) * (1.0 if column.startswith("force") else 100.0) for summary in summaries]
        for column in COLUMNS
    ]


def _print(title: str, found: list[tuple[int, Comparison]]) -> None:
    """One row a trial and scenario, then the scenario's mean."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table("trial", "scenario", *HEADS, title=title)
    for scenario in dict.fromkeys(comparison.scenario for _, comparison in found):
        rows = [(number, comparison) for number, comparison in found if comparison.scenario == scenario]
        for number, comparison in rows:
            cells = [f"{fixed:.1f} → {schedule:.1f}" for fixed, schedule in _row(comparison)]
            table.add_row(str(number), scenario, *(cells if comparison.grips else ["never met"] * len(HEADS)))
        met = [_row(comparison) for _, comparison in rows if comparison.grips]
        if met:
            means = np.mean(met, axis=0)
            cells = [f"{a:.1f} → {b:.1f} ({100 * (b / a - 1) if a else 0:+.0f} %)" for a, b in means]
            table.add_row("mean", scenario, *cells, end_section=True, style="bold")
    Console().print(table)


def _write_csv(path: Path, found: list[tuple[int, Comparison]]) -> None:
    """The table in long form, in SI units."""
    import pandas as pd

    from mild_viz.files import write_atomically

    rows = [
        {"trial": number, "scenario": comparison.scenario, "stiffness": name, "grips": len(comparison.grips)}
        | {column: getattr(motion.summary(), column) for column in COLUMNS}
        for number, comparison in found
        for name, motion in comparison.motions.items()
    ]
    write_atomically(path, lambda temporary: pd.DataFrame(rows).to_csv(temporary, index=False))
