"""Tips are looked for when somebody looks at them, and once; whoever looks at none waits for none."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene, View
from surgbench.errors import InvalidAnswerError, PluginError
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import FoundTips, Tips
from surgbench.objective import LossWeights, Objective
from surgbench.suite.settings import Plug
from surgbench.tasks.instrument.conformance.scenes import make_play
from surgbench.tasks.instrument.tips import check_tips
from surgbench.tasks.instrument.units import _seen
from surgbench.tasks.instrument.worker import Loop, Setup

BOTH = np.array([[80.0, 60.0], [84.0, 61.0]])
ONE = BOTH[:1]


class Counting:
    """A source that counts how often it is asked."""

    name = "counting"
    every_frame: ClassVar[bool] = False

    def __init__(self, answer: Any = (BOTH,)) -> None:
        self.asked, self.answer = 0, answer

    def reset(self, scene: Scene) -> None:
        pass

    def detect(self, observation: Observation, view: View) -> Any:
        self.asked += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class InTurn(Counting):
    name = "in-turn"
    every_frame = True


class Blind:
    """A tracker that looks at no tips."""

    name = "blind"

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        pass

    def step(self, observation: Observation) -> FloatArray:
        return observation.start


class Looking(Blind):
    name = "looking"

    def step(self, observation: Observation) -> FloatArray:
        assert observation.views[0].keypoints is observation.views[0].keypoints
        return observation.start


class Deaf(Blind):
    """Goes on whatever happens to the tips."""

    name = "deaf"

    def step(self, observation: Observation) -> FloatArray:
        with suppress(Exception):
            _ = observation.views[0].tips
        return observation.start


class Filter:
    name = "none"

    def reset(self, scene: Scene, state: FloatArray) -> None:
        self.state = state

    def predict(self) -> FloatArray:
        return self.state

    def update(self, estimate: FloatArray) -> FloatArray:
        return estimate


def lazy_view(tips: Tips | Callable[[], Tips]) -> View:
    camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
    return View(camera, np.eye(4), np.zeros((120, 160), dtype=bool), found=FoundTips(tips))


def loop_of(monkeypatch: pytest.MonkeyPatch, tracker: Any, source: Any) -> Loop:
    """The engine's loop around ready-made plug-ins, begun."""
    made = {"tracker": tracker, "keypoints": source, "filter": Filter()}
    monkeypatch.setattr(Loop, "_make", staticmethod(lambda plug: made[plug.kind]))
    plugs = {kind: Plug(kind, "", one.name, "", {}, {}, False) for kind, one in made.items()}
    play, axes = make_play(frames=2), {"test": 0}
    loop = Loop(
        Setup(plugs["tracker"], plugs["filter"], plugs["filter"], plugs["keypoints"], play.scene, {**axes}, {**axes})
    )
    loop.begin(play.observations[0], play.truth[0])
    return loop


def frames() -> tuple[Observation, ...]:
    return make_play(frames=2).observations


def test_tips_are_made_when_they_are_first_looked_at_and_once() -> None:
    asked = []
    view = lazy_view(lambda: asked.append(1) or (BOTH,))  # type: ignore[func-returns-value]
    other = replace(view, mask=~view.mask)
    assert not asked
    assert view.keypoints[0] is BOTH
    assert other.tips[0] is BOTH
    assert asked == [1]


def test_a_pickled_view_has_its_tips() -> None:
    view = pickle.loads(pickle.dumps(lazy_view(lambda: (BOTH, ONE, None))))
    np.testing.assert_array_equal(view.tips[0], BOTH)
    np.testing.assert_array_equal(view.tips[1], ONE)
    assert view.keypoints[1:] == (None, None)


def test_a_view_is_made_with_tips_or_without() -> None:
    view = lazy_view((BOTH,))
    assert replace(view, keypoints=(ONE,)).tips == (ONE,)
    assert View(view.camera, view.T_view_cam, view.mask).tips == (None,)
    assert view == replace(view)


def test_the_loss_looks_only_for_terms_that_need_tips() -> None:
    play = make_play(frames=2)
    source = Counting()
    views = (replace(play.observations[0].views[0], found=FoundTips(lambda: source.detect(frame, frame.views[0]))),)
    frame = replace(play.observations[0], views=views)
    without, with_tips = (Objective(play.scene, LossWeights(keypoints=weight)) for weight in (0.0, 5e-4))
    without.observe(frame)
    without(play.truth)
    without.gradient(play.truth)
    with_tips.observe(frame)
    with_tips.mismatch(play.truth)
    assert source.asked == 0
    with_tips(play.truth)
    assert source.asked == 1


def test_who_does_not_look_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Counting()
    loop = loop_of(monkeypatch, Blind(), source)
    before = source.asked
    answer = loop.step(frames()[0])
    assert (source.asked, answer.latency_keypoints_ms) == (before, 0.0)


def test_who_looks_waits_and_the_time_is_the_source_s(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Counting()
    loop = loop_of(monkeypatch, Looking(), source)
    before = source.asked
    answer = loop.step(frames()[0])
    assert source.asked == before + 1
    whole, tips, optimise = answer.latency_ms, answer.latency_keypoints_ms, answer.latency_optimise_ms
    assert whole is not None
    assert tips is not None
    assert optimise is not None
    assert 0 < tips < whole
    assert optimise + tips < whole


def test_a_source_that_follows_tips_is_asked_in_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    source = InTurn()
    loop = loop_of(monkeypatch, Blind(), source)
    before = source.asked
    answers = [loop.step(frame) for frame in frames()]
    assert source.asked == before + 2
    assert all(answer.latency_keypoints_ms and answer.latency_keypoints_ms > 0 for answer in answers)


@pytest.mark.parametrize("tracker", [Looking(), Deaf()])
def test_a_source_that_raises_is_blamed_by_name(monkeypatch: pytest.MonkeyPatch, tracker: Any) -> None:
    source = Counting()
    loop = loop_of(monkeypatch, tracker, source)
    source.answer = ValueError("no\nidea")
    with pytest.raises(PluginError, match=r"^keypoints 'counting' raised ValueError: no idea$"):
        loop.step(frames()[0])


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (3, "returned int, not the tips of every arm"),
        ((BOTH, BOTH), "returned tips of 2 arms, not of 1"),
        ((np.zeros((3, 2)),), r"returned tips of shape \(3, 2\), not \(2, 2\), \(1, 2\) or None"),
        ((np.zeros(2),), r"returned tips of shape \(2,\)"),
        (("tip",), "returned str, not the pixels of tips"),
        ((BOTH * np.nan,), "returned tips with NaN or infinity"),
    ],
)
def test_a_wrong_answer_is_told_in_one_line(answer: Any, words: str) -> None:
    with pytest.raises(InvalidAnswerError, match=f"^keypoints 'mine' {words}"):
        check_tips(answer, 1, "keypoints 'mine'")


def test_no_tips_are_none() -> None:
    assert check_tips([np.zeros((0, 2)), None], 2, "") == (None, None)


def test_of_a_dataset_s_tips_one_may_be_known() -> None:
    tips = np.stack([BOTH, np.array([[np.nan, np.nan], [84.0, 61.0]]), np.full((2, 2), np.nan)])
    np.testing.assert_array_equal(_seen([tips], 0)[0], BOTH)
    np.testing.assert_array_equal(_seen([tips], 1)[0], BOTH[1:])
    assert _seen([tips], 2) == (None,)
