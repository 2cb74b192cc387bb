"""Controllers of other processes: what they command is what is run, and whatever they do the arm is safe."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import AMPLE_S, records, surgbench
from hypothesis import given
from hypothesis import strategies as st

from surgbench.dataset.open import open_dataset
from surgbench.registry import create, find
from surgbench.report.rows import read_rows
from surgbench.tasks.viewpoint.conformance.worlds import circling
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.arm_files import load_camera_arm
from surgbench.viewpoint.bridge.hub import Hub, listen
from surgbench.viewpoint.bridge.lines import BridgeError
from surgbench.viewpoint.bridge.messages import Bye, Command, Message, MessageError, ObservationMessage, decode
from surgbench.viewpoint.bridge.service import Service, serve
from surgbench.viewpoint.bridge.translation import tell_arm, tell_observation, tell_scene, understand_arm
from surgbench.viewpoint.contract import ViewpointObservation
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.servo import resting_place
from surgbench.viewpoint.simulator import Course, Simulation, make_scene

EXAMPLES = Path(__file__).parents[2] / "examples"
STEPS = 60
# Where a client hangs; all others are waited for as long as they take.
IMPATIENT_S = 0.2


class Wire:
    """A client as plain as can be: it says what a test has it say."""

    def __init__(self, address: Any) -> None:
        self.socket = socket.socket(socket.AF_UNIX if isinstance(address, str) else socket.AF_INET)
        deadline = time.monotonic() + AMPLE_S
        while self.socket.connect_ex(address):
            assert time.monotonic() < deadline, "nobody listens"
            time.sleep(0.02)
        self.socket.settimeout(AMPLE_S)
        self.file = self.socket.makefile("rw", encoding="utf-8")

    def say(self, text: str | dict[str, Any]) -> None:
        self.file.write((text if isinstance(text, str) else json.dumps(text)) + "\n")
        self.file.flush()

    def hello(self, **more: Any) -> None:
        self.say({"type": "hello", "protocol": 1, "name": "wire", **more})
        assert self.hear()["type"] == "hello"

    def hear(self) -> dict[str, Any]:
        return json.loads(self.file.readline() or '{"type": "bye"}')  # type: ignore[no-any-return]

    def close(self) -> None:
        with contextlib.suppress(OSError):  # what could not be sent
            self.file.close()
        self.socket.close()


Answer = Callable[[Wire, dict[str, Any]], None]


def straight(wire: Wire, message: dict[str, Any]) -> None:
    """What the example does."""
    if message["type"] == "scene":
        wire.say({"type": "ready", "id": message["id"]})
    elif message["type"] == "observation":
        pose = naive_pose(np.array(message["T_world_feature"])).tolist()
        wire.say({"type": "command", "id": message["id"], "pose": pose})


@contextlib.contextmanager
def client(address: Any, answer: Answer) -> Iterator[list[dict[str, Any]]]:
    """A client in a thread of its own; yields all that it is told."""
    told: list[dict[str, Any]] = []

    def talk() -> None:
        with contextlib.closing(Wire(address)) as wire, contextlib.suppress(OSError):
            wire.hello()
            while True:
                told.append(wire.hear())
                if told[-1]["type"] == "bye":
                    return
                answer(wire, told[-1])

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    yield told
    thread.join(AMPLE_S)
    assert not thread.is_alive(), "it hangs"


def remotely(answer: Answer, patience_s: float = AMPLE_S) -> tuple[Course, Any, list[dict[str, Any]]]:
    """A trial whose controller is a client; its course, the tracker, and what the client was told."""
    trial = circling(STEPS)
    with listen("127.0.0.1", 0, None) as listener:
        hub = Hub(listener, AMPLE_S, lambda line: None, lambda: None)
        with client(listener.getsockname(), answer) as told:
            assert hub.client().name == "wire"
            with hub.handing_out():
                tracker = create(find("tracker", "remote"), {"patience_s": patience_s})
                course = Simulation(tracker, trial, make_scene(trial), np.random.default_rng(0)).run()
                tracker.close()
            hub.bye()
    return course, tracker, told


def directly(controller: Any) -> Course:
    trial = circling(STEPS)
    return Simulation(controller, trial, make_scene(trial), np.random.default_rng(0)).run()


class Straight:
    """The same as :func:`straight`, here."""

    def reset(self, scene: Any, joints: Any, rng: Any) -> None: ...

    def step(self, observation: ViewpointObservation) -> Any:
        return naive_pose(observation.T_world_feature)


def same_course(one: Course, other: Course) -> None:
    for name in ("joints", "setpoints", "goals", "clipped", "active", "solver"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


# --- a client controls


def test_a_client_is_run_as_the_same_controller_here() -> None:
    course, tracker, told = remotely(straight)
    assert tracker.held is None
    same_course(course, directly(Straight()))
    assert [message["type"] for message in told] == ["scene", *["observation"] * STEPS, "bye"]
    assert len({message["id"] for message in told[:-1]}) == STEPS + 1


@pytest.mark.parametrize("name", ["gaze", "autocam"])
def test_both_doors_one_after_the_other_change_no_bit(name: str) -> None:
    """Our controller behind the bridge's other end: joints and velocities, rules and all, as if it stood here."""
    service = Service(lambda: create(find("tracker", name), {}))

    def ask(wire: Wire, message: dict[str, Any]) -> None:
        answer = service(decode(json.dumps(message).encode()))
        assert answer is not None
        wire.say(answer.encode().decode().strip())

    course, tracker, _ = remotely(ask)
    assert tracker.held is None
    same_course(course, directly(create(find("tracker", name), {})))


def after(step: int, what: Answer) -> Answer:
    """Be good at first."""

    def answer(wire: Wire, message: dict[str, Any]) -> None:
        (what if message.get("index", -1) >= step or message["type"] == "error" else straight)(wire, message)

    return answer


def says(text: str) -> Answer:
    """Say one thing, with the right id."""

    def answer(wire: Wire, message: dict[str, Any]) -> None:
        if message["type"] == "observation":
            wire.say(text.replace("ID", json.dumps(message["id"])))

    return answer


def floods(wire: Wire, message: dict[str, Any]) -> None:
    """Answers, again and again, what was never asked."""
    while True:
        wire.say({"type": "command", "id": "no such", "joints": [0.0] * 6})


COMMAND = '{"type": "command", "id": ID, '
WRONG: dict[str, tuple[Answer, str, str]] = {
    "hangs": (lambda wire, message: None, "timeout", "no answer from the client within 0.2 s"),
    "floods": (floods, "timeout", "no answer from the client within 0.2 s"),
    "hangs up": (lambda wire, message: wire.socket.shutdown(socket.SHUT_RDWR), "exited", "closed the connection"),
    "garbage": (says("\x00 what?"), "invalid", "the client sent no message"),
    "a million bytes": (says("7" * 1_000_000), "invalid", "a line of more than 65536 bytes"),
    "deep": (says("[" * 60_000), "invalid", "no message"),
    "NaN": (says(COMMAND + '"joints": [NaN, 0, 0, 0, 0, 0]}'), "invalid", "should be a finite number, not nan"),
    "infinite": (says(COMMAND + '"joints": [1e999, 0, 0, 0, 0, 0]}'), "invalid", "should be a finite number"),
    "five joints": (says(COMMAND + '"joints": [0, 0, 0, 0, 0]}'), "invalid", "key 'joints.5' is missing"),
    "no target": (says(COMMAND + '"mode": "move"}'), "invalid", "either 'joints' or 'pose'"),
    "misspelt": (says(COMMAND + '"joint": [0, 0, 0, 0, 0, 0]}'), "invalid", "did you mean 'joints'"),
    "no rotation": (
        says(COMMAND + '"pose": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}'),
        "invalid",
        "whose rotation is no rotation",
    ),
    "no rule": (says(COMMAND + '"joints": [0,0,0,0,0,0], "active": ["gravity"]}'), "invalid", "rule 'gravity'"),
    "not asked": (says('{"type": "ready", "id": ID}'), "invalid", "another message than 'command'"),
    "gives up": (says('{"type": "error", "error": "I am\\nlost"}'), "failed", "the client says: I am lost"),
}


@pytest.mark.parametrize("how", WRONG)
def test_whatever_a_client_does_the_arm_comes_to_rest_and_the_row_says_why(how: str) -> None:
    what, status, words = WRONG[how]
    course, tracker, told = remotely(after(20, what), IMPATIENT_S if status == "timeout" else AMPLE_S)
    assert tracker.held is not None
    assert tracker.held[0] == status
    assert words in tracker.held[1]
    assert tracker.held[1].endswith("; the arm came to rest and stayed")
    assert "\n" not in tracker.held[1]
    assert len(course.goals) == STEPS
    assert np.isfinite(course.joints).all()
    np.testing.assert_allclose(course.setpoints[-1], course.setpoints[-2], atol=1e-12)
    if status != "timeout":  # on a busy machine it may come earlier
        assert tracker.held[1].startswith("step 20: ")
        np.testing.assert_array_equal(course.setpoints[:21], directly(Straight()).setpoints[:21])
    if how in ("garbage", "NaN", "no rotation"):  # the connection is as good as before
        assert {"type": "error", "id": None, "error": tracker.held[1]} in told


def test_a_client_that_is_never_ready_is_held_from_the_first_step() -> None:
    course, tracker, _ = remotely(lambda wire, message: None, IMPATIENT_S)
    assert tracker.held[0] == "timeout"
    assert tracker.held[1].startswith("before the first step: no answer")
    np.testing.assert_array_equal(course.setpoints, course.setpoints[[0]].repeat(STEPS + 1, axis=0))


def test_a_client_with_much_to_complain_of_is_held_like_any_other() -> None:
    course, tracker, _ = remotely(lambda wire, message: wire.say({"type": "error", "error": "x" * 2000}), AMPLE_S)
    assert tracker.held[0] == "failed"
    assert len(course.goals) == STEPS


def test_a_client_that_has_left_may_come_back_for_the_next_trial_and_is_waited_for_no_longer_than_told() -> None:
    trial, gone = circling(STEPS), []
    with listen("127.0.0.1", 0, None) as listener:
        hub = Hub(listener, AMPLE_S, lambda line: None, lambda: gone.append(True))

        def run() -> Any:
            tracker = create(find("tracker", "remote"), {"patience_s": AMPLE_S})
            Simulation(tracker, trial, make_scene(trial), np.random.default_rng(0)).run()
            tracker.close()
            return tracker.held

        with hub.handing_out():
            leave = after(20, lambda wire, message: wire.socket.shutdown(socket.SHUT_RDWR))
            with client(listener.getsockname(), leave):
                assert "the client closed the connection" in run()[1]
            with client(listener.getsockname(), straight):
                assert run() is None
                hub.bye()
            hub._patience_s = IMPATIENT_S
            with pytest.raises(BridgeError, match=r"no client came to 127.0.0.1:\d+ within 0.2 s"):
                run()
    assert gone == [True]


def test_who_does_not_greet_is_told_so_and_the_next_one_is_served() -> None:
    with listen("127.0.0.1", 0, None) as listener:
        said: list[str] = []
        hub = Hub(listener, AMPLE_S, said.append, lambda: None)

        def come() -> None:
            for text, words in (("GET / HTTP/1.1", "no message"), ('{"type": "hello", "protocol": 2}', "protocol 2")):
                with contextlib.closing(Wire(listener.getsockname())) as stranger:
                    stranger.say(text)
                    assert words in stranger.hear()["error"]
            with contextlib.closing(Wire(listener.getsockname())) as wire:
                wire.hello(name="third")
                assert wire.hear() == {"type": "bye"}

        thread = threading.Thread(target=come, daemon=True)
        thread.start()
        assert hub.client().name == "third"
        hub.bye()
        thread.join(AMPLE_S)
    assert sum(line.startswith("turned away: ") for line in said) == 2


# --- our controller commands


def scene_of(steps: int = 3) -> tuple[Message, ViewpointObservation]:
    """What a client says of a trial, and its first observation."""
    trial = circling(steps)
    scene = make_scene(trial)
    still = np.zeros(6)
    observation = ViewpointObservation(0, 0.0, trial.T_world_feature[0], trial.start, trial.start, still)
    return tell_scene(scene, trial.start, 1, 0), observation


def test_a_feature_that_is_not_measured_is_answered_with_where_the_arm_comes_to_rest() -> None:
    service = Service(lambda: create(find("tracker", "gaze"), {}))
    scene, observation = scene_of()
    service(scene)
    moving = np.array([0.3, -0.3, 0.05, 1.0, 0.0, 0.0])
    message = tell_observation(observation, 2)
    answer = service(message.model_copy(update={"T_world_feature": None, "setpoint_velocity": tuple(moving)}))
    assert isinstance(answer, Command)
    assert (answer.mode, answer.velocity, answer.held) == ("move", None, "the feature was not measured")
    arm = make_scene(circling(3)).arm
    np.testing.assert_array_equal(answer.joints, resting_place(arm, observation.setpoint, moving))
    rest = observation.setpoint + moving * np.abs(moving) / (2 * np.array(arm.acceleration))
    np.testing.assert_allclose(np.array(answer.joints), rest)


class Faint:
    """Answers twice."""

    def reset(self, scene: Any, joints: Any, rng: Any) -> None:
        self.left = 2

    def step(self, observation: ViewpointObservation) -> Any:
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("it is all\ntoo much")
        return observation.setpoint if self.left else np.full(6, np.nan)


def test_a_controller_of_ours_that_fails_holds_the_arm_and_says_why() -> None:
    service = Service(Faint)
    scene, observation = scene_of()
    service(scene)
    said = [service(tell_observation(observation, k)) for k in range(3)]
    held = [one.held for one in said if isinstance(one, Command)]
    assert held[0] is None
    assert "NaN or infinity" in str(held[1])
    assert held[2] == "the controller: RuntimeError: it is all too much"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": [9.0] * 6}, "the arm rests outside its joint limits"),
        ({"T_world_base": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "T_world_base is not a rotation"),
        ({"workspace.zone_m": [[0, 0, 0]] * 5}, "collinear"),
        ({"workspace.preferred_side": [2, 0, 0]}, "unit length"),
        ({"arm.lower": [9] * 6}, "a lower joint limit of the arm is above the upper one"),
    ],
)
def test_a_scene_that_cannot_be_is_told_in_one_line(change: dict[str, Any], words: str) -> None:
    service = Service(Faint)
    told = json.loads(scene_of()[0].encode())
    for key, value in change.items():
        *place, last = key.split(".")
        (told[place[0]] if place else told)[last] = value
    answer = service(decode(json.dumps(told).encode()))
    assert answer is not None
    assert words in json.loads(answer.encode())["error"]
    missing = service(tell_observation(scene_of()[1], 5))
    assert missing is not None
    assert json.loads(missing.encode()) == {"type": "error", "id": 5, "error": "there is no scene yet"}


@pytest.mark.parametrize("name", ["psm_classic", "ecm", "ecm_30_up"])
def test_an_arm_comes_out_as_it_went_in(name: str) -> None:
    """One with locked joints, too; where none is told of it is the simulator's."""
    arm = load_camera_arm(name).arm()
    back = understand_arm(tell_arm(arm))
    for one, other in ((back.packed, arm.packed), (back.lower, arm.lower), (back.upper, arm.upper)):
        np.testing.assert_array_equal(one, other)
    assert (back.velocity, back.acceleration, back.camera_m) == (arm.velocity, arm.acceleration, arm.camera_m)
    assert understand_arm(None) == load_camera_arm("psm_classic").arm()


def test_our_controller_answers_over_a_socket_whatever_else_is_said(tmp_path: Path) -> None:
    said: list[str] = []
    scene, observation = scene_of()
    with listen("", 0, tmp_path / "bridge") as listener:
        thread = threading.Thread(target=serve, args=(listener, Faint, said.append, 2), daemon=True)
        thread.start()
        wire = Wire(listener.getsockname())
        wire.hello()
        wire.say("what?")
        assert "no message" in wire.hear()["error"]
        wire.say(scene.encode().decode().strip())
        assert wire.hear() == {"type": "ready", "id": 1}
        wire.say({"type": "ready", "id": 3})
        assert "a client says" in wire.hear()["error"]
        wire.say(tell_observation(observation, "seven").encode().decode().strip())
        assert wire.hear()["id"] == "seven"
        with contextlib.suppress(OSError):  # it hangs up in the middle
            wire.say("7" * 1_000_000)
            assert wire.hear()["type"] == "bye"
        wire.close()
        wire = Wire(listener.getsockname())
        wire.hello()
        wire.say({"type": "bye"})
        assert wire.hear() == {"type": "bye"}
        wire.close()
        thread.join(AMPLE_S)
    assert said == [
        "'wire' is here",
        "the client sent a line of more than 65536 bytes",
        "'wire' is here",
        "it has left",
    ]


# --- messages


FRAGMENTS = (
    '{"type": "command"',
    ', "id": 1',
    ', "joints": ',
    "[",
    "]",
    "}",
    "0, ",
    "NaN",
    "1e999",
    '"',
    "\\ud800",
    "null",
)


@given(st.binary(max_size=200) | st.lists(st.sampled_from(FRAGMENTS)).map(lambda parts: "".join(parts).encode()))
def test_any_line_is_a_message_or_told_in_one_line(line: bytes) -> None:
    try:
        decode(line)
    except MessageError as error:
        assert "\n" not in str(error)  # noqa: PT017
        assert len(str(error)) < 1000  # noqa: PT017


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=34, max_size=34))
def test_numbers_come_out_as_they_went_in_to_the_last_bit(numbers: list[float]) -> None:
    pose = np.reshape(numbers[:16], (4, 4))
    observation = ViewpointObservation(3, 0.1, pose, *np.reshape(numbers[16:], (3, 6)))
    back = decode(tell_observation(observation, "a").encode())
    assert isinstance(back, ObservationMessage)
    assert back == tell_observation(observation, "a")
    assert np.array(back.T_world_feature).tobytes() == pose.tobytes()
    assert isinstance(decode(Bye().encode()), Bye)


# --- the command


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short trials."""
    folder = tmp_path_factory.mktemp("bridge") / "chaser"
    surgbench("generate", "wire-chaser-mini", "--sequences", 2, "--frames", 100, "--jobs", 1, "--out", folder)
    return folder


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# A client as a user starts it, once the server is there.
STARTED = """
import runpy, socket, sys, time
while socket.socket().connect_ex(("127.0.0.1", int(sys.argv[2]))):
    time.sleep(0.05)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
def test_the_client_of_the_documents_is_scored_as_a_controller_here(dataset: Path, tmp_path: Path) -> None:
    port, out = free_port(), tmp_path / "runs"
    command = [sys.executable, "-W", "ignore", "-c", STARTED, str(EXAMPLES / "viewpoint_client.py"), str(port)]
    with subprocess.Popen(command) as started:
        surgbench(
            *("serve-viewpoint", "--dataset", dataset, "--sequences", 1, "--frames", STEPS, "--port", port),
            *("--wait", AMPLE_S, "--timeout", AMPLE_S, "--out", out),
        )
        assert started.wait(AMPLE_S) == 0
    (record,) = records(out)
    assert (record["status"], record["spec"]["row_id"], record["unit_frames"]) == ("ok", "straight", STEPS)
    data = open_dataset(dataset)
    assert isinstance(data, ViewpointDataset)
    trial = data.trial(record["spec"]["unit"])
    course = Simulation(Straight(), trial, make_scene(trial), np.random.default_rng(0), STEPS).run()
    np.testing.assert_allclose(record["frames"]["setpoint"], course.setpoints[1:], atol=1e-8)
    (row,) = (row for row in read_rows([out]) if row["subset"] == "all" and row["camera"] is None)
    assert (row["row_id"], row["tracker"], row["status"]) == ("straight", "remote", "ok")
    assert row["vva_deg"] == pytest.approx(course_errors(course, trial, make_scene(trial))["vva_deg"].mean(), abs=1e-4)


@pytest.mark.slow
def test_a_client_that_leaves_costs_its_trial_and_what_comes_after_waits_for_the_next_call(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "bridge", tmp_path / "runs"
    leave = after(20, lambda wire, message: wire.socket.shutdown(socket.SHUT_RDWR))
    with client(str(path), leave):
        surgbench(
            *("serve-viewpoint", "--dataset", dataset, "--socket", path, "--name", "leaver", "--wait", 1),
            *("--registration", "rigid", "--frames", STEPS, "--timeout", AMPLE_S, "--out", out),
            expect=1,
        )
    error = capsys.readouterr().err
    line = "step 20: the client closed the connection; the arm came to rest and stayed"
    assert f"leaver 000: exited: {line}" in error
    assert f"no client came to {path} within 1 s; the same command again goes on from here" in error
    (record,) = records(out)
    assert (record["status"], record["error"]) == ("exited", line)
    assert record["spec"]["registration"] == "rigid"
    assert np.isfinite(record["frames"]["joints"]).all()
    assert len(record["frames"]["index"]) == STEPS
    before, last = record["frames"]["setpoint"][-2:]
    np.testing.assert_allclose(last, before, atol=1e-9)
    assert not path.exists()


def test_our_controller_answers_at_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, observation = scene_of()
    sent = [scene, tell_observation(observation, 2), Bye()]
    path = tmp_path / "bridge"
    told: list[dict[str, Any]] = []

    def talk() -> None:
        with contextlib.closing(Wire(str(path))) as wire:
            wire.hello()
            for message in sent:
                wire.say(message.encode().decode().strip())
                told.append(wire.hear())

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    surgbench("serve-viewpoint", "--tracker", "gaze", "--socket", path, "--clients", 1)
    thread.join(AMPLE_S)
    assert [message["type"] for message in told] == ["ready", "command", "bye"]
    assert (told[1]["mode"], told[1]["held"]) == ("servo", None)
    assert "'gaze' answers at" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "say either --dataset DIR"),
        (["--tracker", "gaze", "--dataset", "x", "--port", 0], "say either --dataset DIR"),
        (["--tracker", "gaze"], "say either --port PORT or --socket PATH"),
        (["--tracker", "gaez", "--port", 0], "did you mean 'gaze'"),
        (["--tracker", "cmaes", "--port", 0], "commands no camera"),
        (["--tracker", "remote", "--port", 0], "commands no camera"),
        (["--tracker", "foresight", "--port", 0], "must be told the future"),
        (["--tracker", "gaze", "--port", 0, "--set", "gaze.patience=1"], "did you mean"),
        (["--tracker", "gaze", "--port", 0, "--registration", "rigid"], "'registration' takes no part"),
        (["--dataset", "nowhere", "--port", 0], "nowhere"),
        (["--tracker", "gaze", "--socket", "/nowhere/at/all"], "cannot be listened at"),
    ],
)
def test_a_command_that_cannot_be_is_told_in_one_line(
    arguments: list[Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench("serve-viewpoint", *arguments, expect=2)
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
