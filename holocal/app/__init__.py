"""The technician's application: finds rigs and procedures by entry point, never by import.

==============  ==========================================================
cli             the command line, one file per command
session         a rig, its lock, its corrections and a run put together
configuration   ``--set``, parameters, and ``config.toml`` with origins
corrections     accepted maps applied to a scene
rendering       a scene file -> the files of its hologram
batch           a folder of scenes -> a frame for each
tolerancing     a tolerance study: started, gone on with, summed up
farm            work in many pieces: here, in several processes, or on Dask
capturing       a frame shown and captured at an exposure found for it
health          packages, plug-ins, devices seen, a rig's pre-flight
terminal        progress and errors on stderr, results on stdout
report          a run directory -> one self-contained page
export          a run directory -> one file for other programs
checking        the accepted calibration measured again in a few frames
history         the runs of a rig in time, and their plot
comparing       two runs side by side
==============  ==========================================================
"""
