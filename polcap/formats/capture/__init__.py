"""Capture folders: which photograph was taken at which angle, and with which camera.

reader            reads a folder as a `Capture`, and prints it as a table
folder_names      what folders hold, by their names
layouts           the four layouts of a folder: angle folders, capture.toml, flat, polarization sensor
photograph_files  probes the files of one folder
foreign_files     names of files of other programs, which all commands ignore
capture_toml      the keys of capture.toml
angle_advice      how the user corrects stated angles
focal_length      focal length in pixels, from EXIF or as stated
arrivals          waits until a folder that is being filled stops changing
"""
