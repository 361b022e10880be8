"""The command `mild-viz live`: skeleton frames in, joint commands out, while a page shows it."""

from __future__ import annotations

import logging
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mild_viz.errors import UserError
from mild_viz.run_options import ModelOptions, OptionalPath, OptionalText, documented

if TYPE_CHECKING:
    from rich.console import Console

    from mild_viz.dashboard.live.start import PageProcess
    from mild_viz.live.loop import LiveLoop
    from mild_viz.live.record import Recorder

OptionalSeconds = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]

PAGE_START = 60.0
"""How long the page may take to start [s]."""


@documented
@dataclass(frozen=True)
class LiveOptions(ModelOptions):
    """Model, robot and controller.

    Attributes:
        dataset: Recordings whose shipped model is used: demo, nuisi, yumi, handover. Default: those that are
            replayed, else demo. Example: --dataset nuisi
        action: Interaction: wave, handshake, rocket, parachute, handover. Default: that of the trial that is
            replayed, else the handshake, if the model has it. Example: --action rocket
    """

    dataset: OptionalText = None
    action: OptionalText = None


def live(
    run: LiveOptions,
    input: str = "udp://127.0.0.1:9870",
    output: str = "none",
    record: OptionalPath = None,
    config: OptionalPath = None,
    page: bool = True,
    host: str = "127.0.0.1",
    port: int = 8080,
    duration: OptionalSeconds = None,
) -> None:
    """Control a robot live: skeleton frames in, joint commands out; stop it with Ctrl-C.

    The robot waits until the person's hand has rested, responds when it leaves its resting place, and returns to rest
    when it is back. Frames may come at any rate; commands are made at the model's (30 Hz for all but yumi). Messages
    are described in docs/live.md; examples/ has a sender and a receiver.
    Example: mild-viz live --input replay:demo/4 --output csv:commands.csv --record session.jsonl

    Args:
        run: What to run.
        input: Where skeleton frames come from: udp://HOST:PORT to listen on, ws://HOST:PORT or rosbridge://HOST:PORT
            to connect to, or replay:DATASET/TRIAL, which begins with a second of rest (?rest=SECONDS).
            Example: --input udp://0.0.0.0:9870
        output: Where joint commands go: udp://HOST:PORT, ws://HOST:PORT to listen on, rosbridge://HOST:PORT, csv:FILE
            or none. Example: --output udp://127.0.0.1:9871
        record: Record the session to this new file, one JSON object a line; to look at it again: mild-viz app
            --session FILE. Example: --record session.jsonl
        config: Thresholds in a TOML file, such as start_displacement = 0.03; what it leaves out has its default, and
            the page lists them all. Example: --config live.toml
        page: Show a page in the browser.
        host: Network address of the page. There is no password. Example: --host 0.0.0.0
        port: TCP port of the page. Example: --port 9000
        duration: End after so many seconds. Default: when the input ends, or with Ctrl-C. Example: --duration 60
    """
    from rich.console import Console

    from mild_viz.live.config import LiveConfig, read_live_config
    from mild_viz.live.controller import LiveController
    from mild_viz.live.inputs import open_input
    from mild_viz.live.loop import LiveLoop
    from mild_viz.live.outputs import open_output
    from mild_viz.live.record import Recorder
    from mild_viz.live.replayed import session_header
    from mild_viz.live.setup import choose_action, choose_dataset, live_model, make_guard, rested, warm_up

    if duration is not None and not 0.0 < duration < float("inf"):
        raise UserError(f"duration is {duration}; valid: seconds, above 0")
    thresholds = LiveConfig() if config is None else read_live_config(config)
    dataset = choose_dataset(run.dataset, input)
    checkpoint, robot = run.load(dataset)
    action = choose_action(run.action, input, checkpoint)
    thresholds = thresholds.for_dataset(checkpoint.dataset)
    model = live_model(
        checkpoint, run.variant or checkpoint.default_variant, action, robot, run.settings(checkpoint), thresholds
    )
    source = open_input(rested(input))
    closing: list[Any] = [source]
    console = Console()
    recorder: Recorder | None = None
    try:
        sink = open_output(output, robot.chain.joint_names)
        closing.append(sink)
        if record is not None:
            names = (source.name, sink.name)
            recorder = Recorder(record, session_header(checkpoint, model, run.robot, thresholds, names))
            closing.append(recorder)
        loop = LiveLoop(LiveController(model, thresholds), source, sink, make_guard(model))
        shown = None
        if page:
            shown = open_page(loop, recorder, checkpoint.path, run, host, port, source.name, sink.name)
            closing.append(shown)
        warm_up(model, thresholds)
        loop.witnesses = tuple(witness for witness in (recorder, shown) if witness is not None)
        say_where(console, loop, host, port if page else None)
        run_until_stopped(loop, duration)
    finally:
        for each in reversed(closing):
            each.close()
    report(console, loop, recorder, shown)


def open_page(
    loop: LiveLoop, recorder: Recorder | None, checkpoint: Path, run: LiveOptions, host: str, port: int, source: str,
    output: str,
) -> PageProcess:  # fmt: skip
    """Start the page's process and wait until it stands. Raises UserError where it does not, such as a taken port."""
    from mild_viz.dashboard.live.start import PageSetup, start_page

    model, config = loop.controller.model, loop.controller.config
    setup = PageSetup(
        host=host,
        port=port,
        checkpoint=checkpoint,
        variant=model.variant,
        action=model.action,
        robot=run.robot,
        robot_source=run.robot_source,
        settings=model.settings,
        T_world_human=model.T_world_human,
        config=config,
        source=source,
        output=output,
    )
    return start_page(setup, loop, recorder, PAGE_START)


def say_where(console: Console, loop: LiveLoop, host: str, port: int | None) -> None:
    """What runs, and where the page is."""
    model = loop.controller.model
    console.print(f"{model.action}, {model.variant}, {model.settings.controller}, {model.rate:g} Hz", style="bold")
    console.print(f"from {loop.source.name} to {loop.output.name}  (stop it with Ctrl-C)", soft_wrap=True)
    if port is not None:
        from mild_viz.dashboard.address import is_loopback, page_url

        url = page_url(host, port)
        console.print(f"page: [link={url}]{url}[/link]", soft_wrap=True)
        if not is_loopback(host):
            console.print("[yellow]Everybody who reaches this address can see the page: it has no password.[/yellow]")


def run_until_stopped(loop: LiveLoop, duration: float | None) -> None:
    """Run in this thread until the input ends, the time is over, or Ctrl-C; a second Ctrl-C does not wait for the
    arm."""
    stopped = False

    def stop(number: int, _frame: object) -> None:
        nonlocal stopped
        if stopped and number == signal.SIGINT:
            raise KeyboardInterrupt
        stopped = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s")
    try:
        loop.run(lambda: stopped, duration)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def report(console: Console, loop: LiveLoop, recorder: Recorder | None, page: PageProcess | None) -> None:
    """The table at the end."""
    from rich.table import Table

    seen, done, out = loop.source.counts, loop.controller.counts, loop.output.counts
    latency = loop.latency
    table = Table(title="Live session", show_header=False)
    table.add_column()
    table.add_column(justify="right")

    def row(name: str, *values: object) -> None:
        table.add_row(name, " / ".join(map(str, values)))

    if latency.count:
        for name, times in (("computing", latency.computing()), ("frame to command", latency.whole())):
            numbers = [f"{1e3 * value:.2f}" for value in (times.median, times.p99, times.longest)]
            row(f"{name} in ms: median / 99 % / longest", *numbers)
    row("answers timed", latency.count)
    row("frames received / used", seen.received, seen.delivered)
    row("rejected / late / repeated", seen.rejected, seen.reordered, seen.duplicated)
    row("of others / left out for newer ones", seen.foreign, seen.skipped)
    row("too old / without an arm", done.stale, done.untracked)
    row("commands: all / sent / failed", loop.sent, out.sent, out.failed)
    row("commands without a frame / cut by the last check", done.held, loop.guard.refused)
    row("interactions", loop.controller.interaction)
    row("sender restarts / clock jumps / faults", seen.restarts, loop.controller.clock.jumps, loop.faults)
    if recorder is not None:
        row("turns recorded", recorder.written)
    if page is not None:
        row("frames that the page left out", page.feed.dropped)
    console.print(table)
    troubles = [loop.source.trouble, loop.output.trouble, loop.controller.trouble]
    troubles += [f"last fault: {loop.last_fault}" if loop.last_fault else "", seen.last_error, out.last_error]
    if recorder is not None:
        troubles.append(recorder.trouble)
    if page is not None and page.feed.gone:
        troubles.append("the page's process ended early")
    for trouble in filter(None, troubles):
        console.print(f"[yellow]{_escaped(trouble)}[/yellow]", soft_wrap=True)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
