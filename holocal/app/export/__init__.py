"""A run for other programs: everything that it measured, with names, units and axes, in one file.

==============  ==========================================================
contents        what a run holds: arrays with units and axes, documents
formats         the contents as NumPy, HDF5 or OpenEXR
==============  ==========================================================
"""
