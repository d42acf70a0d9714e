"""Photographs: RAW files and finished pictures, decoded in the sandbox.

probe         kind, digest, EXIF and size of a file, without its pixels
libraw        sensor counts of a RAW file
photo         linear values of a TIFF, PNG, EXR or JPEG
exif          camera settings from the metadata of every maker
file_kind     RAW, picture or other, by the first bytes; the directories of a TIFF
file_checks   refuses files that are cut, stripped or wrongly decoded
file_bytes    the bytes of a file, read once, and their digest
dng           the writer of DNGs under the name that users' scripts know
"""
