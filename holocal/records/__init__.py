"""Frozen data and their files.

==============  ==========================================================
facts           what a rig says of itself: panel, camera, wavelengths
rig             a rig's file: found, typed, fingerprinted
rig_model       the simulated rig's file: every key with its range
validate        pydantic's complaints as errors that name file and key
files           atomic writes, JSON, TOML
maps            OpenEXR of named channels
frames          PNG: what the panel is sent, and camera counts
scene           a scene image -> intensity, checked at the border
manifest        SHA-256 and size of every file of a run
calibration     which accepted runs are in force for a rig
==============  ==========================================================
"""
