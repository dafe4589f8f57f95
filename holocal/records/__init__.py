"""Frozen data and their files.

==============  ==========================================================
facts           what a rig says of itself: panel, camera, wavelengths
plugins         what entry points offer; a broken one stops nothing
rig             a rig's file: found, typed, fingerprinted
rig_model       the simulated rig's file: every key with its range
fault_model     what is to go wrong on a simulated rig
tolerance_model what a bench may be off, and what its image must meet
journal         finished pieces of work, a checked line each
safety          what no run may exceed
validate        pydantic's complaints as errors that name file and key
files           atomic writes, JSON, TOML
reading         files that a user names: size checked, errors as sentences
maps            OpenEXR of named channels
field_map       a map over directions, read between its pixels
frames          PNG: what the panel is sent, and camera counts
scene           a scene image -> intensity, checked at the border
scene_data      what the files of the other scenes hold, as plain data
scene_points    points in a CSV file
scene_layers    images with depths, listed in a TOML file
scene_mesh      a mesh in an OBJ or PLY file
scene_views     the views of a light field, listed in a TOML file
reading         a user's file opened, and what goes wrong said
scene_toml      what the two lists have in common
manifest        SHA-256 and size of every file of a run
run_files       what a run directory says of itself, read without trust
results         the numbers of a result, with sigma and target
checks          the checks that were made of a rig's calibration
index           all runs, for questions about their history
calibration     which accepted runs are in force for a rig
==============  ==========================================================
"""
