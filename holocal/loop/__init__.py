"""The closed loop: shows, grabs, gates, journals, checkpoints, stops. No physics.

==============  ==========================================================
devices         what is asked of a panel, a camera, a light, a rig
procedure       what a procedure is to the runner
runner          one closed loop, from the first frame to the manifest
shooting        one shot: show, expose, grab, gates, retake
gates           what makes a frame unfit, each with its number and limit
reference       what the pre-flight learns of camera and light: dark level, noise, rate
sameness        whether two pictures are of one pattern
preflight       what must hold before the first measurement
drift           whether the light at the end is that of the pre-flight
checking        an accepted calibration measured again
ending          the panel blank and the light off on every way out
record          the run directory
checkpoint      a frozen state to a file and back, in two slots
figures         the data of the report's figures
environment     versions, platform, commit, threads
lock            one process per rig, one per run
signals         Ctrl-C, SIGTERM and SIGHUP while a rig is open
==============  ==========================================================
"""
