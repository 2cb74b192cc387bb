"""What makes datasets: trajectories, masks rendered with Mitsuba, their corruption, keypoints and joint readings."""
