"""Reads and writes files; frozen dataclasses go in and out.

raw/            photographs, decoded in the sandbox
capture/        folders of photographs
maps/           the folder maps/ of a result
export/         assets for other programs
html/           the report's page
sandbox         child processes that read untrusted files, with limits on time and memory
dng_writer      a mosaic as a DNG
onnx            opens and runs networks
calibrations    measurements of the user
ball_accuracies errors of the normals of the user's ball
chart_file      measured color charts
board_print     the board to print
color_profile   color matrix of a chart, for captures without one
shipped_data    data that ship with polcap
scene_files     meshes and texture sets for synthetic scenes
npy_folder      a value as JSON and arrays in a folder
atomic          files and folders, complete or not at all
own_files       record of the files that polcap wrote
system_errors   errors while writing, in words
text_file       TOML and JSON of any origin
own_folders     names of polcap's folders
folder_lock     one process at a time in a folder
addresses       percent-encoded links
"""
