"""The ROS 2 node of the documents, with a stub for ``rclpy``: it closes the loop, and holds where input is stale."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commandline import AMPLE_S
from scipy.spatial.transform import Rotation

from surgbench.geometry import FloatArray, rigid_transform
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.conformance.worlds import circling
from surgbench.viewpoint.bridge.hub import listen
from surgbench.viewpoint.bridge.service import serve
from surgbench.viewpoint.bridge.translation import tell_scene
from surgbench.viewpoint.servo import JointServo, resting_place
from surgbench.viewpoint.simulator import Simulation, make_scene
from surgbench.viewpoint.trial import Trial

NODE = Path(__file__).parents[2] / "examples" / "viewpoint_node.py"
RING_M = 0.033


class JointState:
    def __init__(self, position: Any = (), velocity: Any = ()) -> None:
        self.header = SimpleNamespace(stamp=None)
        self.position, self.velocity = position, velocity


class StubNode:
    """As much of ``rclpy.node.Node`` as there is need of."""

    parameters: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.topics: dict[str, Callable[[Any], None]] = {}
        self.sent: list[tuple[str, Any]] = []
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.warnings: list[str] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], depth: int) -> None:
        self.topics[topic] = callback

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message)))

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.timers.append((period_s, callback))

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.warnings.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))


class Clock:
    """Seconds that pass when a test says so; waiting for a socket is by the machine's own clock."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s


def pose_message(pose: FloatArray) -> Any:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    place = SimpleNamespace(**dict(zip("xyz", pose[:3, 3], strict=True)))
    return SimpleNamespace(pose=SimpleNamespace(position=place, orientation=SimpleNamespace(x=x, y=y, z=z, w=w)))


class Robot:
    """An arm that does what the node publishes, and what the node hears of it and of the tool."""

    def __init__(self, node: Any, trial: Trial, clock: Clock) -> None:
        scene = make_scene(trial)
        self.node, self.trial, self.clock = node, trial, clock
        self.servo = JointServo(scene.arm, trial.start, scene.dt_s, scene.servo_lag_s)

    def tell(self, index: int, *, ring: bool = True, joints: bool = True) -> None:
        servo, heard = self.servo, self.node.topics
        if ring:
            tool = self.trial.T_world_feature[index] @ rigid_transform(np.eye(3), np.array([0.0, 0.0, -RING_M]))
            heard["/PSM1/measured_cp"](pose_message(tool))
        if joints:
            still = np.zeros(6).tolist()
            heard["/PSM3/measured_js"](JointState(servo.joints.tolist(), still))
            heard["/PSM3/setpoint_js"](JointState(servo.setpoint.tolist(), servo.velocity.tolist()))

    def step(self, index: int, **what: bool) -> list[str]:
        """One period; where the node published."""
        self.node.sent.clear()
        self.tell(index, **what)
        self.node.timers[0][1]()
        for topic, message in self.node.sent:
            if topic == "/PSM3/servo_jp":
                self.servo.servo(np.array(message.position), np.array(message.velocity))
            else:
                self.goal = np.array(message.position)
        if not self.node.sent or self.node.sent[-1][0] == "/PSM3/move_jp":
            self.servo.move(self.goal)
        self.clock.now_s += self.trial.dt_s
        return [topic for topic, _ in self.node.sent]


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """The node, connected to our controller and to a robot."""
    trial = circling(120)
    told = json.loads(tell_scene(make_scene(trial), trial.start, 0, 0).encode())
    scene = {key: value for key, value in told.items() if key not in ("type", "id", "joints")}
    (tmp_path / "scene.json").write_text(json.dumps(scene), encoding="utf-8")
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": StubNode},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseStamped": SimpleNamespace},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"JointState": JointState},
    }
    for name, members in modules.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("viewpoint_node", NODE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    # A busy machine may take longer for an answer than a robot's period.
    monkeypatch.setattr(socket.socket, "settimeout", lambda self, _, wait=socket.socket.settimeout: wait(self, AMPLE_S))
    with listen("127.0.0.1", 0, None) as listener:
        monkeypatch.setattr(
            StubNode, "parameters", {"port": listener.getsockname()[1], "scene": str(tmp_path / "scene.json")}
        )
        make: Any = lambda: create(find("tracker", "gaze"), {})  # noqa: E731
        thread = threading.Thread(target=serve, args=(listener, make, lambda line: None, 1), daemon=True)
        thread.start()
        node = module.ViewpointNode()
        yield Robot(node, trial, clock)
        with contextlib.suppress(OSError):
            node._server._socket.shutdown(socket.SHUT_RDWR)
        node._server._socket.close()
        thread.join(AMPLE_S)


def test_the_loop_over_the_topics_is_the_simulator_s(robot: Robot) -> None:
    course = Simulation(
        create(find("tracker", "gaze"), {}), robot.trial, make_scene(robot.trial), np.random.default_rng(0)
    ).run()
    for index in range(len(course.goals)):
        np.testing.assert_allclose(robot.servo.setpoint, course.setpoints[index], atol=1e-7)
        assert robot.step(index) == ["/PSM3/servo_jp"]
    assert robot.node.warnings == []
    assert robot.node.timers[0][0] == robot.trial.dt_s


def test_a_ring_that_is_not_measured_any_more_is_held_once_and_followed_when_it_is_back(robot: Robot) -> None:
    for index in range(20):
        robot.step(index)
    published = [robot.step(index, ring=False) for index in range(20, 60)]
    # For as long as the last measurement is fresh, it is followed.
    moves = [k for k, topics in enumerate(published) if "/PSM3/move_jp" in topics]
    assert len(moves) == 1
    assert 0.1 <= (moves[0] + 1) * robot.trial.dt_s < 0.1 + 2 * robot.trial.dt_s
    assert published[moves[0] + 1 :] == [[]] * (39 - moves[0])
    assert robot.node.warnings == ["holding: the feature was not measured"]
    np.testing.assert_allclose(robot.servo.velocity, 0.0, atol=1e-12)
    assert robot.step(60) == ["/PSM3/servo_jp"]


def test_an_arm_that_says_nothing_is_told_to_stay_once(robot: Robot) -> None:
    for index in range(20):
        robot.step(index)
    rest = resting_place(make_scene(robot.trial).arm, robot.servo.setpoint, robot.servo.velocity)
    robot.clock.now_s += 1.0
    robot.step(20, joints=False)
    assert [topic for topic, _ in robot.node.sent] == ["/PSM3/move_jp"]
    assert np.abs(robot.goal - rest).max() < 2e-3  # it was told of a step before
    assert robot.step(21, joints=False) == []
    assert robot.node.warnings == ["holding: no joints of the camera arm"]


@pytest.mark.parametrize("what", ["NaN", "no velocity", "no quaternion"])
def test_a_message_that_says_nothing_is_none(robot: Robot, what: str) -> None:
    """Nothing is published before everything is there."""
    heard = robot.node.topics
    if what == "NaN":
        robot.tell(0, ring=False)
        message = pose_message(robot.trial.T_world_feature[0])
        message.pose.position.x = float("nan")
        heard["/PSM1/measured_cp"](message)
    elif what == "no quaternion":
        robot.tell(0, ring=False)
        zero = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
        heard["/PSM1/measured_cp"](SimpleNamespace(pose=SimpleNamespace(position=zero, orientation=zero)))
    else:
        robot.tell(0, joints=False)
        heard["/PSM3/measured_js"](JointState([0.0] * 6))
        heard["/PSM3/setpoint_js"](JointState([0.0] * 6))
    robot.node.timers[0][1]()
    assert [topic for topic, _ in robot.node.sent] in ([], ["/PSM3/move_jp"])
    if robot.node.sent:  # the joints are known: to hold is to stay
        np.testing.assert_allclose(robot.node.sent[0][1].position, robot.servo.setpoint, atol=1e-12)


def test_a_server_that_hangs_up_is_held(robot: Robot) -> None:
    for index in range(10):
        robot.step(index)
    rest = resting_place(make_scene(robot.trial).arm, robot.servo.setpoint, robot.servo.velocity)
    robot.node._server._socket.shutdown(socket.SHUT_RDWR)
    assert robot.step(10) == ["/PSM3/move_jp"]
    assert np.abs(robot.goal - rest).max() < 1e-5
    for index in range(11, 60):
        assert robot.step(index) == []
    np.testing.assert_allclose(robot.servo.velocity, 0.0, atol=1e-12)
