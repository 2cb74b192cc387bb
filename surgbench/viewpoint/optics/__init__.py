"""What cameras of the viewpoint task see: stereo pictures, markers, calibration, the console's view."""
