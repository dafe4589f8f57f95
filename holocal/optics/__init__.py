"""The optics of the bench as functions on arrays: float64, SI units, no files, no hardware.

==================  ====================================================================
bench               the ellipsoid bench, its frames, its panel and pupil, its misalignment
raytrace            rays through the bench both ways, and between two given points
phase_function      what the panel must show for one virtual point: path length, slope fit
series              smooth functions of two variables as Chebyshev series
spots               waves of a few points over the whole panel as local plane waves; the adjoint
zernike             Zernike polynomials and their gradients by stable recurrences
propagate           free space to a parallel plane, and the direct sum that judges it
free_space_kernel   its kernel on a padded grid: plane waves, points, or cylinder waves
doubtful_light      a warning of light whose way the samples of a field do not tell
padded_convolution  convolution with an even kernel, without the FFTs of zeros
==================  ====================================================================
"""
