"""A robot with its manufacturer's looks through `robot_descriptions`: fetched by git, and every way in which it fails.

The package is the real one; its repository is one on this disk, which holds the reference description.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robot_descriptions import _repositories

from mild_viz import cli
from mild_viz.dashboard.catalog import Catalog
from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot

LINK = "RForeArm"


def git(folder: Path, *arguments: str) -> str:
    names = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    done = subprocess.run(["git", "-C", str(folder), *names, *arguments], check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], None]]:
    """`package(description, url)` lets the package fetch that repository from a folder or an address, into an empty
    cache."""
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))

    def point(description: str, url: str) -> None:
        commit = git(Path(url), "rev-parse", "HEAD") if Path(url).is_dir() else "0" * 40
        entry = replace(_repositories.REPOSITORIES[description], url=url, commit=commit)
        monkeypatch.setitem(_repositories.REPOSITORIES, description, entry)

    for module in ("pepper_description", "panda_description"):
        monkeypatch.delitem(sys.modules, f"robot_descriptions.{module}", raising=False)
    yield point
    for module in ("pepper_description", "panda_description"):
        sys.modules.pop(f"robot_descriptions.{module}", None)


@pytest.fixture
def upstream(tmp_path: Path, shared: Callable[[str], Path]) -> Path:
    """A repository as LIRMM's, with three of its meshes."""
    folder, reference = tmp_path / "upstream", shared("robots/pepper_description")
    (folder / "meshes").mkdir(parents=True)
    shutil.copytree(reference / "urdf", folder / "urdf")
    for name in ("RElbowRoll", "HeadPitch", "KneePitch"):
        shutil.copy(reference / "meshes" / f"{name}.dae", folder / "meshes")
    commit_all(folder)
    return folder


def commit_all(folder: Path) -> None:
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "--allow-empty", "-m", "as it is")


def edit(folder: Path, old: str, new: str) -> None:
    file = folder / "urdf" / "pepper.urdf"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    commit_all(folder)


def test_the_manufacturers_looks_on_our_joints(
    package: Callable[[str, str], None], upstream: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    package("pepper_description", str(upstream))
    robot, own = load_robot("pepper", source="robot_descriptions"), load_robot("pepper")
    assert robot.urdf == tmp_path / "cache" / "pepper_description" / "urdf" / "pepper.urdf"
    assert "ours is shown" not in caplog.text
    # it is drawn with theirs: fingers, which ours has not, and a forearm of other vertices
    assert "RFinger12_link" in robot.link_names and "RFinger12_link" not in own.link_names
    assert set(robot.visuals) >= {LINK, "Head"}
    assert len(robot.visuals[LINK].vertices) != len(own.visuals[LINK].vertices)
    # but moves as ours: the root of theirs is on the floor, and both arms are where ours are
    rng = np.random.default_rng(0)
    joints = {name: rng.uniform(arm.lower, arm.upper, (20, arm.n_joints)) for name, arm in own.arms.items()}
    for name, arm in robot.arms.items():
        np.testing.assert_array_equal(forward(arm, joints[name]), forward(own.arms[name], joints[name]))
    poses = [one.link_poses(joints["right"], "wave", {"left": joints["left"]}) for one in (robot, own)]
    for link in ("RBicep", LINK, "LForeArm", "r_wrist", "Head"):
        theirs, ours = (pose[:, one.link_names.index(link)] for pose, one in zip(poses, (robot, own), strict=True))
        np.testing.assert_allclose(theirs[:, 4:], ours[:, 4:], atol=1e-4, err_msg=link)
        np.testing.assert_allclose(np.abs(np.sum(theirs[:, :4] * ours[:, :4], axis=1)), 1.0, atol=1e-6, err_msg=link)
    # the page's chooser offers it once, under its name
    catalog = Catalog(robot, source="robot_descriptions")
    assert catalog.robot_name == "pepper" and catalog.robot("pepper") is robot
    assert sorted(catalog.robot_titles.values()) == ["Kobo", "Panda", "Pepper", "YuMi"]
    assert robot.floor == pytest.approx(own.floor, abs=0.03)  # LIRMM's floor is 27 mm nearer to the shoulders


def test_without_network_a_rollout_uses_ours_and_says_so(
    package: Callable[[str, str], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    package("pepper_description", "https://localhost:9/pepper_description.git")
    for name in ("https_proxy", "HTTPS_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # nobody listens on the port
    options = ["--robot-source", "robot_descriptions", "--out", str(tmp_path / "ours.npz")]
    cli.main(["rollout", *options])
    assert "Pepper: no robot from robot_descriptions, ours is shown: pepper_description cannot be " in caplog.text
    assert "is there a network? (fatal: unable to access" in caplog.text
    assert "Cloning" not in capsys.readouterr().out  # nothing of the package's goes where results do
    assert (tmp_path / "ours.npz").is_file()


@pytest.mark.parametrize(
    ("robot", "change", "message"),
    [
        ("pepper", ('joint name="LElbowYaw"', 'joint name="LElbow2"'), "has no joint 'LElbowYaw' of ours"),
        ("pepper", ('xyz="0.1812 -0.015 0.00013"', 'xyz="0.2812 -0.015 0.00013"'), "'RElbowYaw' is 10.0 cm from where"),
        ("pepper", ("/meshes/", "/shapes/"), "none of its .* meshes is there"),
        ("pepper", ("<robot", "<robo"), "is not a valid URDF"),
        ("kobo", None, "Kobo: no robot .*: robot_descriptions has no Kobo"),
    ],
)
def test_what_is_another_robot_is_not_shown(
    robot: str,
    change: tuple[str, str] | None,
    message: str,
    package: Callable[[str, str], None],
    upstream: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if change is not None:
        edit(upstream, *change)
    package("pepper_description", str(upstream))
    shown, own = load_robot(robot, source="robot_descriptions"), load_robot(robot)
    assert shown.urdf == own.urdf and shown.link_names == own.link_names
    (record,) = caplog.records
    assert re.search(message, record.getMessage()), record.getMessage()


def test_a_missing_package_is_named(
    package: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    assert load_robot("panda", source="robot_descriptions").urdf == load_robot("panda").urdf
    assert "the package robot_descriptions is not installed; pip install 'mild-viz[robots]'" in caplog.text
