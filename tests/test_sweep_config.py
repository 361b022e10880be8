"""Configs of training and sweeps: strict reading, the nearest key, and which cells a sweep has."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from mild_viz import cli
from mild_viz.checkpoint import load_checkpoint
from mild_viz.errors import UserError
from mild_viz.settings import VARIANTS
from mild_viz.training.config import OPTIONS, read_train_config
from mild_viz.training.options import TrainingOptions
from mild_viz.training.state import state_folder
from mild_viz.training.sweep_config import Cell, read_sweep_config

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = [sys.executable, "-c", "import sys; from mild_viz.cli import main; sys.exit(main())"]


def write(folder: Path, text: str) -> Path:
    file = folder / "config.toml"
    file.write_text(text)
    return file


def test_the_example_parses_and_its_cells_are_every_combination() -> None:
    config = read_sweep_config(REPOSITORY / "configs" / "sweep-example.toml")
    cells = config.cells()
    assert len(cells) == len({cell.name for cell in cells}) == 4 * 2
    assert {cell.options.beta for cell in cells} == {1e-3, 5e-3}
    assert {cell.options.seed for cell in cells} == {0, 1, 2, 3}
    assert {(cell.dataset, cell.stage, cell.variants, cell.options.seeds) for cell in cells} == {
        ("nuisi", "hri", ("v1", "v2.1", "v2.2", "v3.1", "v3.2"), 1)
    }


def test_groups_and_plain_names_of_variants(tmp_path: Path) -> None:
    text = 'datasets = ["demo", "nuisi"]\nvariants = ["v1", ["v3.1", "v3.2"]]\ngrid.hidden = [[8, 4], [40, 20]]'
    cells = read_sweep_config(write(tmp_path, text)).cells()
    assert len(cells) == 8
    assert {cell.variants for cell in cells} == {("v1",), ("v3.1", "v3.2")}
    assert {cell.options.hidden for cell in cells} == {(8, 4), (40, 20)}
    assert len({cell.name for cell in cells}) == 8
    twice = 'datasets = ["demo", "demo"]\nseeds = [1, 1]'
    assert len(read_sweep_config(write(tmp_path, twice)).cells()) == 1


def test_a_cell_keeps_its_name_however_the_config_says_it(tmp_path: Path) -> None:
    names = set()
    for text in ("[options]\nbeta = 1e-3", "[grid]\nbeta = [1e-3]\nlatent_size = [5]", "[grid]\nbeta = [0.001]"):
        names |= {cell.name for cell in read_sweep_config(write(tmp_path, f'datasets = ["demo"]\n{text}')).cells()}
    (name,) = names
    assert name.startswith("demo-v1+v2.1+v2.2+v3.1+v3.2+v4-seed0-beta0.001-")


def test_everything_that_decides_a_run_decides_its_name() -> None:
    plain = Cell("demo", "hri", ("v3.1",), TrainingOptions())
    others = [dataclasses.replace(plain, **change) for change in ({"dataset": "nuisi"}, {"stage": "hhi"})]
    others += [dataclasses.replace(plain, variants=("v3.1", "v1"))]
    for field in dataclasses.fields(TrainingOptions):
        value = getattr(plain.options, field.name)
        others_of = {str: {"hmm": "hsmm", "cpu": "cuda"}.get, bool: lambda flag: not flag, tuple: lambda _: (9, 7)}
        changed = others_of.get(type(value), lambda number: number + 1)(value)
        others.append(dataclasses.replace(plain, options=dataclasses.replace(plain.options, **{field.name: changed})))
    names = {cell.name for cell in (plain, *others)}
    assert len(names) == 1 + len(others)
    most = Cell("handover", "hri", tuple(VARIANTS), dataclasses.replace(others[-1].options, hidden=(9999, 9999)))
    assert max(map(len, [*names, most.name])) <= 110


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('dataset = ["demo"]', "unknown key 'dataset'; did you mean 'datasets'? valid: datasets, grid, options"),
        ("seeds = [0]", "datasets is missing"),
        ('datasets = "demo"', "datasets is 'demo', expected a list: [...]"),
        ('datasets = ["moon"]', "dataset 'moon' is unknown; valid: demo, nuisi"),
        ("datasets = []", "datasets is an empty list"),
        ('datasets = ["demo"]\nvariants = ["v3.1", ["v9"]]', "variant 'v9' is unknown; valid: v1"),
        ('datasets = ["demo"]\nvariants = ["v3.1", []]', "a group of variants is an empty list"),
        ('datasets = ["demo"]\nvariants = "v3.1"', "variants is 'v3.1', expected a list"),
        ('datasets = ["demo"]\nseeds = 4', "seeds is 4, expected a list"),
        ('datasets = ["demo"]\nseeds = [true]', "seeds: an entry is True, expected a whole number"),
        ('datasets = ["demo"]\nseeds = [-1]', "seed is -1; valid: 0 to"),
        ('datasets = ["demo"]\nstage = "all"', "stage 'all' is unknown; valid: hhi, hri"),
        ('datasets = ["demo"]\nbeta = 1.0', "beta belongs under [options] or, as a list of values, under [grid]"),
        ('datasets = ["demo"]\noptions.betta = 1.0', "[options]: unknown key 'betta'; did you mean 'beta'?"),
        ('datasets = ["demo"]\ngrid.beta = 1.0', "grid.beta is 1.0, expected a list"),
        ('datasets = ["demo"]\ngrid.beta = []', "grid.beta is an empty list"),
        ('datasets = ["demo"]\ngrid.beta = [1.0, "a"]', "grid.beta: an entry is 'a', expected a finite number"),
        ('datasets = ["demo"]\ngrid.beta = [-1.0]', "beta is -1.0; valid: 0 or more"),
        ('datasets = ["demo"]\ngrid.hidden = [[40]]', "grid.hidden: an entry is [40], expected a list of 2: [...]"),
        ('datasets = ["demo"]\noptions.hidden = [40, 0]', "hidden is (40, 0); valid: 1 to"),
        ('datasets = ["demo"]\noptions.learning_rate = nan', "options.learning_rate is nan, expected a finite number"),
        ('datasets = ["demo"]\noptions.learning_rate = 0', "learning_rate is 0.0; valid: a finite number above 0"),
        ('datasets = ["demo"]\noptions.batch_size = 2.0', "options.batch_size is 2.0, expected a whole number"),
        ('datasets = ["demo"]\noptions.seed = 1', "[options]: seed is given by the list seeds"),
        ('datasets = ["demo"]\noptions = 3', "[options] is 3, expected a section"),
        ('datasets = ["demo"]\n[options]\nbeta = 1\n[grid]\nbeta = [1]', "is both under [options]"),
        ("datasets = [", "is not valid TOML"),
    ],
)  # fmt: skip
def test_a_wrong_sweep_is_refused(text: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path, text)
    assert cli.main(["sweep", str(file)]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"mild-viz: error: {file}") and expected in message
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("learning_rat = 1.0", "unknown key 'learning_rat'; did you mean 'learning_rate'?"),
        ("variant = []", "unknown key 'variant'; did you mean 'variants'?"),
        ("options = 1", "unknown key 'options'"),
        ("resume = true", "unknown key 'resume'"),
        ("dataset = 3", "dataset is 3, expected a text"),
        ('dataset = "demo"\nvariants = [3]', "variants: an entry is 3, expected a text"),
        ("seeds = 0", "dataset is missing"),
        ('dataset = "demo"\nseeds = 0', "seeds is 0; valid: 1 to 256"),
        (
            'dataset = "demo"\nepochs = 2\nrobot_epochs = 3',
            "epochs stands for all stages; leave out robot_epochs, or epochs",
        ),
    ],
)
def test_a_wrong_training_config_is_refused(text: str, expected: str, tmp_path: Path) -> None:
    file = write(tmp_path, text)
    with pytest.raises(UserError) as refused:
        read_train_config(file)
    assert str(refused.value).startswith(str(file)) and expected in str(refused.value)


def test_a_training_config_may_set_every_option(tmp_path: Path) -> None:
    values: dict[str, Any] = dataclasses.asdict(TrainingOptions(seed=3, beta=0.5, hidden=(12, 6)))
    assert values.keys() == OPTIONS.keys()
    text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())  # which is TOML, too
    read = read_train_config(write(tmp_path, f'dataset = "nuisi"\nvariants = ["v1"]\nout = "runs/x"\n{text}'))
    assert read.pop("options") == TrainingOptions(**values)
    assert read == {"dataset": "nuisi", "variants": ("v1",), "out": Path("runs/x")}
    brief = read_train_config(write(tmp_path, 'dataset = "demo"\nepochs = 7'))
    assert brief == {"dataset": "demo", "options": TrainingOptions(human_epochs=7, robot_epochs=7, joint_epochs=7)}
    read_train_config(REPOSITORY / "configs" / "train-example.toml")


def test_options_are_not_given_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path, 'dataset = "demo"')
    assert cli.main(["train", "--config", str(file), "--seeds", "2", "--epochs", "1"]) == 2
    assert "gives every option: leave out --seeds, --epochs, or write it there" in capsys.readouterr().err
    assert cli.main(["train", "--config", str(tmp_path / "none.toml")]) == 2
    assert "none.toml cannot be read: No such file" in capsys.readouterr().err
    assert cli.main(["sweep", str(file), "--jobs", "0"]) == 2
    assert "--jobs is 0; valid: 1 or more" in capsys.readouterr().err
    assert cli.main(["sweep", str(file), "--jobs", "2", "--scheduler", "tcp://x:1"]) == 2
    assert "leave out one" in capsys.readouterr().err


def test_ctrl_c_keeps_the_state_and_says_how_to_go_on(tmp_path: Path) -> None:
    file = write(tmp_path, 'dataset = "demo"\nvariants = ["v3.1"]\nseeds = 1\nhuman_epochs = 4\nrobot_epochs = 4000')
    out = tmp_path / "model"
    command = ["train", "--config", str(file), "--out", str(out)]
    with subprocess.Popen([*PROGRAM, *command], cwd=REPOSITORY, stderr=subprocess.PIPE, text=True) as program:
        wait_for(state_folder(out) / "robot.pt", program)
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=60)
    assert program.returncode == 130 and "Traceback" not in said
    again = said.strip().splitlines()[-1].strip()
    assert again == f"mild-viz {' '.join(command)} --resume"
    assert not out.exists() and (state_folder(out) / "run.json").is_file()
    # The state is whole: with it the run goes on, and refuses to be another one.
    assert cli.main(command) == 2
    file.write_text(file.read_text().replace("4000", "6"))
    with pytest.raises(UserError, match="robot_epochs was 4000, asked for is 6"):
        from mild_viz.training.config import train_from_config

        train_from_config(file, out, resume=True)


def wait_for(path: Path, program: subprocess.Popen[str]) -> None:
    """Wait until a program has written a file."""
    deadline = time.monotonic() + 120
    while not path.exists():
        assert program.poll() is None and time.monotonic() < deadline, f"{path} does not come"
        time.sleep(0.02)


def test_a_config_trains_what_it_says_and_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path, 'dataset = "demo"\nvariants = ["v3.2"]\nseeds = 1\nepochs = 1\nhidden = [12, 6]\nseed = 5')
    out = tmp_path / "model"
    assert cli.main(["train", "--config", str(file), "--out", str(out)]) == 0
    made = load_checkpoint(out)
    assert made.variants == ("v3.2",) and made.hidden == (12, 6)
    assert made.training["command"] == f"mild-viz train --config {file} --out {out}"
    assert made.training["seed"] == 5 and made.training["options"]["human_epochs"] == 1
    assert f"evaluate --checkpoint {out} --dataset demo" in capsys.readouterr().out
