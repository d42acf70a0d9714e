"""The folder maps/ of a result.

maps_folder   writes and reads the folder
map_files     the content of each file
exr           OpenEXR files of named channels
png           PNG files of 8 or 16 bits
"""
