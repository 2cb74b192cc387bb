"""What is measured of a hand's work, as in the article's Fig. 7, and what explains it."""

from __future__ import annotations

import numpy as np

from surgbench.viewpoint.hand.contact import lasting_contacts
from surgbench.viewpoint.hand.measures import PERFORMANCE
from surgbench.viewpoint.hand.operation import BEHIND_TOOL, NOTHING, Operation

# A contact ends when ring and wire are this far apart; shorter ones, and shorter gaps between them, do not count. As
# the generator of wire chasers has it; the article measured electrically, and says nothing of either.
RELEASE_M, SHORTEST_S = 0.0002, 0.1


def performance(operation: Operation, dt_s: float) -> dict[str, float]:
    """All of :data:`PERFORMANCE`; NaN for what is not there, and for everything where the clock never started.

    A ring that did not come back has the time at which it was broken off.
    """
    count = len(operation.pressed_m)
    end = count if operation.ended is None else operation.ended + 1
    during = slice(operation.begun, end)
    if end <= operation.begun:
        return dict.fromkeys(PERFORMANCE, float("nan"))
    contact = lasting_contacts(operation.pressed_m[during], dt_s, RELEASE_M, SHORTEST_S)
    collisions = int((np.diff(contact.astype(int), prepend=0) == 1).sum())
    contact_s = float(contact.sum()) * dt_s
    assert operation.trial.truth is not None
    way = operation.trial.truth.T_world_feature[during, :3, 3]
    return {
        "task_time_s": (end - operation.begun) * dt_s,
        "collisions": float(collisions),
        "contact_s": contact_s,
        "mean_contact_s": contact_s / collisions if collisions else float("nan"),
        "path_m": float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        "unseen_percent": 100.0 * float(np.isin(operation.sight[during], (NOTHING, BEHIND_TOOL)).mean()),
        "views_taken": float(operation.retaken[during].sum()),
        "unfinished": float(operation.ended is None),
    }
