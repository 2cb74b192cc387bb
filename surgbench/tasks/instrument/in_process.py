"""A run in this process and without a record, for those who look at a tracker's answers themselves."""

from __future__ import annotations

from collections.abc import Iterator

from surgbench.suite.settings import Job
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.execute import child_setup, first_truth, true_states, unit_data
from surgbench.tasks.instrument.worker import Answer, Loop, waiting


def answers(job: Job, dataset: InstrumentDataset) -> Iterator[Answer]:
    """What a job's tracker answers, frame by frame, with the seeds that a recorded run has.

    Nothing where no mask shows an instrument.

    Args:
        job: What is run.
        dataset: On what.
    """
    data = unit_data(job, dataset)
    first = data.first_seen(job.frames)
    loop = Loop(child_setup(job, data, first or 0))
    state = None
    for frame in range(job.frames if first is None else first, job.frames):
        observation = data.observation(frame)
        if state is None:
            state = loop.initialise(observation, first_truth(job, data, frame), lambda _: None)
            if state is None:
                continue
            loop.begin(observation, state, true_states(job, data, frame))
            yield from [waiting(state)] * frame
        yield loop.step(observation)
