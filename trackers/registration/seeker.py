"""One arm looked for elsewhere, where its contour does not fit or where it was lost."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np

from surgbench.contract import Estimate, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.state import JOINTS, STATE_SCALE, StateSpace, clip_joints
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import tutorial_settings
from surgbench.trackers.registration.arrival import arrivals
from surgbench.trackers.registration.fit import Fit, Prior
from surgbench.trackers.registration.follower import ARRIVING, DRAWN, HIDDEN_M, Follower, share_of
from surgbench.trackers.registration.hypothesis import SAME, Hypothesis
from surgbench.trackers.registration.options import HybridOptions
from surgbench.trackers.registration.part import PartView
from surgbench.trackers.registration.proposals import (
    Move,
    anew,
    best_of_each,
    jump_cost,
    propose,
    slide,
    sweep_jaws,
    widest_rolls,
)
from surgbench.trackers.registration.screen import missing_piece

# What may have changed while nothing was seen, once it is put where the mask is.
AWAY = np.array([0.15, 0.7, 0.15, 1.2e-2, 1.2e-2, 2.5e-2, 0.5, 0.5, 0.4])
# States drawn as is believed, and along the shaft, of an arm that was hidden.
BELIEVED, SLID = 48, 240
# Likewise with roll and joints anew, of one that does not fit: they may be anything, and few of them lead to the right
# ones. Of these, so many of the best are refined.
ANEW, ANEW_REFINED = 900, 8
OFTEN = 8  # frames that do not fit, in which it is looked for so; then in every so many, for that takes long
GLITCH = 3  # frames that do not fit, before which a hidden arm is not searched: a mask may err, and anything fits it
LONG_UNFIT = 4  # frames in which no search helps, after which an arm is looked for as if it had been away
LOOK_EVERY = 3  # frames
LOOKS_BETTER = 0.85  # share of the loss that another place of a jaw has to have
# Iterations, and from one contour point to the next: of all that a search has drawn and liked, and of the best of them.
COARSE_STEPS, COARSE_PX = 2, 6
FINE_STEPS, FINE_PX = 6, 3
FAR_WORSE = 1.5  # share of the loss of the best story followed
PIXELS = 5.0  # weight of the logarithm of the loss among what one search has found


class Seeker(Follower):
    """Follows one arm, and searches where edges stay unexplained.

    Args:
        scene: Of that arm.
        state: ``(9,)`` of the first frame.
        options: Of the tracker.
        rng: The only source of randomness.
        part: Others are in the picture too.

    Attributes:
        trace: Where candidates are noted, if anywhere.
    """

    def __init__(
        self, scene: Scene, state: FloatArray, options: HybridOptions, rng: np.random.Generator, *, part: bool = False
    ) -> None:
        super().__init__(scene, state, options, part=part)
        self.trace: Trace | None = None
        self._rng = rng
        self._space = StateSpace(scene.joint_limits, STATE_SCALE, 1)
        self._evolution = tutorial_settings(
            len(state), options.population, mean_rate=2.0, covariance_rate=4.0, elites=15
        )
        self._drawn = np.diag((STATE_SCALE / DRAWN) ** 2)
        self._pause = 0
        self._unfit = 0  # frames in a row in which one of two arms did not fit

    @property
    def unfit(self) -> bool:
        """Whether the last frame did not fit one of two arms that was known well: it was where it was expected."""
        return self._unfit > 0 and self.hypotheses[0].off_m <= HIDDEN_M

    def step(self, observation: Observation) -> Estimate:
        """Follow every hypothesis; search where the best leaves edges unexplained; report the best."""
        last = self.hypotheses[0].state
        self.predict(observation.timestamp_s)
        self.observe(observation)
        for k, hypothesis in enumerate(self.hypotheses):
            ask = self.ask(hypothesis, observation, observation.start if k == 0 else None)
            self.take(hypothesis, self.fitted(ask, observation), observation)
        self.look(last, observation)
        estimate: Estimate = self.answer(observation)
        return estimate

    def look(self, last: FloatArray, observation: Observation, *, alone: bool = True) -> None:
        """Look elsewhere, where that is called for.

        Args:
            last: ``(9,)`` the last frame's estimate.
            observation: The frame, in which all stories have been followed.
            alone: Nothing else is in its masks. Where a lost arm may be, edges that do not fit call for nothing.
        """
        options, best = self.options, self.best
        seen = bool(observation.mask.any())
        fits = self._fits(best)
        share = share_of(observation.mask)
        self._unfit = 0 if fits or best.hidden or not alone else self._unfit + 1
        if self.whereabouts.lost or (self.whereabouts.fresh and not fits):
            if options.samples and share >= OUT_OF_VIEW_SHARE and (not fits or self.whereabouts.unseen):
                self._recover(best, observation)
        elif best.hidden or not alone or (best.off_m > HIDDEN_M and self._unfit < GLITCH):
            self._pause = 0
        elif self._unfit == 1 and self._lacks_a_piece(best, observation):
            self._pause = 0  # from the next frame on that is taken to be hidden
        elif self._part and options.samples and self._unfit > LONG_UNFIT and self._unfit % LONG_UNFIT == 0:
            self._recover(best, observation)
        elif seen and options.samples and not fits:
            if self._pause > 0:
                self._pause -= 1
            elif not self._search(best, last, observation):
                self._pause = options.pause
        else:
            self._pause = 0
            if seen and options.samples and observation.joints is None and observation.index % LOOK_EVERY == 0:
                self._look_at_jaws(best, last, observation)

    def _lacks_a_piece(self, best: Hypothesis, observation: Observation) -> bool:
        """Whether nothing is seen of a large piece of one of two arms."""
        view = observation.views[0]
        if not isinstance(view, PartView):
            return False
        silhouette = self.evaluator.mask(best.state)
        return missing_piece(silhouette, view.mask, view.hidden, view.mask) is not None

    def _search(self, best: Hypothesis, last: FloatArray, observation: Observation) -> bool:
        """Draw, score and refine other states; the best of them becomes a hypothesis. Returns whether one did."""
        states = self._draw(np.stack([best.state, last]), observation)
        found: tuple[Hypothesis, Fit] | None = None
        least = np.inf
        for fit in self._refine(states, observation, lambda state: best.belief.prior_at(state, self._drawn)):
            candidate = Hypothesis(best.belief, fit.state, 0.0)
            self._judge(candidate, fit, observation)
            candidate.cost, candidate.jump = self._frame_cost(candidate), jump_cost(fit.state, last)
            # Pixels tell apart what edges explain equally well, within their tolerance.
            pixels = float(self._objective(fit.state[None])[0][0])
            total = candidate.total + PIXELS * np.log(pixels + 1.0)
            if total < least:
                found, least = (candidate, fit), total
        return found is not None and self._adopt(*found, best)

    def _recover(self, best: Hypothesis, observation: Observation) -> None:
        """Look for an instrument that was lost, along its shaft; what is found is followed.

        No jump counts against it. The belief begins anew where the mask has the instrument, known only to what may have
        changed unseen, and each find is a compromise of that and the frame, so that a few pixels are not believed more
        than they tell.
        """
        options, unseen = self.options, self.whereabouts.unseen
        centres = arrivals(self.whereabouts.sure, self.evaluator, observation.mask)
        belief = copy.deepcopy(best.belief)
        belief.restart(centres[0], AWAY, ARRIVING)
        if observation.joints is not None:
            belief.read_joints(observation.joints.ravel(), options.reading_noise_rad)
        prior = belief.prior
        centres[:, JOINTS] = clip_joints(belief.state, self.scene.joint_limits)[JOINTS]
        before = 0.0
        if unseen:  # what was followed meanwhile followed nothing
            self.hypotheses = []
        else:
            before = best.cost - self._frame_cost(best)
            if best.iou >= options.lost_iou:
                centres = np.concatenate([centres, best.state[None]])
        states = self._draw(centres, observation)
        for fit in self._refine(states, observation, lambda _: prior):
            own = copy.deepcopy(belief)
            own.update(fit.state, fit.shape, fit.information)
            candidate = Hypothesis(own, fit.state, 0.0)
            self._judge(candidate, fit, observation)
            off = (own.near(fit.state) - belief.state) / STATE_SCALE
            candidate.jump = 0.5 * float(off @ np.linalg.solve(belief.covariance, off))
            candidate.cost = before + self._frame_cost(candidate)
            self.hypotheses.append(candidate)

    def _draw(self, centres: FloatArray, observation: Observation) -> FloatArray:
        """States around ``(m, 9)`` others, scored and evolved; the best of each kind, ``(k, 9)``."""
        options, scene = self.options, self.scene
        known = observation.joints is not None
        rolls = widest_rolls(scene.instruments)
        states, moves = propose(centres, options.samples, scene.joint_limits, known, self._rng, rolls)
        if not known:
            swept = sweep_jaws(centres, scene.joint_limits)
            states = np.concatenate([states, swept])
            moves = np.append(moves, np.full(len(swept), Move.SWEEP))
        if self._part and self.hypotheses and (self.hypotheses[0].off_m > HIDDEN_M or self._unfit > 1):
            more = [
                self.hypotheses[0].belief.draw(BELIEVED, self._rng),
                slide(centres, SLID, self._rng, rolls[0]),
            ]
            kinds = [Move.BELIEVED, Move.SLIDE]
            if not known and self._unfit > 1 and (self._unfit <= OFTEN or self._unfit % OFTEN == 0):
                more.append(anew(centres, ANEW, scene.joint_limits, self._rng, rolls[0]))
                kinds.append(Move.ANEW)
            states = np.concatenate([states, clip_joints(np.concatenate(more), scene.joint_limits)])
            moves = np.append(moves, np.repeat(kinds, [len(some) for some in more]))
        losses = self._objective(states)[0]
        order = best_of_each(losses, moves, options.refined)
        scattered = np.flatnonzero(moves == Move.ANEW)
        scattered = scattered[np.argsort(losses[scattered], kind="stable")[:ANEW_REFINED]]
        order = np.append(order, np.setdiff1d(scattered, order))
        if options.generations:
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
            self.fit(one, observation, prior_of(one), iterations=COARSE_STEPS, spacing_px=COARSE_PX) for one in states
        ]
        others = [one.state for one in self.hypotheses]
        ends = np.stack([fit.state for fit in fits] + others)
        losses = self._objective(ends)[0]
        worst = FAR_WORSE * losses[len(fits) :].min(initial=np.inf)
        kept: list[int] = []
        for k in np.argsort(losses[: len(fits)], kind="stable"):
            if losses[k] <= worst and all(jump_cost(ends[k], other) >= SAME for other in others):
                kept.append(int(k))
                others.append(ends[k])
        return [
            self.fit(ends[k], observation, prior_of(states[k]), iterations=FINE_STEPS, spacing_px=FINE_PX)
            for k in kept[: self.options.finished]
        ]

    def _look_at_jaws(self, best: Hypothesis, last: FloatArray, observation: Observation) -> None:
        """Follow another place of one jaw beside the best story, where the mask likes that better.

        A hidden jaw that has slipped leaves so little of the edge unexplained that nothing else would notice.
        """
        states = np.concatenate([best.state[None], sweep_jaws(best.state[None], self.scene.joint_limits)])
        losses = self._objective.mismatch(states)[0]
        elsewhere = np.array([jump_cost(state, best.state) >= SAME for state in states])
        if not elsewhere.any():
            return
        k = int(np.argmin(np.where(elsewhere, losses, np.inf)))
        if losses[k] > LOOKS_BETTER * losses[0]:
            return
        fit = self.fit(
            states[k],
            observation,
            best.belief.prior_at(states[k], self._drawn),
            iterations=COARSE_STEPS + FINE_STEPS,
            spacing_px=FINE_PX,
        )
        found = Hypothesis(best.belief, fit.state, 0.0)
        self._judge(found, fit, observation)
        found.cost, found.jump = self._frame_cost(found), jump_cost(fit.state, last)
        self._adopt(found, fit, best)

    def _evolve(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Samples of a few generations of CMA-ES from a state on, and their losses."""
        options = self.options
        search = CMA(self._space.encode(state), 1.0, options.population, settings=self._evolution)
        states, losses = [], []
        for _ in range(options.generations):
            samples = search.ask(self._rng.standard_normal((options.population, len(state))))
            states.append(self._space.decode(samples))
            losses.append(self._objective(states[-1])[0])
            search.tell(samples, losses[-1])
        return np.concatenate(states), np.concatenate(losses)
