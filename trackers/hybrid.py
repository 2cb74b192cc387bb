"""Our tracker: robust Gauss-Newton on the contour with a motion belief, and a search for what it may have missed.

Three things make it accurate. The contour's residuals and Jacobians are exact (no pixels are rendered), so that a few
Gauss-Newton steps reach the optimum to a small part of a pixel. A belief of constant velocity with all its
correlations takes part in the estimate. And where the silhouette leaves edges unexplained (a jaw that has slipped
behind the other, a fast turn about the shaft), other states are drawn around the estimate, scored by eq. 5, evolved for
a few generations of CMA-ES, refined, and followed beside it as hypotheses of their own until the masks decide.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import JOINTS, STATE_SCALE, STATE_SIZE, StateSpace, clip_joints
from surgbench.timing import step_s
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import tutorial_settings
from surgbench.trackers.registration.arrival import Whereabouts, arrivals
from surgbench.trackers.registration.belief import MotionBelief
from surgbench.trackers.registration.edges import missed_edge
from surgbench.trackers.registration.fit import ContourFit, Fit, FitConfig, Prior
from surgbench.trackers.registration.jaws import JawJudge
from surgbench.trackers.registration.proposals import (
    Move,
    best_of_each,
    jump_cost,
    propose,
    sweep_jaws,
)

# Per second (squared): how fast hands move such an instrument. Its jaws turn together more than they open: where one is
# hidden behind the other, it goes with that one.
ACCELERATION = np.array([4.0, 12.0, 4.0, 0.4, 0.4, 0.4, 8.0, 8.0, 2.5])
VELOCITY = np.array([0.3, 1.0, 0.3, 0.02, 0.02, 0.02, 0.5, 0.5, 0.3])
SETTLING_S = np.array([*[np.inf] * 8, 0.5])
# How well the first state, or a hypothesis just found, is known; and how well a drawn one is.
FOUND = np.array([0.01, 0.05, 0.03, 5e-4, 5e-4, 1e-3, 0.05, 0.05, 0.05])
DRAWN = np.array([0.1, 1.0, 0.2, 5e-3, 5e-3, 2e-2, 1.0, 1.0, 1.0])
# What may have changed while nothing was seen, once it is put where the mask is; and how fast it is then put in.
AWAY = np.array([0.15, 0.7, 0.15, 1.2e-2, 1.2e-2, 2.5e-2, 0.5, 0.5, 0.4])
ARRIVING = np.array([0.3, 1.0, 0.3, 0.3, 0.3, 0.3, 0.5, 0.5, 0.3])
YAW_AND_JAWS = slice(JOINTS.start + 1, JOINTS.stop)
# Edges are counted as worse than synthetic ones are, so that a frame doesn't outvote the motion; the spread of
# estimates about the truth is this much of the belief's (on data of the presets `paper` and `agile`).
STATED = 0.24
# What no contour tells of an instrument and a camera that are off what is declared (their size and focal length, the
# lens, the principal point) makes wrong, where what contours do tell of them is off by a natural step (on data of the
# preset `mismatch`).
MODEL_ERROR = np.array([0.0025, 0.007, 0.01, 7e-4, 6e-4, 2.2e-3, 0.006, 0.01, 0.007])
EXPLAINED_PX = 2
JAW_PX = 3
BEST_JAWS = 0.15  # what masks leave unexplained of jaws that are right, of their own contour
BEST_UNEXPLAINED = 0.02  # what masks leave unexplained of a right state
LOOK_EVERY = 3  # frames
LOOKS_BETTER = 0.85  # share of the loss that another place of a jaw has to have
SAME = 1.0  # jump cost within which two hypotheses are one
# Iterations, and from one contour point to the next: of all that a search has drawn and liked, and of the best of them.
COARSE_STEPS, COARSE_PX = 2, 6
FINE_STEPS, FINE_PX = 6, 3
FAR_WORSE = 1.5  # share of the loss of the best story followed
PIXELS = 5.0  # weight of the logarithm of the loss among what one search has found


@dataclass
class Hypothesis:
    """One story of how the instrument has moved.

    Attributes:
        belief: What it says of the frame to come.
        state: Its last estimate.
        cost: How badly it explained the last frames, the latest most.
        jump: How unlikely the jump was that it began with, beside the story that goes on. Unlike the cost it isn't
            forgotten while both are followed, so that of two which the masks do not tell apart the one without stays.
        iou: Overlap of its silhouette with the mask.
        explained: Share of its contour that has an edge in the mask.
        explained_mask: Share of the mask's edge that has a contour.
        missed_jaws: Share of the jaws that is unexplained, of their own contour.
    """

    belief: MotionBelief
    state: FloatArray
    cost: float
    iou: float = 0.0
    explained: float = 1.0
    explained_mask: float = 1.0
    missed_jaws: float = 0.0
    jump: float = 0.0

    @property
    def total(self) -> float:
        """What stories are compared by."""
        return self.cost + self.jump


class HybridTracker(InstrumentTracker):
    """Follows the contour, and looks elsewhere when it does not fit."""

    name: ClassVar[str] = "hybrid"
    summary: ClassVar[str] = "ours: Gauss-Newton on the contour, evolution where it leaves edges unexplained"

    class Config(Section):
        """Options."""

        fit: FitConfig = FitConfig()
        acceleration: Annotated[Positive, Field(description="factor on the belief's accelerations")] = 1.0
        fast_acceleration: Annotated[Positive, Field(description="further factor for fast sequences")] = 2.5
        reading_bias_rad: Annotated[NotNegative, Field(description="what readings are wrong by for long")] = 0.02
        reading_drift_rad: Annotated[NotNegative, Field(description="how that changes from frame to frame")] = 0.003
        reading_noise_rad: Annotated[Positive, Field(description="what they are wrong by in one frame")] = 0.01
        explained: Annotated[float, Field(ge=0, le=1, description="share of edges below which it searches")] = 0.9
        jaws: Annotated[float, Field(ge=0, le=1, description="share of a jaw unexplained above which it does")] = 0.35
        weak_jaws_rad: Annotated[
            NotNegative, Field(description="jaws known no better than so have tips looked for; 0: always")
        ] = 0.1
        misfit_px: Annotated[NotNegative, Field(description="so do edges that fit no better than so")] = 0.15
        samples: Annotated[int, Field(ge=0, description="states drawn in a search; 0: never search")] = 96
        generations: Annotated[int, Field(ge=0, description="of CMA-ES in a search")] = 3
        population: Annotated[int, Field(ge=4, description="samples of such a generation")] = 70
        refined: Annotated[int, Field(ge=1, description="best samples of a search that are fitted coarsely")] = 8
        finished: Annotated[int, Field(ge=1, description="best of these that are fitted to the end")] = 3
        hypotheses: Annotated[int, Field(ge=1, description="followed at a time")] = 3
        pause: Annotated[int, Field(ge=0, description="frames without a search after one that found nothing")] = 2
        model_error: Annotated[
            NotNegative, Field(description="factor on what stated deviations owe to a departure from what is declared")
        ] = 1.0
        trust: Annotated[Positive, Field(description="weight of a frame among hypotheses")] = 20.0
        trust_jaws: Annotated[NotNegative, Field(description="weight of its jaws")] = 10.0
        memory: Annotated[float, Field(ge=0, lt=1, description="of hypotheses' costs from frame to frame")] = 0.8
        given_up: Annotated[Positive, Field(description="cost above the best at which one is dropped")] = 10.0
        lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5
        loss: LossWeights = LossWeights()

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the scorer, the fit and the belief."""
        config = self.config
        self._scene = scene
        self._rng = rng
        self._scale: FloatArray = np.tile(STATE_SCALE, scene.arms)
        self._objective = Objective(scene, config.loss)
        self._evaluator = SilhouetteEvaluator(scene.instruments, scene.views[0].camera)
        self._fit = ContourFit(scene, self._evaluator, self._scale, config.fit)
        self._space = StateSpace(scene.joint_limits, STATE_SCALE, scene.arms)
        self._evolution = tutorial_settings(
            len(state), config.population, mean_rate=2.0, covariance_rate=4.0, elites=15
        )
        self._jaws = JawJudge(scene.instruments, scene.views[0].camera)
        self._drawn = np.diag((self._scale / np.tile(DRAWN, scene.arms)) ** 2)
        self._pause = 0
        self._last_s: float | None = None  # when the last frame was
        self._step_s = scene.dt_s
        self._whereabouts = Whereabouts(state)
        self._found: FloatArray = np.tile(FOUND, scene.arms)
        self._arriving: FloatArray = np.tile(ARRIVING, scene.arms)
        faster = config.acceleration * (config.fast_acceleration if scene.speed == "fast" else 1.0)
        belief = MotionBelief(
            self._scale,
            scene.dt_s,
            np.tile(ACCELERATION * faster, scene.arms),
            np.tile(VELOCITY, scene.arms),
            config.reading_bias_rad,
            config.reading_drift_rad,
            self._fit.shape.scale,
            np.tile(SETTLING_S, scene.arms),
        )
        belief.restart(state, self._found)
        self._hypotheses = [Hypothesis(belief, np.array(state), 0.0)]

    def step(self, observation: Observation) -> Estimate:
        """Follow every hypothesis; search where the best leaves edges unexplained; report the best."""
        config = self.config
        self._objective.observe(observation)
        seen = bool(observation.mask.any())
        last = self._hypotheses[0].state
        if self._last_s is not None:
            self._step_s = step_s(self._last_s, observation.timestamp_s, self._scene.dt_s)
        for k, hypothesis in enumerate(self._hypotheses):
            self._follow(hypothesis, observation, observation.start if k == 0 else None, seen)
        self._last_s = observation.timestamp_s
        best = min(self._hypotheses, key=lambda h: h.total)
        fits = self._fits(best)
        share = float(observation.mask.mean())
        if self._whereabouts.lost or (self._whereabouts.fresh and not fits):
            if config.samples and share >= OUT_OF_VIEW_SHARE and (not fits or self._whereabouts.unseen):
                self._recover(best, observation)
        elif seen and config.samples and not fits:
            if self._pause > 0:
                self._pause -= 1
            elif not self._search(best, last, observation):
                self._pause = config.pause
        else:
            self._pause = 0
            if seen and config.samples and observation.joints is None and observation.index % LOOK_EVERY == 0:
                self._look_at_jaws(best, last, observation)
        self._sort()
        best = self._hypotheses[0]
        # With next to nothing in the mask the best state is one out of the picture, and that overlaps perfectly.
        lost = bool(best.iou < config.lost_iou or share < OUT_OF_VIEW_SHARE)
        if self._scene.arms == 1:  # of two, one mask doesn't tell which is lost
            self._whereabouts.note(best.state, share, lost=lost, fits=self._fits(best))
        return Estimate(
            best.state,
            confidence=float(best.iou),
            lost=lost,
            standard_deviations=self._stated(best.belief),
        )

    def _fits(self, best: Hypothesis) -> bool:
        """Whether nothing has slipped that would be worth a search."""
        config = self.config
        return min(best.explained, best.explained_mask) >= config.explained and best.missed_jaws <= config.jaws

    @property
    def shape(self) -> FloatArray:
        """``(m,)`` what was learned so far of instruments and camera (:class:`Shape`), by the best story."""
        shape: FloatArray = self._hypotheses[0].belief.shape
        return shape

    def _follow(self, hypothesis: Hypothesis, observation: Observation, start: FloatArray | None, seen: bool) -> None:
        belief, config = hypothesis.belief, self.config
        if self._last_s is not None:
            if self._whereabouts.fresh:  # the jump back to where it is is no speed
                belief.slow(self._arriving)
            belief.predict(self._step_s)
        tips = (
            self._last_s is None
            or self._jaws_sd_rad(belief) > config.weak_jaws_rad
            or self._fit.misfit_px > config.misfit_px
        )
        if observation.joints is not None:
            belief.read_joints(observation.joints.ravel(), config.reading_noise_rad)
        starts = [clip_joints(belief.state, self._scene.joint_limits)]
        if start is not None:
            starts.append(belief.near(start))
        if self._step_s > self._scene.dt_s:  # for so long nothing may have gone on as it did
            starts.append(belief.near(hypothesis.state))
        candidates = np.stack(starts)
        # A detector takes longer than all the rest of a frame: it isn't waited for while the contour tells the jaws.
        losses = (self._objective if tips else self._objective.mismatch)(candidates)[0]
        begin = candidates[int(np.argmin(losses))]
        # Edges that do not fit because the instrument is elsewhere would make those of the frames to come count little.
        fit = self._fit(begin, observation, belief.prior, tips=tips, learn=not self._whereabouts.doubted)
        belief.update(fit.state, fit.shape, fit.information)
        if not seen:
            belief.stand_still()
        self._take(hypothesis, fit, observation)
        hypothesis.cost = config.memory * hypothesis.cost + self._frame_cost(hypothesis)

    def _stated(self, belief: MotionBelief) -> FloatArray:
        """What the estimate is expected to be off by, ``(9 * arms,)`` rad and m."""
        own = STATED * np.sqrt(np.diag(belief.covariance)) * self._scale
        model = self.config.model_error * belief.departure * np.tile(MODEL_ERROR, self._scene.arms)
        return np.asarray(np.hypot(own, model))

    def _jaws_sd_rad(self, belief: MotionBelief) -> float:
        """How well yaw and jaws are known before a frame, those of the arm that is known worst."""
        return float((np.sqrt(np.diag(belief.covariance)) * self._scale).reshape(-1, STATE_SIZE)[:, YAW_AND_JAWS].max())

    def _take(self, hypothesis: Hypothesis, fit: Fit, observation: Observation) -> None:
        silhouette = self._evaluator.mask(fit.state)
        hypothesis.state, hypothesis.explained = fit.state, fit.explained
        missed = missed_edge(observation.mask, silhouette, EXPLAINED_PX, JAW_PX)
        hypothesis.explained_mask = missed.explained
        hypothesis.missed_jaws = self._jaws(fit.state, fit.missed_px, fit.length_px, missed)
        hypothesis.iou = float(self._objective.mismatch(fit.state[None])[1][0])

    def _frame_cost(self, hypothesis: Hypothesis) -> float:
        # A mask that is a pixel too large costs every hypothesis the same area, but leaves no edge unexplained.
        unexplained = 1.0 - (hypothesis.explained + hypothesis.explained_mask) / 2.0
        whole = float(np.log(unexplained + BEST_UNEXPLAINED))
        jaws = float(np.log(hypothesis.missed_jaws + BEST_JAWS))
        return self.config.trust * whole + self.config.trust_jaws * jaws

    def _search(self, best: Hypothesis, last: FloatArray, observation: Observation) -> bool:
        """Draw, score and refine other states; the best of them becomes a hypothesis. Returns whether one did."""
        states = self._draw(np.stack([best.state, last]), observation)
        found: Hypothesis | None = None
        least = np.inf
        for fit in self._refine(states, observation, lambda state: best.belief.prior_at(state, self._drawn)):
            candidate = Hypothesis(best.belief, fit.state, 0.0)
            self._take(candidate, fit, observation)
            candidate.cost, candidate.jump = self._frame_cost(candidate), jump_cost(fit.state, last)
            # Pixels tell apart what edges explain equally well, within their tolerance.
            pixels = float(self._objective(fit.state[None])[0][0])
            total = candidate.total + PIXELS * np.log(pixels + 1.0)
            if total < least:
                found, least = candidate, total
        return found is not None and self._adopt(found, best)

    def _recover(self, best: Hypothesis, observation: Observation) -> None:
        """Look for an instrument that was lost, along its shaft; what is found is followed.

        No jump counts against it. The belief begins anew where the mask has the instrument, known only to what may have
        changed unseen, and each find is a compromise of that and the frame, so that a few pixels are not believed more
        than they tell.
        """
        config, unseen = self.config, self._whereabouts.unseen
        centres = arrivals(self._whereabouts.sure, self._evaluator, observation.mask)
        belief = copy.deepcopy(best.belief)
        belief.restart(centres[0], AWAY, ARRIVING)
        if observation.joints is not None:
            belief.read_joints(observation.joints.ravel(), config.reading_noise_rad)
        prior = belief.prior
        centres[:, JOINTS] = clip_joints(belief.state, self._scene.joint_limits)[JOINTS]
        before = 0.0
        if unseen:  # what was followed meanwhile followed nothing
            self._hypotheses = []
        else:
            before = best.cost - self._frame_cost(best)
            if best.iou >= config.lost_iou:
                centres = np.concatenate([centres, best.state[None]])
        states = self._draw(centres, observation)
        for fit in self._refine(states, observation, lambda _: prior):
            own = copy.deepcopy(belief)
            own.update(fit.state, fit.shape, fit.information)
            candidate = Hypothesis(own, fit.state, 0.0)
            self._take(candidate, fit, observation)
            off = (own.near(fit.state) - belief.state) / self._scale
            candidate.jump = 0.5 * float(off @ np.linalg.solve(belief.covariance, off))
            candidate.cost = before + self._frame_cost(candidate)
            self._hypotheses.append(candidate)

    def _draw(self, centres: FloatArray, observation: Observation) -> FloatArray:
        """States around ``(m, 9 * arms)`` others, scored and evolved; the best of each kind, ``(k, 9 * arms)``."""
        config, scene = self.config, self._scene
        known = observation.joints is not None
        states, moves = propose(centres, config.samples, scene.joint_limits, known, self._rng)
        if not known:
            swept = sweep_jaws(centres, scene.joint_limits)
            states = np.concatenate([states, swept])
            moves = np.append(moves, np.full(len(swept), Move.SWEEP))
        losses = self._objective(states)[0]
        order = best_of_each(losses, moves, config.refined)
        if config.generations:
            evolved, evolved_losses = self._evolve(states[int(np.argmin(losses))])
            states, losses = np.concatenate([states, evolved]), np.concatenate([losses, evolved_losses])
            order = np.append(order, len(moves) + np.argmin(evolved_losses))
        if self.trace is not None:
            ranked = np.argsort(losses, kind="stable")
            self.trace.states.append(states[ranked])
            self.trace.losses.append(losses[ranked])
        chosen: FloatArray = states[order]
        return chosen

    def _refine(
        self, states: FloatArray, observation: Observation, prior_of: Callable[[FloatArray], Prior]
    ) -> list[Fit]:
        """Fit all states coarsely, and to the end the best that no story followed is like, nor far better than."""
        fits = [
            self._fit(one, observation, prior_of(one), iterations=COARSE_STEPS, spacing_px=COARSE_PX) for one in states
        ]
        others = [one.state for one in self._hypotheses]
        ends = np.stack([fit.state for fit in fits] + others)
        losses = self._objective(ends)[0]
        worst = FAR_WORSE * losses[len(fits) :].min(initial=np.inf)
        kept: list[int] = []
        for k in np.argsort(losses[: len(fits)], kind="stable"):
            if losses[k] <= worst and all(jump_cost(ends[k], other) >= SAME for other in others):
                kept.append(int(k))
                others.append(ends[k])
        return [
            self._fit(ends[k], observation, prior_of(states[k]), iterations=FINE_STEPS, spacing_px=FINE_PX)
            for k in kept[: self.config.finished]
        ]

    def _look_at_jaws(self, best: Hypothesis, last: FloatArray, observation: Observation) -> None:
        """Follow another place of one jaw beside the best story, where the mask likes that better.

        A hidden jaw that has slipped leaves so little of the edge unexplained that nothing else would notice.
        """
        states = np.concatenate([best.state[None], sweep_jaws(best.state[None], self._scene.joint_limits)])
        losses = self._objective.mismatch(states)[0]
        elsewhere = np.array([jump_cost(state, best.state) >= SAME for state in states])
        if not elsewhere.any():
            return
        k = int(np.argmin(np.where(elsewhere, losses, np.inf)))
        if losses[k] > LOOKS_BETTER * losses[0]:
            return
        fit = self._fit(
            states[k],
            observation,
            best.belief.prior_at(states[k], self._drawn),
            iterations=COARSE_STEPS + FINE_STEPS,
            spacing_px=FINE_PX,
        )
        found = Hypothesis(best.belief, fit.state, 0.0)
        self._take(found, fit, observation)
        found.cost, found.jump = self._frame_cost(found), jump_cost(fit.state, last)
        self._adopt(found, best)

    def _adopt(self, found: Hypothesis, best: Hypothesis) -> bool:
        """Follow a story beside the best one, unless it is far worse or one that is followed already.

        Its cost is that of this frame: what was before they share.
        """
        found.cost += best.cost - self._frame_cost(best)
        found.jump += best.jump
        if found.total > best.total + self.config.given_up or any(
            jump_cost(found.state, other.state) < SAME for other in self._hypotheses
        ):
            return False
        belief = copy.deepcopy(best.belief)
        belief.restart(found.state, self._found)
        self._hypotheses.append(replace(found, belief=belief))
        return True

    def _evolve(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Samples of a few generations of CMA-ES from a state on, and their losses."""
        config = self.config
        search = CMA(self._space.encode(state), 1.0, config.population, settings=self._evolution)
        states, losses = [], []
        for _ in range(config.generations):
            samples = search.ask(self._rng.standard_normal((config.population, len(state))))
            states.append(self._space.decode(samples))
            losses.append(self._objective(states[-1])[0])
            search.tell(samples, losses[-1])
        return np.concatenate(states), np.concatenate(losses)

    def _sort(self) -> None:
        """Best first; without those that have become another's double, or have been outdone."""
        kept: list[Hypothesis] = []
        for one in sorted(self._hypotheses, key=lambda h: h.total):
            outdone = kept and one.total > kept[0].total + self.config.given_up
            if not outdone and all(jump_cost(one.state, other.state) >= SAME for other in kept):
                kept.append(one)
        self._hypotheses = kept[: self.config.hypotheses]
        if len(self._hypotheses) == 1:
            self._hypotheses[0].jump = 0.0
