"""Synthetic captures: renders random scenes through a simulated camera, and writes capture folders with the truth."""
