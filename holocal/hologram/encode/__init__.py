"""From the full-complex hologram to a phase.

====================  =======================================================================
``encoder``           what every encoder is given and gives back; encoders one after another
``ifta``              the phase-only field nearest to a wanted spectrum; ``ifta_encoder``
``gradient_descent``  the same by descent with momentum, towards any of the ``goals``
``direct_search``     the best phase or level of every fourth pixel at a time
``error_diffusion``   one pass; what a pixel cannot show is passed on to its neighbours
``double_phase``      closed form: two neighbouring pixels share one value
``fourier``           Fourier transforms between the panel and a window of frequencies
``far_field``         the plain, zero-padded Fourier transform of a field
``levels``            the panel's levels as part of a search
``blocks``            threads that take lines in blocks, from end to end in a cache
====================  =======================================================================
"""
