"""Recordings: the table's content, and the page in a browser without a network."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scene_rollouts import N_STATES, scene_inference, scene_rollout

from mild_viz.dashboard.recorder import record_csv, record_html, titled
from mild_viz.dashboard.view import ViewSettings
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("pepper")


@pytest.fixture(scope="module")
def rollout(robot: RobotModel) -> Rollout:
    return scene_rollout(robot, scene_inference(whole=False))


def test_the_table_holds_one_row_a_frame(rollout: Rollout, tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    record_csv(rollout, path)
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    inference = rollout.inference
    joints = inference.joint_names
    assert list(rows[0]) == [
        "time", "active_state", *(f"alpha_{s}" for s in range(N_STATES)), *(f"decoded_{j}" for j in joints),
        *(f"commanded_{j}" for j in joints), *(f"stiffness_{j}" for j in joints), "contact", "distance",
    ]  # fmt: skip
    assert len(rows) == inference.n_windows

    def column(name: str) -> np.ndarray:
        return np.array([float(row[name]) for row in rows])

    np.testing.assert_allclose(column("time"), inference.time, rtol=1e-8)
    np.testing.assert_array_equal(column("active_state"), inference.active_state)
    alpha = np.stack([column(f"alpha_{s}") for s in range(N_STATES)], axis=1)
    np.testing.assert_allclose(alpha, np.exp(inference.log_alpha_human), rtol=1e-8)
    for j, joint in enumerate(joints):
        np.testing.assert_allclose(column(f"decoded_{joint}"), inference.joints_decoded[:, j], rtol=1e-8)
        np.testing.assert_allclose(column(f"commanded_{joint}"), rollout.joints_commanded[:, j], rtol=1e-8)
        np.testing.assert_allclose(column(f"stiffness_{joint}"), rollout.stiffness[:, j], rtol=1e-8)
    np.testing.assert_array_equal(column("contact"), rollout.contact)
    np.testing.assert_allclose(column("distance"), rollout.hand_distance, rtol=1e-8)


def test_what_is_unknown_is_an_empty_cell(rollout: Rollout, robot: RobotModel, tmp_path: Path) -> None:
    distance = rollout.hand_distance.copy()
    distance[7] = np.nan
    record_csv(scene_rollout(robot, rollout.inference, hand_distance=distance), tmp_path / "trial.csv")
    lines = (tmp_path / "trial.csv").read_text().splitlines()
    assert lines[8].endswith(",") and not lines[9].endswith(",")


def test_a_file_is_replaced_whole_or_stays(rollout: Rollout, tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("old")
    record_csv(rollout, path)
    assert path.read_text().startswith("time,") and list(tmp_path.iterdir()) == [path]
    with pytest.raises(UserError, match="choose another place"):
        record_csv(rollout, tmp_path / "missing" / "trial.csv")
    assert list(tmp_path.iterdir()) == [path]


def test_names_are_escaped_in_the_page(rollout: Rollout, robot: RobotModel) -> None:
    page = titled("<head><title>Viser</title></head><body><div id=\"root\"></div>", scene_rollout(
        robot, rollout.inference, controller="<script>alert(1)</script>"
    ), dark=False)  # fmt: skip
    assert "<script>" not in page and "demo/test/" in page.split("</title>")[0]


def test_the_page_plays_without_a_network(
    rollout: Rollout, robot: RobotModel, chromium: Browser, tmp_path: Path
) -> None:
    path = tmp_path / "trial.html"
    record_html(rollout, robot, ViewSettings(dark=True), path)
    assert list(tmp_path.iterdir()) == [path] and path.stat().st_size < 10e6

    context = chromium.new_context(viewport={"width": 640, "height": 400}, offline=True)
    page = context.new_page()
    requests: list[str] = []
    errors: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    try:
        page.goto(path.as_uri())
        state = "window.__viserSceneTree && window.__viserSceneTree.getState()"
        page.wait_for_function(f"{state} && {state}['/latent/robot/state{N_STATES - 1}']", timeout=60_000)
        opacity = f"[...Array({N_STATES}).keys()].map(s => {state}[`/latent/human/state${{s}}`].message.props.opacity)"
        seen = set()
        deadline = time.monotonic() + 60.0
        while len(seen) < 3 and time.monotonic() < deadline:
            seen.add(tuple(page.evaluate(opacity)))
            time.sleep(0.2)
        assert len(seen) >= 3, "the opacities must change as it plays"
        canvas = "[...document.querySelectorAll('canvas[data-engine]')].map(one => getComputedStyle(one).opacity)"
        assert page.evaluate(canvas) == ["1"], "the picture must not fade at every loop"
        nodes = page.evaluate(f"Object.keys({state})")
        assert {"/human/joints", "/robot/solid/RForeArm", "/latent/path_human", "/reach/line"} <= set(nodes)
        assert page.title() == f"demo/test/{rollout.inference.trial} · handshake"
        assert page.get_by_text("variant v3.1, controller mild-ik").is_visible()
    finally:
        context.close()
    assert not errors
    assert all(url.startswith(("file:", "blob:", "data:")) for url in requests)
