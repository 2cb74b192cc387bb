"""Find the first state by Bayesian optimisation: TuRBO over pose and joints, as Hu et al. 2026 do.

Seven coordinates are searched (four with readings): distance, tilt, both rolls, and the joints. Where the wrist is in
the image is no coordinate: each hypothesis is placed over the mask, and its pose refined a little, joints fixed, before
its loss counts. Of a state and its 180-degree twin, where the instrument has one, only that with a negative wrist
pitch is searched.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.contract import Observation, Plugin, Scene
from surgbench.errors import ConfigError
from surgbench.extras import missing
from surgbench.geometry import FloatArray
from surgbench.metrics import rotation_error
from surgbench.search.hypotheses import DISTANCE_M, ELEVATION_DEG, hypothesis_states
from surgbench.state import ANGLES, POSITION, STATE_SCALE, STATE_SIZE, StateSpace
from surgbench.trackers.initialisers.arms import initialise_each_arm
from surgbench.trackers.initialisers.refinement import WIDE, Count, RefinementConfig, Scorer, finish
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import tutorial_settings

MODULES = ("torch", "gpytorch", "botorch")
POSE = slice(0, 6)
# Coordinates of the search: distance, elevation, roll about the shaft, roll about the optical axis, then the joints.
PERIODIC = np.array([False, False, True, True, False, False, False])
TIP_STEPS = 3  # of the fixed point that places the tips
APART_RAD = 0.3  # between the orientations of hypotheses that are refined


class TurboInitialiser(Plugin):
    """Searches pose hypotheses and joints by TuRBO; each is scored after a short refinement of its pose."""

    name: ClassVar[str] = "turbo"
    summary: ClassVar[str] = "TuRBO over pose and joints, the best refined, as Hu et al. 2026 (extra 'turbo')"
    needs_truth: ClassVar[bool] = False

    class Config(RefinementConfig):
        """Options."""

        evaluations: Annotated[Count, Field(description="hypotheses that TuRBO asks for, in whole batches")] = 600
        batch: Annotated[Count, Field(description="hypotheses at a time, and before the first Gaussian process")] = 50
        places: Annotated[Count, Field(description="pixels of the mask that the wrist is tried at")] = 32
        local_generations: Annotated[Count, Field(description="of the refinement of each hypothesis' pose")] = 6
        local_population: Annotated[int, Field(ge=4, description="its samples a generation")] = 16
        distance_m: Annotated[tuple[float, float], Field(description="of the wrist along the optical axis")] = (
            DISTANCE_M
        )
        elevation_deg: Annotated[
            tuple[float, float], Field(description="tilt of the shaft against the optical axis")
        ] = ELEVATION_DEG

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    @classmethod
    def unavailable(cls) -> str | None:
        """What is missing of the extra ``turbo``, one line; ``None`` where nothing is."""
        return missing(MODULES)

    def initialise(
        self,
        scene: Scene,
        observation: Observation,
        rng: np.random.Generator,
        truth: FloatArray | None,
        progress: Callable[[float], None],
    ) -> FloatArray:
        """Search every arm in its own part of the mask.

        Raises:
            ConfigError: The extra ``turbo`` is not installed.
            SurgbenchError: The first mask is empty, or two arms cannot be told apart in it.
        """
        missing = self.unavailable()
        if missing is not None:
            raise ConfigError(f"initialiser '{self.name}' cannot run: {missing}")

        def search(alone: Scene, frame: Observation, advance: Callable[[float], None]) -> FloatArray:
            return self._initialise_arm(alone, frame, rng, advance)

        states: FloatArray = initialise_each_arm(scene, observation, progress, search)
        return states

    def _initialise_arm(
        self, scene: Scene, observation: Observation, rng: np.random.Generator, progress: Callable[[float], None]
    ) -> FloatArray:
        from surgbench.trackers.optimisers.turbo import Turbo

        config = self.config
        batches = -(-config.evaluations // config.batch)
        tips = observation.views[0].keypoints[0] is not None
        each = config.places + tips + config.local_generations * config.local_population
        score = Scorer(scene, observation, config.loss, batches * config.batch * each + config.work, progress)
        settle = _Settler(scene, observation, config, score, rng)
        search = Turbo(PERIODIC[: settle.dimensions], config.batch, rng)
        states, losses = [], []
        for _ in range(batches):
            asked = search.ask()
            settled, values = settle(asked)
            search.tell(asked, np.log(np.maximum(values, 1.0)))
            states.append(settled)
            losses.append(values)
        chosen = _apart(np.concatenate(states), np.concatenate(losses), config.refined)
        found: FloatArray = finish(scene, observation, chosen, config, score, rng)
        return found


class _Settler:
    """Turns points of the search into states: the wrist is placed over the mask, then the pose refined a little.

    The samples of the refinement are the same for all points, so that the loss is a function of the point.
    """

    def __init__(
        self,
        scene: Scene,
        observation: Observation,
        config: TurboInitialiser.Config,
        score: Scorer,
        rng: np.random.Generator,
    ) -> None:
        self._scene, self._observation, self._config, self._score = scene, observation, config, score
        self._camera = observation.views[0].camera
        self._space = StateSpace(scene.limits[0], STATE_SCALE)
        limits = scene.limits[0]
        lower, upper = limits.lower_rad.copy(), limits.upper_rad.copy()
        # Of a state and its 180-degree twin one has a negative wrist pitch.
        if scene.instruments[0].symmetry == "twin" and np.allclose(lower[:2], -upper[:2]):
            upper[0] = 0.0
        low = [config.distance_m[0], np.deg2rad(config.elevation_deg[0]), 0.0, 0.0]
        high = [config.distance_m[1], np.deg2rad(config.elevation_deg[1]), 2 * np.pi, 2 * np.pi]
        if observation.joints is None:
            low, high = [*low, *lower], [*high, *upper]
        self._low, self._high = np.array(low), np.array(high)
        rows, columns = np.nonzero(observation.mask)
        pick = rng.integers(len(rows), size=config.places)
        self._places = columns[pick], rows[pick]
        self._normals = rng.standard_normal((config.local_generations, config.local_population, 6))

    @property
    def dimensions(self) -> int:
        """7, or 4 where the joints are read."""
        return len(self._low)

    def __call__(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States ``(n, 9)`` and losses ``(n,)`` of ``(n, dimensions)`` points of the unit cube."""
        return self._refine(self._place(points))

    def _place(self, points: FloatArray) -> FloatArray:
        distance, elevation, roll_local, roll_camera, *joints = (self._low + points * (self._high - self._low)).T
        read = self._observation.joints
        q = np.stack(joints, axis=1) if read is None else np.tile(read, (len(points), 1))
        n, places = len(points), len(self._places[0])
        columns, rows = (np.tile(pixels, n) for pixels in self._places)
        roll_camera, elevation, roll_local, distance, q = (
            np.repeat(values, places, axis=0) for values in (roll_camera, elevation, roll_local, distance, q)
        )
        states = hypothesis_states(self._camera, roll_camera, elevation, roll_local, distance, (columns, rows), q)
        tried = states.reshape(n, places, STATE_SIZE)
        tips = self._observation.views[0].keypoints[0]
        if tips is not None:
            by_tips = self._over_tips(tried[:, 0].copy(), tips)
            tried = np.concatenate([tried, by_tips[:, None]], axis=1)
        losses = self._score(tried.reshape(-1, STATE_SIZE)).reshape(n, -1)
        placed: FloatArray = tried[np.arange(n), np.argmin(losses, axis=1)]
        return placed

    def _over_tips(self, states: FloatArray, tips_px: FloatArray) -> FloatArray:
        """The states moved sideways until the middle of their tips is seen where it was observed."""
        focal = np.array([self._camera.fx, self._camera.fy])
        for _ in range(TIP_STEPS):
            tips = self._scene.instruments[0].tips_cam(states)
            off = tips_px.mean(axis=0) - self._camera.project(tips).mean(axis=-2)
            step = off / focal * tips[..., 2].mean(axis=-1, keepdims=True)
            states[:, POSITION.start : POSITION.start + 2] += np.nan_to_num(step)  # NaN: a tip behind the camera
        return states

    def _refine(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A few generations of CMA-ES on each pose, joints as they are."""
        starts = self._space.encode(states)
        population = self._config.local_population
        settings = tutorial_settings(POSE.stop, population)
        searches = [CMA(start[POSE], WIDE, population, settings=settings) for start in starts]
        best, least = states.copy(), np.full(len(states), np.inf)
        for normals in self._normals:
            asked = np.stack([search.ask(normals) for search in searches])
            vectors = np.repeat(starts[:, None], asked.shape[1], axis=1)
            vectors[..., POSE] = asked
            tried = self._space.decode(vectors)
            losses = self._score(tried.reshape(-1, STATE_SIZE)).reshape(len(states), -1)
            for search, samples, values in zip(searches, asked, losses, strict=True):
                search.tell(samples, values)
            first = np.argmin(losses, axis=1)
            found = losses[np.arange(len(states)), first]
            better = found < least
            best[better], least[better] = tried[np.arange(len(states)), first][better], found[better]
        return best, least


def _apart(states: FloatArray, losses: FloatArray, keep: int) -> FloatArray:
    """The best ``keep`` states whose orientations differ, for TuRBO ends with many of one basin, maybe the wrong one.

    Args:
        states: ``(n, 9)``.
        losses: ``(n,)``.
        keep: At most so many.
    """
    order = np.argsort(losses, kind="stable")
    chosen = [int(order[0])]
    for index in order[1:]:
        if len(chosen) == keep:
            break
        if rotation_error(states[chosen][:, ANGLES], states[index, ANGLES]).min() > APART_RAD:
            chosen.append(int(index))
    return states[chosen]
