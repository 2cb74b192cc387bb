"""A camera-holding arm that keeps a moving feature in view."""
