"""The lumped-error particle filter on images of painted instruments, as Richter et al. (arXiv 2102.06235) use it.

Features are the instrument's painted markers, each of which is told by its colour, so that no pairs are to be found,
and the two edges of the shaft. Both are looked for in images; masks play no part. See
:mod:`surgbench.trackers.particle_filter` for the model.

- A marker's place is not the middle of the paint but of what shows of it: of spots that are seen from the side, or that
  go round an edge, the two differ.
- A marker that is not found costs all particles the same; whether a particle would hide it is not asked.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.config import Positive
from surgbench.contract import Estimate, Observation, Scene, View
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.instrument.spec import LinkPoint
from surgbench.silhouette import KeypointProjector
from surgbench.trackers.observations.image_edges import detect_image_edges
from surgbench.trackers.observations.likelihood import identified_likelihood
from surgbench.trackers.observations.lines import LineConfig, ShaftLines
from surgbench.trackers.observations.lumped_error import CloudConfig, Features, Particles
from surgbench.trackers.observations.markers import MarkerConfig, MarkerFinder
from surgbench.trackers.observations.patches import Patches, Shown
from surgbench.trackers.particle_filter import ParticleFilterTracker


class MarkerFilterConfig(CloudConfig, LineConfig, MarkerConfig):
    """Options; where the publication or its code gives a value, it is the default."""

    marker_rate: Annotated[Positive, Field(description="gamma of the markers, per pixel")] = 0.15
    marker_threshold_px: Annotated[Positive, Field(description="markers farther apart are no pair")] = 20.0


class ImageFeatures:
    """The painted markers, and the edges of the shaft in the image.

    Args:
        config: Options.
        scene: Instruments and cameras.
        arm: Which.

    Attributes:
        found: ``(P, 2)`` markers that were last found in each view; NaN for those that were not.
        sought: ``(P,)`` whether they should show, in each view.
        finders: Of each view.
        lines: Of each view; ``None`` unless the shaft is observed.
    """

    def __init__(self, config: MarkerFilterConfig, scene: Scene, arm: int) -> None:
        self._config = config
        self._instrument = instrument = scene.instruments[arm]
        patches = Patches(instrument)
        self.finders = [MarkerFinder(instrument, view.camera, config, patches) for view in scene.views]
        self.lines = [ShaftLines(config, instrument) for _ in scene.views] if config.shaft else None
        count, views = len(instrument.spec.markers), len(scene.views)
        self.found: list[FloatArray] = [np.full((count, 2), np.nan)] * views
        self.sought: list[NDArray[np.bool_]] = [np.zeros(count, dtype=bool)] * views

    def likelihood(self, index: int, view: View, particles: Particles) -> FloatArray:
        """See :class:`~surgbench.trackers.observations.lumped_error.Features`."""
        config, finder = self._config, self.finders[index]
        image = view.image()
        if image is None:
            raise ConfigError(NEEDS_IMAGES)
        self.found[index], shown = finder.find(image, particles.mean_state)
        self.sought[index] = shown.sought
        likelihood = np.ones(len(particles.weights))
        seen = np.isfinite(self.found[index][:, 0])
        if seen.any():
            projected = self._projector(view, shown, seen).project(particles.states)[:, 0]
            threshold = config.marker_rate * config.marker_threshold_px
            likelihood = identified_likelihood(projected, self.found[index][seen], config.marker_rate, threshold)
        if self.lines is not None:
            radii = np.sqrt(shown.areas_px / np.pi)
            detect = partial(detect_image_edges, image, shown.places_px, radii)
            edges = self.lines[index].likelihood(particles, view.camera, detect)
            if edges is not None:
                likelihood = likelihood * edges
        return likelihood

    @property
    def share_found(self) -> float:
        """Of the markers that should have shown in the last frame, how many were found, over all views."""
        found = sum(int(np.isfinite(places[:, 0]).sum()) for places in self.found)
        return found / max(sum(int(sought.sum()) for sought in self.sought), 1)

    @property
    def blind(self) -> bool:
        """Whether the last frame showed nothing of the instrument, neither markers nor edges."""
        edges = [] if self.lines is None else [lines.found for lines in self.lines]
        return self.share_found == 0.0 and not any(len(found) for found in edges)

    def _projector(self, view: View, shown: Shown, seen: NDArray[np.bool_]) -> KeypointProjector:
        """Of the middles of what shows of the markers that were found."""
        markers = np.array(self._instrument.spec.markers, dtype=object)[seen]
        points = [
            LinkPoint.model_construct(link=marker.point.link, point_m=tuple(place.tolist()))
            for marker, place in zip(markers, shown.points_m[seen], strict=True)
        ]
        return KeypointProjector([self._instrument], view.camera, [points])


class MarkerFilterTracker(ParticleFilterTracker):
    """Tracks what calibration and readings together are wrong by, from painted markers and the shaft's two edges.

    Attributes:
        features: Of each arm, as of the last frame.
    """

    name: ClassVar[str] = "particle-filter-markers"
    summary: ClassVar[str] = "the same on images of painted instruments; needs kinematics, readings, images and markers"
    reads_images: ClassVar[bool] = True

    Config: ClassVar[type[Any]] = MarkerFilterConfig

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Spread the particles of each arm around ``state``.

        Raises:
            ConfigError: The dataset has no kinematics, or an instrument no markers or no shaft.
        """
        for instrument in scene.instruments:
            if not instrument.spec.markers:
                raise ConfigError(NEEDS_MARKERS.format(instrument.name))
        self.features = [ImageFeatures(self.config, scene, arm) for arm in range(scene.arms)]
        super().reset(scene, state, rng)

    def _features(self, scene: Scene, arm: int) -> Features:
        return self.features[arm]

    def _estimate(self, state: FloatArray, observation: Observation) -> Estimate:
        confidence = np.array([one.share_found for one in self.features])
        return Estimate(state, confidence, lost=np.array([one.blind for one in self.features]))


NEEDS_IMAGES = (
    "particle-filter-markers needs images in every frame and view: a dataset of the preset 'markers', or alike"
)
NEEDS_MARKERS = (
    "particle-filter-markers needs painted instruments, and the file of instrument '{}' lists no 'markers': a dataset "
    "of the preset 'markers', or alike"
)
