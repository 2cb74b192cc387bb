"""Names of what is measured of a hand's work."""

from __future__ import annotations

# Of Fig. 7: completion time, number of collisions, total time in contact, mean duration of a contact; and ours: the
# ring's way, the share of time in which no picture that was shown had the ring in it and before the tool, how often the
# view was taken anew, and whether the ring did not come back in time.
PERFORMANCE = (
    "task_time_s",
    "collisions",
    "contact_s",
    "mean_contact_s",
    "path_m",
    "unseen_percent",
    "views_taken",
    "unfinished",
)
