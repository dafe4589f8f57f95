"""A bench outside the program under test: it looks at a monitor's pixels and answers as a GigE Vision camera.

==================  ====================================================================
__main__            the process: arguments, start, end
process             start and end it from Python
twin                the simulated bench behind the devices
monitor             the pixels of the panel's monitor
lasers              the lasers: SCPI on TCP ports
gige_server         the camera: libaravis's simulator with our pictures, by ctypes
camera_description  its GenICam description: features and registers
pixel_formats       counts as bytes on the wire
==================  ====================================================================
"""
