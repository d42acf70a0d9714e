"""Physics and image mathematics that several packages use; NumPy or torch arrays alike where stated."""
