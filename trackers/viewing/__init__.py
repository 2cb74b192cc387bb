"""Parts of the controller `gaze`: goals, the way to them, what a step may do, and how the feature goes on."""
