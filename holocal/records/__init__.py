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
calibration     which accepted runs are in force for a rig
==============  ==========================================================
"""
