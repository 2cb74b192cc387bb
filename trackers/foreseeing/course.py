"""A whole course as one program: knots, what moves between them, and its improvement by quadratic programs.

Between knots the set points move with constant acceleration, so that servo steps reach them exactly within the limits
of velocity and acceleration. The joints behind them are taken at the pace that their first-order lag settles at,
``j = s - lag v + lag^2 a``. One round linearises the cost's terms and the rules about the present course and solves the
quadratic program for all knots at once with Clarabel (sparse interior-point method; Goulart and Chen 2024), within a
region of trust; Gauss-Newton's Hessian is banded, for every step depends on two knots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from surgbench.geometry import FloatArray
from surgbench.trackers.foreseeing.model import RULES, TERMS, clearances, judge

JOINTS = 6
# Of breaking a rule by a metre, or a limit by a radian, at one step, in units of the cost.
PRICE = 1e5
# The first region of trust: radians, metres for the insertion.
TRUST = np.array([0.1, 0.1, 0.01, 0.4, 0.2, 0.2])
SMALLEST_TRUST = 1e-3
# Shares of velocity and acceleration that are used, so that rounding breaks no limit.
USED = 0.999


@dataclass(frozen=True, eq=False)
class Problem:
    """All that a course depends on, base frame.

    Attributes:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(4, 6)`` lower and upper joint limits, largest velocities and accelerations.
        wanted: ``(T, 2, 3)`` feature and naive place that the joints after each step are held against.
        feature: ``(T, 3)`` the feature at the moment of the joints after each step.
        distance_m: d_t.
        weights: ``(4,)`` as :func:`surgbench.trackers.foreseeing.model.judge` takes them.
        up: ``(3,)``.
        rules: ``(2, 4)`` as :func:`surgbench.trackers.foreseeing.model.clearances` takes them.
        faces: ``(n, 4)``.
        margin_m: Kept from the rules.
        dt_s: Of a step.
        lag_s: Of the joints.
        start: ``(2, 6)`` set point and its velocity before the first step.
    """

    arm: FloatArray
    reach_m: float
    limits: FloatArray
    wanted: FloatArray
    feature: FloatArray
    distance_m: float
    weights: FloatArray
    up: FloatArray
    rules: FloatArray
    faces: FloatArray
    margin_m: float
    dt_s: float
    lag_s: float
    start: FloatArray


class Knots:
    """How knots become set points and joints: linear, joint by joint.

    Args:
        problem: Steps and lag.
        every: Steps from knot to knot.
    """

    def __init__(self, problem: Problem, every: int) -> None:
        steps = len(problem.feature)
        self.count = -(-steps // every) + 1
        self.gap_s = every * problem.dt_s
        step = np.arange(1, steps + 1)
        self.first = np.minimum((step - 1) // every, self.count - 2)
        t = (step - self.first * every) * problem.dt_s
        h, lag = self.gap_s, problem.lag_s
        one = np.ones(steps)
        # Columns: place and velocity at the knot before, velocity at the knot after.
        self.setpoint = np.stack([one, t - t * t / (2 * h), t * t / (2 * h)], axis=1)
        settled = -lag * (t / h) + lag * lag / h
        self.joint = self.setpoint + np.stack([0 * one, -lag - settled, settled], axis=1)
        middle = (t - problem.dt_s / 2) / h
        self.speed = np.stack([0 * one, 1 - middle, middle], axis=1)  # the mean of the step that ends there

    def steps(self, places: FloatArray, velocities: FloatArray, rows: FloatArray) -> FloatArray:
        """``(T, 6)`` of knots ``(K, 6)`` by ``setpoint`` or ``joint``."""
        k = self.first
        value = rows[:, :1] * places[k] + rows[:, 1:2] * velocities[k] + rows[:, 2:] * velocities[k + 1]
        return np.asarray(value)

    def places(self, start: FloatArray, velocities: FloatArray) -> FloatArray:
        """``(K, 6)`` places that follow from velocities."""
        moved = np.cumsum(self.gap_s / 2 * (velocities[:-1] + velocities[1:]), axis=0)
        return np.concatenate([start[None], start + moved])


@dataclass(frozen=True, eq=False)
class Merit:
    """What a course costs: ``view_cost``, metres by which rules and radians by which limits are broken, summed."""

    cost: float
    broken_m: float
    beyond_rad: float

    @property
    def total(self) -> float:
        """All, rules and limits at their price."""
        return self.cost + PRICE * (self.broken_m + self.beyond_rad)


class CourseProgram:
    """Improves a course.

    Args:
        problem: What is asked.
        every: Steps from knot to knot.
    """

    def __init__(self, problem: Problem, every: int) -> None:
        self._problem, self.knots = problem, Knots(problem, every)

    def merit(self, places: FloatArray, velocities: FloatArray) -> Merit:
        """Of a course, by its knots."""
        problem, knots = self._problem, self.knots
        joints = knots.steps(places, velocities, knots.joint)
        r, _ = self._judge(joints)
        broken = 0.0
        for at in (joints, knots.steps(places, velocities, knots.setpoint)):
            clear, _ = self._clear(at)
            broken += float(np.maximum(problem.margin_m - clear, 0.0).sum())
        room, _ = self._room(places, velocities)
        return Merit(float((r * r).sum()), broken, float(np.maximum(-room, 0.0).sum()))

    def _room(self, places: FloatArray, velocities: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far within its limits each joint comes to rest after each step, ``(2, T, 6)``, and the speeds' part.

        As the servo reckons it: ``s + w |w| / 2a`` with the mean velocity w of the step.
        """
        lower, upper, _, acceleration = self._problem.limits
        at = self.knots.steps(places, velocities, self.knots.setpoint)
        speed = self.knots.steps(places, velocities, self.knots.speed)
        rest = at + speed * np.abs(speed) / (2 * acceleration)
        room = acceleration * self._problem.dt_s**2
        return np.stack([upper - room - rest, rest - lower - room]), np.abs(speed) / acceleration

    def improve(self, velocities: FloatArray, rounds: int) -> tuple[FloatArray, list[Merit]]:
        """Rounds of quadratic programs from a course on.

        Args:
            velocities: ``(K, 6)`` at the knots.
            rounds: At most so many.

        Returns:
            The best velocities ``(K, 6)``, and the merit after every round that was better.
        """
        trust = TRUST.copy()
        places = self.knots.places(self._problem.start[0], velocities)
        merits = [self.merit(places, velocities)]
        for _ in range(rounds):
            found = self._solve(places, velocities, trust)
            if found is not None:
                tried = self.knots.places(self._problem.start[0], found)
                merit = self.merit(tried, found)
                if merit.total < merits[-1].total:
                    gain = 1 - merit.total / max(merits[-1].total, 1e-12)
                    places, velocities = tried, found
                    merits.append(merit)
                    if gain < 1e-4:
                        break
                    trust = np.minimum(trust * 1.5, 2 * TRUST)
                    continue
            trust = trust * 0.3
            if trust[0] < SMALLEST_TRUST * TRUST[0] * 10:
                break
        return velocities, merits

    def _judge(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        p = self._problem
        r, J = np.empty((len(joints), TERMS)), np.empty((len(joints), TERMS, JOINTS))
        judge(p.arm, p.reach_m, joints, p.wanted, p.distance_m, p.weights, p.up, r, J)
        return r, J

    def _clear(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        p = self._problem
        clear, J = np.empty((len(joints), RULES)), np.empty((len(joints), RULES, JOINTS))
        clearances(p.arm, p.reach_m, joints, p.feature, p.rules, p.faces, clear, J)
        return clear, J

    def _solve(self, places: FloatArray, velocities: FloatArray, trust: FloatArray) -> FloatArray | None:
        """Velocities ``(K, 6)`` of the quadratic program's solution; ``None`` where the solver finds none."""
        import clarabel

        knots = self.knots
        K, n = knots.count, JOINTS
        joints = knots.steps(places, velocities, knots.joint)
        r, J = self._judge(joints)
        columns = _columns(knots.first)
        blocks = _blocks(J, knots.joint)
        size = 2 * n * K
        G = _rows(blocks, columns, size)
        rules, slack = self._near_rows(places, velocities, trust, columns, size)
        total = size + slack
        P = sparse.block_diag([2 * G.T @ G, sparse.csc_matrix((slack, slack))], format="csc")
        q = np.concatenate([2 * (G.T @ r.ravel()), np.full(slack, PRICE)])
        A, b, equal = self._limits(places, velocities, trust, total)
        if slack:
            A = sparse.vstack([A, rules[0], _selection(size, slack, total, -1.0)], format="csc")
            b = np.concatenate([b, rules[1], np.zeros(slack)])
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = 60
        settings.tol_gap_rel = settings.tol_gap_abs = settings.tol_feas = 1e-7
        cones = [clarabel.ZeroConeT(equal), clarabel.NonnegativeConeT(len(b) - equal)]
        upper: Any = sparse.triu(P, format="csc")
        solution = clarabel.DefaultSolver(upper, q, A.tocsc(), b, cones, settings).solve()
        if not np.isfinite(solution.x).all() or "Solved" not in str(solution.status):
            return None
        step = np.array(solution.x[:size]).reshape(K, 2, n)
        return np.asarray(velocities + step[:, 1])

    def _near_rows(
        self, places: FloatArray, velocities: FloatArray, trust: FloatArray, columns: Any, size: int
    ) -> tuple[tuple[Any, FloatArray], int]:
        """Rows ``-J d - s <= clear - margin`` of rules and limits that are near, each with a slack ``s`` of its own."""
        knots, problem = self.knots, self._problem
        parts, sides = [], []
        for rows in (knots.joint, knots.setpoint):
            clear, J = self._clear(knots.steps(places, velocities, rows))
            near = clear - problem.margin_m < np.abs(J) @ trust
            step, rule = np.nonzero(near)
            parts.append(_rows(_blocks(-J[step, rule][:, None], rows[step]), columns[step], size))
            sides.append(clear[step, rule] - problem.margin_m)
        room, ahead = self._room(places, velocities)
        for sign, left in zip((1.0, -1.0), room, strict=True):
            step, joint = np.nonzero(left < trust + ahead * trust / knots.gap_s)
            weight = sign * np.eye(JOINTS)[joint][:, None]
            block = _blocks(weight, knots.setpoint[step]) + _blocks(
                weight * ahead[step, joint][:, None, None], knots.speed[step]
            )
            parts.append(_rows(block, columns[step], size))
            sides.append(left[step, joint])
        side = np.concatenate(sides)
        slack = len(side)
        rows_all = sparse.vstack(parts, format="csc")
        return (sparse.hstack([rows_all, -sparse.identity(slack)], format="csc"), side), slack

    def _limits(
        self, places: FloatArray, velocities: FloatArray, trust: FloatArray, total: int
    ) -> tuple[Any, FloatArray, int]:
        """The course's own rows: how it begins and goes on, then limits of place, velocity and acceleration."""
        problem, knots = self._problem, self.knots
        K, n, h = knots.count, JOINTS, knots.gap_s
        _, _, fastest, acceleration = problem.limits
        fastest, acceleration = USED * fastest, USED * acceleration
        one: Any = sparse.identity(n)
        eye: Any = sparse.identity(K)
        place = sparse.kron(eye, sparse.hstack([one, sparse.csc_matrix((n, n))]))
        speed = sparse.kron(eye, sparse.hstack([sparse.csc_matrix((n, n)), one]))
        before, after = slice(0, n * (K - 1)), slice(n, n * K)
        place, speed = place.tocsr(), speed.tocsr()
        gap = place[after] - place[before] - h / 2 * (speed[after] + speed[before])
        change = (speed[after] - speed[before]) / h
        start = sparse.vstack([place[:n], speed[:n]])
        equal = sparse.vstack([start, gap])
        trusted = np.tile(trust, K)
        slow = (fastest - velocities).ravel(), (fastest + velocities).ravel()
        now = np.diff(velocities, axis=0) / h
        hard = (acceleration - now).ravel(), (acceleration + now).ravel()
        A = sparse.vstack([equal, place, -place, speed, -speed, change, -change])
        b = np.concatenate([
            np.zeros(equal.shape[0]), trusted, trusted, *slow, *hard,
        ])  # fmt: skip
        empty = sparse.csc_matrix((A.shape[0], total - A.shape[1]))
        return sparse.hstack([A, empty], format="csc"), b, equal.shape[0]


def _columns(first: Any) -> Any:
    """``(T, 18)`` variables that each step depends on: place and velocity of a knot, velocity of the next."""
    base = first[:, None] * 2 * JOINTS
    return np.concatenate([base + np.arange(2 * JOINTS), base + 3 * JOINTS + np.arange(JOINTS)], axis=1)


def _blocks(J: FloatArray, rows: FloatArray) -> FloatArray:
    """``(T, m, 18)`` derivatives by a step's variables, of ``(T, m, 6)`` by its joints."""
    return np.concatenate([J * rows[:, None, k, None] for k in range(3)], axis=2)


def _rows(blocks: FloatArray, columns: Any, size: int) -> Any:
    steps, m, width = blocks.shape
    indices = np.repeat(columns[:, None, :], m, axis=1).ravel()
    pointers = np.arange(0, steps * m * width + 1, width)
    return sparse.csr_matrix((blocks.ravel(), indices, pointers), shape=(steps * m, size)).tocsc()


def _selection(before: int, count: int, total: int, sign: float) -> Any:
    rows = np.arange(count)
    return sparse.csc_matrix((np.full(count, sign), (rows, before + rows)), shape=(count, total))
