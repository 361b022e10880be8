"""The page, put together: server, scene, controls, timeline, session and player."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import webbrowser
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from mild_viz import paths, pipeline
from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.dashboard.address import is_loopback, page_url
from mild_viz.dashboard.catalog import Catalog
from mild_viz.dashboard.compliance import ComplianceStage
from mild_viz.dashboard.controls import Controls
from mild_viz.dashboard.live.recorded import RecordedSession, open_recorded
from mild_viz.dashboard.player import Player
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.server import check_port, open_server
from mild_viz.dashboard.session import Choice, Pipeline, Session
from mild_viz.dashboard.timeline import Timeline
from mild_viz.data.load import load_dataset
from mild_viz.decoding import open_robot
from mild_viz.errors import UserError
from mild_viz.evaluation.controllers import controller_figures
from mild_viz.robot.model import RobotModel
from mild_viz.robot.source import RobotSource
from mild_viz.rollout import Rollout
from mild_viz.settings import ControlSettings, InferSettings, choose
from mild_viz.trial import Dataset

LABEL = "mild_viz"


class Dashboard:
    """A running page. `stop` ends it."""

    def __init__(
        self, host: str, port: int, catalog: Catalog, robot: RobotModel, model: str, first: InferSettings,
        recorded: RecordedSession | None = None,
    ) -> None:  # fmt: skip
        self.server = open_server(host, port, LABEL)
        self.url = page_url(host, port)
        self._dark: bool | None = None
        self._set_theme(False)
        self.scene = Scene(self.server, robot, dark=False)
        self.player = Player(self.scene.set_frame, self._tick, lambda: bool(self.server.get_clients()))
        self.controls = Controls(
            self.server, catalog, first, model, lambda: self.session.mark_dirty(), self.scene.move_camera,
            self._write_html, self._write_csv, ControlSettings() if recorded is None else recorded.settings,
        )  # fmt: skip
        if recorded is not None:
            self.controls.remember_contact_states(
                catalog.checkpoint(model), recorded.variant, recorded.action, recorded.settings.contact_states
            )
        self.timeline = Timeline(self.server, self.player)
        self._compared: tuple[Rollout | None, dict[str, Rollout]] = None, {}
        """What was last compared, and the rollout that it belongs to."""
        of = pipeline if recorded is None else recorded
        stages = Pipeline(of.infer, of.control)
        self.compliance = ComplianceStage(self.scene, self.controls.compliance, self.timeline)
        self.session = Session(self.controls.read, stages, self._show, self.controls.report, self.compliance.run)
        self._playing = asyncio.run_coroutine_threadsafe(self.player.run(), self.server.get_event_loop())
        self._fitting = asyncio.run_coroutine_threadsafe(self._fit_cameras(), self.server.get_event_loop())
        self.session.start()

    def stop(self) -> None:
        """End playback, worker and server."""
        self._playing.cancel()
        self._fitting.cancel()
        self.session.close()
        self.server.stop()

    def _show(self, rollout: Rollout, choice: Choice, is_new: bool) -> None:
        """Called by the session's worker with every new rollout or view."""
        self._set_theme(choice.view.dark)
        self.scene.set_robot(choice.robot)
        compared = self._compare(rollout, choice)
        self.scene.show(rollout, choice.view, compared)
        before = self.session.choice
        restart = before is None or before.trial is not choice.trial or before.robot is not choice.robot
        control, chain = choice.settings.control, choice.robot.chain
        figures = [controller_figures(one, chain, control.lambda_x, control.lambda_q) for one in compared]
        self.controls.show(rollout, choice, figures)
        self.timeline.show(rollout, choice.view.alpha_mode)
        # Last: the player then draws this frame and lets the texts follow, on its own thread.
        self.player.load(rollout.inference.n_windows, rollout.inference.rate, restart)
        if before is None:
            # Reading all datasets may take seconds: the page stands already, and the list completes itself.
            threading.Thread(target=self.controls.offer_datasets, name="mild_viz datasets", daemon=True).start()

    def _compare(self, rollout: Rollout, choice: Choice) -> tuple[Rollout, ...]:
        """The rollouts of the compared controllers, the one that is shown among them, in the session's worker.

        A few milliseconds each; a change of view alone runs none again.
        """
        of, ran = self._compared
        if of is not rollout:
            ran = {rollout.controller: rollout}
        missing = [name for name in choice.view.compared if name not in ran]
        for name in missing:
            # where the human is shown, which no widget may say
            settings = replace(choice.settings.control, controller=name, placement=rollout.placement)
            ran[name] = pipeline.control(rollout.inference, choice.checkpoint, choice.robot, choice.trial, settings)
        self._compared = rollout, ran
        return tuple(ran[name] for name in choice.view.compared)

    def _tick(self, frame: int, playing: bool) -> None:
        self.timeline.tick(frame, playing)
        self.controls.tick(frame)

    def _set_theme(self, dark: bool) -> None:
        if dark != self._dark:
            self._dark = dark
            self.server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)

    async def _fit_cameras(self) -> None:
        """Keep every browser's preset fitted: canvases change when panels dock or fold, layouts with each trial."""
        while True:
            await asyncio.sleep(0.25)
            with contextlib.suppress(Exception):  # a browser may leave at any moment
                self.scene.refit_cameras()

    def _write_html(self, path: Path) -> None:
        from mild_viz.dashboard import recorder  # only a recording needs it

        assert self.session.rollout is not None and self.session.choice is not None
        choice = self.session.choice
        recorder.record_html(self.session.rollout, choice.robot, choice.view, path)

    def _write_csv(self, path: Path) -> None:
        from mild_viz.dashboard import recorder

        assert self.session.rollout is not None
        recorder.record_csv(self.session.rollout, path)


def first_settings(
    dataset: Dataset, checkpoint: Checkpoint, action: str | None, trial: int | None, variant: str | None
) -> InferSettings:
    """What is shown first: test trial `trial`, else the first one of an action that both dataset and model know."""
    shared = tuple(name for name in dataset.actions if name in checkpoint.actions)
    if not shared:
        raise UserError(
            f"checkpoint {checkpoint.name} knows {', '.join(checkpoint.actions)}; "
            f"dataset '{dataset.name}' holds {', '.join(dataset.actions)}"
        )
    asked = None if trial is None else dataset.trial("test", trial).action
    action = choose(f"{dataset.name}: action", action or asked or preferred(shared), shared)
    trials = [one for one in dataset.test + dataset.train if one.action == action]
    if trial is not None:
        trials = [one for one in trials if one.split == "test" and one.index == trial]
        if not trials:
            raise UserError(f"{dataset.name}: test trial {trial} is a {asked}, not a {action}; leave one of both out")
    variant = choose(
        f"checkpoint {checkpoint.name}: variant", variant or checkpoint.default_variant, checkpoint.variants
    )
    return InferSettings(dataset.name, trials[0].split, trials[0].index, variant)


def preferred(actions: tuple[str, ...]) -> str:
    """The action that shows most: a handshake, if there is one."""
    return "handshake" if "handshake" in actions else actions[0]


def open_dashboard(
    checkpoint: Path | None = None,
    dataset: str = "demo",
    action: str | None = None,
    trial: int | None = None,
    variant: str | None = None,
    robot: str | None = None,
    robot_source: RobotSource = "own",
    host: str = "127.0.0.1",
    port: int = 8080,
    session: Path | None = None,
) -> Dashboard:
    """Load model, data and robot (default: the model's own), or a recorded session, and start the page.

    Returns while the first rollout is computed.

    Raises:
        UserError: for anything that was given and cannot be used.
    """
    check_port(host, port)
    recorded = None if session is None else open_recorded(session, checkpoint)
    if recorded is not None:
        recordings, model, arm = recorded.dataset, recorded.checkpoint, recorded.robot
        folder, dataset, variant = model.path, recordings.name, variant or recorded.variant
    else:
        recordings = load_dataset(dataset)
        folder = checkpoint or paths.default_checkpoint(dataset)
        model = load_checkpoint(folder)
        arm = open_robot(model, robot, robot_source)
    catalog = Catalog(arm, folder, robot_source, None if recorded is None else recordings)
    shown = catalog.robot_name
    first = first_settings(recordings, model, action, trial, variant)
    name = catalog.name_of(folder)
    problem = catalog.problem(name, dataset, shown)
    if problem is not None:
        raise UserError(problem)
    return Dashboard(host, port, catalog, arm, name, first, recorded)


def run(
    checkpoint: Path | None = None,
    dataset: str = "demo",
    action: str | None = None,
    trial: int | None = None,
    variant: str | None = None,
    robot: str | None = None,
    robot_source: RobotSource = "own",
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
    session: Path | None = None,
) -> None:
    """Start the page and serve it until Ctrl-C."""
    dashboard = open_dashboard(checkpoint, dataset, action, trial, variant, robot, robot_source, host, port, session)
    console = Console()
    console.print(f"[bold]mild_viz[/bold] is at [link={dashboard.url}]{dashboard.url}[/link]  (stop it with Ctrl-C)")
    if not is_loopback(host):
        console.print("[yellow]Everybody who reaches this address can use the page: it has no password.[/yellow]")
    if open_browser:
        webbrowser.open(dashboard.url)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        dashboard.stop()
