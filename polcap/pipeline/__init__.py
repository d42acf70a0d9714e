"""Runs the path of stages for one capture: order of the stages, stage cache, result folder, exports and checks."""
