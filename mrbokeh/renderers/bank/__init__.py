"""Banks of measured kernels in the role of apertures, for every renderer that can take them."""
