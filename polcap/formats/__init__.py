"""Reads and writes files; values of `images.py` go in and out.

raw/            photographs, decoded in a child process
capture/        folders of photographs
maps/           the folder maps/ of a result
export/         assets for other programs
html/           the report's page
onnx            opens and runs networks
calibrations    measurements of the user
color_profile   color matrix of a chart, for captures without one
shipped_data    data that ship with polcap
scene_files     meshes and texture sets for synthetic scenes
npy_folder      a value as JSON and arrays in a folder
atomic          files and folders, complete or not at all
text_file       TOML and JSON of any origin
own_folders     names of polcap's folders
folder_lock     one process at a time in a folder
addresses       percent-encoded links
"""
