"""From frames to what they say, with how sure: no hardware, no files, no plots.

==============  ===========================================================================
blocks          local mean brightness of a speckled picture, and its noise
thesis_map      the thesis's estimate of the brightness: block means, then a Gaussian
registration    where the camera sees the image, from a frame of blobs
brightness      the default: one smooth map from all frames, by a Gaussian process
uniformity      non-uniformity of a picture, speckle taken out, with its error
fringes         the phases of unknown steps, from the fringe that every camera pixel sees
response        the phase of every level of a panel, from the phases of some
posterior       samples of what measurements leave possible, round a maximum-likelihood fit
coverage        whether errors are as large as they are said to be
spot_model      what a camera window shows of a spot, through the known frame
spot_places     where the camera sees the zones' spots
spot_fit        the wavefront of a zone, with nuisances, coarse to fine
zone_data       what that fit is made of: noise, priors, counts, parameters, result
zone_fits       the fits of all zones
field_model     Zernike coefficients over the field, from all zones together
lit_pupil       what of a wavefront a cut pupil shows, and a bias that spreads its spot
mirrored_pictures
                what two pictures at opposite biases say about an aberration
model_free      the aberration of every zone without a model: plan, trials, steps
model_free_state, model_free_result
                its plan and state; what it found, how sure, what did not work
dot_grid        a regular grid of dots in a picture: found, indexed, mapped
dot_scale, dot_detection, dot_fit
                the dots' size and sign; which spots are dots; their centres
dot_indexing, lattice_prediction
                rows and columns; where a cell should be, from its neighbours
smooth_map, map_fit, map_basis
                a smooth map of the plane with its error and inverse; its fit; its terms
==============  ===========================================================================
"""
