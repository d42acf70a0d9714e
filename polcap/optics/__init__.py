"""Physics and image mathematics used by two rooms or more; NumPy or torch arrays alike where noted."""
