"""Synthetic captures.

Renders random shapes, materials and light through a simulated camera, and writes a capture folder.
"""
