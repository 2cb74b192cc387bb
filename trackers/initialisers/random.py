"""Find the first state without a hint: random pose hypotheses, ranked, the best of them refined.

The hypothesis space is that of Liang et al. (arXiv:2503.05953; figures as in their released code): the shaft is
tilted by 30 to 60 degrees against the optical axis, at any roll, 0.10 to 0.17 m away. They reach the
position in the image by gradient; here the wrist is placed over a random pixel of the mask instead. The
shaft dominates the silhouette, so that the first ranking finds it and little else; then the roll about it and
the joints are drawn anew around the best shafts, and thin parts of the mask are weighted up throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, ClassVar

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Plugin, Scene
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation
from surgbench.objective import LossWeights
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, STATE_SCALE, JointLimits, StateSpace
from surgbench.trackers.initialisers.thickness import ThicknessObjective
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import published_settings

Count = Annotated[int, Field(ge=1)]
Range = tuple[float, float]

BATCH = 256
WIDE = 5.0  # first step of refinements that begin at a coarse hypothesis
SHAFT_SLIP_M = 2e-3  # how well a shaft tells where along it the wrist is


class RandomInitialiser(Plugin):
    """Ranks random pose hypotheses by the tracking loss and refines the best by CMA-ES."""

    name: ClassVar[str] = "random"
    summary: ClassVar[str] = "pose hypotheses of Liang et al., ranked, the best refined: needs no hint"
    needs_truth: ClassVar[bool] = False

    class Config(BaseModel):
        """Options."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        hypotheses: Annotated[Count, Field(description="random states that are ranked")] = 8192
        refined: Annotated[Count, Field(description="best hypotheses that are refined")] = 16
        shafts: Annotated[Count, Field(description="best of those, whose roll and joints are drawn anew")] = 2
        finalists: Annotated[Count, Field(description="best states that are refined to the end")] = 4
        generations: Annotated[tuple[int, int], Field(description="of a refinement, and of the last one")] = (20, 100)
        population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
        distance_m: Annotated[Range, Field(description="of the wrist along the optical axis")] = (0.10, 0.17)
        elevation_deg: Annotated[Range, Field(description="tilt of the shaft against the optical axis")] = (30.0, 60.0)
        loss: LossWeights = LossWeights()

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

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
            SurgbenchError: The first mask is empty, or two arms cannot be told apart in it.
        """
        masks = _mask_per_arm(observation, scene.arms)
        states = []
        for arm, mask in enumerate(masks):
            view = replace(observation.views[0], mask=mask, keypoints=(observation.views[0].keypoints[arm],))
            joints = None if observation.joints is None else observation.joints.reshape(scene.arms, 3)[arm]
            alone = replace(
                scene, instruments=(scene.instruments[arm],), limits=(scene.limits[arm],), views=(view,), arms=1
            )
            one = replace(observation, views=(view,), joints=joints)

            def advance(fraction: float, before: int = arm) -> None:
                progress((before + fraction) / scene.arms)

            states.append(self._initialise_arm(alone, one, rng, advance))
        found: FloatArray = np.concatenate(states)
        return found

    def _initialise_arm(
        self, scene: Scene, observation: Observation, rng: np.random.Generator, progress: Callable[[float], None]
    ) -> FloatArray:
        config = self.config
        limits = scene.limits[0]
        drawn = scene.instruments[0].generate_limits
        objective = ThicknessObjective(scene, config.loss)
        objective.observe(observation)
        short, long = config.generations
        refinements = 2 * config.refined * short + config.finalists * long
        work = 2 * config.hypotheses + config.population * refinements
        done = 0

        def evaluate(states: FloatArray) -> FloatArray:
            nonlocal done
            losses: FloatArray = objective(states)[0]
            done += len(states)
            progress(min(done / work, 1.0))
            return losses

        # With readings the joints are searched within a few hundredths of a radian of them.
        joint_step = 1.0 if observation.joints is None else 0.1
        space = StateSpace(limits, STATE_SCALE * np.where(np.arange(len(STATE_SCALE)) < 6, 1.0, joint_step))

        def refine(candidates: FloatArray, sigma: float, generations: int, keep: int) -> FloatArray:
            ended = [self._refine(space, state, sigma, generations, evaluate, rng) for state in candidates]
            order = np.argsort([loss for _, loss in ended], kind="stable")[:keep]
            return np.stack([ended[i][0] for i in order])

        coarse = _best(self._draw(observation, drawn, rng), evaluate, config.refined)
        shafts = refine(coarse, WIDE, short, config.shafts)
        anew = _best(self._draw_anew(shafts, observation, drawn, rng), evaluate, config.refined)
        candidates = np.concatenate([shafts, anew])
        finalists = refine(candidates, WIDE, short, config.finalists)
        best: FloatArray = refine(finalists, 1.0, long, 1)[0]
        return best

    def _draw_anew(
        self, shafts: FloatArray, observation: Observation, limits: JointLimits, rng: np.random.Generator
    ) -> FloatArray:
        """``(hypotheses, 9)`` states on the given shafts, with another roll and other joints."""
        states = np.resize(shafts, (self.config.hypotheses, shafts.shape[1]))
        states[:, BETA] = rng.uniform(0.0, 2 * np.pi, len(states))
        along_shaft = look_at_rotation(states[:, ANGLES])[:, :, 2]
        states[:, POSITION] += rng.normal(0.0, SHAFT_SLIP_M, (len(states), 1)) * along_shaft
        states[:, JOINTS] = _draw_joints(observation, limits, len(states), rng)
        return states

    def _draw(self, observation: Observation, limits: JointLimits, rng: np.random.Generator) -> FloatArray:
        """``(hypotheses, 9)`` random states whose wrist projects onto the mask."""
        n = self.config.hypotheses
        camera: Camera = observation.views[0].camera
        roll_camera, roll_local = rng.uniform(0.0, 2 * np.pi, (2, n))
        elevation = np.deg2rad(rng.uniform(*self.config.elevation_deg, n))
        depth = rng.uniform(*self.config.distance_m, n)
        rows, columns = np.nonzero(observation.mask)
        pick = rng.integers(len(rows), size=n)
        states = np.empty((n, 9))
        states[:, :3] = look_at_angles(_rot_z(roll_camera) @ _rot_y(elevation) @ _rot_z(roll_local))
        states[:, 3] = (columns[pick] - camera.cx) / camera.fx * depth
        states[:, 4] = (rows[pick] - camera.cy) / camera.fy * depth
        states[:, 5] = depth
        states[:, JOINTS] = _draw_joints(observation, limits, n, rng)
        return states

    def _refine(
        self,
        space: StateSpace,
        state: FloatArray,
        sigma: float,
        generations: int,
        evaluate: Callable[[FloatArray], FloatArray],
        rng: np.random.Generator,
    ) -> tuple[FloatArray, float]:
        """The best state that CMA-ES with the tutorial's rates meets, and its loss."""
        settings = published_settings(len(state), self.config.population)
        search = CMA(space.encode(state), sigma, self.config.population, settings=settings)
        best, best_loss = state, np.inf
        for _ in range(generations):
            samples = search.ask(rng.standard_normal((self.config.population, len(state))))
            states = space.decode(samples)
            losses = evaluate(states)
            search.tell(samples, losses)
            first = int(np.argmin(losses))
            if losses[first] < best_loss:
                best, best_loss = states[first], float(losses[first])
        return best, best_loss


def _best(states: FloatArray, evaluate: Callable[[FloatArray], FloatArray], keep: int) -> FloatArray:
    """The ``keep`` states of least loss, best first."""
    losses = np.concatenate([evaluate(states[begin : begin + BATCH]) for begin in range(0, len(states), BATCH)])
    return states[np.argsort(losses, kind="stable")[:keep]]


def _draw_joints(observation: Observation, limits: JointLimits, count: int, rng: np.random.Generator) -> FloatArray:
    """``(count, 3)``: the readings where there are any, else anything an instrument in use does."""
    if observation.joints is not None:
        return np.tile(observation.joints, (count, 1))
    return rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))


def _mask_per_arm(observation: Observation, arms: int) -> list[Mask]:
    """One mask per arm: the mask, the instance masks, or the two largest parts of the mask from left to right."""
    view = observation.views[0]
    if not view.mask.any():
        raise SurgbenchError(f"the mask of frame {observation.index} is empty: nothing to start from")
    if arms == 1:
        return [view.mask]
    if view.instance_masks is not None:
        return list(view.instance_masks)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(view.mask.astype(np.uint8))
    if count < 3:
        raise SurgbenchError("the arms overlap in the first mask: start from a frame where they are apart")
    largest = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")[:2]
    return [np.asarray(labels == label) for label in sorted(largest, key=lambda label: centres[label][0])]


def _rot_z(angle_rad: FloatArray) -> FloatArray:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)


def _rot_y(angle_rad: FloatArray) -> FloatArray:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)
