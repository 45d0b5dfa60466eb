"""The exact reference: every pixel spread by its own kernel, clipped against the pixel grid."""
