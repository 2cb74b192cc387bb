"""What is believed of the state before a frame is seen: constant velocity, Gaussian, all components together.

Unlike the engine's filters, whose output only starts the next search, this belief takes part in the estimate: where
a silhouette says little about a direction of the state, the motion so far decides. Joint readings enter it with a
bias of their own, which changes slowly and is learned from the masks; so do what instruments and camera are other in
than declared (:mod:`surgbench.trackers.registration.shape`), which no frame tells alone.
"""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, wrap_angle
from surgbench.state import JOINTS, POSITION, STATE_SIZE
from surgbench.timing import carried_s
from surgbench.trackers.registration.fit import Prior

NO_SHAPE = np.zeros(0)
FALLS = 2.0
SHAPE_DRIFT = 0.001  # natural steps a frame: instrument and camera stay what they are


class MotionBelief:
    """Gaussian over values, velocities, the readings' biases and the shape, in natural steps.

    Args:
        scale: ``(n,)`` natural step of each component; n is 9 per arm.
        dt_s: Seconds between frames, as a rule.
        acceleration: ``(n,)`` standard deviation of the acceleration, constant over a frame, per s².
        velocity: ``(n,)`` standard deviation of the velocities at the beginning, per s.
        bias_rad: Standard deviation of the readings' biases.
        bias_drift_rad: How much they change from frame to frame.
        shape_scale: ``(m,)`` natural step of each unknown of the shape, its standard deviation before the first
            frame; none unless told.
        settling_s: ``(n,)`` seconds in which a velocity that no frame tells of falls to 1/e; it stays unless told.
    """

    def __init__(
        self,
        scale: FloatArray,
        dt_s: float,
        acceleration: FloatArray,
        velocity: FloatArray,
        bias_rad: float,
        bias_drift_rad: float,
        shape_scale: FloatArray = NO_SHAPE,
        settling_s: FloatArray | float = np.inf,
    ) -> None:
        n = len(scale)
        self._scale = scale
        self._velocity_variance = (velocity / scale) ** 2
        joints = np.arange(n).reshape(-1, STATE_SIZE)[:, JOINTS].ravel()
        self._joints = joints
        self._biases = 2 * n + np.arange(len(joints))
        size = 2 * n + len(joints) + len(shape_scale)
        # Of what a frame tells directly: the values and the shape.
        self._told = np.concatenate([np.arange(n), np.arange(size - len(shape_scale), size)])
        self._told_scale = np.concatenate([scale, shape_scale])
        self._dt_s = dt_s
        self._settling_s = settling_s
        self._pushes = np.diag((acceleration / scale) ** 2)
        self._drift = np.zeros(size)  # variance of a frame, of what changes slowly
        self._drift[self._biases] = (bias_drift_rad / scale[joints]) ** 2
        self._drift[self._told[n:]] = SHAPE_DRIFT**2
        self._regular = self._motion(dt_s)
        is_angle = np.ones(STATE_SIZE, dtype=bool)
        is_angle[POSITION] = False
        self._is_angle = np.resize(is_angle, n)
        self._mean: FloatArray = np.zeros(size)
        self._covariance: FloatArray = np.eye(size)
        self._covariance[self._biases, self._biases] = (bias_rad / scale[joints]) ** 2

    def restart(self, state: FloatArray, spread: FloatArray, velocity: FloatArray | None = None) -> None:
        """Begin again at rest at ``state``, known to ``spread``; biases and shape stay.

        Args:
            state: ``(n,)``.
            spread: ``(n,)`` standard deviations.
            velocity: ``(n,)`` those of velocities, per s, where they are not those at the beginning.
        """
        n = len(self._scale)
        self._mean[: 2 * n] = np.concatenate([state / self._scale, np.zeros(n)])
        self._covariance[: 2 * n, :] = self._covariance[:, : 2 * n] = 0.0
        velocities = self._velocity_variance if velocity is None else (velocity / self._scale) ** 2
        variance = np.concatenate([(spread / self._scale) ** 2, velocities])
        self._covariance[: 2 * n, : 2 * n] = np.diag(variance)

    @property
    def state(self) -> FloatArray:
        """``(n,)`` mean of the values, as a state."""
        return self._mean[: len(self._scale)] * self._scale

    @property
    def covariance(self) -> FloatArray:
        """``(n, n)`` of the values, natural steps."""
        n = len(self._scale)
        return self._covariance[:n, :n]

    @property
    def prior(self) -> Prior:
        """What is believed of values and shape."""
        among = np.ix_(self._told, self._told)
        return Prior(self._mean[self._told] * self._told_scale, np.linalg.inv(self._covariance[among]))

    def prior_at(self, state: FloatArray, information: FloatArray) -> Prior:
        """What is believed of the shape, and of the values another story: mean ``(n,)``, ``(n, n)`` information."""
        n = len(self._scale)
        own = self.prior
        both = np.zeros_like(own.information)
        shape = self._told[n:]
        both[:n, :n] = information
        both[n:, n:] = np.linalg.inv(self._covariance[np.ix_(shape, shape)])
        return Prior(np.concatenate([state, own.mean[n:]]), both)

    @property
    def shape(self) -> FloatArray:
        """``(m,)`` mean of the shape."""
        n = len(self._scale)
        return np.asarray(self._mean[self._told[n:]] * self._told_scale[n:])

    @property
    def departure(self) -> float:
        """How far the shape is known to be off the declared one: root mean square over its unknowns, natural steps."""
        shape = self._told[len(self._scale) :]
        beyond = self._mean[shape] ** 2 - np.diag(self._covariance)[shape]
        return float(np.sqrt(max(beyond.mean(), 0.0))) if len(shape) else 0.0

    def predict(self, step_s: float | None = None) -> None:
        """Advance to the next frame, which is ``step_s`` seconds away, or as far as frames are unless told."""
        step_s = self._dt_s if step_s is None else step_s
        transition, process = self._regular if step_s == self._dt_s else self._motion(step_s)
        self._mean = transition @ self._mean
        self._covariance = transition @ self._covariance @ transition.T + process

    def _motion(self, step_s: float) -> tuple[FloatArray, FloatArray]:
        """Transition and process noise of a step, ``(size, size)`` each."""
        n, size = len(self._scale), len(self._drift)
        transition = np.eye(size)
        transition[:n, n : 2 * n] = carried_s(step_s, self._dt_s) * np.eye(n)
        transition[n : 2 * n, n : 2 * n] = np.exp(-step_s / self._settling_s) * np.eye(n)
        # An acceleration a that is constant over a frame moves the value by a dt²/2 and the velocity by a dt.
        push = np.array([[step_s**4 / 4, step_s**3 / 2], [step_s**3 / 2, step_s**2]])
        process = np.zeros((size, size))
        process[: 2 * n, : 2 * n] = np.kron(push, self._pushes)
        slow = np.flatnonzero(self._drift)
        process[slow, slow] = self._drift[slow] * (step_s / self._dt_s)
        return transition, process

    def stand_still(self) -> None:
        """Nothing was seen: no velocity is to carry the state away."""
        n = len(self._scale)
        self._mean[n : 2 * n] = 0.0

    def slow(self, fastest: FloatArray) -> None:
        """No velocity is larger than ``(n,)``, per s."""
        n = len(self._scale)
        most = fastest / self._scale
        self._mean[n : 2 * n] = np.clip(self._mean[n : 2 * n], -most, most)

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count, n)`` states as likely as they are believed to be."""
        root = np.linalg.cholesky(self.covariance)
        return np.asarray(self.state + rng.standard_normal((count, len(root))) @ root.T * self._scale)

    def settle(self, kept: float) -> None:
        """Velocities fall to a share of what they are, and what is not known of them tends to that at the beginning.

        Whether they fall so, sooner or later is as unknown, too: by ``FALLS`` times as much as they fall.
        """
        n = len(self._scale)
        velocities = slice(n, 2 * n)
        falls = FALLS * (1.0 - kept) * self._mean[velocities]
        self._mean[velocities] *= kept
        self._covariance[velocities] *= kept
        self._covariance[:, velocities] *= kept
        self._covariance[velocities, velocities] += np.diag((1.0 - kept**2) * self._velocity_variance + falls**2)

    def near(self, state: FloatArray) -> FloatArray:
        """The same state with each angle turned by full turns to lie nearest to the mean."""
        turned = np.array(state, dtype=np.float64)
        mean, angles = self.state, self._is_angle
        turned[angles] = mean[angles] + wrap_angle(turned[angles] - mean[angles])
        return turned

    def read_joints(self, readings_rad: FloatArray, noise_rad: float) -> None:
        """Take in joint readings, ``(3 * arms,)``, which are joint plus bias plus white noise."""
        scale = self._scale[self._joints]
        observe = np.zeros((len(self._joints), len(self._mean)))
        rows = np.arange(len(self._joints))
        observe[rows, self._joints] = observe[rows, self._biases] = 1.0
        across = self._covariance @ observe.T
        spread = observe @ across + np.diag((noise_rad / scale) ** 2)
        gain = np.linalg.solve(spread, across.T).T
        self._mean = self._mean + gain @ (readings_rad / scale - observe @ self._mean)
        self._settle(self._covariance - gain @ across.T)

    def update(self, state: FloatArray, shape: FloatArray, information: FloatArray) -> None:
        """Take in an estimate that already is a compromise between this belief and a frame.

        Args:
            state: ``(n,)`` the compromise, the mode of the posterior; it becomes the mean of the values.
            shape: ``(m,)`` likewise.
            information: ``(n + m, n + m)`` what the frame alone says, natural steps: the inverse of its covariance.
        """
        told = self._told
        column = self._covariance[:, told].copy()
        own = column[told]
        # Kalman's gain for H = [1 0] in information form: (H P H' + R)⁻¹ = I (1 + P I)⁻¹ with I = R⁻¹.
        inner = information @ np.linalg.inv(np.eye(len(told)) + own @ information)
        # What is correlated with the values follows them.
        shift = np.concatenate([self.near(state), shape]) / self._told_scale - self._mean[told]
        self._mean = self._mean + column @ np.linalg.solve(own, shift)
        self._settle(self._covariance - column @ inner @ column.T)

    def _settle(self, covariance: FloatArray) -> None:
        self._covariance = (covariance + covariance.T) / 2
