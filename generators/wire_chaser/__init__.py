"""The generator of the viewpoint task: a ring that is led along a bent wire and back."""
