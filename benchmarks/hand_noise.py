"""The one constant of the simulated hand that is fitted: how exactly it sees edges.

    python benchmarks/hand_noise.py data/wire-chaser --noise 0.05 --noise 0.1

Hands lead the ring by the endoscope's picture alone, on wires that no table has; shown is the share of time in which
ring and wire touch. In the article's ENDO it is 22.08 s of 79.82 s, 28 %.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from surgbench.dataset.open import open_as
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.hand.operation import Operating
from surgbench.viewpoint.hand.performance import performance
from surgbench.viewpoint.hand.person import People, draw_person
from surgbench.viewpoint.simulator import make_scene

WIRES, PEOPLE = ("001", "002", "003"), 4
MEASURES = ("task_time_s", "contact_s", "collisions", "unseen_percent")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--noise", type=float, action="append", help="pixels of the console; may be given again")
    arguments = parser.parse_args()
    dataset = open_as(ViewpointDataset, arguments.dataset)
    for noise in arguments.noise or [People().noise_px[0]]:
        people = People().model_copy(update={"noise_px": (noise, 0.2 * noise)})
        found = [lead(dataset, wire, number, people) for wire in WIRES for number in range(PEOPLE)]
        time, contact, collisions, unseen = np.mean(found, axis=0)
        print(
            f"{noise:5.3f} px: touch {100 * contact / time:3.0f} % of the time ({contact:.1f} of {time:.1f} s), "
            f"{collisions:.1f} collisions; the ring is hidden {unseen:.0f} % of the time"
        )


def lead(dataset: ViewpointDataset, wire: str, number: int, people: People) -> list[float]:
    """What one hand does on one wire."""
    trial = dataset.trial(wire)
    person = draw_person(people, generator(seed=0, person=number, purpose="who"))
    operation = Operating(
        create(find("tracker", "static"), {}),
        trial,
        make_scene(trial),
        "endoscope",
        person,
        generator(purpose="controller"),
        generator(wire=wire, person=number, purpose="noise"),
    ).run()
    values = performance(operation, trial.dt_s)
    return [values[name] for name in MEASURES]


if __name__ == "__main__":
    main()
