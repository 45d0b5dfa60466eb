"""A lens measured: kernels over blur, field and colour, from focal stacks, blur pairs and pictures of points of light.

A kernel is a picture of the pupil (fitting.pupil_picture), scaled by half the signed circle of confusion. So each blurred
pixel of a slice is a sum of that picture's cells, each times what it sees of the all-in-focus picture: one linear equation, whatever the
diameter. Equations of many pixels (evidence) are summed in normal matrices, one per side of the focus, range of diameters, part of the
field and colour (knots), and solved for pictures that are nowhere negative, sum to one, and are near their neighbours' (solving).
"""
