"""What trackers of a kind have in common: bases to build on, nothing that the contract asks for."""
