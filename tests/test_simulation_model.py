"""The arm as MuJoCo takes it, against our kinematics and the maker's masses; what is refused."""

from __future__ import annotations

import importlib
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.simulation.model import GRAVITY, HAND, build_model

mujoco: Any = importlib.import_module("mujoco")  # its stubs name nothing
LINKS = ("RShoulder", "RBicep", "RElbow", "RForeArm", "r_wrist")


@pytest.fixture(scope="module")
def pepper() -> RobotModel:
    return load_robot("pepper")


def pose(model: Any, joints: np.ndarray) -> Any:
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_forward(model, data)
    return data


def test_the_hand_is_where_our_kinematics_say(pepper: RobotModel) -> None:
    model = build_model(pepper, 1e-3, True)
    assert [model.joint(number).name for number in range(model.njnt)] == list(pepper.chain.joint_names)
    joints = np.random.default_rng(0).uniform(pepper.chain.lower, pepper.chain.upper, (50, 4))
    hands = [pose(model, row).site(HAND).xpos.copy() for row in joints]
    assert np.allclose(hands, pepper.end_effector(joints), rtol=0, atol=1e-6)


def test_masses_and_centres_are_the_makers(pepper: RobotModel, shared: Callable[[str], Path]) -> None:
    ours: dict[str, Any] = {link.name: link.inertial for link in pepper.description.urdf.robot.links}
    root = ET.parse(shared("robots/pepper_naoqi/pepper.urdf")).getroot()
    reference = {str(link.get("name")): link for link in root.findall("link")}
    for link in LINKS + tuple(name.replace("R", "L", 1).replace("r_", "l_") for name in LINKS):
        inertial = reference[link].find("inertial")
        assert inertial is not None
        mass, origin = inertial.find("mass"), inertial.find("origin")
        assert mass is not None and origin is not None
        assert ours[link].mass == pytest.approx(float(str(mass.get("value"))), rel=1e-6)
        centre = [float(value) for value in str(origin.get("xyz")).split()]
        assert np.allclose(ours[link].origin[:3, 3], centre, rtol=0, atol=1e-6)


def test_estimated_moments_matter_little(pepper: RobotModel, shared: Callable[[str], Path]) -> None:
    """About the shoulder's pitch axis, straight arm: masses by our cylinders against masses by the maker's tensors."""
    model = build_model(pepper, 1e-3, True)
    data = pose(model, np.array([0.0, -0.0087, 0.0, 0.0087]))
    root = ET.parse(shared("robots/pepper_naoqi/pepper.urdf")).getroot()
    published = 0.0
    for link in LINKS:
        inertia = root.find(f"link[@name='{link}']/inertial/inertia")
        assert inertia is not None
        names = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        tensor = np.array([[float(str(inertia.get(name))) for name in row] for row in names])
        turned = data.body(link).xmat.reshape(3, 3) @ tensor @ data.body(link).xmat.reshape(3, 3).T
        away = data.body(link).xipos - data.xanchor[0]
        published += model.body(link).mass[0] * (away[0] ** 2 + away[2] ** 2) + turned[1, 1]
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, inertia, data.qM)
    ours = inertia[0, 0] - pepper.spec.dynamics.rotor_inertia
    assert ours == pytest.approx(published, rel=0.02)
    assert ours == pytest.approx(0.060, abs=0.0005)  # the README says so
    assert data.qfrc_bias[0] == pytest.approx(-2.2, abs=0.05)
    assert model.opt.gravity[2] == -GRAVITY


def test_other_robots_are_refused_by_name() -> None:
    with pytest.raises(UserError, match="nothing that joint 'panda_joint1' moves has an <inertial>.*pepper"):
        build_model(load_robot("panda"), 1e-3, True)


def test_a_missing_package_is_named_with_its_extra(pepper: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UserError, match=r"pip install 'mild-viz\[sim\]'"):
        build_model(pepper, 1e-3, True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="0.50527"/>', '<mass value="-1"/>', "link 'RBicep' has the mass -1.0"),
        ('ixx="0.0004579"', 'ixx="-0.0004579"', "link 'RBicep' has the inertia (?s:.*) positive definite"),
        ('effort="5.428"', 'effort="0"', "joint 'RShoulderPitch' has the effort 0.0"),
    ],
)
def test_broken_numbers_are_refused(tmp_path: Path, pepper: RobotModel, old: str, new: str, message: str) -> None:
    text = pepper.urdf.read_text(encoding="utf-8")
    assert old in text
    start = text.index('name="RBicep"') if "effort" not in old else text.index('<joint name="RShoulderPitch"')
    (tmp_path / "broken.urdf").write_text(text[:start] + text[start:].replace(old, new, 1), encoding="utf-8")
    with pytest.raises(UserError, match=message):
        build_model(load_robot(str(tmp_path / "broken.urdf")), 1e-3, True)
