"""The closed loop: shows, grabs, gates, journals, checkpoints, stops. No physics.

==============  ==========================================================
devices         what is asked of a panel, a camera, a light, a rig
procedure       what a procedure is to the runner
runner          one closed loop, from the first frame to the manifest
shooting        one shot: show, expose, grab, gates, retake
gates           what makes a frame unfit, each with its number and limit
preflight       what must hold before the first measurement
record          the run directory
checkpoint      a frozen state to a file and back, in two slots
figures         the data of the report's figures
environment     versions, platform, commit, threads
lock            one process per rig, one per run
signals         Ctrl-C and SIGTERM end a run after its step
==============  ==========================================================
"""
