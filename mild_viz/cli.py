"""The console command `mild-viz`: options and their help; each command imports what it needs when it runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from mild_viz.errors import UserError
from mild_viz.evaluate_commands import evaluate, report
from mild_viz.live_commands import live
from mild_viz.run_options import (
    OptionalInt,
    OptionalPath,
    OptionalText,
    OptionalVariant,
    RunOptions,
    SourceName,
    check_output,
    documented,
    leave,
)
from mild_viz.simulate_command import simulate
from mild_viz.train_commands import sweep, train, train_baseline


def app(
    checkpoint: OptionalPath = None,
    dataset: str = "demo",
    action: OptionalText = None,
    trial: OptionalInt = None,
    variant: OptionalVariant = None,
    robot: OptionalText = None,
    robot_source: SourceName = "own",
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
    session: OptionalPath = None,
) -> None:
    """Start the dashboard; stop it with Ctrl-C.

    Without options it shows the built-in demo set with the demo model at http://127.0.0.1:8080.
    Example: mild-viz app --dataset nuisi --action handshake --variant v3.2

    Args:
        checkpoint: Folder of a trained model. Default: the shipped model of the dataset: checkpoints/demo,
            nuisi-pepper, yumi or handover-panda. Example: --checkpoint checkpoints/nuisi-pepper
        dataset: Recordings to open: demo (built in), nuisi, yumi, handover, buetepage (see: mild-viz data list).
            Example: --dataset nuisi
        action: Interaction to show first: wave, handshake, rocket, parachute, handover. Default: the handshake, if
            dataset and model have it, else their first one. Example: --action rocket
        trial: Test trial to show first, from 0, as in rollout and record. Default: the first of the action.
            Example: --trial 5
        variant: Variant of MILD to show first (how the robot's decoder was trained and conditioned; the README
            has the table). Default: v3.1, if the model has it. Example: --variant v2.1
        robot: Robot to control: pepper, panda, yumi, kobo, a folder with a robot.toml, or the path of a URDF file with
            the joints that the model drives; meshes named package://... are looked up beside the file. Default: the
            robot that the model was trained for. Example: --robot ~/pepper.urdf
        robot_source: Where the robot's looks come from: own, or robot_descriptions, the Python package that downloads
            the manufacturer's meshes (needs: pip install 'mild-viz[robots]'). Without network ours are shown.
            Example: --robot-source robot_descriptions
        host: Network address to listen on. There is no password: leave it at this machine's own address unless
            everybody on the network may use the page. Example: --host 0.0.0.0
        port: TCP port to listen on. Example: --port 9000
        open_browser: Also open the page in this machine's browser.
        session: Live session to look at, as recorded by: mild-viz live --record. It brings its own model and robot;
            its interactions are the trials, shown exactly as they were until a setting is changed.
            Example: --session session.jsonl
    """
    from mild_viz.dashboard.app import run

    run(
        checkpoint=checkpoint,
        dataset=dataset,
        action=action,
        trial=trial,
        variant=variant,
        robot=robot,
        robot_source=robot_source,
        host=host,
        port=port,
        open_browser=open_browser,
        session=session,
    )


def data_list() -> None:
    """List the datasets, what each holds, whether it is here, and where it was looked for.

    Recordings are looked for in the folder named by the environment variable MILD_VIZ_DATA, else in the
    user's cache.
    """
    from mild_viz.data.commands import list_datasets

    leave(list_datasets())


def data_fetch(name: tyro.conf.Positional[str]) -> None:
    """Download the recordings of a dataset from their public source, and check their SHA-256.

    They are put into the folder named by MILD_VIZ_DATA, else into the user's cache; what is there and intact
    is not loaded again. Example: mild-viz data fetch nuisi

    Args:
        name: Dataset to download, as named by: mild-viz data list
    """
    from mild_viz.data.commands import fetch

    leave(fetch(name))


def data_check(path: tyro.conf.Positional[Path]) -> None:
    """Read a file or folder of recordings and report what it holds and what is wrong with it.

    Example: mild-viz data check ~/recordings/nuisi/traj_data.npz

    Args:
        path: File or folder to check.
    """
    from mild_viz.data.commands import check

    leave(check(path))


def rollout(run: RunOptions, out: Path) -> None:
    """Run the pipeline on one trial and write the arrays to an .npz file.

    Row n of every array belongs to human window n, whose newest observation is frame n + 4; joints are those of
    frame n + 5. Units are metres, radians and seconds. The README lists the arrays.
    Example: mild-viz rollout --dataset nuisi --trial 3 --variant v3.1 --controller mild-ik --out rollout.npz

    Args:
        run: What to run.
        out: File to write. Example: --out rollout.npz
    """
    check_output(out, ".npz")
    result, _ = run.run()
    result.save(out)
    inference = result.inference
    print(
        f"{out}: {inference.dataset}/{inference.split}/{inference.trial} ({inference.action}), {inference.variant}, "
        f"{result.controller}: {inference.n_windows} windows, {inference.n_states} states"
    )


def record(run: RunOptions, out: Path, csv: OptionalPath = None) -> None:
    """Record one trial as a web page that plays offline, and as a table.

    Example: mild-viz record --dataset demo --trial 4 --out handshake.html --csv handshake.csv

    Args:
        run: What to run.
        out: The page: one self-contained file that a browser opens without a network. Example: --out wave.html
        csv: The table: one row a frame with time, active state, forward variable, joints, stiffness and distance.
            Example: --csv wave.csv
    """
    check_output(out, ".html")
    if csv is not None:
        check_output(csv, ".csv")
    from mild_viz.dashboard.recorder import record_csv, record_html
    from mild_viz.dashboard.view import ViewSettings

    result, robot = run.run()
    record_html(result, robot, ViewSettings(), out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {result.inference.n_windows} frames")
    if csv is not None:
        record_csv(result, csv)
        print(f"{csv}: {result.inference.n_windows} rows")


def import_published(file: tyro.conf.Positional[Path], out: Path) -> None:
    """Convert a Pepper model published by the paper's authors (.pth) to a checkpoint of this program.

    The file is a pickle, which could name any code; it is read with an unpickler that admits only what such a model
    holds, and runs nothing of it. Example: mild-viz import-published mild_v3_2_pepper_nuisi.pth --out runs/published

    Args:
        file: The published file.
        out: Folder to write the checkpoint to. Example: --out runs/published
    """
    from mild_viz.published import import_published as convert

    checkpoint = convert(file, out)
    print(f"{out}: by its own arguments, {file.name} is {', '.join(checkpoint.variants)}")


def _choice(commands: dict[str, Any]) -> Any:
    """A type of which tyro makes one subcommand for each entry; an entry may be a group of its own."""
    parts = [
        Annotated[Any, tyro.conf.subcommand(name=name, constructor=documented(run))] for name, run in commands.items()
    ]
    return reduce(or_, parts)


DATA_COMMANDS = {"list": data_list, "fetch": data_fetch, "check": data_check}


def data(command: _choice(DATA_COMMANDS)) -> None:  # pyright: ignore[reportInvalidTypeForm]
    """List, download and check recordings."""


COMMANDS = {
    "app": app,
    "data": data,
    "train": train,
    "train-baseline": train_baseline,
    "sweep": sweep,
    "evaluate": evaluate,
    "report": report,
    "live": live,
    "rollout": rollout,
    "record": record,
    "simulate": simulate,
    "import-published": import_published,
}


def _run(commands: Any, program: str, arguments: Sequence[str] | None, description: str | None = None) -> int:
    """Parse and run; a message for a person, and 2, where something that was given is unusable."""
    try:
        tyro.cli(
            commands,
            prog=program,
            args=arguments,
            description=description,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
        )
    except UserError as error:
        print(f"{program}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """`mild-viz`: returns the exit code; parse errors and --help leave by SystemExit (2 and 0)."""
    description = (
        "Latent interaction dynamics and robot playback: data, training, evaluation, rollouts, recordings, and a "
        "dashboard in the browser. Start with: mild-viz app"
    )
    return _run(_choice(COMMANDS), "mild-viz", arguments, description)


def main_app(arguments: Sequence[str] | None = None) -> int:
    """`python app.py`: the options of `mild-viz app`."""
    return _run(app, "app.py", arguments)
