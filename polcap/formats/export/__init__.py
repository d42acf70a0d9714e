"""Assets for other programs: glTF, OBJ, USD, MaterialX, layered EXR."""
