"""Parts of the controller `gaze`: the whole-pose fit, the joints' chase of it, and the prediction of the feature."""
