"""Trackers as strangers write them: right ones and wrong ones."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np


class Still:
    """The least that works: three members and a plain array."""

    name = "still"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.state = state

    def step(self, observation: Any) -> Any:
        return observation.start


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


class NoStep:
    name = "no-step"

    def reset(self, scene: Any, state: Any, rng: Any) -> None: ...


class NanConfidence(Still):
    name = "nan-confidence"

    def step(self, observation: Any) -> Any:
        from surgbench.contract import Estimate

        return Estimate(observation.start, confidence=float("nan"))


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
    name = "spins"

    def step(self, observation: Any) -> Any:
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
