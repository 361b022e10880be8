"""The command line: help that documents, clear errors, a quick start."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from mild_viz import cli, paths, run_options
from mild_viz.errors import UserError
from mild_viz.robot.source import RobotSource
from mild_viz.settings import CONTROLLERS, OTHER_ARM, VARIANTS

REPOSITORY = Path(__file__).resolve().parents[1]
COMMANDS = [name for name in cli.COMMANDS if name != "data"] + [f"data {name}" for name in cli.DATA_COMMANDS]


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What `--help` prints."""
    with pytest.raises(SystemExit) as leaving:
        cli.main([*command.split(), "--help"])
    assert leaving.value.code in (0, None)
    return capsys.readouterr().out


def test_main_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of("", capsys)
    for name in cli.COMMANDS:
        assert re.search(rf"^\W+{name}\s+[A-Z]", text, re.MULTILINE), name


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_every_option(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each option is there, with what it means, and an example of what to type."""
    text = " ".join(help_of(command, capsys).split())
    assert text.startswith(f"usage: mild-viz {command} ")
    assert "{None}" not in text  # how a type reads in Python is no help
    function = cli.DATA_COMMANDS[command.split()[1]] if command.startswith("data ") else cli.COMMANDS[command]
    options = dict.fromkeys(inspect.signature(function).parameters, function)
    if options.pop("run", None):
        group = get_type_hints(function)["run"]
        options |= {field.name: group for field in dataclasses.fields(group)}
    if "trials" in options:
        del options["trial"]  # it stands for it
    for name, source in options.items():
        docs = [one.__doc__ or "" for one in (source.__mro__ if isinstance(source, type) else (source,))]
        text_of = "\n".join(inspect.cleandoc(doc) for doc in docs)  # options are inherited, and so is their help
        found = re.search(rf"^ {{4,8}}{name}: (.+)$", text_of, re.MULTILINE)
        assert found, f"{command}: {name} is not documented"
        sentence = " ".join(found[1].split())
        assert sentence in text or sentence.rstrip(".") in text
        positional = "Positional" in str(inspect.signature(function).parameters.get(name, ""))
        option = name.replace("_", "-")
        switch = f"--{option}, --no-{option} " in text
        assert positional or switch or f"--{option} " in text
        assert positional or switch or name == "json" or re.search(r"Example: --|Default: ", sentence), name
    assert not options or "Example: " in text


def test_help_fits_a_narrow_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of("rollout", capsys)
    assert max(len(line) for line in text[text.index(" options") :].splitlines()) <= 80


def test_choices_are_those_of_the_tables() -> None:
    assert get_args(run_options.VariantName) == tuple(VARIANTS)
    assert get_args(run_options.ControllerName) == CONTROLLERS
    assert get_args(run_options.SourceName) == get_args(RobotSource)
    assert get_args(run_options.OtherArmName) == OTHER_ARM


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("rollout --dataset nothing --out {tmp}/a.npz", "'nothing' is unknown; valid: demo"),
        ("rollout --checkpoint {tmp}/none --out {tmp}/a.npz", "is not a checkpoint"),
        ("rollout --out {tmp}/a.txt", "must end in .npz"),
        ("rollout --out {tmp}/none/a.npz", "there is no folder"),
        ("rollout --trial 9999 --out {tmp}/a.npz", "has no trial 9999; valid: 0 to"),
        ("rollout --trial -1 --out {tmp}/a.npz", "has no trial -1; valid: 0 to"),
        ("rollout --contact-states 99 --out {tmp}/a.npz", "[99] do not exist; valid: 0 to"),
        ("rollout --lambda-x -1 --out {tmp}/a.npz", "lambda_x is -1.0; valid"),
        ("rollout --smoothing 0 --out {tmp}/a.npz", "smoothing is 0.0; valid"),
        ("rollout --robot {tmp}/none.urdf --out {tmp}/a.npz", "none.urdf"),
        ("record --out {tmp}/a.htm", "must end in .html"),
        ("record --out {tmp}/a.html --csv {tmp}/a.html", "must end in .csv"),
        ("evaluate --checkpoint {tmp}/none", "is not a checkpoint"),
        ("evaluate --dataset nothing", "no model ships for dataset 'nothing'"),
        ("evaluate --json {tmp}/a.csv", "must end in .json"),
        ("evaluate --csv {tmp}/a.json", "must end in .csv"),
        ("evaluate --markdown {tmp}/a.txt", "must end in .md"),
        ("evaluate --latex {tmp}/a.txt", "must end in .tex"),
        ("evaluate --compare v3.1 nothing --json {tmp}/a.json", "--compare 'nothing' is unknown; valid: v1, v2.1"),
        ("train --dataset nothing --out {tmp}/run", "nothing"),
        ("data fetch nothing", "nothing"),
        ("data check {tmp}/none.npz", "none.npz"),
        ("import-published {tmp}/none.pth --out {tmp}/run", "none.pth does not exist"),
        ("app --dataset nothing", "'nothing' is unknown; valid: demo"),
    ],
)
def test_unusable_input_is_refused_with_a_message(
    arguments: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert leave_code(arguments.format(tmp=tmp_path).split()) == 2
    captured = capsys.readouterr()
    assert expected in " ".join((captured.err + captured.out).split())
    assert "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        "",
        "nothing",
        "rollout",
        "rollout --out a.npz --variant v9",
        "rollout --out a.npz --controller nothing",
        "rollout --out a.npz --split validation",
        "rollout --out a.npz --trial first",
        "app --port http",
        "train --out a --stage third",
        "data",
        "data fetch",
    ],
)
def test_unknown_words_are_refused(arguments: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert leave_code(arguments.split()) == 2
    assert capsys.readouterr().err


def leave_code(arguments: list[str]) -> int | str | None:
    try:
        return cli.main(arguments)
    except SystemExit as leaving:
        return leaving.code


def test_rollout_writes_its_arrays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    from mild_viz.rollout import SAVED

    out = tmp_path / "trial.npz"
    assert cli.main(["rollout", "--trial", "1", "--variant", "v2.1", "--controller", "mild", "--out", str(out)]) == 0
    assert "v2.1" in capsys.readouterr().out
    with np.load(out) as arrays:
        assert set(arrays.files) == set(SAVED)
        assert {len(arrays[name]) for name in SAVED} == {len(arrays["time"])}
        assert np.isfinite(arrays["joints_commanded"]).all()


def test_app_script_answers_with_one_line() -> None:
    program = subprocess.Popen(
        [sys.executable, "app.py", "--dataset", "nothing"], cwd=REPOSITORY, stderr=subprocess.PIPE, text=True
    )
    _, message = program.communicate(timeout=60)
    assert program.returncode == 2
    assert message.startswith("app.py: error: ") and message.count("\n") == 1


def test_start_is_quick_and_imports_nothing_heavy() -> None:
    heavy = "('torch', 'numba', 'scipy', 'pandas', 'viser', 'trimesh', 'numpy')"
    code = f"import sys, mild_viz.cli; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
    durations = []
    for _ in range(3):
        start = time.perf_counter()
        subprocess.run([sys.executable, "app.py", "--help"], cwd=REPOSITORY, capture_output=True, check=True)
        durations.append(time.perf_counter() - start)
    assert min(durations) < 1.0


def test_shipped_folders_are_found_or_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (paths.assets() / "urdf").is_dir()
    assert paths.checkpoints().is_dir()
    monkeypatch.setattr(paths, "PACKAGE", tmp_path / "site-packages" / "mild_viz")
    with pytest.raises(UserError, match="install from a complete clone"):
        paths.assets()
    (tmp_path / "site-packages" / "mild_viz" / "assets").mkdir(parents=True)
    assert paths.assets() == tmp_path / "site-packages" / "mild_viz" / "assets"


def test_default_checkpoint_follows_the_dataset() -> None:
    assert paths.default_checkpoint("nuisi") == paths.checkpoints() / "nuisi-pepper"
    with pytest.raises(UserError, match="models ship for demo, nuisi"):
        paths.default_checkpoint("buetepage")
