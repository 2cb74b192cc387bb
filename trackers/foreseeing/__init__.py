"""The optimum in hindsight: a camera's course over a whole trial by sequential quadratic programming."""
