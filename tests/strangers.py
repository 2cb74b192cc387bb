"""Trackers as strangers write them: right ones and wrong ones."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.contract import Estimate
from surgbench.errors import SurgbenchError


class Still:
    """The least that works: three members and a plain array."""

    name = "still"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.state = state

    def step(self, observation: Any) -> Any:
        return observation.start


class OneEyed(Still):
    """Looks at the endoscope's picture alone."""

    name = "one-eyed"
    one_view = True


class Noisy(Still):
    """Random, from the generator it is given."""

    name = "noisy"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.state, self.rng = state, rng

    def step(self, observation: Any) -> Any:
        return observation.start + self.rng.normal(0, 1e-3, observation.start.shape)


class Peeking(Still):
    """Reports everything that its observations hold; the truth must not be among it."""

    name = "peeking"

    def step(self, observation: Any) -> Any:
        assert not hasattr(observation, "truth")
        assert "truth" not in repr(vars(observation))
        assert observation.mask.dtype == bool
        assert observation.mask.flags.c_contiguous
        return observation.start


class Raises(Still):
    name = "raises"

    def step(self, observation: Any) -> Any:
        if observation.index == 1:
            raise RuntimeError("no instrument\nanywhere")
        return observation.start


class Exits(Still):
    name = "exits"

    def step(self, observation: Any) -> Any:
        os._exit(3)


class Hangs(Still):
    name = "hangs"

    def step(self, observation: Any) -> Any:
        time.sleep(3600)


class ReturnsNan(Still):
    name = "returns-nan"

    def step(self, observation: Any) -> Any:
        return np.full(9, np.nan)


class ReturnsShape(Still):
    name = "returns-shape"

    def step(self, observation: Any) -> Any:
        return np.zeros(7)


class ReturnsText(Still):
    name = "returns-text"

    def step(self, observation: Any) -> Any:
        return "left"


class FailsOnce(Still):
    """Fails until a file that the environment names exists."""

    name = "fails-once"

    def step(self, observation: Any) -> Any:
        if not os.path.exists(os.environ["SURGBENCH_TEST_FLAG"]):  # noqa: PTH110
            raise RuntimeError("not yet")
        return observation.start


class Signs(Still):
    """Notes its process in a file that the environment names, and takes its time."""

    name = "signs"

    def step(self, observation: Any) -> Any:
        if observation.index == 1:
            with open(os.environ["SURGBENCH_TEST_FLAG"], "a") as file:  # noqa: PTH123
                file.write(f"{os.getpid()}\n")
        time.sleep(0.2)
        return observation.start


class NoStep:
    name = "no-step"

    def reset(self, scene: Any, state: Any, rng: Any) -> None: ...


class NanConfidence(Still):
    name = "nan-confidence"

    def step(self, observation: Any) -> Any:
        return Estimate(observation.start, confidence=float("nan"))


class CertainOfAll(Still):
    """Claims to be right to the last bit."""

    name = "certain"

    def step(self, observation: Any) -> Any:
        return Estimate(observation.start, standard_deviations=np.zeros(9))


class Unsure(Still):
    """Half a radian and 1 mm off, it says, but of every third frame nothing; lost where the mask is empty."""

    name = "unsure"

    def step(self, observation: Any) -> Any:
        deviations = None if observation.index % 3 == 2 else np.repeat([0.5, 0.001, 0.5], 3)
        return Estimate(observation.start, lost=not observation.mask.any(), standard_deviations=deviations)


class WrongName(Still):
    name = "../elsewhere"


class WrongConfig(Still):
    name = "wrong-config"
    Config = 3


class Prints(Still):
    name = "prints"

    def step(self, observation: Any) -> Any:
        print("seen", observation.index)
        return observation.start


class Spins(Still):
    """Never ends; says so by a file that the environment names."""

    name = "spins"

    def step(self, observation: Any) -> Any:
        Path(os.environ["SURGBENCH_TEST_FLAG"]).touch()
        while True:
            pass


class NotHere(Still):
    """Lacks something on every machine."""

    name = "not-here"

    @classmethod
    def unavailable(cls) -> str | None:
        return "needs a left-handed\ncompiler"


class CannotTell(Still):
    name = "cannot-tell"

    @classmethod
    def unavailable(cls) -> str | None:
        raise OSError("no such driver")


class ForgetfulOracle:
    """A filter that asks for the truth and has no way to take it."""

    name = "forgetful"
    needs_truth = True

    def reset(self, scene: Any, state: Any) -> None: ...

    def predict(self) -> Any: ...

    def update(self, estimate: Any) -> Any: ...


# --- one broken rule each, for `surgbench check tracker`


class NoisyFromEverybodys(Still):
    """Draws from NumPy's global generator."""

    name = "everybodys"

    def step(self, observation: Any) -> Any:
        return observation.start + np.random.normal(0, 1e-3)  # noqa: NPY002


class SeedsEverybodys(Noisy):
    """Seeds the global generator of Python, and draws from its own."""

    name = "seeds-everybodys"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        super().reset(scene, state, rng)
        random.seed(0)


class NoisyFromNowhere(Still):
    """A generator of its own that nobody has seeded."""

    name = "nowhere"

    def step(self, observation: Any) -> Any:
        return observation.start + np.random.default_rng().normal(0, 1e-3)


class Remembers(Still):
    """Counts frames, and goes on counting in the next sequence."""

    name = "remembers"

    def __init__(self) -> None:
        self.frames = 0

    def step(self, observation: Any) -> Any:
        self.frames += 1
        return observation.start + 1e-4 * self.frames


class Unpicklable(Still):
    name = "unpicklable"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.shift: Callable[[Any], Any] = lambda start: start

    def step(self, observation: Any) -> Any:
        return self.shift(observation.start)


class LosesItsPlace(Noisy):
    """Leaves its generator behind when it is pickled."""

    name = "loses-its-place"

    def __getstate__(self) -> Any:
        return {"state": self.state, "rng": np.random.default_rng(0)}


class WritesMask(Still):
    name = "writes-mask"

    def step(self, observation: Any) -> Any:
        observation.mask[:] = False
        return observation.start


class WritesState(Still):
    name = "writes-state"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        state += 1.0


class BeyondLimits(Still):
    name = "beyond-limits"

    def step(self, observation: Any) -> Any:
        return observation.start + np.eye(9)[8] * 2.0


class TooSure(Still):
    name = "too-sure"

    def step(self, observation: Any) -> Any:
        return Estimate(observation.start, confidence=2.0)


class DividesByTheMask(Still):
    """NaN where the mask is empty."""

    name = "divides"

    def step(self, observation: Any) -> Any:
        with np.errstate(invalid="ignore"):
            return observation.start + 0.0 * np.float64(1.0) / np.float64(observation.mask.sum())


class NeedsTips(Still):
    name = "needs-tips"

    def step(self, observation: Any) -> Any:
        return observation.start + 0.0 * observation.views[0].keypoints[0].sum()


class NeedsReadings(Still):
    """Readings once are readings for ever, it thinks."""

    name = "needs-readings"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.had = False

    def step(self, observation: Any) -> Any:
        self.had = self.had or observation.joints is not None
        return observation.start + 0.0 * observation.joints.sum() if self.had else observation.start


class LostBehindTheCamera(Still):
    name = "lost-behind"

    def step(self, observation: Any) -> Any:
        return observation.start * (np.nan if observation.start[5] < 0 else 1.0)


class Dawdles(Still):
    name = "dawdles"

    def step(self, observation: Any) -> Any:
        time.sleep(0.02)
        return observation.start


class OneArm(Still):
    """Says what it does not do, as it should."""

    name = "one-arm"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        if scene.arms != 1:
            raise SurgbenchError("one-arm follows one arm only")


class OneArmInSilence(Still):
    name = "one-arm-in-silence"

    def step(self, observation: Any) -> Any:
        return observation.start[:9]


class NeedsKinematics(Still):
    """Runs with the robot's own readings only, and says so."""

    name = "needs-kinematics"

    def step(self, observation: Any) -> Any:
        if observation.kinematics is None:
            raise SurgbenchError("needs-kinematics needs a dataset with kinematics")
        assert observation.kinematics.shape == (len(observation.start) // 9, 4, 4)
        return observation.start


class ShowsOthers(Noisy):
    """Draws once more when somebody looks."""

    name = "shows-others"
    trace: Any = None

    def step(self, observation: Any) -> Any:
        if self.trace is not None:
            self.rng.normal()
        return super().step(observation)


class BreaksDown(Still):
    """Takes the process down on a full mask, and sleeps on an empty one."""

    name = "breaks-down"

    def step(self, observation: Any) -> Any:
        if observation.mask.all():
            os._exit(4)
        if not observation.mask.any():
            time.sleep(3600)
        return observation.start


class Watching:
    """A controller of the viewpoint task, as small as can be."""

    name = "watching"
    task = "viewpoint"

    def reset(self, scene: Any, joints: Any, rng: Any) -> None:
        self.joints = joints

    def step(self, observation: Any) -> Any:
        return self.joints


class Fainting(Watching):
    """Raises in the middle of a trial."""

    name = "fainting"

    def step(self, observation: Any) -> Any:
        if observation.index == 30:
            raise ValueError("it is all too much")
        return self.joints


class Scribbling(Watching):
    """Answers with what is no command."""

    name = "scribbling"

    def step(self, observation: Any) -> Any:
        return np.full(6, np.nan) if observation.index == 20 else self.joints


class Mute(Watching):
    """Answers with what is no command from the first step on."""

    name = "mute"

    def step(self, observation: Any) -> Any:
        return np.full(6, np.nan)


class Stumbling(Watching):
    """Raises at once."""

    name = "stumbling"

    def step(self, observation: Any) -> Any:
        raise RuntimeError("no")


class Dozing(Watching):
    """Hangs."""

    name = "dozing"

    def step(self, observation: Any) -> Any:
        time.sleep(3600)
