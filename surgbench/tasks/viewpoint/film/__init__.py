"""Films of viewpoint runs: the scene in space, what both eyes see, and errors and rules over time."""
