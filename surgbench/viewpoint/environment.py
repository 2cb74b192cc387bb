"""The viewpoint task as a Gymnasium environment, for learning: one arm, or many at once in one process.

Importing this module registers :data:`ID`, so that

    gymnasium.make("surgbench.viewpoint.environment:surgbench/Viewpoint-v0", dataset="data/chaser")

works, and ``make_vec`` with ``num_envs``. It needs the extra ``gym``. An episode is a trial of a dataset; what is
observed, what is done and what is rewarded is told in :class:`ViewpointEnv`, all of it on reported poses, as any
controller is told them. The camera's course is that of ``surgbench run`` for the same set points.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from surgbench.dataset.open import open_dataset
from surgbench.errors import ConfigError, DatasetError, unknown_name
from surgbench.extras import not_installed
from surgbench.geometry import FloatArray
from surgbench.viewpoint.registration import Method
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.worlds import DEPTHS, ERRORS, Worlds

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(not_installed(["gymnasium"]), name=error.name) from None

ID = "surgbench/Viewpoint-v0"
# A millimetre or a degree beyond a rule costs as much as a degree off the view.
BROKEN_COST = 1.0
# Where an observation is cut off, metres.
FARTHEST_M = 10.0
# The parts of an observation and how many numbers each has.
OBSERVED = {
    "joints": 6,
    "setpoint": 6,
    "setpoint_velocity": 6,
    "feature_camera_m": 3,
    "normal_camera": 3,
    "up_camera": 3,
    "feature_base_m": 3,
    "normal_base": 3,
    **dict.fromkeys(DEPTHS, 1),
    "measured": 1,
}
# What `info` tells of a step.
TOLD = (*ERRORS, *DEPTHS)
_REWARDS = np.array([-1.0, -BROKEN_COST])
_MARGIN = 1e-3


def observation_slices() -> dict[str, slice]:
    """Where each part of an observation is."""
    ends = np.cumsum(list(OBSERVED.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(OBSERVED.items(), ends, strict=True)}


class _Episodes:
    """Trials as episodes of N worlds: what a single environment and a vector of them have in common.

    Args:
        dataset: A dataset's folder, or
        trials: these.
        registration: How touched points correct the arm's base.
        steps: Only the first so many of each trial.
        count: N.
    """

    def __init__(
        self,
        dataset: Path | str | None,
        trials: Sequence[Trial] | None,
        registration: Method,
        steps: int | None,
        count: int,
    ) -> None:
        if (dataset is None) == (trials is None):
            raise DatasetError("an environment takes either a dataset's folder or trials")
        if registration not in get_args(Method):
            raise ConfigError(unknown_name("registration", str(registration), get_args(Method)))
        if steps is not None and steps < 1:
            raise ConfigError(f"steps is {steps}; an episode has one at least")
        if trials is None:
            assert dataset is not None
            data = open_dataset(dataset)
            read = getattr(data, "trial", None)
            if read is None:
                raise DatasetError(f"{dataset}: a dataset of the {data.task} task; expected trials of a camera")
            trials = [read(unit.sequence) for unit in data.units()]
        self.names = [trial.id for trial in trials]
        self.worlds = Worlds(trials, count, registration=registration, steps=steps)
        limits = self.worlds.tables.limits
        lower, upper, fastest = limits[:, 0].min(axis=0), limits[:, 1].max(axis=0), limits[:, 2].max(axis=0)
        far, unit = np.full(3, FARTHEST_M), np.ones(3)
        beyond = np.array([1e3 * FARTHEST_M, 1e3 * FARTHEST_M, 90.0, 1e3 * FARTHEST_M])
        high = np.concatenate([upper, upper, fastest, far, unit, unit, far, unit, beyond, [1.0]])
        low = np.concatenate([lower, lower, -fastest, -far, -unit, -unit, -far, -unit, -beyond, [0.0]])
        self._low, self._high = low, high
        self.observation_space = gymnasium.spaces.Box(
            (low - _MARGIN).astype(np.float32), (high + _MARGIN).astype(np.float32), dtype=np.float32
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def check(self, options: dict[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
        """The options of a reset, all of which are known."""
        for name in options or {}:
            if name not in known:
                raise ConfigError(unknown_name("option of reset", str(name), known))
        return options or {}

    def actions(self, given: Any) -> FloatArray:
        """``(N, 6)`` actions as they are given, in a world of its own as ``(6,)``."""
        count = len(self.worlds.index)
        actions = np.asarray(given, dtype=np.float64)
        if actions.shape not in ([(count, 6), (6,)] if count == 1 else [(count, 6)]):
            expected = "(6,)" if count == 1 else f"({count}, 6)"
            raise ConfigError(f"an action is of shape {expected}, one velocity for each joint; not {actions.shape}")
        return actions.reshape(count, 6)

    def begin(self, begun: NDArray[np.bool_], generators: Sequence[np.random.Generator], name: str | None) -> None:
        """Begin episodes: on the trial of that name, or on one that each world's generator draws."""
        if name is not None and name not in self.names:
            raise DatasetError(unknown_name("trial", name, self.names))
        chosen = np.zeros(len(begun), dtype=np.int64)
        for n in np.flatnonzero(begun).tolist():
            chosen[n] = generators[n].integers(len(self.names)) if name is None else self.names.index(name)
        self.worlds.begin(begun, chosen)

    def observe(self) -> NDArray[np.float32]:
        """``(N, 38)`` observations."""
        return self.worlds.observe(self._low, self._high)

    def rewards(self) -> FloatArray:
        """``(N,)`` of the last step: what the view costs, and broken rules."""
        return np.asarray(self.worlds.costs @ _REWARDS)


class ViewpointEnv(gymnasium.Env):
    """One camera arm that is to keep a moving feature in view.

    An episode is a trial: truncated at its end, never terminated. ``reset(seed=...)`` draws which one, and
    ``reset(options={"trial": ID})`` says so.

    *Action*, ``(6,)`` in [-1, 1]: wanted velocities of the joints (yaw, pitch, insertion, roll, wrist pitch, wrist
    yaw) until the next step, as shares of the largest ones. Each is clipped to what its joint can reach in a step, and
    from where it can still be stopped before its limit. NaN counts as 0. Where the feature is not measured the arm
    comes to rest, whatever the action.

    *Observation*, ``(38,)`` float32, in the order of :data:`OBSERVED` (:func:`observation_slices`), rad and m: joints
    as measured, set points and their velocities ``(6,)`` each; the feature's place, its normal and the world's up
    ``(3,)`` each in the camera's frame; place and normal ``(3,)`` each in the frame of the arm's base; how far the
    camera is in the no-go zone, below the floor (mm), on the wrong side (degrees) and nearer to the feature than
    allowed (mm), by set point or joints, the worse of the two, and negative where nothing is broken; and 1 where the
    feature is measured, 0 where place and normal are the last ones that were.

    *Reward*: minus ``view_cost`` (:data:`surgbench.viewpoint.scores.COST_TOLERANCES`), what was wanted at this step
    against the camera after it, and minus 1 for each millimetre or degree that the camera is beyond a rule after it.
    Where the feature was not measured, the latter alone.

    *Info*: ``trial``; after a step ``vva_deg``, ``fd_mm``, ``pf_deg``, ``an_deg``, ``pn_full_mm`` where the feature was
    measured, and the depths.

    Args:
        dataset: A dataset's folder, or
        trials: trials.
        registration: How touched points correct the arm's base, as ``surgbench run --registration``.
        steps: Only the first so many of each trial.
        render_mode: None.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        dataset: Path | str | None = None,
        trials: Sequence[Trial] | None = None,
        registration: Method = "translation",
        steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.episodes = _Episodes(dataset, trials, registration, steps, 1)
        self.observation_space, self.action_space = self.episodes.observation_space, self.episodes.action_space
        self.render_mode = render_mode
        self._begun = np.ones(1, dtype=bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a trial."""
        super().reset(seed=seed)
        told = self.episodes.check(options, ("trial",))
        self.episodes.begin(self._begun, [self.np_random], told.get("trial"))
        return self.episodes.observe()[0], {"trial": self._trial}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of the control loop.

        Raises:
            gymnasium.error.ResetNeeded: The trial is at its end, or has not begun.
        """
        worlds = self.episodes.worlds
        if worlds.ended[0]:
            raise gymnasium.error.ResetNeeded("the trial is at its end, or has not begun: call reset()")
        worlds.step(self.episodes.actions(action))
        info: dict[str, Any] = dict(zip(TOLD, worlds.views[0].tolist(), strict=True))
        if not worlds.counted[0]:
            info = {name: info[name] for name in DEPTHS}
        info["trial"] = self._trial
        return self.episodes.observe()[0], float(self.episodes.rewards()[0]), False, bool(worlds.ended[0]), info

    @property
    def _trial(self) -> str:
        return str(self.episodes.names[self.episodes.worlds.trial[0]])


class ViewpointVectorEnv(VectorEnv):
    """Many of them (:class:`ViewpointEnv`), each on a trial of its own, stepped together in compiled code.

    ``reset(seed=s)`` seeds world n with s + n: it behaves as a single one with that seed. A world at its trial's end
    begins the next one in the step after (``AutoresetMode.NEXT_STEP``); its action and reward do not count then.

    Args:
        num_envs: How many.
        dataset: As for one.
        trials: As for one.
        registration: As for one.
        steps: As for one.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        dataset: Path | str | None = None,
        trials: Sequence[Trial] | None = None,
        registration: Method = "translation",
        steps: int | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.episodes = _Episodes(dataset, trials, registration, steps, num_envs)
        self.single_observation_space = self.episodes.observation_space
        self.single_action_space = self.episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [seeding.np_random(None)[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a trial in every world, or in those of ``options["reset_mask"]``."""
        told = self.episodes.check(options, ("trial", "reset_mask"))
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + n for n in range(self.num_envs)]
        seeds = list(seed or [])
        for n, one in enumerate(seeds):
            if one is not None:
                self._generators[n] = seeding.np_random(one)[0]
        begun = np.asarray(told.get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        self.episodes.begin(begun, self._generators, told.get("trial"))
        return self.episodes.observe(), {}

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of every world's control loop."""
        worlds = self.episodes.worlds
        again = worlds.ended
        worlds.step(self.episodes.actions(actions))
        rewards, counted = self.episodes.rewards(), worlds.counted
        info: dict[str, Any] = dict(zip(TOLD, worlds.views.T.copy(), strict=True))
        info |= {f"_{name}": ~again if name in DEPTHS else counted for name in TOLD}
        if again.any():
            self.episodes.begin(again, self._generators, None)
        return self.episodes.observe(), rewards, np.zeros(self.num_envs, dtype=bool), worlds.ended, info

    def close(self, **_: Any) -> None:
        """Nothing is held open."""


def register() -> None:
    """Make the environment known to Gymnasium, once."""
    if ID not in gymnasium.registry:
        here = __name__
        gymnasium.register(ID, entry_point=f"{here}:ViewpointEnv", vector_entry_point=f"{here}:ViewpointVectorEnv")


register()
