"""What trainings of networks share: the course of one, what it keeps, and weights on disk."""
