"""Taking a recording home: a page that plays offline, and a table. Both reach the browser as downloads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import viser

from mild_viz.rollout import Rollout

Writer = Callable[[Path], None]


class RecordTab:
    """Two buttons. Files are made in a temporary folder: no name or path from a browser reaches the disk."""

    def __init__(
        self,
        gui: viser.GuiApi,
        rollout: Callable[[], Rollout | None],
        model: Callable[[], str],
        write_html: Writer,
        write_csv: Writer,
    ) -> None:
        self._rollout, self._model = rollout, model
        self._busy = threading.Lock()
        gui.add_html(
            '<div class="mv-note">Recordings hold the trial as it is shown now: model, controller, contact states, '
            "view. They are downloaded by this browser.</div>"
        )
        html = gui.add_button(
            "Record page (HTML)", icon=viser.Icon.MOVIE, hint="The 3-D scene as one file that plays without network."
        )
        csv = gui.add_button(
            "Record table (CSV)", icon=viser.Icon.TABLE_EXPORT,
            hint="One row a frame: time, state, α, joints, stiffness, distance.",
        )  # fmt: skip
        html.on_click(lambda event: self._deliver(event.client, "html", write_html))
        csv.on_click(lambda event: self._deliver(event.client, "csv", write_csv))

    def _deliver(self, client: viser.ClientHandle | None, suffix: str, write: Writer) -> None:
        rollout = self._rollout()
        if client is None or rollout is None:
            return
        if not self._busy.acquire(blocking=False):
            client.add_notification("Recording", "One recording is being made already.", auto_close_seconds=4.0)
            return
        note = client.add_notification("Recording", "This takes some seconds.", loading=True, with_close_button=False)
        try:
            with TemporaryDirectory(prefix="mild_viz.") as folder:
                path = Path(folder) / f"recording.{suffix}"
                write(path)
                client.send_file_download(
                    file_name(rollout, self._model(), suffix), path.read_bytes(), save_immediately=True
                )
        except Exception as error:  # also a browser that closed in the meantime: the page must not hang on it
            client.add_notification("The recording failed", str(error), color="red")
            raise
        finally:
            note.remove()
            self._busy.release()


def file_name(rollout: Rollout, model: str, suffix: str) -> str:
    """Says what was recorded: 'demo-handshake-test-3-my-model-v3.1-mild-ik.html'. `model` is its name on the page."""
    inference = rollout.inference
    trial = (inference.dataset, inference.action, inference.split, str(inference.trial))
    return f"{'-'.join((*trial, Path(model).name, inference.variant, rollout.controller))}.{suffix}"
