"""Stages, with contacts and poses set by hand."""

import numpy as np
import pytest

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.either_arm import EitherArmTask
from imfvla.tasks.gate import BAR_LENGTH, GateTask
from imfvla.tasks.kinematics import rotation_matrix
from imfvla.tasks.props import RING_THICKNESS
from imfvla.tasks.socket import PEG_LENGTH, SocketTask, measure_fit
from imfvla.tasks.transfer import TransferTask

AIR = 0.2


@pytest.fixture
def socket_task(monkeypatch) -> SocketTask:
    return _without_physics(monkeypatch, SocketTask("default"))


@pytest.fixture
def transfer_task(monkeypatch) -> TransferTask:
    return _without_physics(monkeypatch, TransferTask("default"))


@pytest.fixture
def gate_task(monkeypatch) -> GateTask:
    return _without_physics(monkeypatch, GateTask("default"))


@pytest.fixture
def either_task(monkeypatch) -> EitherArmTask:
    return _without_physics(monkeypatch, EitherArmTask("default"))


def _without_physics(monkeypatch, task):
    """The task with poses and contacts of the test's choice: `held`, `touched`, `resting` and `poses`."""
    task.held, task.touched, task.resting, task.poses = set(), set(), set(), {}
    monkeypatch.setattr(task, "contacts", lambda physics: None)
    monkeypatch.setattr(task, "holds", lambda contacts, side, name: (side, name) in task.held)
    monkeypatch.setattr(
        task, "touches", lambda contacts, side, name: (side, name) in task.held | task.touched
    )
    monkeypatch.setattr(task, "on_table", lambda contacts, name: name in task.resting)
    monkeypatch.setattr(task, "prop_pose", lambda physics, name: task.poses[name])
    return task


def peg_at(depth: float, aside: float = 0.0, tilt: float = 0.0, height: float = AIR) -> Pose:
    """A peg whose tip is `depth` deep in a socket at (0, 0, AIR), turned about its tip."""
    rotation = rotation_matrix(np.array([0, 0, tilt]))
    tip = np.array([-depth, aside, height])
    return Pose(tip + rotation[:, 0] * PEG_LENGTH / 2, rotation)


@pytest.mark.parametrize(
    ("peg", "stage"),
    [
        (peg_at(-0.1), 2),
        (peg_at(-0.02), 3),
        (peg_at(-0.02, aside=0.02), 2),
        (peg_at(-0.02, tilt=0.4), 2),
        (peg_at(0.01), 4),
        (peg_at(0.01, aside=0.01), 3),
        (peg_at(0.01, tilt=0.2), 3),
        (peg_at(RING_THICKNESS), 5),
        (peg_at(RING_THICKNESS, aside=0.01), 3),
        (peg_at(0.05), 5),
    ],
)
def test_socket_stages_of_lifted_objects(socket_task, peg, stage):
    socket_task.poses = {"socket": Pose(np.array([0, 0, AIR]), np.eye(3)), "peg": peg}
    assert socket_task.stage(None) == 0
    socket_task.held = {("right", "peg")}
    assert socket_task.stage(None) == 0
    socket_task.held = {("left", "socket"), ("right", "peg")}
    assert socket_task.stage(None) == stage


def test_socket_stages_on_the_table(socket_task):
    socket_task.held = {("left", "socket"), ("right", "peg")}
    socket_task.poses = {"socket": Pose(np.array([0, 0, 0.034]), np.eye(3)), "peg": peg_at(-0.2)}
    assert socket_task.stage(None) == 1
    socket_task.poses["peg"] = peg_at(0.03, height=0.034)
    assert socket_task.stage(None) == 1


def test_either_end_of_the_peg_will_do():
    socket = Pose(np.array([0.1, 0.2, 0.3]), rotation_matrix(np.array([0.1, -0.2, 0.9])))
    for turn in (0, np.pi):
        rotation = socket.rotation @ rotation_matrix(np.array([0, 0, turn]))
        peg = Pose(socket.at(np.array([PEG_LENGTH / 2 - 0.017, 0.002, -0.001])), rotation)
        fit = measure_fit(socket, peg)
        assert fit.depth == pytest.approx(0.017)
        np.testing.assert_allclose(fit.aside, [0.002, -0.001], atol=1e-9)
        assert fit.angle == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("held", "touched", "height", "resting", "stage"),
    [
        ("", "", 0.012, True, 0),
        ("right", "", 0.012, True, 1),
        ("right", "", 0.03, False, 1),
        ("right", "", AIR, False, 2),
        ("right", "left", AIR, False, 2),
        ("left right", "", AIR, False, 3),
        ("left right", "", 0.012, True, 1),
        ("left", "right", AIR, False, 0),
        ("left", "", AIR, False, 4),
        ("left", "", AIR, True, 0),
        ("left", "", 0.012, True, 0),
    ],
)
def test_transfer_stages(transfer_task, held, touched, height, resting, stage):
    transfer_task.held = {(side, "bar") for side in held.split()}
    transfer_task.touched = {(side, "bar") for side in touched.split()}
    transfer_task.resting = {"bar"} if resting else set()
    transfer_task.poses = {"bar": Pose(np.array([0, 0, height]), np.eye(3))}
    assert transfer_task.stage(None) == stage


@pytest.mark.parametrize(
    ("x", "height", "resting", "stage"),
    [
        (0.25, 0.012, True, 1),
        (0.25, AIR, False, 2),
        (0.1 + BAR_LENGTH / 2 + 0.005, AIR, False, 2),
        (0.1 + BAR_LENGTH / 2 - 0.005, AIR, False, 3),
        (0.1 - BAR_LENGTH / 2 - 0.005, AIR, False, 3),
        (0.1 - BAR_LENGTH / 2 - 0.01, AIR, False, 4),
        (0.1 - BAR_LENGTH / 2 - 0.01, 0.012, True, 1),
    ],
)
@pytest.mark.parametrize("turn", [0, np.pi])
def test_gate_stages(gate_task, x, height, resting, stage, turn):
    gate_task.resting = {"bar"} if resting else set()
    bar = Pose(np.array([x, 0.05, height]), rotation_matrix(np.array([0, 0, turn])))
    gate_task.poses = {"bar": bar, "post": Pose(np.array([0.1, 0, 0]), np.eye(3))}
    assert gate_task.stage(None) == 0
    gate_task.held = {("right", "bar")}
    assert gate_task.stage(None) == stage
    gate_task.touched_post = True
    assert gate_task.stage(None) == 0


@pytest.mark.parametrize(
    ("held", "touched", "height", "distance", "alone", "shared"),
    [
        ("", "", 0.012, 0.2, 0, 0),
        ("left", "", 0.012, 0.2, 1, 1),
        ("left right", "", 0.012, 0.0, 2, 2),
        ("left right", "", AIR, 0.0, 3, 3),
        ("left", "right", AIR, 0.0, 1, 1),
        ("right", "", AIR, 0.01, 1, 4),
        ("left", "", AIR, 0.01, 1, 4),
        ("left", "", AIR, 0.06, 1, 5),
        ("right", "", AIR, 0.06, 1, 5),
        ("", "", AIR, 0.06, 0, 0),
    ],
)
def test_either_arm_stages(either_task, monkeypatch, held, touched, height, distance, alone, shared):
    """An arm alone counts only after both have lifted the bar."""
    either_task.held = {(side, "bar") for side in held.split()}
    either_task.touched = {(side, "bar") for side in touched.split()}
    either_task.poses = {"bar": Pose(np.array([0, 0, height]), np.eye(3))}
    monkeypatch.setattr(either_task, "distance", lambda physics, side: distance)
    for either_task.shared, stage in ((False, alone), (True, shared)):
        assert either_task.stage(None) == stage
