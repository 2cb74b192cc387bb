"""The state of one or two instruments in every frame of a mask sequence."""
