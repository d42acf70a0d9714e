"""The folder maps/ of a result, and the EXR and PNG files in it."""
