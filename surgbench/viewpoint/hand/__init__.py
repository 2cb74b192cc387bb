"""A simulated hand that leads the ring along the wire by what a camera shows of it, through teleoperation."""
