"""Options of the tracker ``hybrid``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.objective import LossWeights
from surgbench.trackers.registration.fit import FitConfig


class HybridOptions(Section):
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
