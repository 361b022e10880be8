"""A trial to take home: a page that plays without a network, and a table."""

from __future__ import annotations

import contextlib
import html
import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import viser
import viser._messages

from mild_viz.dashboard.scene.scene import Scene, fill_initial_camera
from mild_viz.dashboard.view import ViewSettings
from mild_viz.files import write_atomically
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout

HEADROOM = 0.22
"""Space [m] that the page's header needs above the titles."""

# viser's client fades its canvas out and in at every start of a loop; its own notice takes the top left corner.
HEADER = """<style>canvas[data-engine]{{opacity:1!important}}</style>
<div style="position:fixed;z-index:2;top:10px;right:14px;max-width:60%;text-align:right;pointer-events:none;
font:13px/1.45 system-ui,sans-serif;color:{color}"><b>{title}</b> &nbsp; {line}<br>
<span style="opacity:.75">{note}</span></div>"""


def record_html(rollout: Rollout, robot: RobotModel, view: ViewSettings, path: Path) -> None:
    """Write the trial as one self-contained HTML page that plays in a loop at the recording's own speed.

    It is made on a second server: a recording also plays on the browsers of the server that makes it.
    """
    with private_server() as server:
        scene = Scene(server, robot, view.dark)
        scene.show(rollout, view)
        fill_initial_camera(server, scene.camera("both", headroom=HEADROOM))
        recording = server.get_scene_serializer()
        for n in range(rollout.inference.n_windows):
            scene.set_frame(n)
            recording.insert_sleep(1.0 / rollout.inference.rate)
        page = recording.as_html(dark_mode=view.dark)
    text = titled(page, rollout, view.dark)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def record_csv(rollout: Rollout, path: Path) -> None:
    """Write one row a frame: time [s], state, forward variable, joints [rad], stiffness, contact, distance [m].

    Columns `alpha_s` are the human-only forward variable of state s; states count from 0, as `active_state`
    does. What is not known is an empty cell.
    """
    inference = rollout.inference
    joints = inference.joint_names
    columns: dict[str, np.ndarray] = {"time": inference.time, "active_state": inference.active_state}
    alpha = np.exp(inference.log_alpha_human)
    columns |= {f"alpha_{state}": alpha[:, state] for state in range(inference.n_states)}
    for kind, values in (
        ("decoded", inference.joints_decoded),
        ("commanded", rollout.joints_commanded),
        ("stiffness", rollout.stiffness),
    ):
        columns |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(joints)}
    columns |= {"contact": rollout.contact.astype(int), "distance": rollout.hand_distance}
    # Imported here: it costs a third of a second of the start, and most sessions write no table.
    import pandas as pd

    table = pd.DataFrame(columns)
    write_atomically(
        path, lambda temporary: table.to_csv(temporary, index=False, float_format="%.9g", lineterminator="\n")
    )


def titled(page: str, rollout: Rollout, dark: bool) -> str:
    """The page with the trial's name as its title, and a header that says what is shown."""
    inference = rollout.inference
    title = f"{inference.dataset}/{inference.split}/{inference.trial} · {inference.action}"
    line = f"variant {inference.variant}, controller {rollout.controller}, {rollout.robot}"
    note = f"Human placed: {rollout.placement.source}. Space plays and pauses; drag to turn."
    color = "#e6e9ee" if dark else "#30343b"
    header = HEADER.format(color=color, title=html.escape(title), line=html.escape(line), note=html.escape(note))
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{html.escape(title)}</title>", page, count=1)
    # The client fills #root and leaves the rest of the body alone; its own text also holds '<body>' somewhere.
    start = page.rindex('<div id="root">')
    return page[:start] + header + page[start:]


@contextlib.contextmanager
def private_server() -> Iterator[viser.ViserServer]:
    """A server of our own on a free port of this machine, silent and without tunnels to the outside."""
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
