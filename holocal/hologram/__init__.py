"""Scene and calibration to the panel's levels.

==================  =====================================================================
``pipeline``        points -> full-complex hologram -> phase -> levels; start reading here
``settings``        panel, bench, colour, field, method: what a hologram is made for
``scenes``          images, points, layers, meshes, light fields -> clouds of points
``synthesis``       points -> hologram, by the method that the settings name
``phase_model``     the phase that is wanted: traced paths and the wavefront correction
``direct``          the sum of exact waves, judge of the others
``zones``           the thesis's zones and their table; ``zone_sum`` adds them up
``sight``           the panel as the pupil's centre sees it, where the pupil is a mask
``warp``            bilinear forms of the phase; ``warped`` cuts the panel in patches
``warped_sum``      non-uniform transforms of patches, the mask, the way to the pixels
``depths``          points that may share a depth
``stored``          plans as arrays, for a store between programs
``wavefront``       Zernike corrections over the field
``encode``          to phase only: IFTA and the other encoders
``frame``           phase -> levels -> packing
``quality``         PSNR with its definition; ``wavefront_error`` what methods leave
``reference``       psi0 and the pupil's window; ``footprint``, ``grid``, ``series`` serve
==================  =====================================================================
"""
