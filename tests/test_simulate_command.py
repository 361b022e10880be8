"""The command `mild-viz simulate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mild_viz import cli


def test_it_prints_and_writes_the_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, motions = tmp_path / "table.csv", tmp_path / "motions"
    assert cli.main(["simulate", "--trials", "4", "--csv", str(table), "--out", str(motions)]) == 0
    printed = capsys.readouterr().out
    assert "demo/test, v3.1, mild-ik" in printed
    rows = pd.read_csv(table).set_index(["scenario", "stiffness"])
    assert list(rows.index) == [(s, k) for s in ("commanded", "human-led") for k in ("fixed", "schedule")]
    assert (rows["grips"] == 1).all()
    for scenario in ("commanded", "human-led"):
        fixed, schedule = rows.loc[(scenario, "fixed")], rows.loc[(scenario, "schedule")]
        assert f"{fixed['force_peak']:.1f} → {schedule['force_peak']:.1f}" in printed
        assert schedule["force_rms"] < fixed["force_rms"]
        with np.load(motions / f"test-4-{scenario}.npz") as arrays:
            held = arrays["schedule_gripped"]
            assert arrays["schedule_force_peak"][held].max() == pytest.approx(schedule["force_peak"])
    # a softer robot and a softer human: less force
    assert cli.main(["simulate", "--trials", "4", "--csv", str(table), "--human-stiffness", "100"]) == 0
    soft = pd.read_csv(table).set_index(["scenario", "stiffness"])
    assert (soft["force_rms"] < rows["force_rms"]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--action jump", "action 'jump' is unknown; valid: wave"),
        ("--trials 99", "has no trial 99"),
        ("--human-stiffness 0", "stiffness is 0.0; valid"),
        ("--saturation -1", "saturation is -1.0; valid"),
        (
            "--dataset handover --action handover --trials 0",
            "nothing that joint 'panda_joint1' moves has an <inertial>",
        ),
        ("--csv {tmp}/a.txt", "must end in .csv"),
        ("--out {tmp}/file", "cannot be made"),
    ],
)
def test_what_it_cannot_do_is_said(
    arguments: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["simulate", *arguments.format(tmp=tmp_path).split()]) == 2
    assert message in capsys.readouterr().err


def test_a_wave_never_meets(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["simulate", "--action", "wave", "--trials", "0"]) == 0
    assert "never met" in capsys.readouterr().out
