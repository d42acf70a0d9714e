"""A path on one side, a value of `images.py` on the other."""
