"""From the full-complex hologram to a phase.

==============  =================================================================
``blocks``      threads that take lines in blocks, from end to end in a cache
``fourier``     Fourier transforms between the panel and a window of frequencies
``ifta``        the phase-only field nearest to a wanted spectrum
==============  =================================================================
"""
