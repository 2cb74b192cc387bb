"""`surgbench check tracker`: every tracker of ours passes, and every rule has a stranger that breaks it."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commandline import AMPLE_S, STRANGERS, surgbench

import surgbench.conformance.conduct as conducting
from surgbench.conformance.checks import Outcome, checks_of, run_check
from surgbench.conformance.conduct import conduct
from surgbench.conformance.subject import Subject
from surgbench.processes.child import Child
from surgbench.registry import discover, find
from surgbench.tasks.instrument.conformance.checks import CHECKS
from surgbench.tasks.instrument.conformance.scenes import evaluator, make_play

# A second for each step: two show what ten do.
QUICK = {"adam-mitsuba": {"iterations": 2}}


class PatientChild(Child):
    """Waits as long as it is told to for the check that hangs, and for the others as long as they take."""

    def send(self, *message: Any) -> None:
        if message[0] == "check" and message[1] != "empty masks":
            self.timeout_s = AMPLE_S
        super().send(*message)


def stranger(name: str, **how: float) -> Subject:
    return Subject(f"{STRANGERS}:{name}", **how)  # type: ignore[arg-type]


SOUND = sorted(name for name, found in discover("tracker").items() if found.problem is None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name in QUICK else name for name in SOUND]
)
def test_every_tracker_of_ours_keeps_the_rules(name: str) -> None:
    reason = find("tracker", name).unavailable
    if reason is not None:
        pytest.skip(reason)
    subject, broken = Subject(name, options=QUICK.get(name, {}), budget_s=AMPLE_S), []
    for check in checks_of(subject):  # here, not in a child: its start takes as long as all checks of a quick tracker
        outcome = run_check(check, subject)
        subject = replace(subject, aids=subject.aids | ({outcome.needs} if outcome.needs else set()))
        broken += [outcome] if outcome.status not in ("ok", "refused") else []
    assert broken == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "check", "message"),
    [
        ("ReturnsNan", "plain sequence", "frame 0: step returned a state with NaN"),
        ("ReturnsShape", "plain sequence", "returned a state of shape (7,), not (9,)"),
        ("ReturnsText", "plain sequence", "returned a state of str"),
        ("CertainOfAll", "plain sequence", "returned a standard deviation of 0, not above 0"),
        ("NanConfidence", "plain sequence", "confidence that is no number"),
        ("Raises", "plain sequence", "RuntimeError: no instrument anywhere"),
        ("NoisyFromNowhere", "same seed", "differ from frame 0 on"),
        ("NoisyFromEverybodys", "same seed", "differ from frame 0 on"),
        ("NoisyFromEverybodys", "no global randomness", "global generator of numpy"),
        ("SeedsEverybodys", "no global randomness", "global generator of random"),
        ("Dawdles", "time", "a step took"),
        ("Remembers", "reset starts anew", "after another sequence frame 0"),
        ("Unpicklable", "another process", "cannot be pickled"),
        ("LosesItsPlace", "another process", "in another process frame 4 comes out differently"),
        ("WritesMask", "input untouched", "step writes into the mask"),
        ("WritesState", "input untouched", "reset writes into state"),
        ("DividesByTheMask", "empty masks", "NaN"),
        ("DividesByTheMask", "lost and found", "frame 3: step returned a state with NaN"),
        ("NeedsTips", "no keypoints", "AttributeError"),
        ("NeedsReadings", "readings", "AttributeError"),
        ("LostBehindTheCamera", "strange starts", "a search that starts behind the camera: "),
        ("OneArmInSilence", "two arms", "returned a state of shape (9,), not (18,)"),
        ("ShowsOthers", "candidates", "the estimates change when 'trace' is set"),
    ],
)
def test_who_breaks_a_rule_is_caught(name: str, check: str, message: str) -> None:
    outcome = run_check(check, stranger(name, budget_s=0.01 if check == "time" else 10.0))
    assert outcome.status == "FAILED"
    assert message in outcome.message
    assert "\n" not in outcome.message


@pytest.mark.parametrize(
    ("name", "check", "message"),
    [("BeyondLimits", "joint limits", "q3 is up to"), ("TooSure", "plain sequence", "a confidence of 2")],
)
def test_what_is_allowed_and_unwise_is_a_warning(name: str, check: str, message: str) -> None:
    outcome = run_check(check, stranger(name))
    assert outcome.status == "warning"
    assert message in outcome.message


def test_a_refusal_is_no_failure() -> None:
    outcome = run_check("two arms", stranger("OneArm"))
    assert (outcome.status, outcome.message) == ("refused", "one-arm follows one arm only")
    # Only where there is something to refuse.
    assert run_check("empty masks", stranger("NeedsKinematics")).status == "FAILED"


@pytest.mark.slow
def test_who_needs_kinematics_is_checked_with_them() -> None:
    names = ["plain sequence", "empty masks", "readings", "kinematics", "two arms"]
    outcomes = {outcome.check: outcome for outcome in conduct(stranger("NeedsKinematics"), AMPLE_S, names=names)}
    assert outcomes["plain sequence"].status == "refused"
    assert outcomes["plain sequence"].message.startswith("needs kinematics (")
    assert [outcomes[name].status for name in ("empty masks", "two arms")] == ["ok", "ok"]
    assert outcomes["kinematics"].message.startswith("frames without: ")


@pytest.mark.slow
def test_a_crash_or_a_hang_fails_its_own_check_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conducting, "Child", PatientChild)
    names = ["plain sequence", "full masks", "empty masks", "readings"]
    outcomes = conduct(stranger("BreaksDown"), 2.0, names=names)
    assert [outcome.status for outcome in outcomes] == ["ok", "FAILED", "FAILED", "ok"]
    assert outcomes[1].message == "the tracker's process exited with code 4"
    assert outcomes[2].message == "no answer within 2 s"


@pytest.mark.slow
def test_who_fails_the_first_check_is_not_put_to_the_others() -> None:
    reported: list[Outcome] = []
    outcomes = conduct(stranger("ReturnsNan"), AMPLE_S, reported.append)
    assert [outcome.status for outcome in outcomes] == ["FAILED"] + ["not run"] * (len(CHECKS) - 1)
    assert reported == outcomes


def test_the_check_leaves_global_generators_as_they_were() -> None:
    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    run_check("no global randomness", stranger("SeedsEverybodys"))
    np.testing.assert_equal((random.getstate(), np.random.get_state()), before)  # noqa: NPY002


@pytest.mark.parametrize("arms", [1, 2])
def test_plays_show_what_they_say(arms: int) -> None:
    """The mask is the state's, and base times reading is where the tool is, so that checks ask for what is there."""
    play = make_play(arms=arms, kinematics=True)
    frame, truth = play.observations[-1], play.truth[-1]
    assert 0.02 < frame.mask.mean() < 0.5
    assert np.array_equal(frame.mask, evaluator(arms).mask(truth))
    assert play.scene.T_cam_base is not None
    assert frame.kinematics is not None
    np.testing.assert_allclose((play.scene.T_cam_base @ frame.kinematics)[:, :3, 3], truth.reshape(arms, 9)[:, 3:6])
    view = frame.views[0]
    assert all(tips is not None and view.camera.contains(tips).all() for tips in view.keypoints)


@pytest.mark.slow
def test_the_command_says_what_failed(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("check", "tracker", f"{STRANGERS}:ReturnsNan", expect=1)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "FAILED   plain sequence         frame 0: step returned a state with NaN or infinity"
    assert lines[-1] == "returns-nan: 1 check failed"
    surgbench("check", "tracker", f"{STRANGERS}:ReturnsNan", "--json", expect=1)
    first = json.loads(capsys.readouterr().out)[0]
    assert (first["check"], first["status"]) == ("plain sequence", "FAILED")


def test_the_command_takes_options_and_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("check", "tracker", f"{STRANGERS}:NotHere")
    assert capsys.readouterr().out == "not-here cannot run here: needs a left-handed compiler\n"
    for arguments, message in (
        (("cmeas",), "did you mean 'cmaes'?"),
        (("cmaes", "--set", "cmaes.iteration=1"), "did you mean 'iterations'?"),
        (("cmaes", "--set", "kalman.speed=fast"), "takes no part in this check"),
    ):
        surgbench("check", "tracker", *arguments, expect=2)
        assert message in capsys.readouterr().err
