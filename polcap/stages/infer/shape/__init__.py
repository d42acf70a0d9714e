"""Corrections of estimated normals by the shape of the whole object.

half_turns          the side of the ray to which each region leans
integrable_normals  normals of one surface
planar_faces        faces that are planes, and their side by the light of the flash
"""
