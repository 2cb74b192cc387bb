"""Columns by which work of simulated hands is read."""

from __future__ import annotations

from surgbench.report.column import Column

TASK_TIME = Column("task_time_s", "task time", "s", 1, short="task\ntime s")
COLLISIONS = Column("collisions", "collisions", "", 1, short="hits")
CONTACT = Column("contact_s", "in contact", "s", 1, short="touch\ns")
MEAN_CONTACT = Column("mean_contact_s", "a contact", "s", 2)
PATH = Column("path_m", "way", "mm", 0, 1e3)
UNSEEN = Column("unseen_percent", "unseen", "%", 1)
VIEWS = Column("views_taken", "views taken", "", 0)
UNFINISHED = Column("unfinished", "unfinished", short="not\ndone")
# Those of the article's Fig. 7, and the ring's way.
MEASURES = (TASK_TIME, COLLISIONS, CONTACT, MEAN_CONTACT, PATH)
# In the leaderboard.
HAND_SHOWN = (TASK_TIME, UNFINISHED, COLLISIONS, CONTACT)
