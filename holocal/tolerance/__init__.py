"""What built benches are worth: image errors by exact rays, before and after correction, and what they do to a yield.

Arrays and frozen data; no files, no camera, no loop. It stands on `optics`, `hologram` and `estimate`, as the
procedures do.

===========  ==============================================================================
design       the bench as it is drawn, and the light that its hologram sends
arrival      where that light arrives on a built bench
wavefront    the wavefront error, and what a correction by Zernike coefficients leaves
picture      distortion, and what four corners and the smooth map leave
light        brightness, evened out at what price; what the panel cannot reach
bench_error  all of it for one bench
cases        which benches a study looks at: drawn, scaled, one freedom at a time
verdict      a bench against the spec, and why it fails
table        the benches that were drawn, as text
summary      yields, sensitivities, and where correction no longer suffices
===========  ==============================================================================
"""
