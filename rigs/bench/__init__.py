"""A bench outside the program under test: it looks at a monitor's pixels and answers as a GigE Vision camera.

==================  ====================================================================
gige_server         the camera: libaravis's simulator with our pictures, by ctypes
camera_description  its GenICam description: features and registers
pixel_formats       counts as bytes on the wire
==================  ====================================================================
"""
