"""Corrections of estimated normals by the shape of the whole object.

half_turns          180° ambiguity: to which side of the view ray normals lean
integrable_normals  normals of one surface: integrability
planar_faces        planes: their side by the light of the flash, and their even normals
"""
