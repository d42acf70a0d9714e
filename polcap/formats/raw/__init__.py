"""Photographs: RAW files and finished pictures, decoded in a child process."""
