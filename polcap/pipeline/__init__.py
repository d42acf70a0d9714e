"""One run: the path, its cache, the result folder around it."""
