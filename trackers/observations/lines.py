"""The shaft's two edges as a feature of particles, whatever picture they are found in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field

from surgbench.camera import Camera
from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.trackers.observations.edges import Gate, expected_edges
from surgbench.trackers.observations.likelihood import association_likelihood, line_costs
from surgbench.trackers.observations.lumped_error import Particles
from surgbench.trackers.observations.shaft import cylinder_edges, shaft_of

# Finds edges near the expected ones: expected edges, end points of the axis and gate, as `detect_edges` takes them.
Detect = Callable[[FloatArray, FloatArray, Gate], FloatArray]


class LineConfig(Section):
    """Options of the shaft's edges; where the publication or its code gives a value, it is the default."""

    shaft: Annotated[bool, Field(description="observe the two edges of the shaft")] = True
    rho_rate: Annotated[NotNegative, Field(description="gamma of the edges' offsets, per pixel")] = 0.05
    theta_rate: Annotated[NotNegative, Field(description="gamma of the edges' directions, per radian")] = 7.5
    rho_threshold_px: Annotated[Positive, Field(description="with the next: edges farther apart are no pair")] = 75.0
    theta_threshold_rad: Annotated[Positive, Field(description="see rho_threshold_px")] = 0.5
    gate_px: Annotated[Positive, Field(description="edges are sought so far from the expected ones")] = 40.0
    gate_rad: Annotated[Positive, Field(le=0.5, description="and turned by so much")] = 0.2
    edge_points: Annotated[int, Field(ge=3, description="rows or columns in which an edge must show")] = 20


class ShaftLines:
    """Weighs the particles of one arm by the edges of its shaft.

    Args:
        config: Options.
        instrument: Of the arm.

    Attributes:
        expected: Edges that were last expected, ``(2, 3)``.
        found: Edges that were last found, ``(0 to 2, 3)``.
    """

    def __init__(self, config: LineConfig, instrument: Instrument) -> None:
        self._config = config
        self._shaft = shaft_of(instrument)
        self._gate = Gate(config.gate_px, config.gate_rad, config.edge_points)
        self.expected = self.found = np.empty((0, 3))

    def likelihood(self, particles: Particles, camera: Camera, detect: Detect) -> FloatArray | None:
        """``(n,)`` up to a factor; ``None`` where no edge is found, which says nothing.

        Args:
            particles: In the camera's frame.
            camera: Intrinsics.
            detect: Finds the edges.
        """
        config, shaft = self._config, self._shaft
        middle = particles.mean_rotation, particles.weights @ particles.translations_m
        self.expected, span_px = expected_edges(*middle, shaft, camera)
        self.found = detect(self.expected, span_px, self._gate)
        if not len(self.found):
            return None
        axis = particles.rotations[:, :, :2] @ shaft.axis_m + particles.translations_m
        edges = cylinder_edges(axis, particles.rotations[:, :, 2], shaft.radius_m, camera)
        origin = _middle_of_image_part(span_px, camera)
        costs = line_costs(_about(edges, origin), _about(self.found, origin), config.rho_rate, config.theta_rate)
        threshold = config.rho_rate * config.rho_threshold_px + config.theta_rate * config.theta_threshold_rad
        likelihood: FloatArray = association_likelihood(costs, threshold)
        return likelihood


def _middle_of_image_part(span_px: FloatArray, camera: Camera) -> FloatArray:
    """Middle of that part of the shaft's expected axis which lies in the image, roughly: clamped end points."""
    corner = np.array([camera.width - 1.0, camera.height - 1.0])
    middle: FloatArray = np.clip(span_px, 0.0, corner).mean(axis=0)
    return middle


def _about(lines: FloatArray, origin_px: FloatArray) -> FloatArray:
    """The same lines with rho measured from another origin."""
    moved = lines.copy()
    moved[..., 2] -= lines[..., :2] @ origin_px
    return moved
