"""The optics of the bench as functions on arrays: float64, SI units, no files, no hardware.

==============  ========================================================================
bench           the ellipsoid bench, its frames, its panel and pupil, its misalignment
raytrace        rays through the bench both ways, and between two given points
phase_function  what the panel must show for one virtual point: path length, slope fit
zernike         Zernike polynomials and their gradients by stable recurrences
propagate       angular spectrum, impulse response, and the direct sum that judges them
==============  ========================================================================
"""
