"""Several captures of one object, turned on a board before a fixed camera, joined into one closed, relightable mesh."""
