"""What one view adds to a contour fit: the normal equations of its edges and tips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from surgbench.camera.change_of_view import ChangeOfView, angle_rates
from surgbench.config import Positive, Section
from surgbench.contract import View
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.instrument import Instrument
from surgbench.silhouette import ContourPoints, KeypointProjector, SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION, STATE_SIZE, split_arms
from surgbench.trackers.registration.edges import (
    deviation,
    explained_lengths,
    find_edges,
    median_size,
    missed_lengths,
    normal_equations,
)
from surgbench.trackers.registration.part import PartView, shown_points
from surgbench.trackers.registration.parts import Parts
from surgbench.trackers.registration.shape import Shape

FEWEST_POINTS = 8
MEDIAN_TO_SD = 1.4826  # standard deviation over median of absolute deviations, of Gaussian numbers
MEMORY = 0.9  # of how wrong edges are, from frame to frame
TIP_WIDTH = 3.0  # standard deviations of a tip beyond which it counts ever less
SHOWS_PX = 5.0  # from a tip to the contour of its jaw, where the silhouette shows it
NARROWING = 0.6  # of the robust width, from one iteration to the next
EXPLAINED_PX = 2.0
JAW_PX = 3.0  # jaws of real instruments are thicker or thinner than ours by as much


class FitConfig(Section):
    """Options of the contour fit."""

    iterations: Annotated[int, Field(ge=1, description="Gauss-Newton steps at most")] = 6
    spacing_px: Annotated[int, Field(ge=1, description="rows and columns from one contour point to the next")] = 1
    reach_px: Annotated[int, Field(ge=1, description="how far edges are looked for")] = 14
    edge_px: Annotated[Positive, Field(description="standard deviation of an edge, for one pixel of contour")] = 1.5
    fits_px: Annotated[Positive, Field(description="spread of edges that fit: of the pixel grid, and a little")] = 0.45
    alike_px: Annotated[
        float, Field(ge=0, description="contour along which what they are wrong by beyond that is alike")
    ] = 200.0
    width_px: Annotated[Positive, Field(description="offsets beyond it count ever less (Geman-McClure)")] = 2.0
    offset_px: Annotated[Positive, Field(description="standard deviation of the offset common to all edges")] = 0.5
    tip_px: Annotated[Positive, Field(description="standard deviation of a tip keypoint")] = 3.0
    single_tips: Annotated[bool, Field(description="fit to a tip where the other was not found, too")] = False


# How wrong T_view_cam of a further view may be, and how much that changes from frame to frame: rotation vector and
# translation in that view's frame.
CALIBRATION = np.array([0.01, 0.01, 0.01, 3e-3, 3e-3, 3e-3])
CHANGE = np.array([5e-4, 5e-4, 5e-4, 1e-4, 1e-4, 1e-4])


class Equations(NamedTuple):
    """What a view says of a step of the state and of the shape.

    Attributes:
        information: ``(n + m, n + m)``, natural steps of the state and of the shape.
        pull: ``(n + m,)``: ``information @ step = pull``.
        explained_px: Length of the predicted contour that has an observed edge.
        length_px: Length of all of it.
    """

    information: FloatArray
    pull: FloatArray
    explained_px: float
    length_px: float


class ViewFit:
    """One view of a frame that a state is being fitted to.

    Beside the state it has unknowns of its own, which are eliminated: the offset common to all edges, and in a view
    that is not ``calibrated`` what its pose is wrong by. Without the latter an error of a millimetre there, several
    pixels, would be explained by an instrument that is somewhere else. It is much the same in all frames, and is
    learned.

    Args:
        instruments: One per arm.
        evaluator: Of the view's camera.
        scale: ``(n,)`` natural step of each component of the state.
        shape: What instruments and camera may be other in than declared, m unknowns.
        config: Options.
        calibrated: Whether the view is the frame that states are given in.

    Attributes:
        offset_px: Of all edges together: above 0 where the mask is dilated.
    """

    def __init__(
        self,
        instruments: Sequence[Instrument],
        evaluator: SilhouetteEvaluator,
        scale: FloatArray,
        shape: Shape,
        config: FitConfig,
        *,
        calibrated: bool,
    ) -> None:
        self._evaluator = evaluator
        self._projector = KeypointProjector(instruments, evaluator.camera)
        self._shape = shape
        self._size = len(scale) + len(shape.scale)
        self._parts = Parts(instruments)
        self._config = config
        self._calibrated = calibrated
        self._scale = np.concatenate([scale, shape.scale, *([] if calibrated else [CALIBRATION])])
        # What the pose is wrong by, in CALIBRATION's units: what is known before a frame, and after its first fit.
        self._known = self._learned = np.zeros(6), np.eye(6)
        # Variance of edges beyond that of edges that fit, px², of all edges and of the wrists': over the frames so far,
        # and in this one; NaN where unknown.
        self._excess: FloatArray = np.full(2, np.nan)
        self._seen_excess = self._excess

    def next_frame(self) -> None:
        """What was learned in the last frame is known in the next, but for what has changed since."""
        mean, information = self._learned
        self._known = mean, np.linalg.inv(np.linalg.inv(information) + np.diag((CHANGE / CALIBRATION) ** 2))

    def begin(self, view: View, *, tips: bool = True) -> None:
        """Begin a fit to a frame's view, with its tips or to its edges alone."""
        self._view = view
        self._with_tips = tips
        self.offset_px = 0.0
        self._width: float | None = None
        self._seen_excess = np.full(2, np.nan)
        self._place(np.zeros(0) if self._calibrated else self._known[0])

    def _place(self, pose: FloatArray) -> None:
        """Take the view's pose to be wrong by so much, ``(6,)`` in CALIBRATION's units."""
        self._pose = pose
        T_view_cam = self._view.T_view_cam
        if not self._calibrated:
            error = pose * CALIBRATION
            T_view_cam = rigid_transform(rotation_from_vector(error[:3]), error[3:]) @ T_view_cam
        self._change = ChangeOfView(T_view_cam)

    def equations(self, state: FloatArray, shape: FloatArray, spacing_px: int, *, shared: bool = False) -> Equations:
        """Linearise at ``state`` ``(n,)`` and ``shape`` ``(m,)``.

        With ``shared`` the offset, which edges of other arms have in common with these, is not eliminated: it is the
        last unknown, of which nothing is known but what these edges say.
        """
        config, n = self._config, self._size
        own = self._change.states(state)
        contour = self._evaluator.contour_points(own, spacing_px)
        if isinstance(self._view, PartView):
            contour = shown_points(contour, self._view.codes)
        grown = self._shape.jacobian(contour, own, self._evaluator.camera, reference=self._calibrated)
        contour = contour._replace(jacobian=self._jacobian(state, own, contour.jacobian, grown))
        A, b, explained_px, length_px = self._edges(contour, grown @ shape)
        self._add_tips(A, b, state, own)
        self._eliminated = []
        if shared:
            return Equations(A, b, explained_px, length_px)
        A[-1, -1] += 1.0 / config.offset_px**2
        if not self._calibrated:
            mean, information = self._known
            A[n:-1, n:-1] += information
            b[n:-1] += information @ (mean - self._pose)
        for k in range(len(b) - 1, n - 1, -1):
            self._eliminated.append((A[k, :k], b[k], A[k, k]))
            A, b = A[:k, :k] - np.outer(A[:k, k], A[k, :k]) / A[k, k], b[:k] - A[:k, k] * (b[k] / A[k, k])
            if k == n + len(self._pose):
                self._with_pose = A
        return Equations(A, b, explained_px, length_px)

    @property
    def misfit_px(self) -> float:
        """What edges were wrong by in the frames so far beyond the pixel grid and the offset common to all."""
        return float(np.sqrt(np.nan_to_num(self._excess[0])))

    def missed(self) -> tuple[FloatArray, FloatArray]:
        """Length of each link's contour, ``(arms, links)``, that had no edge in the last iteration; and all of it."""
        missed: tuple[FloatArray, FloatArray] = missed_lengths(*self._seen, self.offset_px, JAW_PX, self._parts.shape)
        return missed

    def follow(self, step: FloatArray) -> None:
        """Adjust the view's own unknowns to the ``(n + m,)`` step that all views together ask for.

        After equations with a shared offset that is the step's last component.
        """
        for row, right, pivot in reversed(self._eliminated):
            step = np.append(step, (right - row @ step) / pivot)
        self.offset_px = float(step[-1])
        if not self._calibrated:
            self._place(self._pose + step[self._size : -1])
        assert self._width is not None
        self._width = max(self._config.width_px, NARROWING * self._width)

    def learn(self, others: FloatArray) -> None:
        """Keep what this fit says of the view's edges and pose, for the frames to come.

        Args:
            others: ``(n + m, n + m)`` what is known of state and shape from elsewhere, natural steps.
        """
        before = _first_known(self._excess, self._seen_excess)
        self._excess = MEMORY * before + (1.0 - MEMORY) * _first_known(self._seen_excess, before)
        if self._calibrated:
            return
        A, n = self._with_pose, self._size
        about_state = np.linalg.solve(A[:n, :n] + others, A[:n, n:])
        self._learned = self._pose, A[n:, n:] - A[n:, :n] @ about_state

    def _jacobian(self, state: FloatArray, own: FloatArray, gradient: FloatArray, grown: FloatArray) -> FloatArray:
        """From derivatives ``(K, n)`` for the view's own state, ``(K, m)`` for the shape, to all but the offset's.

        The view's pose moves every point p of its frame by ``w x p + t``.
        """
        shared = np.concatenate([self._change.pull_back(state, gradient), grown], axis=1)
        if self._calibrated:
            return shared
        arms = gradient.reshape(len(gradient), gradient.shape[1] // STATE_SIZE, STATE_SIZE)
        places = split_arms(own)
        turned = np.einsum("kai,aij->kj", arms[..., ANGLES], angle_rates(places[:, ANGLES]))
        turned += np.cross(places[:, POSITION], arms[..., POSITION]).sum(axis=1)
        pose = np.concatenate([turned, arms[..., POSITION].sum(axis=1)], axis=1)
        return np.concatenate([shared, pose], axis=1)

    def _edges(self, contour: ContourPoints, grown_px: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Normal equations of the edges, and which length of the contour is explained, of which length.

        ``grown_px``, ``(K,)``, is by how much the contour lies further out than the modelled one.
        """
        config = self._config
        picture = self._view.codes if isinstance(self._view, PartView) else self._view.mask
        offsets = find_edges(contour, picture, config.reach_px) - grown_px
        self._seen = contour, offsets
        if np.count_nonzero(~np.isnan(offsets)) < FEWEST_POINTS:
            size = len(self._scale) + 1
            self._width = config.width_px
            return np.zeros((size, size)), np.zeros(size), 0.0, float(contour.lengths_px.sum())
        if self._width is None:
            self._width = max(config.width_px, 2.0 * MEDIAN_TO_SD * median_size(offsets))
        # What edges are wrong by beyond the pixel grid (the instrument is not quite this one, a segmentation cuts
        # corners) is much the same along a part: as if every pixel told of it anew, it would outvote all else. A real
        # wrist differs from the modelled one most of all, and on one side, and would bend the joints to it.
        wrist = self._parts.on_wrist(contour)
        self._seen_excess = np.array([self._excess_of(offsets), self._excess_of(offsets[wrist])])
        whole, wrists = _first_known(self._excess, self._seen_excess)
        variance = config.edge_px**2 + config.alike_px * np.where(wrist, np.fmax(whole, wrists), whole)
        A, b = normal_equations(
            offsets, contour._replace(lengths_px=contour.lengths_px / variance), self._scale, self._width
        )
        return A, b, *explained_lengths(contour, offsets, self.offset_px, EXPLAINED_PX)

    def _excess_of(self, offsets: FloatArray) -> float:
        """Variance of some edges beyond that of edges that fit, px²; NaN where there are few."""
        spread: float = MEDIAN_TO_SD * deviation(offsets, FEWEST_POINTS)
        return spread if np.isnan(spread) else max(spread**2 - self._config.fits_px**2, 0.0)

    def _add_tips(self, A: FloatArray, b: FloatArray, state: FloatArray, own: FloatArray) -> None:
        """Add the tips' part to the normal equations, in place."""
        sd = self._config.tip_px
        if not self._with_tips:
            return
        size = len(self._scale)
        found = self._view.tips if self._config.single_tips else self._view.keypoints
        seen = [(arm, tips) for arm, tips in enumerate(found) if tips is not None]
        if not seen:
            return
        projected = self._projector.project(own[None])[0]
        for arm, tips in seen:
            off, share = _offsets(tips, projected[arm], TIP_WIDTH * sd)
            if not np.isfinite(off).all():  # behind the camera
                continue
            forces = np.zeros((4, len(projected), 2, 2))
            forces[:, arm] = np.eye(4).reshape(4, 2, 2)
            gradient = self._projector.pull_back(np.tile(own, (4, 1)), forces)
            # Of the jaws' length no tip is asked: a detector is wrong by more.
            J = self._jacobian(state, own, gradient, np.zeros((4, len(self._shape.scale)))) * self._scale
            distance = np.linalg.norm(off, axis=1).repeat(2)
            share = share * self._parts.shows(self._seen[0], arm, projected[arm], SHOWS_PX)
            weight = share.repeat(2) / (sd * (1.0 + (distance / (TIP_WIDTH * sd)) ** 2)) ** 2
            A[:size, :size] += (J * weight[:, None]).T @ J
            b[:size] += (J * weight[:, None]).T @ off.reshape(4)


def _first_known(values: FloatArray, others: FloatArray) -> FloatArray:
    return np.where(np.isnan(values), others, values)


def _offsets(seen: FloatArray, projected: FloatArray, width_px: float) -> tuple[FloatArray, FloatArray]:
    """How far each projected tip is from what was seen of it, ``(2, 2)``, and how much that counts, ``(2,)``.

    Two seen tips go with the projected ones in the nearer way round. A single one may be either: it goes with the
    nearer, and counts by how much likelier it is that one; nothing where both lie alike, for drawing both would close
    the jaws.

    The loss's ``KeypointTerm`` chooses too, but by lengths beyond a tolerance, in the form of a publication, and with a
    single tip takes the nearer alone: where tips lie close together it chooses otherwise. What is nearer here is what
    the fit minimises, squares.
    """
    if len(seen) == 1:
        off = seen - projected
        squares = (off**2).sum(axis=1)
        likely = np.exp((squares.min() - squares) / (2.0 * width_px**2))
        share = likely / likely.sum()
        return off, np.maximum(share - share[::-1], 0.0)
    off = min((seen - projected, seen[::-1] - projected), key=lambda way: float((way**2).sum()))
    return off, np.ones(2)
