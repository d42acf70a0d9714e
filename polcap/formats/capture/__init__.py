"""Folders of photographs: layouts, stated facts, arrivals."""
