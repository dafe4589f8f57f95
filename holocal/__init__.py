"""holocal: closed-loop calibration and correction of holographic near-eye displays.

=============  ==============================================================================
app            command line, plug-ins, report: finds rigs and procedures by entry point
loop           devices, procedure, runner, gates, record: shows and looks, knows no physics
tolerance      what built benches are worth, before and after correction
hologram       scene and calibration -> levels: points, zones, encoders, frame
estimate       frames -> brightness, wavefront, geometry, with their uncertainty
optics         bench, ray trace, phase functions, Zernike polynomials, propagation
records        frozen data and its files
=============  ==============================================================================
"""

__version__ = "0.1.0"
