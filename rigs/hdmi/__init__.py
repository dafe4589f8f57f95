"""A phase panel on a monitor output: the parts of `rigs.hdmi_slm`.

============ =====================================================================================================
`window`     the full-screen window and its pixels, by SDL2; only the thread that opened it may use it
`x_outputs`  what an X server says of its outputs: mode, rotation, gamma ramp, properties, EDID
`x_guard`    a lost X server becomes an error here, not the end of the process
`read_back`  the pixels that the display server says are on the panel's output
`edid`       who made a monitor: the identity that it sends over its cable
============ =====================================================================================================
"""
