"""One arm followed by its contour: hypotheses with beliefs, fitted frame by frame, and judged by what they explain."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from surgbench.contract import Estimate, Mask, Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.objective import Objective
from surgbench.silhouette import SilhouetteEvaluator, iou
from surgbench.state import JOINTS, STATE_SCALE, STATE_SIZE, clip_joints
from surgbench.timing import step_s
from surgbench.trackers.registration.arrival import STEADY, Whereabouts
from surgbench.trackers.registration.belief import MotionBelief
from surgbench.trackers.registration.edges import missed_edge
from surgbench.trackers.registration.fit import ContourFit, Fit, Prior
from surgbench.trackers.registration.hypothesis import SAME, Hypothesis
from surgbench.trackers.registration.jaws import JawJudge
from surgbench.trackers.registration.options import HybridOptions
from surgbench.trackers.registration.part import PartObjective, PartView
from surgbench.trackers.registration.proposals import jump_cost

# Per second (squared): how fast hands move such an instrument. Its jaws turn together more than they open: where one is
# hidden behind the other, it goes with that one.
ACCELERATION = np.array([4.0, 12.0, 4.0, 0.4, 0.4, 0.4, 8.0, 8.0, 2.5])
VELOCITY = np.array([0.3, 1.0, 0.3, 0.02, 0.02, 0.02, 0.5, 0.5, 0.3])
SETTLING_S = np.array([*[np.inf] * 8, 0.5])
# How well the first state, or a hypothesis just found, is known.
FOUND = np.array([0.01, 0.05, 0.03, 5e-4, 5e-4, 1e-3, 0.05, 0.05, 0.05])
# How well a drawn state is known.
DRAWN = np.array([0.1, 1.0, 0.2, 5e-3, 5e-3, 2e-2, 1.0, 1.0, 1.0])
# How fast an arm that comes back is put in.
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
# Of one of two arms. Tips that are known no better make the estimate a lost one; and better than so nothing is hidden.
# What is believed of something hidden is as it says, unlike what edges tell (STATED).
LOST_M, HIDDEN_M = 0.0035, 0.002
GONE_M = 0.02  # a hidden arm may be anywhere, and hides nothing of the other
# What no frame tells of moves on for so many seconds only, and then at such speeds: hands go to and fro.
HIDDEN_SETTLES_S = 0.3
UNEXPLAINED_POWER = 3  # of what is explained, in its confidence
UNFIT = 0.5  # of the confidence, where something has slipped that is searched for
SLIPPED = 3  # frames that do not fit, after which an arm of two has to be seen to fit for it to be believed
WELL_EXPLAINED = 0.95  # so much at least of what is right, in most frames
TELLING_PX = 40.0  # of visible contour, below which no edge is missed
TELLING_SHARE = 0.1  # of a silhouette, below which it is hidden


class Ask(NamedTuple):
    """What is to be fitted: from where on, with which prior, to tips or not, and whether edges are learned from."""

    begin: FloatArray
    prior: Prior
    tips: bool
    learn: bool


def share_of(mask: Mask) -> float:
    """Share of a picture that a mask covers."""
    return np.count_nonzero(mask) / mask.size


class Follower:
    """Follows one arm.

    Args:
        scene: Of that arm.
        state: ``(9,)`` of the first frame.
        options: Of the tracker.
        part: Others are in the picture too: views are :class:`PartView`.

    Attributes:
        hypotheses: The stories followed, best first.
        whereabouts: Where it was last seen.
    """

    def __init__(self, scene: Scene, state: FloatArray, options: HybridOptions, *, part: bool = False) -> None:
        self.options, self.scene, self._part = options, scene, part
        self._objective = PartObjective(scene, options.loss) if part else Objective(scene, options.loss)
        self.evaluator = SilhouetteEvaluator(scene.instruments, scene.views[0].camera)
        self.fit = ContourFit(scene, self.evaluator, STATE_SCALE, options.fit)
        self._jaws = JawJudge(scene.instruments, scene.views[0].camera)
        self._misfits = 0  # frames in a row
        self._until_sure = 0  # frames in which wrist and jaws must be seen to fit
        self._first = True
        self._last_s: float | None = None  # when the last frame was
        self._step_s = scene.dt_s
        self.whereabouts = Whereabouts(state)
        faster = options.acceleration * (options.fast_acceleration if scene.speed == "fast" else 1.0)
        belief = MotionBelief(
            STATE_SCALE,
            scene.dt_s,
            ACCELERATION * faster,
            VELOCITY,
            options.reading_bias_rad,
            options.reading_drift_rad,
            self.fit.shape.scale,
            SETTLING_S,
        )
        belief.restart(state, FOUND)
        self.hypotheses = [Hypothesis(belief, np.array(state), 0.0)]

    @property
    def best(self) -> Hypothesis:
        """The story that explains most."""
        return min(self.hypotheses, key=lambda h: h.total)

    @property
    def shape(self) -> FloatArray:
        """``(m,)`` what was learned so far of instrument and camera (:class:`Shape`), by the best story."""
        shape: FloatArray = self.hypotheses[0].belief.shape
        return shape

    def predict(self, timestamp_s: float) -> None:
        """Advance all beliefs to a frame."""
        self._first = self._last_s is None
        if self._last_s is not None:
            self._step_s = step_s(self._last_s, timestamp_s, self.scene.dt_s)
            for hypothesis in self.hypotheses:
                if self.whereabouts.fresh:  # the jump back to where it is is no speed
                    hypothesis.belief.slow(ARRIVING)
                if self._part and hypothesis.off_m > HIDDEN_M:
                    hypothesis.belief.settle(float(np.exp(-self._step_s / HIDDEN_SETTLES_S)))
                hypothesis.belief.predict(self._step_s)
        self._last_s = timestamp_s

    def expected(self, hypothesis: Hypothesis) -> FloatArray:
        """``(9,)`` where a story has the arm before the frame is seen."""
        return clip_joints(hypothesis.belief.state, self.scene.joint_limits)

    def observe(self, observation: Observation) -> None:
        """Take the frame that is followed, judged and looked at next."""
        self._objective.observe(observation)

    def ask(self, hypothesis: Hypothesis, observation: Observation, start: FloatArray | None) -> Ask:
        """Where a story's fit begins: as predicted, or at the engine's start, whichever the masks like better."""
        belief, options = hypothesis.belief, self.options
        tips = (
            self._first or self._jaws_sd_rad(belief) > options.weak_jaws_rad or self.fit.misfit_px > options.misfit_px
        )
        if observation.joints is not None:
            belief.read_joints(observation.joints.ravel(), options.reading_noise_rad)
        if self._part:
            return Ask(self.expected(hypothesis), belief.prior, tips, learn=not self.whereabouts.doubted)
        starts = [self.expected(hypothesis)]
        if start is not None:
            starts.append(belief.near(start))
        if self._step_s > self.scene.dt_s:  # for so long nothing may have gone on as it did
            starts.append(belief.near(hypothesis.state))
        candidates = np.stack(starts)
        # A detector takes longer than all the rest of a frame: it isn't waited for while the contour tells the jaws.
        losses = (self._objective if tips else self._objective.mismatch)(candidates)[0]
        begin = candidates[int(np.argmin(losses))]
        # Edges that do not fit because the instrument is elsewhere would make those of the frames to come count little.
        return Ask(begin, belief.prior, tips, learn=not self.whereabouts.doubted)

    def fitted(self, ask: Ask, observation: Observation) -> Fit:
        """Fit one story alone."""
        return self.fit(ask.begin, observation, ask.prior, tips=ask.tips, learn=ask.learn)

    def take(self, hypothesis: Hypothesis, fit: Fit, observation: Observation) -> None:
        """Believe a fit, and judge it by a frame."""
        belief = hypothesis.belief
        belief.update(fit.state, fit.shape, fit.information)
        if not observation.mask.any():
            belief.stand_still()
        self._judge(hypothesis, fit, observation)
        hypothesis.cost = self.options.memory * hypothesis.cost + self._frame_cost(hypothesis)

    def answer(self, observation: Observation) -> Estimate:
        """The best story's estimate, once the frame has been followed; what is kept of the others."""
        self._sort()
        best, share = self.hypotheses[0], share_of(observation.mask)
        # With next to nothing in the mask the best state is one out of the picture, and that overlaps perfectly.
        lost = missing = bool(best.iou < self.options.lost_iou or share < OUT_OF_VIEW_SHARE)
        confidence = best.iou
        if self._part:
            for hypothesis in self.hypotheses:
                hypothesis.off_m = self._tips_off_m(hypothesis)
            missing = best.off_m > GONE_M if best.hidden else lost
            lost = missing or best.off_m > LOST_M
            # What is wrong may overlap well: of a shaft that is in its place, and all else is not.
            overlap = 1.0 if best.hidden else best.iou * min(best.explained, best.explained_mask) ** UNEXPLAINED_POWER
            confidence = overlap / (1.0 + (best.off_m / LOST_M) ** 2) * (UNFIT if self._slipped(best) else 1.0)
        self.whereabouts.note(best.state, share, lost=missing, fits=self._fits(best))
        return Estimate(
            best.state, confidence=float(confidence), lost=lost, standard_deviations=self._stated(best.belief)
        )

    def _slipped(self, best: Hypothesis) -> bool:
        """Whether something has slipped, and has not been seen to be right since.

        What did not fit for long and then does may fit for being hidden: of roll and joints a shaft says nothing.
        """
        fits = self._fits(best)
        self._misfits = 0 if fits else self._misfits + 1
        if self._misfits > SLIPPED:
            self._until_sure = STEADY
        elif best.tool_px >= TELLING_PX and self._until_sure:
            # What a search finds in a mask that is not the arm's fits well enough, but not as well as what is right.
            well = min(best.explained, best.explained_mask) >= WELL_EXPLAINED and best.missed_jaws <= BEST_JAWS
            self._until_sure -= int(well)
        return not fits or self._until_sure > 0

    def _tips_off_m(self, hypothesis: Hypothesis) -> float:
        """How far off the tips' centre is believed to be, metres."""
        belief = hypothesis.belief
        states = hypothesis.state + np.concatenate([np.zeros((1, STATE_SIZE)), 0.01 * np.diag(STATE_SCALE)])
        places = self.scene.instruments[0].tips_cam(states).mean(axis=1)
        J = (places[1:] - places[0]) / 0.01  # metres per natural step
        return float(np.sqrt(np.einsum("ia,ij,ja->", J, belief.covariance, J)))

    def _fits(self, best: Hypothesis) -> bool:
        """Whether nothing has slipped that would be worth a search."""
        options = self.options
        explained = min(best.explained, best.explained_mask)
        return bool(explained >= options.explained and best.missed_jaws <= options.jaws)

    def _stated(self, belief: MotionBelief) -> FloatArray:
        """What the estimate is expected to be off by, ``(9,)`` rad and m."""
        own = STATED * np.sqrt(np.diag(belief.covariance)) * STATE_SCALE
        model = self.options.model_error * belief.departure * MODEL_ERROR
        return np.asarray(np.hypot(own, model))

    def _jaws_sd_rad(self, belief: MotionBelief) -> float:
        """How well yaw and jaws are known before a frame."""
        return float((np.sqrt(np.diag(belief.covariance)) * STATE_SCALE)[YAW_AND_JAWS].max())

    def _judge(self, hypothesis: Hypothesis, fit: Fit, observation: Observation) -> None:
        silhouette = self.evaluator.mask(fit.state)
        view = observation.views[0]
        hidden = view.hidden if isinstance(view, PartView) else None
        hypothesis.state, hypothesis.explained = fit.state, fit.explained
        missed = missed_edge(observation.mask, silhouette, EXPLAINED_PX, JAW_PX, hidden)
        hypothesis.explained_mask = missed.explained
        hypothesis.missed_jaws = self._jaws(fit.state, fit.missed_px, fit.length_px, missed)
        covered, shown = self._overlap(hypothesis, silhouette, observation)
        if hidden is not None:
            hypothesis.tool_px = float(fit.length_px[:, 1:].sum())
            hypothesis.hidden = covered > 0 and shown < max(TELLING_SHARE * covered, OUT_OF_VIEW_SHARE * hidden.size)
            if covered and fit.length_px.sum() < TELLING_PX:
                hypothesis.explained = 1.0

    def _overlap(self, hypothesis: Hypothesis, silhouette: Mask, observation: Observation) -> tuple[int, int]:
        """Judge by the masks; returns how many pixels the silhouette covers, and in how many of them it would show."""
        view = observation.views[0]
        covered = shown = 0
        if isinstance(view, PartView):
            covered, shown = int(np.count_nonzero(silhouette)), int(np.count_nonzero(silhouette & ~view.hidden))
        if isinstance(view, PartView) and len(observation.views) == 1:  # counted here what would be counted anew
            overlap, seen = np.count_nonzero(silhouette & view.mask), int(np.count_nonzero(view.mask))
            hypothesis.iou = float(iou(np.array([shown]), np.array([overlap]), seen)[0])
        else:
            hypothesis.iou = float(self._objective.mismatch(hypothesis.state[None])[1][0])
        return covered, shown

    def _frame_cost(self, hypothesis: Hypothesis) -> float:
        # A mask that is a pixel too large costs every hypothesis the same area, but leaves no edge unexplained.
        unexplained = 1.0 - (hypothesis.explained + hypothesis.explained_mask) / 2.0
        whole = float(np.log(unexplained + BEST_UNEXPLAINED))
        jaws = float(np.log(hypothesis.missed_jaws + BEST_JAWS))
        return float(self.options.trust * whole + self.options.trust_jaws * jaws)

    def _adopt(self, found: Hypothesis, fit: Fit, best: Hypothesis) -> bool:
        """Follow a story beside the best one, unless it is far worse or one that is followed already.

        Its cost is that of this frame: what was before they share.
        """
        found.cost += best.cost - self._frame_cost(best)
        found.jump += best.jump
        if found.total > best.total + self.options.given_up or any(
            jump_cost(found.state, other.state) < SAME for other in self.hypotheses
        ):
            return False
        belief = copy.deepcopy(best.belief)
        belief.restart(found.state, DRAWN if self._part else FOUND)
        if self._part:  # it may be seen but for a little, which tells of it no more than that
            belief.update(fit.state, fit.shape, fit.information)
        self.hypotheses.append(replace(found, belief=belief))
        return True

    def _sort(self) -> None:
        """Best first; without those that have become another's double, or have been outdone."""
        kept: list[Hypothesis] = []
        for one in sorted(self.hypotheses, key=lambda h: h.total):
            outdone = kept and one.total > kept[0].total + self.options.given_up
            if not outdone and all(jump_cost(one.state, other.state) >= SAME for other in kept):
                kept.append(one)
        self.hypotheses = kept[: self.options.hypotheses]
        if len(self.hypotheses) == 1:
            self.hypotheses[0].jump = 0.0
