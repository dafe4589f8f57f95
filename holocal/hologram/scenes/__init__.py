"""What is shown, as points (thesis 1.2: points, layers, polygons and rays alike).

===========  =================================================================
points       a cloud of points, and the part of the pupil it is seen through
image        an image as a grid of points; initial phases
cloud        points of a table; the lit points of a grid
layers       images in planes of their own depths, nearer ones hiding farther
raster       which triangle is seen in which direction, and where
mesh         triangles, placed, shaded and seen: a point per visible pixel
light_field  views from parts of the pupil: a cloud for each
===========  =================================================================
"""
